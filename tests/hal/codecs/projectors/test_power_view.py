"""Reading "on" and "off" in the light of what was seen before."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from hal.values import LampRules, Power
from plugins.projectors.answers import PowerView

RULES = LampRules(warm_up_s=60, stable_s=900, cool_down_s=120, minimum_off_s=180)


def test_a_lamp_just_switched_on_warms_for_its_time() -> None:
    view = PowerView(RULES)
    view.switched_on(0.0)
    assert view.answered(Power.ON, 59.0) is Power.WARMING
    assert view.answered(Power.ON, 60.0) is Power.ON


def test_a_lamp_that_was_on_and_is_off_counts_as_hot() -> None:
    view = PowerView(RULES)
    assert view.answered(Power.ON, 0.0) is Power.ON
    assert view.answered(Power.OFF, 10.0) is Power.COOLING
    assert view.answered(Power.OFF, 129.0) is Power.COOLING
    assert view.answered(Power.OFF, 131.0) is Power.OFF


def test_standby_told_by_the_projector_ends_cooling_early() -> None:
    view = PowerView(RULES)
    view.answered(Power.ON, 0.0)
    view.noticed_power(Power.COOLING, 1.0)
    assert view.answered(Power.OFF, 2.0) is Power.COOLING
    view.noticed_power(Power.OFF, 30.0)
    assert view.answered(Power.OFF, 31.0) is Power.OFF


def test_someone_elses_remote_control_is_seen() -> None:
    view = PowerView(RULES)
    assert view.answered(Power.OFF, 0.0) is Power.OFF
    assert view.answered(Power.ON, 10.0) is Power.WARMING
    assert view.answered(Power.ON, 71.0) is Power.ON


def test_a_fresh_on_is_never_hidden_by_an_old_off() -> None:
    view = PowerView(RULES)
    view.answered(Power.ON, 0.0)
    view.switched_off(1.0)
    assert view.answered(Power.ON, 2.0) is Power.ON


def test_a_lamp_seen_lit_during_an_old_cooling_time_cools_anew() -> None:
    view = PowerView(RULES)
    view.switched_off(0.0)
    view.answered(Power.ON, 119.0)
    view.answered(Power.OFF, 119.5)
    assert view.answered(Power.OFF, 121.0) is Power.COOLING


def test_a_lamp_that_goes_out_while_it_warms_counts_as_hot() -> None:
    view = PowerView(RULES)
    view.noticed_power(Power.WARMING, 0.0)
    view.answered(Power.ON, 1.0)
    assert view.answered(Power.OFF, 59.0) is Power.COOLING
    assert view.answered(Power.OFF, 61.0) is Power.COOLING


def test_a_reported_failure_is_a_fault_until_the_next_accepted_start() -> None:
    view = PowerView(RULES)
    view.switched_on(0.0)
    view.noticed_trouble("lamp-failed")
    assert view.answered(Power.OFF, 1.0) is Power.FAULT
    assert list(view.trouble) == ["lamp-failed"]
    view.switched_on(200.0)
    assert not view.trouble
    assert view.answered(Power.ON, 201.0) is Power.WARMING


def test_a_warning_is_told_and_stops_nothing() -> None:
    view = PowerView(RULES)
    view.noticed_trouble("lamp-hours-warning")
    assert view.answered(Power.OFF, 0.0) is Power.OFF
    assert view.trouble == ("lamp-hours-warning",)


def test_a_projector_that_tells_its_phase_itself_is_believed() -> None:
    view = PowerView(RULES)
    for power in (Power.WARMING, Power.COOLING, Power.FAULT, Power.UNKNOWN):
        assert view.answered(power, 0.0) is power


@settings(max_examples=500)
@given(
    st.lists(
        st.tuples(st.sampled_from(["on", "off", "warming", "cooling", "standby", "ask1", "ask0"]), st.floats(0, 300))
    )
)
def test_an_off_lamp_never_reads_as_burning_and_never_as_cold_right_after_light(steps: list[tuple[str, float]]) -> None:
    view = PowerView(RULES)
    now_s, lit_at_s, standby = 0.0, -1e9, True
    for step, wait_s in steps:
        now_s += wait_s
        if step == "on":
            view.switched_on(now_s)
        elif step == "off":
            view.switched_off(now_s)
        elif step in ("warming", "cooling"):
            view.noticed_power(Power(step), now_s)
            standby = False
        elif step == "standby":
            view.noticed_power(Power.OFF, now_s)
            standby = True
        elif step == "ask1":
            assert view.answered(Power.ON, now_s) in (Power.ON, Power.WARMING)
            lit_at_s, standby = now_s, False
        else:
            power = view.answered(Power.OFF, now_s)
            assert power is not Power.ON
            if not standby and now_s - lit_at_s < 1.0 and step == "ask0":
                assert power in (Power.COOLING, Power.WARMING)


def test_a_family_that_names_its_states_is_believed() -> None:
    view = PowerView(RULES, frozenset({Power.WARMING, Power.COOLING}))
    view.switched_on(0.0)
    assert view.answered(Power.WARMING, 1.0) is Power.WARMING
    assert view.in_transition(1.0)
    assert view.answered(Power.ON, 20.0) is Power.ON, "its own word counts, though warm_up_s is not over"
    assert not view.in_transition(20.0)
    view.switched_off(30.0)
    assert view.answered(Power.COOLING, 31.0) is Power.COOLING
    assert view.answered(Power.OFF, 60.0) is Power.OFF
    assert not view.in_transition(60.0)
