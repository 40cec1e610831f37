"""The shutter button of a Canon EOS body, and bulb: pressed once, and always released."""

from __future__ import annotations

from typing import Final

from hal.codecs.ptp.values import Operation
from hal.deadline import Deadline, in_seconds
from hal.errors import DeviceRefused
from plugins.ptp.canon.conversation import EosTalk
from plugins.ptp.link import Reply
from plugins.ptp.shot import Shot

_HALF, _FULL = 1, 2
_LET_GO_S: Final = 2.0
_RELEASE_ERRORS: Final = {
    1: ("camera-autofocus", "its autofocus failed", "Switch the lens to manual focus, then try again."),
    3: ("camera-mirror", "its mirror is up", "Leave live view and switch mirror lock-up off, then try again."),
    7: ("card-full", "its memory is full", "Empty or replace the card, then continue. Nothing was exposed."),
    8: ("card-unusable", "its card is write-protected", "Unlock the card. Nothing was exposed."),
}


class EosShutter:
    """Presses and releases; the caller interprets the answers."""

    def __init__(self, talk: EosTalk) -> None:
        self._talk = talk
        self._channel = talk.channel

    @property
    def bulb(self) -> bool:
        """Whether the body has commands to open and close the shutter."""
        return self._channel.has(Operation.EOS_BULB_START) and self._channel.has(Operation.EOS_BULB_END)

    def press(self, shot: Shot, *, bulb: bool, deadline: Deadline) -> Reply:
        """Press and release. The answer to the full press decides."""
        if bulb:
            return self._hold(shot, deadline)
        patience_s = self._channel.timing.answer_s + 2 * shot.exposure_s
        if not self._channel.has(Operation.EOS_RELEASE_ON):
            shot.fire()
            return self._channel.once(Operation.EOS_RELEASE, patience_s=patience_s, deadline=deadline)
        try:
            half = self._channel.once(Operation.EOS_RELEASE_ON, _HALF, 0, deadline=deadline)
            if not half.ok or any(half.parameters[:1]):
                return half
            shot.fire()
            return self._channel.once(Operation.EOS_RELEASE_ON, _FULL, 0, patience_s=patience_s, deadline=deadline)
        finally:
            # In every case: a body whose button stays down takes no further picture.
            self.let_go()

    def let_go(self) -> None:
        """With its own deadline, so that the caller's deadline or cancellation does not leave the button down."""
        for button in (_FULL, _HALF):
            if self._channel.has(Operation.EOS_RELEASE_OFF) and not self._channel.link.broken:
                self._channel.once(Operation.EOS_RELEASE_OFF, button, deadline=in_seconds(_LET_GO_S))

    def close(self) -> None:
        """Close a shutter that bulb may have left open."""
        if self.bulb and not self._channel.link.broken:
            self._channel.once(Operation.EOS_BULB_END, deadline=in_seconds(_LET_GO_S))

    def _hold(self, shot: Shot, deadline: Deadline) -> Reply:
        """Hold the shutter open for the exposure."""
        shot.fire()
        # Not cancelled before its answer: that would end the connection, and leave the shutter open.
        opened = self._channel.once(Operation.EOS_BULB_START, deadline=Deadline(deadline.at_s))
        if not opened.ok or any(opened.parameters[:1]):
            return opened
        shot.held = True
        try:
            while (left_s := shot.exposure_s - shot.age_s()) > 0:
                deadline.sleep(min(left_s, max(0.001, left_s - 0.05), 1.0))
                if left_s > 2.0:
                    self._talk.keep_alive(deadline)
                if deadline.passed:
                    break
        finally:
            self.close()
        shot.held = deadline.passed
        return opened


def released(reply: Reply) -> bool:
    return reply.ok and not any(reply.parameters[:1])


def not_released(code: int) -> DeviceRefused:
    """The error for this answer of the body to a press."""
    name, why, remedy = _RELEASE_ERRORS.get(
        code, ("camera-not-released", f"it gave the unknown reason {code}", "Switch it off and on, then try again.")
    )
    return DeviceRefused(name, what=f"The camera took no picture: {why}.", remedy=remedy)
