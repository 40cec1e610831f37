"""How tests are spread over workers, with workers that only write down what they are given."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest

from tests.scheduling import (
    LONG,
    LONGEST_FIRST,
    MAKES_THE_DEMO,
    NEEDS_THE_DEMO,
    PARTS,
    SHARES_NOTHING,
    LongestFirst,
    file_of,
    scope_of,
)

SHORT = [f"tests/short/test_{n}.py" for n in range(40)]


class Worker:
    """Runs a test as soon as it knows the next one, or that there is none, as xdist's do."""

    def __init__(self) -> None:
        self.given: list[int] = []
        self.done = 0
        self.shutting_down = False
        self.gateway = SimpleNamespace(id="worker")

    def send_runtest_some(self, tests: list[int]) -> None:
        self.given += tests

    def shutdown(self) -> None:
        self.shutting_down = True

    @property
    def can_run(self) -> bool:
        return len(self.given) - self.done > (0 if self.shutting_down else 1)


def scheduled(tests: list[str], workers: int) -> tuple[LongestFirst, list[Worker]]:
    config = SimpleNamespace(
        getvalue=lambda name: ["popen"] * workers, option=SimpleNamespace(loadscopereorder=False), rootpath=None
    )
    scheduling = LongestFirst(cast(pytest.Config, config))
    made = [Worker() for _ in range(workers)]
    for worker in made:
        scheduling.add_node(cast(Any, worker))
        scheduling.add_node_collection(cast(Any, worker), tests)
    scheduling.schedule()
    return scheduling, made


def finish_one(scheduling: LongestFirst, worker: Worker) -> int:
    test = worker.given[worker.done]
    worker.done += 1
    scheduling.mark_test_complete(cast(Any, worker), test)
    return test


def all_tests(of_a_file: int = 3) -> list[str]:
    return [f"{file}::test_{n}" for file in (*SHORT, *sorted(LONG)) for n in range(of_a_file)]


@pytest.mark.parametrize("of_a_file", [1, 2, 5])
@pytest.mark.parametrize("workers", [1, 3, 5])
def test_every_test_runs_once_and_what_shares_something_on_one_worker(workers: int, of_a_file: int) -> None:
    tests = all_tests(of_a_file)
    scheduling, made = scheduled(tests, workers)
    while any(worker.can_run for worker in made):
        for worker in made:
            if worker.can_run:
                finish_one(scheduling, worker)
    assert sorted(test for worker in made for test in worker.given) == list(range(len(tests)))
    assert all(worker.done == len(worker.given) for worker in made)
    scopes = [{scope_of(tests[test]) for test in worker.given} for worker in made]
    assert sum(map(len, scopes)) == len(SHORT) + len(LONG) + len(SHARES_NOTHING) * (of_a_file - 1)


def test_what_needs_the_demo_waits_until_it_is_made_and_comes_soon_then() -> None:
    tests = all_tests()
    scheduling, made = scheduled(tests, 2)
    maker, other = sorted(made, key=lambda worker: not tests[worker.given[0]].startswith(MAKES_THE_DEMO))
    assert tests[maker.given[0]].startswith(MAKES_THE_DEMO)
    for _ in range(60):
        finish_one(scheduling, other)
    assert not any(tests[test].startswith(NEEDS_THE_DEMO) for test in other.given)
    finish_one(scheduling, maker)
    before = len(other.given)
    for _ in range(9):
        finish_one(scheduling, other)
    assert any(tests[test].startswith(NEEDS_THE_DEMO[0]) for test in other.given[before:])


def test_without_the_demos_own_tests_nothing_waits_for_them() -> None:
    _, (worker,) = scheduled([f"{file}::test" for file in (*SHORT, *NEEDS_THE_DEMO)], 1)
    assert worker.given[0] == len(SHORT)


def test_a_worker_gets_a_short_file_while_it_is_busy_with_a_long_one() -> None:
    tests = all_tests(1)
    _, made = scheduled(tests, 3)
    for worker, first in zip(made, LONGEST_FIRST, strict=False):
        assert [tests[test].split("::")[0] for test in worker.given] == [first, worker_file(tests, worker)]
        assert worker_file(tests, worker) in SHORT


def worker_file(tests: list[str], worker: Worker) -> str:
    return tests[worker.given[-1]].split("::")[0]


@pytest.mark.parametrize(
    ("one", "other", "together"),
    [
        ("tests/booted/test_bare.py::test_a[bookworm]", "tests/booted/test_work.py::test_b[bookworm-a]", True),
        ("tests/booted/test_bare.py::test_a[bookworm]", "tests/booted/test_bare.py::test_a[trixie]", False),
        ("tests/real_kernel/test_on_kernel.py::test_a", "tests/real_kernel/test_on_kernel.py::test_b", True),
        ("tests/real_kernel/test_on_kernel.py::test_keys_a", "tests/real_kernel/test_on_kernel.py::test_b", False),
        (f"{SHARES_NOTHING[0]}::test_a", f"{SHARES_NOTHING[0]}::test_b", False),
    ],
)
def test_two_machines_are_two_scopes(one: str, other: str, together: bool) -> None:
    assert (scope_of(one) == scope_of(other)) is together
    assert file_of(one).startswith(file_of(scope_of(one)))


def test_a_file_whose_tests_are_spread_makes_nothing_once_for_all_of_them(pytestconfig: pytest.Config) -> None:
    for file in SHARES_NOTHING:
        assert 'scope="module"' not in (pytestconfig.rootpath / file).read_text()


def test_every_part_is_in_its_file(pytestconfig: pytest.Config) -> None:
    for file, parts in PARTS.items():
        text = (pytestconfig.rootpath / file).read_text()
        assert all(part.strip(":[") in text for part in parts)


def test_every_long_file_exists(pytestconfig: pytest.Config) -> None:
    assert [file for file in LONG if not (pytestconfig.rootpath / file).exists()] == []
