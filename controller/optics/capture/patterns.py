"""What is shown to one projector during a calibration: a plan of named patterns. `pattern_frames` draws them.

Everything is a pure function of the projector's size. Cells and phases fit together so that no camera pixel is
ambiguous: the Gray code counts cells of half the coarse phase's period, so a pixel whose cell is read one off, which
happens only at the border of two cells, still lies 6 px inside the period it is given. The coarse phase in turn only
chooses among the fringes of the fine sinusoids, which give the position and, by the contrast they lose, the blur.

A plan with few pictures leaves out what others tell: the opposite of a sinusoid is white less the sinusoid, three bits
of the Gray code are shown at once, one in each colour, and a map from before can stand for the code.

The paper's patterns are dots: one lit pixel in every r x r block of a projector's image, r^2 of them (paper 4.1). The
fast way measures the same metapixels from 35 photographs. Dots remain the reference to compare with, and the way to see
a single pixel's light where one camera pixel looks at two surfaces.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from controller.core.arrays import ByteImage
from controller.core.errors import UsageError

CELL_PX = 12
"""Seven bits encode 1536 px: both sides of 1400x1050 take seven."""
PERIOD_PX = 24
PHASE_STEPS = 3
BLUR_STEPS = 3
BLUR_FREQUENCIES = {"x": (1 / 5, 0.0), "y": (0.0, 1 / 5), "d": (1 / 7, 1 / 7)}
"""Cycles per projector pixel of the three fine sinusoids: position within their fringe, and blur."""
ONLY_STRENGTH: Final = {"blur-d": 1}
"""Steps of a sinusoid from which, in a plan with few pictures, only the blur is measured: x and y tell the place."""
TILE_PATTERNS, FEWER_TILE_PATTERNS = 2, 1
FEW_CELLS = 1000
"""With fewer Gray cells on the whole frame, one more set of colour tiles is shown."""
MOST_TILES = 4000
"""With more Gray cells than this, a colour tile covers 2x2 of them: wider, so that defocus affects less of each."""
TILE_MARGIN: Final = 0.28
"""Share of a colour tile's side, on each side of it, that may contain a neighbour's light."""


class PatternKind(enum.Enum):
    """How a pattern is generated."""

    FLAT = "flat"
    GRAY = "gray"
    COLOUR_GRAY = "gray in colours"
    COLOUR_TILES = "mosaic"
    SINUSOID = "sinusoid"
    RANDOM = "random"


class Code(enum.StrEnum):
    """What tells the cells: Gray code, the same with a bit in each colour, or a map from before."""

    GRAY = "gray"
    COLOURS = "colours"
    KNOWN = "known"


@dataclass(frozen=True, slots=True)
class Pattern:
    """One picture of the plan.

    ``colour`` (FLAT) fraction of full light per channel; ``axis`` (GRAY) 0 for x, 1 for y; ``bit`` (GRAY) 0 is the
    coarsest of ``bits``; ``coloured_bits`` (COLOUR_GRAY) axis, bit and bits in red, green and blue, None for a channel
    that shows nothing; ``opposite`` (SINUSOID) the picture that shows the light that this one lacks: then this one is
    not shown; ``tile_cells`` (COLOUR_TILES) Gray cells along a tile's side; ``frequency`` (SINUSOID) x and y in
    cycles per projector pixel; ``phase_rad`` (SINUSOID) its step; ``seed`` (COLOUR_TILES, RANDOM); ``coarse`` (RANDOM)
    with large bright and dark parts, too, which throw light on each other.
    """

    name: str
    kind: PatternKind
    colour: tuple[float, float, float] = (1.0, 1.0, 1.0)
    axis: int = 0
    bit: int = 0
    bits: int = 0
    coloured_bits: tuple[tuple[int, int, int] | None, ...] = ()
    opposite: str = ""
    tile_cells: int = 1
    frequency: tuple[float, float] = (0.0, 0.0)
    phase_rad: float = 0.0
    seed: int = 0
    coarse: bool = False

    @property
    def needs_response(self) -> bool:
        """Whether the pattern has values between black and white, so that it waits for the projector's response."""
        return self.kind in (PatternKind.SINUSOID, PatternKind.RANDOM)


