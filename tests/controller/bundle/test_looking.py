"""What inspect, diff, export and sign are made of."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from nacl.signing import SigningKey
from skimage.io import imread

from controller.bundle.describe import as_text, describe, differences, differences_as_text, export_pictures
from controller.bundle.format import PlaylistEntry
from controller.bundle.reader import Bundle
from controller.bundle.signing import ANY_SIGNER
from controller.bundle.writer import NewAppearance, NewBundle, NewLive, sign_bundle, write_bundle
from controller.core.errors import BundleError, UsageError
from tests.controller.bundle.conftest import OUTPUTS, PNG, write

Pictures = dict[str, dict[str, npt.NDArray[np.uint8]]]


def test_a_description_is_json_and_says_what_was_written(signed: Path, key: SigningKey) -> None:
    with Bundle.open_trusted(signed, ANY_SIGNER) as bundle:
        found = json.loads(json.dumps(describe(bundle)))
        text = as_text(found)
    assert found["signed_by"] == bytes(key.verify_key).hex()
    assert (found["bytes"], found["revision"], found["created"]) == (
        signed.stat().st_size,
        3,
        "2023-11-14 22:13:20Z",
    )
    assert [one["name"] for one in found["appearances"]] == ["noise", "ramp"]
    assert [one["thumbnail"] for one in found["appearances"]] == [False, True]
    assert found["appearances"][0]["metadata"] == {"de": 2.5, "ist schön": True}
    assert "left 13x10, right 8x6" in text


def test_a_date_beyond_the_calendar_is_shown_as_a_number(tmp_path: Path) -> None:
    write_bundle(tmp_path / "b.vel", NewBundle("s", "c", created_unix_s=2**53, outputs=OUTPUTS), appearances=[])
    with Bundle.open_trusted(tmp_path / "b.vel", ANY_SIGNER) as bundle:
        assert str(2**53) in as_text(describe(bundle))


def other_picture(appearances: list[NewAppearance]) -> list[NewAppearance]:
    frames = {name: frame.copy() for name, frame in appearances[0].frames.items()}
    frames["right"][5, 7, 2] ^= 1
    return [replace(appearances[0], frames=frames), appearances[1]]


@pytest.mark.parametrize(
    ("change", "lines"),
    [
        (lambda a: a, []),
        (other_picture, ["~ appearance noise: right"]),
        (lambda a: [a[0], replace(a[1], thumbnail=PNG + b"x")], ["~ appearance ramp: thumbnail"]),
        (lambda a: [replace(a[0], metadata={}), a[1]], ["~ appearance noise: metadata"]),
        (lambda a: [a[1], replace(a[0], name="new")], ["- appearance noise", "+ appearance new"]),
    ],
)
def test_two_bundles_differ_in_what_was_changed_and_nothing_else(
    tmp_path: Path,
    appearances: list[NewAppearance],
    key: SigningKey,
    change: Callable[[list[NewAppearance]], list[NewAppearance]],
    lines: list[str],
) -> None:
    files = [write(tmp_path / "a", appearances, key), write(tmp_path / "b", change(appearances), key)]
    with Bundle.open_trusted(files[0], ANY_SIGNER) as one, Bundle.open_trusted(files[1], ANY_SIGNER) as other:
        found = differences(one, other)
    assert found["same"] == (not lines)
    assert differences_as_text(found).splitlines() == (lines or ["The bundles have the same content."])


def test_other_outputs_and_signers_are_told(tmp_path: Path, unsigned: Path, key: SigningKey) -> None:
    small = tmp_path / "small.vel"
    write_bundle(
        small,
        NewBundle(
            stage="demo", calibration="run-1", created_unix_s=1_700_000_000, revision=3, outputs=[("left", 4, 4)]
        ),
        appearances=[],
        key=key,
    )
    with Bundle.open_trusted(unsigned, ANY_SIGNER) as one, Bundle.open_trusted(small, ANY_SIGNER) as other:
        text = differences_as_text(differences(one, other))
    assert "- signed_by none" in text
    assert f"+ signed_by {bytes(key.verify_key).hex()}" in text
    assert "+ outputs left 4x4" in text


def test_exported_pictures_are_the_frames_byte_for_byte(signed: Path, pictures: Pictures, tmp_path: Path) -> None:
    out = tmp_path / "new" / "pictures"
    with Bundle.open_trusted(signed, ANY_SIGNER) as bundle:
        assert export_pictures(bundle, out) == 4
    index = json.loads((out / "index.json").read_text())
    for appearance in index["appearances"]:
        for output, file in appearance["frames"].items():
            assert hashlib.sha256((out / file["file"]).read_bytes()).hexdigest() == file["sha256"]
            np.testing.assert_array_equal(imread(out / file["file"]), pictures[appearance["name"]][output])
    assert (out / index["appearances"][1]["thumbnail"]["file"]).read_bytes() == PNG
    assert index["appearances"][0]["thumbnail"] is None
    assert sorted(path.name for path in out.iterdir()) == ["frames", "index.json", "thumbnails"]


def test_an_export_that_is_stopped_or_may_not_begin_leaves_nothing(signed: Path, tmp_path: Path) -> None:
    def stop(done: float) -> None:
        if done:
            raise KeyboardInterrupt

    with Bundle.open_trusted(signed, ANY_SIGNER) as bundle:
        with pytest.raises(KeyboardInterrupt):
            export_pictures(bundle, tmp_path / "x" / "y", stop)
        assert list((tmp_path / "x").iterdir()) == []
        (tmp_path / "x" / "mine.txt").write_text("mine")
        with pytest.raises(UsageError) as caught:
            export_pictures(bundle, tmp_path / "x")
    assert caught.value.code == "folder-not-empty"
    assert [path.name for path in (tmp_path / "x").iterdir()] == ["mine.txt"]


def test_signing_changes_the_signature_and_nothing_else(unsigned: Path, signed: Path, key: SigningKey) -> None:
    assert sign_bundle(unsigned, key) == bytes(key.verify_key)
    assert unsigned.read_bytes() == signed.read_bytes()
    other = SigningKey(bytes(32))
    sign_bundle(signed, other)
    Bundle.open(signed, trusted=[bytes(other.verify_key)]).close()
    with pytest.raises(BundleError, match="does not trust"):
        Bundle.open(signed, trusted=[bytes(key.verify_key)])


def test_what_is_damaged_is_not_signed(unsigned: Path, key: SigningKey) -> None:
    data = bytearray(unsigned.read_bytes())
    data[4096 + 9] ^= 16
    unsigned.write_bytes(data)
    with pytest.raises(BundleError, match="damaged"):
        sign_bundle(unsigned, key)
    assert unsigned.read_bytes() == bytes(data)


def test_schedule_and_live_section_are_told_and_compared(tmp_path: Path) -> None:
    frame = {"P1": np.zeros((4, 5, 3), np.uint8)}

    def bundle(name: str, fade_ms: int, value: float) -> Bundle:
        write_bundle(
            tmp_path / name,
            NewBundle(
                stage="s",
                calibration="c",
                created_unix_s=0,
                outputs=[("P1", 5, 4)],
                schedule=[PlaylistEntry("a", 5000, fade_ms)],
                live=NewLive((7, 6), {"gain": np.full(3, value, np.float32)}),
            ),
            appearances=[NewAppearance("a", frame)],
        )
        return Bundle.open(tmp_path / name, allow_unsigned=True)

    with bundle("1.vel", 250, 1) as one, bundle("2.vel", 500, 1) as other, bundle("3.vel", 250, 2) as third:
        found = describe(one)
        assert (found["version"], found["schedule"]) == (2, [["a", 5000, 250]])
        assert found["live"]["target_px"] == [7, 6]
        assert "a for 5 s, fade 0.25 s" in as_text(found)
        assert "targets of 7x6" in as_text(found)
        assert list(differences(one, other)["changed"]) == ["schedule"]
        assert list(differences(one, third)["changed"]) == ["live"]
        assert differences_as_text(differences(one, third)) == "~ live"
        assert differences(one, one)["same"]
