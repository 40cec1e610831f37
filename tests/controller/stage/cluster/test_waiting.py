"""Waiting for workers: with a scheduler whose answers a test sets."""

from __future__ import annotations

import time

import pytest

from controller.stage.cluster import Cluster


class Scheduler:
    """Has no worker when it is asked for the first time."""

    def __init__(self) -> None:
        self.asked = 0

    def scheduler_info(self, *, n_workers: int) -> dict[str, dict[str, int]]:
        self.asked += 1
        return {"workers": {} if self.asked == 1 else {"tcp://one:1": 1}}


def test_workers_that_restart_while_nobody_looks_have_their_whole_time_to_come_back(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    cluster = Cluster(Scheduler(), "tcp://here:1")
    solved_here_until_s = time.monotonic() + 3600
    monkeypatch.setattr(time, "monotonic", lambda: solved_here_until_s)
    cluster.wait_for_workers(lambda: None)
    assert cluster.workers == 1
