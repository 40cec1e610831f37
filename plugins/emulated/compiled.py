"""Numba with types: ``compiled`` keeps a kernel's signature visible to the type checker.

The first call compiles for a few seconds; the machine code is cached beside the source, so later runs start at once.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

Kernel = TypeVar("Kernel", bound=Callable[..., Any])


def compiled(*, parallel: bool = False, fastmath: bool = False) -> Callable[[Kernel], Kernel]:
    """Compile a numeric kernel in no-Python mode, without the GIL."""
    decorate = numba.njit(parallel=parallel, fastmath=fastmath, nogil=True, cache=True)
    return cast("Callable[[Kernel], Kernel]", decorate)
