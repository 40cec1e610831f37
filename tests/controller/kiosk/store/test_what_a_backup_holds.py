"""Everything that stage.toml and building.toml name is in a backup, wherever it is, and a restored stage finds it."""

from __future__ import annotations

import gzip
import re
import shutil
import tarfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, get_args

import pytest
import zstandard
from pydantic import BaseModel

from controller.config import load_stage
from controller.config.models import StageTables
from controller.config.table import Holds, texts
from controller.core.errors import UsageError
from controller.kiosk.store import archive
from controller.kiosk.store.references import OWN, references
from plugins.projectors.profile_files import profile_text
from tests.controller.kiosk.vase import TEXT, graded_run, vase

RUN = "20260501-100000-calibrate"
PROFILE = profile_text("optoma-later", Path())[0]


@pytest.fixture
def stage(tmp_path: Path) -> Path:
    made = vase(tmp_path / "stage")
    captures = graded_run(made, RUN, {"left": 0.01}) / "captures" / "light"
    captures.mkdir(parents=True)
    (captures / "white.raw").write_bytes(b"a photograph")
    return made


def held(file: Path) -> set[str]:
    with tarfile.open(file) as packed:
        return set(packed.getnames())


def put(place: Path, content: str) -> Path:
    place.parent.mkdir(parents=True, exist_ok=True)
    place.write_text(content)
    return place


def on_another_computer(stage: Path, tmp_path: Path) -> Path:
    """Restored where nothing of the first computer is left but the backup."""
    file = archive.backup(stage).rename(tmp_path / "backup.tar.gz")
    shutil.rmtree(stage)
    shutil.rmtree(tmp_path / "outside", ignore_errors=True)
    archive.check_backup(file)
    archive.restore(tmp_path / "other", file)
    return tmp_path / "other"


def models(of: Any) -> Iterator[type[BaseModel]]:
    if isinstance(of, type) and issubclass(of, BaseModel):
        yield of
        for field in of.model_fields.values():
            yield from models(field.annotation)
    for inner in get_args(of):
        yield from models(inner)


def test_every_field_that_names_a_file_says_so_by_its_type() -> None:
    checked = 0
    for model in set(models(StageTables)):
        for key, field in model.model_fields.items():
            if re.search(r"(^|_)file$", key) or re.match(r"(?!the )an? .*\bfile\b", field.description or ""):
                given: dict[str, Any] = {**dict.fromkeys(model.model_fields), key: "x"}
                one = model.model_construct(None, **given)
                assert [holds for path, _, holds in texts(one) if path == (key,)] != [None], f"{model.__name__}.{key}"
                checked += 1
    assert checked >= 5


def test_own_names_are_those_of_the_documented_folder() -> None:
    page = (Path(__file__).parents[4] / "docs/architecture.md").read_text()
    block = page.split("## A stage on disk")[1].split("##")[0]
    documented = {re.split(r"[/,]", line.split()[0])[0] for line in block.splitlines() if line.startswith("    ")}
    assert documented - {archive.OUTSIDE} <= OWN


@pytest.mark.parametrize("where", ["stage", "outside", "odd"])
def test_a_file_behind_every_field_comes_back(stage: Path, tmp_path: Path, where: str) -> None:
    folder = {"stage": stage, "outside": tmp_path / "outside", "odd": stage / "tapes"}[where]
    place = {
        name: put(folder / name, content)
        for name, content in {
            "lens.toml": "a lens", "mine.toml": PROFILE, "pictures/clouds.png": "clouds", "ca.pem": "authorities",
            "scene.blend": "a scene", "cues.csv": "time,verb,values\n",
        }.items()
    }  # fmt: skip
    written = {name: str(path.relative_to(stage)) if where == "stage" else str(path) for name, path in place.items()}
    text = TEXT.replace('"optoma-later"', f'"{written["mine.toml"]}" # ours')
    text = text.replace("iso = 100", f'iso = 100\nintrinsics = "{written["lens.toml"]}"')
    text = text.replace('file = "appearances/glass.png"', f'file = "{written["pictures/clouds.png"]}"')
    text += f'[[appearances]]\nname = "m"\nkind = "blender"\nscene = "{written["scene.blend"]}"\n'
    text += f'[alerts]\ncertificates = "{written["ca.pem"]}"\nmail_password_file = "keys/mail"\n'
    (stage / "stage.toml").write_text(text)
    put(stage / "keys/mail", "SECRET")
    put(stage / "building.toml", f'[cues]\nfile = "{written["cues.csv"]}"\n')
    before = {path: one.read_text() for one in place.values() for path in [one.name]}
    other = on_another_computer(stage, tmp_path)
    found = {one.place.name: one for one in references(other) if one.holds is Holds.FILE}
    assert {name: one.place.read_text() for name, one in found.items()} == before
    assert all(one.place.is_relative_to(other) for one in found.values())
    assert "# ours" in (other / "stage.toml").read_text()
    assert not (other / "keys").exists()
    if where == "stage":
        assert (other / "stage.toml").read_text() == text
        assert (other / "pictures/clouds.png").exists()


def scene_of(place: Path, *links: str, pack: Callable[[bytes], bytes] = bytes) -> Path:
    """A file with these texts where Blender has the paths of pictures and libraries."""
    place.parent.mkdir(parents=True, exist_ok=True)
    texts = b"".join(b"IM\0\0" + link.encode().ljust(1024, b"\0") for link in links)
    place.write_bytes(pack(b"BLENDER-v405" + texts + b"ENDB"))
    return place


