"""Every experiment of the study at size small, on the bench with its devices: python -m tests.campaigns.study [SEEDS].

For the night: about an hour for a seed on two quiet cores. It fails where an experiment can't be done, judges
nothing, or leaves figures out. A criterion that is missed is reported; it is what the study is for.
"""

from __future__ import annotations

import sys
import tempfile
import threading
from pathlib import Path

from controller.cli.console import PlainReporter
from lab.study.catalogue import EXPERIMENTS
from lab.study.output.keeping import StoredStudy, read_study
from lab.study.output.pages import DATA
from lab.study.service import study


def faults(kept: StoredStudy) -> list[str]:
    """What is wrong with the results of one experiment."""
    found = [f"{kept.name}: {one.asked}: not judged" for result in kept.results for one in result.criteria
             if one.holds is None and not one.reason]  # fmt: skip
    found += [f"{kept.name}: the table {table.name} is empty" for table in kept.tables if not table.rows]
    return found if kept.criteria else [f"{kept.name}: asks nothing"]


def main(arguments: list[str]) -> int:
    """Do all experiments; 1 where one of them is faulty."""
    seeds = range(1, 1 + int(arguments[0] if arguments else 1))
    wrong: list[str] = []
    with tempfile.TemporaryDirectory(prefix="velatura-study-") as folder:
        pages = Path(folder) / "pages"
        study(
            names=[one.name for one in EXPERIMENTS], size="small", out=Path(folder), pages=pages, seeds=seeds,
            reporter=PlainReporter(sys.stdout), cancel=threading.Event(),
        )  # fmt: skip
        for one in EXPERIMENTS:
            kept = read_study(pages / DATA / f"{one.name}.json")
            wrong += faults(kept)
            for each in kept.criteria:
                if each.holds is False:
                    sys.stdout.write(f"missed: {kept.name}: {each.asked}: {'; '.join(each.reached.values())}\n")
    sys.stdout.write("\n".join([*wrong, f"{len(wrong)} faults in {len(EXPERIMENTS)} experiments"]) + "\n")
    return 1 if wrong else 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
