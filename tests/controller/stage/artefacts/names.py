"""Names that stage.toml lets projectors have, chosen to be hard to distinguish."""

from __future__ import annotations

from hypothesis import strategies as st

from controller.stage.artefacts.kinds import StepKind

WORDS = (
    *StepKind, "left", "top", "white", "black", "pattern", "target", "reachable", "image", "file", "reasons", "error",
    "device", "linear", "frame", "000", "0", ".", "..", "%", "%2D", "%~", "a.npy", "Ärger", "e\u0301", "é",
    "\x85", "“”",
)  # fmt: skip
"""Parts of names of steps, files and arrays, and what is awkward in the name of a file."""

_LETTERS = st.characters(blacklist_categories=["Cs"], blacklist_characters=[*map(chr, range(0x20)), "\x7f", "/", "\\"])
_JOINED = st.builds(lambda parts, by: by.join(parts), st.lists(st.sampled_from(WORDS), min_size=1, max_size=4),
                    st.sampled_from(["-", " ", ".", ""]))  # fmt: skip
names = st.one_of(_JOINED, st.text(_LETTERS, min_size=1, max_size=64)).filter(lambda name: 1 <= len(name) <= 64)
projectors = st.lists(names, min_size=1, max_size=5, unique=True)
"""Of one stage, in any order."""
