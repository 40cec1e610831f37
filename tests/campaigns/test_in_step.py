"""Fewer swaps, shorter cuts and a smaller bundle than ``make campaign NAME=in_step``."""

from __future__ import annotations

import pytest

from tests.campaigns.in_step import BACK_S, compared, large_bundle, three, troubles
from tests.campaigns.network import network

pytestmark = pytest.mark.long


def test_three_computers_stay_in_step_whatever_happens_to_their_network() -> None:
    with network(3) as net, three(net) as computers:
        net.delay_s, net.jitter_s, net.loss = 0.02, 0.01, 0.02
        found = compared(computers, 400)
        assert found.compared > 300
        assert found.mixed == 0
        net.delay_s = net.jitter_s = net.loss = 0.0
        assert max(troubles(computers, 8.0).values()) < BACK_S
        assert large_bundle(computers, 60_000_000) > 0
