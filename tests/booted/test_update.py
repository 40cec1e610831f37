"""Another version of the package on a booted kiosk that plays, and back."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from tests.booted.kiosk import SERVICES, Kiosk
from tests.campaigns.power_cuts import kept, lost

BLACK_S = 2.0
"""While the player is another version."""
AS_A_RESTART = 2.0
"""The same, of what a restart of the player takes: on a computer that is busy with other tests."""


def test_another_version_is_installed_while_it_plays_and_taken_back(playing: Kiosk) -> None:
    machine = playing.machine
    version = ("dpkg-query", "--show", "--showformat=${Version}", "velatura")
    first, second = playing.packages
    before = kept(playing)
    for package, wanted in ((second, "2-1~deb"), (first, "1-1~deb")):
        black_s = _black_s(playing, partial(machine.install, package))
        assert machine.call(*version).startswith(wanted)
        if black_s > BLACK_S:
            restarted_s = _black_s(playing, lambda: machine.call("systemctl", "restart", "velatura-player"))
            assert black_s <= AS_A_RESTART * restarted_s
        assert lost(playing, before) == []
        assert {machine.restarts(name) for name in SERVICES[1:]} == {0}


def _black_s(playing: Kiosk, work: Callable[[], object]) -> float:
    """How long it is black while this is done to a kiosk that plays: once, and it never shows anything else."""
    machine = playing.machine
    with machine.watched() as seen:
        work()
        machine.wait_for(playing.shows)
        machine.wait_for(lambda: playing.state == "playing")
    shown = [what for _, what in seen[:-1]]
    assert shown == [shown[0], "black", shown[0]]
    print(f"black for {seen[2][0] - seen[1][0]:.2f} s")
    return seen[2][0] - seen[1][0]
