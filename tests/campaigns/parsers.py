"""Malformed inputs for every parser: no crash, none above 50 ms, memory bounded.

    python -m tests.campaigns.parsers 1000000            (or make campaign NAME=parsers COUNT=1000000)
    python -m tests.campaigns.parsers 100000 ptp-ip stage-toml

Half of the inputs are sound ones with random damage, half come from atheris, which follows the code's branches (in a
process of its own with 512 MiB); one hypothesis example for a hundred inputs comes on top. An input that raises
anything but the parser's own refusal, or needs more than 50 ms of the processor in each of three runs, is shown; then
the campaign ends with 1.
"""

from __future__ import annotations

import importlib
import importlib.util
import logging
import os
import random
import re
import resource
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.campaigns.parser_targets import Target, scratch, targets

MOST_S = 0.05
MEMORY_MIB = 512
"""Limit of an atheris process, interpreter and libraries included."""
ROUNDS = 3
ROOT = Path(__file__).parents[2]
NUMBERS = (0, 1, 0x7F, 0x80, 0xFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)
PIECES = (
    b"[" * 200,
    b"{" * 200,
    b"[[" * 60,
    b"=",
    b'"',
    b"\\",
    b"\r",
    b"\x00",
    b"\xff\xfe",
    b"9" * 300,
    b"-",
    b"nan",
    b"\n",
)


@dataclass
class Outcome:
    """What came of one parser's inputs."""

    parser: str
    inputs: int = 0
    refused: int = 0
    slowest_s: float = 0.0
    grown_mib: float = 0.0
    wrong: list[str] = field(default_factory=list)

    @property
    def holds(self) -> bool:
        return not self.wrong


def once(target: Target, data: bytes, outcome: Outcome) -> None:
    """Give one input to the parser; the processor's time of this thread counts, because others use the machine too."""
    outcome.inputs += 1
    took_s = MOST_S
    for _ in range(ROUNDS):
        began = time.thread_time()
        try:
            target.parse(data)
            refused = 0
        except target.refuses:
            refused = 1
        except Exception as error:  # noqa: BLE001 - that is what is looked for
            outcome.wrong.append(f"{type(error).__name__}: {error} for {data[:200]!r}")
            return
        took_s = min(took_s if _ else 1e9, time.thread_time() - began)
        if took_s <= MOST_S:
            break
    outcome.refused += refused
    outcome.slowest_s = max(outcome.slowest_s, took_s)
    if took_s > MOST_S:
        outcome.wrong.append(f"{took_s:.3f} s for {data[:200]!r}")


def damaged(data: bytes, dice: random.Random, most_bytes: int) -> bytes:
    """A sound input with one to eight injuries."""
    made = bytearray(data)
    for _ in range(dice.randint(1, 8)):
        at = dice.randrange(len(made) + 1)
        match dice.randrange(6):
            case 0 if made:
                made[at % len(made)] ^= 1 << dice.randrange(8)
            case 1:
                del made[at : at + dice.randint(1, 16)]
            case 2:
                made[at:at] = dice.choice(PIECES)
            case 3:
                made[at : at + 4] = dice.choice(NUMBERS).to_bytes(4, "little")
            case 4:
                made[at:at] = made[at : at + dice.randint(1, 64)] * dice.randint(1, 8)
            case _:
                made[at:at] = dice.randbytes(dice.randint(1, 16))
    return bytes(made[:most_bytes])


def damage_campaign(target: Target, count: int, seed: int, outcome: Outcome) -> None:
    dice = random.Random(seed)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for _ in range(count):
        once(target, damaged(dice.choice(target.seeds), dice, target.most_bytes), outcome)
        if len(outcome.wrong) >= 10:
            break
    outcome.grown_mib = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024


def hypothesis_campaign(target: Target, count: int, outcome: Outcome) -> None:
    seeds = st.sampled_from(target.seeds)
    cut = st.builds(
        lambda seed, at, more: seed[: at % (len(seed) + 1)] + more, seeds, st.integers(0, 4096), st.binary()
    )

    @settings(max_examples=max(1, count), deadline=None, database=None, derandomize=True,
              suppress_health_check=list(HealthCheck))  # fmt: skip
    @given(st.one_of(st.binary(max_size=target.most_bytes), cut))
    def each(data: bytes) -> None:
        once(target, data, outcome)

    each()


