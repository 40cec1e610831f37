"""The routes for log-in, log-out, passwords, accounts and tokens."""

from __future__ import annotations

import hmac
import re
from functools import partial
from typing import Any

import anyio
from starlette.requests import Request
from starlette.responses import HTMLResponse, RedirectResponse, Response

from controller.core.errors import UsageError
from controller.core.text import printable
from controller.kiosk.store.accounts import FIRST_ACCOUNT, LONGEST_PASSWORD, Account, Role
from controller.panel.auth.identity import Entry, Visitor, cookie_name, form_pair, form_token, same_origin
from controller.panel.auth.sessions import LONGEST_S
from controller.panel.context import Panel
from controller.panel.pages.drawing import Drawing
from controller.panel.pages.forms import Sent, checked, refused
from controller.panel.pages.routes import Pages
from controller.panel.words.language import COOKIE, LANGUAGES, LOOK_COOKIE, LOOKS, gettext, mark, ngettext

_WRONG = mark("Name or password is wrong.")


class Entrance:
    def __init__(self, panel: Panel, drawing: Drawing, pages: Pages) -> None:
        self._panel, self._drawing, self._pages = panel, drawing, pages

    def entries(self) -> list[Entry]:
        forms = (
            ("/logout", Role.VIEWER, self._logout),
            ("/password", Role.VIEWER, self._password),
            ("/accounts/add", Role.TECHNICIAN, self._add),
            ("/accounts/role", Role.TECHNICIAN, self._role),
            ("/accounts/remove", Role.TECHNICIAN, self._remove),
            ("/tokens/add", Role.TECHNICIAN, self._add_token),
            ("/tokens/remove", Role.TECHNICIAN, self._remove_token),
        )
        return [
            Entry("GET", "/login", "public", None, self._login_page),
            Entry("POST", "/login", "public", None, self._login),
            Entry("POST", "/language", "public", None, self._language),
            *(Entry("POST", path, "session", role, checked(self._panel, handler)) for path, role, handler in forms),
        ]

    async def _login_page(self, _: Request, __: Visitor) -> Response:
        return self._form("", 200)

    async def _language(self, request: Request, _: Visitor) -> Response:
        """Keep the visitor's language, and the look of pages, in cookies, and go back to the page."""
        form = await request.form(max_files=0, max_fields=4, max_part_size=4096)
        name, back = str(form.get("language", "")), str(form.get("back", "/"))
        if name not in LANGUAGES or not same_origin(self._panel, request):
            raise refused()
        # Only a path of ours: it must not lead elsewhere.
        page = RedirectResponse(back if re.fullmatch(r"/[A-Za-z0-9._/-]*", back) and "//" not in back else "/", 303)
        self._set_cookie(page, COOKIE, name, 400 * 86400)
        if (look := form.get("look")) in LOOKS:
            self._set_cookie(page, LOOK_COOKIE, str(look), 400 * 86400)
        return page

    def _form(self, problem: str, status: int) -> Response:
        cookie, token = form_pair(self._panel)
        # Before anybody has entered there is one account, whose name the documentation says.
        name = "" if self._panel.accounts.entered else FIRST_ACCOUNT
        facts = {"csrf": token, "problem": gettext(problem), "here": "/login", "name": name}
        page = HTMLResponse(self._drawing.page("login.html", facts), status)
        self._set_cookie(page, cookie_name(self._panel) + "-form", cookie, 3600)
        return page

    def _set_cookie(self, page: Response, name: str, value: str, max_age_s: int) -> None:
        page.set_cookie(
            name, value, max_age=max_age_s, path="/", secure=self._panel.options.tls, httponly=True, samesite="strict"
        )

    async def _login(self, request: Request, _: Visitor) -> Response:
        panel = self._panel
        form = await request.form(max_files=0, max_fields=5, max_part_size=4096)
        name, password, token = (str(form.get(key, ""))[:LONGEST_PASSWORD] for key in ("name", "password", "csrf"))
        cookie = request.cookies.get(cookie_name(panel) + "-form", "")
        expected = form_token(panel, cookie)
        if not same_origin(panel, request):
            return self._form(mark("The panel does not know this address. Start the kiosk with --name for it."), 403)
        if not cookie or not hmac.compare_digest(expected, token.encode().decode("ascii", "replace")):
            return self._form(mark("This page was out of date. Try again."), 403)
        address = request.client.host if request.client else ""
        wait_s = max(panel.by_address.wait_s(address), panel.by_account.wait_s(name))
        if wait_s > 0:
            whole_s = int(wait_s) + 1
            said = ngettext("Too many wrong passwords. Wait %(num)d second.",
                            "Too many wrong passwords. Wait %(num)d seconds.", whole_s)  # fmt: skip
            page = self._form(said % {"num": whole_s}, 429)
            page.headers["retry-after"] = str(int(wait_s) + 1)
            return page
        # Counted before the check, so that many simultaneous tries are all counted.
        panel.by_address.failed(address)
        panel.by_account.failed(name)
        account = await anyio.to_thread.run_sync(panel.accounts.verify, name, password, limiter=panel.hashing)
        if account is None:
            panel.refused.add(f"A log-in as {printable(name)[:32]} from {address} was refused")
            return self._form(_WRONG, 403)
        panel.kiosk.record("logged-in", f"{account.name} logged in from {address}.")
        panel.by_address.succeeded(address)
        panel.by_account.succeeded(name)
        return self._enter(request, account)

    def _enter(self, request: Request, account: Account) -> Response:
        """Start a new session; a session cookie of the browser is never reused."""
        panel = self._panel
        panel.sessions.end(request.cookies.get(cookie_name(panel), ""))
        secret, _ = panel.sessions.begin(account.name)
        if panel.accounts.get(account.name) != account:
            # The account was changed during the check, after its other sessions had been ended.
            panel.sessions.end(secret)
            return self._form(_WRONG, 403)
        first = "/setup" if panel.kiosk.snapshot().needs_setup and account.role is Role.TECHNICIAN else "/"
        page = RedirectResponse("/password" if account.one_time else first, 303)
        self._set_cookie(page, cookie_name(panel), secret, int(LONGEST_S))
        page.delete_cookie(cookie_name(panel) + "-form", path="/", secure=panel.options.tls, httponly=True)
        return page

    async def _logout(self, _: Request, visitor: Visitor, __: Sent) -> Response:
        self._panel.kiosk.record("logged-out", f"{visitor.name} logged out.")
        self._panel.sessions.end(visitor.secret)
        page = RedirectResponse("/login", 303)
        page.delete_cookie(cookie_name(self._panel), path="/", secure=self._panel.options.tls, httponly=True)
        page.headers["clear-site-data"] = '"cache"'
        return page

    async def _password(self, request: Request, visitor: Visitor, sent: Sent) -> Response:
        panel, new = self._panel, sent.texts.get("new", "")
        old = sent.texts.get("old", "")
        address = request.client.host if request.client else ""
        try:
            if panel.by_address.wait_s(address) > 0:
                raise UsageError("too-many-tries", what="Too many wrong passwords.", remedy="Wait a minute.")

            async def known(password: str) -> Account | None:
                verify = partial(panel.accounts.verify, visitor.name, password)
                return await anyio.to_thread.run_sync(verify, limiter=panel.hashing)

            # Who entered with a one-time password typed it a moment ago, and can do nothing but this.
            if not visitor.must_change_password and await known(old) is None:
                panel.by_address.failed(address)
                panel.refused.add(f"A change of the password of {visitor.name} from {address} was refused")
                raise UsageError("password-wrong", what="The old password is wrong.", remedy="Type it again.")
            if new != sent.texts.get("again", ""):
                raise UsageError("password-wrong", what="The two new passwords differ.", remedy="Type them again.")
            if await known(new) is not None:
                raise UsageError("password-weak", what="The new password is the old one.", remedy="Choose another one.")
            await anyio.to_thread.run_sync(panel.accounts.set_password, visitor.name, new, limiter=panel.hashing)
        except UsageError as error:
            return await self._redirect(visitor, "/password", "error", f"{error.what} {error.remedy}")
        panel.kiosk.record("done-by", f"{visitor.name}: Change the own password.")
        panel.sessions.end_all(visitor.name, but=visitor.session)
        page = "/setup" if panel.kiosk.snapshot().needs_setup and visitor.role is Role.TECHNICIAN else "/"
        return await self._redirect(visitor, page, "good", gettext("Your new password is in use."))

    async def _redirect(self, visitor: Visitor, page: str, level: str, text: str) -> Response:
        assert visitor.session is not None
        visitor.session.notes.append((level, text))
        return RedirectResponse(page, 303)

    async def _again(self, visitor: Visitor, error: UsageError, typed: dict[str, str]) -> Response:
        """The page with what was typed; passwords are not kept."""
        assert visitor.session is not None
        visitor.session.notes.append(("error", f"{error.what} {error.remedy}"))
        facts = {**self._pages.accounts(), "here": "/accounts", "typed": typed}
        return await self._pages.show("accounts.html", visitor, facts, 422)

    async def _apply(
        self, visitor: Visitor, change: Any, said: str, about: str, typed: dict[str, str] | None = None
    ) -> Response:
        try:
            await anyio.to_thread.run_sync(change, limiter=self._panel.hashing)
        except UsageError as error:
            self._panel.kiosk.record("refused", f"{visitor.name}: {about}. Refused: {error.what}", "warning")
            if typed is not None:
                return await self._again(visitor, error, typed)
            return await self._redirect(visitor, "/accounts", "error", f"{error.what} {error.remedy}")
        self._panel.kiosk.record("done-by", f"{visitor.name}: {about}.")
        return await self._redirect(visitor, "/accounts", "good", said)

    async def _add(self, _: Request, visitor: Visitor, sent: Sent) -> Response:
        name, password, role = (sent.texts.get(key, "") for key in ("name", "password", "role"))
        return await self._apply(
            visitor, lambda: self._panel.accounts.add(name, Role.named(role), password),
            gettext("The account is added."),
            f"Add the account {name} ({role})", {"name": name, "role": role},
        )  # fmt: skip

    async def _role(self, _: Request, visitor: Visitor, sent: Sent) -> Response:
        name, role = sent.texts.get("name", ""), sent.texts.get("role", "")

        def change() -> None:
            self._panel.accounts.set_role(name, Role.named(role))
            if name != visitor.name:
                self._panel.sessions.end_all(name)

        return await self._apply(visitor, change, gettext("The role is changed."), f"Make {name} a {role}")

    async def _remove(self, _: Request, visitor: Visitor, sent: Sent) -> Response:
        name = sent.texts.get("name", "")
        if sent.texts.get("sure") != "yes":
            question = gettext("Remove the account {name}?").format(name=name)
            return await self._ask(visitor, "/accounts/remove", question, name)

        def change() -> None:
            self._panel.accounts.remove(name)
            self._panel.sessions.end_all(name)

        said = gettext("The account is removed.")
        return await self._apply(visitor, change, said, f"Remove the account {name}")

    async def _add_token(self, _: Request, visitor: Visitor, sent: Sent) -> Response:
        accounts = self._panel.accounts
        try:
            shown = accounts.add_token(sent.texts.get("name", ""), Role.named(sent.texts.get("role", "")))
        except UsageError as error:
            typed = {f"token-{key}": sent.texts.get(key, "") for key in ("name", "role")}
            return await self._again(visitor, error, typed)
        self._panel.kiosk.record(
            "done-by", f"{visitor.name}: Add the token {sent.texts['name']} ({sent.texts['role']})."
        )
        facts = {"accounts": accounts.all(), "tokens": accounts.tokens(), "shown": shown, "here": "/accounts"}
        return await self._pages.show("accounts.html", visitor, facts)

    async def _remove_token(self, _: Request, visitor: Visitor, sent: Sent) -> Response:
        name = sent.texts.get("name", "")
        if sent.texts.get("sure") != "yes":
            question = gettext("Remove the token {name}? Its programs are refused.").format(name=name)
            return await self._ask(visitor, "/tokens/remove", question, name)
        change = partial(self._panel.accounts.remove_token, name)
        said = gettext("The token is removed.")
        return await self._apply(visitor, change, said, f"Remove the token {name}")

    async def _ask(self, visitor: Visitor, action: str, question: str, name: str) -> Response:
        facts = {"question": question, "action": action, "back": "/accounts", "kept": [("name", name)]}
        return await self._pages.show("sure.html", visitor, {**facts, "here": "/accounts", "returns": False})
