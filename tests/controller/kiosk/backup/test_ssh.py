"""Backups to OpenSSH's own server: sent, read back, restored; and what is said where that fails."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import pytest

from controller.core.errors import VelaturaError
from controller.kiosk.backup import Server
from controller.kiosk.store import archive
from tests.controller.kiosk.backup.ssh_server import CutLine, SshServer, make_key
from tests.controller.kiosk.vase import TEXT, vase


@pytest.fixture
def server(tmp_path: Path) -> SshServer:
    return SshServer(tmp_path / "server")


@pytest.fixture
def source(tmp_path: Path) -> Path:
    stage = vase(tmp_path / "stage")
    (stage / "appearances/noise.png").write_bytes(os.urandom(400_000))
    return archive.backup(stage)


def refused(place: Server, source: Path) -> VelaturaError:
    with pytest.raises(VelaturaError) as caught:
        place.store(source, "20260504", 2)
    assert caught.value.remedy
    return caught.value


def test_it_is_sent_and_read_back_the_oldest_go_and_another_machine_restores_it(
    server: SshServer, source: Path, tmp_path: Path
) -> None:
    place = Server(server.address(), server.key_file, server.host_key)
    (server.folder / "holiday.tar.gz").write_bytes(b"somebody else's")
    with server.running():
        for day in ("20260504", "20260505", "20260505", "20260506"):
            told = place.store(source, day, 2)
    assert told.code == "backup-made"
    assert "sent to 127.0.0.1 and read back" in told.what
    assert server.names() == ["holiday.tar.gz", "velatura-20260505.tar.gz", "velatura-20260506.tar.gz"]
    assert [path.name for path in source.parent.iterdir()] == [source.name], "what was read back is gone"
    blank = tmp_path / "blank"
    blank.mkdir()
    archive.restore(blank, server.folder / "velatura-20260506.tar.gz")
    assert (blank / "stage.toml").read_text() == TEXT


def test_another_server_in_its_place_gets_nothing(server: SshServer, source: Path, tmp_path: Path) -> None:
    other = " ".join(make_key(tmp_path / "other").with_suffix(".pub").read_text().split()[:2])
    with server.running():
        error = refused(Server(server.address(), server.key_file, other), source)
    assert error.code == "backup-host-key"
    assert server.names() == []


def test_a_key_that_it_does_not_know_and_one_that_is_missing(server: SshServer, source: Path, tmp_path: Path) -> None:
    with server.running():
        stranger = refused(Server(server.address(), make_key(tmp_path / "stranger"), server.host_key), source)
    assert stranger.code == "backup-login-refused"
    assert refused(Server(server.address(), tmp_path / "no key", server.host_key), source).code == "backup-key-missing"
    assert refused(Server(server.address(), None, server.host_key), source).code == "backup-ssh-incomplete"


def test_a_server_that_is_off(server: SshServer, source: Path) -> None:
    assert refused(Server(server.address(), server.key_file, server.host_key), source).code == "backup-unreachable"


def test_a_connection_that_is_lost_on_the_way_replaces_nothing(server: SshServer, source: Path) -> None:
    (server.folder / "velatura-20260504.tar.gz").write_bytes(b"the one of before")
    with server.running(), CutLine(server.port, 100_000) as line:
        error = refused(Server(server.address(line.port), server.key_file, server.host_key), source)
        assert error.code == "backup-unreachable", error.what
        assert (server.folder / "velatura-20260504.tar.gz").read_bytes() == b"the one of before"
        # The rest of it does not stand in the way of the next one.
        Server(server.address(), server.key_file, server.host_key).store(source, "20260504", 2)
    assert server.names() == ["velatura-20260504.tar.gz"]


@pytest.mark.parametrize("says", ["", "echo 'Connection to 127.0.0.1 closed by remote host.' >&2; "])
def test_a_program_that_its_lost_connection_ends_is_no_fault_of_the_server(
    server: SshServer, source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, says: str
) -> None:
    """OpenSSH's `sftp` ends so where its `ssh` ends first: about once in eight times on a busy machine."""
    program = tmp_path / "programs" / "sftp"
    program.parent.mkdir()
    program.write_text(f"#!/bin/sh\n{says}kill -PIPE $$\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{program.parent}:{os.environ['PATH']}")
    assert refused(Server(server.address(), server.key_file, server.host_key), source).code == "backup-unreachable"


def test_a_server_that_does_not_answer_is_given_up(server: SshServer, source: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = server.address(silent.getsockname()[1])
        assert (
            refused(Server(address, server.key_file, server.host_key, longest_s=1.0), source).code
            == "backup-unreachable"
        )


def test_a_full_disk_and_a_missing_folder_of_the_server(server: SshServer, source: Path) -> None:
    place = Server(server.address(), server.key_file, server.host_key)
    with server.running(largest_file=100_000):
        full = refused(place, source)
    assert full.code == "backup-server-failed"
    assert "Check the free space there" in full.remedy
    assert not [name for name in server.names() if not name.startswith(".")]
    for path in server.folder.iterdir():
        path.unlink()
    server.folder.rmdir()
    with server.running():
        assert refused(place, source).code == "backup-folder-missing"
