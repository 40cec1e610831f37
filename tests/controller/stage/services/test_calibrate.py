from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from controller.bundle.signing import generate_key
from controller.config import write_stage
from controller.core.errors import UsageError
from controller.core.storage import exclusive
from controller.demo import demo
from controller.run.journal import Journal
from controller.run.progress import Reporter, Silent
from controller.run.step_id import StepId
from controller.stage.artefacts.names import write_json
from controller.stage.artefacts.projectors import Light
from controller.stage.artefacts.views import view_folders
from controller.stage.services.calibrate import AppearanceOrder, calibrate, make_appearances
from controller.stage.services.play import PlayRequest, play
from controller.stage.sessions.calibrations import KEY_FILE, finished_calibration, output_sizes, signing_key
from controller.stage.sessions.check import Checked, check_stage
from controller.stage.sessions.run import LOCK
from controller.stage.sessions.session import OwnSession, StageWork


@pytest.fixture
def stage(tmp_path: Path) -> Path:
    write(tmp_path)
    return tmp_path


def write(
    folder: Path, *, trusted: Sequence[str] = (), unsigned: bool = False, outputs: Sequence[str] = ("P1", "P2")
) -> None:
    projectors = [
        {"name": name, "output": output, "driver": "serial", "profile": "optoma-later", "port": name}
        for name, output in (("left", "P2"), ("right", "P1"))
    ]
    write_stage(
        folder / "stage.toml",
        {
            "stage": {"name": "services"},
            "projectors": projectors,
            "camera": {"driver": "ptp", "address": "ptpip:127.0.0.1", "iso": 100, "focal_length_px": 500.0},
            "display": {
                "driver": "player",
                "outputs": [{"name": n, "width_px": 10 + k, "height_px": 20 + k} for k, n in enumerate(outputs)],
            },
            "bundle": {"trusted_keys": list(trusted), "allow_unsigned": unsigned},
            "appearances": [{"name": "shine", "kind": "gloss"}],
        },
    )


def run(stage: Path, name: str, *steps: str) -> Path:
    folder = stage / "runs" / name
    with Journal(folder) as journal:
        for step in steps:
            journal.complete(StepId(step), {}, [], began_at_s=time.time())
    return folder


def test_the_newest_finished_calibration_counts_whatever_was_begun_since(stage: Path) -> None:
    run(stage, "20260101-000000-calibrate", "calibrated")
    newest = run(stage, "20260102-000000-demo", "exposure", "calibrated")
    run(stage, "20260103-000000-calibrate", "exposure")
    run(stage, "20260104-000000-play", "play")
    (stage / "runs" / "20260105-000000-calibrate").mkdir()
    assert finished_calibration(stage) == newest


def test_a_stage_without_a_finished_calibration_says_so(stage: Path) -> None:
    run(stage, "20260103-000000-calibrate", "exposure")
    with pytest.raises(UsageError, match="velatura calibrate") as wrong:
        finished_calibration(stage)
    assert wrong.value.code == "not-calibrated"


def test_outputs_are_listed_as_the_display_has_them(stage: Path) -> None:
    sizes = output_sizes(check_stage(stage))
    assert list(sizes.items()) == [("right", ("P1", (10, 20))), ("left", ("P2", (11, 21)))]


def test_real_windows_must_be_written_down_before_anything_is_published(stage: Path) -> None:
    write(stage, outputs=())
    with pytest.raises(UsageError, match="'outputs' is missing"):
        output_sizes(check_stage(stage))


def test_the_stages_own_key_signs_if_the_stage_trusts_it(stage: Path) -> None:
    public = generate_key(stage / KEY_FILE).hex()
    write(stage, trusted=[public])
    assert signing_key(check_stage(stage)) == stage / KEY_FILE
    write(stage, trusted=["00" * 32])
    with pytest.raises(UsageError, match="not trusted"):
        signing_key(check_stage(stage))


def test_without_a_key_bundles_are_unsigned_only_if_the_stage_says_so(stage: Path) -> None:
    with pytest.raises(UsageError, match="velatura bundle key") as wrong:
        signing_key(check_stage(stage))
    assert wrong.value.code == "no-signing-key"
    write(stage, unsigned=True)
    assert signing_key(check_stage(stage)) is None


