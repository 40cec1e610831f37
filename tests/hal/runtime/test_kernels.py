"""Kernels that are compiled ahead: the tables, the processes that compile them, and that a demo compiles nothing more.

The last is in tests/end_to_end/test_demo.py.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from numba import types

from hal.runtime import kernels
from hal.runtime.kernels import TABLES, Compilation, are_compiled, decode, encode, main, record
from tests.processes import children

MODULE = "controller.optics.capture.encoding"
"""A small one, with several kernels, of which some call others and some use all cores."""

numbers = st.sampled_from([types.float32, types.float64, types.int64, types.uint8, types.uint16, types.boolean])
arrays = st.builds(
    types.Array,
    numbers,
    st.integers(1, 5),
    st.sampled_from(["C", "F", "A"]),
    readonly=st.booleans(),
    aligned=st.booleans(),
)
kinds = st.recursive(numbers | arrays | st.just(types.none), lambda inner: st.lists(inner, max_size=4).map(types.Tuple))


@given(kinds)
def test_argument_types_survive_being_written_and_read(kind: types.Type) -> None:
    assert decode(json.loads(json.dumps(encode(kind)))) == kind


@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
        lambda inner: st.lists(inner, max_size=6) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    ).filter(lambda value: not isinstance(value, str))
)
def test_what_is_no_argument_type_is_refused(value: object) -> None:
    with pytest.raises((ValueError, AttributeError, TypeError, ImportError)):
        decode(value)


def test_every_call_in_the_tables_can_be_read() -> None:
    calls = [
        kind
        for table in TABLES
        for functions in json.loads(table.read_text()).values()
        for rows in functions.values()
        for row in rows
        for kind in row
    ]
    assert calls
    assert all(encode(decode(kind)) == kind for kind in calls)


def _compile(cache: Path, module: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"VELATURA_CACHE": str(cache)}
    return subprocess.run(
        [sys.executable, "-m", "hal.runtime.kernels", "modules"], env=environment, capture_output=True, text=True,
        check=False, cwd=Path(__file__).parents[3], input=f"{module}\n",
    )  # fmt: skip


def test_a_module_that_is_compiled_ahead_is_found_in_the_kernel_folder(tmp_path: Path) -> None:
    assert _compile(tmp_path, MODULE).returncode == 0
    written = record(tmp_path / "kernels")[TABLES[0]][MODULE]
    wanted = json.loads(TABLES[0].read_text())[MODULE]
    assert {name: sorted(map(str, rows)) for name, rows in written.items()} == {
        name: sorted(map(str, rows)) for name, rows in wanted.items()
    }
    newest = max(path.stat().st_mtime_ns for path in tmp_path.rglob("*.nbi"))
    assert _compile(tmp_path, MODULE).returncode == 0
    assert max(path.stat().st_mtime_ns for path in tmp_path.rglob("*.nbi")) == newest


def test_a_compilation_that_is_closed_ends_its_processes_at_once_and_one_that_ended_is_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("VELATURA_CACHE", str(tmp_path))
    with Compilation(processes=1) as compilation:
        assert not compilation.wait(0.05)
        assert compilation.share < 1
    assert compilation.wait(0)
    assert not are_compiled()
    monkeypatch.setattr(kernels, "TABLES", ())  # all of nothing, which takes no time
    assert not are_compiled()
    with Compilation(processes=1) as compilation:
        assert compilation.wait(60)
    assert are_compiled()


def test_a_compilation_whose_process_was_killed_names_what_is_missing_and_ends_without_a_traceback(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("VELATURA_CACHE", str(tmp_path))
    raised: list[threading.ExceptHookArgs] = []
    monkeypatch.setattr(threading, "excepthook", raised.append)
    before = children()
    with Compilation(processes=1) as compilation:
        for process in set(children()).difference(before):
            os.kill(process, signal.SIGKILL)
        assert compilation.wait(60)
        assert compilation.failed
    assert raised == []


def test_a_module_that_fails_does_not_stop_those_after_it_and_is_told_in_the_exit_code(tmp_path: Path) -> None:
    done = _compile(tmp_path, "controller.nothing\ncontroller.optics.transport.planes")
    assert (done.stdout.split(), done.returncode) == (["failed", "compiled"], 1)


@pytest.fixture
def table_of_a_missing_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    table = tmp_path / "kernels.json"
    table.write_text(json.dumps({"controller.nothing": {"kernel": [["float32"]]}}))
    monkeypatch.setattr(kernels, "TABLES", (table,))
    monkeypatch.setenv("VELATURA_CACHE", str(tmp_path))


@pytest.mark.usefixtures("table_of_a_missing_module")
def test_a_table_of_a_missing_module_counts_as_not_compiled() -> None:
    assert not are_compiled()
    with Compilation(processes=1) as compilation:
        assert compilation.wait(60)
        assert compilation.failed == ("controller.nothing",)
    assert not are_compiled()


@pytest.mark.usefixtures("table_of_a_missing_module")
def test_compiling_names_a_missing_module_and_the_remedy(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["compile"]) == 1
    assert capsys.readouterr().err == (
        "velatura: The module controller.nothing in the kernel tables does not exist. "
        "Run `python -m hal.runtime.kernels record`.\n"
    )
