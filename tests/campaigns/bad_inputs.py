"""About 200 bad inputs, each through the real command line in a process of its own.

    python -m tests.campaigns.bad_inputs 250              (or make campaign NAME=bad_inputs)
    python -m tests.campaigns.bad_inputs 250 stage mesh   (only those whose names begin so)

Each must end within a time limit with exit code 0, 1, 2, 3 or 130; where it fails, with one error of two sentences and
a code; never with a traceback or a crash report. What does otherwise is shown; then the campaign ends with 1.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from tests.campaigns import bad_files, bad_stages
from tests.campaigns.bad_cases import Case

LONGEST_S: Final = 30.0
"""Of one command, on a machine that does much else meanwhile."""
CODES: Final = (0, 1, 2, 3, 130)
MOST: Final = 100_000
ROOT: Final = Path(__file__).parents[2]


def cases() -> list[Case]:
    """All of them, always in the same order."""
    return [*bad_stages.cases(), *bad_files.cases()]


@dataclass(frozen=True, slots=True)
class Outcome:
    """``complaints``: what the case did wrong, empty if it behaved; ``error`` is what it said."""

    name: str
    code: int
    seconds: float
    error: dict[str, str]
    complaints: tuple[str, ...]


class Warm:
    """A process that has imported the program and forks for each command: an import takes longer than most cases."""

    def __enter__(self) -> Warm:
        command = [sys.executable, "-c", _SERVER]
        environment = os.environ | {"PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "default"}
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT, env=environment
        )
        assert self._read() == {"ready": True}
        return self

    def __exit__(self, *_: object) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        assert self._process.stdout is not None
        self._process.stdout.close()

    def run(self, words: Sequence[str], folder: Path) -> tuple[int | None, float, str, str]:
        """The exit code, None where it had to be killed; seconds; what it wrote on stdout and on stderr."""
        out, err = folder / "stdout.txt", folder / "stderr.txt"
        assert self._process.stdin is not None
        order = {"words": list(words), "out": str(out), "err": str(err), "state": str(folder / "state")}
        self._process.stdin.write(json.dumps(order) + "\n")
        self._process.stdin.flush()
        began_s = time.monotonic()
        answer = self._read()
        seconds = time.monotonic() - began_s
        texts = (path.read_text(errors="replace") if path.exists() else "" for path in (out, err))
        return (answer["code"], seconds, *texts)

    def _read(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        answer: dict[str, Any] = json.loads(self._process.stdout.readline())
        return answer


_SERVER: Final = f"""
import gc, json, os, resource, signal, sys, time, traceback
import controller.__main__ as program
import controller.stage.services.calibrate, controller.stage.services.play, controller.stage.services.live
import controller.stage.services.bundle
import controller.stage.services.camera, controller.stage.services.plan, controller.kiosk.api.offline_dispatch
import trimesh, cv2, OpenEXR, plugins.emulated.bench, controller.demo, controller.stage.doctor.examine
import controller.stage.services.compare, controller.panel.server
from tests.campaigns.bad_readers import COMMANDS
program.MEMBERS["For this campaign"] = COMMANDS
program._built()
gc.freeze()
print(json.dumps({{"ready": True}}), flush=True)
for line in sys.stdin:
    order = json.loads(line)
    child = os.fork()
    if not child:
        os.setsid()
        os.environ["XDG_STATE_HOME"] = order["state"]
        for number, name, flags in ((0, os.devnull, os.O_RDONLY), (1, order["out"], os.O_WRONLY | os.O_CREAT),
                                    (2, order["err"], os.O_WRONLY | os.O_CREAT)):
            handle = os.open(name, flags, 0o600)
            os.dup2(handle, number)
        resource.setrlimit(resource.RLIMIT_AS, (6 << 30, 6 << 30))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        code = 99
        try:
            program.main(order["words"])
        except SystemExit as ended:
            code = ended.code
        except BaseException:
            traceback.print_exc()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)  # an end in good order would touch every page that is shared with the parent
    until = time.monotonic() + {LONGEST_S}
    status = None
    while status is None and time.monotonic() < until:
        ended, value = os.waitpid(child, os.WNOHANG)
        if ended:
            status = os.waitstatus_to_exitcode(value)
        else:
            time.sleep(0.005)
    if status is None:
        os.killpg(child, signal.SIGKILL)
        os.waitpid(child, 0)
    print(json.dumps({{"code": status}}), flush=True)
