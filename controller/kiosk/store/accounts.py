"""Accounts with argon2id passwords and API tokens, each with one of three roles, in one private file."""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import json
import re
import secrets
import threading
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

from argon2 import PasswordHasher
from argon2.exceptions import InvalidHashError, VerificationError

from controller.core.errors import UsageError, WorkError
from controller.core.files import read_bytes
from controller.core.storage import write_atomically
from controller.kiosk.roles import ACCOUNT_NAME, LONGEST_PASSWORD, Role


def digest_of(secret: str) -> str:
    """SHA-256 in hex of a session's or a token's secret; the secret has too many bits to be guessed."""
    return hashlib.sha256(secret.encode()).hexdigest()


SHORTEST_PASSWORD: Final = 10
FOLDER: Final = "kiosk/panel"
"""The panel's private files, in the stage's folder."""
FIRST_ACCOUNT: Final = "technician"
TOKEN_PREFIX: Final = "velatura_"  # noqa: S105 - a prefix that shows what the token is for

# Without characters that look alike when they are projected.
_READABLE: Final = "abcdefghkmnpqrstuvwxyz23456789"


@dataclass(frozen=True, slots=True)
class Account:
    """``one_time`` True: the password must be changed before anything else is allowed."""

    name: str
    role: Role
    password_hash: str
    one_time: bool = False


@dataclass(frozen=True, slots=True)
class Token:
    """An API token. Only its SHA-256 is stored: 256 random bits need no slow hash."""

    name: str
    role: Role
    digest: str
    made_unix_s: float


class Accounts:
    """The accounts of a kiosk, in ``file`` (JSON, mode 0600). Thread-safe.

    ``hasher`` argon2id; the default is RFC 9106's low-memory choice, about 50 ms.
    """

    def __init__(
        self, file: Path, *, hasher: PasswordHasher | None = None, clock: Callable[[], float] = time.time
    ) -> None:
        self._file, self._clock = file, clock
        self._hasher = hasher or PasswordHasher()
        self._lock = threading.RLock()
        # An unknown name must take as long as a wrong password, else the response time would reveal names.
        self._unknown_hash = self._hasher.hash(secrets.token_urlsafe(16))
        self._accounts, self._tokens = _read(file)

    def first_start(self) -> str | None:
        """Make the first technician with a one-time password and return it; None if an account has its own password.

        The password itself is not stored. Every start makes a new one until it has been used.
        """
        with self._lock:
            if self.entered:
                return None
            password = "-".join("".join(secrets.choice(_READABLE) for _ in range(4)) for _ in range(4))
            # Every start makes another one, so a disk that is full must not keep the service from starting.
            with contextlib.suppress(WorkError):
                self._put(Account(FIRST_ACCOUNT, Role.TECHNICIAN, self._hasher.hash(password), one_time=True))
            return password

    @property
    def entered(self) -> bool:
        """Whether an account has its own password, not a one-time password."""
        with self._lock:
            return any(not account.one_time for account in self._accounts.values())

    def all(self) -> list[Account]:
        with self._lock:
            return sorted(self._accounts.values(), key=lambda account: account.name)

    def get(self, name: str) -> Account | None:
        with self._lock:
            return self._accounts.get(name)

    def verify(self, name: str, password: str) -> Account | None:
        """The account, if the password is right. Takes the same time for an unknown name."""
        account = self.get(name)
        stored = self._unknown_hash if account is None else account.password_hash
        if account is not None and account.one_time:
            password = password.lower()  # projectors show it in upper case
        try:
            self._hasher.verify(stored, password[:LONGEST_PASSWORD])
        except (VerificationError, InvalidHashError):
            return None
        return account

    def add(self, name: str, role: Role, password: str) -> None:
        """Raises UsageError("account-name", "account-exists", "password-weak")."""
        if not re.fullmatch(ACCOUNT_NAME, name):
            raise UsageError(
                "account-name",
                what="This account name is not allowed.",
                remedy="Use 1 to 32 lower-case letters, digits, dots, dashes, underscores. Start with a letter.",
            )
        _check_password(name, password)
        with self._lock:
            if name in self._accounts:
                raise UsageError(
                    "account-exists", what=f"The account '{name}' exists already.", remedy="Choose another name."
                )
            self._put(Account(name, role, self._hasher.hash(password)))

    def set_password(self, name: str, password: str) -> None:
        """Raises UsageError("account-unknown", "password-weak")."""
        _check_password(name, password)
        with self._lock:
            self._put(replace(self._known(name), password_hash=self._hasher.hash(password), one_time=False))

    def set_role(self, name: str, role: Role) -> None:
        """Raises UsageError("account-unknown", "last-technician")."""
        with self._lock:
            account = self._known(name)
            if role is not Role.TECHNICIAN:
                self._keep_a_technician(account)
            self._put(replace(account, role=role))

    def remove(self, name: str) -> None:
        """Raises UsageError("account-unknown", "last-technician")."""
        with self._lock:
            self._keep_a_technician(self._known(name))
            del self._accounts[name]
            self._write()

    def tokens(self) -> list[Token]:
        with self._lock:
            return sorted(self._tokens.values(), key=lambda token: token.name)

    def add_token(self, name: str, role: Role) -> str:
        """A new token; it is not stored in clear text. Raises UsageError("account-name", "token-exists")."""
        if not re.fullmatch(ACCOUNT_NAME, name):
            raise UsageError(
                "account-name",
                what="This token name is not allowed.",
                remedy="Use 1 to 32 lower-case letters, digits, dots, dashes, underscores. Start with a letter.",
            )
        with self._lock:
            if name in self._tokens:
                raise UsageError(
                    "token-exists",
                    what=f"The token '{name}' exists already.",
                    remedy="Remove it, or choose another name.",
                )
            token = TOKEN_PREFIX + secrets.token_urlsafe(32)
            self._tokens[name] = Token(name, role, digest_of(token), self._clock())
            self._write()
            return token

    def remove_token(self, name: str) -> None:
        """Raises UsageError("token-unknown")."""
        with self._lock:
            if self._tokens.pop(name, None) is None:
                raise UsageError(
                    "token-unknown", what="This token does not exist.", remedy="Load the page again and choose another."
                )
            self._write()

    def by_token(self, shown: str) -> Token | None:
        """The token of the secret ``shown``, compared in constant time with every token."""
        digest = digest_of(shown)
        with self._lock:
            matching = [token for token in self._tokens.values() if hmac.compare_digest(token.digest, digest)]
        return matching[0] if matching else None

    def _known(self, name: str) -> Account:
        account = self._accounts.get(name)
        if account is None:
            raise UsageError(
                "account-unknown", what="This account does not exist.", remedy="Load the page again and choose another."
            )
        return account

    def _keep_a_technician(self, leaving: Account) -> None:
        others = [other for other in self._accounts.values() if other.name != leaving.name]
        if leaving.role is Role.TECHNICIAN and all(other.role is not Role.TECHNICIAN for other in others):
            raise UsageError(
                "last-technician",
                what="This is the last technician.",
                remedy="Make another account a technician first. A stage needs at least one.",
            )

    def _put(self, account: Account) -> None:
        self._accounts[account.name] = account
        self._write()

    def _write(self) -> None:
        content = {
            "accounts": [{**asdict(account), "role": account.role.name} for account in self._accounts.values()],
            "tokens": [{**asdict(token), "role": token.role.name} for token in self._tokens.values()],
        }
        write_atomically(self._file, (json.dumps(content, indent=1) + "\n").encode(), mode=0o600)