def test_solving_is_refused_while_the_stage_is_at_work(stage: Path) -> None:
    with exclusive(stage / LOCK, what_is_running="Another"), pytest.raises(UsageError) as refused:
        make_appearances(
            AppearanceOrder(names=()), session=OwnSession(stage), reporter=Silent(), cancel=threading.Event()
        )
    assert refused.value.code == "already-running"


def test_what_solves_is_as_typed_or_as_the_stage_says(stage: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(device: str | None) -> str:
        with pytest.raises(UsageError) as error:
            make_appearances(
                AppearanceOrder(names=(), device=device),
                session=OwnSession(stage),
                reporter=Silent(),
                cancel=threading.Event(),
            )
        return error.value.code

    assert refused("tpu") == "solve-device-unknown"
    assert refused("cpu") == "not-calibrated", "that was accepted"
    with (stage / "stage.toml").open("a") as file:
        file.write('\n[solve]\ndevice = "gpu"\n')
    # as if the extra were not installed
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert refused(None) == "extra-missing"
    assert refused("auto") == "not-calibrated"
    with pytest.raises(UsageError) as error:
        demo(stage, reporter=Silent(), cancel=threading.Event())
    assert error.value.code == "extra-missing", "the demo, too, and before its devices are started"


def test_playing_without_a_bundle_is_refused_before_any_device_is_opened(stage: Path) -> None:
    with pytest.raises(UsageError) as refused:
        play(
            PlayRequest(names=("shine",), sequence=None, seconds=1, fade_s=0, repeat=1),
            session=OwnSession(stage),
            reporter=Silent(),
            cancel=threading.Event(),
        )
    assert refused.value.code == "nothing-installed"
    assert not (stage / "runs").exists()


class Alone(OwnSession):
    """Photographs nothing: notes the work that it is given, and puts a whole calibration there."""

    def run(self, checked: Checked, work: StageWork, *, reporter: Reporter, cancel: threading.Event) -> Path:
        assert work.place is not None
        assert not work.views
        name, folder = work.place
        (folder / "captures").mkdir(parents=True)
        described(folder, name)
        return folder


def described(folder: Path, name: str) -> None:
    """The white of a projector in a folder: a picture that depends on the view's name."""
    write_json(folder / "geometry.json", {"projectors": {"left": {}, "right": {}}})
    white = np.random.default_rng(len(name)).random((8, 12, 3), np.float32)
    for projector in ("left", "right"):
        Light(np.zeros((3, 256)), np.eye(3), white, np.zeros_like(white), np.eye(3)).write(folder, projector)


def photographed(stage: Path, view: str) -> None:
    calibrate(session=Alone(stage), reporter=Silent(), cancel=threading.Event(), view=view)


@pytest.fixture
def calibrated(stage: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr("controller.stage.services.calibrate.join_geometry", lambda *_: False)
    monkeypatch.setattr("controller.stage.services.calibrate.changed_lamps", lambda *_: [])
    monkeypatch.setattr("controller.stage.services.calibrate.photographs_sentence", lambda *_: "")
    folder = run(stage, "20261129-120000-calibrate", "calibrated")
    described(folder, "camera")
    return folder


def test_a_place_to_which_the_only_camera_was_carried_is_added_to_the_newest_calibration(
    stage: Path, calibrated: Path
) -> None:
    photographed(stage, "from the left")
    assert view_folders(calibrated) == {"camera": calibrated, "from the left": calibrated / "views" / "from the left"}


def test_a_view_that_is_whole_is_replaced_by_the_new_one_only_at_the_end(stage: Path, calibrated: Path) -> None:
    photographed(stage, "side")
    (calibrated / "views" / "side" / "old").touch()
    photographed(stage, "side")
    assert list(view_folders(calibrated)) == ["camera", "side"]
    assert [path.name for path in (calibrated / "views").iterdir()] == ["side"]
    assert not (calibrated / "views" / "side" / "old").exists()


@pytest.mark.parametrize(("view", "code"), [("camera", "view-is-first"), ("../other", "view-unknown")])
def test_a_view_that_can_not_be_added_is_refused_before_anything_is_photographed(
    stage: Path, calibrated: Path, view: str, code: str
) -> None:
    with pytest.raises(UsageError) as error:
        photographed(stage, view)
    assert error.value.code == code
    assert not (calibrated / "views").exists()


def test_without_a_calibration_no_view_is_added(stage: Path) -> None:
    with pytest.raises(UsageError) as error:
        photographed(stage, "side")
    assert error.value.code == "not-calibrated"
