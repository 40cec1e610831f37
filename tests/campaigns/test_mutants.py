"""The campaign of changed lines finds what a test misses, and continues where it stopped."""

from __future__ import annotations

import subprocess
from collections import Counter
from itertools import islice
from pathlib import Path

import pytest
from cosmic_ray.mutating import mutate_code

from tests.campaigns.mutant_draws import Draw, RemoveOperand, RemoveStatement
from tests.campaigns.mutants import Campaign, Limits, Nearness, Result, summary

WATCHED = "def larger(a: int | None, b: int) -> bool:\n    return a > b\n\n\nsame = dict(strict=True)\n"
TESTED = (
    "from hal.watched import larger\n\n\n"
    "def test_larger() -> None:\n    assert larger(2, 1)\n    assert not larger(1, 1)\n"
)
EMPTY = "import hal.unwatched\n\n\ndef test_nothing() -> None:\n    pass\n"
SETTINGS = '[pytest]\npythonpath = .\naddopts = --import-mode=importlib\nmarkers = long\n'  # fmt: skip


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    root = tmp_path / "code"
    for name, text in (
        ("hal/watched.py", WATCHED), ("hal/unwatched.py", WATCHED.replace("a > b", "a < b")), ("pytest.ini", SETTINGS),
        ("tests/hal/test_watched.py", TESTED), ("tests/other/test_unwatched.py", EMPTY),
        ("tests/other/test_apart.py", "def test_that_would_fail() -> None:\n    raise AssertionError\n"),
    ):  # fmt: skip
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    subprocess.run(["git", "init", "-q", "."], cwd=root, check=True)
    return root


@pytest.mark.slow
def test_a_change_is_killed_by_its_test_and_survives_an_empty_one(
    tree: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")  # the others take a second at every start
    monkeypatch.setenv("PYTEST_PLUGINS", "pytest_timeout,xdist.plugin")
    equivalent, folder = tmp_path / "equivalent.toml", tmp_path / "session"
    equivalent.write_text("")
    first = list(Campaign(tree, folder, "1", equivalent).run(1, Limits()))
    both = list(Campaign(tree, folder, "1", equivalent).run(2, Limits()))
    assert both[:1] == first
    by_path = {one.place: one for one in both}
    assert sorted(by_path) == ["hal/unwatched.py:2", "hal/watched.py:2"]
    killed, survivor = by_path["hal/watched.py:2"], by_path["hal/unwatched.py:2"]
    assert (killed.state, killed.why) == ("killed", "tests/hal/test_watched.py::test_larger")
    assert (survivor.state, survivor.before, survivor.why) == ("survived", "return a < b", "2 test files")
    assert survivor.after != survivor.before
    assert (folder / "tree/hal/unwatched.py").read_text() == (tree / "hal/unwatched.py").read_text()

    equivalent.write_text(
        f'[[mutant]]\npath = "hal/unwatched.py"\nbefore = "{survivor.before}"\nafter = "{survivor.after}"\n'
        'reason = "nobody calls it"\n'
    )
    listed = Campaign(tree, folder, "1", equivalent)
    assert Counter(one.state for one in listed.run(2, Limits())) == {"killed": 1, "equivalent": 1}

    # A test that fails without the change, too, kills nothing, and does not hide the next one. Nor does a change that
    # a killed campaign has left.
    equivalent.write_text("")
    (folder / "tree/hal/unwatched.py").write_text(WATCHED.replace("a > b", "a"))
    mended = "import pytest\n\n\n@pytest.mark.parametrize('why', ['too busy'])\n"
    mended += "def test_of_a_busy_computer(why: str) -> None:\n    raise OSError(why)\n\n\n"
    mended += TESTED.replace("watched", "unwatched").replace("2, 1", "1, 2")
    (tree / "tests/other/test_unwatched.py").write_text(mended)
    states = [one.state for one in Campaign(tree, folder, "1", equivalent).run(2, Limits())]
    assert sorted(states) == ["killed", "survived"]
    again = {one.place: one.why for one in Campaign(tree, folder, "1", equivalent).run(2, Limits(), again=True)}
    assert again["hal/unwatched.py:2"] == "tests/other/test_unwatched.py::test_larger"


def test_the_same_seed_draws_the_same_changes_and_leaves_annotations_out(tree: Path) -> None:
    drawn = [(str(one.module_path), one.start_pos, one.operator_name) for one in Draw(tree, "1")]
    assert drawn == [(str(one.module_path), one.start_pos, one.operator_name) for one in Draw(tree, "1")]
    assert {place[0] for _, place, _ in drawn} == {2}
    seeds = {next(iter(islice(Draw(tree, str(seed)), 1))).operator_name for seed in range(9)}
    assert len(seeds) > 1


@pytest.mark.parametrize(
    ("code", "changed"),
    [
        ("save(a)\n", ["pass\n"]),
        ("self.a = b\n", ["pass\n"]),
        ("a = b\n", []),
        ("return save(a)\n", []),
        (
            "if a and b or c: d = 1\n",
            ["if c: d = 1\n", "if a and b: d = 1\n", "if b or c: d = 1\n", "if a or c: d = 1\n"],
        ),
        ("x = a or b or c\n", ["x = b or c\n", "x = a or c\n", "x = a or b\n"]),
    ],
)
def test_statements_and_conditions_are_left_out(code: str, changed: list[str]) -> None:
    operators = (RemoveStatement(), RemoveOperand())
    results = [mutate_code(code, operator, n) for operator in operators for n in range(5)]
    assert [one for one in results if one is not None] == changed


def test_the_nearest_tests_come_first(tree: Path) -> None:
    (tree / "hal/above.py").write_text("def late() -> None:\n    from hal import watched\n")
    (tree / "tests/hal/test_above.py").write_text("import hal.above\n")
    (tree / "tests/hal/test_process.py").write_text("import subprocess\n")
    (tree / "tests/plugins").mkdir()
    (tree / "tests/plugins/test_watched.py").write_text("import subprocess\n")
    assert Nearness(tree).tests_of("hal/watched.py") == [
        f"tests/{name}.py"
        for name in ("hal/test_watched", "hal/test_above", "plugins/test_watched", "hal/test_process")
    ]


def test_equivalent_changes_are_no_part_of_the_share() -> None:
    states = ["killed"] * 9 + ["survived"] + ["equivalent"] * 5
    results = [Result("hal/a.py:1", "a", "b", state, "") for state in states]
    assert summary(results) == "9 killed, 1 survived, 5 equivalent: 90.0 % of 10 noticed"
