"""Which methods take part: those of this package, installed ones, and functions that a user names."""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Final

from controller.core.errors import UsageError
from controller.core.storage import sha256_of
from lab.compare import learned, methods, planar

GROUP: Final = "velatura.methods"
"""Entry points of installed methods."""
LEARNED_GROUP: Final = "velatura.learned"
"""Those of learned ones."""
NAME: Final = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]*")
TARGET: Final = "target"
"""Pictures of the targets are kept under this name."""


@dataclass(frozen=True, slots=True)
class Entry:
    """A method that takes part. ``dots``: it needs photographs of dots.

    ``method``: ``api.ComparisonMethod``; on photographs of others, ``learned.LearnedMethod``
    """

    name: str
    method: Callable[[Any], Callable[[Any], Any]]
    dots: bool = False
    cost_s: float = 60.0

    @property
    def about(self) -> str:
        """The first line of the method's docstring."""
        text = inspect.getdoc(self.method) or ""
        return text.split("\n", 1)[0].rstrip(".")

    def code_sha256(self) -> str:
        """Hash of the file that the method stands in: one that was changed is done again."""
        try:
            source = inspect.getsourcefile(self.method)
        except TypeError:
            source = inspect.getsourcefile(type(self.method))
        return "" if source is None else sha256_of(Path(source))


BUILT_IN: Final = (
    Entry("ours", methods.ours),
    Entry("paper", methods.paper, dots=True),
    Entry("inversion", methods.inversion, dots=True, cost_s=90.0),
    Entry("feathering", methods.feathering, cost_s=30.0),
    Entry("single", methods.single, cost_s=30.0),
    Entry("superresolution", planar.superresolution, cost_s=30.0),
    Entry("regression", learned.learned_regression),
)
LEARNED: Final = (Entry("regression", learned.regression), Entry("uncorrected", learned.uncorrected))


def entries(names: Sequence[str], known_ones: Sequence[Entry] = BUILT_IN, group: str = GROUP) -> list[Entry]:
    """The methods of these names, in this order; without names all of this package and all installed ones.

    A name is that of a method, ``module:function`` or ``file.py:function``. Raises UsageError("method-unknown",
    "method-unreadable", "method-twice").
    """
    known = {entry.name: entry for entry in known_ones}
    installed = {point.name: point for point in entry_points(group=group) if point.name not in known}
    found = []
    for name in names or (*known, *installed):
        if name in known:
            found.append(known[name])
        elif name in installed:
            found.append(_checked(name, installed[name].load))
        elif ":" in name:
            found.append(_named(name))
        else:
            raise UsageError(
                "method-unknown",
                what=f"There is no method called {name}.",
                remedy=f"Choose from {', '.join((*known, *installed))}, or name a function as module:function.",
            )
    twice = next((entry.name for entry in found if [one.name for one in found].count(entry.name) > 1), None)
    if twice is not None:
        raise UsageError(
            "method-twice", what=f"Two methods are called {twice}.", remedy="Give the function another name."
        )
    return found


def _named(text: str) -> Entry:
    module, _, function = text.rpartition(":")

    def load() -> Any:
        found = _from_file(Path(module)) if module.endswith(".py") else importlib.import_module(module)
        return getattr(found, function)

    return _checked(function, load, text)


def _checked(name: str, load: Callable[[], Any], text: str = "") -> Entry:
    try:
        method = load()
    except Exception as error:  # another's module may raise anything when it is imported
        raise _unreadable(text or name, f"{type(error).__name__}: {error}") from error
    if not callable(method):
        raise _unreadable(text or name, "it is not a function")
    if not NAME.fullmatch(name) or name == TARGET:
        raise _unreadable(text or name, f"it can't be called {name!r}")
    return Entry(name, method)


def _from_file(path: Path) -> Any:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    if spec is None or spec.loader is None:
        raise ImportError(f"{path} can't be imported")
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def _unreadable(name: str, why: str) -> UsageError:
    return UsageError(
        "method-unreadable",
        what=f"The method {name} can't be loaded ({why}).",
        remedy="Name a function as module:function or file.py:function, and check that it can be imported.",
    )
