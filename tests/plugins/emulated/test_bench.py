"""The bench as a process: what it prepares, what it serves, how it ends; and what its camera sees."""

from __future__ import annotations

import dataclasses
import json
import os
import random
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rawpy
import serial
from sacn import DataPacket

from hal.deadline import in_seconds
from hal.errors import DeviceError
from hal.registry import OpenContext
from hal.values import Power
from lab.emulated.projectors.boards import BOARDS, login_of, projector_on_its_wire
from plugins.emulated.bench import EmulatedBench
from plugins.emulated.core.shot import ShotSettings
from plugins.emulated.core.truth import (
    DEFAULT_BOARD,
    BenchTruth,
    DouserTruth,
    MainsTruth,
    ProjectorTruth,
    read_truth,
    write_truth,
)
from plugins.emulated.optics.layout import Stands
from plugins.emulated.optics.world import World
from plugins.emulated.projectors.lamp import EmulatedLamp, LampTiming
from plugins.projectors.network.driver import open_network_projector
from plugins.projectors.serial import SerialProjector, open_serial_projector

SERVE = """
import sys
from pathlib import Path
from plugins.emulated.bench import EmulatedBench
sys.exit(EmulatedBench().serve(Path(sys.argv[1]), json_lines=True))
"""
WHITE = ShotSettings(exposure_s=1 / 15, iso=100, aperture_f=8.0, raw=True, jpeg=False)


@pytest.fixture
def prepared(tmp_path: Path, shrink: Callable[[BenchTruth], BenchTruth]) -> Path:
    EmulatedBench().prepare(tmp_path / "stage", size="small", object_file=None, seed=11)
    write_truth(tmp_path / "stage", shrink(read_truth(tmp_path / "stage")))
    return tmp_path / "stage"


def served(stage: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", SERVE, str(stage)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).parents[3],
    )


def until_ready(process: subprocess.Popen[str]) -> Iterator[dict[str, Any]]:
    assert process.stdout is not None
    for line in process.stdout:
        record = json.loads(line)
        if record.get("ready"):
            return
        yield record


def power_of(tty: Path, *, patience_s: float = 20.0) -> bytes:
    """What the projector says of its power; nothing if it has no mains."""
    with serial.Serial(str(tty), 9600, timeout=patience_s) as line:
        line.write(b"~00124 1\r")
        return bytes(line.read_until(b"\r"))


def test_a_stage_is_served_at_the_addresses_it_was_prepared_with_and_cleaned_up(prepared: Path) -> None:
    truth = read_truth(prepared)
    (port,) = random.SystemRandom().sample(range(20000, 32768), 1)
    mains = (MainsTruth("cupboard", 2, ("left", "right"), 0.1),)
    dousers = (DouserTruth(port, 1, 5, "above"),)
    write_truth(prepared, dataclasses.replace(truth, mains=mains, dousers=dousers))
    (prepared / "bench" / "usb.toml").write_text('[[device]]\nname = "cupboard"\nkind = "relay"\nserial = "BENCH"\n')
    camera = truth.camera
    ends_s = time.monotonic() + 120
    with served(prepared) as process:
        try:
            records = list(until_ready(process))
            addresses = {str(record["device"]): str(record["address"]) for record in records if "device" in record}
            assert addresses["camera"] == f"ptpip:127.0.0.1:{camera.command_port}:{camera.event_port}"
            ttys = [Path(addresses[name]) for name in ("left", "right", "above")]
            assert all(tty.is_symlink() and tty.resolve().is_char_device() for tty in ttys)
            socket.create_connection(("127.0.0.1", camera.command_port), timeout=60).close()
            assert any("progress" in record for record in records)
            assert addresses["douser"] == f"127.0.0.1:{port}"
            packet = DataPacket(tuple(range(16)), "desk", 1, (0, 0, 0, 0, 255))
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as desk:
                desk.sendto(bytes(packet.getBytes()), ("127.0.0.1", port))
            told = [json.loads(next(process.stdout)) for _ in range(2)] if process.stdout is not None else []
            # No one continues sending.
            assert told == [{"douser": "above", "open": True}, {"douser": "above", "open": False}]
            assert [power_of(tty, patience_s=0.5) for tty in ttys[:2]] == [b"", b""], "these two have no mains"
            assert power_of(ttys[2]) == b"OK0\r"
            variables = next(record["environment"] for record in records if "environment" in record)
            subprocess.run(["usbrelay", "BENCH_2=1"], env={**os.environ, **variables}, check=True, capture_output=True)
            told = [json.loads(next(process.stdout)) for _ in range(2)] if process.stdout is not None else []
            assert told == [{"mains": name, "on": True, "damages": 0} for name in ("left", "right")]
            said: list[bytes] = []
            while said != [b"OK0\r"] * 3 and time.monotonic() < ends_s:
                said = [power_of(tty, patience_s=2) for tty in ttys]
            assert said == [b"OK0\r"] * 3
        finally:
            process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=20) == 0
    assert not any(tty.is_symlink() for tty in ttys)


