"""The ColorHug ALS ambient light sensor, to check that the room is dark."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from hal.codecs.hid import (
    LIGHT_SENSOR_PRODUCT,
    LIGHT_SENSOR_REPORT,
    LIGHT_SENSOR_VENDOR,
    READING_LENGTH,
    SETTINGS_LENGTH,
    USABLE,
    LightReading,
    SensorSettings,
    parse_reading,
    parse_settings,
)
from hal.deadline import Deadline
from hal.errors import DeviceBusy, DeviceTimeout
from hal.registry import Driver, OpenContext, setting
from hal.values import DeviceIdentity
from plugins.hid.link import HidKind, HidLink, OpenHid

_KIND: Final = HidKind(name="light sensor", vendor=LIGHT_SENSOR_VENDOR, product=LIGHT_SENSOR_PRODUCT)
_SETTLE_S: Final = 0.05


class ColorHugLightSensor:
    """``hal.interfaces.LightSensor``. Readings are requested, not taken from a queue, so none is old."""

    def __init__(self, *, serial: str = "", backend: str = "hidraw", deadline: Deadline) -> None:
        self._link = HidLink(_KIND, serial=serial, backend=backend)
        try:
            self.illuminance_lux(deadline=deadline)
        except BaseException:
            self._link.close()
            raise

    def identity(self, *, deadline: Deadline) -> DeviceIdentity:
        def query(sensor: OpenHid) -> DeviceIdentity:
            # Read its settings, so that an answer never comes from an unplugged sensor.
            parse_settings(sensor.handle.get_feature_report(LIGHT_SENSOR_REPORT, SETTINGS_LENGTH))
            return DeviceIdentity(sensor.found.maker, sensor.found.product, sensor.serial)

        return self._link.call(query, deadline=deadline)

    def illuminance_lux(self, *, deadline: Deadline) -> float:
        """See ``hal.interfaces.LightSensor``. Raises DeviceBusy("light-sensor-not-ready") at the deadline."""
        refused: DeviceBusy | None = None
        while True:
            try:
                reading = self._link.call(_read, deadline=deadline)
            except DeviceTimeout as error:
                raise refused or error from None
            if reading.state in USABLE:
                return reading.illuminance_lux
            refused = _not_ready(reading)
            if deadline.left_s() <= _SETTLE_S:
                raise refused
            deadline.sleep(_SETTLE_S)

    def close(self) -> None:
        self._link.close()


def _read(sensor: OpenHid) -> LightReading:
    wanted = SensorSettings()
    now = parse_settings(sensor.handle.get_feature_report(LIGHT_SENSOR_REPORT, SETTINGS_LENGTH))
    if now.power != wanted.power:  # also after it was plugged in again
        sensor.handle.send_feature_report(wanted.pack())
    return parse_reading(sensor.handle.get_input_report(LIGHT_SENSOR_REPORT, READING_LENGTH))


def _not_ready(reading: LightReading) -> DeviceBusy:
    return DeviceBusy(
        "light-sensor-not-ready",
        what=f"The light sensor has no reading: {reading.state.name.lower().replace('_', ' ')}.",
        remedy="Wait a few seconds. If it still has none, unplug it and plug it in again.",
    )


def open_light_sensor(settings: Mapping[str, Any], context: OpenContext, deadline: Deadline) -> ColorHugLightSensor:
    """Open the light sensor of a stage's table."""
    return ColorHugLightSensor(
        serial=setting(settings, "serial", str, ""),
        backend=setting(settings, "backend", str, "hidraw"),
        deadline=deadline,
    )


DRIVER: Final = Driver(
    kind="light_sensor",
    name="colorhug-als",
    summary="The ColorHug ALS ambient light sensor (273f:1008).",
    open=open_light_sensor,
    settings={
        "serial": "its USB serial number (default: the only sensor)",
        "backend": '"hidraw" (default) or "libusb": the backend of hidapi',
    },
)
