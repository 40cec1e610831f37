"""Streams by other programs: FFmpeg's over UDP, GStreamer's RTSP server, NDI's own sender; lost, stalled and back."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from controller.core.arrays import ByteImage
from controller.core.errors import UsageError
from controller.stage.live import LivePicture, Lost, StreamSource, is_stream, open_stream, without_password
from controller.stage.steps.appearance.live import TargetMaker, run_live
from tests.ports import kept_port
from tests.waiting import eventually, wait_for

HERE = Path(__file__).parent
COLOUR = (64, 128, 192)
SIZE = (160, 120)
SYSTEM_PYTHON = "/usr/bin/python3"
NDI_LOSES = 6
"""Of 255, by its own compression: 64, 128, 192 arrive as 62, 127, 186 at every size."""


def has_rtsp_server() -> bool:
    asked = "import gi; gi.require_version('GstRtspServer', '1.0'); from gi.repository import GstRtspServer"
    return subprocess.run([SYSTEM_PYTHON, "-c", asked], capture_output=True, check=False).returncode == 0


needs_ffmpeg = pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="needs ffmpeg (a package of the test set-up)")


def encoded(*more: str, rate: int = 25) -> list[str]:
    colour = "".join(f"{value:02x}" for value in COLOUR)
    return ["ffmpeg", "-nostdin", "-loglevel", "error", "-y", *more, "-f", "lavfi",
            "-i", f"color=c=0x{colour}:s={SIZE[0]}x{SIZE[1]}:r={rate}", "-c:v", "libx264", "-preset", "ultrafast",
            "-tune", "zerolatency", "-g", "5", "-pix_fmt", "yuv420p"]  # fmt: skip


@contextlib.contextmanager
def running(command: Sequence[str], **more: Any) -> Iterator[subprocess.Popen[bytes]]:
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, **more) as process:
        try:
            yield process
        finally:
            process.kill()


@contextlib.contextmanager
def sent(port: int) -> Iterator[subprocess.Popen[bytes]]:
    """FFmpeg sends a picture of one colour over UDP, as a media server does."""
    with running([*encoded("-re"), "-f", "mpegts", f"udp://127.0.0.1:{port}?pkt_size=1316"]) as process:
        yield process


def is_sent(picture: ByteImage, within: int = 4) -> bool:
    """Whether it is the picture that is sent, within what video's colours lose."""
    return picture.shape == (SIZE[1], SIZE[0], 3) and int(np.abs(picture.astype(int) - COLOUR).max()) <= within


def newest(source: StreamSource) -> LivePicture | None:
    with contextlib.suppress(UsageError):
        return source.next(0.0)
    return None


@needs_ffmpeg
def test_a_stalled_stream_keeps_its_last_picture_and_one_that_comes_back_goes_on() -> None:
    shown: list[ByteImage] = []
    told: list[int] = []
    lost, back, over = threading.Event(), threading.Event(), threading.Event()

    def tell(figures: Any) -> None:
        told.append(figures.bad)
        if over.is_set():
            raise KeyboardInterrupt

    def show(frames: list[ByteImage]) -> None:
        shown.append(frames[0].copy())
        if lost.is_set():
            back.set()

    with kept_port() as port:
        source = open_stream(f"udp://127.0.0.1:{port}", silent_s=1.0, retry_s=0.1)

        def play() -> None:
            with pytest.raises(KeyboardInterrupt):
                run_live(source, TargetMaker(SIZE), show, rate_hz=50, report=tell)

        worker = threading.Thread(target=play)
        worker.start()
        try:
            with sent(port) as ffmpeg:
                wait_for(lambda: len(shown) > 10)
                ffmpeg.send_signal(signal.SIGSTOP)
                wait_for(lambda: told[-1:] == [1])
            before = len(shown)
            # Long enough for some attempts: it stays lost, and this is no further bad picture.
            time.sleep(1.5)
            assert len(shown) == before
            assert told[-1] == 1
            lost.set()
            with sent(port):
                assert back.wait(20)
        finally:
            over.set()
            worker.join(20)
    assert all(is_sent(picture) for picture in shown), "no black picture, nor any other"
    assert told[-1] == 1


