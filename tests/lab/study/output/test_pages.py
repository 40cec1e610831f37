"""Results on disk, and the pages that are written from them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from controller.core.errors import UsageError
from lab.study.catalogue import EXPERIMENTS, SCENES, chosen
from lab.study.output.drawing import LARGEST_BYTES, LabelledPicture, Line, encoded_webp, maps, plotted, strip
from lab.study.output.figures import figure
from lab.study.output.keeping import StoredStudy, read_result, read_study, save_result
from lab.study.output.pages import publish
from lab.study.output.words import DESCRIPTIONS, MISS_REASONS, description, miss_reason
from lab.study.subject.scenes import curved_object
from lab.study.values import Criterion, Experiment, Figure, Result, ResultTable


def result(value: float = 0.5) -> Result:
    return Result(
        (Criterion("at most 1", f"{value}", value <= 1), Criterion("a | b", "3", False, "because | of\nthis")),
        (ResultTable("rows", "Rows", ("name", "value"), (("one", np.float32(value)), ("two", float("nan")))),),  # type: ignore[arg-type]
        (Figure("dots", "Some dots.", np.zeros((20, 30, 3), np.uint8)),),
        "What it shows.",
    )


def experiment(name: str) -> Experiment:
    return Experiment(name, f"Title of {name}", "Paper 9", "it must show.", None, lambda subject: result())


def test_what_was_kept_is_read_again(tmp_path: Path) -> None:
    path, picture = save_result(tmp_path, experiment("alpha"), result(), {"size": "small"})
    kept = read_result(path)
    assert kept.criteria[1] == Criterion("a | b", "3", False, "because | of\nthis")
    assert kept.tables[0].rows == (("one", 0.5), ("two", None))
    assert kept.figures == ((picture.name, "Some dots."),)
    assert path.read_bytes() == save_result(tmp_path, experiment("alpha"), result(), {"size": "small"})[0].read_bytes()


def test_a_result_that_is_none_is_told(tmp_path: Path) -> None:
    path = tmp_path / "alpha.json"
    path.write_text("{}")
    with pytest.raises(UsageError, match="not a result of a study") as caught:
        read_result(path)
    assert caught.value.code == "study-result-unreadable"


def test_pages_hold_tables_pictures_and_what_is_missed(tmp_path: Path) -> None:
    both = [experiment("alpha"), experiment("beta")]
    made = save_result(tmp_path, both[0], result(), {"size": "small", "seed": 1})
    index = publish(made[:1], tmp_path / "pages", both)
    page = (tmp_path / "pages/alpha.md").read_text()
    assert "| a \\| b | 3 | **no** | because \\| of this |" in page
    assert "![Some dots.](pictures/alpha-dots.webp)" in page
    assert (tmp_path / "pages/pictures/alpha-dots.webp").stat().st_size > 0
    assert (tmp_path / "pages/data/alpha-rows.csv").read_text() == "seed,name,value\n1,one,0.5\n1,two,\n"
    assert "0 of 2 hold, 1 missed, 1 open" in index.read_text()
    assert "not done" in index.read_text()
    assert not (tmp_path / "pages/beta.md").exists()


def test_a_second_study_keeps_the_pages_of_the_first(tmp_path: Path) -> None:
    both = [experiment("alpha"), experiment("beta")]
    for one in both:
        folder = tmp_path / one.name
        folder.mkdir()
        publish(save_result(folder, one, result(), {})[:1], tmp_path / "pages", both)
    text = (tmp_path / "pages/README.md").read_text()
    assert "[Title of alpha](alpha.md)" in text
    assert "[Title of beta](beta.md)" in text
    assert "not done" not in text


def published(folder: Path, one: Experiment, seed: int, made: Result, **facts: object) -> StoredStudy:
    """The experiment as kept after this seed's result came, in a folder for each seed."""
    own = folder / f"seed-{seed}"
    own.mkdir(exist_ok=True)
    told = {"size": "small", "seed": seed, "code": "1", **facts}
    publish(save_result(own, one, made, told)[:1], folder / "pages", [one])
    return read_study(folder / f"pages/data/{one.name}.json")


def test_a_criterion_holds_only_if_it_holds_for_three_seeds(tmp_path: Path) -> None:
    alpha = experiment("alpha")
    for seed, holds in ((2, None), (1, None), (3, True)):
        kept = published(tmp_path, alpha, seed, result(0.1 * seed))
        assert kept.criteria[0].holds is holds
    assert kept.seeds == (1, 2, 3)
    assert kept.criteria[1].holds is False
    page = (tmp_path / "pages/alpha.md").read_text()
    assert "| at most 1 | 0.1 | 0.2 | 0.30000000000000004 | yes |" in page
    assert "seeds 1, 2, 3" in page
    assert "*Some dots. Seed 1.*" in page
    assert (tmp_path / "pages/data/alpha-rows.csv").read_text().splitlines()[0] == "seed,name,value"
    kept = published(tmp_path, alpha, 2, result(5.0))
    assert kept.criteria[0].holds is False
    assert "1 missed" not in (tmp_path / "pages/README.md").read_text()
    assert "at most 1: seed 1: 0.1; seed 2: 5.0; seed 3" in (tmp_path / "pages/README.md").read_text()


