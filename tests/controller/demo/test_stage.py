"""The demo's stage: whole or not at all, and found again by the same options."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from controller import demo as module
from controller.config import load_stage
from controller.core.errors import UsageError, VelaturaError, WorkError
from controller.demo import BUILDING, DEFAULT_ROOM, MARK, DemoStage, prepare
from hal.errors import DeviceError

TABLES = {
    "projectors": [{"name": "left", "output": "P1", "driver": "serial"}],
    "camera": {"driver": "ptp", "iso": 100, "focal_length_px": 500.0},
    "display": {"driver": "player", "outputs": [{"name": "P1", "width_px": 4, "height_px": 3}]},
}


class ModelBench:
    """Writes one file, and fails after that if asked to."""

    def __init__(self) -> None:
        self.prepared: list[Path] = []
        self.settings: list[Mapping[str, Any]] = []
        self.error: BaseException | None = None

    def prepare(self, stage: Path, *, size: str, object_file: Path | None, seed: int) -> Mapping[str, Any]:
        self.prepared.append(stage)
        stage.mkdir(parents=True)
        (stage / "bench.toml").write_text(f"seed = {seed}")
        if self.error is not None:
            raise self.error
        return TABLES

    def serve(self, stage: Path, *, json_lines: bool) -> int:
        return 0


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> ModelBench:
    bench = ModelBench()

    def bench_of(stage: Path, settings: Mapping[str, Any]) -> ModelBench:
        bench.settings.append(settings)
        return bench

    monkeypatch.setattr(module, "bench_of", bench_of)
    return bench


def prepared(out: Path, *, size: str = "small", seed: int = 1, thing: Path | str | None = None, **more: Any) -> Path:
    return prepare(out, DemoStage(size, seed, None if thing is None else str(thing), **more))


def test_it_writes_a_stage_that_reads_and_signs_with_a_private_key(bench: ModelBench, tmp_path: Path) -> None:
    stage = prepared(tmp_path / "out")
    tables = load_stage(stage).tables
    assert [one.name for one in tables.appearances] == ["photograph", "new-pattern", "checkerboard", "gloss"]
    assert (stage / "photograph.png").read_bytes().startswith(b"\x89PNG")
    key = stage / "keys" / "stage.key"
    assert key.stat().st_mode & 0o077 == 0
    public = (stage / "keys" / "stage.key.pub").read_text().split()[1]
    assert tables.bundle.trusted_keys == (public,)
    assert tomllib.loads((stage / "stage.toml").read_text())["stage"]["name"] == "demo small"
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["stage"]


def test_the_same_options_find_it_again_and_others_are_refused(bench: ModelBench, tmp_path: Path) -> None:
    mesh = tmp_path / "mesh.obj"
    mesh.write_text("v 0 0 0")
    stage = prepared(tmp_path / "out", thing=mesh)
    key = (stage / "keys" / "stage.key").read_bytes()
    assert prepared(tmp_path / "out", thing=mesh) == stage
    assert (stage / "keys" / "stage.key").read_bytes() == key
    assert len(bench.prepared) == 1
    assert bench.settings == [{"room": DEFAULT_ROOM}]
    for options in ({"seed": 2}, {"size": "medium"}, {"thing": None}, {"room": "hard"}, {"projectors": 1}):
        with pytest.raises(UsageError) as refused:
            prepared(tmp_path / "out", **{"thing": mesh, **options})  # type: ignore[arg-type]
        assert refused.value.code == "demo-folder-taken"
    mesh.write_text("v 1 1 1")
    with pytest.raises(UsageError, match="another size, object, seed, room or number"):
        prepared(tmp_path / "out", thing=mesh)


@pytest.mark.parametrize(
    ("error", "kind", "code"),
    [
        (DeviceError("object-no-faces", what="No faces.", remedy="Give some."), UsageError, "object-no-faces"),
        (DeviceError("size-unknown", what="No size.", remedy="Give one."), UsageError, "size-unknown"),
        (DeviceError("stage-not-written", what="Full.", remedy="Free some."), WorkError, "stage-not-written"),
    ],
)
def test_what_the_bench_refuses_leaves_nothing(
    bench: ModelBench, tmp_path: Path, error: DeviceError, kind: type[VelaturaError], code: str
) -> None:
    bench.error = error
    with pytest.raises(kind) as refused:
        prepared(tmp_path / "out")
    assert (refused.value.code, refused.value.what, refused.value.remedy) == (code, error.what, error.remedy)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_was_there_before_stays(bench: ModelBench, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    bench.error = DeviceError("object-no-faces", what="No faces.", remedy="Give some.")
    with pytest.raises(UsageError):
        prepared(tmp_path / "out")
    assert list((tmp_path / "out").iterdir()) == []


def test_one_that_was_killed_while_it_wrote_is_no_hindrance(bench: ModelBench, tmp_path: Path) -> None:
    half = tmp_path / "out" / BUILDING
    half.mkdir(parents=True)
    (half / "bench.toml").write_text("half")
    stage = prepared(tmp_path / "out")
    assert (stage / "bench.toml").read_text() == "seed = 1"
    assert not half.exists()


@pytest.mark.parametrize("mark", ["", "{", "[]", json.dumps({"size": "small"})])
def test_a_damaged_mark_makes_the_folder_foreign(bench: ModelBench, tmp_path: Path, mark: str) -> None:
    stage = prepared(tmp_path / "out")
    (stage / MARK).write_text(mark)
    with pytest.raises(UsageError) as refused:
        prepared(tmp_path / "out")
    assert refused.value.code == "demo-folder-taken"


def test_an_object_that_can_not_be_read_is_told(bench: ModelBench, tmp_path: Path) -> None:
    with pytest.raises(UsageError) as refused:
        prepared(tmp_path / "out", thing=tmp_path / "nowhere.obj")
    assert refused.value.code == "object-missing"
    with pytest.raises(UsageError) as refused:
        prepared(tmp_path / "out", thing=tmp_path)
    assert refused.value.code == "object-missing"
    assert bench.prepared == []


def test_a_bare_word_is_a_built_in_object_and_all_else_a_mesh(bench: ModelBench, tmp_path: Path) -> None:
    """Even where a file of that name lies: no mesh can be read without its ending."""
    stage = prepared(tmp_path / "out", thing="painting", projectors=2)
    assert bench.settings == [{"room": DEFAULT_ROOM, "object": "painting", "projectors": 2}]
    tables = load_stage(stage).tables
    assert tables.stage.name == "demo small painting"
    assert [one.kind for one in tables.appearances] == ["restoration", "recolour"]
    assert prepared(tmp_path / "out", thing="painting", projectors=2) == stage
    with pytest.raises(UsageError):
        prepared(tmp_path / "out", thing="statue", projectors=2)
    for path in ("./painting", "painting.obj", "Painting", "a/painting", "painting "):
        with pytest.raises(UsageError) as refused:
            prepared(tmp_path / "other", thing=path)
        assert refused.value.code == "object-missing"


@pytest.mark.parametrize(
    ("thing", "kinds"),
    [
        (None, {"photograph", "pattern", "checkerboard", "gloss"}),
        ("painting", {"restoration", "recolour"}),
        ("relief", {"restoration", "recolour"}),
        ("statue", {"texture", "checkerboard", "gloss"}),
        ("corner", {"recolour"}),
    ],
)
def test_each_object_gets_appearances_of_its_own_and_none_that_needs_a_shape_from_one_projector(
    bench: ModelBench, tmp_path: Path, thing: str | None, kinds: set[str]
) -> None:
    stages = [prepared(tmp_path / str(count), thing=thing, projectors=count) for count in (None, 1)]
    whole, alone = ({one.kind for one in load_stage(stage).tables.appearances} for stage in stages)
    assert whole == kinds
    assert alone == (kinds if thing == "painting" else {"recolour"})


@pytest.mark.parametrize(
    ("asked", "code", "words"),
    [
        ({"thing": "vase"}, "setting-wrong", "painting, relief, statue"),
        ({"projectors": 7}, "setting-wrong", "from 1 to 6"),
    ],
)
def test_what_the_bench_has_not_is_refused_with_what_it_has(
    tmp_path: Path, asked: dict[str, Any], code: str, words: str
) -> None:
    with pytest.raises(UsageError) as refused:
        prepared(tmp_path / "out", **asked)
    assert refused.value.code == code
    assert words in refused.value.remedy
    assert not (tmp_path / "out").exists()


def test_an_unknown_room_is_refused_with_those_that_there_are(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="dark, room, hard") as refused:
        prepared(tmp_path / "out", room="cellar")
    assert refused.value.code == "setting-wrong"
    assert not (tmp_path / "out").exists()
