"""The product in figures: how large it is, what only one other file imports, long parameter lists, names.

    python -m tests.house

``test_house.py`` has the limits.
"""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).parents[1]
PRODUCT: Final = ("controller", "hal", "plugins")
SMALL_LINES: Final = 80
"""A shorter file that only one other imports is part of that one, unless it is named with a reason."""
MANY_PARAMETERS: Final = 8
COMPILED: Final = re.compile(r"compiled|jit")
"""In a decorator of a kernel, whose arguments are arrays and numbers."""
IRREGULAR: Final = {
    "begun", "bound", "built", "chosen", "drawn", "found", "given", "gone", "held", "kept", "known", "lent", "lost",
    "made", "put", "said", "seen", "sent", "shown", "told", "trying", "written",
}  # fmt: skip
NO_PARTICIPLES: Final = {"bed", "feed", "need", "seed", "shed", "speed"}


def source_files(*folders: str) -> dict[str, str]:
    """The text of each Python file below these folders, by its path from the root."""
    paths = sorted(path for folder in folders for path in (ROOT / folder).rglob("*.py"))
    return {path.relative_to(ROOT).as_posix(): path.read_text("utf-8") for path in paths}


def module_of(path: str) -> str:
    """The dotted name of a file."""
    return path.removesuffix(".py").removesuffix("/__init__").replace("/", ".")


def line_count(files: Mapping[str, str]) -> int:
    """Lines of all files."""
    return sum(text.count("\n") for text in files.values())


def root_folders(files: Mapping[str, str], package: str = "controller") -> set[str]:
    """The folders at the root of a package."""
    parts = (path.split("/") for path in files)
    return {part[1] for part in parts if part[0] == package and len(part) > 2}


def importers(files: Mapping[str, str]) -> dict[str, set[str]]:
    """For each file, the other files that import it or a name of it."""
    by_module = {module_of(path): path for path in files}
    users: dict[str, set[str]] = defaultdict(set)
    for path, text in files.items():
        for name in _imported_names(ast.parse(text)):
            imported = by_module.get(name)
            if imported is not None and imported != path:
                users[imported].add(path)
    return users


def _imported_names(tree: ast.Module) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def single_importers(files: Mapping[str, str]) -> list[str]:
    """Files, packages apart, that exactly one other file imports."""
    users = importers(files)
    return [path for path in files if not path.endswith("__init__.py") and len(users[path]) == 1]


def small_single_importers(files: Mapping[str, str]) -> list[str]:
    """Those of them that are short."""
    return [path for path in single_importers(files) if files[path].count("\n") < SMALL_LINES]


def long_parameter_lists(files: Mapping[str, str]) -> list[str]:
    """``path:function`` of each function with eight parameters or more, without ``self`` and without kernels."""
    return [
        f"{path}:{node.name}"
        for path, text in files.items()
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        and _parameter_count(node) >= MANY_PARAMETERS
        and not any(COMPILED.search(ast.unparse(decorator)) for decorator in node.decorator_list)
    ]


def _parameter_count(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    arguments = function.args
    bound = bool(arguments.args) and arguments.args[0].arg in ("self", "cls")
    return len(arguments.posonlyargs) + len(arguments.args) + len(arguments.kwonlyargs) - bound


def participle_modules(files: Mapping[str, str]) -> list[str]:
    """Modules and packages whose name is one past participle: it does not say of what."""
    names = {path: module_of(path).rpartition(".")[2] for path in files}
    return [
        path
        for path, name in names.items()
        if name in IRREGULAR or (re.fullmatch(r"[a-z]+ed", name) and name not in NO_PARTICIPLES)
    ]


def decision_records() -> list[str]:
    """The numbered records of docs/decisions."""
    return sorted(path.name for path in (ROOT / "docs" / "decisions").glob("[0-9]*.md"))


def commands_in_help(shown: str) -> list[str]:
    """The commands that a help page lists, in its order."""
    return re.findall(r"^  ([a-z][a-z-]*)(?:  |$)", shown, re.MULTILINE)


FIGURES: Final[Mapping[str, Callable[[Mapping[str, str]], int]]] = {
    "lines": line_count,
    "files": len,
    "folders at the root of controller": lambda files: len(root_folders(files)),
    "files with one importer": lambda files: len(single_importers(files)),
    "small files with one importer": lambda files: len(small_single_importers(files)),
    "functions with 8 or more parameters": lambda files: len(long_parameter_lists(files)),
    "modules named by a participle": lambda files: len(participle_modules(files)),
    "decision records": lambda _: len(decision_records()),
}
"""Each figure of the product's files."""


def main() -> None:
    """Print the figures, and the names behind those that have to shrink."""
    files = source_files(*PRODUCT)
    for name, measure in FIGURES.items():
        print(f"{name:38} {measure(files):7,}")
    for title, names in (
        ("small files with one importer", small_single_importers(files)),
        ("functions with 8 or more parameters", long_parameter_lists(files)),
        ("modules named by a participle", participle_modules(files)),
    ):
        print(f"\n{title}:", *names, sep="\n  ")


if __name__ == "__main__":
    main()
