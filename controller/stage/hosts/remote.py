"""A player on another computer, as the conductor sees it, and what it and the agent there send each other."""

from __future__ import annotations

import contextlib
import threading
import time
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from controller.core.errors import UsageError, WorkError
from controller.core.storage import sha256_of
from controller.play.control.notify import log
from controller.stage.hosts.screen import Pictures, Setup, State
from controller.stage.link.membership import Authority
from controller.stage.link.session import Link, house_link
from controller.stage.link.transfer import send
from hal.errors import CodedError

NO_UPDATE: Final = "", "", ""
_ROWS_BYTES: Final = 4 << 20
"""Of pixels in one message, before they are packed."""


def key(host: str, word: str) -> str:
    """What is asked or reported under ``word``, of the computer ``host``."""
    return f"member/{host}/{word}"


@dataclass(frozen=True, slots=True)
class Asked:
    """A request to the player of an X screen; ``bundle`` in it is a bundle's name."""

    screen: str
    request: dict[str, Any]
    within_s: float


@dataclass(frozen=True, slots=True)
class Report:
    """The state of a computer twice a second. ``trouble``: of its clock, "" if it has none; ``update``: name, state
    and why of the last one of its program.
    """

    trouble: str
    states: dict[str, State] = field(default_factory=dict)
    update: tuple[str, str, str] = NO_UPDATE


