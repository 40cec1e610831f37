"""The verbs of a building: roles, rates, values from text and from objects."""

from __future__ import annotations

from pathlib import Path

import pytest

from controller.core.errors import UsageError, VelaturaError, WorkError
from controller.kiosk.building.protocol import NetworkOptions, read
from controller.kiosk.building.verbs import Rate, Verbs
from controller.kiosk.roles import Role
from tests.controller.panel.memory_kiosk import MemoryKiosk


def code_of(verbs: Verbs, verb: str, sent: object = "", source: str = "") -> str:
    with pytest.raises(VelaturaError) as caught:
        verbs.do(verb, sent, source=source)  # type: ignore[arg-type]
    return caught.value.code


def test_each_verb_changes_what_is_shown_and_says_who_did_it(kiosk: MemoryKiosk) -> None:
    verbs = Verbs(kiosk, "OSC")
    verbs.do("play", {"name": "warm wood", "fade_s": 2.5}, source="10.0.0.5")
    assert (verbs.status().playing, kiosk.asked) == ("warm wood", [("play", ("warm wood", 2.5))])
    assert kiosk.recorded == [("done-by", "OSC (10.0.0.5): Show this appearance now (warm wood).")]
    verbs.do("next")
    assert verbs.status().playing == "marble"
    verbs.do("black", "true")
    verbs.do("brightness", "40")
    verbs.do("pause", {"on": True})
    now = verbs.status()
    assert (now.black, now.brightness, now.paused) == (True, 40, True)
    verbs.do("play", '{"name": "marble", "fade_s": 1}')
    assert (verbs.status().black, kiosk.asked[-1]) == (False, ("play", ("marble", 1)))
    verbs.do("close")
    assert code_of(verbs, "next") == "nothing-plays"
    assert kiosk.recorded[-1] == ("refused", "OSC: Show the next appearance. Refused: The stage is closed.")
    assert code_of(verbs, "restore", {"backup": "x"}) == "verb-unknown"
    assert code_of(verbs, "brightness", "101") == "field-wrong"
    assert code_of(verbs, "play", '{"name": ') == "body-wrong"


def test_a_viewer_only_looks(kiosk: MemoryKiosk) -> None:
    verbs = Verbs(kiosk, "OSC", role=Role.VIEWER)
    assert verbs.status().playing == "marble"
    assert code_of(verbs, "close") == "verb-not-allowed"
    assert verbs.status().state == "playing"


def test_each_source_has_its_own_rate(kiosk: MemoryKiosk) -> None:
    now = [0.0]
    verbs = Verbs(kiosk, "OSC", rate=Rate(burst=3, per_s=2.0), clock=lambda: now[0])
    for _ in range(3):
        verbs.do("next", source="one")
    assert code_of(verbs, "next", source="one") == "too-many-verbs"
    verbs.do("next", source="two")
    now[0] = 0.5
    verbs.do("next", source="one")
    with pytest.raises(WorkError):
        verbs.do("next", source="one")


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("[osc", "TOML"),
        ("[smoke]\n", "not a protocol"),
        ("[osc]\nport = 70000\n", "port"),
        ("[osc]\nhost = '0.0.0.0'\n", "allow"),
        ("[osc]\nallow = ['everybody']\n", "allow"),
        ("[osc]\nfeedback = ['9001']\n", "feedback"),
        ("[pjlink]\npasword = 'x'\n", "pasword"),
    ],
)
def test_what_is_wrong_in_building_toml_is_named(tmp_path: Path, text: str, word: str) -> None:
    (tmp_path / "building.toml").write_text(text)
    with pytest.raises(UsageError) as caught:
        read(tmp_path)
    assert caught.value.code == "building-wrong"
    assert word in caught.value.what


def test_only_named_networks_and_this_machine_are_let_in(tmp_path: Path) -> None:
    assert read(tmp_path) == ()
    (tmp_path / "building.toml").write_text('[osc]\nhost = "::"\nallow = ["192.168.1.0/24"]\n')
    (found,) = read(tmp_path)
    assert isinstance(found.options, NetworkOptions)
    answers = [found.options.allows(host) for host in ("127.0.0.1", "::ffff:192.168.1.7", "192.168.2.7", "fe80::1%a")]
    assert answers == [True, True, False, False]
