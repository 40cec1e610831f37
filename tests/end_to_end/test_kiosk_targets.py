"""Uploads of every size on a real, calibrated kiosk; and appearances that can't be made, which stop no other."""

from __future__ import annotations

import os
import signal
import subprocess
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import expect

from controller.config.models import SolveTable
from controller.core.arrays import load_arrays
from controller.core.colour import srgb_to_linear
from controller.core.errors import UsageError, WorkError
from controller.kiosk.api.kiosk import StageKiosk
from controller.kiosk.preview.preview_light import view_picture
from controller.kiosk.service import Service
from controller.kiosk.state import Job
from controller.kiosk.store.event_log import EventLog
from controller.kiosk.values import Computed
from controller.optics.solve.request import solve_appearance
from controller.optics.solve.result.metrics import by_pixels, visible_object
from controller.optics.solve.targets.files import load_target
from controller.panel.uploads import Targets, UploadLimits
from controller.stage.artefacts.calibrated import Calibrated
from controller.stage.artefacts.geometry import read_geometry
from controller.stage.artefacts.solved import read_solved
from controller.stage.blender.job import own_paint
from controller.stage.blender.run import find_blender
from controller.stage.report.pictures import crop_around, to_screen
from controller.stage.sessions.calibrations import finished_calibration
from controller.stage.sessions.check import check_stage
from controller.stage.steps.appearance.solving import options_of
from tests.controller.panel.browser import CHROMIUM, chromium, enter, tab
from tests.controller.panel.served import served
from tests.controller.stage.blender.test_render import PAINT_SCENE
from tests.end_to_end.conftest import FinishedDemo
from tests.end_to_end.kiosk import copied, wait_for
from tests.end_to_end.test_targets import CAMERA_PX, grey_png
from tests.shared import made_once
from tests.waiting import meanwhile

pytestmark = [pytest.mark.long, pytest.mark.timeout(1500)]
LONG_MS = 800_000
HEAD = "\n[[appearances]]"


