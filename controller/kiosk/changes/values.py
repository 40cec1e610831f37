"""What changed, as the panel shows it and the commands print it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Change:
    """One thing that differs from the last good day.

    ``kind`` is a key of ``compare.KINDS``; ``name``: which one; ``before`` and ``now`` as they were read, empty where
    there was or is none; ``sentence`` says it, ``remedy`` what to do. ``since_unix_s``: when it was first seen.
    """

    kind: str
    name: str
    before: str
    now: str
    sentence: str
    remedy: str
    since_unix_s: float


@dataclass(frozen=True, slots=True)
class Changes:
    """``good_unix_s``: when the last good day's inventory was taken, None if there is none; ``run``: what graded well;
    ``unknown``: what can't be read now, so that it is not compared.
    """

    good_unix_s: float | None
    run: str
    changes: tuple[Change, ...]
    unknown: tuple[str, ...]
