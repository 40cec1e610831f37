"""A computer joins a house by a short code that it shows on its own screen, and that a person types at the house.

The code is the password of SPAKE2 (RFC 9382; the package that Magic Wormhole uses): who listens learns nothing, and who
is in between has one guess for each exchange. A code is for one use, a few minutes and three exchanges. What follows,
the request for a certificate and the certificate, is sealed by the key that both then have (NaCl's secret box).
"""

from __future__ import annotations

import re
import secrets
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypeVar

from nacl.encoding import RawEncoder
from nacl.exceptions import CryptoError
from nacl.hash import blake2b
from nacl.secret import SecretBox
from spake2 import SPAKE2_A, SPAKE2_B, SPAKEError

from controller.core.errors import UsageError, WorkError
from controller.stage.link.membership import AUTHORITY, Authority, Member, Membership, checked_name, join, requested
from controller.stage.link.session import EVERYWHERE, Link, packed, unpacked
from hal.errors import CodedError, DeviceError
from hal.links import host_and_port

T = TypeVar("T")
PORT: Final = 7448
VALID_S: Final = 600.0
MOST_EXCHANGES: Final = 3
DIGITS: Final = 8
_WITHIN_S: Final = 10.0


@dataclass(frozen=True, slots=True)
class _Hello:
    """SPAKE2's message, hex, and what is sealed for the other, hex."""

    element: str
    sealed: str = ""


@dataclass(frozen=True, slots=True)
class _Asked:
    request: str
    name: str


@dataclass(frozen=True, slots=True)
class _Admitted:
    certificate: str
    authority: str
    house: str
    endpoints: tuple[str, ...]


class Joining:
    """The side of the computer that joins; a context manager. ``code`` is to be shown to the person."""

    def __init__(
        self, folder: Path, name: str, *, host: str = EVERYWHERE, port: int = PORT, valid_s: float = VALID_S
    ) -> None:
        """``folder``: of the membership to come.

        Raises UsageError("house-name-wrong") and WorkError("link-not-opened").
        """
        self._folder, self._name = folder, checked_name(name)
        number = f"{secrets.randbelow(10**DIGITS):0{DIGITS}}"
        self.code = f"{number[:4]}-{number[4:]}"
        self._until_s = time.monotonic() + valid_s
        self._key, self._request = requested()
        self._exchanges = 0
        self._boxes: tuple[SecretBox, SecretBox] | None = None
        self._lock, self._over = threading.Lock(), threading.Event()
        self._outcome: Membership | CodedError | None = None
        self._link = Link({"listen": {"endpoints": [f"tcp/{host}:{port}"], "exit_on_failure": True}}, "tcp")
        self._link.answer("join/hello", _Hello, self._hello)
        self._link.answer("join/admitted", bytes, self._admitted)

    def __enter__(self) -> Joining:
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._link.close()

    def wait(self) -> Membership:
        """Wait until it has joined. Raises WorkError("join-code-expired", "join-code-refused") and
        UsageError("house-certificate-wrong").
        """
        self._over.wait(max(0.0, self._until_s - time.monotonic()))
        with self._lock:
            outcome = self._outcome or _expired()
            self._over.set()
        if isinstance(outcome, CodedError):
            raise outcome
        return outcome

    def _hello(self, hello: _Hello) -> _Hello:
        with self._lock:
            if self._over.is_set() or time.monotonic() > self._until_s:
                raise _expired()
            self._exchanges += 1
            side = SPAKE2_B(_password(self.code), idA=b"velatura house", idB=b"velatura member")
            element = side.start()
            try:
                boxes = self._boxes = _boxes(side.finish(bytes.fromhex(hello.element)))
            except (SPAKEError, ValueError) as error:
                raise _refused() from error
            asked = _Asked(self._request.decode(), self._name)
            if self._exchanges == MOST_EXCHANGES:
                # The last exchange may be the right one; after it, there is none.
                self._until_s = min(self._until_s, time.monotonic() + _WITHIN_S)
            if self._exchanges > MOST_EXCHANGES:
                self._end(_refused())
                raise _refused()
            return _Hello(element.hex(), boxes[1].encrypt(packed(asked)).hex())

    def _admitted(self, sealed: bytes) -> None:
        with self._lock:
            if self._over.is_set() or self._boxes is None:
                raise _expired()
            sent = _opened(self._boxes[0], sealed, _Admitted)
            member = Membership(self._folder, self._name, sent.house, sent.endpoints)
            try:
                join(member, self._key, sent.certificate.encode(), sent.authority.encode())
            except CodedError as error:
                self._end(error)
                raise
            self._end(member)

    def _end(self, outcome: Membership | CodedError) -> None:
        self._outcome = outcome
        self._over.set()