@dataclass(frozen=True, slots=True)
class PatternPlan:
    """The patterns of one projector in the order in which they are shown; those that need the response come last.

    ``size_px`` (width, height) of the projector; ``computed``: sinusoids that need not be shown, because white and
    their opposites tell them; ``code``: what tells the cells
    """

    size_px: tuple[int, int]
    patterns: tuple[Pattern, ...]
    computed: tuple[Pattern, ...] = ()
    code: Code = Code.GRAY

    def __iter__(self) -> Iterator[Pattern]:
        return iter(self.patterns)

    def __len__(self) -> int:
        return len(self.patterns)

    def of_kind(self, kind: PatternKind) -> tuple[Pattern, ...]:
        """The patterns of one kind, in the order in which they are shown."""
        return tuple(pattern for pattern in self.patterns if pattern.kind is kind)

    def gray(self, axis: int) -> tuple[Pattern, ...]:
        """The Gray-code bits of one axis (0 x, 1 y), coarsest first."""
        return tuple(pattern for pattern in self.of_kind(PatternKind.GRAY) if pattern.axis == axis)

    def sinusoids(self, prefix: str) -> tuple[Pattern, ...]:
        """The steps of one sinusoid; ``prefix`` is e.g. ``"phase-x"`` or ``"blur-d"``. An opposite follows its own."""
        steps = []
        for pattern in self.of_kind(PatternKind.SINUSOID):
            if pattern.name.rpartition("-")[0] == prefix:
                steps += [pattern, *(other for other in self.computed if other.opposite == pattern.name)]
        return tuple(steps)

    def measures_phase(self, prefix: str) -> bool:
        """Whether the steps of a sinusoid give its phase; one picture and its opposite only give its strength."""
        return len(self.sinusoids(prefix)) > 2


def plan_patterns(size_px: tuple[int, int], *, few: bool = False, code: Code = Code.GRAY) -> PatternPlan:
    """The plan for a projector of ``size_px`` (width, height).

    Names: ``black white``, ``gray-x-0``.., ``gray-y-0``.., ``mosaic-0``.., ``phase-x-0..2``, ``phase-y-0..2``,
    ``blur-x-0..2``, ``blur-y-0..2``, ``blur-d-0..2``, ``random-0``.

    Parameters
    ----------
    few : two steps of each sinusoid, a quarter of a period apart, and one of the diagonal one; the opposites are
        computed. One picture of tiles less
    code : ``COLOURS``: ``gray-rgb-0``.. with three bits each; ``KNOWN``: no code

    Raises UsageError("projector-too-small") below 2 cells a side.
    """
    width, height = size_px
    if min(width, height) < 2 * CELL_PX:
        raise UsageError(
            "projector-too-small",
            what=f"A projector of {width}x{height} pixels is too small to be calibrated.",
            remedy=f"Give its true size in stage.toml; each side needs at least {2 * CELL_PX} pixels.",
        )
    patterns = [
        Pattern("black", PatternKind.FLAT, colour=(0.0, 0.0, 0.0)),
        Pattern("white", PatternKind.FLAT),
        *_code_patterns(size_px, code),
        *_tile_patterns(size_px, few),
    ]
    sinusoids = {"phase-x": (1 / PERIOD_PX, 0.0), "phase-y": (0.0, 1 / PERIOD_PX)}
    sinusoids |= {f"blur-{name}": frequency for name, frequency in BLUR_FREQUENCIES.items()}
    computed: list[Pattern] = []
    for prefix, frequency in sinusoids.items():
        if few:
            shown = _quarters(prefix, frequency, ONLY_STRENGTH.get(prefix, 2))
            patterns += shown
            computed += [_opposite(pattern, prefix, len(shown) + n) for n, pattern in enumerate(shown)]
        else:
            patterns += _steps(prefix, frequency, PHASE_STEPS if prefix.startswith("phase") else BLUR_STEPS)
    patterns.append(Pattern("random-0", PatternKind.RANDOM, coarse=True))
    return PatternPlan(size_px, tuple(patterns), tuple(computed), code)


def _code_patterns(size_px: tuple[int, int], code: Code) -> list[Pattern]:
    if code is Code.KNOWN:
        return []
    bits = [*_gray_bits("x", 0, size_px[0]), *_gray_bits("y", 1, size_px[1])]
    if code is Code.GRAY:
        return bits
    places = [(pattern.axis, pattern.bit, pattern.bits) for pattern in bits]
    pictures = [(*places[first : first + 3], None, None)[:3] for first in range(0, len(places), 3)]
    return [
        Pattern(f"gray-rgb-{n}", PatternKind.COLOUR_GRAY, coloured_bits=picture) for n, picture in enumerate(pictures)
    ]


