"""A calibration that is stopped, killed, unplugged and short of disk, and continues each time, to its end.

The object is a mesh from a file, and the projectors' lenses bend their pictures. The bench's truth lies elsewhere from
the moment at which its devices are there.
"""

from __future__ import annotations

import contextlib
import time
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from hal.values import Power
from tests.end_to_end.program import (
    Bench,
    Command,
    Outcome,
    asked,
    hidden,
    lamps,
    powers,
    processes_on,
    run_of,
    shots,
    strikes,
    velatura,
)

pytestmark = [pytest.mark.long, pytest.mark.timeout(1200)]
NAMES = ("left", "right", "above")
QUICK = """
[capture]
settle_s = 0.05
"""
"""The bench shows a frame 0.033 s after it was presented."""
STRAIGHT = "distortion = [0.0, 0.0]"
"""The projectors' lenses, as the bench is prepared; here their pictures are bent, as real ones are."""


@dataclass(frozen=True, slots=True)
class Chapter:
    """What an interruption left: how the command ended and how fast, photographs, lamps remembered and in truth."""

    outcome: Outcome | None
    seconds: float
    shots: dict[str, float]
    lit: dict[str, bool]
    strikes: dict[str, int]
    powers: dict[str, Power]
    processes: list[str]
    parts: list[str]


@dataclass(slots=True)
class Story:
    """One stage's way to its calibration, and what came of it."""

    stage: Path
    chapters: dict[str, Chapter] = field(default_factory=dict)
    commands: dict[str, Outcome] = field(default_factory=dict)

    def tell(self, name: str, outcome: Outcome | None, since_s: float, *, answering: bool = True) -> None:
        seconds, run = time.monotonic() - since_s, run_of(self.stage)
        self.chapters[name] = Chapter(
            outcome=outcome,
            seconds=seconds,
            shots=shots(run),
            lit=lamps(self.stage),
            strikes=strikes(self.stage),
            powers=powers(self.stage) if answering else {},
            processes=[words for words in processes_on(self.stage) if "bench_with_knobs" not in words],
            parts=[path.name for path in run.rglob("*.part")],
        )

    def stop(self, name: str, step: str, fraction: float = 0.0) -> None:
        with Command("calibrate", self.stage) as calibrate:
            calibrate.wait_for(step, fraction=fraction)
            began_s = time.monotonic()
            self.tell(name, calibrate.interrupt(), began_s)

    def fill_the_disk(self, name: str, step: str, fraction: float) -> None:
        with Command("calibrate", self.stage) as calibrate:
            calibrate.wait_for(step, fraction=fraction)
            began_s = time.monotonic()
            calibrate.limit_files_to(600_000)  # a RAW file has 0.8 MB
            self.tell(name, calibrate.outcome(), began_s)

    def kill(self, name: str, step: str, fraction: float) -> None:
        with Command("calibrate", self.stage) as calibrate:
            calibrate.wait_for(step, fraction=fraction)
            calibrate.kill()
            self.tell(name, None, time.monotonic())

    def unplug(self, name: str, step: str, fraction: float, bench: Bench) -> None:
        with Command("calibrate", self.stage) as calibrate:
            calibrate.wait_for(step, fraction=fraction)
            bench.turn("unplug left")
            outcome = calibrate.outcome()
            began_s = time.monotonic()
            bench.turn("replug left")
            self.tell(name, outcome, began_s)

    def lose_the_bench(self, name: str, step: str, fraction: float, bench: Bench) -> None:
        with Command("calibrate", self.stage) as calibrate:
            calibrate.wait_for(step, fraction=fraction)
            began_s = time.monotonic()
            bench.kill()
            self.tell(name, calibrate.outcome(), began_s, answering=False)


@pytest.fixture(scope="module")
def story(tmp_path_factory: pytest.TempPathFactory, bumpy_ball: Path) -> Story:
    out = tmp_path_factory.mktemp("going on") / "out"
    prepared = velatura("demo", "--prepare-only", "--room", "dark", "--object", bumpy_ball, "--out", out)
    assert prepared.result == {"stage": str(out / "stage")}
    toml = out / "stage" / "stage.toml"
    toml.write_text(toml.read_text().replace("power_down_s = 10.0", "power_down_s = 3.0") + QUICK)
    truth = out / "stage" / "bench.toml"
    assert truth.read_text().count(STRAIGHT) == len(NAMES)
    truth.write_text(truth.read_text().replace(STRAIGHT, "distortion = [0.02, -0.005]"))
    story = Story(out / "stage")
    with Bench(story.stage) as bench, truth_away(story.stage):
        story.stop("stopped while the lamps warm up", "Waiting for stable light")
        story.fill_the_disk("disk full", "Photographing the light of left", 0.3)
        story.kill("killed", "Photographing the light of right", 0.3)
        story.stop("stopped while photographing", "Photographing the light of above", 0.3)
        story.unplug("unplugged", "Photographing the patterns of left", 0.3, bench)
        story.lose_the_bench("bench gone", "Photographing the patterns of right", 0.3, bench)
    with Bench(story.stage), truth_away(story.stage):
        story.stop("stopped while decoding", "Decoding above")
        story.commands["calibrate"] = velatura("calibrate", story.stage)
        with Command("appearance", story.stage, "gloss") as solving:
            solving.wait_for("Solving the base image", fraction=0.05)
            story.commands["appearance, stopped"] = solving.interrupt()
        story.commands["appearance"] = velatura("appearance", story.stage, "gloss")
        story.commands["play"] = velatura("play", story.stage, "gloss", "--seconds", "1")
    return story


def truth_away(stage: Path) -> contextlib.AbstractContextManager[None]:
    """All that only the bench may know; the projectors' profile is named in stage.toml."""
    secrets = [path for path in (stage / "bench").iterdir() if path.name != "optoma-fast.toml"]
    assert "object.npz" in {path.name for path in secrets}
    return hidden(stage / "bench.toml", *secrets)


