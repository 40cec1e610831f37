"""The fixed scenes: a bench's stage, prepared from a seed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from controller.core.errors import UsageError
from lab.study.subject.scenes import Scene, plate_object

_ALL: Final = (
    Scene("dark", "a painted vase and bust before three projectors, no light but theirs"),
    Scene("flat", "a pale plate, flat but for its rim, no light but that of three projectors", plate_object),
    Scene(
        "room", "vase and bust on a table before a wall, with the light that these throw back", None, {"room": "room"}
    ),
    Scene(
        "traced",
        "the same room, its light followed along paths through Mitsuba 3",
        None,
        {"room": "room", "engine": "mitsuba"},
    ),
)
SCENES: Final[Mapping[str, Scene]] = {scene.name: scene for scene in _ALL}
PLANES: Final = frozenset({"flat"})
"""Scenes whose targets are on their flat part alone."""


def chosen_scenes(names: Sequence[str]) -> list[Scene]:
    """The scenes of these names; without names all. Raises UsageError("scene-unknown")."""
    for name in names:
        if name not in SCENES:
            raise UsageError(
                "scene-unknown", what=f"There is no scene called {name}.", remedy=f"Choose from {', '.join(SCENES)}."
            )
    return [scene for scene in _ALL if not names or scene.name in names]