@pytest.mark.parametrize("where", ["stage", "outside"])
@pytest.mark.parametrize("pack", [bytes, zstandard.compress, gzip.compress])
def test_the_textures_of_a_scene_come_with_it_and_its_libraries_and_others_are_named(
    stage: Path, tmp_path: Path, where: str, pack: Callable[[bytes], bytes]
) -> None:
    folder = (stage if where == "stage" else tmp_path / "outside") / "scenes"
    far = put(tmp_path / "elsewhere/far.png", "far")
    put(folder / "textures/wood.png", "wood")
    put(folder / "lib/moss.png", "moss")
    scene_of(folder / "lib/plants.blend", "//moss.png", "//../scene.blend")
    links = ("//textures\\wood.png", "//lib/plants.blend", "//packed.png", str(far), "//../keys/stage.key")
    scene = scene_of(folder / "scene.blend", *links, pack=pack)
    named = scene.relative_to(stage) if where == "stage" else scene
    (stage / "stage.toml").write_text(TEXT + f'[[appearances]]\nname = "m"\nkind = "blender"\nscene = "{named}"\n')
    lacks = [one.split(",")[0] for one in archive.missing(stage)]
    assert f"The scene {named} links to {far}" in lacks
    assert len(lacks) == 1 + (where == "stage"), "the key, too"
    other = on_another_computer(stage, tmp_path)
    (there,) = (one.place for one in references(other) if one.place.name == "scene.blend")
    assert (there.parent / "textures/wood.png").read_text() == "wood"
    assert (there.parent / "lib/moss.png").read_text() == "moss"
    assert not (other / "keys").exists()


def test_links_out_of_a_folder_are_followed_and_those_in_it_stay(stage: Path, tmp_path: Path) -> None:
    put(tmp_path / "outside/pictures/a.png", "far")
    (stage / "appearances/linked").symlink_to(tmp_path / "outside/pictures")
    (stage / "appearances/glass.png").unlink()
    (stage / "appearances/glass.png").symlink_to(tmp_path / "outside/pictures/a.png")
    (stage / "appearances/loop").symlink_to(stage / "appearances")
    put(stage / "bundles/1.vel", "a bundle")
    (stage / "bundles/current").symlink_to("1.vel")
    other = on_another_computer(stage, tmp_path)
    assert (other / "appearances/glass.png").read_text() == "far"
    assert (other / "appearances/linked/a.png").read_text() == "far"
    assert (other / "bundles/current").readlink() == Path("1.vel")


def test_photographs_are_left_out_unless_they_are_asked_for(stage: Path) -> None:
    name = f"runs/{RUN}/captures/light/white.raw"
    assert name not in held(archive.backup(stage))
    assert name in held(archive.backup(stage, photographs=True))


def test_what_was_missing_already_stops_no_restore_and_what_got_lost_does(stage: Path, tmp_path: Path) -> None:
    (stage / "appearances/glass.png").unlink()
    assert archive.missing(stage) == ["stage.toml names appearances/glass.png, which is not a file."]
    archive.check_backup(archive.backup(stage))
    put(stage / "appearances/glass.png", "a picture")
    file = tmp_path / "lost.tar.gz"
    with tarfile.open(archive.backup(stage)) as old, tarfile.open(file, "w:gz") as new:
        for member in old:
            if not member.name.endswith("glass.png"):
                new.addfile(member, old.extractfile(member))
    with pytest.raises(UsageError, match=r"glass\.png, which is not a file"):
        archive.restore(stage, file)
    assert (stage / "appearances/glass.png").exists()


def test_a_stage_that_could_not_start_is_refused_before_anything_is_replaced(stage: Path, tmp_path: Path) -> None:
    file = archive.backup(stage)
    for wrong in ('driver = "serial"', 'driver = "player"'):
        bad = vase(tmp_path / wrong[-7:-1])
        (bad / "stage.toml").write_text(TEXT.replace(wrong, 'driver = "gone"'))
        with pytest.raises(UsageError, match="gone"):
            archive.restore(stage, archive.backup(bad))
    archive.restore(stage, file)
    assert (stage / "stage.toml").read_text() == TEXT


def test_a_damaged_run_of_the_same_name_does_not_hide_the_sound_one(stage: Path) -> None:
    file = archive.backup(stage)
    (stage / "runs" / RUN / "verification.json").write_text("{damaged")
    archive.restore(stage, file)
    newest = max(run.name for run in (stage / "runs").iterdir())
    assert newest > RUN
    assert "0.01" in (stage / "runs" / newest / "verification.json").read_text()
    assert (stage / "runs" / RUN / "verification.json").read_text() == "{damaged"


def test_a_sound_run_of_the_same_name_keeps_its_place_and_its_photographs(stage: Path) -> None:
    archive.restore(stage, archive.backup(stage))
    assert [run.name for run in (stage / "runs").iterdir()] == [RUN]
    assert (stage / "runs" / RUN / "captures/light/white.raw").exists()


def test_a_restored_run_counts_also_after_one_of_a_clock_that_was_ahead(stage: Path) -> None:
    file = archive.backup(stage)
    graded_run(stage, "20360101-000000-calibrate", {"left": 0.3})
    archive.restore(stage, file)
    newest = max((stage / "runs").iterdir(), key=lambda run: run.name)
    assert "0.01" in (newest / "verification.json").read_text()


def test_it_is_private_and_what_was_private_stays_so(stage: Path, tmp_path: Path) -> None:
    (stage / "stage.toml").chmod(0o600)
    file = archive.backup(stage)
    assert file.stat().st_mode & 0o777 == 0o600
    archive.restore(tmp_path / "other", file)
    assert (tmp_path / "other/stage.toml").stat().st_mode & 0o777 == 0o600
    assert load_stage(tmp_path / "other").tables.stage.name == "The vase"
