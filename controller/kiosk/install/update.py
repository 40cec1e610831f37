"""Another version of the program in the place of this one, and back: two folders that change places in one step.

An update is a Debian package of Velatura with a signature behind it. The service `velatura-update` (root) unpacks it
beside the program, exchanges both, and starts the kiosk again. Then the former version, from where it lies now, judges
the new one: until a drift check or a calibration was as good as before it, or a day is over. So a power cut leaves one
of the two, whole, and a version that does not even start is taken back.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import itertools
import json
import os
import re
import shutil
import tempfile
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Final

from nacl.signing import SigningKey

from controller.bundle.signing import BLOCK_BYTES, check_signature, load_public_key, sign
from controller.core.errors import BundleError, UsageError, VelaturaError, WorkError
from controller.core.kiosk_places import PLAYERS, RUNTIME, STATE
from controller.core.storage import stream_atomically, sync_folder, write_atomically
from controller.kiosk.install.steps import SHIPPED_PREFIX, TRUSTED, only_plays
from controller.kiosk.install.system import System

if TYPE_CHECKING:  # Zenoh is an extra
    from controller.stage.link.session import Link

PROGRAM: Final = Path(SHIPPED_PREFIX)
OTHER: Final = PROGRAM.with_suffix(".other")
"""The version that comes, and the former one while the new one is judged."""
TRIAL: Final = PROGRAM.with_suffix(".trial")
"""While a version may be judged: its mark. `velatura-update.service` compares it with that of the program."""
PACKAGE: Final = PROGRAM.with_suffix(".package")
"""There as long as the version is wanted: it is removed before the former one comes back."""
STARTS: Final = PROGRAM.with_suffix(".starts")
RESULT: Final = PROGRAM.with_suffix(".update")
MARK: Final = ".update"
"""In a program's folder: which update it is."""
CHANGELOG: Final = "changelog"
"""In a package, beside its control file: `dpkg-deb` reads it there without unpacking the rest."""
OFFERED: Final = STATE / "update.deb"
PLAYS: Final = RUNTIME / "plays"
"""Of a computer that only plays: what its agent reported last."""
START_S: Final = 600.0
"""So long a new version may need until it is as well as the former one was. It may compile its kernels first."""
WITHIN_S: Final = 26 * 3600.0
_LOOK_S, _WELL_S = 5.0, 60.0
_OLD_S: Final = 10.0
_MOST_STARTS: Final = 3
_EXCHANGE: Final = 2
_SIGNED: Final = b"velatura update 1\0"
_TAIL: Final = b"%-16s%-12d%-6d%-6d%-8s%-10d`\n" % (b"_velatura", 0, 0, 0, b"100644", BLOCK_BYTES)
"""Of a member of an `ar` archive, whose name makes `dpkg` skip it."""
_ADVICE: Final = ("nothing", "quick", "full", "look")
_PLAYS: Final = ("playing", "degraded")
_CLOSED: Final = ("off", "cooling")


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of the last update. ``name``: SHA-256 of the package; ``state``: "trial", "done", or "failed", when
    the former version plays; ``before``: what the kiosk reported then.
    """

    name: str = ""
    state: str = ""
    why: str = ""
    began_unix_s: float = 0.0
    before: dict[str, Any] = field(default_factory=dict)


def outcome(system: System) -> Outcome:
    """Of this computer, for everybody to read."""
    try:
        return Outcome(**json.loads(system.read(RESULT) or "{}"))
    except (ValueError, TypeError):
        return Outcome()


def sign_package(package: Path, key: SigningKey, to: Path) -> None:
    """Write a Debian package with a signature behind it, which `dpkg` skips. Raises WorkError, OSError."""
    digest = hashlib.sha256()

    def write(copy: BinaryIO) -> None:
        with package.open("rb") as file:
            size, _ = _end_of_content(file)
            for part in itertools.chain(_content(file, size), [b"\n" * (size % 2)]):
                digest.update(part)
                copy.write(part)
        copy.write(_TAIL + sign(_SIGNED, digest.digest(), key))

    stream_atomically(to, write)


def check_package(package: Path, trusted: Path) -> None:
    """Raises UsageError("update-not-trusted") unless a key in the folder ``trusted`` has signed it."""
    try:
        with package.open("rb") as file:
            size, block = _end_of_content(file)
            digest = hashlib.sha256()
            for part in _content(file, size):
                digest.update(part)
        keys = [load_public_key(path) for path in sorted(trusted.glob("*.pub"))]
        if block and keys:
            check_signature(_SIGNED, digest.digest(), block, trusted=keys, allow_unsigned=False)
            return
    except (OSError, BundleError):
        pass
    raise UsageError(
        "update-not-trusted", what="No key that this computer trusts has signed the update.",
        remedy="Sign it with `velatura kiosk update FILE --sign KEY`. `velatura kiosk install --trust KEY.pub` trusts "
        "a key.",
    )  # fmt: skip


def _end_of_content(file: BinaryIO) -> tuple[int, bytes]:
    """The bytes of a package without a signature behind it, and that signature; empty where it has none."""
    size = file.seek(0, os.SEEK_END)
    end = file.seek(max(0, size - len(_TAIL) - BLOCK_BYTES))
    tail, block = file.read(len(_TAIL)), file.read()
    return (end, block) if tail == _TAIL else (size, b"")


def _content(file: BinaryIO, size: int) -> Iterator[bytes]:
    file.seek(0)
    while size and (part := file.read(min(size, 1 << 20))):
        size -= len(part)
        yield part


def needs(system: System, package: Path) -> list[str]:
    """The Debian packages that are to be installed for it, as apt says.

    Raises UsageError("update-needs-packages") where this computer can't have them.
    """
    depends = (system.look("dpkg-deb", "--field", str(package), "Depends") or "").strip()
    said = system.look("apt-get", "--simulate", "satisfy", depends) if depends else ""
    if said is None:
        raise UsageError(
            "update-needs-packages", what=f"The update needs what this computer can't have: {depends[:300]}.",
            remedy="Take the package for this release of Debian, or let apt-get reach its servers.",
        )  # fmt: skip
    return sorted(re.findall(r"^Inst (\S+)", said, re.MULTILINE))


def changelog(system: System, package: Path) -> str:
    """That of a package (Markdown, a heading for each version); empty without one."""
    return system.look("dpkg-deb", "--info", str(package), CHANGELOG) or ""


def news(text: str, versions: Collection[str]) -> list[str]:
    """The entries of a changelog that are newer than the oldest of ``versions``; a sentence if it doesn't have one."""
    releases = re.split(r"^## ", text, flags=re.MULTILINE)[1:]
    names = [release.split(maxsplit=1)[0] for release in releases]
    if unknown := sorted(set(versions) - set(names)):
        return [f"The package does not say what has changed since version {', '.join(unknown)}."]
    newer = "".join(releases[: max(map(names.index, versions), default=0)])
    entries = re.findall(r"^- (.*(?:\n +\S.*)*)", newer, re.MULTILINE)
    return [" ".join(entry.split()) for entry in entries] or ["The changelog of the package has nothing newer."]