def _tile_patterns(size_px: tuple[int, int], few: bool) -> list[Pattern]:
    across, down = cells_of_frame(size_px)
    number = (FEWER_TILE_PATTERNS if few else TILE_PATTERNS) + (across * down < FEW_CELLS)
    tile_cells = 2 if across * down > MOST_TILES else 1
    return [Pattern(f"mosaic-{n}", PatternKind.COLOUR_TILES, tile_cells=tile_cells, seed=n) for n in range(number)]


def cells_of_frame(size_px: tuple[int, int]) -> tuple[int, int]:
    """Gray cells along the width and the height of a projector of ``size_px``, those cut by its border included."""
    return math.ceil(size_px[0] / CELL_PX), math.ceil(size_px[1] / CELL_PX)


def _gray_bits(letter: str, axis: int, pixels: int) -> list[Pattern]:
    bits = max(1, math.ceil(math.log2(math.ceil(pixels / CELL_PX))))
    return [Pattern(f"gray-{letter}-{n}", PatternKind.GRAY, axis=axis, bit=n, bits=bits) for n in range(bits)]


def _steps(prefix: str, frequency: tuple[float, float], steps: int) -> list[Pattern]:
    return [
        Pattern(f"{prefix}-{n}", PatternKind.SINUSOID, frequency=frequency, phase_rad=2 * math.pi * n / steps)
        for n in range(steps)
    ]


def _quarters(prefix: str, frequency: tuple[float, float], steps: int) -> list[Pattern]:
    """Steps a quarter of a period apart: with their opposites, four steps of the whole period."""
    return [
        Pattern(f"{prefix}-{n}", PatternKind.SINUSOID, frequency=frequency, phase_rad=math.pi * n / 2)
        for n in range(steps)
    ]


def _opposite(pattern: Pattern, prefix: str, number: int) -> Pattern:
    return replace(pattern, name=f"{prefix}-{number}", phase_rad=pattern.phase_rad + math.pi, opposite=pattern.name)


PAPER_SPACING_PX: Final = 16
SIGMAS_APART: Final = 6.5
"""Dots this many standard deviations apart do not disturb each other's fit: their Gaussians meet at 3.25."""
LEAST_SPACING_PX: Final = 4


@dataclass(frozen=True, slots=True)
class DotPattern:
    """One picture: the projector pixels with x = ``column`` and y = ``row`` modulo ``spacing_px`` are lit."""

    name: str
    column: int
    row: int
    spacing_px: int


def dot_patterns(size_px: tuple[int, int], r: int = PAPER_SPACING_PX) -> tuple[DotPattern, ...]:
    """The patterns in which each pixel of a projector of ``size_px`` (width, height) is lit just once.

    There are r^2 of them, fewer where the projector is smaller than r. Names: ``dot-00-00``.., column first.

    Raises UsageError("dot-spacing-wrong") for ``r`` below 1, or a projector without pixels.
    """
    width, height = size_px
    if r < 1 or min(size_px) < 1:
        raise UsageError(
            "dot-spacing-wrong",
            what=f"Dots {r} pixels apart do not fit on a projector of {width}x{height}.",
            remedy=f"Choose a spacing of at least {LEAST_SPACING_PX} pixels; {PAPER_SPACING_PX} works for every focus.",
        )
    return tuple(
        DotPattern(f"dot-{column:02d}-{row:02d}", column, row, r)
        for row in range(min(r, height))
        for column in range(min(r, width))
    )


def dot_frame(pattern: DotPattern, size_px: tuple[int, int]) -> ByteImage:
    """(rows, columns, 3) uint8 device values: the dots at white, all else at black."""
    width, height = size_px
    frame = np.zeros((height, width, 3), np.uint8)
    frame[pattern.row :: pattern.spacing_px, pattern.column :: pattern.spacing_px] = 255
    return frame


def dot_spacing(largest_sigma_px: float) -> int:
    """The smallest spacing r that keeps dots apart: r >= 6.5 sigma.

    Parameters
    ----------
    largest_sigma_px : standard deviation, in projector pixels, of the most blurred metapixels that matter; the camera's
        blur counts

    Raises UsageError("dot-blur-unknown") unless it is a number of at least 0.
    """
    if not 0 <= largest_sigma_px < math.inf:
        raise UsageError(
            "dot-blur-unknown",
            what=f"No dot spacing follows from a blur of {largest_sigma_px} projector pixels.",
            remedy=f"Measure the blur first, or use the spacing of {PAPER_SPACING_PX} pixels.",
        )
    return max(LEAST_SPACING_PX, math.ceil(SIGMAS_APART * largest_sigma_px))