SIX = ("benq", "nec", "hitachi", "panasonic-dz", "sony-adcp", "jvc")
"""As many as a bench may have, in every notation, three of them on their LAN port."""


def test_projectors_of_many_families_are_served_on_serial_lines_and_lan_ports(
    tmp_path: Path, shrink: Callable[[BenchTruth], BenchTruth]
) -> None:
    assert set(SIX) < set(BOARDS) - {DEFAULT_BOARD}
    EmulatedBench(Stands(len(SIX))).prepare(tmp_path / "stage", size="small", object_file=None, seed=11)
    truth = shrink(read_truth(tmp_path / "stage"))
    others = [
        dataclasses.replace(projector, board=family, **network_of(family))
        for projector, family in zip(truth.projectors, SIX, strict=True)
    ]
    write_truth(tmp_path / "stage", dataclasses.replace(truth, projectors=tuple(others)))
    with served(tmp_path / "stage") as process:
        try:
            assert not [record for record in until_ready(process) if "error" in record]
            for projector in others:
                driver = opened(tmp_path / "stage", projector)
                driver.switch_on(deadline=in_seconds(60))
                assert driver.status(deadline=in_seconds(20)).power in (Power.WARMING, Power.ON), projector.board
                driver.close()
        finally:
            process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=20) == 0


def network_of(family: str) -> dict[str, Any]:
    """A free TCP port and a password, for a family with a login."""
    if login_of(family) in ("", "none"):
        return {}
    with socket.create_server(("127.0.0.1", 0)) as free:
        return {"tcp_port": free.getsockname()[1], "password": "secret12"}


def opened(stage: Path, projector: ProjectorTruth) -> SerialProjector:
    settings = {"profile": f"bench/{projector.board}-fast.toml"}
    if not projector.tcp_port:
        return open_serial_projector({**settings, "port": projector.port}, OpenContext(stage), in_seconds(20))
    settings |= {"address": f"127.0.0.1:{projector.tcp_port}", "password": projector.password}
    return open_network_projector(settings, OpenContext(stage), in_seconds(20))


@pytest.mark.parametrize(("board", "tcp_port"), [("sony-adcp", 0), ("sanyo", 4001)])
def test_a_family_on_a_wire_that_it_does_not_have_is_refused(prepared: Path, board: str, tcp_port: int) -> None:
    truth = read_truth(prepared)
    odd = dataclasses.replace(truth.projectors[0], board=board, tcp_port=tcp_port)
    with pytest.raises(DeviceError) as caught:
        projector_on_its_wire(prepared, odd, EmulatedLamp(LampTiming(0.1, 0.1)), 0.0)
    assert caught.value.code == "board-without-wire"
    assert board in caught.value.what


def test_a_family_without_a_board_is_refused_with_those_there_are(prepared: Path) -> None:
    truth = read_truth(prepared)
    odd = dataclasses.replace(truth.projectors[0], board="pjlink")
    write_truth(prepared, dataclasses.replace(truth, projectors=(odd, *truth.projectors[1:])))
    process = served(prepared)
    out, _ = process.communicate(timeout=60)
    assert process.returncode == 3
    error = json.loads(out.splitlines()[-1])["error"]
    assert error["code"] == "board-unknown"
    assert "benq" in error["remedy"]


def test_a_port_in_use_is_told_in_a_sentence_before_anything_is_served(prepared: Path) -> None:
    with socket.create_server(("127.0.0.1", read_truth(prepared).camera.command_port)):
        process = served(prepared)
        out, err = process.communicate(timeout=60)
    assert process.returncode == 3
    error = json.loads(out.splitlines()[-1])["error"]
    assert error.keys() == {"code", "what", "remedy"}
    assert error["code"] == "port-in-use"
    assert err == ""
    assert not (prepared / "run" / "tty-left").exists()


def test_a_mesh_without_faces_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    (tmp_path / "cloud.obj").write_text("v 0 0 0\nv 1 1 1\n")
    with pytest.raises(DeviceError) as refused:
        EmulatedBench().prepare(tmp_path / "stage", size="small", object_file=tmp_path / "cloud.obj", seed=1)
    assert refused.value.code == "object-no-faces"
    assert not (tmp_path / "stage").exists()


def test_an_unknown_size_is_refused_with_those_there_are(tmp_path: Path) -> None:
    with pytest.raises(DeviceError, match="small, medium, paper"):
        EmulatedBench().prepare(tmp_path / "stage", size="huge", object_file=None, seed=1)
    assert not (tmp_path / "stage").exists()