@pytest.fixture(scope="session")
def seen_stage(finished_demo: FinishedDemo, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo's, with what a kiosk keeps of its calibration for previews: that takes as long as a whole test.

    All workers share it: copy it.
    """

    def look(folder: Path) -> None:
        stage = copied(finished_demo.stage, folder / "stage")
        view_picture(stage, finished_calibration(stage), check_stage(stage).names)

    return made_once(tmp_path_factory, "seen", look)[0] / "stage"


@pytest.fixture
def kiosk(seen_stage: Path, tmp_path: Path) -> Iterator[StageKiosk]:
    """Over its service on the demo's calibration; a test moves it by hand, and no device is opened."""
    stage = copied(seen_stage, tmp_path / "stage")
    toml = stage / "stage.toml"
    # What the demo solved stays in every bundle; solving that again would test nothing here.
    toml.write_text(toml.read_text().partition(HEAD)[0] + f'{HEAD}\nname = "checkerboard"\nkind = "checkerboard"\n')
    log = EventLog(stage / EventLog.FILE, durable=False)
    kiosk = StageKiosk(stage)
    kiosk.attach(Service(check_stage(stage), log))
    yield kiosk
    kiosk.service.jobs.close(60)
    kiosk.detach()
    log.close()


def ended(kiosk: StageKiosk, job: Job) -> Job:
    """After its end was taken note of."""
    service, done = kiosk.service, threading.Event()

    def look() -> bool:
        service.reconciler.step()
        service.changed()
        known = kiosk.job(job.number)
        if known is not None and known.ended:
            # What follows from it is another test's.
            with_more = service.reconciler.working
            if with_more:
                kiosk.cancel()
            else:
                done.set()
        return done.is_set()

    wait_for(look)
    found = kiosk.job(job.number)
    assert found is not None
    return found


@contextmanager
def moved(kiosk: StageKiosk) -> Iterator[None]:
    """A thread moves its service, as that of ``velatura kiosk serve`` does."""

    def move() -> None:
        kiosk.service.reconciler.step()
        kiosk.service.changed()

    with meanwhile(move, every_s=0.05):
        yield


@pytest.mark.skipif(not CHROMIUM.exists(), reason="needs Debian's chromium (a package of the test set-up)")
def test_in_a_browser_an_upload_is_fitted_and_judged_and_a_bad_appearance_stays_in_sight(
    kiosk: StageKiosk, tmp_path: Path
) -> None:
    (tmp_path / "phone.png").write_bytes(grey_png(300, 100))
    (kiosk.stage / "small.png").write_bytes(grey_png(77, 52))
    with (kiosk.stage / "stage.toml").open("a") as toml:
        toml.write(f'{HEAD}\nname = "small"\nkind = "picture"\nfile = "small.png"\n')
    with (
        moved(kiosk),
        served(kiosk, tmp_path / "private") as panel,
        chromium() as browser,
        tab(browser, panel.address) as page,
    ):
        page.set_default_timeout(LONG_MS)
        enter(page, "otto")
        page.goto("/appearances/new")
        page.get_by_text("fill the view").click()
        page.set_input_files("#file", tmp_path / "phone.png")
        page.get_by_role("button", name="Upload").click()
        expect(page.locator(".headline")).to_be_visible(timeout=LONG_MS)
        found = kiosk.reach(panel.app.state.panel.targets.path(page.url.rpartition("/")[2]))
        assert page.locator(".headline b").inner_text() == f"{100 * found.share:.0f} %"
        legend = [int(text.split()[0]) for text in page.locator(".legend b").all_inner_texts()]
        assert abs(sum(legend) - 100) <= len(legend), "the whole object"
        for alt in (
            "The target on the object",
            "What the object will look like, calculated",
            "Map of what can't be reached",
        ):
            expect(page.get_by_alt_text(alt)).to_be_visible(timeout=LONG_MS)
            expect(page.get_by_alt_text(alt)).not_to_have_js_property("naturalWidth", 0)
        page.get_by_label("Name", exact=True).fill("phone")
        page.get_by_role("button", name="Compute").click()
        expect(page.locator(".failed")).to_contain_text("small was not solved: small.png is 77 x 52", timeout=LONG_MS)
        page.goto("/appearances")
        expect(page.get_by_role("heading", name="phone")).to_be_visible()
        expect(page.locator(".failed")).to_be_visible()
        page.goto("/")
        page.get_by_role("button", name="Confirm the failures").click()
        expect(page.locator(".failed")).to_have_count(0)


def test_an_upload_of_another_size_becomes_a_target_and_an_appearance(kiosk: StageKiosk, tmp_path: Path) -> None:
    (tmp_path / "phone.png").write_bytes(grey_png(77, 52))
    targets = Targets(tmp_path / "targets", UploadLimits(), fitted=kiosk.fitted)
    target = targets.path(targets.add(tmp_path / "phone.png", "fill"))
    picture = cv2.imread(str(target), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    assert picture.shape == (CAMERA_PX[1], CAMERA_PX[0], 4)
    found = kiosk.reach(target)
    assert 0.2 < found.share <= 1
    assert found.share + found.too_bright + found.too_dark + found.too_colourful <= 1.001
    assert {name: cv2.imread(str(file)) is None for name, file in found.pictures.items()} == dict.fromkeys(
        ("target", "result", "map"), False
    )
    assert kiosk.reach(target) == found, "it is kept"
    assert kiosk.reach(tmp_path / "phone.png").pictures["map"].is_file()
    job = ended(kiosk, kiosk.compute("phone", tmp_path / "phone.png"))
    assert not job.failed, job.outcome
    assert "phone" in [one.name for one in kiosk.appearances()]
    assert kiosk.snapshot().failures == ()


def test_a_preview_of_twelve_megapixels_costs_no_more_than_four_times_what_pillow_takes_to_fit_it(
    kiosk: StageKiosk, tmp_path: Path
) -> None:
    """In processor time, because other work on the machine changes that less, and by turns. An upload is read by a
    process of its own. The calibration's light is prepared, as it is when a person opens the page."""
    picture = cv2.resize(np.random.default_rng(1).integers(0, 255, (300, 400, 3), np.uint8), (4000, 3000))
    (tmp_path / "phone.jpg").write_bytes(cv2.imencode(".jpg", picture)[1].tobytes())
    kiosk.view()
    view_px = kiosk.view_px()
    assert view_px is not None
    targets = Targets(tmp_path / "targets", UploadLimits(), fitted=kiosk.fitted, view_px=kiosk.view_px)

    def fit() -> None:
        with Image.open(tmp_path / "phone.jpg") as phone:
            phone.convert("RGBA").resize(view_px, Image.Resampling.LANCZOS).save(tmp_path / "fitted.png")

    def preview() -> None:
        kiosk.reach(targets.path(targets.add(tmp_path / "phone.jpg")))

    preview()  # compiles, and loads libraries
    spent = [(spent_s(preview), spent_s(fit)) for _ in range(3)]
    assert min(ours for ours, _ in spent) <= 4 * min(pillows for _, pillows in spent), spent


def spent_s(work: Callable[[], None]) -> float:
    """Processor time of this process and of those that it has waited for."""
    before = os.times()
    work()
    return sum(os.times()[:4]) - sum(before[:4])


def test_an_upload_is_wrapped_around_the_object_as_an_appearance_of_stage_toml_is(
    kiosk: StageKiosk, finished_demo: FinishedDemo, tmp_path: Path
) -> None:
    """The demo solved the same photograph as an appearance of its own; what the solver was asked for is the judge."""
    targets = Targets(tmp_path / "targets", UploadLimits(), fitted=kiosk.fitted, view_px=kiosk.view_px)
    picture = cv2.imread(str(targets.path(targets.add(kiosk.stage / "photograph.png", "wrap"))), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    assert picture.shape == (CAMERA_PX[1], CAMERA_PX[0], 4)
    assert 0.05 < (picture[..., 3] > 0).mean() < 0.9, "all else stays dark"
    run = finished_calibration(kiosk.stage)
    wanted = read_solved(run, "photograph", kiosk.service.checked.names).requested.target
    inside = (picture[..., 3] > 0) & (wanted.max(axis=2) > 0)
    made = srgb_to_linear(picture[..., 2::-1])[inside].mean(axis=1)
    assert np.corrcoef(made, wanted[inside].mean(axis=1))[0, 1] > 0.98


def test_a_scene_is_looked_at_on_the_object_before_it_is_computed(kiosk: StageKiosk) -> None:
    """Of a scene of the stage's own in which the object shines in its own paint, so that the paint is the judge."""
    own = kiosk.stage / "scenes" / "paint.blend"
    own.parent.mkdir()
    maker = kiosk.stage / "make.py"
    maker.write_text(PAINT_SCENE)
    subprocess.run([find_blender().command[0], str(maker), str(own)], check=True, timeout=120)
    assert [(one.name, one.preview) for one in kiosk.scenes() if not one.shipped] == [("paint.blend", None)]
    found = kiosk.scene_reach("paint.blend")
    assert 0.2 < found.share <= 1
    assert kiosk.scene_reach("paint.blend") == found, "it is kept"
    assert {one.name: one.preview for one in kiosk.scenes()}["paint.blend"] == found.pictures["result"]
    calibrated = Calibrated(finished_calibration(kiosk.stage), kiosk.service.checked.names)
    paint = own_paint(read_geometry(calibrated.folder, calibrated.projectors), calibrated.transport.reach())
    seen = load_arrays(kiosk.stage / "kiosk" / "scenes" / "scene-paint.blend.npz")
    rows, columns = seen["mask"].shape
    # The paint is 0.02 where the object's shape is not known.
    painted = (paint.mean(axis=2) > 0.05).astype(np.float32)
    known = np.asarray(cv2.resize(painted, (columns, rows), interpolation=cv2.INTER_AREA)) > 0.99
    paint = cv2.resize(paint.mean(axis=2), (columns, rows), interpolation=cv2.INTER_AREA)
    # Without its edge, where samples of the object and of the room are mixed.
    inside = known & (cv2.erode(seen["mask"].astype(np.uint8), np.ones((5, 5), np.uint8)) > 0)
    assert np.corrcoef(seen["image"].mean(axis=2)[inside], paint[inside])[0, 1] > 0.95
    with pytest.raises(UsageError, match="made in another way"):
        kiosk.compute_scene("checkerboard", "gold")
    job = ended(kiosk, kiosk.compute_scene("painted", "paint.blend"))
    assert not job.failed, job.outcome
    assert "painted" in [one.name for one in kiosk.appearances()]
    assert 'kind = "blender"\nscene = "scenes/paint.blend"' in kiosk.settings()


def test_an_outline_keeps_the_light_of_an_appearance_inside_it(kiosk: StageKiosk, tmp_path: Path) -> None:
    view = cv2.imread(str(kiosk.view()))
    assert view is not None
    assert view.shape == (CAMERA_PX[1], CAMERA_PX[0], 3)
    (tmp_path / "whole.png").write_bytes(grey_png(*CAMERA_PX))
    targets = Targets(tmp_path / "targets", UploadLimits(), fitted=kiosk.fitted)
    key = targets.add(tmp_path / "whole.png", "fill")
    targets.restrict(key, "[[[0, 0], [0.5, 0], [0.5, 1], [0, 1]]]")
    job = ended(kiosk, kiosk.compute("half", targets.path(key)))
    assert not job.failed, job.outcome
    (preview,) = (one.preview for one in kiosk.appearances() if one.name == "half")
    assert preview is not None
    picture = cv2.imread(str(preview))
    assert picture is not None
    middle = picture.shape[1] // 2
    inside, outside = picture[:, : middle - 8], picture[:, middle + 8 :]
    assert np.quantile(inside, 0.9) > 40
    assert np.quantile(outside, 0.9) < 0.3 * np.quantile(inside, 0.9)


def test_a_bad_appearance_stops_no_other_and_stays_in_sight_until_it_was_seen(
    kiosk: StageKiosk, tmp_path: Path
) -> None:
    (tmp_path / "good.png").write_bytes(grey_png(*CAMERA_PX))
    (kiosk.stage / "small.png").write_bytes(grey_png(77, 52))
    with (kiosk.stage / "stage.toml").open("a") as toml:
        toml.write(f'{HEAD}\nname = "small"\nkind = "picture"\nfile = "small.png"\n')
    job = ended(kiosk, kiosk.compute("good", tmp_path / "good.png"))
    assert not job.failed, job.outcome
    assert "good" in [one.name for one in kiosk.appearances()]
    assert "small was not solved: small.png is 77 x 52 pixels" in job.outcome
    (failure,) = kiosk.snapshot().failures
    assert (failure.code, failure.level) == ("appearance-failed", "error")
    again = EventLog(kiosk.stage / EventLog.FILE, durable=False)
    assert again.failures == (failure,), "a new start shows it, too"
    again.close()
    kiosk.seen(failure.number)
    assert kiosk.snapshot().failures == ()


def test_a_new_appearance_that_can_not_be_solved_is_taken_out_of_stage_toml(kiosk: StageKiosk, tmp_path: Path) -> None:
    (tmp_path / "cut.png").write_bytes(grey_png(*CAMERA_PX))
    job = kiosk.compute("cut", tmp_path / "cut.png")
    (kiosk.stage / "appearances" / "cut.png").write_bytes(b"the disk lost it")
    found = ended(kiosk, job)
    assert found.failed
    assert "cut was not solved" in found.outcome
    assert "cut" not in kiosk.settings()
    assert "checkerboard" in [one.name for one in kiosk.appearances()]


def test_a_preview_shows_what_the_computation_will_make(kiosk: StageKiosk, tmp_path: Path) -> None:
    """Mesa's lavapipe; the judge is the processor, at all pixels. The end of the process that solves, by a driver or
    for a job, is none of the kiosk's.
    """
    target = tmp_path / "squares.png"
    rows, columns = np.indices((CAMERA_PX[1], CAMERA_PX[0])) // 40
    cv2.imwrite(str(target), np.where(((rows + columns) % 2)[..., None], (90, 120, 150), (150, 110, 80)))
    solves_on(kiosk, "gpu")
    with ThreadPoolExecutor(1) as other:
        looking = other.submit(kiosk.computed, target)
        wait_for(lambda: bool(preview_processes()))
        os.kill(preview_processes()[0], signal.SIGKILL)
        assert code_of(looking.result) == "preview-ended"
    found = kiosk.computed(target)
    assert kiosk.computed(target) == found, "it is kept"
    agrees_with_the_processor(found, kiosk, target)
    assert len(preview_processes()) == 1, "it stays for the next target"
    job = kiosk.compute("squares", target)
    wait_for(lambda: kiosk.service.jobs.running is not None or moved_once(kiosk))
    assert code_of(lambda: kiosk.computed(tmp_path / "squares.png")) == "preview-ended"
    assert preview_processes() == []
    kiosk.cancel()
    ended(kiosk, job)
    solves_on(kiosk, "cpu")
    on_processor = kiosk.computed(target)
    assert on_processor.device == "processor"
    agrees_with_the_processor(on_processor, kiosk, target)


def agrees_with_the_processor(found: Computed, kiosk: StageKiosk, target: Path) -> None:
    names, options = kiosk.service.checked.names, options_of(SolveTable())
    calibrated = Calibrated(finished_calibration(kiosk.stage), names)
    black, transport = calibrated.calibration.black, calibrated.transport
    made = solve_appearance(calibrated.light, load_target(target, CAMERA_PX), options)
    seen = calibrated.predicted_light(made.frames) + black
    exposure, whole = float(made.figures["exposure"] or 0), visible_object(transport.object_mask)
    judged = by_pixels(
        seen, made.asked, calibrated.calibration.camera_to_xyz, exposure, reachable=made.asked_reachable,
        valid=made.valid, lit=transport.object_mask,
    )  # fmt: skip
    assert found.delta_e == pytest.approx(judged["visible"].delta_e00_median, rel=0.02)
    assert found.in_reach == pytest.approx(judged["in_reach"].delta_e00_median, rel=0.02)
    assert found.in_reach_share == pytest.approx(1 - judged["in_reach"].left_out_share, abs=1e-3)
    picture, box = cv2.imread(str(found.pictures["result"])), crop_around(whole)
    assert picture is not None
    wanted = to_screen(seen, calibrated.calibration.camera_to_xyz, white=exposure)[box.rows, box.columns, ::-1]
    inside = cv2.erode(whole.astype(np.uint8), np.ones((9, 9), np.uint8))[box.rows, box.columns] > 0
    assert np.abs(picture.astype(int) - wanted)[inside].mean() < 3, "but for the compression as JPEG"


def moved_once(kiosk: StageKiosk) -> bool:
    kiosk.service.reconciler.step()
    kiosk.service.changed()
    return False


def code_of(call: Callable[[], object]) -> str:
    with pytest.raises(WorkError) as caught:
        call()
    return caught.value.code


def solves_on(kiosk: StageKiosk, device: str) -> None:
    """A new service with this device, as after a change of stage.toml."""
    toml = kiosk.stage / "stage.toml"
    text = toml.read_text()
    toml.write_text(text.partition("\n[solve]")[0] + f'\n[solve]\ndevice = "{device}"\n')
    log = kiosk.service.log
    kiosk.detach()
    kiosk.attach(Service(check_stage(kiosk.stage), log))


def preview_processes() -> list[int]:
    """This process's own."""
    found = []
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            parent = int(status.read_text().rpartition(")")[2].split()[1])
            command = (status.parent / "cmdline").read_bytes()
        except OSError:
            continue  # it has ended
        if parent == os.getpid() and b"kiosk.preview.computing" in command:
            found.append(int(status.parent.name))
    return found
