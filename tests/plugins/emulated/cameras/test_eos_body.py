"""The emulated EOS body, operation by operation."""

from __future__ import annotations

import struct
from collections.abc import Callable

import pytest

from lab.emulated.cameras.camera import EmulatedPtpCamera
from plugins.emulated.cameras.body import EmulatedBody
from plugins.emulated.cameras.wire import OK
from tests.plugins.ptp.ptp_rig import Studio

MIRROR_IS_UP = 3


def view(body: EmulatedBody, value: int) -> None:
    assert body.answer(0x9110, (), struct.pack("<III", 12, 0xD1B0, value)).code == OK


def pressed(body: EmulatedBody) -> tuple[int, ...]:
    """What a full press of the release tells."""
    assert body.answer(0x9128, (1, 0), b"").code == OK
    return body.answer(0x9128, (2, 0), b"").parameters


@pytest.mark.parametrize("end", [lambda body: body.answer(0x1003, (), b""), lambda body: body.disconnected()])
def test_live_view_ends_with_its_session_however_that_ends(end: Callable[[EmulatedBody], object]) -> None:
    with EmulatedPtpCamera(Studio().expose, flavour="eos-new", time_scale=0.0) as camera:
        body = camera.body
        body.answer(0x1002, (1,), b"")
        view(body, 2)
        assert pressed(body) == (MIRROR_IS_UP,), "in live view the mirror is up"
        end(body)
        body.answer(0x1002, (1,), b"")
        assert MIRROR_IS_UP not in pressed(body)
        assert body.answer(0x9153, (0x100000,), b"").code != OK, "no frame without live view"
