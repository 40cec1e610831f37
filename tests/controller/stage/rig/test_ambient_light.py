"""The room's light is distinguished from the projectors' own."""

from __future__ import annotations

from controller.stage.rig.ambient_light import LightWatch

PLAYED = "marble"


def test_light_on_top_of_the_pictures_own_is_told_until_half_of_it_is_gone() -> None:
    watch = LightWatch(0.5)
    assert watch.observe(20.0, PLAYED) is None
    assert watch.observe(21.0, PLAYED) is None, "once may be a torch"
    told = watch.observe(21.0, PLAYED)
    assert told is not None
    assert "1.0 lux" in told
    assert watch.observe(20.4, PLAYED) is not None, "light about the limit is told once"
    assert watch.observe(20.2, PLAYED) is None


def test_a_brighter_picture_is_no_light_in_the_room() -> None:
    watch = LightWatch(0.5)
    for lux, scene in ((5.0, "dim"), (50.0, "bright"), (50.0, "bright"), (5.0, "dim"), (50.1, "bright")):
        assert watch.observe(lux, scene) is None


def test_nothing_is_told_while_nothing_lasts() -> None:
    watch = LightWatch(0.5)
    watch.observe(20.0, PLAYED)
    for _ in range(5):
        assert watch.observe(900.0, None) is None
    assert watch.observe(900.0, PLAYED) is None
    assert watch.observe(900.0, PLAYED) is not None
