"""A link between a house and its members: a Zenoh session with TLS, in which each has keys of its own.

Members connect to the house and never to each other; there is no broker, and nothing leaves the local network. Keys:
``member/NAME/...`` is between the house and that member, both ways; ``all/...`` is from the house to everybody. The
house enforces this by the certificates: no member can speak as another, and one that was removed is heard no more.
"""

from __future__ import annotations

import contextlib
import json
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any, Final, TypeVar

import zenoh
from pydantic import TypeAdapter, ValidationError
from pydantic_core import from_json, to_json

from controller.core.errors import SEND_DIAGNOSTICS, WorkError
from controller.stage.link.membership import AUTHORITY, CERTIFICATE, KEY, Authority, Member, Membership
from hal.errors import CodedError

T = TypeVar("T")
PORT: Final = 7447
EVERYWHERE: Final = "[::]" if socket.has_dualstack_ipv6() else "0.0.0.0"  # noqa: S104 - TLS, or a code, guards it
MOST_BYTES: Final = 8 << 20
"""Of one message; what is larger is sent in parts."""
BEAT: Final = "all/beat"
BEAT_S: Final = 0.5
ALONE_S: Final = 4.0
"""A member that has heard no beat of its house for so long connects again."""
CLOSING_S: Final = 2.0
_MOST_HANDLERS: Final = 8
_RETRY: Final = {"period_init_ms": 500, "period_max_ms": 2000, "period_increase_factor": 1.5}
_MESSAGES: Final = (
    "put", "delete", "declare_subscriber", "query", "reply", "declare_queryable", "liveliness_token",
    "liveliness_query", "declare_liveliness_subscriber",
)  # fmt: skip
"""All kinds that Zenoh's access control knows."""


def packed(value: Any) -> bytes:
    """``value`` as sent: bytes as they are, all else (dataclasses, lists, numbers, text, None) as JSON."""
    return value if isinstance(value, bytes) else to_json(value)


def unpacked(kind: type[T], data: bytes) -> T:
    """A value of this type, which may be ``bytes``. Raises WorkError("link-message-wrong")."""
    if kind is bytes:
        return data  # type: ignore[return-value] # mypy does not narrow the type of a type
    try:
        adapter = _adapters.get(kind) or _adapters.setdefault(kind, TypeAdapter(kind))
        value: T = adapter.validate_json(data)
    except ValidationError as error:
        raise WorkError(
            "link-message-wrong",
            what=f"Another computer sent what this one does not understand ({error.error_count()} values).",
            remedy="Install the same version of Velatura on both.",
        ) from error
    return value


_adapters: Final[dict[Any, TypeAdapter[Any]]] = {}
"""By type: to make one takes longer than to read a message."""


