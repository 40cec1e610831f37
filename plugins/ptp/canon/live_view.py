"""Live view of Canon EOS bodies that have it (9153): for aiming, and off before any picture."""

from __future__ import annotations

from typing import Final

from hal.codecs.ptp.eos import VIEW_TO_COMPUTER, EosProperty, parse_view
from hal.codecs.ptp.values import Operation
from hal.deadline import Deadline
from hal.errors import DeviceTimeout
from plugins.ptp.body import no_live_view
from plugins.ptp.canon.conversation import EosTalk
from plugins.ptp.link import refused

_WHOLE_FRAME: Final = (0x0020_0000, 0, 0)


class EosView:
    """``on`` while live view is active."""

    def __init__(self, talk: EosTalk) -> None:
        self._talk = talk

    @property
    def able(self) -> bool:
        return self._talk.channel.has(Operation.EOS_GET_VIEWFINDER) and self._talk.state.knows(EosProperty.VIEW_OUTPUT)

    @property
    def on(self) -> bool:
        return self.able and self._talk.state.number(EosProperty.VIEW_OUTPUT) & VIEW_TO_COMPUTER != 0

    def frame(self, deadline: Deadline) -> bytes:
        """One JPEG. The body answers "busy" or "not ready" until the first frame is there."""
        if not self.able:
            raise no_live_view()
        talk = self._talk
        if not self.on:
            if talk.state.knows(EosProperty.VIEW_MODE):
                talk.set(EosProperty.VIEW_MODE, 1, deadline)
            talk.set(EosProperty.VIEW_OUTPUT, VIEW_TO_COMPUTER, deadline)
        until = deadline.within(talk.channel.timing.busy_s)
        while True:
            talk.keep_alive(deadline)
            # Every body is busy until its mirror is up: that is no trouble.
            reply = talk.channel.once(Operation.EOS_GET_VIEWFINDER, *_WHOLE_FRAME, deadline=deadline, note_busy=False)
            if reply.ok:
                return parse_view(reply.data)
            if not reply.busy:
                raise refused(reply, "show live view")
            if until.passed:
                raise DeviceTimeout(
                    "camera-no-view",
                    what="The camera sent no live view picture in time.",
                    remedy="Enable live view in its menu, leave its menus, then try again.",
                )
            talk.drain(deadline)
            until.sleep(0.02)

    def end(self, deadline: Deadline) -> None:
        if self.on:
            self._talk.set(EosProperty.VIEW_OUTPUT, 0, deadline)