def atheris_campaign(name: str, count: int, seed: int, outcome: Outcome) -> None:
    """In another process, because the fuzzer ends the one that it runs in."""
    if importlib.util.find_spec("atheris") is None:
        return
    folder = scratch()
    try:
        corpus = folder / "corpus"
        corpus.mkdir()
        for number, data in enumerate(targets(folder)[name].seeds):
            (corpus / str(number)).write_bytes(data)
        command = [sys.executable, "-m", "tests.campaigns.parsers", "--atheris", name, str(folder), f"-runs={count}",
                   f"-seed={seed}", "-max_len=4096", f"-rss_limit_mb={MEMORY_MIB}", "-timeout=10",
                   f"-artifact_prefix={folder}/", str(corpus)]  # fmt: skip
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, errors="replace", check=False)
        match = re.search(r"Done (\d+) (?:runs|in)", done.stderr)
        outcome.inputs += int(match[1]) if match else 0
        told = re.search(r"slowest ([0-9.]+) refused (\d+)", done.stderr)
        if told:
            outcome.slowest_s = max(outcome.slowest_s, float(told[1]))
            outcome.refused += int(told[2])
        if done.returncode != 0 or match is None:
            outcome.wrong.append(f"atheris ended with {done.returncode}: {done.stderr[-1500:]}")
    finally:
        shutil.rmtree(folder)


def atheris_child(name: str, folder: Path, options: list[str]) -> None:
    """Runs the fuzzer; never returns."""
    import atexit

    import atheris  # type: ignore[import-untyped]

    outcome = Outcome(name)
    # What the fuzzer follows must be known to it before it is imported again, with its branches counted.
    for module in [m for m in sys.modules if m.startswith(("hal", "controller", "plugins", "tests.campaigns.parser_"))]:
        del sys.modules[module]
    with atheris.instrument_imports(
        include=["hal", "controller.kiosk.building", "controller.bundle", "controller.config"]
    ):
        again = importlib.import_module("tests.campaigns.parser_targets")
    target: Any = again.targets(folder)[name]
    most_s = MOST_S * 2  # counting branches takes as long as the work itself

    def one(data: bytes) -> None:
        began = time.thread_time()
        once(target, data, outcome)
        if outcome.wrong and not (time.thread_time() - began < most_s and outcome.wrong[-1].startswith("0.0")):
            raise RuntimeError(outcome.wrong[-1])
        outcome.wrong.clear()

    def tell() -> None:
        os.write(2, f"slowest {outcome.slowest_s:.4f} refused {outcome.refused}\n".encode())

    atexit.register(tell)
    atheris.Setup([sys.argv[0], *options], one)
    atheris.Fuzz()


def run(count: int, seed: int = 1, names: tuple[str, ...] = (), *, follow: bool = True) -> list[Outcome]:
    """``count`` inputs a parser; without ``follow`` all of them are damaged sound ones."""
    folder, outcomes = scratch(), []
    try:
        for name, target in targets(folder).items():
            if names and name not in names:
                continue
            outcome = Outcome(name)
            followed = count // 2 if follow and importlib.util.find_spec("atheris") else 0
            damage_campaign(target, count - followed, seed, outcome)
            hypothesis_campaign(target, count // 100, outcome)
            if followed:
                atheris_campaign(name, followed, seed, outcome)
            outcomes.append(outcome)
            print(row(outcome), flush=True)
    finally:
        shutil.rmtree(folder)
    return outcomes


def row(outcome: Outcome) -> str:
    line = f"{outcome.parser:<16} {outcome.inputs:>9} {outcome.refused:>9} {1e3 * outcome.slowest_s:>8.2f}"
    wrong = "".join(f"\n    WRONG: {one}" for one in outcome.wrong)
    return f"{line} {outcome.grown_mib:>8.1f}  {'holds' if outcome.holds else 'DOES NOT HOLD'}{wrong}"


def main() -> int:
    # python-osc would write a line for most of its inputs; the service filters them (controller.kiosk.building.osc).
    logging.disable()
    if sys.argv[1:2] == ["--atheris"]:
        atheris_child(sys.argv[2], Path(sys.argv[3]), sys.argv[4:])
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 10_000
    print(f"{'parser':<16} {'inputs':>9} {'refused':>9} {'worst ms':>8} {'+MiB':>8}")
    began = time.monotonic()
    outcomes = run(count, names=tuple(sys.argv[2:]))
    holds = all(outcome.holds for outcome in outcomes)
    print(f"{'holds' if holds else 'DOES NOT HOLD'}, {time.monotonic() - began:.0f} s")
    return 0 if holds else 1


if __name__ == "__main__":
    sys.exit(main())
