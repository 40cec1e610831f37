"""Which engine solves: asked for, found, or missing."""

from __future__ import annotations

import subprocess
import sys

import pytest

from controller.core.errors import UsageError
from controller.optics.solve.bounded.engine import Processor
from controller.optics.solve.engines import choose_engine, graphics_sentence
from controller.optics.solve.gpu.device import adapters
from controller.optics.solve.gpu.engine import GpuEngine


def silent(text: str) -> None:
    raise AssertionError(f"nothing was to be said, but: {text}")


def test_the_processor_is_taken_when_asked_for() -> None:
    assert isinstance(choose_engine("cpu", silent), Processor)


def test_a_device_in_software_is_taken_only_when_asked_for() -> None:
    real = [found for found in adapters() if not found.software]
    assert isinstance(choose_engine("gpu", silent), GpuEngine)
    assert isinstance(choose_engine("auto", silent), GpuEngine if real else Processor)


def test_an_unknown_device_is_refused_with_the_known_ones() -> None:
    with pytest.raises(UsageError, match="auto, cpu, gpu") as refused:
        choose_engine("tpu", silent)
    assert refused.value.code == "solve-device-unknown"


@pytest.mark.parametrize("wanted", ["gpu", "auto"])
def test_without_drivers_auto_is_the_processor_and_gpu_an_error(wanted: str) -> None:
    """In a process of its own, whose Vulkan has no driver: the library looks for them once."""
    code = (
        "from controller.core.errors import UsageError\n"
        "from controller.optics.solve.engines import choose_engine\n"
        "from controller.optics.solve.engines import graphics_sentence\n"
        f"try: print(choose_engine({wanted!r}, print).name)\n"
        "except UsageError as error: print(error.code, error.remedy)\n"
        "print(graphics_sentence())\n"
    )
    nowhere = {"VK_DRIVER_FILES": "/nowhere.json", "VK_ICD_FILENAMES": "/nowhere.json", "PATH": "/usr/bin"}
    done = subprocess.run([sys.executable, "-c", code], env=nowhere, capture_output=True, text=True, check=True)
    chosen, sentence = done.stdout.strip().splitlines()
    assert sentence == "Solves run on the processor: no graphics processor was found."
    if wanted == "auto":
        assert chosen == "processor"
    else:
        assert chosen.startswith("no-graphics-processor Install its Vulkan driver")


def test_without_the_extra_gpu_nothing_of_it_is_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert isinstance(choose_engine("auto", silent), Processor)
    with pytest.raises(UsageError, match=r"velatura\[gpu\]") as refused:
        choose_engine("gpu", silent)
    assert refused.value.code == "extra-missing"
    assert "the extra gpu is not installed" in graphics_sentence()


def test_the_doctor_s_sentence_names_the_device_of_these_tests() -> None:
    assert "llvmpipe" in graphics_sentence()
    assert "in software" in graphics_sentence()
