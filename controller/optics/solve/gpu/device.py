"""A graphics processor that computes: its buffers, its kernels and what it refuses.

All errors of wgpu leave here as ``DeviceRefused``: what a device can't do, the processor does instead.
"""

from __future__ import annotations

import contextlib
import logging
import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import wgpu

GROUP: Final = 64
"""Threads of a group of the kernels over flat arrays."""
MOST_GROUPS: Final = 65535
"""Groups along one axis, of any device."""
STORAGE_BUFFERS: Final = 8
"""Of one kernel, of any device."""
SMALLEST_BYTES: Final = 16
CHUNK_BYTES: Final = 1 << 24
CHUNKS: Final = 2
STRIP_BYTES: Final = 1 << 20
"""Of an array that is no block of memory, so much is copied at a time: it stays in the processor's cache."""
SOFTWARE: Final = "CPU"
"""wgpu's name for the kind of adapter that is a program, such as Mesa's lavapipe."""

# It writes to standard error where no program handles its messages; all that it says is in its errors, too.
logging.getLogger("wgpu").addHandler(logging.NullHandler())

Buffer = Any
"""wgpu has no types."""
Array = npt.NDArray[Any]


class DeviceRefused(Exception):
    """The device is missing, lost, too small or out of memory; the text says which, in one sentence."""


@dataclass(frozen=True, slots=True)
class Found:
    """A graphics processor of this computer. ``software``: a program that does its work on the processor."""

    name: str
    backend: str
    software: bool
    adapter: Any


def adapters() -> list[Found]:
    """The graphics processors that wgpu finds, real ones first, discrete before integrated. None without drivers."""
    kinds = {"DiscreteGPU": 0, "IntegratedGPU": 1, SOFTWARE: 3}
    found = []
    with _refusals("look for a graphics processor"), _no_windows():
        for adapter in wgpu.gpu.enumerate_adapters_sync():
            info = adapter.info
            # OpenGL has no compute shaders that could be relied on
            if info["backend_type"] != "OpenGL":
                software = info["adapter_type"] == SOFTWARE
                order = kinds.get(info["adapter_type"], 2)
                found.append((order, Found(str(info["device"]), str(info["backend_type"]), software, adapter)))
    return [one for _, one in sorted(found, key=lambda pair: pair[0])]


