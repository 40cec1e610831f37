"""A stage small enough for tests."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import pytest

from plugins.emulated.core.truth import BenchTruth, Lens, ObjectTruth
from plugins.emulated.optics.objects import StageObject, default_object
from plugins.emulated.optics.staging import random_truth

CAMERA_PX, PROJECTOR_PX = (96, 64), (70, 52)


class Clock:
    """Turned by hand."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def resized(lens: Lens, size_px: tuple[int, int]) -> Lens:
    share = size_px[0] / lens.size_px[0]
    x, y = ((at + 0.5) * share - 0.5 for at in lens.centre_px)
    return dataclasses.replace(lens, size_px=size_px, focal_px=lens.focal_px * share, centre_px=(x, y))


def shrunk(truth: BenchTruth) -> BenchTruth:
    """The same stage with images of few pixels."""
    return dataclasses.replace(
        truth,
        subsamples=2,
        camera=dataclasses.replace(truth.camera, lens=resized(truth.camera.lens, CAMERA_PX)),
        projectors=tuple(dataclasses.replace(p, lens=resized(p.lens, PROJECTOR_PX)) for p in truth.projectors),
    )


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture(scope="session")
def vase_and_bust() -> StageObject:
    return default_object()


@pytest.fixture(scope="session")
def tiny_truth(vase_and_bust: StageObject) -> BenchTruth:
    return shrunk(random_truth("small", 7, vase_and_bust, ObjectTruth("vase-and-bust", "", 7), (0, 0)))


@pytest.fixture(scope="session")
def shrink() -> Callable[[BenchTruth], BenchTruth]:
    return shrunk
