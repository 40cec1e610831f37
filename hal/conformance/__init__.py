"""Tests for every driver, ours and third-party ones. Each needs only a few lines:

    from hal.conformance import CameraConformance

    class TestMyCamera(CameraConformance):
        @pytest.fixture
        def camera(self): return MyCamera.open("emulated")

The fixture (``projector``, ``camera``, ``display``, ``power_switch``, ``douser``, ``light_sensor`` or ``button_panel``)
gives an opened device and closes it afterwards. The device may be in any healthy state at the start of a test. Class
attributes are the tests' time limits; increase them for a slow device. Only this part of ``hal`` needs pytest.
"""

from hal.conformance.camera import CameraConformance
from hal.conformance.device import (
    ButtonPanelConformance,
    DeviceConformance,
    DouserConformance,
    LightSensorConformance,
    PowerSwitchConformance,
)
from hal.conformance.display import BundleDisplayConformance, DisplayConformance
from hal.conformance.projector import ProjectorConformance

__all__ = [
    "BundleDisplayConformance",
    "ButtonPanelConformance",
    "CameraConformance",
    "DeviceConformance",
    "DisplayConformance",
    "DouserConformance",
    "LightSensorConformance",
    "PowerSwitchConformance",
    "ProjectorConformance",
]
