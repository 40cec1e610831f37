"""Solvers of one small bounded least-squares problem: min |A x - b|^2 for 0 <= x <= 1.

``lsq_linear`` is the reference, of the family that the paper used; ``clarabel`` (interior point) and ``osqp`` (operator
splitting) are faster, and are imported only when asked for. All work on a region of some hundred unknowns.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final, TypeAlias

import numpy as np
import scipy.sparse as sp

from controller.core.arrays import Float64
from controller.core.errors import UsageError, WorkError

TOLERANCE: Final = 1e-8
OSQP_TOLERANCE: Final = 1e-5
"""Splitting converges slowly; this is its accuracy at the usual cost."""


@dataclass(frozen=True, slots=True)
class BoxProblem:
    """``matrix`` (equations, unknowns) sparse rows; ``right_hand_side`` (equations,); ``start`` (unknowns,)."""

    matrix: sp.csr_matrix[np.float64]
    right_hand_side: Float64
    start: Float64

    def objective(self, x: Float64) -> float:
        """|A x - b|^2."""
        return float(np.sum((self.matrix @ x - self.right_hand_side) ** 2))


BoxSolver: TypeAlias = Callable[[BoxProblem], Float64]


def solve_box(solver: str, problem: BoxProblem) -> Float64:
    """(unknowns,) in [0, 1], by the solver of that name; a plain function of plain values, to be sent anywhere.

    Raises UsageError("solver-unknown"), UsageError("solver-missing") or WorkError("region-unsolved").
    """
    if solver not in SOLVERS:
        raise UsageError(
            "solver-unknown",
            what=f"The solver {solver} for regions is unknown.",
            remedy=f"Choose one of {', '.join(SOLVERS)}.",
        )
    x = SOLVERS[solver](problem)
    if not np.isfinite(x).all():
        raise WorkError(
            "region-unsolved",
            what=f"The solver {solver} found no solution for a region of {problem.start.size} unknowns.",
            remedy="Use lsq_linear for the regions, or the global solver.",
        )
    return np.clip(x, 0, 1)


def _by_lsq_linear(problem: BoxProblem) -> Float64:
    from scipy.optimize import lsq_linear

    return np.asarray(lsq_linear(problem.matrix, problem.right_hand_side, (0, 1), tol=TOLERANCE, lsmr_tol="auto").x)


def _by_clarabel(problem: BoxProblem) -> Float64:
    clarabel = _imported("clarabel")
    quadratic, linear = _quadratic(problem)
    count = linear.size
    identity = sp.identity(count, format="csc")
    constraints = sp.vstack([identity, -identity], format="csc")
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_threads = 1
    # By itself it takes the plain factorisation up to some thousand unknowns, which light that mixes makes dense.
    settings.direct_solve_method = "faer"
    bounds = np.concatenate([np.ones(count), np.zeros(count)])
    cones = [clarabel.NonnegativeConeT(2 * count)]
    return np.array(clarabel.DefaultSolver(quadratic, linear, constraints, bounds, cones, settings).solve().x)


def _by_osqp(problem: BoxProblem) -> Float64:
    osqp = _imported("osqp")
    quadratic, linear = _quadratic(problem)
    count = linear.size
    solver = osqp.OSQP()
    solver.setup(
        quadratic, linear, sp.identity(count, format="csc"), np.zeros(count), np.ones(count),
        verbose=False, eps_abs=OSQP_TOLERANCE, eps_rel=OSQP_TOLERANCE, polishing=False,
    )  # fmt: skip
    solver.warm_start(x=problem.start)
    return np.array(solver.solve(raise_error=False).x)


def _quadratic(problem: BoxProblem) -> tuple[sp.csc_matrix[np.float64], Float64]:
    """The upper triangle of A'A and -A'b, scaled so that tolerances mean the same in any unit of light."""
    hessian = (problem.matrix.T @ problem.matrix).tocsc()
    scale = 1 / max(float(hessian.diagonal().mean()), np.finfo(np.float64).tiny)
    return sp.triu(hessian * scale, format="csc"), -scale * np.asarray(problem.matrix.T @ problem.right_hand_side)


def _imported(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise UsageError(
            "solver-missing",
            what=f"The solver {name} is not installed ({error}).",
            remedy=f"Install the Python package {name}, or use lsq_linear.",
        ) from error


SOLVERS: Final[Mapping[str, BoxSolver]] = {
    "lsq_linear": _by_lsq_linear,
    "clarabel": _by_clarabel,
    "osqp": _by_osqp,
}
