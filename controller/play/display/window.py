"""One borderless window over all projectors, by pyglet: one context, one flip, so no projector is ahead of another.
Which output of the X server is which output of the stage, and where on the screen it lies, is decided here, too.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pyglet

from controller.core.errors import UsageError
from controller.play.display.x11 import Connector
from controller.play.frames import OutputSize

LOOK_S: Final = 2.0
"""Between two looks at the gamma ramps."""
_MOST_RATES_APART_HZ: Final = 0.01
"""Outputs of one window that are farther apart drift by a frame in less than two minutes."""


def find_connectors(
    sizes: Sequence[OutputSize], where: Mapping[str, str], connectors: Sequence[Connector]
) -> dict[str, Connector]:
    """The X server's output of each of ours that is there, by our name, whatever its size.

    ``where`` gives a connector's name or a display's serial number for ours, with "@x,y" for a rectangle of its
    picture; without it, our name is taken for that.
    Raises UsageError("output-ambiguous") if two displays have the serial number.
    """
    found = {}
    for size in sizes:
        wanted, _, corner = where.get(size.name, size.name).partition("@")
        named = [c for c in connectors if c.name == wanted] or [c for c in connectors if wanted in c.serials]
        if len(named) > 1:
            raise UsageError(
                "output-ambiguous",
                what=f"The displays at {' and '.join(c.name for c in named)} have the same serial number {wanted}.",
                remedy=f"Give the connector's name for output {size.name} instead.",
            )
        found.update({size.name: _part(named[0], corner, size)} if named else {})
    return found


def _part(connector: Connector, corner: str, size: OutputSize) -> Connector:
    """The rectangle of ours in the connector's picture, if ``corner`` ("x,y") says where it is and it fits in."""
    if not corner:
        return connector
    x, y = map(int, corner.split(","))
    if x + size.width_px > connector.width_px or y + size.height_px > connector.height_px:
        return connector
    left, top = connector.x + x, connector.y + y
    return replace(connector, x=left, y=top, width_px=size.width_px, height_px=size.height_px)


def unfit(
    sizes: Sequence[OutputSize],
    where: Mapping[str, str],
    found: Mapping[str, Connector],
    connectors: Sequence[Connector],
) -> dict[str, UsageError]:
    """By our name, why an output can't show its pictures: UsageError("output-missing", "output-size-differs",
    "output-changed" or "output-overlaps").
    """
    wrong = {}
    for size in sizes:
        wanted, connector = where.get(size.name, size.name), found.get(size.name)
        if connector is None:
            has = ", ".join(" ".join((c.name, *(f"(serial number {s})" for s in c.serials[:1]))) for c in connectors)
            wrong[size.name] = UsageError(
                "output-missing",
                what=f"The X server has no output {wanted}; it has {has or 'none'}.",
                remedy="Check the cable and stage.toml, and force the output on if the projector is off.",
            )
        elif connector.changed:
            wrong[size.name] = UsageError(
                "output-changed",
                what=f"Output {size.name} is {connector.changed} by the X server, which changes its pixels.",
                remedy=f"Run xrandr --output {connector.name} --rotate normal --reflect normal --scale 1x1.",
            )
        elif (connector.width_px, connector.height_px) != (size.width_px, size.height_px):
            wrong[size.name] = UsageError(
                "output-size-differs",
                what=f"Output {size.name} is {connector.width_px}x{connector.height_px}, but stage.toml says "
                f"{size.width_px}x{size.height_px}.",
                remedy="Set the output's mode with xrandr, or correct stage.toml and calibrate again.",
            )
        elif others := [name for name, other in found.items() if name != size.name and _overlap(connector, other)]:
            wrong[size.name] = UsageError(
                "output-overlaps",
                what=f"Output {size.name} shows the same part of the screen as {', '.join(others)}.",
                remedy=f"Place it beside them: xrandr --output {connector.name} --right-of the last of the others.",
            )
    return wrong


def _overlap(one: Connector, other: Connector) -> bool:
    """Whether they show a common part of the screen, as clones do."""
    across = min(one.x + one.width_px, other.x + other.width_px) - max(one.x, other.x)
    down = min(one.y + one.height_px, other.y + other.height_px) - max(one.y, other.y)
    return across > 0 and down > 0