class Device:
    """An open graphics processor. ``held_bytes``: of the buffers made and not given back."""

    def __init__(self, found: Found) -> None:
        """Open it. Raises DeviceRefused."""
        self.name, self.software = found.name, found.software
        self.held_bytes = 0
        self._kernels: dict[tuple[str, ...], Any] = {}
        limits = {name: found.adapter.limits[name] for name in ("max-buffer-size", "max-storage-buffer-binding-size")}
        self.most_bytes = int(min(limits.values()))
        """The largest buffer that a kernel can use."""
        with _refusals("open"), _no_windows():
            self._device = found.adapter.request_device_sync(
                required_limits={**limits, "max-storage-buffers-per-shader-stage": STORAGE_BUFFERS}
            )
        self._chunks: dict[int, list[Buffer]] = {}

    def close(self) -> None:
        """Give the device back. All that uses it afterwards raises DeviceRefused."""
        self._device.destroy()

    # buffers

    def room(self, size_bytes: int, what: str) -> Buffer:
        """A buffer of zeros. Raises DeviceRefused if it is too large for this device, or for its memory."""
        size = max(-(-size_bytes // 4) * 4, SMALLEST_BYTES)
        if size > self.most_bytes:
            raise DeviceRefused(
                f"{self.name} has room for {self.most_bytes / 1e6:.0f} MB in one piece, and the {what} "
                f"need {size / 1e6:.0f} MB"
            )
        usage = wgpu.BufferUsage.STORAGE | wgpu.BufferUsage.COPY_DST | wgpu.BufferUsage.COPY_SRC
        with _refusals(f"hold the {what}"):
            buffer = self._device.create_buffer(size=size, usage=usage)
        self.held_bytes += size
        return buffer

    def uniform(self, values: Array) -> Buffer:
        """A buffer of constants, of a kernel's structure."""
        with _refusals("hold constants"):
            return self._device.create_buffer_with_data(
                data=values.tobytes(), usage=wgpu.BufferUsage.UNIFORM | wgpu.BufferUsage.COPY_DST
            )

    def write(self, buffer: Buffer, values: Array, at: int = 0) -> None:
        """Put values to a buffer, from byte ``at`` on. They may be a part of an array: it is read in place."""
        if not values.size:
            return
        if values.nbytes < CHUNK_BYTES:
            flat = np.ascontiguousarray(values).reshape(-1).view(np.uint8)
            if flat.nbytes % 4:
                flat = np.concatenate([flat, np.zeros(-flat.nbytes % 4, np.uint8)])
            with _refusals("take values"):
                self._device.queue.write_buffer(buffer, at, flat)
            return
        usage = wgpu.BufferUsage.MAP_WRITE | wgpu.BufferUsage.COPY_SRC
        rows = values.reshape(-1, 1) if values.flags.c_contiguous else values
        with _refusals("take values"):
            for number, part in enumerate(_strips(rows, CHUNK_BYTES)):
                chunk = self._chunk(usage, number)
                # waits until the chunk's last content was copied
                chunk.map_sync(wgpu.MapMode.WRITE)
                done = 0
                for strip in _strips(part, STRIP_BYTES):
                    chunk.write_mapped(np.ascontiguousarray(strip).reshape(-1).view(np.uint8), done)
                    done += strip.nbytes
                chunk.unmap()
                self._copy(chunk, 0, buffer, at, done)
                at += done

    def read(self, buffer: Buffer, count: int) -> npt.NDArray[np.float32]:
        """The first ``count`` float32 of a buffer, after all that was submitted."""
        out = np.empty(count, np.float32)
        parts = list(_strips(out, CHUNK_BYTES))
        usage = wgpu.BufferUsage.MAP_READ | wgpu.BufferUsage.COPY_DST
        with _refusals("give its result"):
            # the next chunk is copied while one is read
            for step in range(len(parts) + CHUNKS - 1):
                if step < len(parts):
                    self._copy(buffer, step * CHUNK_BYTES, self._chunk(usage, step), 0, parts[step].nbytes)
                number = step - CHUNKS + 1
                if number >= 0:
                    chunk, part = self._chunk(usage, number), parts[number]
                    chunk.map_sync(wgpu.MapMode.READ)
                    part[:] = np.frombuffer(chunk.read_mapped(0, part.nbytes, copy=False), np.float32)
                    chunk.unmap()
        return out

    def _chunk(self, usage: int, number: int) -> Buffer:
        """One of a few buffers that this program and the device both see, in turn. They stay: making them is slow."""
        if usage not in self._chunks:
            self._chunks[usage] = [self._device.create_buffer(size=CHUNK_BYTES, usage=usage) for _ in range(CHUNKS)]
        return self._chunks[usage][number % CHUNKS]

    def _copy(self, source: Buffer, at: int, to: Buffer, begin: int, size: int) -> None:
        encoder = self._device.create_command_encoder()
        encoder.copy_buffer_to_buffer(source, at, to, begin, size)
        self._device.queue.submit([encoder.finish()])

    # work

    def kernel(self, *sources: str) -> Any:
        """The kernel ``main`` of the files in ``shaders`` with these names, joined."""
        # not before the first kernel: a look at what this computer has loads no numeric package
        from controller.optics.solve.gpu.shader_constants import declarations

        if sources not in self._kernels:
            code = "\n".join(_source(name) for name in sources)
            code = declarations(code) + code
            with _refusals(f"compile {sources[-1]}"):
                module = self._device.create_shader_module(code=code)
                self._kernels[sources] = self._device.create_compute_pipeline(
                    layout="auto", compute={"module": module, "entry_point": "main"}
                )
        return self._kernels[sources]

    def work(
        self, kernel: Any, buffers: Sequence[Buffer] | Mapping[int, Buffer], threads: int | tuple[int, int]
    ) -> Work:
        """A kernel with its buffers, by number. ``threads``: so many at least, or groups of them along each axis."""
        numbered = buffers if isinstance(buffers, Mapping) else dict(enumerate(buffers))
        entries = [{"binding": number, "resource": {"buffer": buffer}} for number, buffer in numbered.items()]
        with _refusals("take work"):
            bound = self._device.create_bind_group(layout=kernel.get_bind_group_layout(0), entries=entries)
        return Work(kernel, bound, spread(threads) if isinstance(threads, int) else threads)

    def submit(self, steps: Sequence[Step]) -> None:
        """Begin the steps, one after the other."""
        with _refusals("do its work"):
            encoder = self._device.create_command_encoder()
            compute = None
            for step in steps:
                if isinstance(step, Work):
                    compute = compute or encoder.begin_compute_pass()
                    compute.set_pipeline(step.kernel)
                    compute.set_bind_group(0, step.bound)
                    compute.dispatch_workgroups(*step.groups)
                    continue
                if compute is not None:
                    compute.end()
                    compute = None
                if isinstance(step, Copy):
                    encoder.copy_buffer_to_buffer(step.source, 0, step.to, 0, step.to.size)
                else:
                    encoder.clear_buffer(step.buffer)
            if compute is not None:
                compute.end()
            self._device.queue.submit([encoder.finish()])


class Held:
    """The buffers of one purpose, which go together."""

    def __init__(self, device: Device) -> None:
        self.device = device
        self._buffers: list[Buffer] = []

    def room(self, size_bytes: int, what: str) -> Buffer:
        """As ``Device.room``."""
        self._buffers.append(self.device.room(size_bytes, what))
        return self._buffers[-1]

    def put(self, values: Array, what: str) -> Buffer:
        """A buffer with these values."""
        made = self.room(values.nbytes, what)
        self.device.write(made, values)
        return made

    def free(self) -> None:
        """Give their memory back."""
        for buffer in self._buffers:
            self.device.held_bytes -= buffer.size
            buffer.destroy()
        self._buffers.clear()


@dataclass(frozen=True, slots=True)
class Work:
    """A kernel that is ready to run, in groups of threads."""

    kernel: Any
    bound: Any
    groups: tuple[int, int]


@dataclass(frozen=True, slots=True)
class Copy:
    """The content of one buffer to another as large."""

    source: Buffer
    to: Buffer


@dataclass(frozen=True, slots=True)
class Clear:
    """Zeros to a buffer."""

    buffer: Buffer


Step = Work | Copy | Clear


def _strips(values: Array, most_bytes: int) -> Iterator[Array]:
    """Parts of the first axis, of at most so many bytes, but a row at least."""
    rows = max(most_bytes // max(values[:1].nbytes, 1), 1)
    for begin in range(0, len(values), rows):
        yield values[begin : begin + rows]


def spread(threads: int) -> tuple[int, int]:
    """Groups, along two axes, that have so many threads or a few more."""
    groups = max(-(-threads // GROUP), 1)
    across = min(groups, MOST_GROUPS)
    return across, -(-groups // across)


def groups_of(threads: int) -> int:
    """How many groups ``spread`` makes; each writes one number where a kernel adds up."""
    across, down = spread(threads)
    return across * down


@cache
def _source(name: str) -> str:
    return (resources.files(__package__) / "shaders" / f"{name}.wgsl").read_text("utf-8")


@contextlib.contextmanager
def _no_windows() -> Iterator[None]:
    """Where this folder is not named, Mesa complains on standard error that it finds no Wayland, needed or not.

    Meanwhile it is the folder that is used where none is named.
    """
    name = "XDG_RUNTIME_DIR"
    if os.environ.get(name):
        yield
        return
    os.environ[name] = tempfile.gettempdir()
    try:
        yield
    finally:
        del os.environ[name]


@contextlib.contextmanager
def _refusals(what: str) -> Iterator[None]:
    """Raise DeviceRefused for anything that wgpu raises: its own errors, and RuntimeError from its library."""
    try:
        yield
    except wgpu.GPUOutOfMemoryError as error:
        raise DeviceRefused(f"the graphics processor has no memory left to {what}") from error
    except (wgpu.GPUError, RuntimeError, OSError) as error:
        raise DeviceRefused(f"the graphics processor could not {what}: {_cause(error)}") from error


def _cause(error: BaseException) -> str:
    """The last line, which holds the cause."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return (lines[-1] if lines else type(error).__name__).rstrip(".")