def rows_of(screen: str, output: str, pixels: npt.NDArray[np.uint8]) -> Iterator[bytes]:
    """A picture in messages."""
    height, width, _ = pixels.shape
    step = max(1, _ROWS_BYTES // (3 * width))
    for first in range(0, height, step):
        head = f"{screen}\t{output}\t{width}\t{height}\t{first}\n".encode()
        yield head + zlib.compress(pixels[first : first + step].tobytes(), 1)


def placed_rows(message: bytes, pictures: dict[tuple[str, str], npt.NDArray[np.uint8]]) -> tuple[str, str]:
    """Put rows where they belong; which screen and output these are. Raises ValueError for anything else."""
    head, packed = message.split(b"\n", 1)
    screen, output, *numbers = head.decode().split("\t")
    width, height, first = map(int, numbers)
    if not (0 < width <= 16384 and 0 <= first < height <= 16384):
        raise ValueError("rows outside of a picture")
    rows = np.frombuffer(zlib.decompressobj().decompress(packed, 2 * _ROWS_BYTES), np.uint8).reshape(-1, width, 3)
    picture = pictures.get((screen, output))
    if picture is None or picture.shape != (height, width, 3) or first == 0:
        picture = pictures[screen, output] = np.zeros((height, width, 3), np.uint8)
    picture[first : first + len(rows)] = rows
    return screen, output


SILENT_S: Final = 3.0
_START_S: Final = 25.0
_PART_S: Final = 10.0
_DRIVERS_S: Final = 10.0
"""A driver that hangs is left behind so long after its deadline at most."""
_AGAIN_S: Final = 1.0
_UPDATE_AGAIN_S: Final = 30.0
_LATER: Final = ("link-no-answer", "update-on-trial")


def opened_link(keys: Path | None, port: int) -> Link:
    """The link to the other computers. Raises UsageError("hosts-without-keys")."""
    if keys is None:
        raise UsageError(
            "hosts-without-keys", what="An output is on another computer, but the stage has no keys for a link.",
            remedy="Let that computer join first.",
        )  # fmt: skip
    return house_link(Authority(keys, "players"), port=port)


def lost_host(name: str) -> WorkError:
    """The error where a computer does not answer that is needed now."""
    return WorkError(
        "host-lost", what=f"No answer from the computer {name}.",
        remedy="Check that it is on and its network; the others keep their picture.",
    )  # fmt: skip


class Remote:
    """As ``screen.Player``. It counts as there once it has its setup, until nothing is heard of it for ``SILENT_S``."""

    def __init__(
        self, link: Link, host: str, screen: str, setups: dict[str, Setup], package: Path | None = None
    ) -> None:
        """``setups``: of all screens of that computer; ``package``: where the update for its program is, once there is
        one; None where another screen of it brings that.
        """
        self._link, self.host, self._screen, self._setups = link, host, screen, setups
        self._state, self.trouble = State(), ""
        self._reports: list[tuple[float, float, str | None]] = []
        self._heard_s, self._first = 0.0, threading.Event()
        self._prepared = False
        self._asked_at: float | None = None
        self._busy = threading.Lock()
        self._wanted: Path | None = None
        self._has: str | None = None
        self._share = 0.0
        self._package, self._offered_ns = package, 0
        link.subscribe(key(host, "state"), Report, self._heard)

    # -- what is heard

    def _heard(self, report: Report) -> None:
        fresh = time.monotonic() - self._heard_s > SILENT_S
        self._heard_s = time.monotonic()
        self._first.set()
        there, update, why = report.update
        self.trouble = report.trouble or (f"Its update was taken back: {why}" if update == "failed" else "")
        self._look_for_update(there)
        self._state = report.states.get(self._screen, State())
        self._reports += self._state.reports
        if (fresh or not report.states) and not self._busy.locked():
            self._prepared = False
            threading.Thread(target=self._prepare, daemon=True).start()

    def _prepare(self) -> None:
        with self._busy, contextlib.suppress(CodedError):
            self._link.ask(key(self.host, "prepare"), self._setups, type(None), within_s=_START_S)
            self._asked_at, self._has = None, None
            self._prepared = True
            log(f"The computer {self.host} is here.")

    def _look_for_update(self, there: str) -> None:
        """Bring an update there that has come since the last look, in a thread. ``there``: the last one it has got."""
        with contextlib.suppress(OSError):
            changed_ns = self._package.stat().st_mtime_ns if self._package is not None else 0
            if changed_ns != self._offered_ns:
                self._offered_ns = changed_ns
                threading.Thread(target=self._bring_update, args=(self._package, there), daemon=True).start()

    def _bring_update(self, package: Path, there: str) -> None:
        with contextlib.suppress(OSError):
            changed_ns = self._offered_ns
            if sha256_of(package) == there:
                return
            while changed_ns == self._offered_ns:
                try:
                    name = send(self._link, key(self.host, "program/package"), package)
                    self._link.ask(key(self.host, "program/update"), name, type(None))
                    log(f"The computer {self.host} has the update.")
                    return
                except CodedError as error:
                    if error.code not in _LATER:
                        log(f"The computer {self.host} does not take the update. {error.what}")
                        return
                time.sleep(_UPDATE_AGAIN_S)

    @property
    def setup(self) -> Setup:
        return self._setups[self._screen]

    @property
    def state(self) -> State:
        """Nothing is known of one that is lost."""
        return self._state if self.there else State()

    @property
    def there(self) -> bool:
        return self._prepared and time.monotonic() - self._heard_s < SILENT_S

    def look(self) -> list[tuple[float, float, str | None]]:
        """New reports."""
        reports, self._reports = self._reports, []
        return reports

    def needs(self, request: Mapping[str, Any]) -> bool:
        """Whether it has come after this was agreed on, and can be asked for it now."""
        return self.there and self._asked_at != request["at"] and self._has_its_bundle(request)

    def _has_its_bundle(self, request: Mapping[str, Any]) -> bool:
        """Another bundle may be loaded since the request was agreed on."""
        return "bundle" not in request or (not self.behind and request["bundle"] == str(self._wanted))

    # -- what is sent

    def ask(self, request: Mapping[str, Any], *, within_s: float) -> dict[str, Any]:
        if not self._has_its_bundle(request):
            raise WorkError("hosts-behind", what=f"{self.progress} of the bundle.", remedy="Wait until it is there.")
        request = {**request, **({"bundle": self._has} if "bundle" in request else {})}
        self._asked_at = request.get("at", self._asked_at)
        try:
            asked = Asked(self._screen, request, within_s)
            return self._link.ask(key(self.host, "ask"), asked, dict, within_s=within_s + 1)
        except CodedError as error:
            if error.code != "superseded":
                self._asked_at = None
            raise

    def call(self, call: Mapping[str, Any]) -> dict[str, Any]:
        """What the agent answers to a call of a device. It is waited for where nothing was ever heard of it."""
        within_s = float(call["within_s"])
        self._first.wait(within_s)
        if time.monotonic() - self._heard_s > SILENT_S:
            raise lost_host(self.host)
        return self._link.ask(key(self.host, "device"), call, dict, within_s=within_s + _DRIVERS_S)

    def end(self) -> None:
        """Its agent and its player stay, and show black."""

    def put(self, pictures: Pictures) -> None:
        for output, pixels in pictures.items():
            for rows in rows_of(self._screen, output, pixels):
                self._link.ask(key(self.host, "rows"), rows, type(None), within_s=_PART_S)

    def bring(self, bundle: Path) -> None:
        """Bring a bundle there, in a thread, however often the link is cut."""
        if self._wanted != bundle:
            self._wanted, self._has = bundle, None
        if self.behind and self.there and not self._busy.locked():
            threading.Thread(target=self._bring, daemon=True).start()

    @property
    def behind(self) -> bool:
        """Whether the newest bundle is not there yet."""
        return self._wanted is not None and self._has is None

    @property
    def progress(self) -> str:
        return f"{self.host} has {self._share:.0%}"

    def _bring(self) -> None:
        with self._busy:
            while self.behind and self.there:
                assert self._wanted is not None
                path = self._wanted

                def wanted(share: float, path: Path = path) -> bool:
                    self._share = share
                    return path == self._wanted

                try:
                    name = send(self._link, key(self.host, "bundle"), path, wanted)
                    if path == self._wanted:
                        self._has = name
                except (CodedError, OSError):
                    time.sleep(_AGAIN_S)