@needs_ffmpeg
@pytest.mark.skipif(not has_rtsp_server(), reason="needs gir1.2-gst-rtsp-server-1.0 (a package of the test set-up)")
def test_rtsp_from_gstreamers_server(tmp_path: Path) -> None:
    subprocess.run([*encoded(), "-t", "3", str(tmp_path / "sent.mp4")], check=True)
    environment = {"PATH": os.environ["PATH"]}  # not that of the tests' own Python
    with kept_port() as port:
        command = [SYSTEM_PYTHON, str(HERE / "rtsp_server.py"), str(port), str(tmp_path / "sent.mp4")]
        source = open_stream(f"rtsp://somebody:secret@127.0.0.1:{port}/stream", silent_s=3.0, retry_s=0.2)
        with contextlib.closing(source), running(command, env=environment):
            source.wait_for_picture(30)
            pictures: list[LivePicture] = []

            def enough() -> bool:
                found = newest(source)
                pictures.extend([] if found is None else [found])
                return len(pictures) > 20

            wait_for(enough)
            assert all(is_sent(one.pixels) for one in pictures)
            numbers = [one.number for one in pictures]
            assert numbers == sorted(set(numbers))
            gaps = np.diff(numbers) - 1
            assert [one.skipped for one in pictures[1:]] == list(gaps)


def test_a_stream_that_sends_nothing_is_refused_without_its_password() -> None:
    with kept_port() as port:
        source = open_stream(f"rtsp://somebody:secret@127.0.0.1:{port}/x", silent_s=1.0, retry_s=0.1)
        with contextlib.closing(source), pytest.raises(UsageError) as refused:
            source.wait_for_picture(0.5)
    assert refused.value.code == "live-source-unreadable"
    assert f"rtsp://127.0.0.1:{port}/x" in refused.value.what
    assert "secret" not in str(refused.value)


@needs_ffmpeg
@pytest.mark.parametrize("kind", ["tcp", "http"])
def test_other_addresses_are_streams_too(tmp_path: Path, kind: str) -> None:
    with kept_port() as port, contextlib.ExitStack() as open_for_now:
        if kind == "tcp":
            command = [*encoded("-re"), "-f", "mpegts", f"tcp://127.0.0.1:{port}?listen=1"]
            address = f"tcp://127.0.0.1:{port}"
        else:
            subprocess.run([*encoded(), "-t", "1", str(tmp_path / "sent.mp4")], check=True)
            command = [
                sys.executable,
                "-m",
                "http.server",
                str(port),
                "--bind",
                "127.0.0.1",
                "--directory",
                str(tmp_path),
            ]
            address = f"http://127.0.0.1:{port}/sent.mp4"
        open_for_now.enter_context(running(command, cwd=tmp_path))
        source = open_for_now.enter_context(contextlib.closing(open_stream(address, silent_s=3.0, retry_s=0.2)))
        source.wait_for_picture(20)
        # FFmpeg has the first pictures of a live stream at once: it looks at them before.
        began_s, count = time.monotonic(), 0
        while count < 40:
            picture = newest(source)
            if picture is not None:
                assert is_sent(picture.pixels)
                count = picture.number
            time.sleep(0.005)
        assert time.monotonic() - began_s > (0.2 if kind == "tcp" else 0.9), "at its own pace"


def test_a_stream_that_stays_away_is_black_after_a_while() -> None:
    class Once:
        sent = False

        def read(self) -> ByteImage:
            if Once.sent:
                raise Lost("it is away")
            Once.sent = True
            return np.full((4, 4, 3), 9, np.uint8)

        def close(self) -> None:
            """Nothing is open."""

    source = StreamSource("a stream", Once, retry_s=0.01)
    with contextlib.closing(source):
        source.wait_for_picture()
        assert source.next(0.0) is not None
        told: list[str] = []

        def gone() -> bool:
            try:
                source.next(1.0)
            except UsageError as error:
                told.append(error.code)
            return bool(told)

        wait_for(gone)
        assert source.next(30.0) is None
        black = source.next(31.5)
        assert black is not None
        assert not black.pixels.any()
        assert source.next(32.0) is None
        assert told == ["live-source-gone"]
        Once.sent = False
        wait_for(lambda: (one := source.next(33.0)) is not None and one.pixels.any())


