"""A driver in a distribution of its own is installed, found by its entry point, opened, and proven."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

SOURCE = Path(__file__).parents[1] / "third_party_driver"
ROOT = SOURCE.parents[1]
USE = """
from pathlib import Path
from acme_light.emulated import EmulatedLightPost
from hal.deadline import in_seconds
from hal.registry import OpenContext, load_drivers, open_device
drivers = load_drivers()
assert not drivers.broken, drivers.broken
with EmulatedLightPost(lux=7.5) as post:
    driver = drivers.get("light_sensor", "acme-light")
    sensor = open_device(driver, {"address": post.address}, OpenContext(Path()), in_seconds(5))
    print(driver.summary, sensor.illuminance_lux(deadline=in_seconds(5)))
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the distribution installed in it; built from a copy, to leave nothing behind."""
    folder = tmp_path_factory.mktemp("third-party")
    copy = shutil.copytree(SOURCE, folder / "source")
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--no-index"]
    done = subprocess.run(
        [*pip, "--disable-pip-version-check", "--target", str(folder / "site"), str(copy)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return folder / "site"


def run(site: Path, *arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, *arguments],
        env={**os.environ, "PYTHONPATH": os.pathsep.join((str(site), str(ROOT)))},
        cwd=site.parent / "source",
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_it_is_found_by_its_entry_point_and_opens(site: Path) -> None:
    assert run(site, "-c", USE).strip() == "Acme's light posts on the network. 7.5"


def test_it_passes_the_conformance_suite_by_its_own_tests(site: Path) -> None:
    base = f"--basetemp={site.parent / 'pytest'}"
    said = run(site, "-m", "pytest", "-q", "-p", "no:cacheprovider", base, "--import-mode=importlib", "tests")
    assert "7 passed" in said, said


def test_without_it_a_stage_that_asks_for_it_is_told_what_to_install() -> None:
    done = subprocess.run(
        [
            sys.executable,
            "-c",
            'from hal.registry import load_drivers; load_drivers().get("light_sensor", "acme-light")',
        ],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert "There is no light sensor driver 'acme-light'" in done.stderr
    assert "colorhug-als" in done.stderr
