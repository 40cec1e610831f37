"""One booted machine with each Debian, for all these tests in their order, from bare to wiped."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from controller.kiosk.install.steps import DEBIAN
from tests.booted.kiosk import PICTURE_S, Kiosk, installed, prepared_stage
from tests.booted.trees import obstacle

ORDER = ("bare", "playing", "faults", "update", "work", "wiped")
"""Of the files: each continues with the machine that the previous one left."""
SHORT = "bare"
"""The file that also `make test` runs, on the older Debian; the others are for `make test-long`."""


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """These tests in their order. A folder's hook gets all tests."""
    here, why = Path(__file__).parent, obstacle()
    places = [place for place, item in enumerate(items) if item.path.parent == here]
    ours = sorted((items[place] for place in places), key=lambda item: ORDER.index(item.path.stem.split("_")[1]))
    for place, item in zip(places, ours, strict=True):
        for mark in (pytest.mark.slow, pytest.mark.timeout(1500), pytest.mark.skipif(why is not None, reason=str(why))):
            item.add_marker(mark)
        if item.path.stem != f"test_{SHORT}" or f"[{min(DEBIAN)}" not in item.name:
            item.add_marker(pytest.mark.long)
        items[place] = item


@pytest.fixture(scope="session")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return prepared_stage(tmp_path_factory.mktemp("demo"))


@pytest.fixture(scope="session", params=DEBIAN)
def bare(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Kiosk]:
    """Installed, without a stage; the projectors show the way to the panel."""
    with installed(request.param, tmp_path_factory.mktemp(request.param), versions=("1", "2")) as kiosk:
        assert kiosk.machine.wait_for(lambda: kiosk.read_code() != "") < PICTURE_S
        yield kiosk


@pytest.fixture(scope="session")
def playing(bare: Kiosk, stage: Path) -> Kiosk:
    """With a stage that plays."""
    bare.put_stage(stage)
    return bare
