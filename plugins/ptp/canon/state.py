"""The reported state of a Canon EOS body, and its possible settings."""

from __future__ import annotations

from collections.abc import Iterable

from hal.codecs.ptp.eos import (
    BATTERY_PERCENT,
    BULB_CODES,
    MANUAL_EXPOSURE,
    MANUAL_FOCUS,
    EosCode,
    EosProperty,
    EosRecord,
    ImageFormat,
    ObjectAdded,
    OtherRecord,
    PropertyChanged,
    StatusChanged,
    ValuesChanged,
    aperture_of,
    exposure_of,
    iso_of,
    parse_image_format,
)
from hal.values import CameraCapabilities


class EosState:
    """The values and allowed values of a body's properties, from its records."""

    def __init__(self) -> None:
        self.fresh: list[ObjectAdded] = []
        self.busy = False
        self.falls_asleep = False
        self._values: dict[int, bytes] = {}
        self._allowed: dict[int, tuple[int, ...]] = {}
        self._formats: tuple[ImageFormat, ...] = ()

    def take(self, records: Iterable[EosRecord]) -> None:
        """Read records; new files are added to ``fresh``, in order."""
        for record in records:
            match record:
                case PropertyChanged(code, data):
                    self._values[code] = data
                case ValuesChanged(EosProperty.IMAGE_FORMAT, _, formats):
                    self._formats = formats
                case ValuesChanged(code, values):
                    self._allowed[code] = values
                case ObjectAdded():
                    self.fresh.append(record)
                case StatusChanged(busy):
                    self.busy = busy
                case OtherRecord(EosCode.SHUTS_DOWN_SOON):
                    self.falls_asleep = True

    @property
    def capabilities(self) -> CameraCapabilities:
        return CameraCapabilities(
            exposures_s=tuple(sorted(self.exposures())),
            isos=tuple(sorted(self.isos())),
            apertures_f=tuple(sorted(self.apertures())),
            raw=self.pick_format(raw=True) is not None,
            jpeg=self.pick_format(raw=False) is not None,
        )

    def knows(self, code: EosProperty) -> bool:
        return code in self._values

    def forget(self, code: EosProperty) -> None:
        """The value is about to change: the next report is the new one."""
        self._values.pop(code, None)

    def assume(self, code: EosProperty, data: bytes) -> None:
        """Assume a value is set, unless the body has reported another one."""
        self._values.setdefault(code, data)

    def is_set(self, code: EosProperty, data: bytes) -> bool:
        return self._values.get(code, b"")[: len(data)] == data

    def number(self, code: EosProperty) -> int:
        """A value as an integer; 0 if it was not reported."""
        return int.from_bytes(self._values.get(code, b"")[:4], "little")

    def allowed(self, code: EosProperty) -> tuple[int, ...]:
        return self._allowed.get(code, ())

    def exposures(self) -> dict[float, int]:
        """Settable exposures in seconds, and their codes; empty unless the dial stands on M."""
        codes = self.allowed(EosProperty.SHUTTER) if self._manual() else ()
        return {seconds: code for code in codes if (seconds := exposure_of(code)) is not None}

    def bulb(self) -> int | None:
        """The shutter code of bulb, if the body accepts it now."""
        codes = self.allowed(EosProperty.SHUTTER) if self._manual() else ()
        return next((code for code in BULB_CODES if code in codes), None)

    def battery_percent(self) -> int | None:
        return BATTERY_PERCENT.get(self.number(EosProperty.BATTERY)) if self.knows(EosProperty.BATTERY) else None

    def warnings(self) -> list[str]:
        """Settings at the body itself that cause problems."""
        focus = self.knows(EosProperty.FOCUS_MODE) and self.number(EosProperty.FOCUS_MODE) != MANUAL_FOCUS
        return ["autofocus-on"] * focus + ["mode-dial"] * (not self._manual())

    def isos(self) -> dict[int, int]:
        return {iso: code for code in self.allowed(EosProperty.ISO) if (iso := iso_of(code)) is not None}

    def apertures(self) -> dict[float, int]:
        codes = self.allowed(EosProperty.APERTURE) if self._manual() else ()
        return {number: code for code in codes if (number := aperture_of(code)) is not None}

    def current_format(self) -> ImageFormat | None:
        data = self._values.get(EosProperty.IMAGE_FORMAT)
        return None if data is None else parse_image_format(data)

    def pick_format(self, *, raw: bool, both: bool = False) -> ImageFormat | None:
        """The best format of a kind: full-size RAW, alone if the body has it; else one full-size fine JPEG.

        ``both``: RAW and JPEG, if the body has that.
        """
        known = self._formats
        if not known and (current := self.current_format()):
            known = (current,)
        able = [format_ for format_ in known if any(part.raw == raw for part in format_)]
        return min(able, default=None, key=lambda format_: (both and raw and len(format_) == 1, _rank(format_, raw)))

    def _manual(self) -> bool:
        return not self.knows(EosProperty.EXPOSURE_MODE) or self.number(EosProperty.EXPOSURE_MODE) == MANUAL_EXPOSURE


def _rank(image_format: ImageFormat, raw: bool) -> tuple[int, int, int]:
    """Smaller is better: whole picture size, then few files, then little compression."""
    part = next(part for part in image_format if part.raw == raw)
    return part.size, len(image_format), -part.compression
