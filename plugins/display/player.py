"""The display through the player process (docs/reference/player-protocol.md)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hal.codecs.player import PROTOCOL, protocol_broken
from hal.deadline import Deadline
from hal.errors import DeviceGone, DeviceRefused, PluginError
from hal.player import Inbox, PlayerClient
from hal.registry import Driver, OpenContext
from hal.values import DeviceIdentity, LiveStatus, OutputInfo, PlaybackStatus, Presented


class PlayerDisplay:
    """A running player as a display. Reconnects after the player was restarted.

    It is a ``hal.interfaces.BundleDisplay`` and also has ``status``. Not for several threads at once.
    """

    def __init__(self, path: Path, expected: tuple[OutputInfo, ...] | None) -> None:
        """``expected``: the outputs that the player must have, or None for any."""
        self._path, self._expected = path, expected
        self._client = PlayerClient()
        self._inbox: Inbox | None = None
        self._outputs: tuple[OutputInfo, ...] = ()
        self._closed = False

    # --- hal.interfaces.Display ---------------------------------------------------------------------------------

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        """The player's name and the protocol that it speaks; its process number stands for the serial number."""
        hello = self._request({"op": "hello"}, deadline)
        return DeviceIdentity(
            "Velatura", str(hello["player"]), serial=str(hello["pid"]), firmware=f"protocol {hello['protocol']}"
        )

    def outputs(self, *, deadline: Deadline) -> tuple[OutputInfo, ...]:
        """The outputs of the running player, in stage order."""
        self._connect(deadline)
        return self._outputs

    def show(self, frames: Mapping[str, npt.NDArray[np.uint8]], *, deadline: Deadline) -> Presented:
        """Show one frame per output; see ``hal.interfaces.Display.show``."""
        inbox = self._connect(deadline)
        self._check(frames)
        return _presented(self._request({"op": "show", "sequence": inbox.put(frames)}, deadline))

    def play(self, appearance: str, *, deadline: Deadline) -> Presented:
        """Show an appearance of the player's bundle; see ``hal.interfaces.Display.play``."""
        return _presented(self._request({"op": "play", "appearance": appearance}, deadline))

    def close(self) -> None:
        """Disconnect from the player; its picture stays."""
        self._closed = True
        self._hang_up()

    # --- hal.interfaces.BundleDisplay -------------------------------------------------------------------------------

    def play_sequence(
        self,
        items: Sequence[tuple[str, float] | tuple[str, float, float]],
        *,
        deadline: Deadline,
        repeat: int = 0,
        rate_hz: float | None = None,
    ) -> Presented:
        """Show appearances one after the other; see ``hal.interfaces.BundleDisplay.play_sequence``.

        ``rate_hz``: pictures change at multiples of 1 / rate_hz seconds; None: at the player's own rate.
        """
        request = {"op": "sequence", "items": [list(item) for item in items], "repeat": repeat, "rate_hz": rate_hz}
        return _presented(self._request(request, deadline))

    def stop(self, *, deadline: Deadline) -> Presented:
        """Show black."""
        return _presented(self._request({"op": "stop"}, deadline))

    def live(self, file: Path, *, deadline: Deadline, white: float | None = None) -> None:
        """Show pictures live from a shared frame file; see ``hal.interfaces.BundleDisplay.live``."""
        self._request({"op": "live", "file": str(file.resolve()), "white": white}, deadline)

    def identify(self, *, deadline: Deadline) -> Presented:
        """Show each output's number, name and size."""
        return _presented(self._request({"op": "identify"}, deadline))

    def status(self, *, deadline: Deadline) -> dict[str, Any]:
        """The player's status: the keys of "status" in docs/reference/player-protocol.md."""
        return self._request({"op": "status"}, deadline)

    def playing(self, *, deadline: Deadline) -> PlaybackStatus:
        """The picture shown now, and timing; see ``hal.interfaces.BundleDisplay.playing``."""
        answer = self.status(deadline=deadline)
        try:
            return PlaybackStatus(
                swaps=int(answer["swaps"]),
                presented_at_s=float(answer["presented_at"]),
                running=bool(answer["sequence_running"]),
                late=int(answer["late"]),
                appearance=answer["appearance"],
                bundle=answer["bundle"],
                interval_p50_s=answer["interval_p50_s"],
                interval_p99_s=answer["interval_p99_s"],
                rss_bytes=int(answer["rss_bytes"]),
                live=_live(answer.get("live")),
            )
        except (KeyError, TypeError, ValueError) as error:
            raise protocol_broken("its status is incomplete") from error

    def load_bundle(self, path: Path, *, deadline: Deadline) -> str:
        """Let the player use another bundle; returns the bundle's identity (hex)."""
        return str(self._request({"op": "load-bundle", "path": str(path.resolve())}, deadline)["bundle"])

    def _request(self, request: Mapping[str, Any], deadline: Deadline) -> dict[str, Any]:
        """As ``PlayerClient.request``, and raises as ``_connect``."""
        self._connect(deadline)
        return self._client.request(self._path, request, deadline)

    def _connect(self, deadline: Deadline) -> Inbox:
        """Connect unless connected; returns the inbox of this player.

        Raises as ``PlayerClient.request``, and DeviceGone("display-closed"), DeviceRefused("player-protocol" or
        "player-outputs-differ").
        """
        if self._closed:
            raise DeviceGone("display-closed", what="The display was closed.", remedy="Open it again to use it.")
        if self._inbox is not None and self._client.is_connected:
            return self._inbox
        self._hang_up()
        try:
            hello = self._client.request(self._path, {"op": "hello"}, deadline)
            self._outputs = self._checked_outputs(hello)
            self._inbox = Inbox(Path(hello["inbox"]), self._outputs)
        except BaseException:
            self._hang_up()
            raise
        return self._inbox

    def _checked_outputs(self, hello: Mapping[str, Any]) -> tuple[OutputInfo, ...]:
        try:
            outputs = tuple(OutputInfo(o["name"], o["width_px"], o["height_px"]) for o in hello["outputs"])
            protocol, _ = hello["protocol"], Path(hello["inbox"])
        except (KeyError, TypeError) as error:
            raise protocol_broken("its answer to hello lacks a key") from error
        if protocol != PROTOCOL:
            raise DeviceRefused(
                "player-protocol",
                what=f"The player has protocol {protocol}, but this driver has {PROTOCOL}.",
                remedy="Install player and controller of the same release, and restart the player.",
            )
        if self._expected is not None and self._expected != outputs:
            raise DeviceRefused(
                "player-outputs-differ",
                what=f"The player has the outputs {_listed(outputs)}, but stage.toml has {_listed(self._expected)}.",
                remedy="Restart the player for this stage, or correct [[display.outputs]].",
            )
        return outputs

    def _hang_up(self) -> None:
        self._client.hang_up()
        inbox, self._inbox = self._inbox, None
        if inbox is not None:
            inbox.close()

    def _check(self, frames: Mapping[str, npt.NDArray[np.uint8]]) -> None:
        shapes = {output.name: (output.height_px, output.width_px, 3) for output in self._outputs}
        for name, frame in frames.items():
            if name not in shapes:
                raise DeviceRefused(
                    "display-no-output",
                    what=f"The player has no output {name!r}; it has {', '.join(shapes)}.",
                    remedy="Use the names of [[display.outputs]] in stage.toml.",
                )
            if frame.shape != shapes[name] or frame.dtype != np.uint8:
                raise DeviceRefused(
                    "display-frame-unfit",
                    what=f"A frame of shape {frame.shape}, {frame.dtype} does not fit output {name}, "
                    f"which takes {shapes[name]}, uint8.",
                    remedy="Use frames of the size in stage.toml for this output.",
                )


