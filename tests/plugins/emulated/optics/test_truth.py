"""bench.toml: written, read back, and refused with the key and the line."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hal.errors import DeviceError
from plugins.emulated.core.truth import BenchTruth, ObjectTruth, read_truth, write_truth
from plugins.emulated.optics.objects import StageObject
from plugins.emulated.optics.staging import INTRINSICS, SIZES, device_tables, intrinsics_of, random_truth

KEPT = ObjectTruth("vase-and-bust", "", 1)


@pytest.fixture
def written(tmp_path: Path, tiny_truth: BenchTruth) -> Path:
    write_truth(tmp_path, tiny_truth)
    return tmp_path


def line_of(stage: Path, text: str, occurrence: int = 1) -> int:
    lines = (stage / "bench.toml").read_text().splitlines()
    return [number for number, line in enumerate(lines, start=1) if line.startswith(text)][occurrence - 1]


def change(stage: Path, number: int, line: str) -> None:
    lines = (stage / "bench.toml").read_text().splitlines()
    lines[number - 1] = line
    (stage / "bench.toml").write_text("\n".join(lines))


def test_what_is_written_is_read_back_exactly(written: Path, tiny_truth: BenchTruth) -> None:
    assert read_truth(written) == tiny_truth


def test_an_unknown_key_is_named_with_its_line_in_the_right_projector(written: Path) -> None:
    number = line_of(written, "brightness", occurrence=2)
    change(written, number, "brigthness = 1.0")
    with pytest.raises(DeviceError) as refused:
        read_truth(written)
    assert refused.value.code == "bench-key-unknown"
    assert f"line {number}" in refused.value.what
    assert "projectors[1].light.brigthness" in refused.value.what
    assert "brightness" in refused.value.what


def test_a_missing_key_is_named_with_the_table_that_lacks_it(written: Path) -> None:
    change(written, line_of(written, "focal_px", occurrence=1), "")
    with pytest.raises(DeviceError) as refused:
        read_truth(written)
    assert refused.value.code == "bench-key-missing"
    assert f"line {line_of(written, '[camera.lens]')}:" in refused.value.what
    assert "camera.lens.focal_px" in refused.value.what


@pytest.mark.parametrize(
    ("key", "line", "said"),
    [
        ("psf_sigma_px", 'psf_sigma_px = "soft"', "a finite number"),
        ("psf_sigma_px", "psf_sigma_px = nan", "a finite number"),
        ("latency_s", "latency_s = -1.0", "between 0 and 1"),
        ("ambient", "ambient = [0.1, 0.1]", "a list of 3"),
        ("subsamples", "subsamples = true", "a whole number"),
    ],
)
def test_a_wrong_value_is_named_with_what_is_allowed(written: Path, key: str, line: str, said: str) -> None:
    number = line_of(written, key)
    change(written, number, line)
    with pytest.raises(DeviceError) as refused:
        read_truth(written)
    assert refused.value.code == "bench-key-wrong"
    assert f"line {number}" in refused.value.what
    assert said in refused.value.what


def test_a_broken_file_and_a_missing_one_are_told_apart(written: Path, tmp_path: Path) -> None:
    change(written, 3, "this is = = not TOML")
    with pytest.raises(DeviceError) as broken:
        read_truth(written)
    with pytest.raises(DeviceError) as missing:
        read_truth(tmp_path / "elsewhere")
    assert (broken.value.code, missing.value.code) == ("bench-file-unreadable", "bench-file-missing")


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 2**62))
def test_every_seed_gives_a_stage_that_can_be_written_and_read(vase_and_bust: StageObject, seed: int) -> None:
    from plugins.emulated.core.tables import dump, load

    truth = random_truth("small", seed, vase_and_bust, KEPT, (1, 2))
    assert load(dump(truth), BenchTruth, file="bench.toml") == truth
    for projector in truth.projectors:
        mixing = np.asarray(projector.light.mixing)
        crosstalk = mixing / mixing.sum(axis=1, keepdims=True)
        assert (crosstalk[~np.eye(3, dtype=bool)] <= 0.125).all()
        assert projector.lens.centre_px[1] / projector.lens.size_px[1] == pytest.approx(1.05, abs=0.03)


def test_the_same_seed_gives_the_same_stage_and_another_seed_another(vase_and_bust: StageObject) -> None:
    first, again, other = (random_truth("small", seed, vase_and_bust, KEPT, (1, 2)) for seed in (3, 3, 4))
    assert first == again
    assert first.projectors[0].pose != other.projectors[0].pose


@pytest.mark.parametrize("size", list(SIZES))
def test_a_technician_knows_the_focal_length_and_the_distance_only_roughly(
    vase_and_bust: StageObject, size: str
) -> None:
    truth = random_truth(size, 9, vase_and_bust, KEPT, (15740, 15741))
    tables = device_tables(truth, vase_and_bust)
    assert tables["camera"]["intrinsics"] == INTRINSICS
    kept = tomllib.loads(intrinsics_of(truth))
    assert 0.0 < abs(kept["focal_length_px"] / truth.camera.lens.focal_px - 1.0) <= 0.001
    assert np.sqrt(kept["covariance"][0][0]) == pytest.approx(0.001)
    nearest = min(np.linalg.norm(vertex - truth.camera.pose.position_m) for vertex in vase_and_bust.vertices)
    assert tables["camera"]["distance_m"] == pytest.approx(nearest, rel=0.011)
    assert tables["camera"]["address"] == "ptpip:127.0.0.1:15740:15741"
    names = [output["name"] for output in tables["display"]["outputs"]]
    assert names == [projector["output"] for projector in tables["projectors"]]
