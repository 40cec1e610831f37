from __future__ import annotations

import math

from hypothesis import given
from hypothesis import strategies as st

from controller.stage.artefacts.camera import Exposures
from controller.stage.steps.capture.exposure import bracket
from controller.stage.steps.capture.patterns import linked

EXPOSURES_S = [2.0 ** (number / 3) for number in range(-30, 10)]


@given(
    base_s=st.floats(1e-4, 20.0),
    factors=st.lists(st.floats(0.01, 100.0), min_size=1, max_size=4),
    longest_s=st.floats(1e-4, 30.0),
)
def test_a_bracket_holds_distinct_exposures_of_the_camera_each_the_nearest_allowed(
    base_s: float, factors: list[float], longest_s: float
) -> None:
    chosen = bracket(base_s, factors, EXPOSURES_S, longest_s)
    assert chosen == sorted(set(chosen))
    assert 1 <= len(chosen) <= len(factors)
    allowed = [value for value in EXPOSURES_S if value <= longest_s] or [min(EXPOSURES_S)]
    assert set(chosen) <= set(allowed)
    for factor in factors:
        wanted = math.log(base_s * factor)
        nearest = min(abs(math.log(value) - wanted) for value in allowed)
        assert min(abs(math.log(value) - wanted) for value in chosen) <= nearest + 1e-12


def test_brackets_of_all_projectors_have_an_exposure_in_common_if_one_is_near() -> None:
    left = Exposures(0.05, (0.05, 0.16, 0.5))
    right = Exposures(0.0625, (0.0625, 0.2, 0.63))
    above = Exposures(0.05, (0.05, 0.16, 0.5))
    found = linked({"left": left, "right": right, "above": above})
    assert found["left"] == left
    assert found["above"] == above
    assert found["right"].base_s == 0.0625
    assert found["right"].white_s in ((0.0625, 0.16, 0.63), (0.0625, 0.2, 0.5))
    far = Exposures(0.004, (0.004, 0.01))
    assert linked({"left": left, "far": far})["far"] == far
    two = Exposures(0.06, (0.06, 0.13))
    assert linked({"left": left, "two": two})["two"] == Exposures(0.06, (0.06, 0.16))