def test_the_controllers_tables_hold_nothing_of_the_truth(tmp_path: Path) -> None:
    tables = EmulatedBench().prepare(tmp_path / "stage", size="small", object_file=None, seed=5)
    truth = read_truth(tmp_path / "stage")
    text = json.dumps(tables)
    for secret in (truth.camera.lens.focal_px, truth.projectors[0].lens.focal_px, truth.projectors[0].light.gamma[0]):
        assert f"{secret:.4f}"[:7] not in text
    assert set(tables) == {"projectors", "camera", "display"}


class Lamp:
    def __init__(self) -> None:
        self.level = 1.0

    def light_level(self) -> float:
        return self.level


@pytest.fixture
def lamps() -> list[Lamp]:
    return [Lamp(), Lamp(), Lamp()]


@pytest.fixture
def world(prepared: Path, lamps: list[Lamp]) -> Iterator[World]:
    with World(prepared, dataclasses.replace(read_truth(prepared), time_scale=0.5), lamps) as made:
        yield made


def show(stage: Path, value: int, at_s: float, sequence: int) -> None:
    """A whole memory output with one grey on every projector."""
    truth = read_truth(stage)
    frames, entries, pixels = len(truth.projectors), b"", b""
    for projector in truth.projectors:
        width, height = projector.lens.size_px
        offset = 4096 + len(pixels)
        entries += np.array([(projector.output.encode(), width, height, offset, 0)], ENTRY).tobytes()
        pixels += bytes([value]) * (width * height * 3)
        pixels += bytes(-len(pixels) % 4096)
    size = 4096 + len(pixels)
    head = np.array([(b"VELFRAME", 1, frames, sequence, at_s, size, b"")], HEADER).tobytes()
    temporary = stage / "run" / "new"
    temporary.write_bytes((head + entries).ljust(4096, b"\0") + pixels)
    temporary.replace(stage / truth.frames)


ENTRY = np.dtype([("name", "S40"), ("w", "<u4"), ("h", "<u4"), ("at", "<u8"), ("zero", "<u8")])
HEADER = np.dtype(
    [("magic", "S8"), ("v", "<u4"), ("n", "<u4"), ("seq", "<u8"), ("at", "<f8"), ("size", "<u8"), ("pad", "V24")]
)


def signal_of(world: World, tmp_path: Path, settings: ShotSettings = WHITE) -> float:
    data = world.expose(settings).raw
    assert data is not None
    (tmp_path / "shot.dng").write_bytes(data)
    with rawpy.imread(str(tmp_path / "shot.dng")) as raw:
        return float(np.percentile(raw.raw_image_visible, 90)) - 128.0


def test_the_camera_sees_what_is_shown_and_only_while_lamps_burn(
    world: World, lamps: list[Lamp], prepared: Path, tmp_path: Path
) -> None:
    nothing_shown = signal_of(world, tmp_path)
    show(prepared, 255, time.monotonic() - 1.0, 2)
    white = signal_of(world, tmp_path)
    for lamp in lamps:
        lamp.level = 0.0
    dark = signal_of(world, tmp_path)
    assert white > 1500
    assert nothing_shown < 30
    assert dark < 30


def test_white_is_well_exposed_at_a_fifteenth_of_a_second(world: World, prepared: Path, tmp_path: Path) -> None:
    show(prepared, 255, time.monotonic() - 1.0, 2)
    files = world.expose(WHITE)
    assert files.raw is not None
    assert files.jpeg is None
    (tmp_path / "white.dng").write_bytes(files.raw)
    with rawpy.imread(str(tmp_path / "white.dng")) as raw:
        assert 2500 < np.percentile(raw.raw_image_visible, 99.5) < 4090


def test_a_frame_that_appears_in_the_middle_of_an_exposure_counts_for_its_share(
    world: World, prepared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    exposed_s: list[tuple[float, float]] = []
    during = world._visible.during

    def noted(start_s: float, end_s: float) -> Any:
        exposed_s.append((start_s, end_s))
        return during(start_s, end_s)

    # When the shutter really was open: a loaded machine opens it late, and closes it late.
    monkeypatch.setattr(world._visible, "during", noted)
    show(prepared, 255, time.monotonic() - 1.0, 2)
    quarter = dataclasses.replace(WHITE, exposure_s=0.8, aperture_f=32.0)
    whole = signal_of(world, tmp_path, quarter)
    dark_at_s = time.monotonic() + 0.2
    show(prepared, 0, dark_at_s, 4)
    part = signal_of(world, tmp_path, quarter)
    start_s, end_s = exposed_s[-1]
    share = (dark_at_s + 2 / 60 - start_s) / (end_s - start_s)
    assert part / whole == pytest.approx(min(1.0, max(0.0, share)), abs=0.06)
