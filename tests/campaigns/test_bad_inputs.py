"""A short campaign in every test run; the long one is started by hand (tests/campaigns/bad_inputs.py)."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.campaigns.bad_cases import Case
from tests.campaigns.bad_inputs import LONGEST_S, cases, judged, run


@pytest.mark.timeout(900)
def test_bad_inputs_end_soon_with_an_error_of_two_sentences() -> None:
    outcomes = list(run(every=11))
    assert len(outcomes) >= 35
    assert [(one.name, one.complaints) for one in outcomes if one.complaints] == []


def test_there_are_two_hundred_and_no_two_are_called_the_same() -> None:
    names = [case.name for case in cases()]
    assert len(names) >= 200
    assert len(set(names)) == len(names)


SOUND = '{"error": {"code": "a-code", "what": "One sentence.", "remedy": "Another."}}'


@pytest.mark.parametrize(
    ("code", "stdout", "stderr"),
    [
        (None, SOUND, ""),
        (139, SOUND, ""),
        (0, "", ""),
        (2, "", "no error at all"),
        (2, SOUND, "Traceback (most recent call last):"),
        (2, SOUND.replace("One sentence.", "No full stop"), ""),
        (2, SOUND.replace("One sentence.", "PosixPath('x') is wrong."), ""),
        (2, SOUND.replace("a-code", "A Code"), ""),
    ],
)
def test_the_campaign_would_show_what_is_wrong(code: int | None, stdout: str, stderr: str, tmp_path: Path) -> None:
    case = Case("a case", lambda stage, folder: [])
    assert judged(case, 2, 1.0, SOUND, "", tmp_path).complaints == ()
    assert judged(case, code, LONGEST_S, stdout, stderr, tmp_path).complaints


def test_the_campaign_would_show_a_crash_report(tmp_path: Path) -> None:
    (tmp_path / "state" / "velatura").mkdir(parents=True)
    (tmp_path / "state" / "velatura" / "crash-1.txt").write_text("ZeroDivisionError")
    assert judged(Case("a case", lambda stage, folder: []), 2, 1.0, SOUND, "", tmp_path).complaints
