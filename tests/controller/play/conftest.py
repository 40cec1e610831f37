"""Real player processes with memory outputs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from controller.bundle.writer import NewAppearance, write_bundle
from controller.play.launch import PlayerProcess, PlayerSettings, start_player
from tests.controller.play.wire import Wire, noise

OUTPUTS = [("P1", 40, 30), ("P2", 41, 31), ("Prój3", 39, 29)]
START = Callable[..., PlayerProcess]


@pytest.fixture
def outputs() -> list[tuple[str, int, int]]:
    return OUTPUTS


@pytest.fixture
def bundle(tmp_path: Path) -> Path:
    """An unsigned bundle with the appearances "0" to "5": noise of that seed."""
    path = tmp_path / "b.vel"
    write_bundle(
        path,
        stage="s",
        calibration="c",
        created_unix_s=0,
        outputs=OUTPUTS,
        appearances=[NewAppearance(str(seed), noise(OUTPUTS, seed)) for seed in range(6)],
    )
    return path


@pytest.fixture
def start(tmp_path: Path) -> Iterator[START]:
    """Start a player in ``tmp_path`` with the memory output ``out.frame``; it is ended with the test."""
    with ExitStack() as stack:

        def started(**changes: Any) -> PlayerProcess:
            settings = {"outputs": OUTPUTS, "frames": tmp_path / "out.frame", **changes}
            return stack.enter_context(start_player(tmp_path, PlayerSettings(**settings)))

        yield started


@pytest.fixture
def wire(start: START, bundle: Path) -> Iterator[Wire]:
    """A connection to a player that has the bundle."""
    with Wire(start(bundle=bundle, allow_unsigned=True).socket) as connection:
        yield connection
