"""Previews of whole solves; tests/end_to_end/test_kiosk_targets.py has a real stage and Mesa's lavapipe."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from controller.core.errors import VelaturaError
from controller.kiosk.preview import computed
from controller.kiosk.preview.computed import ComputedPreviews
from controller.stage.sessions.check import check_stage
from tests.controller.kiosk.vase import TEXT, graded_run, vase


def a_stage(folder: Path, device: str) -> Path:
    stage = vase(folder)
    (stage / "stage.toml").write_text(f'{TEXT}\n[solve]\ndevice = "{device}"\n')
    graded_run(stage, "20260101-100000-calibrate", {"left": 0.01})
    (stage / "target.png").write_bytes(b"any")
    return stage


@pytest.mark.parametrize(("device", "code"), [("cpu", "array-file-unreadable"), ("gpu", "no-graphics-processor")])
def test_an_error_of_the_other_process_keeps_its_code_and_its_sentences(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, device: str, code: str
) -> None:
    """The run has a grade, and none of its arrays. Vulkan's loader finds no driver here."""
    monkeypatch.setenv("VK_DRIVER_FILES", str(tmp_path / "none.json"))
    monkeypatch.setenv("VK_ICD_FILENAMES", str(tmp_path / "none.json"))
    stage = a_stage(tmp_path / "stage", device)
    previews = ComputedPreviews()
    try:
        with pytest.raises(VelaturaError) as caught:
            previews.of(check_stage(stage), stage / "target.png")
        assert caught.value.code == code
    finally:
        previews.end()


def test_the_process_that_has_begun_to_read_answers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    begun: list[subprocess.Popen[str]] = []

    def counted(*args: Any, **options: Any) -> subprocess.Popen[str]:
        begun.append(start(*args, **options))
        return begun[-1]

    start = subprocess.Popen
    monkeypatch.setattr(subprocess, "Popen", counted)
    stage = a_stage(tmp_path / "stage", "cpu")
    checked, target, previews = check_stage(stage), stage / "target.png", ComputedPreviews()
    try:
        previews.begin(checked, target)
        assert len(begun) == 1
        with pytest.raises(VelaturaError, match="array"):
            previews.of(checked, target)
        assert len(begun) == 1
    finally:
        previews.end()
    assert begun[0].returncode is not None


@pytest.mark.parametrize(("does", "code"), [("print(flush=True)", "array-file-unreadable"), ("pass", "preview-slow")])
def test_a_solve_may_take_long_but_not_without_a_word(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, does: str, code: str
) -> None:
    """Another program in its place: for 4.5 s, in which it says that it continues, or nothing."""
    error = {"error": {"usage": False, "code": "array-file-unreadable", "what": "No.", "remedy": "Look."}}
    program = tmp_path / "python"
    program.write_text(
        f"#!{sys.executable}\nimport json, time\ninput(), input(), print(flush=True)\n"
        f"for _ in range(15):\n    time.sleep(0.3)\n    {does}\nprint(json.dumps({error}))\n"
    )
    program.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(program))
    monkeypatch.setattr(computed, "SILENT_S", 3.0)
    stage = a_stage(tmp_path / "stage", "cpu")
    previews = ComputedPreviews()
    with pytest.raises(VelaturaError) as caught:
        previews.of(check_stage(stage), stage / "target.png")
    assert caught.value.code == code
    previews.end()