def _listed(outputs: Sequence[OutputInfo]) -> str:
    return ", ".join(f"{output.name} {output.width_px}x{output.height_px}" for output in outputs)


def _presented(answer: Mapping[str, Any]) -> Presented:
    sequence, at_s = answer.get("sequence"), answer.get("presented_at")
    if not isinstance(sequence, int) or not isinstance(at_s, float):
        raise protocol_broken("an answer of it has no presentation time")
    return Presented(sequence, at_s)


def _live(live: Mapping[str, Any] | None) -> LiveStatus | None:
    if live is None:
        return None
    return LiveStatus(
        int(live["shown"]), live["source"] == "there", str(live["by"]), live["delay_p50_s"], live["delay_p99_s"]
    )


def _open(settings: Mapping[str, Any], context: OpenContext, deadline: Deadline) -> PlayerDisplay:
    if context.runtime is None:
        raise PluginError(
            "player-socket-unknown",
            what="The command does not say where the player's socket is.",
            remedy="Give OpenContext the folder of the socket player.sock as its runtime.",
        )
    path = context.runtime / "player.sock"
    try:
        tables = settings.get("outputs")
        expected = tables and tuple(OutputInfo(t["name"], int(t["width_px"]), int(t["height_px"])) for t in tables)
    except (KeyError, TypeError, ValueError) as error:
        raise PluginError(
            "player-outputs-wrong",
            what="An output in [[display.outputs]] lacks its name, width_px or height_px.",
            remedy='Give each output all three, e.g. name = "P1", width_px = 1400, height_px = 1050.',
        ) from error
    display = PlayerDisplay(path, expected)
    display.outputs(deadline=deadline)
    return display


DRIVER = Driver(
    kind="display",
    name="player",
    summary="all projector outputs together, through Velatura's player process",
    open=_open,
    settings={
        "outputs": "list of tables with name, width_px and height_px, in stage order",
        "frames": "file, relative to the stage, in which the player shows frames instead of windows (memory output)",
    },
)
