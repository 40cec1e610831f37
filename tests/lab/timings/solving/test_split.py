"""A façade that is solved in parts, by Dask, against the solve of the whole."""

from __future__ import annotations

import numpy as np
from distributed import Client

from controller.optics.solve.bounded.equations import TOLERANCE, build_problem
from controller.optics.solve.bounded.solver import solve_bounded
from lab.timings.solving.split import NEAR, solve_split
from lab.timings.tools.facade import facade_solve
from lab.timings.tools.split_parts import part_problem, parts_of, turns

TRANSPORT, TARGET, BLACK = facade_solve(3, 2, (24, 32))


def test_the_equations_of_parts_are_those_of_the_whole() -> None:
    parts, sheet = parts_of(TRANSPORT), TRANSPORT.sheet
    whole = build_problem(TRANSPORT, TARGET, BLACK, 0.001, None)
    np.testing.assert_array_equal(np.sort(np.concatenate([part.own for part in parts])), np.arange(TRANSPORT.pixels))
    assert turns(parts) == [[0, 2], [1]], "those at the ends have no border"
    for part in parts:
        own = part_problem(part, part.seen(sheet, TARGET), part.seen(sheet, BLACK), None, whole.strength_per_step)
        np.testing.assert_allclose(own.majoriser[:, part.own], whole.majoriser[:, part.own], rtol=1e-4)
    for one, other, shared in ((0, 1, True), (1, 2, True), (0, 2, False)):
        places, of = parts[one].border(parts[other])
        assert (places.size > 0) is shared
        assert places.size == of.size < 0.6 * parts[one].lit.sum()


def test_parts_that_exchange_their_borders_are_as_good_as_the_whole() -> None:
    whole = solve_bounded(TRANSPORT, TARGET, BLACK)
    with Client(processes=False, n_workers=1, threads_per_worker=1, dashboard_address=":0") as client:  # type: ignore[no-untyped-call]
        split = solve_split(client, TRANSPORT, TARGET, BLACK, 0.0, whole.iterations)
    assert abs(split.objective / whole.objective - 1) < NEAR
    assert split.kkt < 1.2 * TOLERANCE