def check_rates(found: Mapping[str, Connector]) -> None:
    """Raise UsageError("output-rates-differ") unless these change together."""
    rates = sorted((connector.rate_hz, name) for name, connector in found.items())
    (slowest, one), (quickest, other) = rates[0], rates[-1]
    if quickest - slowest > _MOST_RATES_APART_HZ:
        raise UsageError(
            "output-rates-differ",
            what=f"Output {one} runs at {slowest:.3f} Hz and {other} at {quickest:.3f} Hz.",
            remedy="Give all outputs the same mode with xrandr, so that they change together.",
        )


# Must be set before pyglet.window is imported: error checks after every call, and a hidden window, cost time.
pyglet.options["debug_gl"] = False
pyglet.options["shadow_window"] = False

from pyglet import gl  # noqa: E402

from controller.bundle.live_maps import LiveMaps  # noqa: E402
from controller.core.errors import WorkError  # noqa: E402
from controller.play.control.notify import log  # noqa: E402
from controller.play.display.drawing import Canvas  # noqa: E402
from controller.play.display.kept_picture import KeptPicture  # noqa: E402
from controller.play.display.live_targets import LiveRenderer  # noqa: E402
from controller.play.display.x11 import XServer  # noqa: E402
from controller.play.frames import FrameSet  # noqa: E402


