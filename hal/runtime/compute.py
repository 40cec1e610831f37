"""Compiled numeric code on this machine: its CPUs, the memory that it may use, how its threads wait, and its folder.

Shared by the controller and the emulated bench, whose kernels are compiled by numba. Importing this module loads
only the standard library and changes nothing.
"""

from __future__ import annotations

import atexit
import contextlib
import hashlib
import importlib
import math
import os
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, Final

from hal.runtime.caches import cache_folder, temporary

GROUPS: Final = Path("/sys/fs/cgroup")
"""Where control groups are mounted, version 1 or 2."""
MEMBERSHIP: Final = Path("/proc/self/cgroup")
"""The file that names this process's groups."""


def groups_of(controller: str, groups: Path = GROUPS, membership: Path = MEMBERSHIP) -> Iterator[Path]:
    """The folders of this process's groups, and of each group above, that may limit ``controller`` ("cpu", ...)."""
    try:
        lines = membership.read_text().splitlines()
    except OSError:
        return
    for controllers, name in (line.split(":", 2)[1:] for line in lines if line.count(":") >= 2):
        if controllers and controller not in controllers.split(","):
            continue
        mount = groups if not controllers else groups / controllers
        path = mount / name.lstrip("/")
        for group in (path, *path.parents):
            if not group.is_relative_to(mount):
                break
            yield group


ROOT: Final = Path(__file__).resolve().parents[2]
PACKAGES: Final = ("controller", "plugins", "hal", "lab", "tests")
"""Packages with kernels."""
LOCATORS: Final = "hal.runtime.compute.KernelFolder,UserProvidedCacheLocator,InTreeCacheLocator,UserWideCacheLocator"
_IMPORT: Final = re.compile(
    rf"^[ \t]*from[ \t]+((?:{'|'.join(PACKAGES)})[\w.]*)[ \t]+import[ \t]+(\([^)]*\)|[^\n]*)", re.MULTILINE
)


def usable_cpus(groups: Path = GROUPS, membership: Path = MEMBERSHIP) -> int:
    """Number of CPUs that this process may use, at least 1: by its affinity and the quotas of its control groups.

    Args:
        groups: Where control groups are mounted, version 1 or 2.
        membership: The file that names this process's groups.
    """
    quotas = [math.ceil(quota) for quota in _quotas(groups, membership)]
    return max(1, min([affinity(), *quotas]))


def affinity() -> int:
    """CPUs that the scheduler may run this process on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def prepare_threads() -> None:
    """Set the environment variables for numba and its OpenMP library, before the first kernel runs.

    OpenMP's threads spin while they wait. With other busy programs, each spins for a thread that has no CPU, and
    a solve takes up to 40 times as long (docs/decisions/0004). A variable set by the user is kept.
    """
    # By itself numba prefers TBB where a system has it, and TBB's threads spin, at the end of a process, too.
    os.environ.setdefault("NUMBA_THREADING_LAYER_PRIORITY", "omp tbb workqueue")
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    if usable_cpus() < affinity():  # numba uses the affinity, but no control groups
        os.environ.setdefault("NUMBA_NUM_THREADS", str(usable_cpus()))
    os.environ.setdefault("NUMBA_CACHE_LOCATOR_CLASSES", LOCATORS)


def threads_may_compute() -> bool:
    """Whether several threads of this process may run kernels at the same time.

    numba can do it with OpenMP or TBB. Where a computer has neither library, it ends the process instead.
    """
    prepare_threads()
    wanted = os.environ.get("NUMBA_THREADING_LAYER", "default")
    return wanted != "workqueue" and _has_threads()


@cache
def _has_threads() -> bool:
    for pool in ("omppool", "tbbpool"):
        with contextlib.suppress(ImportError):
            importlib.import_module(f"numba.np.ufunc.{pool}")
            return True
    return False


def kernel_folder() -> Path:
    """The folder of compiled kernels, in ``hal.runtime.caches.cache_folder``."""
    return cache_folder() / "kernels"


def can_keep_kernels() -> bool:
    """Whether compiled kernels can be kept for other programs: ``kernel_folder`` can be made and written to."""
    try:
        _make_private(kernel_folder())
    except (OSError, RuntimeError):  # RuntimeError: the user has no home folder
        return False
    return True


def _make_private(folder: Path) -> None:
    """Make a folder for this user alone, because what lies in it is executed. Raises ``OSError``."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if folder.stat().st_uid != os.geteuid() or not os.access(folder, os.W_OK):
        raise PermissionError(f"{folder} belongs to another user or cannot be written")


