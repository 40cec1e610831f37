"""From what xrandr prints to the X server's configuration."""

from __future__ import annotations

from controller.kiosk.outputs import connected, placed, player_outputs, x_configuration
from controller.play.frames import parse_outputs

LEFT = """Screen 0: minimum 320 x 200, current 2800 x 1050, maximum 16384 x 16384
HDMI-1 connected primary 1400x1050+0+0 (0x4a) normal (normal left inverted right x axis y axis) 0mm x 0mm
\tIdentifier: 0x42
\tEDID:
\t\t00ffffffffffff003e8d0100
\tBroadcast RGB: Automatic
\t\tsupported: Automatic, Full, Limited 16:235
  1400x1050 (0x4a) 121.750MHz -HSync +VSync *current +preferred
        h: width  1400 start 1488 end 1632 total 1864 skew    0 clock  65.32KHz
        v: height 1050 start 1053 end 1057 total 1089           clock  59.98Hz
  1920x1080i (0x4c) 74.250MHz +HSync +VSync Interlace
        h: width  1920 start 2008 end 2052 total 2200 skew    0 clock  33.75KHz
        v: height 1080 start 1084 end 1094 total 1125           clock  60.00Hz
  1024x768 (0x4b) 65.000MHz -HSync -VSync
        h: width  1024 start 1048 end 1184 total 1344 skew    0 clock  48.36KHz
        v: height  768 start  771 end  777 total  806           clock  60.00Hz
"""
OFF = """DP-1 disconnected (normal left inverted right x axis y axis)
\tIdentifier: 0x43
"""
RIGHT = """HDMI-2 connected 1920x1080+1400+0 (0x4f) normal (normal left inverted right x axis y axis) 0mm x 0mm
  1920x1080 (0x4f) 148.500MHz +HSync +VSync *current +preferred
        h: width  1920 start 2008 end 2052 total 2200 skew    0 clock  67.50KHz
        v: height 1080 start 1084 end 1089 total 1125           clock  60.00Hz
  1024x768 (0x50) 65.000MHz -HSync -VSync
        h: width  1024 start 1048 end 1184 total 1344 skew    0 clock  48.36KHz
        v: height  768 start  771 end  777 total  806           clock  60.00Hz
"""


def test_one_projector_gets_the_mode_that_it_asks_for() -> None:
    (one,) = placed(connected(LEFT + OFF))
    assert (one.name, one.mode.key, one.left_px) == ("HDMI-1", (1400, 1050, 59.98), 0)
    text = x_configuration([one])
    assert 'Modeline "1400x1050_59.98" 121.75 1400 1488 1632 1864 1050 1053 1057 1089 -hsync +vsync' in text
    assert 'Option "PreferredMode" "1400x1050_59.98"' in text
    assert "DP-1" not in text


def test_different_projectors_get_a_mode_that_both_have_side_by_side() -> None:
    left, right = placed(connected(LEFT + OFF + RIGHT))
    assert left.mode.key == right.mode.key == (1024, 768, 60.0)
    assert (left.left_px, right.left_px) == (0, 1024)
    told = ",".join(f"{name}:{width}x{height}" for name, width, height in player_outputs([left, right]))
    assert [one.name for one in parse_outputs(told)] == ["HDMI-1", "HDMI-2"]


def test_without_a_common_mode_each_has_its_own() -> None:
    alone = RIGHT[: RIGHT.index("  1024x768")]
    left, right = placed(connected(LEFT + alone))
    assert (left.mode.key[:2], right.mode.key[:2]) == ((1400, 1050), (1920, 1080))
    assert right.left_px == 1400


def test_an_interlaced_mode_stays_one() -> None:
    (one,) = connected(LEFT)
    assert one.modes[1].modeline.endswith("+hsync +vsync interlace")


def test_nothing_plugged_in_is_nothing() -> None:
    assert placed(connected(OFF)) == []
    assert connected("") == []