def changes(system: System, package: Path) -> dict[str, Any]:
    """What an update would change here: ``version``, the ``news`` in it, what it ``needs``, and the files of the
    program that are ``new``, ``changed`` and ``gone``. Raises WorkError("kiosk-step-failed"), and as ``needs``.
    """
    with tempfile.TemporaryDirectory(dir="/var/tmp") as folder:  # /tmp may be memory
        system.run("dpkg-deb", "--extract", str(package), folder)
        theirs, ours = (_files(root) for root in (Path(folder, *PROGRAM.parts[1:]), system.at(PROGRAM)))
    return {
        "version": (system.look("dpkg-deb", "--field", str(package), "Version") or "").strip(),
        "news": news(changelog(system, package), [metadata.version("velatura")]),
        "needs": needs(system, package),
        "new": sorted(theirs.keys() - ours.keys()),
        "changed": sorted(name for name in theirs.keys() & ours.keys() if theirs[name] != ours[name]),
        "gone": sorted(ours.keys() - theirs.keys() - {MARK}),
    }


def _files(root: Path) -> dict[str, bytes]:
    """Without byte code, which follows from the rest."""
    return {
        str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).digest()
        for path in root.rglob("*")
        if path.is_file() and not path.is_symlink() and path.suffix != ".pyc"
    }