def _read(file: Path) -> tuple[dict[str, Account], dict[str, Token]]:
    """Raises UsageError("accounts-damaged"): a damaged file must not count as "no accounts"."""
    try:
        content: Any = json.loads(read_bytes(file))
        accounts = [Account(**{**row, "role": Role[row["role"]]}) for row in content["accounts"]]
        tokens = [Token(**{**row, "role": Role[row["role"]]}) for row in content["tokens"]]
    except FileNotFoundError:
        return {}, {}
    except (ValueError, KeyError, TypeError, OSError, RecursionError) as error:
        raise UsageError(
            "accounts-damaged",
            what=f"The accounts in {file} can't be read.",
            remedy="Restore the file from a copy, or delete it. The next start then makes a new one-time password.",
        ) from error
    return {account.name: account for account in accounts}, {token.name: token for token in tokens}


def _check_password(name: str, password: str) -> None:
    if not SHORTEST_PASSWORD <= len(password) <= LONGEST_PASSWORD or name in password or len(set(password)) < 5:
        raise UsageError(
            "password-weak",
            what="This password is too easy to guess.",
            remedy=f"Use {SHORTEST_PASSWORD} characters or more, without the account's name. A few words are good.",
        )


def stage_accounts(stage: Path) -> Accounts:
    """The accounts of a stage; open them only once at a time. Raises UsageError("accounts-damaged")."""
    (stage / FOLDER).mkdir(mode=0o700, parents=True, exist_ok=True)
    return Accounts(stage / FOLDER / "accounts.json")


__all__ = [
    "FIRST_ACCOUNT", "FOLDER", "LONGEST_PASSWORD", "SHORTEST_PASSWORD", "TOKEN_PREFIX", "Account", "Accounts", "Role",
    "Token", "stage_accounts",
]  # fmt: skip
