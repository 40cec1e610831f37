"""What the store finds in bundles: pictures for the panel, and frames for a stage that lost a projector."""

from __future__ import annotations

import os
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given

from controller.bundle.describe import png
from controller.bundle.install import install
from controller.bundle.reader import Bundle
from controller.bundle.signing import Trust
from controller.bundle.writer import NewAppearance, NewBundle, write_bundle
from controller.core.errors import WorkError
from controller.core.storage import write_atomically
from controller.kiosk.store import bundle_store as stock_module
from controller.kiosk.store.bundle_store import PREVIEWS, UNREAD_S, BundleStore, slots_without
from tests.controller.stage.artefacts.names import projectors as stages

UNSIGNED = Trust((), allow_unsigned=True)


def installed(stage: Path, revision: int, names: tuple[str, ...], slots: Path | None = None) -> int:
    """A bundle in which all but the last appearance have a picture, all of one grey; that grey."""
    picture = png(np.full((4, 6, 3), 10 * revision, np.uint8))
    frames = {"P1": np.zeros((8, 8, 3), np.uint8)}
    made = [NewAppearance(name, frames, thumbnail=None if name == names[-1] else picture) for name in names]
    write_bundle(
        stage / "made.vel",
        NewBundle(stage="demo", calibration="one", created_unix_s=1, outputs=[("P1", 8, 8)], revision=revision),
        appearances=made,
        key=None,
    )
    install(stage / "made.vel", slots or stage / "bundles", trusted=(), allow_unsigned=True)
    return 10 * revision


def grey_of(file: Path) -> int:
    """Of a picture that is a few bytes, as a browser likes it."""
    assert file.stat().st_size < 1000
    picture = cv2.imread(str(file))
    assert picture is not None
    assert picture.shape == (4, 6, 3)
    return round(float(picture.mean()))


def test_each_appearance_has_the_picture_of_its_own_bundle_or_none(tmp_path: Path) -> None:
    bundles = BundleStore(tmp_path, UNSIGNED)
    assert bundles.previews() == {}
    first = installed(tmp_path, 1, ("marble", "a name with spaces", "bare"))
    found = bundles.previews()
    assert sorted(found) == ["a name with spaces", "marble"]
    assert {grey_of(file) for file in found.values()} == {first}
    second = installed(tmp_path, 2, ("marble", "bare"))
    assert {name: grey_of(file) for name, file in bundles.previews().items()} == {"marble": second}
    assert len(list((tmp_path / PREVIEWS).iterdir())) == 1, "those of the bundle before are gone"


def test_a_disk_that_takes_nothing_costs_the_pictures_alone(tmp_path: Path) -> None:
    installed(tmp_path, 1, ("marble", "bare"))
    (tmp_path / "kiosk").write_text("a file where a folder should be")
    assert BundleStore(tmp_path, UNSIGNED).previews() == {}


def test_frames_without_a_projector_serve_what_they_hold(tmp_path: Path) -> None:
    installed(tmp_path, 1, ("marble", "bare"))
    bundles = BundleStore(tmp_path, UNSIGNED)
    assert bundles.without({"left"}, "marble") is None
    installed(tmp_path, 1, ("marble",), slots_without(tmp_path, {"left"}))
    assert bundles.without({"left"}, "marble") is not None
    assert bundles.without({"left"}, "bare") is None


def test_pictures_that_the_disk_did_not_take_are_made_when_there_is_space_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    installed(tmp_path, 1, ("marble", "wood", "bare"))
    failures = [WorkError("no-space", what="The disk is full.", remedy="Free some.")]

    def write(path: Path, data: bytes) -> None:
        if path.name == "1.jpg" and failures:
            raise failures.pop()
        write_atomically(path, data)

    monkeypatch.setattr(stock_module, "write_atomically", write)
    bundles = BundleStore(tmp_path, UNSIGNED)
    bundles.previews()
    assert not failures
    assert sorted(bundles.previews()) == ["marble", "wood"]


def test_what_is_read_while_others_are_forgotten_is_known(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    installed(tmp_path, 1, ("marble", "bare"))
    bundles, close = BundleStore(tmp_path, UNSIGNED), Bundle.close

    def closing(bundle: Bundle) -> None:
        close(bundle)
        for number in range(66):  # another thread, months later: one after the other of these is installed
            bundles.index(tmp_path / f"{number}.vel")

    monkeypatch.setattr(Bundle, "close", closing)
    assert list(bundles.names()) == ["marble", "bare"]


@given(stages)
def test_every_set_of_lost_projectors_has_a_folder_of_its_own_inside_the_stage(names: list[str]) -> None:
    sets = [some for count in range(1, len(names) + 1) for some in combinations(names, count)]
    folders = {slots_without(Path("stage"), some) for some in sets}
    assert len(folders) == len(sets)
    for folder in folders:
        assert Path(os.path.normpath(folder)).parent == Path("stage") / "bundles-without"
        assert len(folder.name.encode()) <= 255


def test_a_bundle_that_could_not_be_read_for_a_moment_is_read_again(tmp_path: Path) -> None:
    installed(tmp_path, 1, ("marble", "bare"))
    now_s = [100.0]
    bundles = BundleStore(tmp_path, UNSIGNED, lambda: now_s[0])
    file = bundles.bundle()
    assert file is not None
    content = file.read_bytes()
    file.write_bytes(b"")
    assert bundles.names() == ()
    file.write_bytes(content)
    assert bundles.names() == ()
    now_s[0] += UNREAD_S
    assert sorted(bundles.names()) == ["bare", "marble"]