def admit(authority: Authority, address: str, code: str, endpoints: tuple[str, ...]) -> Member:
    """The house's side: admit the computer at ``address`` (host, or host:port) that shows ``code``.

    ``endpoints``: where the house can be reached. Raises UsageError("join-code-wrong", "house-name-taken",
    "house-name-wrong"), WorkError("join-no-answer", "join-code-refused", "join-code-expired").
    """
    try:
        host, port = host_and_port(address.strip(), PORT)
    except DeviceError as error:
        raise UsageError("join-address-wrong", what=f"{address[:80]} is no address of a computer.",
                         remedy="Type its name or its number: stage.local, 192.168.1.20.") from error  # fmt: skip
    side = SPAKE2_A(_password(code), idA=b"velatura house", idB=b"velatura member")
    place = f"[{host}]" if ":" in host else host
    reach = {"endpoints": [f"tcp/{place}:{port}"], "timeout_ms": 2000, "exit_on_failure": True}
    try:
        link = Link({"connect": reach, "listen": {"endpoints": []}}, "tcp")
    except WorkError as error:
        raise WorkError(
            "join-no-answer",
            what=f"No computer that wants to join answers at {host}:{port}.",
            remedy="Check the address, and that the code is still shown there.",
        ) from error
    with link:
        answer = link.ask("join/hello", _Hello(side.start().hex()), _Hello, within_s=_WITHIN_S)
        try:
            ours, theirs = _boxes(side.finish(bytes.fromhex(answer.element)))
            asked = _opened(theirs, bytes.fromhex(answer.sealed), _Asked)
        except (SPAKEError, ValueError) as error:
            raise _wrong() from error
        certificate = authority.admit(asked.request.encode(), asked.name, host)
        sent = _Admitted(certificate.decode(), (authority.folder / AUTHORITY).read_text(), authority.name, endpoints)
        try:
            link.ask("join/admitted", bytes(ours.encrypt(packed(sent))), type(None), within_s=_WITHIN_S)
        except CodedError:
            authority.remove(asked.name)
            raise
    return authority.members[asked.name]


def _password(code: str) -> bytes:
    """What a person types: with or without the hyphen. Raises UsageError("join-code-wrong")."""
    digits = re.sub(r"[\s-]", "", code)
    if not re.fullmatch(rf"[0-9]{{{DIGITS}}}", digits):
        raise _wrong()
    return digits.encode()


def _boxes(key: bytes) -> tuple[SecretBox, SecretBox]:
    """For what the house sends, and for what it gets: a message that is sent back opens with neither."""
    of_house, of_member = (
        SecretBox(blake2b(b"velatura join", key=key, person=side, encoder=RawEncoder)) for side in (b"house", b"member")
    )
    return of_house, of_member


def _opened(box: SecretBox, sealed: bytes, kind: type[T]) -> T:
    try:
        return unpacked(kind, bytes(box.decrypt(sealed)))
    except (CryptoError, ValueError) as error:
        raise _wrong() from error


def _wrong() -> UsageError:
    return UsageError(
        "join-code-wrong",
        what="The code is not the one that the other computer shows.",
        remedy=f"Type its {DIGITS} digits again. After {MOST_EXCHANGES} wrong ones it needs a new code.",
    )


def _refused() -> WorkError:
    return WorkError(
        "join-code-refused",
        what="A wrong code was typed too often.",
        remedy="Ask the computer that joins for a new code.",
    )


def _expired() -> WorkError:
    return WorkError(
        "join-code-expired",
        what="The code is not valid any more.",
        remedy="Ask the computer that joins for a new code.",
    )
