"""One graphics processor in software (Mesa's lavapipe) for all tests of a process."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numba
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from controller.optics.calibrate.values import PhaseMap
from controller.optics.solve.gpu.device import Device, adapters
from controller.optics.transport import LightTransport, build_transport
from tests.controller.optics.transport.conftest import random_calibration
from tests.controller.optics.transport.windows.test_transport import RGGB, mapped

few = settings(
    max_examples=6, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], derandomize=True
)
stages = given(seed=st.integers(0, 2**20), mosaic=st.booleans())


def opened() -> Device:
    """A device in software, of its own."""
    software = [found for found in adapters() if found.software]
    if not software:
        pytest.skip("needs Debian's mesa-vulkan-drivers (a package of the test set-up)")
    return Device(software[0])


@pytest.fixture(scope="session")
def device() -> Iterator[Device]:
    made = opened()
    yield made
    made.close()


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """The processor's loops on one core: stages are so small that threads mostly wait for each other."""
    before = numba.get_num_threads()
    numba.set_num_threads(1)
    yield
    numba.set_num_threads(before)


def any_windows(seed: int, *, mosaic: bool, segment: float = 0.0) -> LightTransport:
    """Windows of all sorts and sizes in any order, many of them partly beyond the frame; those of one are small."""
    calibration = random_calibration(seed, camera=(22, 36), sizes=((11, 14), (70, 21)))
    one, other = mapped(calibration, seed, mosaic=RGGB if mosaic else None).projectors
    assert other.phase_map is not None
    sharp = PhaseMap(other.phase_map.projector_px, np.float32(0.12) * other.phase_map.spread_px2)
    parts = one, dataclasses.replace(other, phase_map=sharp)
    made = dataclasses.replace(calibration, projectors=parts, mosaic=RGGB if mosaic else None)
    transport = build_transport(made)
    return dataclasses.replace(transport, segments=(segment, 0.0)) if segment else transport
