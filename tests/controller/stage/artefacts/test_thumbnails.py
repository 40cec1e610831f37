"""A small picture of an appearance is that of its latest solve."""

from __future__ import annotations

from pathlib import Path

from controller.stage.artefacts.published import read_thumbnail, write_thumbnail
from controller.stage.artefacts.solved import solved_figures_path


def solve(run: Path, name: str, figures: str) -> None:
    path = solved_figures_path(run, name)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(figures)


def test_a_picture_is_kept_until_its_appearance_is_solved_again(tmp_path: Path) -> None:
    for name in ("gold", "gold-leaf"):
        solve(tmp_path, name, "{}")
        assert read_thumbnail(tmp_path, name) is None
        write_thumbnail(tmp_path, name, name.encode())
    assert read_thumbnail(tmp_path, "gold") == b"gold"
    solve(tmp_path, "gold", '{"sweeps": 2}')
    assert read_thumbnail(tmp_path, "gold") is None
    write_thumbnail(tmp_path, "gold", b"gold again")
    assert read_thumbnail(tmp_path, "gold") == b"gold again"
    assert read_thumbnail(tmp_path, "gold-leaf") == b"gold-leaf"
    assert len(list(tmp_path.rglob("thumbnail-*.png"))) == 2
