"""What the API names, how quickly it is imported, and what it does not need."""

from __future__ import annotations

import inspect
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from controller import api

ROOT = Path(__file__).parents[3]
GRAPHICS = ("wgpu", "skimage", "rawpy", "OpenEXR", "embreex", "matplotlib")
"""Only what is called needs them, and they take seconds to load."""
PANEL = ("starlette", "uvicorn", "aiomqtt", "argon2", "prometheus_client", "python_multipart", "multipart")
CLUSTER = ("dask", "distributed")


def python(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)


def test_every_name_exists_and_is_listed_once() -> None:
    assert sorted(set(api.__all__)) == api.__all__
    assert set(dir(api)) >= set(api.__all__)
    assert all(getattr(api, name).__name__ == name for name in api.__all__)


def test_a_name_that_is_not_there_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="sovle"):
        getattr(api, "sovle")  # noqa: B009 - a type checker refuses api.sovle


@pytest.mark.parametrize("name", api.__all__)
def test_every_name_says_what_it_takes_and_gives(name: str) -> None:
    found = getattr(api, name)
    text = inspect.getdoc(found) or ""
    assert len(text) > 40
    if inspect.isfunction(found) and found.__module__.startswith("controller.api."):
        parameters = list(inspect.signature(found).parameters.values())
        assert all(one.annotation is not inspect.Parameter.empty for one in parameters)
        assert all(one.name in text for one in parameters)
        assert inspect.signature(found).return_annotation is not inspect.Signature.empty


def test_importing_it_loads_nothing_that_only_some_functions_need() -> None:
    found = python(f"import sys; from controller import api; print([n for n in {GRAPHICS} if n in sys.modules])")
    assert found.stdout.strip() == "[]", found.stderr


def test_it_needs_neither_the_panel_nor_the_cluster() -> None:
    blocked = [*PANEL, *CLUSTER]
    found = python(
        f"import sys; sys.modules.update(dict.fromkeys({blocked}));\n"
        "from controller import api\n"
        "print([name for name in api.__all__ if getattr(api, name) is None])"
    )
    assert found.stdout.strip() == "[]", found.stderr


def test_the_blocked_modules_are_those_of_the_extras() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["optional-dependencies"]
    shared = {*extras["controller"]}
    wanted = {name.partition("-cffi")[0].replace("-", "_") for name in {*extras["panel"], *extras["cluster"]} - shared}
    assert wanted <= {*PANEL, *CLUSTER}
