"""Another version of the package on a booted kiosk that plays, and back."""

from __future__ import annotations

from tests.booted.kiosk import SERVICES, Kiosk
from tests.campaigns.power_cuts import kept, lost


def test_another_version_is_installed_while_it_plays_and_taken_back(playing: Kiosk) -> None:
    machine = playing.machine
    version = ("dpkg-query", "--show", "--showformat=${Version}", "velatura")
    first, second = playing.packages
    before = kept(playing)
    for package, wanted in ((second, "2-1~deb"), (first, "1-1~deb")):
        with machine.watched() as seen:
            machine.install(package)
            assert machine.call(*version).startswith(wanted)
            machine.wait_for(playing.shows)
            machine.wait_for(lambda: playing.state == "playing")
        shown = [what for _, what in seen[:-1]]
        assert shown == [shown[0]], "it was never black, and never showed anything else"
        assert shown != ["black"]
        assert lost(playing, before) == []
        assert {machine.restarts(name) for name in SERVICES[1:]} == {0}