STOPPED = ("stopped while the lamps warm up", "stopped while photographing", "stopped while decoding")
FAILED = (
    ("disk full", 1, {"no-space", "cannot-write"}),
    ("unplugged", 3, {"port-missing"}),
    ("bench gone", 3, {"camera-off", "camera-gone", "camera-lost", "port-missing", "port-lost"}),
)


def test_it_ends_calibrated_without_ever_seeing_the_benchs_truth(story: Story) -> None:
    done = story.commands["calibrate"]
    assert (done.code, done.stderr, done.error) == (0, "", {})
    run = run_of(story.stage)
    assert done.result["run"] == str(run)
    assert done.result.keys() == {"run", "grade", "map", "error", "photographs"}
    assert done.result["grade"] in ("A", "B")
    assert (run / "geometry.npz").exists()
    # the solving that was stopped, the one that went on, and what was refined is published
    assert asked(run, "SELECT outcome FROM runs ORDER BY id")[-3:] == [("cancelled",), ("done",), ("done",)]


@pytest.mark.parametrize("name", STOPPED)
def test_ctrl_c_ends_soon_with_a_sentence_and_every_lamp_off(story: Story, name: str) -> None:
    chapter = story.chapters[name]
    assert chapter.outcome is not None
    assert chapter.outcome.code == 130
    assert chapter.outcome.error["what"] == "The work was stopped on request."
    assert chapter.outcome.error["remedy"] == "Run the same command to continue from here."
    assert chapter.outcome.stderr == ""
    assert chapter.seconds < 15
    assert set(chapter.powers.values()) <= {Power.OFF, Power.COOLING}
    assert not any(chapter.lit.values())
    assert chapter.processes == []


@pytest.mark.parametrize(("name", "code", "errors"), FAILED)
def test_a_failure_is_told_in_two_sentences_with_its_exit_code(
    story: Story, name: str, code: int, errors: set[str]
) -> None:
    outcome = story.chapters[name].outcome
    assert outcome is not None
    assert outcome.code == code
    assert outcome.error["code"] in errors
    assert outcome.error["what"].endswith(".")
    assert outcome.error["remedy"].endswith(".")
    assert outcome.stderr == ""
    assert story.chapters[name].processes == []


@pytest.mark.parametrize("name", ["disk full", "unplugged", "bench gone", *STOPPED])
def test_no_temporary_file_stays_behind(story: Story, name: str) -> None:
    assert story.chapters[name].parts == []


def test_a_full_disk_leaves_no_lamp_lit(story: Story) -> None:
    chapter = story.chapters["disk full"]
    assert set(chapter.powers.values()) <= {Power.OFF, Power.COOLING}
    assert not any(chapter.lit.values())


def test_a_projector_that_was_unplugged_is_named_and_the_others_are_off(story: Story) -> None:
    chapter = story.chapters["unplugged"]
    assert chapter.outcome is not None
    assert "tty-left" in chapter.outcome.error["what"]
    assert chapter.lit == {"left": True, "right": False, "above": False}
    assert chapter.powers["left"] is Power.ON  # its lamp burns on: no command reached it
    assert {chapter.powers[name] for name in ("right", "above")} <= {Power.OFF, Power.COOLING}
    told = [record["message"] for record in chapter.outcome.records if "message" in record]
    assert any(one["level"] == "error" and "left could not be switched off" in one["text"] for one in told)


def test_a_bench_that_dies_holds_nothing_up(story: Story) -> None:
    chapter = story.chapters["bench gone"]
    assert chapter.seconds < 30
    assert chapter.lit == dict.fromkeys(NAMES, True)  # no one could say otherwise


def test_a_killed_run_leaves_its_lamps_lit_and_the_next_does_not_strike_them_again(story: Story) -> None:
    killed, after = story.chapters["killed"], story.chapters["stopped while photographing"]
    assert killed.powers == dict.fromkeys(NAMES, Power.ON)
    assert killed.lit == dict.fromkeys(NAMES, True)
    assert after.strikes == killed.strikes


def test_only_one_run_was_ever_begun_and_its_photographs_were_taken_once(story: Story) -> None:
    """But those that were taken while a projector was away, or when the bench died: no one knows what they show."""
    chapters = list(story.chapters.values())
    assert [len(chapter.shots) for chapter in chapters] == sorted(len(chapter.shots) for chapter in chapters)
    final = shots(run_of(story.stage))
    for name in ("disk full", "killed", "stopped while photographing", "stopped while decoding"):
        kept = story.chapters[name].shots
        assert len(kept) > 0
        assert {shot: final[shot] for shot in kept} == kept, name


def test_a_kill_repeats_one_photograph_at_most(story: Story) -> None:
    killed, after = story.chapters["killed"], story.chapters["stopped while photographing"]
    assert len(killed.shots) >= 1
    assert {name: after.shots[name] for name in killed.shots} == killed.shots
    final, captures = shots(run_of(story.stage)), run_of(story.stage) / "captures"
    assert {str(path.relative_to(captures.parent)) for path in captures.rglob("*.dng")} == set(final)


def test_a_stopped_solve_goes_on_and_its_appearance_plays(story: Story) -> None:
    stopped, solved, played = (story.commands[name] for name in ("appearance, stopped", "appearance", "play"))
    assert (stopped.code, stopped.error["code"]) == (130, "cancelled")
    assert (solved.code, solved.error) == (0, {})
    assert Path(solved.result["bundle"]).is_relative_to(story.stage / "bundles")
    assert (played.code, played.error, played.result) == (0, {}, {"played": "gloss"})
    assert not any(lamps(story.stage).values())
