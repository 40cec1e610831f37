"""Where compiled kernels are kept, which CPUs are used, and how threads wait: seen from other processes."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest

from hal.runtime.compute import usable_cpus

ROOT = Path(__file__).parents[3]
KERNEL = """
from __future__ import annotations
import numpy as np
from controller.core.jit import compiled
from {package}.constants import FACTOR

@compiled()
def scaled(x):
    return (x * FACTOR).sum()

import numba
print(scaled(np.ones(4)), sum(scaled.stats.cache_hits.values()), numba.get_num_threads())
"""


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A copy of what kernels need, with one kernel, lab/timings/kernel.py, which uses lab/timings/constants.py."""
    return _tree(tmp_path / "tree")


def _tree(root: Path) -> Path:
    for package in ("hal", "controller"):
        shutil.copytree(ROOT / package, root / package, ignore=shutil.ignore_patterns("__pycache__"))
    (root / "lab" / "timings").mkdir(parents=True)
    (root / "lab" / "timings" / "constants.py").write_text("FACTOR = 2.0\n")
    (root / "lab" / "timings" / "kernel.py").write_text(KERNEL.format(package="lab.timings"))
    return root


def _run(root: Path, cache: Path, environment: Mapping[str, str] | None = None, *, before: str = "") -> list[str]:
    """Words that the kernel prints: result, kernels found in the cache, threads."""
    clean = {name: value for name, value in os.environ.items() if not name.startswith(("NUMBA_", "OMP_", "VELATURA_"))}
    clean |= {"VELATURA_CACHE": str(cache), "PYTHONPATH": str(root), "PYTHONDONTWRITEBYTECODE": "1"}
    code = f"{before}\nimport lab.timings.kernel"
    done = subprocess.run(
        [sys.executable, "-c", code], env=clean | dict(environment or {}), capture_output=True, text=True, check=True,
        cwd=root,
    )  # fmt: skip
    return done.stdout.split()


def test_a_kernel_is_compiled_once_for_every_copy_of_one_version(tree: Path, tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    assert _run(tree, cache)[:2] == ["8.0", "0"]
    assert _run(tree, cache)[:2] == ["8.0", "1"]
    assert _run(_tree(tmp_path / "copy"), cache)[:2] == ["8.0", "1"]


def test_a_constant_that_changes_in_an_imported_file_is_compiled_in(tree: Path, tmp_path: Path) -> None:
    assert _run(tree, tmp_path / "cache")[0] == "8.0"
    (tree / "lab" / "timings" / "constants.py").write_text("FACTOR = 3.0\n")
    assert _run(tree, tmp_path / "cache")[:2] == ["12.0", "0"]


def test_a_cache_folder_that_cannot_be_made_costs_only_the_time_to_compile(tree: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    assert _run(tree, tmp_path / "file" / "cache", {"TMPDIR": str(temporary)})[0] == "8.0"
    assert list(temporary.iterdir()) == []


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a folder to another user; CI is root")
def test_a_kernel_folder_of_another_user_is_not_used(tree: Path, tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    _run(tree, cache)
    (folder,) = (cache / "kernels").glob("kernel-*")
    os.chown(folder, 12345, 12345)
    assert _run(tree, cache)[:2] == ["8.0", "0"]


def test_threads_wait_without_spinning_and_what_the_user_has_set_stays(tree: Path, tmp_path: Path) -> None:
    show = "import atexit, os; atexit.register(lambda: print(os.environ['OMP_WAIT_POLICY']))"
    assert _run(tree, tmp_path, before=show)[-1] == "passive"
    assert _run(tree, tmp_path, {"OMP_WAIT_POLICY": "active"}, before=show)[-1] == "active"


PARALLEL = """
@compiled(parallel=True)
def doubled(x):
    for i in numba.prange(x.size):
        x[i] *= 2

doubled(np.ones(4))
print(numba.threading_layer())
"""


TOGETHER = """
from hal.runtime.compute import threads_may_compute

print(threads_may_compute())
"""


def test_kernels_run_on_openmp_also_where_the_system_has_tbb(tree: Path, tmp_path: Path) -> None:
    # ``.ci/system-packages`` brings libtbb; by itself numba would take it, whose threads spin
    with (tree / "lab" / "timings" / "kernel.py").open("a") as file:
        file.write(PARALLEL)
    assert _run(tree, tmp_path)[-1] == "omp"
    assert _run(tree, tmp_path, {"NUMBA_THREADING_LAYER": "workqueue"})[-1] == "workqueue"


def test_threads_compute_together_only_where_numba_would_not_end_the_process(tree: Path, tmp_path: Path) -> None:
    with (tree / "lab" / "timings" / "kernel.py").open("a") as file:
        file.write(TOGETHER)
    assert _run(tree, tmp_path)[-1] == "True"
    assert _run(tree, tmp_path, {"NUMBA_THREADING_LAYER": "workqueue"})[-1] == "False"
    # as on a computer without the libraries
    missing = "import sys; sys.modules.update({f'numba.np.ufunc.{name}pool': None for name in ('omp', 'tbb')})"
    assert _run(tree, tmp_path, before=missing)[-1] == "False"


def test_numba_that_was_loaded_before_gets_the_same_settings(tree: Path, tmp_path: Path) -> None:
    _run(tree, tmp_path)
    assert _run(tree, tmp_path, before="import numba")[1] == "1"


def test_one_cpu_is_used_where_the_scheduler_allows_one(tree: Path, tmp_path: Path) -> None:
    one = f"import os; os.sched_setaffinity(0, [{min(os.sched_getaffinity(0))}])"
    assert _run(tree, tmp_path, before=one)[2] == "1"


@pytest.mark.parametrize(
    ("files", "membership", "cpus"),
    [
        ({"cpu.max": "max 100000"}, "0::/\n", None),
        ({"kiosk/cpu.max": "100000 100000"}, "0::/kiosk\n", 1),
        ({"kiosk/cpu.max": "50000 100000"}, "0::/kiosk\n", 1),
        ({"kiosk/cpu.max": "100000 100000", "kiosk/a/cpu.max": "max 100000"}, "0::/kiosk/a\n", 1),
        ({"cpu/kiosk/cpu.cfs_quota_us": "100000", "cpu/kiosk/cpu.cfs_period_us": "100000"}, "4:cpu:/kiosk\n", 1),
        ({"cpu/kiosk/cpu.cfs_quota_us": "-1", "cpu/kiosk/cpu.cfs_period_us": "100000"}, "4:cpu:/kiosk\n", None),
        ({"cpu,io/k/cpu.cfs_quota_us": "90000", "cpu,io/k/cpu.cfs_period_us": "100000"}, "3:cpu,io:/k\n", 1),
        ({"kiosk/cpu.max": "nonsense"}, "0::/kiosk\n1\n::\n", None),
    ],
)  # fmt: skip
def test_quotas_of_control_groups_are_kept(
    tmp_path: Path, files: Mapping[str, str], membership: str, cpus: int | None
) -> None:
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text + "\n")
    (tmp_path / "membership").write_text(membership)
    unlimited = len(os.sched_getaffinity(0))
    assert usable_cpus(tmp_path, tmp_path / "membership") == min(cpus or unlimited, unlimited)
    assert usable_cpus(tmp_path, tmp_path / "missing") == unlimited