def test_one_seed_that_asks_less_than_the_others_leaves_a_criterion_open(tmp_path: Path) -> None:
    less = Result((Criterion("a | b", "3", False),), result().tables)
    for seed in (1, 2):
        published(tmp_path, experiment("alpha"), seed, result())
    kept = published(tmp_path, experiment("alpha"), 3, less)
    assert [one.holds for one in kept.criteria] == [None, False]


@pytest.mark.parametrize("other", [{"size": "medium"}, {"code": "2"}])
def test_results_of_another_size_or_version_are_not_mixed(tmp_path: Path, other: dict[str, str]) -> None:
    published(tmp_path, experiment("alpha"), 1, result())
    assert published(tmp_path, experiment("alpha"), 2, result(), **other).seeds == (2,)


def test_a_page_of_an_earlier_version_of_the_experiment_says_so(tmp_path: Path) -> None:
    alpha = experiment("alpha")
    published(tmp_path, alpha, 1, result())
    assert "earlier version" in (tmp_path / "pages/alpha.md").read_text()
    assert "; earlier version |" in (tmp_path / "pages/README.md").read_text()
    published(tmp_path, alpha, 1, result(), code=alpha.code_sha256())
    assert "earlier version" not in (tmp_path / "pages/alpha.md").read_text()


def test_a_figure_for_a_sentence_is_one_number_or_the_least_and_the_most_of_all_seeds(tmp_path: Path) -> None:
    kept = published(tmp_path, experiment("alpha"), 1, result(0.5))
    assert figure(kept, "rows", "one", "value", ".2f") == "0.50"
    kept = published(tmp_path, experiment("alpha"), 2, result(0.75))
    assert figure(kept, "rows", "one", "value", ".2f") == "0.50 to 0.75"
    for table, row, column in (("rows", "three", "value"), ("rows", "one", "weight"), ("columns", "one", "value")):
        with pytest.raises(KeyError):
            figure(kept, table, row, column, ".2f")


def test_an_experiment_done_again_leaves_the_files_of_one_with_a_longer_name(tmp_path: Path) -> None:
    both = [experiment("alpha"), experiment("alpha-six")]
    for one in (both[1], both[0], both[0]):
        publish(save_result(tmp_path, one, result(), {})[:1], tmp_path / "pages", both)
    pictures = {path.name for path in (tmp_path / "pages/pictures").iterdir()}
    assert pictures == {"alpha-dots.webp", "alpha-six-dots.webp"}
    assert (tmp_path / "pages/data/alpha-six-rows.csv").exists()


def test_a_table_with_a_row_too_long_is_refused() -> None:
    with pytest.raises(ValueError, match="2 cells"):
        ResultTable("t", "T", ("a", "b"), ((1, 2, 3),))


def test_pictures_stay_small() -> None:
    noise = np.random.default_rng(0).integers(0, 256, (600, 600, 3), dtype=np.uint8)
    assert len(encoded_webp(noise)) <= LARGEST_BYTES


def test_drawings_hold_what_is_drawn_and_are_the_same_each_time() -> None:
    one, again, other = (
        plotted([Line("a", [1.0, 2.0], [3.0, y])], x="x", y="y", marks={"m": ("y", 3.5)}) for y in (4.0, 4.0, 5.0)
    )
    assert (one == again).all()
    assert (one != other).any()
    empty, full = (maps({"a": np.full((4, 6), v, np.float32)}, low=0, high=1, label="l") for v in (np.nan, 1.0))
    assert (empty != full).any(axis=2).mean() > 0.2


def test_a_strip_holds_every_panel() -> None:
    panels = [LabelledPicture(str(value), np.full((10, 20, 3), value, np.uint8)) for value in (10, 60, 110)]
    picture = strip(panels, columns=2, width_px=404)
    assert picture.shape[1] == 404
    assert all((picture == value).all(axis=2).sum() > 1000 for value in (10, 60, 110))


def test_the_catalogue_is_consistent() -> None:
    names = [one.name for one in EXPERIMENTS]
    assert len(set(names)) == len(names)
    assert all(one.scene is None or one.scene in SCENES for one in EXPERIMENTS)
    assert all(len(one.code_sha256()) == 64 for one in EXPERIMENTS)
    assert [one.name for one in chosen(("residual-six",))] == ["residual-six"]
    assert not any(one.optional for one in chosen(()))
    with pytest.raises(UsageError, match="no experiment called nothing"):
        chosen(("nothing",))


def test_the_curved_object_is_a_mesh_that_faces_the_audience(tmp_path: Path) -> None:
    import trimesh

    curved_object(tmp_path / "object.ply", columns=31, rows=21)
    mesh: Any = trimesh.load(tmp_path / "object.ply", process=False)
    assert len(mesh.vertices) == 31 * 21
    assert (mesh.face_normals[:, 2] > 0).mean() == 1
    assert np.ptp(mesh.vertices[:, 1]) == pytest.approx(0.3, abs=1e-3)


def test_words_stand_apart_from_results_and_are_about_known_experiments() -> None:
    names = {one.name for one in EXPERIMENTS}
    assert set(DESCRIPTIONS) <= names
    assert {name for name, _ in MISS_REASONS} <= names
    assert "six" in description("residual-six")
    assert description("residual") != ""
    (name, begins), text = next(iter(MISS_REASONS.items()))
    assert miss_reason(name, f"{begins} and more") == text
    assert miss_reason(name, "something else") == ""
