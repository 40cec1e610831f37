"""Sequences from files, and what is wrong with them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from controller.bundle.format import PlaylistEntry
from controller.bundle.signing import ANY_SIGNER, Trust
from controller.bundle.writer import NewAppearance, NewBundle, write_bundle
from controller.core.errors import BundleError, UsageError
from controller.stage.services.play import (
    PlayedSequence,
    PlayRequest,
    read_sequence,
    requested_sequence,
    suggested_sequence,
)


def test_a_sequence_file_says_what_for_how_long_and_how_often(tmp_path: Path) -> None:
    path = tmp_path / "evening.toml"
    path.write_text(
        'repeat = 2\n[[item]]\nappearance = "marble"\nseconds = 5\nfade_s = 1.5\n[[item]]\nappearance = "stone"\n'
    )
    found = read_sequence(path)
    assert found.items == (("marble", 5.0, 1.5), ("stone", 10.0, 0.0))
    assert found.whole_s == 30.0


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "needs ..item.. tables"),
        ("item = 3", "needs ..item.. tables"),
        ("[[items]]\n", "needs ..item.. tables"),
        ("[[item]\n", "not TOML"),
        ("repeat = -1\n[[item]]\nappearance = 'a'", "whole number"),
        ("repeat = true\n[[item]]\nappearance = 'a'", "whole number"),
        ("[[item]]\nseconds = 3", "item 1"),
        ("[[item]]\nappearance = 'a'\n[[item]]\nappearance = 'b'\nseconds = 0", "item 2"),
        ("[[item]]\nappearance = 'a'\nseconds = 1\nfade_s = 2", "fade_s"),
        ("[[item]]\nappearance = 'a'\nseconds = nan", "seconds"),
        ("[[item]]\nappearance = 'a'\nfade = 2", "item 1"),
    ],
)
def test_a_wrong_sequence_file_is_told_with_its_item(tmp_path: Path, text: str, why: str) -> None:
    path = tmp_path / "s.toml"
    path.write_text(text)
    with pytest.raises(UsageError, match=why) as caught:
        read_sequence(path)
    assert caught.value.code == "sequence-file-wrong"


def test_one_name_stays_and_several_take_turns() -> None:
    alone = requested_sequence(PlayRequest(("a",), None, 7.0, 2.0, 0))
    assert (alone.repeat, alone.whole_s) == (1, 7.0)
    several = requested_sequence(PlayRequest(("a", "b"), None, 3.0, 1.0, 4))
    assert several.items == (("a", 3.0, 1.0), ("b", 3.0, 1.0))
    assert several.whole_s == 24.0


def test_what_does_not_go_together_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="Both appearances and a sequence"):
        requested_sequence(PlayRequest(("a",), tmp_path / "s.toml", None, 0.0, 0))
    with pytest.raises(UsageError, match="is longer than the 1 s for each"):
        requested_sequence(PlayRequest(("a", "b"), None, 1.0, 2.0, 0))
    with pytest.raises(UsageError, match="can't be read"):
        read_sequence(tmp_path / "none.toml")


def test_with_nothing_named_the_bundle_s_own_playlist_is_played(tmp_path: Path) -> None:
    path, black = tmp_path / "b.vel", {"P1": np.zeros((2, 3, 3), np.uint8)}
    made = [NewAppearance(name, black) for name in ("a", "b")]
    new = NewBundle("s", "c", created_unix_s=0, outputs=[("P1", 3, 2)])
    playlist = [PlaylistEntry("b", 9_000, 500), PlaylistEntry("a", 2_000, 2_000)]
    write_bundle(path, replace(new, schedule=playlist), made)
    assert suggested_sequence(path, ANY_SIGNER, 3, None) == PlayedSequence((("b", 9.0, 0.5), ("a", 2.0, 2.0)), 3)
    assert suggested_sequence(path, ANY_SIGNER, 0, 1.0).items == (("b", 1.0, 0.5), ("a", 1.0, 1.0))
    write_bundle(path, new, made)
    with pytest.raises(UsageError, match="has no playlist"):
        suggested_sequence(path, ANY_SIGNER, 0, None)
    with pytest.raises(BundleError, match="no signature"):
        suggested_sequence(path, Trust(), 0, None)
