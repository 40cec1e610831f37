"""Installation leaves the old bundle or the new one, whole, and never an unsound one."""

from __future__ import annotations

import errno
import os
import time
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from nacl.signing import SigningKey

from controller.bundle.format import Index
from controller.bundle.install import current, install, rollback
from controller.bundle.reader import Bundle
from controller.bundle.writer import NewAppearance, NewBundle, write_bundle
from controller.core.errors import BundleError, WorkError


def made(path: Path, value: int, revision: int = 0, key: SigningKey | None = None) -> Path:
    frames = {"P1": np.full((6, 5, 3), value, np.uint8)}
    write_bundle(
        path,
        NewBundle(stage="s", calibration="c", created_unix_s=0, outputs=[("P1", 5, 6)], revision=revision),
        appearances=[NewAppearance("a", frames)],
        key=key,
    )
    return path


def plays(folder: Path) -> int:
    """The pixel value that the installed bundle would show."""
    file = current(folder)
    assert file is not None
    with Bundle.open(file, allow_unsigned=True) as bundle:
        bundle.verify()
        return int(bundle.decode("a", "P1")[0, 0, 0])


def test_the_newest_plays_and_the_one_before_comes_back(tmp_path: Path) -> None:
    folder = tmp_path / "bundles"
    for value in (1, 2, 3):
        install(made(tmp_path / "b.vel", value), folder, allow_unsigned=True)
    assert plays(folder) == 3
    assert len(list(folder.glob("*.vel"))) == 2, "only the current and the previous one are kept"
    rollback(folder)
    assert plays(folder) == 2
    rollback(folder)
    assert plays(folder) == 3


def test_installing_the_current_bundle_again_keeps_the_previous_one(tmp_path: Path) -> None:
    folder = tmp_path / "bundles"
    for value in (1, 2, 2):
        install(made(tmp_path / "b.vel", value), folder, allow_unsigned=True)
    rollback(folder)
    assert plays(folder) == 1


def test_without_an_earlier_bundle_there_is_nothing_to_go_back_to(tmp_path: Path) -> None:
    install(made(tmp_path / "b.vel", 1), tmp_path / "bundles", allow_unsigned=True)
    with pytest.raises(BundleError) as caught:
        rollback(tmp_path / "bundles")
    assert caught.value.code == "bundle-no-previous"
    assert plays(tmp_path / "bundles") == 1


def test_unsound_foreign_and_older_bundles_change_nothing(tmp_path: Path) -> None:
    folder, key = tmp_path / "bundles", SigningKey(bytes(32))
    trusted = [bytes(key.verify_key)]
    install(made(tmp_path / "b.vel", 1, 7, key), folder, trusted=trusted)
    broken = bytearray(made(tmp_path / "broken.vel", 2, 8, key).read_bytes())
    broken[4100] ^= 1
    (tmp_path / "broken.vel").write_bytes(broken)
    for path, code in (
        (tmp_path / "broken.vel", "bundle-damaged"),
        (made(tmp_path / "unsigned.vel", 3, 9), "bundle-unsigned"),
        (made(tmp_path / "older.vel", 4, 6, key), "bundle-older"),
        (tmp_path / "absent.vel", "bundle-unreadable"),
    ):
        with pytest.raises(BundleError) as caught:
            install(path, folder, trusted=trusted)
        assert caught.value.code == code
        assert plays(folder) == 1
        assert len(list(folder.glob("*.vel"))) == 1


def test_a_revoked_key_is_refused_though_it_is_trusted_too(tmp_path: Path) -> None:
    folder, key = tmp_path / "bundles", SigningKey(bytes(32))
    public = bytes(key.verify_key)
    bundle = made(tmp_path / "b.vel", 1, 7, key)
    for how in ({"trusted": [public]}, {"allow_unsigned": True}):
        with pytest.raises(BundleError) as caught:
            install(bundle, folder, revoked=[public], **how)
        assert caught.value.code == "bundle-revoked"
    assert current(folder) is None
    install(bundle, folder, trusted=[public])


