from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from _pytest.mark.structures import ParameterSet

from lab.simulate.life import Life, Outcome
from lab.simulate.monitors.invariants import INVARIANTS
from lab.simulate.scenarios.generator import random_scenario, random_site
from lab.simulate.scenarios.scenario import STOPPED, Incident, Site, from_json, to_json
from lab.simulate.scheduler import DAY_S
from tests.campaigns.log_lives import log_life

FOUND = Path(__file__).parent / "found"
ROOT = Path(__file__).parents[3]
ONE = "from lab.simulate.life import Life; print(Life('same', 0.5).run().digest)"


def digest(folder: Path, cores: int, **variables: str) -> str:
    """Of a life in a process of its own: in ``folder``, on so many cores, with a mask of its own for file modes."""
    some = sorted(os.sched_getaffinity(0))[:cores]
    begin = f"import os; os.sched_setaffinity(0, {some}); os.umask({cores + 0o22}); {ONE}"
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **variables}
    done = subprocess.run(
        [sys.executable, "-c", begin], cwd=folder, env=environment, capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


def test_the_same_seed_gives_the_same_event_log_in_every_process(tmp_path: Path) -> None:
    first = digest(ROOT, 8, PYTHONHASHSEED="1", TZ="UTC", LC_ALL="C.UTF-8")
    second = digest(
        tmp_path, 1, PYTHONHASHSEED="77", TZ="Australia/Lord_Howe", LC_ALL="POSIX", PYTHONUTF8="0",
        HOME=str(tmp_path), TMPDIR=str(tmp_path), XDG_RUNTIME_DIR=str(tmp_path), COLUMNS="20",
    )  # fmt: skip
    assert len(first) == 64
    assert first == second


def test_another_seed_gives_another_life() -> None:
    assert random_scenario("one", 3.0) != random_scenario("two", 3.0)
    assert random_scenario("one", 3.0) == random_scenario("one", 3.0)


def test_a_script_is_the_same_after_it_was_kept() -> None:
    site, script = random_site("kept"), random_scenario("kept", 5.0)
    assert from_json(to_json(site, script)) == (site, script)


def test_each_life_leaves_some_kinds_of_things_out_and_all_of_them_have_all() -> None:
    lives = [{incident.kind for incident in random_scenario(f"all-{number}", 60.0)} for number in range(8)]
    assert set().union(*lives) >= {"line", "power cut", "killed while writing", "clock set", "command", "x server"}
    assert all(kinds < set().union(*lives) for kinds in lives)


def kept_scenarios() -> list[ParameterSet]:
    """The kept scenarios; those of more than a simulated day are long: a service lives through them."""
    scenarios = [(path.stem, *from_json(path.read_text("utf-8"))) for path in sorted(FOUND.glob("*.json"))]
    return [
        pytest.param(name, site, incidents, id=name, marks=[pytest.mark.long] if incidents[-1].at_s > DAY_S else [])
        for name, site, incidents in scenarios
    ]


@pytest.mark.parametrize(("name", "site", "incidents"), kept_scenarios())
def test_what_was_found_once_is_not_found_again(name: str, site: Site, incidents: list[Incident]) -> None:
    """A scenario is named after its seed. It violated an invariant once, some only with a planted bug."""
    outcome = Life(name.partition(".")[0], incidents[-1].at_s / DAY_S + 0.25, incidents, site).run()
    assert outcome.violation == ""


def test_a_short_life_keeps_every_promise() -> None:
    outcome = Life("planted-0", 0.8).run()
    assert outcome.violation == "", outcome.last
    assert outcome.events > 10
    assert outcome.minutes["open"] + outcome.minutes["closed"] > 900


@pytest.mark.parametrize("number", range(10))
def test_troubles_of_the_log_alone_break_no_promise(number: int) -> None:
    outcome = log_life(f"short-{number}")
    assert outcome.violation == "", outcome.last
    assert outcome.events > 10


def test_what_waits_for_a_moment_happens_when_the_log_says_that() -> None:
    rows = [{"day": day, "opens": "10:00", "closes": "18:00"} for day in ("mon", "tue", "wed", "thu", "fri")]
    killed = Incident(600.0, "killed", after_event="work-begins", delay_s=5.0)
    outcome = Life("moment", 1.0, [killed], Site(1_767_571_200.0, "UTC", rows, "03:30")).run()
    began, again = [
        float(line.split()[1]) for line in outcome.last if " work-begins " in line or "run ended unexpectedly" in line
    ]
    assert 5.0 <= again - began < 9.0
    assert outcome.violation == ""


def a_life(incidents: list[Incident], days: float, **values: Any) -> Outcome:
    """From Monday, 00:00 on: open from 10:00 to 18:00."""
    rows = [{"day": "mon", "opens": "10:00", "closes": "18:00"}]
    return Life("script", days, incidents, Site(1_767_571_200.0, "UTC", rows, "03:30", **values)).run()


def test_the_player_of_a_small_computer_answers_late_while_it_works() -> None:
    work = [Incident(600.0, "command", "recalibrate", arguments='{"kind": "full"}')]
    small, large = a_life(work, 0.05, is_small=True), a_life(work, 0.05)
    assert [outcome.violation for outcome in (small, large)] == ["", ""]
    assert any(" player-hung " in line for line in small.last)
    assert not any(" player-hung " in line for line in large.last)


def test_an_administrator_edits_the_settings_on_a_full_disk_too() -> None:
    edited = Incident(900.0, "settings edited", variant="comment")
    damaged = Incident(9000.0, "file damaged", "stage.toml", "empty")
    outcome = a_life([Incident(600.0, "disk full", duration_s=1200.0), edited, damaged], 0.12)
    assert outcome.violation == ""
    assert sum(" service-started " in line for line in outcome.last) == 4
    assert any("runs with the last good settings" in line for line in outcome.last)


def test_a_computer_without_a_battery_has_no_time_after_a_power_cut() -> None:
    cut = [Incident(600.0, "power cut", duration_s=5.0)]
    without, with_battery = a_life(cut, 0.05, no_time_s=120.0), a_life(cut, 0.05)
    assert [outcome.violation for outcome in (without, with_battery)] == ["", ""]
    unknown, known = [line for line in without.last if " clock-unknown " in line or " clock-known " in line]
    assert float(unknown.split()[1]) < 1_000.0 < 1_767_571_200.0 < float(known.split()[1])
    assert not any(" clock-unknown " in line for line in with_battery.last)


@pytest.mark.parametrize("how", ["block", "half", "zeros"])
def test_damage_to_what_was_written_last_meets_the_small_tables_of_a_log_of_months(how: str) -> None:
    # One of those pages has the number of the last event.
    incidents = [
        Incident(
            1800.0 * (1 + page), "file damaged", "kiosk/events.sqlite", how,
            magnitude=1.0 + (page + 0.6) / 8, arguments=STOPPED,
        )
        for page in range(8)
    ]  # fmt: skip
    outcome = a_life(incidents, 0.25, logged=1000)
    numbers = [int(line.split()[0]) for line in outcome.last]
    assert outcome.violation == ""
    assert numbers[0] in (1001, 1002), "of the last thirty events"
    assert numbers[-1] > 1_767_571_200


def test_every_promise_is_on_the_page() -> None:
    page = (ROOT / "docs" / "how-to" / "simulate.md").read_text("utf-8")
    assert [name for name, sentence in INVARIANTS.items() if f"| {name} | {sentence} |" not in page] == []
