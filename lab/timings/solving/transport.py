"""The products of the light transport against one pass over what is stored of it, in seconds and in processor time.

Processor time is that of one thread, against one thread that reads: it can be compared on a busy machine, too.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

import numba
import numpy as np

from controller.core.arrays import FloatImage
from controller.optics.transport import LightTransport, build_transport
from lab.timings import Row, Timing, at_most, timed
from lab.timings.solving.solve import STREAMED_FLOATS, _read, stored_bytes, stored_windows
from lab.timings.tools.synthetic import synthetic_calibration

REPEATS = 9
BYTES_A_WEIGHT = 2
"""Of a transport that stores its weights; ours stores what they are made from."""
WEIGHTS = 16


def measure(size: str) -> list[Row]:
    """The stored bytes, then each product by all cores' seconds and by one thread's processor time."""
    transport = build_transport(synthetic_calibration(size))
    windows, stored = stored_windows(transport), stored_bytes(transport)
    rows = [
        at_most("stored", stored / 1e6, None, unit="MB", how=f"{windows} windows, {stored / windows:.1f} bytes each")
    ]
    cores = numba.get_num_threads()
    rows += _against_a_pass(transport, timed, f"{cores} threads, seconds", 5.0 if size == "paper" else None)
    numba.set_num_threads(1)
    try:
        rows += _against_a_pass(transport, _processor_time, "1 thread, processor time", None)
    finally:
        numba.set_num_threads(cores)
    return rows


def _against_a_pass(
    transport: LightTransport, clock: Callable[..., Timing], what: str, goal: float | None
) -> list[Row]:
    rng = np.random.default_rng(0)
    p = rng.random((3, transport.pixels), np.float32)
    light = np.zeros((3, *transport.camera_shape), np.float32)
    back, stream = np.zeros_like(p), np.ones(STREAMED_FLOATS, np.float32)
    buffer = transport.sensor_buffer()
    right_hand_side, residual = np.zeros_like(buffer), np.empty_like(buffer)
    weights = np.ones(transport.camera_shape, np.float32)
    read = clock(partial(_read, stream), repeats=REPEATS)
    forward = clock(lambda: transport.forward_planes(p, out=light), repeats=REPEATS)
    adjoint = clock(lambda: transport.adjoint_planes(light, out=back), repeats=REPEATS)
    sweep = clock(lambda: _sweep(transport, p, weights, right_hand_side, buffer, residual, back), repeats=REPEATS)
    again = clock(partial(_read, stream), repeats=REPEATS)
    bandwidth = stream.nbytes / min(read.minimum, again.minimum)
    one_pass = stored_bytes(transport) / bandwidth
    plain = BYTES_A_WEIGHT * WEIGHTS * stored_windows(transport) / bandwidth
    pair = forward.minimum + adjoint.minimum
    return [
        at_most(f"one pass, {what}", one_pass, None, unit="s", how=f"{bandwidth / 1e9:.1f} GB/s, {read} and {again}"),
        at_most(f"T p, {what}", forward.minimum, None, unit="s", how=str(forward)),
        at_most(f"T' r, {what}", adjoint.minimum, None, unit="s", how=str(adjoint)),
        at_most(f"T p + T' r by one pass, {what}", pair / one_pass, goal, unit="x", how="minima"),
        at_most(
            f"the same by a pass over {BYTES_A_WEIGHT} bytes a weight, {what}",
            pair / plain,
            None,
            unit="x",
            how=f"what storing {WEIGHTS} weights a window would take to read, if nothing else were stored",
        ),
        at_most(
            f"T_n p, D' D s - c and T_n' r of each projector on the camera's samples, by one pass, {what}",
            sweep.minimum / one_pass,
            None,
            unit="x",
            how=f"what a sweep of the solver takes of T; {sweep}",
        ),
    ]


def _sweep(
    transport: LightTransport,
    p: FloatImage,
    weights: FloatImage,
    right_hand_side: FloatImage,
    buffer: FloatImage,
    residual: FloatImage,
    back: FloatImage,
) -> None:
    for n in range(len(transport.sizes)):
        transport.normal_residual(buffer, weights, right_hand_side, residual)
        transport.adjoint_of_buffer(n, residual, back)
        transport.accumulate_forward(n, p, buffer)


def _processor_time(work: Callable[[], object], *, repeats: int) -> Timing:
    """As ``lab.timings.timed``, in seconds of the process on a processor."""
    work()
    seconds = []
    for _ in range(repeats):
        began = time.process_time()
        work()
        seconds.append(time.process_time() - began)
    return Timing(min(seconds), float(np.median(seconds)), max(seconds))