def test_a_camera_that_is_not_there_is_named() -> None:
    with contextlib.closing(open_stream("/dev/video97")) as source, pytest.raises(UsageError) as refused:
        source.wait_for_picture(0.5)
    assert "/dev/video97 (there is no such device)" in refused.value.what


def test_a_reader_that_hangs_is_left_behind() -> None:
    entered = threading.Event()

    class Hanging:
        def read(self) -> ByteImage:
            entered.set()
            threading.Event().wait(30)
            raise Lost("never")

        def close(self) -> None:
            """Nothing is open."""

    source = StreamSource("a stream", Hanging)
    assert entered.wait(10)
    began_s = time.monotonic()
    assert source.next(0.0) is None
    source.close()
    assert time.monotonic() - began_s < 5


@pytest.mark.parametrize(
    ("text", "stream"),
    [("rtsp://host/x", True), ("RTSPS://host", True), ("udp://@:5000", True), ("ndi://PC (out 1)", True),
     ("/dev/video0", True), ("/dev/video", False), ("video.mp4", False), ("rtsp:/host", False), ("ftp://x/y", False),
     ("http://host/video.mp4", True), ("HTTPS://host/live.m3u8", True), ("tcp://host:9000", True),
     ("srt://host:9000?mode=caller", True), ("http:/host", False),
     ("rtsp://", False)],
)  # fmt: skip
def test_addresses_of_streams_are_told_from_files(text: str, *, stream: bool) -> None:
    assert is_stream(text) is stream


def test_passwords_are_left_out_of_messages() -> None:
    assert without_password("rtsp://me:p%40ss@host:554/a@b") == "rtsp://host:554/a@b"
    assert without_password("ndi://PC (a@b)") == "ndi://PC (a@b)"


@pytest.mark.parametrize("address", ["srt://host:9000", "SRT://host:9000?mode=listener"])
def test_srt_is_refused_at_once_with_the_way_round_it(address: str) -> None:
    with pytest.raises(UsageError, match="udp://") as refused:
        open_stream(address)
    assert refused.value.code == "live-source-unreadable"


def test_ndi_without_its_runtime_is_refused_in_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cyndilib", None)
    with pytest.raises(UsageError) as refused:
        open_stream("ndi://PC (out)")
    assert refused.value.code == "extra-missing"
    assert "velatura[ndi]" in refused.value.remedy


def test_ndi_from_its_own_sender(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    finder = pytest.importorskip("cyndilib.finder", reason="needs cyndilib (extra ndi)")
    # Sources are asked for on this computer alone: the machine of a test may have no multicast.
    (tmp_path / "ndi-config.v1.json").write_text('{"ndi": {"networks": {"ips": "127.0.0.1"}}}')
    monkeypatch.setenv("NDI_CONFIG_DIR", str(tmp_path))
    name = f"velatura test {os.getpid()}"
    with running([sys.executable, str(HERE / "ndi_sender.py"), name], stdin=subprocess.PIPE) as sender:
        with finder.Finder() as found:
            assert eventually(lambda: [one for one in found.update_sources() if name in one], every_s=0.1)
            (address,) = (one for one in found.get_source_names() if name in one)
        with contextlib.closing(open_stream(f"ndi://{address}", silent_s=2.0, retry_s=0.2)) as source:
            source.wait_for_picture(20)
            wait_for(lambda: bool((one := newest(source)) and is_sent(one.pixels, NDI_LOSES)))
            sender.send_signal(signal.SIGSTOP)

            def lost() -> bool:
                try:
                    source.next(0.0)
                except UsageError as error:
                    return error.code == "live-source-gone"
                return False

            wait_for(lost)
            sender.send_signal(signal.SIGCONT)
            wait_for(lambda: bool((one := newest(source)) and is_sent(one.pixels, NDI_LOSES)))
