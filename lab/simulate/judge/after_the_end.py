"""What a service that has started again finds of the one before."""

from __future__ import annotations

from controller.kiosk.service import Service
from controller.kiosk.store.event_log import SHOWN
from lab.simulate.disk import STAGE
from lab.simulate.judge.promises import Broken
from lab.simulate.judge.witness import Witness


def after_the_end(witness: Witness, service: Service, *, damaged: frozenset[str]) -> None:
    """A service has started again: what the one before logged is there. ``damaged``: files that were. Raises Broken."""
    rows = list(service.log.after(0))
    # What could not be written before the end is gone, and its numbers are given again.
    witness.log.read = next(
        (row.number - 1 for row in reversed(rows) if row.code == "service-started"), witness.log.read
    )
    witness.log.numbers_again()
    there = {row.number: row for row in rows}
    # A full log forgets its oldest; one that is not full has all of them.
    least = min(there) if len(rows) >= SHOWN else 0
    for number, row in list(witness.log.rows.items()):
        if number < least:
            del witness.log.rows[number]
        elif there.get(number) != row:
            raise Broken("nothing lost", f"event {number} is gone from the log: {row.text}")
    if not (STAGE / "stage.toml").exists() and "stage.toml" not in damaged:
        raise Broken("nothing lost", "stage.toml is gone")