class Packages:
    """The updates that the other side of a link offers to this computer, below ``key``."""

    def __init__(self, system: System, link: Link, key: str) -> None:
        from controller.stage.link.transfer import Arrivals

        self._system = system
        self._arrivals = Arrivals(system.at(STATE / "updates"), lambda file: check_package(file, system.at(TRUSTED)))
        self._arrivals.listen(link, f"{key}/package")
        link.answer(f"{key}/update", str, self._offer)

    def _offer(self, name: str) -> None:
        """Give what has come to this computer's own service, which checks it again."""
        if outcome(self._system).state == "trial":
            raise WorkError("update-on-trial", what="An update is on trial.", remedy="Wait until it has ended.")
        self._arrivals.path(name).replace(self._system.at(OFFERED))

    def plays(self, state: str) -> tuple[str, str, str]:
        """Note the state of a computer that only plays, for the service. Returns name, state and why of its update."""
        with contextlib.suppress(VelaturaError):
            write_atomically(self._system.at(PLAYS), state.encode())
        told = outcome(self._system)
        return told.name, told.state, told.why


def status_of_player(system: System) -> Mapping[str, Any] | None:
    """What ``Updates`` asks for, of a computer that only plays; None while its agent does not run."""
    file = system.at(PLAYS)
    if not file.exists() or time.time() - file.stat().st_mtime > _OLD_S:
        return None
    return {"state": file.read_text()}


class Updates:
    """The service; ``run`` it as root. ``status``: what the kiosk reports now; None, or a VelaturaError, if it does not
    answer.
    """

    def __init__(
        self, system: System, *, status: Callable[[], Mapping[str, Any] | None],
        wait: Callable[[float], None] = time.sleep, now: Callable[[], float] = time.time,
    ) -> None:  # fmt: skip
        self._system, self._ask, self._wait, self._now = system, status, wait, now
        self._program, self._other, self._trial, self._package = map(system.at, (PROGRAM, OTHER, TRIAL, PACKAGE))

    def run(self) -> None:
        """Exchange both for what is offered, or judge what is on trial, or finish what a power cut interrupted.

        A process does one of these: what it has not loaded yet is of another version afterwards. While anything is
        left, `velatura-update.path` starts the next one.
        """
        if not self._wanted():
            return
        name = self._name()
        if not self._installed(name):
            self._install(name)
            return
        if self._trial.exists() and (why := self._judged()):
            self._end(name, "failed", why)
        else:
            self._trial.unlink(missing_ok=True)
            sync_folder(self._trial.parent)  # else a power cut could bring it back, without the package
            self._give_to_players()
            self._end(name, "done", "")
        self._go_back()

    def _give_to_players(self) -> None:
        """Let the conductor bring what has proved itself to the other computers of the stage."""
        players = self._system.at(PLAYERS)
        if players.is_dir():
            with contextlib.suppress(VelaturaError, OSError), self._package.open("rb") as source:
                copy = players / OFFERED.name
                stream_atomically(copy, lambda file: shutil.copyfileobj(source, file, 1 << 20), mode=0o644)

    def _status(self) -> Mapping[str, Any] | None:
        with contextlib.suppress(VelaturaError):
            return self._ask()
        return None

    def _wanted(self) -> bool:
        """Whether there is an update to carry out. One that is offered is copied before it is checked."""
        self._go_back()
        offered = self._system.at(OFFERED)
        if self._package.exists() or not offered.exists():
            return self._package.exists()
        copy = self._package.with_name(f".{self._package.name}.new")
        try:
            with os.fdopen(os.open(offered, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK), "rb") as source:
                stream_atomically(copy, lambda file: shutil.copyfileobj(source, file, 1 << 20), mode=0o600)
            check_package(copy, self._system.at(TRUSTED))
            needs(self._system, copy)
            copy.rename(self._package)
            sync_folder(self._package.parent)
        except (VelaturaError, OSError) as error:
            copy.unlink(missing_ok=True)
            self._tell(Outcome("", "failed", error.what if isinstance(error, VelaturaError) else str(error)))
        offered.unlink()
        return self._package.exists()

    def _name(self) -> str:
        with self._package.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()

    def _installed(self, name: str) -> bool:
        return self._system.read(PROGRAM / MARK) == name

    def _install(self, name: str) -> None:
        """Unpack it, and exchange both."""
        unpacked = self._other.with_name(f"{self._other.name}.new")
        try:
            for folder in (unpacked, self._other):
                shutil.rmtree(folder, ignore_errors=True)
            self._system.run("dpkg-deb", "--extract", str(self._package), str(unpacked))
            unpacked.joinpath(*PROGRAM.parts[1:]).rename(self._other)
            shutil.rmtree(unpacked)
            write_atomically(self._other / MARK, name.encode())
            now = self._status() or {}
            before = {key: now[key] for key in ("state", "drifts", "grades") if key in now}
            self._tell(Outcome(name, "trial", "", self._now(), before))
            write_atomically(self._system.at(STARTS), b"0")
            os.sync()
            write_atomically(self._trial, name.encode())
            self._exchange()
        except (VelaturaError, OSError) as error:
            self._end(name, "failed", error.what if isinstance(error, VelaturaError) else str(error))
            self._trial.unlink(missing_ok=True)

    def _exchange(self) -> None:
        """Raises OSError; then nothing has changed."""
        here = -100  # no folder: both paths are whole
        places = os.fsencode(self._program), os.fsencode(self._other)
        if ctypes.CDLL(None, use_errno=True).renameat2(here, places[0], here, places[1], _EXCHANGE):
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
        sync_folder(self._program.parent)

    def _begin(self) -> None:
        """Start the version that is there now, with its own units."""
        as_player = ("--player",) if only_plays(self._system) else ()
        self._system.run(str(PROGRAM / "bin" / "velatura"), "kiosk", "install", *as_player, "--restart")

    def _judged(self) -> str:
        """Wait until the new version has proved itself; why not, "" if it has."""
        starts = int(self._system.read(STARTS) or 0)
        write_atomically(self._system.at(STARTS), b"%d" % (starts + 1))
        if starts >= _MOST_STARTS:
            return f"The computer started {starts} times, and the kiosk was never well."
        told = outcome(self._system)
        try:
            self._begin()
        except VelaturaError as error:
            return error.what
        plays, waited_s = told.before.get("state") not in _PLAYS, 0.0
        while waited_s < START_S:
            now = self._status()
            plays = plays or (now is not None and now["state"] in _PLAYS)
            ill = _illness(now, told.before, plays)
            if now is not None and not ill:
                waited_s = 0.0
                if starts >= 0:
                    write_atomically(self._system.at(STARTS), b"0")
                    starts = -1
                if (verdict := _verdict(now, told.before)) is not None:
                    return verdict
                if not 0 <= self._now() - told.began_unix_s < WITHIN_S:
                    return "" if plays else "The kiosk has not played since."
            self._wait(_LOOK_S if ill else _WELL_S)
            waited_s += _LOOK_S
        return ill

    def _end(self, name: str, state: str, why: str) -> None:
        told = outcome(self._system)
        self._tell(Outcome(name, state, why, told.began_unix_s, told.before))
        self._package.unlink(missing_ok=True)
        sync_folder(self._package.parent)

    def _go_back(self) -> None:
        """Bring the former version back, if that was decided."""
        if self._package.exists() or not self._trial.exists():
            return
        if self._installed(self._trial.read_text()):
            self._exchange()
        with contextlib.suppress(VelaturaError):
            self._begin()
        self._trial.unlink()

    def _tell(self, told: Outcome) -> None:
        write_atomically(self._system.at(RESULT), json.dumps(asdict(told)).encode())