class Link:
    """An open session; a context manager. What answers runs in threads of its own.

    A member that can't reach the house tries again for as long as the link is open, and so does not wait for it.
    """

    def __init__(self, config: dict[str, Any], protocol: str = "tls", endpoints: Sequence[str] = ()) -> None:
        """``config``: Zenoh's, beside what all links share; ``endpoints``: of a house, which is tried at one after the
        other. Raises WorkError("link-not-opened").
        """
        shared = {
            "mode": "peer",
            "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
            "adminspace": {"enabled": False},
        }
        link = {"protocols": [protocol], "rx": {"max_message_size": MOST_BYTES}}
        link |= {"tls": config["tls"]} if "tls" in config else {}
        own = {key: value for key, value in config.items() if key != "tls"}
        # No shared memory: the services of a kiosk may not have any, and what passes is to pass by TLS.
        self._config = shared | own | {"transport": {"link": link, "shared_memory": {"enabled": False}}}
        self._endpoints = deque(endpoints)
        self._declarations: list[Callable[[], object]] = []
        self._declared: list[object] = []
        """What Zenoh would take back once nothing holds it."""
        self._answering: set[Future[None]] = set()
        self._handlers = ThreadPoolExecutor(_MOST_HANDLERS, thread_name_prefix="link")
        self._opening, self._ended = threading.Lock(), threading.Event()
        self._session = self._opened()
        self._heard_s = time.monotonic()
        if endpoints:
            self.subscribe(BEAT, bytes, lambda _: self._hear())
        beats = self._follow if endpoints else self._beat if "access_control" in config else None
        if beats is not None:
            threading.Thread(target=beats, name="link", daemon=True).start()

    def _opened(self) -> zenoh.Session:
        config = self._config
        if self._endpoints:
            # At one only: a second connection to the same house would be refused, and tried again for ever.
            config = config | {"connect": config["connect"] | {"endpoints": [self._endpoints[0]]}}
        try:
            return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
        except zenoh.ZError as error:
            raise WorkError(
                "link-not-opened",
                what=f"The link to other computers could not be opened: {str(error)[:200]}",
                remedy="Check that no other program uses its port, and start again.",
            ) from error

    def _beat(self) -> None:
        while not self._ended.wait(BEAT_S):
            self.publish(BEAT, b"", urgent=True)

    def _hear(self) -> None:
        self._heard_s = time.monotonic()

    def _follow(self) -> None:
        """Open the session again where the house has said nothing for a while. A house that restarts while a connection
        is being made can leave one behind that Zenoh takes for alive.
        """
        while not self._ended.wait(BEAT_S):
            if time.monotonic() - self._heard_s < ALONE_S:
                continue
            with self._opening, contextlib.suppress(WorkError):
                if not self._ended.is_set():
                    self._session.close()  # type: ignore[no-untyped-call] # of the extension
                    self._endpoints.rotate(-1)
                    self._session = self._opened()
                    self._declared = [declare() for declare in self._declarations]
            self._hear()

    def _declare(self, declare: Callable[[], object]) -> None:
        with self._opening:
            self._declarations.append(declare)
            self._declared.append(declare())

    def __enter__(self) -> Link:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """What is being answered is answered, if that is soon."""
        wait(tuple(self._answering), CLOSING_S)
        self._ended.set()
        with self._opening:
            self._session.close()  # type: ignore[no-untyped-call] # of the extension
        self._handlers.shutdown(wait=False, cancel_futures=True)

    def publish(self, key: str, value: Any, *, urgent: bool = False) -> None:
        """Send to all who subscribed, unless it is closed; never waits for the network. ``urgent``: before all else."""
        priority = zenoh.Priority.REAL_TIME if urgent else zenoh.Priority.DATA
        # It may be closed, or be opened again just now.
        with contextlib.suppress(zenoh.ZError):
            self._session.put(key, packed(value), priority=priority, express=urgent,
                              congestion_control=zenoh.CongestionControl.DROP)  # fmt: skip

    def subscribe(self, key: str, kind: type[T], heard: Callable[[T], object]) -> None:
        """Call ``heard`` for each value, in order, in Zenoh's thread: it must return at once. What is not of this
        type is ignored.
        """

        def sample(one: zenoh.Sample) -> None:
            with contextlib.suppress(WorkError):
                heard(unpacked(kind, one.payload.to_bytes()))

        self._declare(lambda: self._session.declare_subscriber(key, sample))

    def answer(self, key: str, kind: type[T], answers: Callable[[T], Any]) -> None:
        """Answer questions of this type; a ``CodedError`` that ``answers`` raises is raised where it was asked."""

        def asked(query: zenoh.Query) -> None:
            answering = self._handlers.submit(_answered, query, kind, answers)
            self._answering.add(answering)
            answering.add_done_callback(self._answering.discard)

        self._declare(lambda: self._session.declare_queryable(key, asked))

    def ask(self, key: str, question: Any, kind: type[T], *, within_s: float = 10.0) -> T:
        """Ask, and wait for the answer. Raises WorkError("link-no-answer", "link-message-wrong") and what the other
        side raised, with its code.
        """
        for reply in (
            () if self._session.is_closed() else self._session.get(key, payload=packed(question), timeout=within_s)
        ):
            if reply.ok is not None:
                return unpacked(kind, reply.ok.payload.to_bytes())
            assert reply.err is not None
            with contextlib.suppress(ValueError, KeyError, TypeError):
                said = from_json(reply.err.payload.to_bytes())
                raise WorkError(str(said["code"]), what=str(said["what"]), remedy=str(said["remedy"]))
        raise WorkError(
            "link-no-answer",
            what="The other computer does not answer.",
            remedy="Check that it is switched on, and the network between both.",
        )

    def appear(self, key: str) -> None:
        """Others see by ``watch`` that this session is there, until it ends or is cut off."""
        self._declare(lambda: self._session.liveliness().declare_token(key))

    def watch(self, key: str, heard: Callable[[bool], object]) -> None:
        """Call ``heard`` with True when ``key`` appears, now or later, and False when it is gone."""

        def sample(one: zenoh.Sample) -> None:
            heard(one.kind == zenoh.SampleKind.PUT)

        self._declare(lambda: self._session.liveliness().declare_subscriber(key, sample, history=True))


