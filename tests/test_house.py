"""The house stays as it is left: not larger, no new fragments, no new long parameter lists. Lower a limit when you can.

``python -m tests.house`` prints the figures, and the names behind them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import pytest

from controller.__main__ import run
from controller.cli import groups
from tests import house

LIMITS: Final[Mapping[str, int]] = {
    "lines": 111_950,
    "files": 655,
    "folders at the root of controller": 11,
    "files with one importer": 145,
    "small files with one importer": 5,
    "functions with 8 or more parameters": 11,
    "modules named by a participle": 10,
    "decision records": 38,
}
MOST_COMMANDS: Final = 17
"""In the first help, without those of other distributions."""


@pytest.fixture(scope="module")
def files() -> dict[str, str]:
    return house.source_files(*house.PRODUCT)


@pytest.mark.parametrize("figure", LIMITS)
def test_a_figure_stays_below_its_limit(figure: str, files: Mapping[str, str]) -> None:
    assert house.FIGURES[figure](files) <= LIMITS[figure]


def test_every_figure_has_a_limit() -> None:
    assert list(LIMITS) == list(house.FIGURES)


def test_the_first_help_can_be_kept_in_mind(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(groups, "installed_commands", dict)
    assert run(["--help"]) == 0
    commands = house.commands_in_help(capsys.readouterr().out)
    assert {"calibrate", "appearance", "play"} <= set(commands)
    assert len(commands) <= MOST_COMMANDS


# The rules themselves


def test_an_import_of_a_name_a_module_or_a_package_counts_once() -> None:
    files = {
        "a/__init__.py": "",
        "a/one.py": "X = 1\n",
        "a/two.py": "from a.one import X\nimport a.one\n",
        "a/three.py": "from a import one, two\n",
        "a/four.py": "import os\n\ndef late() -> None:\n    import a.three\n",
    }
    assert house.importers(files) == {
        "a/one.py": {"a/two.py", "a/three.py"},
        "a/two.py": {"a/three.py"},
        "a/__init__.py": {"a/three.py"},
        "a/three.py": {"a/four.py"},
    }
    assert house.single_importers(files) == ["a/two.py", "a/three.py"]
    assert house.small_single_importers(files | {"a/two.py": "from a.one import X\n" + "\n" * 79}) == ["a/three.py"]


def test_parameters_are_counted_without_self_and_kernels() -> None:
    many = ", ".join(f"p{number}" for number in range(8))
    source = f"def f({many}): ...\n@compiled\ndef k({many}): ...\nclass C:\n    def m(self, {many[4:]}): ...\n"
    assert house.long_parameter_lists({"a.py": source}) == ["a.py:f"]
    assert house.long_parameter_lists({"a.py": "async def f(a, b, c, d, /, e, *, f, g, h): ..."}) == ["a.py:f"]


def test_a_participle_alone_is_no_name() -> None:
    names = ["kept", "judged", "seed", "scaling", "kept_work", "trying", "bundle"]
    files = {f"controller/{name}.py": "" for name in names}
    assert house.participle_modules(files) == ["controller/kept.py", "controller/judged.py", "controller/trying.py"]
    assert house.participle_modules({"controller/wanted/__init__.py": ""}) == ["controller/wanted/__init__.py"]


def test_commands_are_read_from_a_help_page() -> None:
    options = "Usage: x\n\nOptions:\n  --help  Show.\n\n"
    shown = f"{options}Set up:\n  init     Make a stage, and\n           more.\n  test-it  Test.\n"
    assert house.commands_in_help(shown) == ["init", "test-it"]