"""


def judged(case: Case, code: int | None, seconds: float, stdout: str, stderr: str, folder: Path) -> Outcome:
    """What is wrong with how the command ended, if anything."""
    wrong = []
    if code is None:
        wrong.append(f"it hung for {LONGEST_S:.0f} s")
    elif code not in CODES:
        wrong.append(f"it ended with {code}")
    elif case.refused and code == 0:
        wrong.append("it was not refused")
    if "Traceback" in stdout + stderr:
        wrong.append(f"a traceback: {stderr[-600:]}")
    reports = sorted(folder.glob("state/velatura/crash-*.txt"))
    if reports:
        wrong.append(f"a crash report: {reports[0].read_text()[-900:]}")
    error = _error(stdout)
    if code not in (0, None) and not wrong and not ('"result"' in stdout and not error):  # doctor lists its findings
        wrong += _misspoken(error, stderr)
    return Outcome(case.name, -1 if code is None else code, seconds, error, tuple(wrong))


def _error(stdout: str) -> dict[str, str]:
    for line in reversed(stdout.splitlines()):
        with contextlib.suppress(ValueError):
            record = json.loads(line)
            if isinstance(record, dict) and "error" in record:
                return dict(record["error"])
    return {}


def _misspoken(error: dict[str, str], stderr: str) -> Iterator[str]:
    if error.keys() != {"code", "what", "remedy"}:
        yield f"no error with a code: {stderr[-300:]}"
        return
    if not re.fullmatch(r"[a-z0-9]+(-[a-z0-9]+)*", error["code"]):
        yield f"its code is {error['code']}"
    for sentence in (error["what"], error["remedy"]):
        if not re.search(r"[.?]$", sentence) or "\n" in sentence:
            yield f"not a sentence: {sentence}"
        if re.search(r"PosixPath|<class|object at 0x|\bNone\b|\bErrno\b", sentence):
            yield f"Python's own words: {sentence}"


def run(most: int = MOST, prefixes: Sequence[str] = (), *, every: int = 1) -> Iterator[Outcome]:
    """Run the cases whose names begin with one of ``prefixes`` (all if there are none); of these each ``every``-th."""
    with tempfile.TemporaryDirectory(prefix="bad-", ignore_cleanup_errors=True) as name, Warm() as warm:
        root = Path(name)
        stage = root / "sound" / "stage"
        code, _, out, err = warm.run(
            ["demo", "--prepare-only", "--out", str(stage.parent), "--json"], _made(root / "x")
        )
        assert code == 0, (out, err)
        chosen = [case for case in cases() if not prefixes or case.name.startswith(tuple(prefixes))]
        for number, case in enumerate(chosen[::every][:most]):
            folder = _made(root / f"case-{number}")
            copy = Path(shutil.copytree(stage, folder / "stage", symlinks=True))
            words = case.prepare(copy, folder)
            ended = warm.run([*words, "--json"], folder)
            yield judged(case, *ended, folder)
            shutil.rmtree(folder, ignore_errors=True)


def _made(folder: Path) -> Path:
    folder.mkdir(parents=True)
    return folder


def main(arguments: Sequence[str]) -> int:
    """The program; see the module."""
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    most = int(arguments[0]) if arguments else MOST
    bad, count = [], 0
    for one in run(most, arguments[1:]):
        count += 1
        print(f"{one.name:<44} {one.code:>3} {one.seconds:6.2f} s  {one.error.get('code', '')}", flush=True)
        for complaint in one.complaints:
            print(f"    {complaint}")
        if one.complaints:
            bad.append(one.name)
    print(f"{count} bad inputs, {len(bad)} not as they should be: {', '.join(bad)}")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
