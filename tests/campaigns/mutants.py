"""Whether tests notice a changed line: lines of the product are drawn by a seed, changed, and the nearest tests run.

    python -m tests.campaigns.mutants COUNT [SEED] [--again] [--files=N] [--seconds=N]

Works in a copy of the code in ``build/mutants/SEED``, where a session of cosmic-ray keeps every result: started again,
it continues where it stopped, with the tests as they are then. ``--again`` tries the survivors once more. For each
change the N test files that are nearest to it by their imports run, in at most so many seconds of a clock; the first
failure ends it, and counts only if that test holds without the change. Prints the survivors with file and line, apart
from those of ``equivalent_mutants.toml``, for which none is run; the exit code is 1 if there is one.
"""

from __future__ import annotations

import argparse
import ast
import os
import re
import shlex
import shutil
import subprocess
import sys
import time
import tomllib
from collections import defaultdict, deque
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Final

from cosmic_ray.mutating import use_mutation
from cosmic_ray.testing import run_tests
from cosmic_ray.work_db import WorkDB
from cosmic_ray.work_item import MutationSpec, TestOutcome, WorkerOutcome, WorkItem, WorkResult

from tests.campaigns.mutant_draws import PARTS, Draw, operator_of
from tests.scheduling import LONG

ROOT: Final = Path(__file__).parents[2]
EQUIVALENT: Final = Path(__file__).with_name("equivalent_mutants.toml")
BATCHES: Final = (4, 8, 16)
"""Test files of one start of pytest: the nearest alone, so that most changes are noticed within seconds."""
ON_USB_BUS: Final = "tests/plugins/on_usb_bus/"
FAILED: Final = re.compile(r"^(?:FAILED|ERROR) (\S+?\.py.*?)(?: - .*)?$", re.MULTILINE)


class Nearness:
    """Which test files of a tree are near to a module: by imports, its name, and the folder that mirrors its own."""

    def __init__(self, root: Path) -> None:
        self._importers: dict[str, set[str]] = defaultdict(set)
        self._tests: list[str] = []
        paths = [path for part in (*PARTS, "lab", "tests") for path in (root / part).rglob("*.py")]
        names = {path.relative_to(root).as_posix() for path in paths}
        for name in names:
            for module in _imported(root / name):
                for file in (f"{module}.py", f"{module}/__init__.py"):
                    if file in names and file != name:
                        self._importers[file].add(name)
            if Path(name).name.startswith("test_"):
                self._tests.append(name)
                for folder in Path(name).parents:
                    self._importers[(folder / "conftest.py").as_posix()].add(name)

    def tests_of(self, path: str) -> list[str]:
        """Test files, the nearest first; the long ones last."""
        far, queue = {path: 0}, deque([path])
        while queue:
            file = queue.popleft()
            for importer in self._importers[file] - far.keys():
                far[importer] = far[file] + 1
                queue.append(importer)
        folder, name = f"tests/{Path(path).parent.as_posix()}/", f"test_{Path(path).name}"
        for test in self._tests:
            if test.startswith(folder) or Path(test).name == name:  # it may start the module in a process of its own
                far.setdefault(test, 3)

        def key(test: str) -> tuple[object, ...]:
            beside = f"{Path(test).parent.as_posix()}/" == folder
            named = Path(test).name == name
            return test.startswith(LONG), not (beside and named), far[test] - beside - 2 * named, far[test], test

        return sorted(far.keys() & self._tests, key=key)


