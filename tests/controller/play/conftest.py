"""Real player processes with memory outputs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from nacl.signing import SigningKey

from controller.bundle.writer import NewAppearance, NewBundle, write_bundle
from controller.play.control.launch import PlayerProcess, PlayerSettings, start_player
from tests.controller.play.wire import Wire, noise

OUTPUTS = [("P1", 40, 30), ("P2", 41, 31), ("Prój3", 39, 29)]
START = Callable[..., PlayerProcess]


@pytest.fixture
def outputs() -> list[tuple[str, int, int]]:
    return OUTPUTS


def write_noise(
    path: Path, *, outputs: Sequence[tuple[str, int, int]] = OUTPUTS, key: SigningKey | None = None, **more: Any
) -> Path:
    """An unsigned bundle with the appearances "0" to "5": noise of that seed; ``more`` for ``NewBundle``."""
    sizes = list(outputs)
    write_bundle(
        path,
        NewBundle("s", "c", created_unix_s=0, outputs=sizes, **more),
        [NewAppearance(str(seed), noise(sizes, seed)) for seed in range(6)],
        key=key,
    )
    return path


@pytest.fixture
def bundle(tmp_path: Path) -> Path:
    return write_noise(tmp_path / "b.vel")


@pytest.fixture
def start(tmp_path: Path) -> Iterator[START]:
    """Start a player in ``tmp_path`` with the memory output ``out.frame``; it is ended with the test."""
    with ExitStack() as stack:

        def started(**changes: Any) -> PlayerProcess:
            settings = {"outputs": OUTPUTS, "frames": tmp_path / "out.frame", **changes}
            return stack.enter_context(start_player(tmp_path, PlayerSettings(**settings)))

        yield started


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Where a player serves that the tests of a file share: none of them may end it."""
    path = tmp_path_factory.mktemp("player")
    settings = PlayerSettings(OUTPUTS, path / "out.frame", bundle=write_noise(path / "b.vel"), allow_unsigned=True)
    with start_player(path, settings):
        yield path


@pytest.fixture
def wire(folder: Path) -> Iterator[Wire]:
    """A connection to the shared player, which shows black and has the bundle."""
    with Wire(folder / "player.sock") as connection:
        connection.ask("stop")
        yield connection