class WindowOutput:
    """Real outputs of an X server.

    Outputs are found by their connector's name (``xrandr``: DP-1, HDMI-2) or their display's serial number. If none of
    them is there, but others are, and none was asked for by ``where``, they lie side by side from the upper left
    corner, in stage order, until one of them comes. An output that is away, of another size, turned, scaled, or over
    another one stays black; when it is as it should be it shows what the others show.
    """

    def __init__(self, sizes: Sequence[OutputSize], where: Mapping[str, str] | None = None) -> None:
        """Open the window. ``where``: connector or serial number by the output's name, where that is another.

        Raises WorkError("display-gone", "display-taken", "display-unfit", "output-gamma" or "output-range"), UsageError
        as ``find_connectors`` and ``check_rates``, and as ``unfit`` if no output is as it should be.
        """
        self._sizes, self._where = tuple(sizes), dict(where or {})
        self._server = XServer()
        self._server.claim()
        found, connectors = self._find()
        self._beside = not found and bool(connectors) and not self._where
        self._missing: tuple[str, ...] = ()
        if not self._beside:
            self._missing = self._checked(found, connectors)
        self._make_plain(found)
        self._places = self._placed(found)
        try:
            self._window = _open_window(self._extent(), self._server.kept)
        except (pyglet.display.xlib.NoSuchDisplayException, pyglet.window.NoSuchConfigException) as error:
            raise WorkError(
                "display-gone",
                what="The player found no display with OpenGL 3.3 for its window.",
                remedy="Start the X server and set DISPLAY, or use --frames on a machine without one.",
            ) from error
        self._server.keep_awake()
        self._server.bypass_compositor(self._window._window)
        self._window.switch_to()
        self._window.set_vsync(True)
        self._canvas = Canvas(sizes)
        self._share = 0.0
        self._live: LiveRenderer | None = None
        self._damaged = False
        self._window.push_handlers(on_expose=self._on_expose, on_draw=self._on_expose, on_close=_stay)

    def _find(self) -> tuple[dict[str, Connector], tuple[Connector, ...]]:
        connectors = self._server.connectors()
        return find_connectors(self._sizes, self._where, connectors), connectors

    def _checked(self, found: Mapping[str, Connector], connectors: Sequence[Connector]) -> tuple[str, ...]:
        """The outputs that are not there as they should be; the others play."""
        wrong = unfit(self._sizes, self._where, found, connectors)
        if len(wrong) == len(self._sizes):
            raise next(iter(wrong.values()))
        for problem in wrong.values():
            log(f"{problem.what} {problem.remedy}")
        check_rates({name: connector for name, connector in found.items() if name not in wrong})
        return tuple(wrong)

    def _make_plain(self, found: Mapping[str, Connector]) -> None:
        """A driver may give an output that returns its old gamma ramp back, and another program may set one, for
        which there is no event.
        """
        self._found, self._looked_s = found, time.monotonic()
        for name, connector in found.items():
            if name not in self._missing:
                self._server.make_plain(connector)

    def _placed(self, found: Mapping[str, Connector]) -> tuple[tuple[int, int] | None, ...]:
        """Upper left corner of each output on the X screen, None for one that is not there as it should be."""
        if self._beside:
            return tuple((sum(s.width_px for s in self._sizes[:number]), 0) for number in range(len(self._sizes)))
        return tuple(
            None if size.name in self._missing else (found[size.name].x, found[size.name].y) for size in self._sizes
        )

    def _extent(self) -> tuple[int, int]:
        """Width and height of the window that reaches from the screen's corner over all outputs."""
        ends = [
            (place[0] + size.width_px, place[1] + size.height_px)
            for place, size in zip(self._places, self._sizes, strict=True)
            if place is not None
        ]
        return max((x for x, _ in ends), default=1), max((y for _, y in ends), default=1)

    def _on_expose(self) -> bool:
        self._damaged = True
        return True

    def prepare(self, frames: FrameSet) -> None:
        self._canvas.load(frames)
        self._share = 0.0
        self._draw()

    def load_live(self, maps: LiveMaps) -> None:
        """As ``live.LiveOutput``."""
        if self._live is not None:
            self._live.close()
            self._live = None
        self._live = LiveRenderer(maps)

    def prepare_live(self, target: npt.NDArray[np.uint8], brightness: float) -> None:
        """As ``live.LiveOutput``; after ``load_live``."""
        assert self._live is not None
        self._live.render(target, brightness, self._canvas.pictures)
        self._share = 0.0
        self._draw()

    def live_frames(self) -> FrameSet:
        """As ``live.LiveOutput``."""
        assert self._live is not None
        return self._live.read_back(self._canvas.pictures)

    def load_fade(self, before: FrameSet, after: FrameSet) -> None:
        self._canvas.load_both(before, after)

    def mix(self, share: float) -> None:
        self._share = share
        self._draw()

    def _draw(self) -> None:
        self._canvas.draw(self._places, self._window.get_framebuffer_size(), self._share)

    def flip(self) -> float:
        self._window.flip()
        gl.glFinish()
        at_s = time.monotonic()
        if self.continued:
            self._server.kept.drop()
        return at_s

    @property
    def continued(self) -> bool:
        return self._server.kept.there

    def leave(self) -> None:
        self._server.kept.keep(self._window._view)

    def missing(self) -> tuple[str, ...]:
        return self._missing

    def pump(self) -> None:
        if self._server.changed():
            self._follow()
        elif time.monotonic() - self._looked_s > LOOK_S:
            self._make_plain(self._found)
        self._window.dispatch_events()
        if self._damaged and not self.continued:
            self._damaged = False
            self._draw()
            self._window.flip()

    def _follow(self) -> None:
        """Outputs came, went or moved: place the window and the pictures again."""
        found, connectors = self._find()
        # With all cables out at the start, the stage's outputs look like outputs without names.
        self._beside = self._beside and not found
        if self._beside:
            return
        wrong = unfit(self._sizes, self._where, found, connectors)
        for name in wrong.keys() - set(self._missing):
            log(f"{wrong[name].what} {wrong[name].remedy}")
        self._missing = tuple(wrong)
        before, self._places = self._places, self._placed(found)
        self._make_plain(found)
        if self._places != before:
            self._window.set_size(*self._extent())
            self._window.set_location(0, 0)
            self._server.keep_awake()
            self._damaged = True

    def close(self) -> None:
        self._window.close()
        self._server.close()


def _stay() -> bool:
    """A kiosk's window can't be closed from its frame."""
    return True


def _open_window(extent: tuple[int, int], kept: KeptPicture) -> Any:
    config = gl.Config(  # type: ignore[abstract]
        double_buffer=True, red_size=8, green_size=8, blue_size=8, major_version=3, minor_version=3, depth_size=0
    )
    window = pyglet.window.Window(
        *extent, caption="Velatura", style="borderless", vsync=True, visible=False, config=config
    )
    if kept.there:
        kept.let_through(window._window, window._view)
    window.set_location(0, 0)
    window.set_visible(True)
    # A window manager may have moved it while it was mapped.
    window.set_location(0, 0)
    window.set_mouse_visible(False)
    return window
