"""The fixed scenes: a bench's stage, prepared from a seed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from controller.core.errors import UsageError
from controller.study.lab.scenes import Scene

_ALL: Final = (
    Scene("dark", "a painted vase and bust before three projectors, no light but theirs"),
    Scene("room", "the same on a table before a wall, with the light that these throw back", None, {"room": "room"}),
)
SCENES: Final[Mapping[str, Scene]] = {scene.name: scene for scene in _ALL}


def chosen_scenes(names: Sequence[str]) -> list[Scene]:
    """The scenes of these names; without names all. Raises UsageError("scene-unknown")."""
    for name in names:
        if name not in SCENES:
            raise UsageError(
                "scene-unknown", what=f"There is no scene called {name}.", remedy=f"Choose from {', '.join(SCENES)}."
            )
    return [scene for scene in _ALL if not names or scene.name in names]
