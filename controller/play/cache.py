"""Appearances decoded ahead, in threads, into a bounded number of frame sets."""

from __future__ import annotations

import os
import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Final

from controller.bundle.reader import Bundle
from controller.core.errors import BundleError, VelaturaError
from controller.play.frames import FrameSet, OutputSize, Tiles

CACHE_BYTES: Final = 64 * 1024 * 1024
_FEWEST_SETS: Final = 3
_MOST_SETS: Final = 64
_MOST_THREADS: Final = 4
_SETS_AT_ONCE: Final = 2


def decode_threads() -> int:
    """How many threads decode: as many as there are processor cores for us, 2 to 4."""
    return min(_MOST_THREADS, max(2, len(os.sched_getaffinity(0))))


def check_fits(bundle: Bundle, outputs: Sequence[OutputSize], *, part: bool = False) -> None:
    """Raise BundleError("bundle-outputs-differ") unless the bundle was made for exactly these outputs, or these are a
    ``part`` of them.
    """
    theirs, own = ([f"{o.name} {o.width_px}x{o.height_px}" for o in sizes] for sizes in (bundle.index.outputs, outputs))
    made_for, ours = ", ".join(theirs), ", ".join(own)
    if made_for != ours and not (part and set(own) <= set(theirs)):
        raise BundleError(
            "bundle-outputs-differ",
            what=f"The bundle was made for the outputs {made_for}, but this player has {ours}.",
            remedy="Calibrate and publish again with these outputs, or restore the earlier outputs.",
        )


class DecodedAhead:
    """Decodes what is wanted, in order, in the background; holds as many sets as its memory allows.

    Called from the player's loop, except ``_work``. ``on_ready`` is called from a decoding thread. Two sets are decoded
    at once, so that no thread waits for the last band of one; the bands of the sooner one come first.
    """

    def __init__(self, bundle: Bundle, outputs: Sequence[OutputSize], on_ready: Callable[[], None]) -> None:
        self.bundle = bundle
        self._outputs = tuple(outputs)
        self._on_ready = on_ready
        set_bytes = sum(o.width_px * o.height_px * 3 for o in outputs)
        self._capacity = max(_FEWEST_SETS, min(_MOST_SETS, CACHE_BYTES // set_bytes))
        self._changed = threading.Condition()
        self._decoded: OrderedDict[str, FrameSet] = OrderedDict()
        self._failed: dict[str, VelaturaError] = {}
        self._wanted: deque[str] = deque()
        self._pinned: frozenset[str] = frozenset()
        self._held: tuple[FrameSet, ...] = ()
        self._decoding: set[str] = set()
        self._ended = False
        self._pool = ThreadPoolExecutor(decode_threads(), thread_name_prefix="decode")
        self._working = _SETS_AT_ONCE
        for _ in range(_SETS_AT_ONCE):
            threading.Thread(target=self._work, name="decode", daemon=True).start()

    @property
    def look_ahead(self) -> int:
        """How many sets may be wanted at once, beside the one that is shown."""
        return self._capacity - 1

    def want(self, names: Iterable[str]) -> None:
        """What will be needed next, the soonest first; replaces what was wanted before.

        The first ``look_ahead`` are kept once decoded, until they are no longer wanted.
        """
        ordered = list(dict.fromkeys(names))[: self.look_ahead]
        with self._changed:
            self._pinned = frozenset(ordered)
            self._wanted = deque(n for n in ordered if n not in self._decoded and n not in self._decoding)
            for name in ordered:
                self._failed.pop(name, None)
            self._changed.notify_all()

    def hold(self, *sets: FrameSet) -> None:
        """Leave the content of these sets as it is, until the next call."""
        with self._changed:
            self._held = sets

    def take(self, name: str) -> FrameSet | None:
        """The decoded set, or None while it is not ready. Raises the BundleError that its decoding raised.

        The set is valid while its name is among those wanted, or it is held.
        """
        with self._changed:
            if name in self._failed:
                raise self._failed.pop(name)
            if name in self._decoded:
                self._decoded.move_to_end(name)
            return self._decoded.get(name)

    def close(self) -> None:
        """Stop decoding; the thread closes the bundle when it has ended. Does not wait."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def _work(self) -> None:
        while (job := self._next_job()) is not None:
            name, frames = job
            failure = None
            try:
                frames = self._decode(name, frames)
            except VelaturaError as error:
                failure = error
            with self._changed:
                self._decoding.remove(name)
                if failure is None:
                    self._decoded[name] = frames
                else:
                    self._failed[name] = failure
            self._on_ready()
        with self._changed:
            self._working -= 1
            last = self._working == 0
        if last:
            self._pool.shutdown()
            self.bundle.close()

    def _decode(self, name: str, frames: FrameSet) -> FrameSet:
        """The appearance, in the pixels of ``frames``; what they have of it already stays."""
        names = [output.name for output in self._outputs]
        buffers = dict(zip(names, frames.pixels, strict=True))
        known = None if frames.tiles is None else {n: t.content for n, t in zip(names, frames.tiles, strict=True)}
        content = self.bundle.decode_into(name, buffers, self._pool, known)
        layouts = [self.bundle.index.output(name) for name in names]
        tiles = tuple(Tiles(layout.tile_width_px, layout.tile_height_px, content[layout.name]) for layout in layouts)
        return FrameSet(frames.pixels, tiles)

    def _next_job(self) -> tuple[str, FrameSet] | None:
        with self._changed:
            while not self._wanted and not self._ended:
                self._changed.wait()
            if self._ended:
                return None
            name = self._wanted.popleft()
            frames = self._free_set()
            self._decoding.add(name)
            return name, frames

    def _free_set(self) -> FrameSet:
        """A set to decode into: a new one while there is room, else the least recently used one that is not needed."""
        if len(self._decoded) + len(self._decoding) >= self._capacity:
            for name, frames in self._decoded.items():
                if name not in self._pinned and not any(frames is held for held in self._held):
                    return self._decoded.pop(name)
        return FrameSet.black(self._outputs)