def _imported(path: Path) -> Iterator[str]:
    """Imported modules and names as paths without an ending, wherever in the file they are imported."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name.replace(".", "/") for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            base = node.module.replace(".", "/")
            yield base
            yield from (f"{base}/{alias.name}" for alias in node.names)


@dataclass(frozen=True, slots=True)
class Result:
    """``state``: killed, survived, equivalent or untried; ``why``: the test that failed, or the reason."""

    place: str
    before: str
    after: str
    state: str
    why: str

    def __str__(self) -> str:
        change = "" if self.state == "killed" else f"\n    - {self.before}\n    + {self.after}"
        return f"{self.state:10} {self.place}  {self.why}{change}"


@dataclass(frozen=True, slots=True)
class Limits:
    """``files``: nearest to a change; ``seconds``: for all their tests; a test that takes a third of these is stuck."""

    files: int = 28
    seconds: float = 600.0


@dataclass
class Trial:
    """Changes in a tree, each with the tests near to it, but ``known``: (path, before, after), for which none runs.

    ``broken``: tests that fail without a change, too.
    """

    tree: Path
    limits: Limits
    known: Collection[tuple[str, ...]] = ()
    broken: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        self._near = Nearness(self.tree)

    def of(self, change: MutationSpec) -> WorkResult:
        left = self._near.tests_of(str(change.module_path))[: self.limits.files]
        path, until_s = self.tree / change.module_path, time.monotonic() + self.limits.seconds
        before = path.read_text(encoding="utf-8")
        with use_mutation(path, operator_of(change.operator_name), change.occurrence) as (_, after):
            pass
        changed = tuple(_changed(before, after or ""))
        if (change.module_path.as_posix(), *changed) in self.known:
            left = []
        sizes, killer, ran = iter(BATCHES), "", 0
        while left and not killer and time.monotonic() < until_s:
            batch, left = left[: (size := next(sizes, BATCHES[-1]))], left[size:]
            killer, done = self._killer(change, batch, until_s)
            ran += len(batch) if done else 0
        outcome = TestOutcome.KILLED if killer else TestOutcome.SURVIVED
        return WorkResult(WorkerOutcome.NORMAL, killer or f"{ran} test files", outcome, "\n".join(changed))

    def _killer(self, change: MutationSpec, tests: list[str], until_s: float) -> tuple[str, bool]:
        """The test that fails with the change and holds without it, or empty; whether all were done in time."""
        while True:
            path = self.tree / change.module_path
            with use_mutation(path, operator_of(change.operator_name), change.occurrence):
                failed, done = self._failed(tests, until_s - time.monotonic())
            if not failed:
                return "", done
            again, _ = self._failed(failed, self.limits.seconds)
            if not again:
                return failed[0], done
            if again[0] in self.broken:
                return "", False
            self.broken.update(again)

    def _failed(self, tests: list[str], seconds: float) -> tuple[list[str], bool]:
        """The first of these tests that fails (its file, if it does not say), and whether they ended in time."""
        options = [f"--timeout={self.limits.seconds / 3}", *(f"--deselect={one}" for one in sorted(self.broken))]
        command = [
            "env", "-C", str(self.tree), f"PYTHONPATH={self.tree}", sys.executable, "-m", "pytest", "-q", "-x",
            "-n", "0", "-m", "not long", "-p", "no:cacheprovider", *options, *map(_runnable, tests),
        ]  # fmt: skip
        outcome, output = run_tests(shlex.join(command), max(1.0, seconds))
        if outcome == TestOutcome.SURVIVED or output == "timeout":
            return [], output != "timeout"
        if found := FAILED.findall(output):
            return found[:1], True
        return ([], True) if re.search(r"no tests ran|^\d+ deselected", output, re.MULTILINE) else (tests, True)


def _runnable(test: str) -> str:
    """A file under the preload library of a USB bus is run by a test of its own."""
    if not test.startswith(ON_USB_BUS):
        return test
    return f"tests/plugins/test_on_usb_bus.py::test_under_the_preload_library[{test.removeprefix(ON_USB_BUS)}]"


def _changed(before: str, after: str) -> Iterator[str]:
    """The first line that differs, before and after, without their indentation."""
    for old, new in zip(before.splitlines(), after.splitlines(), strict=False):
        if old != new:
            yield from (old.strip(), new.strip())
            return


class Campaign:
    """A session in a folder: so many changes of a seed, and their results.

    Args:
        root: The code; its product is copied once for a session, its tests at every start.
        folder: Of the session; made if it is missing.
        equivalent: TOML with ``[[mutant]]``: path, before, after, reason.
    """

    def __init__(self, root: Path, folder: Path, seed: str, equivalent: Path = EQUIVALENT) -> None:
        self.tree, self._seed = folder / "tree", seed
        folder.mkdir(parents=True, exist_ok=True)
        _copy(root, self.tree)
        self._session = WorkDB(folder / "session.sqlite", WorkDB.Mode.create)
        known = tomllib.loads(equivalent.read_text(encoding="utf-8")).get("mutant", [])
        self._equivalent = {(one["path"], one["before"], one["after"]): one["reason"] for one in known}

    def run(self, count: int, limits: Limits, again: bool = False) -> Iterator[Result]:
        """Results, old and new, in the order of the draw; ``again``: survivors are tried once more."""
        items = {item.job_id: item for item in self._session.work_items}
        if len(items) < count:
            drawn = islice(Draw(self.tree, self._seed), len(items), count)
            new = [WorkItem.single(f"{n:06}", change) for n, change in enumerate(drawn, len(items))]
            self._session.add_work_items(new)
            items |= {item.job_id: item for item in new}
        done = dict(self._session.results)
        trial = Trial(self.tree, limits, self._equivalent)
        for job in sorted(items)[:count]:
            change, result = items[job].mutations[0], done.get(job)
            if result is None or (again and self._result(change, result).state in ("survived", "untried")):
                result = trial.of(change)
                self._session.set_result(job, result)
            yield self._result(change, result)

    def _result(self, change: MutationSpec, result: WorkResult) -> Result:
        before, _, after = (result.diff or "").partition("\n")
        path = change.module_path.as_posix()
        # One that no test file ended for in time says nothing; --again tries it once more.
        untried = not result.is_killed and (result.output or "").startswith("0 test files")
        state = "killed" if result.is_killed else "untried" if untried else "survived"
        reason = self._equivalent.get((path, before, after))
        if reason is not None and not result.is_killed:
            return Result(f"{path}:{change.start_pos[0]}", before, after, "equivalent", reason)
        return Result(f"{path}:{change.start_pos[0]}", before, after, state, result.output or "")


def _copy(root: Path, tree: Path) -> None:
    """All files that are not ignored; of a tree that has a product this is kept, as it was before any change."""
    have, unchanged = (tree / "complete").exists(), tree.with_name("unchanged")
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=root, capture_output=True, text=True, check=True,
    ).stdout.split("\0")  # fmt: skip
    if have:
        shutil.rmtree(tree / "tests", ignore_errors=True)
    for name in filter(None, listed):
        if (have and name.startswith(tuple(f"{part}/" for part in PARTS))) or not (root / name).is_file():
            continue
        (tree / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(root / name, tree / name)
    source, goal = (unchanged, tree) if have else (tree, unchanged)  # one that was killed has left its last change
    for part in filter(lambda part: (source / part).is_dir(), PARTS):
        shutil.copytree(source / part, goal / part, dirs_exist_ok=True)
    if (root / ".venv").exists() and not (tree / ".venv").exists():
        (tree / ".venv").symlink_to((root / ".venv").resolve())
    (tree / "complete").touch()


def summary(results: Sequence[Result]) -> str:
    """One line, with the share of the changes that a test could notice."""
    of = {state: sum(one.state == state for one in results) for state in ("killed", "survived", "equivalent")}
    judged = of["killed"] + of["survived"]
    share = f"{100 * of['killed'] / judged:.1f} % of {judged} noticed" if judged else "nothing to notice"
    return f"{of['killed']} killed, {of['survived']} survived, {of['equivalent']} equivalent: {share}"


def main(arguments: Sequence[str]) -> int:
    options, usual = argparse.ArgumentParser(), Limits()
    options.add_argument("count", type=int)
    options.add_argument("seed", nargs="?", default="1")
    options.add_argument("--again", action="store_true")
    options.add_argument("--files", type=int, default=usual.files)
    options.add_argument("--seconds", type=float, default=usual.seconds)
    chosen = options.parse_args(arguments)
    os.environ.pop("PYTEST_ADDOPTS", None)
    campaign = Campaign(ROOT, ROOT / "build" / "mutants" / chosen.seed, chosen.seed)
    results = []
    for one in campaign.run(chosen.count, Limits(chosen.files, chosen.seconds), chosen.again):
        results.append(one)
        print(one, flush=True)
    survivors = [one for one in results if one.state == "survived"]
    print("", *survivors, f"seed {chosen.seed}: {summary(results)}", sep="\n")
    return 1 if survivors else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
