"""The tree that docs/architecture.md shows is the tree that exists, and keeps its rules."""

from __future__ import annotations

import ast
import json
import re
from collections import Counter
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import controller.core.errors
import hal.errors

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "architecture.md").read_text("utf-8")
TOPS = ("controller", "hal", "plugins", "firmware_configs")


def folders() -> list[Path]:
    """Every folder of the product that holds a file, relative to the root."""
    found = {file.parent for top in TOPS for file in (ROOT / top).rglob("*") if file.is_file()}
    return sorted(folder.relative_to(ROOT) for folder in found if "__pycache__" not in folder.parts)


def packages() -> list[Path]:
    return [folder for folder in folders() if any((ROOT / folder).glob("*.py"))]


def named() -> list[str]:
    tree = PAGE.partition("## The tree")[2].split("```")[1]
    return [line.split()[0].rstrip("/") for line in tree.splitlines() if line.strip()]


def test_the_page_names_every_folder_once_and_no_other() -> None:
    assert Counter(named()) == Counter(folder.as_posix() for folder in folders())


def test_each_named_folder_is_explained() -> None:
    tree = PAGE.partition("## The tree")[2].split("```")[1]
    assert [line for line in tree.splitlines() if len(line.split()) == 1] == []


@pytest.mark.parametrize("folder", packages(), ids=str)
def test_each_package_says_what_lives_there(folder: Path) -> None:
    text = (ROOT / folder / "__init__.py").read_text("utf-8")
    assert len(ast.get_docstring(ast.parse(text)) or "") > 20


@pytest.mark.parametrize("folder", packages(), ids=str)
def test_what_a_package_names_exists(folder: Path) -> None:
    text = ast.get_docstring(ast.parse((ROOT / folder / "__init__.py").read_text("utf-8"))) or ""
    for first, symbol in re.findall(r"(?<!`)`(\w+)(?:\.(\w+))?`(?!`)", text):
        if first.islower():
            module = ROOT / folder / first
            place = module / "__init__.py" if module.is_dir() else module.with_suffix(".py")
            if first in TOPS:
                assert any((ROOT / first / symbol).parent.glob(f"{symbol}*")), symbol
            else:
                assert re.search(
                    rf"^(def|class) {symbol}\b|^{symbol}\b" if symbol else "", place.read_text("utf-8"), re.MULTILINE
                )


def equations(text: str) -> set[int]:
    """The numbers of the equations that a text names: "eq. 3", "eqs 2 and 3", "eqs 4-6"."""
    found: set[int] = set()
    for first, last in re.findall(r"\beqs?\.? (\d)(?:(?: and | to |-)(\d))?", text):
        found |= set(range(int(first), int(last or first) + 1))
    return found


def test_each_equation_is_named_in_the_files_that_the_page_lists_for_it() -> None:
    table = PAGE.partition("## Equations and code")[2].partition("\n## ")[0]
    rows = [line.split("|")[1::2] for line in table.splitlines() if re.match(r"\| \d", line)]
    listed = [
        ({int(number) for number in numbers.split(",")}, re.findall(r"`([^`]+)`", code)) for numbers, code in rows
    ]
    assert sorted(number for numbers, _ in listed for number in numbers) == list(range(1, 10))
    for numbers, files in listed:
        assert files
        for file in files:
            assert numbers & equations((ROOT / file).read_text("utf-8")), f"{file} names none of {numbers}"


def imports() -> dict[str, set[str]]:
    """Modules by what they import anywhere in their file, also inside functions and for types alone."""
    files = {}
    for top in TOPS:
        for path in (ROOT / top).rglob("*.py"):
            files[".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")] = path
    graph: dict[str, set[str]] = {}
    for module, path in files.items():
        graph[module] = set()
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module and not node.level:
                targets = {f"{node.module}.{alias.name}" for alias in node.names}
                graph[module] |= {target if target in files else node.module for target in targets}
            elif isinstance(node, ast.Import):
                graph[module] |= {alias.name for alias in node.names}
        graph[module] &= files.keys() - {module}
    return graph


def test_no_file_imports_itself_by_way_of_others() -> None:
    TopologicalSorter(imports()).prepare()  # raises CycleError, which names the files


def test_no_exception_is_made_once_for_all() -> None:
    """It would keep a traceback of each time it is raised, with all that the frames hold."""
    own = {name for module in (controller.core.errors, hal.errors) for name, kind in vars(module).items()
           if isinstance(kind, type) and issubclass(kind, BaseException)}  # fmt: skip
    kept = []
    for path in (path for top in TOPS for path in (ROOT / top).rglob("*.py")):
        for node in ast.parse(path.read_text("utf-8")).body:
            made = node.value if isinstance(node, ast.Assign | ast.AnnAssign) else None
            name = ast.unparse(made.func).rpartition(".")[2] if isinstance(made, ast.Call) else ""
            if name in own or name.endswith(("Error", "Exception")):
                kept.append(f"{path.relative_to(ROOT)}:{node.lineno}")
    assert kept == []


def test_every_kernel_of_the_tables_is_a_function_of_its_module() -> None:
    missing = []
    for table in (ROOT / top / "kernels.json" for top in ("controller", "plugins")):
        for module, kernels in json.loads(table.read_text("utf-8")).items():
            tree = ast.parse((ROOT / module.replace(".", "/")).with_suffix(".py").read_text("utf-8"))
            functions = {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
            missing += [f"{module}.{name}" for name in kernels if name.partition(".")[0] not in functions]
    assert missing == []
