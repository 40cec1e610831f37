"""Errors by sets of pixels: nothing is hidden by what a set leaves out."""

from __future__ import annotations

import numpy as np
import pytest

from controller.optics.solve.result.metrics import TITLES, as_rows, as_table, by_pixels, visible_object

SHAPE = (100, 200)
MATRIX = np.array([[0.41, 0.36, 0.18], [0.21, 0.72, 0.07], [0.02, 0.12, 0.95]])


def test_each_set_has_its_own_error_and_tells_what_it_leaves_out() -> None:
    lit = np.zeros(SHAPE, np.bool_)
    lit[10:90, 20:180] = True
    lit[:, 100:102] = False
    valid = lit.copy()
    valid[10:20] = False
    reachable = np.zeros(SHAPE, np.bool_)
    reachable[:, :100] = True
    asked = np.full((*SHAPE, 3), 0.5, np.float32)
    photograph = np.where(reachable[..., None], asked, 0.4).astype(np.float32)
    found = by_pixels(photograph, asked, MATRIX, 1.0, reachable=reachable, valid=valid, lit=lit)
    assert list(found) == list(TITLES)
    in_reach, all_lit, visible = found.values()
    assert in_reach.delta_e00_p95 == pytest.approx(0, abs=1e-4)
    assert (all_lit.delta_e00_p95 or 0) > 3
    assert visible.left_out_share == 0
    whole = 80 * 160
    assert all_lit.left_out_share == pytest.approx(1 - 70 * 158 / whole, abs=1e-3)
    assert in_reach.left_out_share == pytest.approx(1 - 70 * 80 / whole, abs=1e-3)
    rows = as_rows(as_table(found))
    assert rows[2] == ("whole visible object, median / 95 %", f"{visible.delta_e00_median:.2f} / "
                       f"{visible.delta_e00_p95:.2f}; 0.0 % left out")  # fmt: skip


def test_an_unlit_gap_is_judged_by_the_target_beside_it() -> None:
    lit = np.ones(SHAPE, np.bool_)
    lit[:, 100:102] = False
    asked = np.repeat(np.where(lit[..., None], 0.5, 0), 3, axis=2).astype(np.float32)
    found = by_pixels(asked, asked, MATRIX, 1.0, reachable=lit, valid=lit, lit=lit)
    black = by_pixels(asked, asked, MATRIX, 1.0, reachable=lit, valid=lit, lit=np.ones(SHAPE, np.bool_))
    assert found["lit"].delta_e00_p95 == 0
    assert found["visible"].left_out_share == 0
    assert visible_object(lit).all()
    assert black["visible"].delta_e00_median == 0


def test_two_objects_stay_two_and_an_empty_set_has_no_error() -> None:
    lit = np.zeros(SHAPE, np.bool_)
    lit[10:90, 10:80], lit[10:90, 120:190] = True, True
    assert not visible_object(lit)[:, 90:110].any()
    asked = np.full((*SHAPE, 3), 0.5, np.float32)
    found = by_pixels(asked, asked, MATRIX, 1.0, reachable=~lit, valid=lit, lit=lit)
    assert found["in_reach"].delta_e00_median is None
    assert found["in_reach"].left_out_share == 1
    assert as_rows(as_table(found))[0][1] == "100.0 % left out"
