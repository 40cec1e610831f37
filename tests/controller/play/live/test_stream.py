"""Live: a real player shows what another process writes, as docs/reference/player-protocol.md tells it."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from controller.core.errors import UsageError
from controller.play.frames import FrameFile, FrameSet, OutputSize
from tests.controller.play.conftest import OUTPUTS, START
from tests.controller.play.wire import Frames, Wire, dark, noise, same
from tests.waiting import eventually

SIZES = [OutputSize(*output) for output in OUTPUTS]
DYING_WRITER = """
import sys, time
from pathlib import Path
from controller.play.frames import FrameFile
from tests.controller.play.live.test_stream import SIZES, noise_set
file = FrameFile(Path(sys.argv[1]), SIZES)
file.write(noise_set(7))
print("written", flush=True)
time.sleep(60)
"""


def noise_set(seed: int) -> FrameSet:
    return FrameSet(tuple(noise(OUTPUTS, seed)[name] for name, _, _ in OUTPUTS))


@pytest.fixture
def writer(folder: Path) -> Iterator[FrameFile]:
    """The shared file, made again."""
    (folder / "live.frame").unlink(missing_ok=True)
    with contextlib.closing(FrameFile(folder / "live.frame", SIZES)) as file:
        yield file


def live(wire: Wire) -> dict[str, Any]:
    found = wire.ask("status")["live"]
    assert isinstance(found, dict)
    return found


def test_what_is_there_and_what_comes_is_shown_until_something_else_is_asked_for(
    wire: Wire, writer: FrameFile, folder: Path
) -> None:
    out = Frames(folder / "out.frame")
    assert wire.ask("status")["live"] is None
    assert wire.ask("live", file=str(writer.path))["by"] == "frames"
    assert (live(wire)["shown"], live(wire)["delay_p50_s"], live(wire)["source"]) == (0, None, "there")
    for shown, seed in enumerate((11, 12, 13), start=1):
        writer.write(noise_set(seed))
        assert eventually(lambda seed=seed: same(out.read(), noise(OUTPUTS, seed)))  # type: ignore[misc]
        assert eventually(lambda shown=shown: live(wire)["shown"] == shown)  # type: ignore[misc]
    status = wire.ask("status")
    assert (status["showing"], status["appearance"], status["sequence_running"]) == ("live", None, False)
    assert 0 <= status["live"]["delay_p50_s"] <= status["live"]["delay_p99_s"]
    assert status["live"]["presented_at"] == status["presented_at"] == out.presented_at
    wire.ask("play", appearance="3")
    assert wire.ask("status")["live"] is None
    swaps = wire.ask("status")["swaps"]
    writer.write(noise_set(14))
    time.sleep(0.1)
    assert wire.ask("status")["swaps"] == swaps
    assert same(out.read(), noise(OUTPUTS, 3))
    # a picture that is there already is shown at once, and a fade begins from it
    wire.ask("live", file=str(writer.path))
    assert eventually(lambda: same(out.read(), noise(OUTPUTS, 14)))
    wire.ask("stop", fade_s=0.05)
    assert dark(out.read())


def test_a_set_that_is_being_written_is_not_shown(wire: Wire, writer: FrameFile, folder: Path) -> None:
    writer.write(noise_set(21))
    out = Frames(folder / "out.frame")
    wire.ask("live", file=str(writer.path))
    assert eventually(lambda: same(out.read(), noise(OUTPUTS, 21)))
    other = Frames(writer.path)
    other._words[2] |= 1
    for pixels in other._pixels.values():
        pixels[...] = 99
    time.sleep(0.1)
    assert same(out.read(), noise(OUTPUTS, 21))
    other._words[2] += 1
    assert eventually(lambda: all((image == 99).all() for image in out.read().values()))


def test_a_file_that_does_not_fit_is_refused_with_both_sizes(wire: Wire, folder: Path, tmp_path: Path) -> None:
    wire.ask("play", appearance="1")
    small = [OutputSize("P1", 20, 10), *SIZES[1:]]
    FrameFile(tmp_path / "small", small).close()
    FrameFile(tmp_path / "few", SIZES[:2]).close()
    (tmp_path / "other").write_bytes(b"no frame file" * 1000)
    (tmp_path / "short").write_bytes((folder / "out.frame").read_bytes()[:-1])
    for name in ("small", "few", "other", "short", "missing"):
        error = wire.ask("live", file=str(tmp_path / name))["error"]
        assert error["code"] == "live-file-unfit"
        assert "P1 40x30, P2 41x31" in error["remedy"]
        if name == "small":
            assert "P1 20x10, P2 41x31" in error["what"]
    assert wire.ask("status")["appearance"] == "1"
    assert wire.ask("status")["live"] is None


@pytest.mark.parametrize("wrong", [{}, {"file": 3}, {"file": "x", "white": 0}, {"file": "x", "white": True}])
def test_a_request_that_is_none_is_refused(wire: Wire, wrong: dict[str, Any]) -> None:
    assert wire.ask("live", **wrong)["error"]["code"] == "request-wrong"


def test_targets_need_a_bundle_for_live(wire: Wire, writer: FrameFile) -> None:
    assert wire.ask("live", file=str(writer.path), white=1.5)["error"]["code"] == "bundle-not-live"


def test_a_source_that_is_killed_leaves_its_last_picture_and_another_one_goes_on(start: START, tmp_path: Path) -> None:
    player, file = start(), tmp_path / "live.frame"
    FrameFile(file, SIZES).close()
    out = Frames(tmp_path / "out.frame")
    with Wire(player.socket) as wire:
        with contextlib.ExitStack() as stack:
            command = [sys.executable, "-c", DYING_WRITER, str(file)]
            process = stack.enter_context(subprocess.Popen(command, stdout=subprocess.PIPE))
            stack.callback(process.kill)
            assert process.stdout is not None
            assert process.stdout.readline() == b"written\n"
            wire.ask("live", file=str(file))
            assert eventually(lambda: same(out.read(), noise(OUTPUTS, 7)))
            time.sleep(1.3)
            assert live(wire)["source"] == "there", "it is silent, but it lives"
        assert eventually(lambda: live(wire)["source"] == "gone")
        assert same(out.read(), noise(OUTPUTS, 7))
        file.unlink()
        with contextlib.closing(FrameFile(file, SIZES)) as another:
            another.write(noise_set(8))
            assert eventually(lambda: same(out.read(), noise(OUTPUTS, 8)))
            assert live(wire)["source"] == "there"
        player.terminate()
    assert dark(out.read())


def test_a_file_that_somebody_writes_to_is_not_put_aside_for_one_of_other_outputs(tmp_path: Path) -> None:
    with contextlib.closing(FrameFile(tmp_path / "live.frame", SIZES)):
        before = (tmp_path / "live.frame").stat()
        with pytest.raises(UsageError) as caught:
            FrameFile(tmp_path / "live.frame", SIZES[:1])
        assert caught.value.code == "frames-in-use"
        assert os.path.samestat((tmp_path / "live.frame").stat(), before)
    FrameFile(tmp_path / "live.frame", SIZES[:1]).close()
