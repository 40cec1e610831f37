"""Key files."""

from __future__ import annotations

from pathlib import Path

import pytest

from controller.bundle.signing import generate_key, load_public_key, load_signing_key, write_public_key
from controller.core.errors import UsageError, WorkError
from tests.full_disk import full_disk


def test_a_new_key_is_private_and_is_read_back(tmp_path: Path) -> None:
    path = tmp_path / "kiosk.key"
    public = generate_key(path)
    assert path.stat().st_mode & 0o777 == 0o600
    assert load_public_key(tmp_path / "kiosk.key.pub") == public
    assert bytes(load_signing_key(path).verify_key) == public


def test_a_key_is_never_replaced(tmp_path: Path) -> None:
    generate_key(tmp_path / "k")
    before = (tmp_path / "k").read_bytes()
    with pytest.raises(UsageError, match="already"):
        generate_key(tmp_path / "k")
    assert (tmp_path / "k").read_bytes() == before


def test_a_full_disk_is_in_the_way_of_another_public_key_only(tmp_path: Path) -> None:
    write_public_key(tmp_path / "k.pub", bytes(32))
    with full_disk():
        write_public_key(tmp_path / "k.pub", bytes(32))
        with pytest.raises(WorkError) as caught:
            write_public_key(tmp_path / "k.pub", bytes([1]) * 32)
    assert caught.value.code == "no-space"
    assert load_public_key(tmp_path / "k.pub") == bytes(32)


def test_a_signing_key_that_others_may_read_is_refused(tmp_path: Path) -> None:
    generate_key(tmp_path / "k")
    (tmp_path / "k").chmod(0o640)
    with pytest.raises(UsageError) as caught:
        load_signing_key(tmp_path / "k")
    assert caught.value.code == "key-open-to-others"


@pytest.mark.parametrize(
    "content", [b"", b"\xff\xfe", b"velatura-public-key-1 12", b"velatura-public-key-1 zz", b"ssh-ed25519 " + b"0" * 64]
)
def test_other_files_are_not_keys(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "k").write_bytes(content)
    with pytest.raises(UsageError) as caught:
        load_public_key(tmp_path / "k")
    assert caught.value.code == "key-unreadable"


def test_a_secret_key_does_not_pass_as_a_public_one(tmp_path: Path) -> None:
    generate_key(tmp_path / "k")
    with pytest.raises(UsageError) as caught:
        load_public_key(tmp_path / "k")
    assert (tmp_path / "k").read_text().split()[1] not in str(caught.value)
