"""Which views a run has, and where their files are."""

from pathlib import Path

import pytest

from controller.stage.artefacts.grade import FIGURES, errors_by_view, worst_letter, worst_of, worst_view
from controller.stage.artefacts.names import write_json
from controller.stage.artefacts.views import (
    first_view,
    is_whole,
    reopen_view,
    view_folder,
    view_folders,
    write_view,
)


def test_a_run_of_one_camera_is_its_only_view(tmp_path: Path) -> None:
    assert view_folders(tmp_path) == {"camera": tmp_path}


def test_views_stand_in_the_stages_order_and_the_first_is_the_run_itself(tmp_path: Path) -> None:
    write_view(tmp_path, "front", 0)
    for number, name in ((2, "a"), (1, "z")):
        view_folder(tmp_path, name).mkdir(parents=True)
        write_view(view_folder(tmp_path, name), name, number)
    assert list(view_folders(tmp_path).items()) == [
        ("front", tmp_path),
        ("z", tmp_path / "views" / "z"),
        ("a", tmp_path / "views" / "a"),
    ]


def test_a_view_that_is_not_whole_is_not_listed(tmp_path: Path) -> None:
    folder = view_folder(tmp_path, "back")
    folder.mkdir(parents=True)
    (folder / "exposure.json").write_text("{}")
    assert not is_whole(folder)
    assert list(view_folders(tmp_path)) == ["camera"]
    write_view(folder, "back", 1)
    assert list(view_folders(tmp_path)) == ["camera", "back"]
    reopen_view(folder)
    assert list(view_folders(tmp_path)) == ["camera"]


def test_the_worst_view_and_projector_are_of_all_views(tmp_path: Path) -> None:
    write_view(tmp_path, "front", 0)
    folder = view_folder(tmp_path, "back")
    folder.mkdir(parents=True)
    write_view(folder, "back", 1)
    assert worst_of(tmp_path) is None
    assert worst_view(tmp_path) == ("front", tmp_path)
    write_json(tmp_path / FIGURES, {"left": {"relative_rms": 0.02}, "right": {"relative_rms": 0.03}})
    write_json(folder / FIGURES, {"left": {"relative_rms": 0.05}, "right": {"relative_rms": 0.01}})
    assert worst_of(tmp_path) == ("left", 5.0)
    assert worst_view(tmp_path) == ("back", folder)
    write_json(tmp_path / FIGURES, {"left": {"relative_rms": 0.06}, "right": {"relative_rms": 0.0}})
    assert worst_view(tmp_path) == ("front", tmp_path)


@pytest.mark.parametrize(("share", "worst", "grade"), [(0.02, ("right", 3.0), "B"), (0.5, ("left", 50.0), "D")])
def test_light_that_only_grazes_what_a_view_sees_counts_as_little_as_it_gives(
    tmp_path: Path, share: float, worst: tuple[str, float], grade: str
) -> None:
    write_view(tmp_path, "front", 0)
    folder = view_folder(tmp_path, "back")
    folder.mkdir(parents=True)
    write_view(folder, "back", 1)
    right = {"relative_rms": 0.03, "light_share": 0.5}
    write_json(tmp_path / FIGURES, {"left": {"relative_rms": 0.01, "light_share": 0.5}, "right": right})
    write_json(folder / FIGURES, {"left": {"relative_rms": 0.5, "light_share": share}, "right": right})
    assert worst_of(tmp_path) == pytest.approx(worst)
    assert worst_letter(tmp_path) == grade
    assert errors_by_view(tmp_path)["back"] == pytest.approx({"left": 100 * share, "right": 3.0})


def test_any_name_has_a_folder_of_its_own(tmp_path: Path) -> None:
    names = ["..", ".", "links", "Rückseite", "50 %", "x" * 300]
    for number, name in enumerate(names, start=1):
        folder = view_folder(tmp_path, name)
        assert folder.parent == tmp_path / "views"
        folder.mkdir(parents=True)
        write_view(folder, name, number)
    assert list(view_folders(tmp_path)) == ["camera", *names]
    assert first_view(tmp_path) == "camera"