def _answered(query: zenoh.Query, kind: type[T], answers: Callable[[T], Any]) -> None:
    with query:
        try:
            sent = query.payload.to_bytes() if query.payload is not None else b""
            data = packed(answers(unpacked(kind, sent)))
        except CodedError as error:
            query.reply_err(to_json({"code": error.code, "what": error.what, "remedy": error.remedy}))
        except Exception as error:  # noqa: BLE001 - the last boundary of this thread: it answers and continues
            what = f"The other computer met an unexpected error ({type(error).__name__})."
            query.reply_err(to_json({"code": "crash", "what": what, "remedy": SEND_DIAGNOSTICS}))
        else:
            query.reply(query.key_expr, data)


def _files(folder: Path, side: str) -> dict[str, Any]:
    return {
        "root_ca_certificate": str(folder / AUTHORITY),
        "enable_mtls": True,
        "verify_name_on_connect": False,
        f"{side}_certificate": str(folder / CERTIFICATE),
        f"{side}_private_key": str(folder / KEY),
    }


def house_link(authority: Authority, *, host: str = EVERYWHERE, port: int = PORT) -> Link:
    """The house's side. Open it again when members were added or removed: it is for those of now.

    Raises WorkError("link-not-opened").
    """
    return Link({
        "listen": {"endpoints": [f"tls/{host}:{port}"], "exit_on_failure": True},
        "tls": _files(authority.folder, "listen"),
        "access_control": _rules(authority.members.values()),
    })  # fmt: skip


def member_link(membership: Membership) -> Link:
    """A member's side. Raises WorkError("link-not-opened")."""
    config = {
        "connect": {"timeout_ms": -1, "exit_on_failure": False, "retry": _RETRY},
        "listen": {"endpoints": []},
        "tls": _files(membership.folder, "connect"),
    }
    return Link(config, endpoints=membership.endpoints)


def _rules(members: Iterable[Member]) -> dict[str, Any]:
    """Zenoh's access control: nothing but what the module says."""
    every = list(members)

    def rule(name: str, messages: Sequence[str], flows: Sequence[str], key: str) -> dict[str, Any]:
        return {"id": name, "permission": "allow", "messages": messages, "flows": flows, "key_exprs": [key]}

    rules = [
        rule("all heard", ["declare_subscriber"], ["ingress"], "all/**"),
        rule("all said", ["put", "delete"], ["egress"], "all/**"),
        *(rule(one.certified, _MESSAGES, ["ingress", "egress"], f"member/{one.name}/**") for one in every),
    ]
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [{"id": one.certified, "cert_common_names": [one.certified]} for one in every],
        "policies": [{"rules": ["all heard", "all said", one.certified], "subjects": [one.certified]} for one in every],
    }