def test_a_revision_may_not_go_down_even_after_a_rollback(tmp_path: Path) -> None:
    folder = tmp_path / "bundles"
    for value, revision in ((1, 3), (2, 5)):
        install(made(tmp_path / f"{value}.vel", value, revision), folder, allow_unsigned=True)
    rollback(folder)
    with pytest.raises(BundleError, match="revision 5 is installed"):
        install(made(tmp_path / "b.vel", 3, 4), folder, allow_unsigned=True)
    install(tmp_path / "1.vel", folder, allow_unsigned=True)  # what is current already
    assert plays(folder) == 1


def test_a_stolen_key_once_revoked_keeps_no_sound_bundle_out(tmp_path: Path) -> None:
    folder, ours, stolen = tmp_path / "bundles", SigningKey(bytes(32)), SigningKey(bytes([1] * 32))
    keys = [bytes(ours.verify_key), bytes(stolen.verify_key)]
    install(made(tmp_path / "b.vel", 1, 2**53 - 1, stolen), folder, trusted=keys)
    install(made(tmp_path / "b.vel", 2, 1, ours), folder, trusted=keys, revoked=keys[1:])
    assert plays(folder) == 2


def test_a_sound_bundle_that_does_not_fit_is_refused(tmp_path: Path) -> None:
    def accept(index: Index) -> None:
        raise BundleError("bundle-other-stage", what=index.stage, remedy="")

    folder = tmp_path / "bundles"
    install(made(tmp_path / "b.vel", 1), folder, allow_unsigned=True)
    with pytest.raises(BundleError) as caught:
        install(made(tmp_path / "b.vel", 2), folder, allow_unsigned=True, accept=accept)
    assert caught.value.code == "bundle-other-stage"
    assert plays(folder) == 1


def test_what_is_no_bundle_is_refused_before_a_byte_is_copied(tmp_path: Path) -> None:
    folder = tmp_path / "bundles"
    install(made(tmp_path / "1.vel", 1), folder, allow_unsigned=True)
    before = sorted(path.name for path in folder.iterdir())
    pipe, huge, link = tmp_path / "pipe.vel", tmp_path / "huge.vel", tmp_path / "link.vel"
    os.mkfifo(pipe)
    with huge.open("wb") as file:
        file.write(made(tmp_path / "2.vel", 2).read_bytes())
        file.truncate(2**40)
    link.symlink_to(tmp_path / "nowhere.vel")
    for source in (pipe, huge, link, Path("/dev/zero"), tmp_path):
        began = time.process_time()
        tracemalloc.start()
        try:
            with pytest.raises(BundleError):
                install(source, folder, allow_unsigned=True)
            assert tracemalloc.get_traced_memory()[1] < 64 * 2**20
        finally:
            tracemalloc.stop()
        assert time.process_time() - began < 0.1
        assert sorted(path.name for path in folder.iterdir()) == before
    assert plays(folder) == 1


def test_links_that_lead_elsewhere_are_not_followed(tmp_path: Path) -> None:
    folder = tmp_path / "bundles"
    install(made(tmp_path / "1.vel", 1), folder, allow_unsigned=True)
    outside = made(tmp_path / ("0" * 64 + ".vel"), 9)
    for target in (str(outside), f"../{outside.name}", "../../etc/passwd", "current", "."):
        (folder / "current").unlink()
        (folder / "current").symlink_to(target)
        assert current(folder) is None, target
    assert outside.exists()
    install(made(tmp_path / "2.vel", 2, revision=1), folder, allow_unsigned=True)
    assert plays(folder) == 2


def test_a_disk_that_is_read_only_or_full_leaves_what_plays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "bundles"
    install(made(tmp_path / "1.vel", 1), folder, allow_unsigned=True)
    source = made(tmp_path / "2.vel", 2, revision=1)

    def fails(number: int) -> None:
        def mkstemp(*_: object, **__: object) -> tuple[int, str]:
            raise OSError(number, os.strerror(number))

        monkeypatch.setattr("controller.core.storage.tempfile.mkstemp", mkstemp)

    for number, code in ((errno.EROFS, "cannot-write"), (errno.ENOSPC, "no-space"), (errno.EDQUOT, "no-space")):
        fails(number)
        with pytest.raises(WorkError) as wrong:
            install(source, folder, allow_unsigned=True)
        assert wrong.value.code == code
        assert plays(folder) == 1
    monkeypatch.undo()
    install(source, folder, allow_unsigned=True)
    assert plays(folder) == 2