def _illness(now: Mapping[str, Any] | None, before: Mapping[str, Any], plays: bool) -> str:
    """What is worse than before the update, "" if nothing. ``plays``: it has played since, or did not before."""
    if now is None:
        return "The kiosk does not answer."
    state = now["state"]
    if state == "fault" != before.get("state"):
        return "The kiosk is in fault."
    return "" if plays or state in _CLOSED else f"The kiosk played before, and is in the state {state} now."


def _verdict(now: Mapping[str, Any], before: Mapping[str, Any]) -> str | None:
    """Why the next check is worse than the last one of the former version, "" if it is not; None until there is one."""
    for what, rows, word, ranks in (
        ("drift check", "drifts", "advice", _ADVICE), ("grade", "grades", "grade", tuple("ABCDEF")),
    ):  # fmt: skip
        new, old = _newest(now, rows), _newest(before, rows)
        if new and new["run"] != old.get("run"):
            said, former = new[word], old.get(word, new[word])
            known = said in ranks and former in ranks
            worse = known and ranks.index(said) > max(1, ranks.index(former))
            return f"The next {what} was worse: {said} instead of {former}." if worse else ""
    return None


def _newest(report: Mapping[str, Any], rows: str) -> Mapping[str, Any]:
    """Empty without one."""
    return next(iter(report.get(rows) or ()), {})
