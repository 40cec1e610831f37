"""The cue list: its lines, its times over days and clock changes, and a list that plays."""

from __future__ import annotations

import os
import time
from datetime import date, datetime, timedelta
from pathlib import Path
from zoneinfo import ZoneInfo

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.core.errors import UsageError
from controller.kiosk.building.cues import Cue, due, parse
from controller.kiosk.building.protocol import read, serving
from controller.kiosk.building.verbs import Verbs
from tests.controller.panel.memory_kiosk import MemoryKiosk
from tests.waiting import wait_for

VIENNA = ZoneInfo("Europe/Vienna")
LIST = """time,verb,values
# every evening
18:30,play,marble
+90,black,true

+1:30,play,"{""name"": ""warm wood"", ""fade_s"": 4}"
2026-12-24 19:00:05,brightness,40
"""


@pytest.fixture
def verbs(kiosk: MemoryKiosk) -> Verbs:
    return Verbs(kiosk, "Cue list")


def at(text: str) -> float:
    return datetime.fromisoformat(text).replace(tzinfo=VIENNA).timestamp()


def lines(cues: tuple[Cue, ...], text: str, seconds: float = 20.0) -> list[int]:
    """The lines that are due in so many seconds after a local time."""
    return [cue.line for cue in due(cues, at(text), at(text) + seconds, VIENNA)]


def test_times_of_the_day_dates_and_times_after_another(verbs: Verbs) -> None:
    cues = parse(LIST, verbs.values)
    assert [(cue.line, cue.after_s) for cue in cues] == [(3, 0), (4, 90), (6, 180), (7, 0)]
    assert lines(cues, "2026-12-23 18:29:50") == [3]
    assert lines(cues, "2026-12-23 18:30:00") == [], "it was due at this moment already"
    assert lines(cues, "2026-12-23 18:31:20") == [4]
    assert lines(cues, "2026-12-24 18:29:59", 300) == [3, 4, 6]
    assert lines(cues, "2026-12-24 19:00:00") == [7]
    assert lines(cues, "2026-12-25 19:00:00") == []


def test_on_the_days_on_which_clocks_change_a_cue_comes_once(verbs: Verbs) -> None:
    cues = parse("time,verb,values\n2:30,next\n18:30,next\n+86400,black,true\n", verbs.values)
    for day in ("2026-03-29", "2026-10-25"):
        begin, end = at(f"{day} 00:00"), at(f"{day} 23:59:59")
        done = []
        while begin < end:
            done += [cue.line for cue in due(cues, begin, min(begin + 30, end), VIENNA)]
            begin += 30
        assert sorted(done) == [2, 3, 4]


@pytest.mark.parametrize(
    ("text", "line", "word"),
    [
        ("when,what\n", 1, "first line"),
        ("time,verb,values\n\n+5,next\n", 3, "no cue before"),
        ("time,verb,values\n18:30,next\n25:00,next\n", 3, "does not exist"),
        ("time,verb,values\n2026-02-31 18:00,next\n", 2, "does not exist"),
        ("time,verb,values\nnoon,next\n", 2, "not a time"),
        ("time,verb,values\n18:30,dance\n", 2, "no such verb"),
        ("time,verb,values\n18:30,brightness,140\n", 2, "percent"),
        ("time,verb,values\n18:30,play,a,b\n", 2, "columns"),
        ('time,verb,values\n18:30,play,"marble\n', 2, "end of data"),
        ("time,verb,values\n18:30,next\n+999999,next\n", 3, "week"),
    ],
)
def test_what_is_wrong_names_its_line(verbs: Verbs, text: str, line: int, word: str) -> None:
    with pytest.raises(UsageError) as caught:
        parse(text, verbs.values)
    assert caught.value.code == "cues-wrong"
    assert caught.value.what.startswith(f"Line {line} of")
    assert word in caught.value.what


CELL = st.sampled_from(
    ["18:30", "+5", "+1:2:3", "2026-12-24 0:00", "next", "play", "marble", '"', ",", "\n", "\r", "#"]
)


@settings(max_examples=300, deadline=None)
@given(st.text(max_size=60) | st.lists(CELL, max_size=20).map("".join))
def test_any_text_is_a_list_or_is_refused(text: str) -> None:
    try:
        cues = parse(f"time,verb,values\n{text}", lambda verb, values: None)
    except UsageError as refused:
        found = refused.code
    else:
        found = "cues-wrong"
        due(cues, 1.8e9, 1.8e9 + 60, VIENNA)
    assert found == "cues-wrong"


def test_a_list_plays_and_a_changed_one_is_read_again(kiosk: MemoryKiosk, tmp_path: Path) -> None:
    file = tmp_path / "cues.csv"
    soon = datetime.fromtimestamp(time.time(), VIENNA) + timedelta(seconds=2)
    first = f"time,verb,values\n{soon:%H:%M:%S},play,warm wood\n+0.5,brightness,40\n+0.1,restore,x\n"
    file.write_text(first.replace("+0.1,restore,x\n", ""))
    (tmp_path / "building.toml").write_text(f'[cues]\nfile = "{file}"\n')
    with serving(kiosk, read(tmp_path)):
        wait_for(lambda: kiosk.snapshot().brightness == 40)
        assert kiosk.snapshot().playing == "warm wood"
        assert kiosk.recorded[0] == ("done-by", "Cue list (line 2): Show this appearance now (warm wood).")
        file.write_text(first)
        os.utime(file, (1, 1))
        wait_for(lambda: any(code == "cues-wrong" for code, _ in kiosk.recorded))
    assert "Line 4 of" in kiosk.recorded[-1][1]


def test_a_list_that_is_wrong_at_the_start_is_told_once(kiosk: MemoryKiosk, tmp_path: Path) -> None:
    (tmp_path / "building.toml").write_text(f'[cues]\nfile = "{tmp_path}/none.csv"\n')
    with serving(kiosk, read(tmp_path)):
        wait_for(lambda: kiosk.recorded)
    assert kiosk.recorded[0][0] == "building-failed"
    assert "none.csv" in kiosk.recorded[0][1]


def test_24_00_is_midnight_at_the_end_of_its_day() -> None:
    daily, dated = parse("time,verb,values\n24:00,close\n2026-12-24 24:00,close\n", lambda verb, values: None)
    assert (daily.day, daily.at.isoformat()) == (None, "00:00:00")
    assert (dated.day, dated.at.isoformat()) == (date(2026, 12, 25), "00:00:00")
    with pytest.raises(UsageError):
        parse("time,verb,values\n24:01,close\n", lambda verb, values: None)
