"""One solve of several views in parts, which computers solve beside each other: a part is the projectors that one view
sees best, with the views that these light.

It is the sweep of ``block_coordinate_descent`` with the projectors in another order: parts that light the same places
sweep in turn (``turns``), the others at the same time. A part keeps the light of its own projectors. What goes from
part to part is light at borders.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from controller.core.arrays import FloatImage
from controller.optics.solve.bounded.engine import _projected_step
from controller.optics.solve.bounded.equations import Problem, build_problem, initial_point
from controller.optics.solve.bounded.gradient import (
    add_smoothness_to_majoriser,
    extrapolate,
    extrapolate_buffer,
)
from controller.optics.transport.views import Sheet, ViewsTransport

Places = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """``transport`` of its views; ``views``: their numbers; ``projectors``: that it solves, and ``own``: their pixels;
    ``lit``: samples of its sensor buffer that they light; ``needs``: those on which their gradient depends, which are
    more where the camera's picture is interpolated from its samples.
    """

    transport: ViewsTransport
    views: tuple[int, ...]
    projectors: tuple[int, ...]
    own: Places
    lit: npt.NDArray[np.bool_]
    needs: npt.NDArray[np.bool_]

    def seen(self, sheet: Sheet, image: npt.NDArray[np.float32]) -> FloatImage:
        """This part's own sheet of an ``image`` (rows, columns, ...) on the ``sheet`` of all views."""
        parts = sheet.parts(image)
        return self.transport.sheet.joined([parts[v] for v in self.views])

    def border(self, other: Part) -> tuple[Places, Places]:
        """Samples that this part needs and the other lights: their places in this part's buffer, and in the other's."""
        ours, theirs = self._places(), other._places()
        both = [v for v in self.views if v in theirs]
        if not both:
            return np.empty(0, np.int64), np.empty(0, np.int64)
        shared = [np.flatnonzero(self.needs[ours[v]] & other.lit[theirs[v]]) for v in both]
        at, of = ([places[v].start + one for v, one in zip(both, shared, strict=True)] for places in (ours, theirs))
        return np.concatenate(at), np.concatenate(of)

    def _places(self) -> dict[int, slice]:
        ends = np.cumsum([0, *(view.sensor_size for view in self.transport.views)]).tolist()
        return {v: slice(*ends[n : n + 2]) for n, v in enumerate(self.views)}


def parts_of(transport: ViewsTransport) -> list[Part]:
    """At most one for each view."""
    spans = [transport.span(n) for n in range(len(transport.sizes))]
    lights = np.array([[np.any(view.per_weight[span] > 0) for span in spans] for view in transport.views])
    homes = [int(np.argmax(transport.trust[:, span].sum(axis=1))) for span in spans]
    shares, parts = transport.sheet.parts(transport.shares), []
    for home in sorted(set(homes)):
        projectors = tuple(n for n, view in enumerate(homes) if view == home)
        views = tuple(map(int, np.flatnonzero(lights[:, projectors].any(axis=1))))
        chosen, sheet = tuple(transport.views[v] for v in views), Sheet(tuple(transport.sheet.sizes[v] for v in views))
        there = replace(
            transport, views=chosen, sheet=sheet, shares=sheet.joined([shares[v] for v in views]),
            trust=transport.trust[list(views)],
            lit=np.stack([sheet.joined([view.lit[n] for view in chosen]) for n in range(len(spans))]),
        )  # fmt: skip
        magnitude, lit = there.with_absolute_mixing(), there.sensor_buffer()
        for n in projectors:
            magnitude.accumulate_forward(n, np.ones((3, there.pixels), np.float32), lit)
        own = np.concatenate([np.arange(there.pixels)[spans[n]] for n in projectors])
        touched, zero = there.sensor_buffer(), there.sensor_buffer()
        some = np.where(lit > 0, np.random.default_rng(0).random(lit.size, np.float32) + 1, 0).astype(np.float32)
        there.normal_residual(some, np.ones(there.camera_shape, np.float32), zero, touched)
        parts.append(Part(there, views, projectors, own, lit > 0, (touched != 0) | (lit > 0)))
    return parts


def turns(parts: Sequence[Part]) -> list[list[int]]:
    """Numbers of the parts that may sweep at the same time: no two have a border."""
    found: list[list[int]] = []
    for number, part in enumerate(parts):
        for turn in found:
            if not any(part.border(parts[other])[0].size + parts[other].border(part)[0].size for other in turn):
                turn.append(number)
                break
        else:
            found.append([number])
    return found


def part_problem(
    part: Part, target: FloatImage, black: FloatImage, weights: FloatImage | None, strength_per_step: float
) -> Problem:
    """The equations of the whole solve in which a part's own pixels stand. Images are of its own sheet;
    ``strength_per_step``: of the whole solve's smoothness.
    """
    problem = build_problem(part.transport, target, black, 0.0, weights)
    smoothness = problem.majoriser, problem.across, problem.down, strength_per_step
    for n in part.projectors:
        add_smoothness_to_majoriser(*smoothness, part.transport.span(n).start, *part.transport.sizes[n])
    return replace(problem, strength_per_step=strength_per_step)


@dataclass(frozen=True, slots=True)
class State:
    """Of a part between two sweeps: point and extrapolated point (3, own pixels), and the light of both, buffers;
    ``light_y`` is what its neighbours see.
    """

    x: FloatImage
    y: FloatImage
    light_x: FloatImage
    light_y: FloatImage


@dataclass(frozen=True, slots=True)
class Swept:
    """``step`` (3, own pixels) of ``y``, and the light after it; ``squared`` and ``uphill`` as of ``projected_step``,
    ``seconds`` of processor time.
    """

    step: FloatImage
    light_y: FloatImage
    squared: float
    uphill: float
    seconds: float


def first_state(part: Part, problem: Problem) -> State:
    """Where a part starts."""
    x = initial_point(problem)
    light = part.transport.sensor_buffer()
    for n in part.projectors:
        part.transport.accumulate_forward(n, x, light)
    own = np.ascontiguousarray(x[:, part.own])
    return State(own, own, light, light)


def sweep_part(part: Part, problem: Problem, state: State, beside: Sequence[tuple[Places, FloatImage]]) -> Swept:
    """One sweep of a part's own projectors; ``beside``: places of its buffer, and the light of others there."""
    began_s, transport = time.process_time(), part.transport
    x, y, step = (np.zeros((3, transport.pixels), np.float32) for _ in range(3))
    x[:, part.own], y[:, part.own] = state.x, state.y
    others, residual = transport.sensor_buffer(), transport.sensor_buffer()
    for places, light in beside:
        others[places] += light
    light_y = state.light_y + others
    squared = uphill = 0.0
    for n in part.projectors:
        transport.normal_residual(light_y, problem.weights, problem.right_hand_side, residual)
        transport.adjoint_of_buffer(n, residual, step)
        a, b = _projected_step(problem, n, y, x, step)
        squared, uphill = squared + a, uphill + b
        transport.accumulate_forward(n, step, light_y)
    light_y -= others
    return Swept(step[:, part.own], light_y, squared, uphill, time.process_time() - began_s)


def advanced(state: State, swept: Swept, momentum: float, overrelaxation: float) -> State:
    """The state for the next sweep."""
    x, y = state.x.copy(), state.y.copy()
    extrapolate(y, x, np.ascontiguousarray(swept.step), momentum, overrelaxation)
    light_y, light_x, before = swept.light_y.copy(), state.light_x.copy(), state.light_y.copy()
    extrapolate_buffer(light_y, light_x, before, momentum, overrelaxation)
    return State(x, y, light_x, light_y)
