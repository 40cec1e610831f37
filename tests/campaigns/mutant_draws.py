"""Single changes of the product's lines, drawn by a seed: cosmic-ray's operators, and two of our own.

A line is drawn first, then one kind of change that it allows, so that a line of many operators counts as one. Left out
are annotations and the decorators of data classes, which change nothing that runs, ``parallel`` and ``strict``, which
change no result of a right program, and replacements that almost always end in a TypeError (``a + b`` to ``a << b``): a
program that can't run is no test of the tests.
"""

from __future__ import annotations

import ast
import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import cosmic_ray.plugins
from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.operators.operator import Operator
from cosmic_ray.util import read_python_source
from cosmic_ray.work_item import MutationSpec
from parso.python.tree import Keyword

PARTS: Final = ("controller", "hal", "plugins")
EMULATORS: Final = "plugins/emulated/"
PARTNERS: Final = {
    "Add": ("Sub",), "Sub": ("Add",), "Mul": ("Div",), "Div": ("Mul",), "FloorDiv": ("Mul",), "Mod": ("FloorDiv",),
    "Pow": ("Mul",), "LShift": ("RShift",), "RShift": ("LShift",), "BitAnd": ("BitOr",), "BitOr": ("BitAnd",),
    "BitXor": ("BitOr",), "Lt": ("LtE", "Gt"), "LtE": ("Lt", "GtE"), "Gt": ("GtE", "Lt"), "GtE": ("Gt", "LtE"),
    "Eq": ("NotEq",), "NotEq": ("Eq",), "Is": ("IsNot",), "IsNot": ("Is",),
    "USub": ("UAdd",), "Delete": ("Not", "USub"),
}  # fmt: skip
"""What each operator of the language is replaced by."""
BINARY: Final = ("term", "arith_expr", "power", "shift_expr", "expr", "xor_expr", "and_expr", "expr_stmt")
"""Nodes in which "*" multiplies: elsewhere it unpacks."""
UNUSED: Final = ("core/RemoveDecorator", "core/VariableReplacer", "core/VariableInserter")


class _Ours(Operator):  # type: ignore[misc]  # cosmic-ray has no types
    @classmethod
    def examples(cls) -> Sequence[Any]:
        return ()


class RemoveStatement(_Ours):
    """A call, or an assignment to an attribute or an element, is not made."""

    def mutation_positions(self, node: Any) -> Iterator[Any]:
        if node.parent is None or node.parent.type != "simple_stmt":
            return
        called = (
            node.type == "atom_expr" and node.children[-1].type == "trailer" and node.children[-1].children[0] == "("
        )
        assigned = node.type == "expr_stmt" and node.children[0].type in ("atom_expr", "power")
        if called or assigned:
            yield node.start_pos, node.end_pos

    def mutate(self, node: Any, index: int) -> Any:
        return Keyword("pass", node.start_pos, prefix=node.get_first_leaf().prefix)


class RemoveOperand(_Ours):
    """One condition of an ``and`` or ``or`` is not asked."""

    def mutation_positions(self, node: Any) -> Iterator[Any]:
        if node.type in ("and_test", "or_test"):
            for operand in node.children[::2]:
                yield operand.start_pos, operand.end_pos

    def mutate(self, node: Any, index: int) -> Any:
        left, last = list(node.children), index == len(node.children) // 2
        prefix = node.get_first_leaf().prefix
        del left[2 * index : 2 * index + 2]
        if last:
            left.pop()  # the word before the last one
        left[0].get_first_leaf().prefix = prefix
        node.children = left
        return node if len(left) > 1 else left[0]


OURS: Final[dict[str, type[Operator]]] = {"RemoveStatement": RemoveStatement, "RemoveOperand": RemoveOperand}


def operator_of(name: str) -> Operator:
    """An operator by its name in a session."""
    return OURS[name]() if name in OURS else cosmic_ray.plugins.get_operator(name)()


def _families() -> dict[str, list[str]]:
    """Names of operators by what they change: "+" has as many chances as "not"."""
    families: dict[str, list[str]] = {name: [name] for name in OURS}
    for name in cosmic_ray.plugins.operator_names():
        kind, *change = name.split("_")
        if name in UNUSED or (change and change[-1] not in PARTNERS.get(change[-2], ())):
            continue
        families.setdefault("_".join([kind, *change[:-1]]), []).append(name)
    return families


@dataclass(frozen=True, slots=True)
class Line:
    """``path`` relative to the root, ``row`` from 1."""

    path: str
    row: int


class Draw:
    """Changes of one tree's product, in the order of a seed: the same for the same code."""

    def __init__(self, root: Path, seed: str) -> None:
        self._root, self._random, self._names = root, random.Random(f"mutants {seed}"), _families()
        paths = sorted(path for part in PARTS for path in (root / part).rglob("*.py"))
        names = [path.relative_to(root).as_posix() for path in paths]
        self._lines = [
            Line(name, row)
            for name in names
            if not name.startswith(EMULATORS)
            for row, text in enumerate(read_python_source(root / name).splitlines(), 1)
            if text.strip() and not text.lstrip().startswith("#")
        ]
        self._random.shuffle(self._lines)

    def __iter__(self) -> Iterator[MutationSpec]:
        for line in self._lines:
            if (one := self._of(line)) is not None:
                yield one

    def _of(self, line: Line) -> MutationSpec | None:
        """One change of this line; None where it allows none."""
        source = read_python_source(self._root / line.path)
        nodes = list(ast_nodes(get_ast(source)))
        nothing = list(_without_effect(source))
        here = [n for n in nodes if n.start_pos[0] == line.row and not any(a <= n.start_pos < b for a, b in nothing)]
        choices: list[list[tuple[str, Any, int, Any, Any]]] = []
        for names in self._names.values():
            choice = [
                (name, node, index, start, end)
                for name in names
                for node in here
                if "BinaryOperator" not in name or (node.parent is not None and node.parent.type in BINARY)
                for index, (start, end) in enumerate(operator_of(name).mutation_positions(node))
                if start[0] == line.row
            ]
            if choice:
                choices.append(choice)
        if not choices:
            return None
        name, node, index, start, end = self._random.choice(self._random.choice(choices))
        before = nodes[: next(n for n, other in enumerate(nodes) if other is node)]
        operator = operator_of(name)
        occurrence = index + sum(1 for other in before for _ in operator.mutation_positions(other))
        return MutationSpec(line.path, name, occurrence, start, end)


def _without_effect(source: str) -> Iterator[tuple[tuple[int, int], tuple[int, int]]]:
    """(start, end) of annotations, decorators of data classes, ``parallel`` and ``strict``, each (row, column)."""
    for node in ast.walk(ast.parse(source)):
        texts: list[ast.expr | None] = []
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            texts = [node.returns]
        elif isinstance(node, ast.arg | ast.AnnAssign):
            texts = [node.annotation]
        elif isinstance(node, ast.ClassDef):
            texts = [one for one in node.decorator_list if "dataclass" in ast.unparse(one)]
        elif isinstance(node, ast.keyword) and node.arg in ("parallel", "strict"):
            texts = [node.value]
        for text in texts:
            if text is not None:
                yield (text.lineno, text.col_offset), (text.end_lineno or 0, text.end_col_offset or 0)
