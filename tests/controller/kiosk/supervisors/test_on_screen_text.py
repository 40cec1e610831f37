"""Text on the projectors at the first start: shown by the real player, and lit for as long as it is needed."""

from __future__ import annotations

import time
from pathlib import Path

import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from controller.core.plotting import font_file
from controller.core.storage import runtime_folder
from controller.kiosk.decide.interfaces import BLACK
from controller.kiosk.store.accounts import Accounts
from controller.kiosk.supervisors.on_screen_text import notice
from controller.kiosk.supervisors.player_supervisor import NOTICE_TURN_S, PlayerSupervisor
from controller.play.control.launch import PlayerSettings
from controller.play.frames import FrameSet, OutputSize
from controller.run.state_machine import State
from hal.notices import Notice
from tests.controller.kiosk.model import NAMES, Kiosk
from tests.controller.panel.served import QUICK_HASH

OUTPUTS = (OutputSize("P1", 280, 210), OutputSize("P2", 320, 180))
LINES = ("velatura", "http://127.0.0.1:8377", "technician", "abcd-efgh-2345-wxyz")


def shown(frames: Path) -> FrameSet:
    """What the memory output holds; black before it is there."""
    if not frames.exists():
        return FrameSet.black(OUTPUTS)
    data = np.memmap(frames, np.uint8, "r")
    found, at = [], 4096
    for output in OUTPUTS:
        size = int(np.prod(output.shape))
        found.append(np.array(data[at : at + size]).reshape(output.shape))
        at += size + -size % 4096
    return FrameSet(tuple(found))


def test_the_player_shows_the_lines_on_one_output_after_the_other_and_black_when_they_are_gone(tmp_path: Path) -> None:
    told: list[Notice] = []
    frames, now_s = tmp_path / "outputs.frame", 0.0
    settings = PlayerSettings([(one.name, one.width_px, one.height_px) for one in OUTPUTS], frames)
    supervisor = PlayerSupervisor(
        runtime_folder(tmp_path), lambda plays: settings, told.append, monotonic=lambda: now_s
    )

    def wait_for(wanted: FrameSet) -> None:
        until_s = time.monotonic() + 60
        while not all(map(np.array_equal, shown(frames).pixels, wanted.pixels)):
            assert time.monotonic() < until_s, [one.text for one in told]
            supervisor.step()

    try:
        supervisor.notice = LINES
        for turn in (0, 1):
            now_s = turn * NOTICE_TURN_S
            wait_for(notice(OUTPUTS, LINES, turn))
        supervisor.notice = ()
        wait_for(FrameSet.black(OUTPUTS))
    finally:
        supervisor.close()


def test_every_line_has_its_place_and_fits() -> None:
    for turn in range(len(OUTPUTS)):
        image = notice(OUTPUTS, LINES, turn).pixels[turn]
        rows = np.flatnonzero(image.any(axis=(1, 2)))
        assert np.count_nonzero(np.diff(rows) > 1) == len(LINES) - 1, "one gap between two lines"
        assert not image[:, [0, -1]].any()


def test_letters_are_those_of_the_typeface_that_ships_with_velatura() -> None:
    font = ImageFont.truetype(str(font_file()), 80)
    with np.load(font_file().with_name("letters.npz")) as kept:
        pictures, advances = kept["pictures"], kept["advances"]
    for place, character in enumerate(map(chr, range(ord(" "), ord("~") + 1))):
        drawn = Image.new("L", (96, 96))
        ImageDraw.Draw(drawn).text((0, 72), character, font=font, fill=255, anchor="ls")
        assert np.abs(np.asarray(drawn, int)[:, : pictures.shape[2]] - pictures[place]).mean() < 1
        assert advances[place] == round(font.getlength(character))


def test_a_telephone_reads_the_address_that_others_reach() -> None:
    lines = ("velatura", "https://192.0.2.17:8377/", "technician", "abcd-efgh-2345-wxyz")
    sizes = (OutputSize("P1", 1400, 1050), OutputSize("P2", 800, 600))
    for turn in range(len(sizes)):
        image = notice(sizes, lines, turn).pixels[turn]
        read, _, _ = cv2.QRCodeDetector().detectAndDecode(image)
        assert read == lines[1]
        text = image[image.shape[0] // 2 :]
        assert np.count_nonzero(np.diff(np.flatnonzero(text.any(axis=(1, 2)))) > 1) == len(lines) - 1
    seen = notice(sizes, ("velatura", "http://127.0.0.1:8377/"), 0).pixels[0]
    assert not cv2.QRCodeDetector().detect(seen)[0]


def test_a_one_time_password_is_taken_as_the_projectors_show_it(tmp_path: Path) -> None:
    accounts = Accounts(tmp_path / "accounts.json", hasher=QUICK_HASH)
    password = accounts.first_start()
    assert password is not None
    assert accounts.verify("technician", password.upper()) is not None
    assert not accounts.entered
    accounts.set_password("technician", "Some Words of Mine")
    assert accounts.entered
    assert accounts.verify("technician", "SOME WORDS OF MINE") is None


def test_lamps_stay_lit_for_whoever_aims_also_when_closed_and_until_somebody_closes(tmp_path: Path) -> None:
    kiosk = Kiosk(tmp_path)
    kiosk.run_until(State.PLAYING)
    kiosk.reconciler.shut()
    kiosk.run_until(State.OFF)
    kiosk.reconciler.light_for(600.0)
    kiosk.run(60)
    assert kiosk.state is State.OFF, "a notice is nothing for a closed stage"
    kiosk.reconciler.light_for(600.0, closed_too=True)
    kiosk.run_until(State.READY)
    assert kiosk.player.view.shown == BLACK
    kiosk.reconciler.shut()
    kiosk.run_until(State.OFF)
    assert not kiosk.lit
    assert not kiosk.sins


def test_lamps_are_lit_for_a_notice_and_cool_when_it_is_over(tmp_path: Path) -> None:
    kiosk = Kiosk(tmp_path)
    kiosk.bundles.installed = None
    kiosk.reconciler.light_for(600.0)
    kiosk.run_until(State.READY)
    assert kiosk.lit == list(NAMES)
    kiosk.run(500)
    assert kiosk.state is State.READY
    kiosk.run_until(State.OFF)
    assert not kiosk.lit
    assert not kiosk.sins
