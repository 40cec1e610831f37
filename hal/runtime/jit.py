"""Numba with types: ``compiled`` keeps a kernel's signature visible to the type checker.

The first call compiles for seconds. The machine code is kept (``hal.runtime.compute``), so later runs start at once.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

from hal.runtime.compute import prepare_threads

Kernel = TypeVar("Kernel", bound=Callable[..., Any])

# Before the first kernel runs: OpenMP is loaded, and numba's threads are started, with it.
prepare_threads()
numba.config.reload_config()  # type: ignore[no-untyped-call]


def compiled(*, parallel: bool = False, fastmath: bool = False) -> Callable[[Kernel], Kernel]:
    """Compile a numeric kernel in no-Python mode, without the GIL.

    A division by zero gives inf or NaN, as in NumPy; an exception would end the work of all pixels for one of them.
    """
    decorate = numba.njit(parallel=parallel, fastmath=fastmath, nogil=True, cache=True, error_model="numpy")
    return cast("Callable[[Kernel], Kernel]", decorate)
