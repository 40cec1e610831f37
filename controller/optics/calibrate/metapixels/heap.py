"""A binary max-heap in arrays whose keys can change.

``heap[0]`` is the number of entries, which follow from ``heap[1]``; ``place[item]`` is where an item lies, 0 if it is
not in; ``key[item]`` orders them. The caller changes ``key`` and then calls ``update``.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from controller.core.arrays import Float64
from controller.core.jit import compiled


@compiled()
def rebuild(key: Float64) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Heap and places of all items whose key is finite."""
    heap, place = np.zeros(key.size + 1, np.int64), np.zeros(key.size, np.int64)
    for item in range(key.size):
        if np.isfinite(key[item]):
            heap[0] += 1
            heap[heap[0]] = item
            place[item] = heap[0]
    for at in range(heap[0] // 2, 0, -1):
        _sink(heap, place, key, at)
    return heap, place


@compiled()
def pop(heap: npt.NDArray[np.int64], place: npt.NDArray[np.int64], key: Float64) -> int:
    """Take out the item with the largest key; the heap must not be empty."""
    top = heap[1]
    last = heap[heap[0]]
    heap[0] -= 1
    place[top] = 0
    if heap[0] > 0:
        heap[1] = last
        place[last] = 1
        _sink(heap, place, key, 1)
    return int(top)


@compiled()
def update(heap: npt.NDArray[np.int64], place: npt.NDArray[np.int64], key: Float64, item: int) -> None:
    """Put an item whose key changed where it belongs; one that is not in is added."""
    if place[item] == 0:
        heap[0] += 1
        heap[heap[0]] = item
        place[item] = heap[0]
    _rise(heap, place, key, place[item])
    _sink(heap, place, key, place[item])


@compiled()
def _rise(heap: npt.NDArray[np.int64], place: npt.NDArray[np.int64], key: Float64, at: int) -> None:
    while at > 1 and key[heap[at]] > key[heap[at // 2]]:
        _swap(heap, place, at, at // 2)
        at //= 2


@compiled()
def _sink(heap: npt.NDArray[np.int64], place: npt.NDArray[np.int64], key: Float64, at: int) -> None:
    while True:
        largest = at
        for child in (2 * at, 2 * at + 1):
            if child <= heap[0] and key[heap[child]] > key[heap[largest]]:
                largest = child
        if largest == at:
            return
        _swap(heap, place, at, largest)
        at = largest


@compiled()
def _swap(heap: npt.NDArray[np.int64], place: npt.NDArray[np.int64], one: int, other: int) -> None:
    heap[one], heap[other] = heap[other], heap[one]
    place[heap[one]], place[heap[other]] = one, other