class KernelFolder:
    """Gives numba the folder of a kernel's machine code, named after the contents of its sources.

    The sources are the kernel's file and every file of this project that it imports, because numba compiles called
    kernels and constants into their caller. Copies of one version share a folder, so a checkout, an installed package
    and parallel tests compile each kernel once. Interface: ``numba.core.caching._CacheLocator``.
    """

    def __init__(self, source: Path, line: int, folder: Path) -> None:
        self._source = source
        self._line = line
        self._folder = folder

    @classmethod
    def from_function(cls, function: Any, file: str) -> KernelFolder | None:
        """For ``function`` in ``file``; None if the file is not part of this project.

        If the user has no writable folder, this process's kernels are kept until it ends.
        """
        source = Path(file).resolve()
        if not source.is_relative_to(ROOT) or source.relative_to(ROOT).parts[0] not in PACKAGES:
            return None
        name = f"{source.stem}-{digest_of(source)}"
        for parent in (kernel_folder, _folder_until_exit):
            try:
                locator = cls(source, function.__code__.co_firstlineno, parent() / name)
                locator.ensure_cache_path()
            except (OSError, RuntimeError):  # RuntimeError: the user has no home folder
                continue
            return locator
        return None

    def ensure_cache_path(self) -> None:
        """Make the folder. Raises ``OSError``."""
        _make_private(self._folder)

    def get_cache_path(self) -> str:
        """The folder."""
        return str(self._folder)

    def get_source_stamp(self) -> str:
        """Identifies the sources of the compiled kernel."""
        return digest_of(self._source)

    def get_disambiguator(self) -> str:
        """Distinguishes kernels of one name in one file: the line."""
        return str(self._line)


@cache
def _folder_until_exit() -> Path:
    stack = contextlib.ExitStack()
    atexit.register(stack.close)
    return stack.enter_context(temporary())


@cache
def digest_of(source: Path) -> str:
    """A digest, 16 hexadecimal digits, of ``source`` and of all files of this project that it imports."""
    sources, waiting = {source}, [source]
    while waiting:
        new = _imported(waiting.pop()) - sources
        sources |= new
        waiting += new
    content = hashlib.sha256()
    for path in sorted(sources):
        content.update(f"{path.relative_to(ROOT)}\0".encode())
        content.update(hashlib.sha256(path.read_bytes()).digest())
    return content.hexdigest()[:16]


@cache
def _imported(source: Path) -> frozenset[Path]:
    """Files of this project that ``source`` imports directly, at its top or inside its functions."""
    named = set()
    for module, names in _IMPORT.findall(source.read_text(encoding="utf-8")):
        named |= {module, *(f"{module}.{name}" for name in re.findall(r"\w+", names))}
    return frozenset(path for name in named if (path := _file_of(name)) is not None)


@cache
def _file_of(module: str) -> Path | None:
    stem = ROOT.joinpath(*module.split("."))
    return next((path for path in (stem.with_suffix(".py"), stem / "__init__.py") if path.is_file()), None)


def _quotas(groups: Path, membership: Path) -> list[float]:
    """CPUs that each control group of this process, and each group above it, may use."""
    quotas = (_quota_of(group) for group in groups_of("cpu", groups, membership))
    return [quota for quota in quotas if quota is not None]


def _quota_of(group: Path) -> float | None:
    """Version 2 has ``cpu.max`` ("quota period" or "max period"), version 1 a file for each, quota -1 for none."""
    try:
        if (group / "cpu.max").is_file():
            quota, period = (group / "cpu.max").read_text().split()
        else:
            quota, period = ((group / f"cpu.cfs_{name}_us").read_text() for name in ("quota", "period"))
        return float(quota) / float(period) if quota != "max" and float(quota) > 0 else None
    except (OSError, ValueError, ZeroDivisionError):
        return None


MEMINFO: Final = Path("/proc/meminfo")
_LIMITS: Final = (
    ("memory.max", "memory.current", ("inactive_file", "active_file")),
    ("memory.limit_in_bytes", "memory.usage_in_bytes", ("total_inactive_file", "total_active_file")),
)
"""Of version 2 and 1: the limit, what is used, and what of it the system can take back."""


def free_bytes(groups: Path = GROUPS, membership: Path = MEMBERSHIP, meminfo: Path = MEMINFO) -> int | None:
    """Bytes that can be had without swapping: of the machine, or of the tightest control group; None: not known."""
    of_groups = [_of_group(group) for group in groups_of("memory", groups, membership)]
    amounts = [value for value in (_of_machine(meminfo), *of_groups) if value is not None]
    return max(min(amounts), 0) if amounts else None


def _of_machine(meminfo: Path) -> int | None:
    try:
        rows = dict(line.split(":", 1) for line in meminfo.read_text().splitlines() if ":" in line)
        return int(rows["MemAvailable"].split()[0]) * 1024
    except (OSError, ValueError, KeyError, IndexError):
        return None


def _of_group(group: Path) -> int | None:
    """Its limit less what is used; files in the system's cache do not count, since they make room."""
    for limit, used, reclaimable in _LIMITS:
        try:
            most = (group / limit).read_text().strip()
            if most == "max":
                return None
            rows = dict(line.split(" ", 1) for line in (group / "memory.stat").read_text().splitlines())
            cached = sum(int(rows.get(name, 0)) for name in reclaimable)
            return int(most) - int((group / used).read_text()) + cached
        except (OSError, ValueError):
            continue
    return None
