"""Documents agree with each other about what was measured, and a document that does not is found."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

from docs.figures import FIGURES, MARK, ROOT, STUDY, differing, documents
from lab.study.catalogue import EXPERIMENTS
from lab.study.output import words


def test_every_document_and_every_page_of_the_study_says_what_was_measured() -> None:
    assert [f"{path.relative_to(ROOT)} {why}" for path, why, _ in differing(ROOT)] == [], "run `make figures`"


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """The documents that this is about, in a folder that may be changed."""
    (tmp_path / "docs" / "notes").mkdir(parents=True)
    for path in [*ROOT.glob("*.md"), *(ROOT / "docs" / "notes").glob("*-0009-*.md")]:
        shutil.copyfile(path, tmp_path / path.relative_to(ROOT))
    shutil.copytree(ROOT / STUDY, tmp_path / STUDY, ignore=shutil.ignore_patterns("pictures"))
    return tmp_path


def told(root: Path) -> str:
    return "\n".join(f"{path.name} {why}" for path, why, _ in differing(root))


def change(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def test_a_marked_figure_that_is_not_the_measured_one_is_found_and_put_right(copy: Path) -> None:
    readme = copy / "README.md"
    right = readme.read_text()
    value = FIGURES["residual-3"].value(copy)
    change(readme, f"-->{value}<!--", "-->0.0001<!--")
    ((path, why, text),) = differing(copy)
    assert (path, text) == (readme, right)
    assert "not the measured one" in why


def test_measured_errors_in_a_document_stand_below_the_size_room_and_seeds_of_their_stages(copy: Path) -> None:
    stages = {"appearances-stages": ("nearer", "its-exposure", "error"), "residual-stages": ("residual-",)}
    for name, starts in stages.items():
        assert re.fullmatch(r"size \w+, room \w+, seeds? [\d, ]+", FIGURES[name].value(copy))
        for path in documents(copy):
            marks = [mark[1] for mark in MARK.finditer(path.read_text())]
            measured = [n for n, mark in enumerate(marks) if mark.startswith(starts) and mark != name]
            assert not measured or name in marks[: measured[0]], f"{path.name} does not say of which stages"


def test_every_page_of_the_study_names_the_room(copy: Path) -> None:
    for one in EXPERIMENTS:
        (stage,) = re.findall(r"^Stage: .*$", (copy / STUDY / f"{one.name}.md").read_text(), re.MULTILINE)
        assert re.search(r"; size \w+; room \w+; ", stage), one.name


def test_two_documents_that_tell_different_numbers_of_the_same_thing_are_found(copy: Path) -> None:
    change(copy / "CHANGELOG.md", "36 photographs per projector of the paper's size", "33 photographs per\n"
           "  projector of the paper's size")  # fmt: skip
    assert told(copy) == 'CHANGELOG.md says "33 photographs per projector of the paper\'s size", and photographs is 36'


def test_a_page_of_the_study_that_was_edited_by_hand_is_found(copy: Path) -> None:
    row = re.search(r"\| 1 \| full solve \| [\d.]+", (copy / STUDY / "live.md").read_text())
    assert row is not None
    change(copy / STUDY / "live.md", row[0], f"{row[0]}1")
    assert told(copy) == "live.md is not what docs/study/data says"


def test_a_name_that_is_not_known_and_a_figure_that_nobody_tells_are_found(copy: Path) -> None:
    text = (copy / "README.md").read_text()
    (copy / "README.md").write_text(text.replace("<!--figure its-exposure-->", "<!--figure its-exposition-->"))
    assert "README.md names a figure that is not known" in told(copy)
    assert "figures.py its-exposure is in no document" in told(copy)
    (copy / "README.md").write_text(text.replace("photographs per projector of", "pictures per projector of"))
    (copy / "CHANGELOG.md").write_text("")
    assert "nothing is said as" in told(copy)


def test_texts_of_the_pages_hold_no_measured_number() -> None:
    beside = words.SIX_PROJECTORS_DESCRIPTION, words.SHARP_DESCRIPTION
    for text in (*words.DESCRIPTIONS.values(), *beside, *words.MISS_REASONS.values()):
        assert not re.search(r"\d\.\d\d|seed \d|size (small|medium|paper)\b", text), text
