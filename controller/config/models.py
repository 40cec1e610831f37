"""What stage.toml may hold. A field's description says what is allowed: errors and the documentation quote it."""

from __future__ import annotations

from typing import Annotated, Final, Literal

from pydantic import AfterValidator, Field

from controller.config.defaults import SMOOTHNESS
from controller.config.table import (
    ConfigTable,
    KeyFile,
    Name,
    Offset,
    OpenConfigTable,
    Positive,
    Seconds,
    Size,
    StageFile,
)
from hal.values import LampRules

_Host = Annotated[
    str,
    Field(pattern=r"^([a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?(\.local)?)?$"),
    AfterValidator(lambda name: name.removesuffix(".local")),
]
_Address = Annotated[str, Field(pattern=r"^[^@\s]+@[^@\s]+$", max_length=254)]


class DiskTable(ConfigTable):
    warn_free_gb: float = Field(
        default=5.0, ge=0, le=100_000,
        description="gigabytes of free space below which the kiosk removes old photographs and runs, and then warns, "
        "0 to 100000",
    )  # fmt: skip
    keep_runs: int = Field(
        default=5, ge=2, le=10_000, description="how many runs of each kind are never removed, 2 to 10000"
    )


class BackupTable(ConfigTable):
    folder: str | None = Field(
        default=None, min_length=1,
        description="the folder that gets a backup every night, best on another disk; relative to the stage's folder; "
        "if omitted: no backup",
    )  # fmt: skip
    usb: str | None = Field(
        default=None, min_length=1, max_length=64,
        description="the label or UUID of the file system of a mounted USB stick that gets a backup every night",
    )  # fmt: skip
    ssh: str | None = Field(
        default=None, max_length=1000,
        pattern=r"^ssh://[A-Za-z0-9_][A-Za-z0-9._-]{0,63}@(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9][A-Za-z0-9.-]{0,252})(:[0-9]{1,5})?/[^\s\"\\*?\[\]]*$",
        description='a folder on a server that gets a backup every night by SFTP: "ssh://USER@HOST/FOLDER", or with '
        "HOST:PORT",
    )  # fmt: skip
    ssh_key_file: KeyFile | None = Field(
        default=None, pattern=r'^[^"\n]+$',
        description="a file with the private key for that server, without a passphrase; relative to the stage's "
        "folder; needed for ssh",
    )  # fmt: skip
    ssh_host_key: str | None = Field(
        default=None, pattern=r"^(ssh-ed25519|ssh-rsa|ecdsa-sha2-nistp(256|384|521)) [A-Za-z0-9+/=]{16,2000}$",
        description='the public key of that server, such as "ssh-ed25519 AAAA...": two words of '
        "/etc/ssh/ssh_host_ed25519_key.pub there; needed for ssh",
    )  # fmt: skip
    at: str = Field(
        default="04:30",
        pattern=r"^(([01][0-9]|2[0-3]):[0-5][0-9]|24:00)$",
        description='the local time "HH:MM" of the backup',
    )
    keep: int = Field(default=7, ge=1, le=366, description="how many backups stay in the folder, 1 to 366")


class AlertsTable(ConfigTable):
    """Who gets the events: people by mail, programs by a webhook."""

    least: Literal["warning", "error"] = Field(
        default="error", description='"warning" or "error": the least level of an event that is sent'
    )
    mail_to: Annotated[tuple[_Address, ...], Field(strict=False, max_length=20)] = Field(
        default=(), description="a list of mail addresses, at most 20; none: no mail"
    )
    mail_from: _Address | None = Field(default=None, description="the sender's mail address; needed for mail")
    mail_host: str | None = Field(
        default=None, min_length=1, max_length=253, description="the name of the mail server (SMTP); needed for mail"
    )
    mail_port: int = Field(default=587, ge=1, le=65_535, description="its port, 1 to 65535")
    mail_security: Literal["starttls", "tls", "none"] = Field(
        default="starttls", description='"starttls", "tls" or "none"; with "none" no password is sent'
    )
    mail_user: str | None = Field(default=None, min_length=1, max_length=254, description="the name to log in with")
    mail_password_file: KeyFile | None = Field(
        default=None, description="a file that has only the password, relative to the stage's folder"
    )
    certificates: StageFile | None = Field(
        default=None,
        description="a file with certificate authorities (PEM) for servers whose certificate is not public",
    )  # fmt: skip
    webhook: str | None = Field(
        default=None, pattern=r"^https?://[^\s]+$", max_length=2000,
        description='an address that gets each alert as JSON by POST, for example "https://example.org/velatura"',
    )  # fmt: skip


__all__ = ["ConfigTable", "Name", "OpenConfigTable", "Positive", "Seconds", "Size"]


class StageTable(ConfigTable):
    name: Name = Field(description="the stage's name, 1 to 64 printable characters")


class DouserTable(OpenConfigTable):
    """A mechanical shutter before a projector's lens."""

    driver: Name = Field(description='the name of a douser driver, e.g. "sacn"')


class PoseTable(ConfigTable):
    """Where a device stands, as it was measured, in a frame of the room that all devices share."""

    position_m: Annotated[tuple[float, float, float], Field(strict=False)] = Field(
        description="[x, y, z] of the middle of its lens, in metres"
    )
    sigma_m: Positive = Field(default=0.01, description="standard uncertainty of each of them in metres, above 0")


class ProjectorTable(OpenConfigTable):
    name: Name = Field(description="a name for people, different for every projector, 1 to 64 printable characters")
    output: Name = Field(description="the name of the display output that feeds this projector")
    driver: Name = Field(description='the name of a projector driver, e.g. "serial"')
    host: _Host = Field(
        default="",
        description="the computer that its control line hangs on, one of those that have outputs; if omitted: this one",
    )
    ask_lit_s: float = Field(
        default=15.0, ge=1, le=60, description="seconds between two questions to a lit projector, 1 to 60"
    )
    ask_dark_s: float = Field(
        default=18.0, ge=1, le=60, description="seconds between two questions to a dark projector, 1 to 60"
    )
    douser: DouserTable | None = Field(default=None, description="the table [projectors.douser]")
    pose: PoseTable | None = Field(default=None, description="the table [projectors.pose]")


class CameraTable(OpenConfigTable):
    name: Name = Field(
        default="",
        description="a name for people, different for every camera, 1 to 64 printable characters; needed with several",
    )
    driver: Name = Field(description='the name of a camera driver, e.g. "ptp"')
    iso: int = Field(ge=25, le=819_200, description="the camera's sensitivity, a whole number from 25 to 819200")
    aperture_f: Annotated[float, Field(ge=0.5, le=128)] | None = Field(
        default=None, description="the f-number from 0.5 to 128; if omitted: the current setting of the lens"
    )
    intrinsics: StageFile | None = Field(
        default=None,
        description="a file that `velatura camera calibrate` wrote, relative to the stage's folder; it replaces "
        "focal_length_px",
    )
    focal_length_px: Positive | None = Field(
        default=None,
        description="the focal length in pixels of the camera's full image, a number above 0 (from the lens and "
        "sensor); not needed with intrinsics",
    )
    focal_length_rel_sigma: float = Field(
        default=0.02, gt=0, le=1, description="relative standard uncertainty of focal_length_px, above 0, at most 1"
    )
    distance_m: Positive | None = Field(
        default=None,
        description="metres from the front of the camera's lens to the nearest visible point of the object, above 0; "
        "if omitted: not measured",
    )
    distance_rel_sigma: float = Field(
        default=0.01, gt=0, le=1, description="relative standard uncertainty of distance_m, above 0, at most 1"
    )
    pose: PoseTable | None = Field(default=None, description="the table [cameras.pose], or [camera.pose]")


class OutputTable(ConfigTable):
    name: Name = Field(description="the output's name, different for every output, 1 to 64 printable characters")
    width_px: Size = Field(description="the output's width in pixels, a whole number from 1 to 16384")
    height_px: Size = Field(description="the output's height in pixels, a whole number from 1 to 16384")
    where: str | None = Field(
        default=None,
        pattern=r"^[^\s=](.*[^\s])?$",
        description='the connector ("HDMI-1") or the serial number of its display; if omitted: the name is one of '
        "these",
    )
    left_top_px: Annotated[tuple[Offset, Offset], Field(strict=False)] | None = Field(
        default=None,
        description="[x, y] of its upper left corner in the picture of its connector, where a splitter divides that "
        "among several projectors; if omitted: the output is the whole connector",
    )
    host: _Host = Field(
        default="",
        description='the computer that it is on, by the name with which that joined ("left" or "left.local"); if '
        "omitted: this one",
    )
    screen: str = Field(
        default="",
        pattern=r"^(:[0-9]{1,5}(\.[0-9]{1,5})?)?$",
        description='the X screen that it is on (":0.1"); if omitted: the first one',
    )

    @property
    def elsewhere(self) -> str:
        """Its computer and X screen as a player's option names them, "" for this computer's first screen."""
        return f"{self.host}/{self.screen}" if self.screen else self.host


class DisplayTable(OpenConfigTable):
    driver: Name = Field(description='the name of a display driver, e.g. "player"')
    frames: str | None = Field(
        default=None, min_length=1, description="the file of a memory output; if omitted: windows on real outputs"
    )
    outputs: Annotated[tuple[OutputTable, ...], Field(strict=False)] = Field(
        default=(), description="a list of [[display.outputs]] tables with name, width_px and height_px"
    )
    alone_s: float = Field(
        default=3600.0, gt=0, le=604_800,
        description="seconds for which the players of several computers or screens continue while they hear nothing of "
        "this one, above 0, at most 604800",
    )  # fmt: skip
    alone: Literal["on", "black", "still"] = Field(
        default="on", description='what they do then: "on" (they play on), "black" or "still"'
    )


class DistanceTable(ConfigTable):
    """Two points of the object in the camera's image, and how far they are apart."""

    from_px: Annotated[tuple[float, float], Field(strict=False)] = Field(description="[x, y] in camera pixels")
    to_px: Annotated[tuple[float, float], Field(strict=False)] = Field(description="[x, y] in camera pixels")
    distance_m: Positive = Field(description="metres between the two points, above 0")
    sigma_m: Positive = Field(default=0.001, description="standard uncertainty of distance_m in metres, above 0")


Corner = Annotated[tuple[Annotated[float, Field(ge=0, le=1)], Annotated[float, Field(ge=0, le=1)]], Field(strict=False)]
Region = Annotated[tuple[Corner, ...], Field(strict=False, min_length=3, max_length=1000)]


class ObjectTable(ConfigTable):
    shape: Literal["auto", "surface", "plane", "unknown"] = Field(
        default="auto",
        description='"surface" (the shape is measured), "plane" (it is flat, or consists of flat parts), "unknown" (no '
        'shape is needed), or "auto" (the most that the photographs give)',
    )
    distances: Annotated[tuple[DistanceTable, ...], Field(strict=False)] = Field(
        default=(),
        description="a list of [[object.distances]] tables with from_px, to_px and distance_m, in the first camera's "
        "picture",
    )
    outline: Annotated[tuple[Region, ...], Field(strict=False, max_length=100)] = Field(
        default=(),
        description="what is the object, instead of what is found: regions as lists of corners [x, y] in the camera's "
        "picture, each from 0 to 1, such as [[[0.2, 0.1], [0.8, 0.1], [0.5, 0.9]]]",
    )


class CaptureTable(ConfigTable):
    settle_s: float | None = Field(
        default=None,
        ge=0,
        le=10,
        description="least seconds from a frame's presentation to the shutter, 0 to 10; without it, as long as a "
        "calibration measured",
    )
    longest_exposure_s: float = Field(
        default=4.0, gt=0, le=3600, description="the longest exposure in seconds, above 0, at most 3600"
    )


class CalibrationTable(ConfigTable):
    worst_grade: float = Field(
        default=4.0,
        gt=0,
        le=1000,
        description="the largest prediction error, in per cent, at which a calibration may be published, above 0, at "
        "most 1000; the default refuses grade C",
    )
    photographs: Literal["full", "few", "fewest"] = Field(
        default="full",
        description='"full" (about 36 photographs a projector), "few" (about 20), or "fewest" (about 15 where nothing '
        "has moved since the last calibration, else as few)",
    )
    photograph_at_night: bool = Field(
        default=False,
        description="true or false: whether the kiosk photographs the appearances after a nightly recalibration",
    )


ONLY_CAMERA: Final = "camera"
"""What the view of a camera without a name is called."""

REFINE: Final = 1
"""Photographs by which each appearance is corrected, unless stage.toml says otherwise."""


class SolveTable(ConfigTable):
    exposure_share: float = Field(
        default=0.9, gt=0, le=1, description="the share of the reachable light that targets may use, above 0, at most 1"
    )
    smoothness: float = Field(
        default=SMOOTHNESS,
        ge=0,
        le=100,
        description="the weight of smoothness in a compensation image (equal neighbours), 0 to 100",
    )
    base: Literal["minimum", "white"] = Field(
        default="white",
        description='the base image of live targets: "minimum" (the darkest white image at each pixel), or '
        '"white" (even light)',
    )
    adapt: float = Field(
        default=0.5,
        ge=0,
        le=1,
        description="how far a target is bent where it is darker or more saturated than can be shown, so that the "
        "object's own pattern does not show, from 0 (such parts are cut off) to 1",
    )
    unseen: Literal["smooth", "black"] = Field(
        default="smooth",
        description='what projector pixels show that light the object where no camera sees it: "smooth" (the light of '
        'what is seen beside them), or "black"',
    )
    device: Literal["auto", "cpu", "gpu"] = Field(
        default="auto",
        description='what solves: "cpu" (the processor), "gpu" (a graphics processor, also one in software), or "auto" '
        "(a real graphics processor where there is one, else the processor)",
    )
    refine: int = Field(
        default=REFINE,
        ge=0,
        le=9,
        description="how many photographs of each result are taken to correct it, 0 to 9, before one that confirms "
        "it; with 0 the projectors stay off while appearances are made",
    )


class MainsTable(ConfigTable):
    """One relay of a board, and whose mains go through it."""

    channel: int = Field(ge=1, le=64, description="the relay's number on its board, from 1")
    feeds: Annotated[tuple[Name, ...], Field(strict=False, min_length=1, max_length=32)] = Field(
        description="a list of names of the projectors that get their mains through this relay"
    )


class RelaysTable(OpenConfigTable):
    name: Name = Field(description="a name for people, different for every relay board, 1 to 64 printable characters")
    driver: Name = Field(description='the name of a power_switch driver, e.g. "usb-relay"')
    host: _Host = Field(
        default="", description="the computer that it hangs on, one of those that have outputs; if omitted: this one"
    )
    boot_s: Annotated[float, Field(ge=0, le=600)] = Field(
        default=10.0, description="seconds from mains on until a projector accepts commands, 0 to 600"
    )
    mains: Annotated[tuple[MainsTable, ...], Field(strict=False, min_length=1, max_length=64)] = Field(
        description="a list of [[relays.mains]] tables with channel and feeds"
    )


class LightSensorTable(OpenConfigTable):
    driver: Name = Field(description='the name of a light_sensor driver, e.g. "colorhug-als"')
    most_lux: float = Field(
        default=5.0, gt=0, le=100_000, description="lux at the object above which calibration is refused, above 0"
    )


class KeyPanelTable(OpenConfigTable):
    driver: Name = Field(description='the name of a button_panel driver, e.g. "stream-deck"')


class HoursTable(ConfigTable):
    """Opening hours of a weekday or a date; see ``controller.kiosk.schedule`` for what they mean together."""

    day: str = Field(
        description='weekdays such as "mon", "mon-fri" or "daily", or a date such as "2026-12-24", which comes first'
    )
    opens: str = Field(
        default="", description='the local time "HH:MM"; if omitted together with closes: closed all day'
    )
    closes: str = Field(default="", description='the local time "HH:MM"; at or before opens: on the next day')
    appearance: str = Field(
        default="", description="the appearance to play; if omitted: the appearance that played last"
    )


class ScheduleTable(ConfigTable):
    time_zone: str = Field(default="UTC", description='a name of the IANA database, e.g. "Europe/Vienna"')
    drift_check: str = Field(
        default="", description='the local time "HH:MM" of the nightly drift check; if omitted: no check'
    )
    without_time: Literal["open", "closed"] = Field(
        default="closed", description='"open" or "closed": the state of the stage while the system time is unknown'
    )
    hours: Annotated[tuple[HoursTable, ...], Field(strict=False)] = Field(
        default=(), description="a list of [[schedule.hours]] tables with day, opens and closes; none: always open"
    )


class SafetyTable(ConfigTable):
    power_up_s: Seconds = Field(
        default=1800.0, description="the longest time in seconds until the lamps are steady, 0 to 86400"
    )
    power_down_s: Seconds = Field(
        default=60.0, description="the longest time in seconds for switching the lamps off, 0 to 86400"
    )
    warm_up_s: Seconds = Field(default=0.0, description="seconds from strike to light, if longer than in the driver")
    stable_s: Seconds = Field(
        default=0.0, description="seconds from strike to steady light, if longer than in the driver"
    )
    cool_down_s: Seconds = Field(default=0.0, description="seconds of cooling, if longer than in the driver")
    minimum_off_s: Seconds = Field(
        default=0.0, description="seconds from off to the next strike, if longer than in the driver"
    )

    def at_least(self) -> LampRules:
        """The stage's own lamp rules, which only make the device's stricter."""
        return LampRules(self.warm_up_s, self.stable_s, self.cool_down_s, self.minimum_off_s)


class BundleTable(ConfigTable):
    allow_unsigned: bool = Field(
        default=False, description="true or false: whether a bundle without a signature may play"
    )
    trusted_keys: Annotated[tuple[Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")], ...], Field(strict=False)] = Field(
        default=(), description="a list of public keys, each 64 hexadecimal digits in lower case"
    )
    revoked_keys: Annotated[tuple[Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")], ...], Field(strict=False)] = Field(
        default=(), description="a list of public keys whose bundles are refused, each 64 hexadecimal digits"
    )


class AppearanceTable(OpenConfigTable):
    name: str = Field(
        pattern=r"^[A-Za-z0-9\u00C0-\u024F][A-Za-z0-9\u00C0-\u024F_-]{0,63}$",
        description="a name of 1 to 64 letters, digits, - and _, different for every appearance",
    )
    kind: Name = Field(description='the kind of target, e.g. "photograph"')
    file: StageFile | None = Field(default=None, description="a picture file, relative to the stage's folder")
    shown_s: float = Field(
        default=15.0, ge=0.1, le=604_800, description="seconds that the bundle's playlist shows it, 0.1 to 604800"
    )
    fade_s: float | None = Field(
        default=None, ge=0, le=600,
        description="seconds of cross-fade at its start, part of shown_s, 0 (none) to 600; if omitted: 1, at most "
"shown_s",
    )  # fmt: skip

    @property
    def hint_ms(self) -> tuple[int, int]:
        """``shown_s`` and ``fade_s`` in whole milliseconds. Raises UsageError("stage-key-value") if they do not fit."""
        if self.fade_s is not None and self.fade_s > self.shown_s:
            raise self.place.wrong_value("fade_s", self.fade_s, "is longer than 'shown_s'", f"at most {self.shown_s:g}")
        fade_s = min(1.0, self.shown_s) if self.fade_s is None else self.fade_s
        return round(1000 * self.shown_s), round(1000 * fade_s)


class StageTables(ConfigTable):
    """The whole of stage.toml."""

    stage: StageTable = Field(description="the table [stage] with the stage's name")
    projectors: Annotated[tuple[ProjectorTable, ...], Field(strict=False, min_length=1, max_length=32)] = Field(
        description="1 to 32 tables [[projectors]], one for each projector"
    )
    camera: CameraTable | None = Field(default=None, description="the table [camera]")
    cameras: Annotated[tuple[CameraTable, ...], Field(strict=False, max_length=8)] = Field(
        default=(), description="1 to 8 tables [[cameras]] instead of [camera], one for each camera"
    )
    display: DisplayTable = Field(description="the table [display]")
    object: ObjectTable = Field(default_factory=ObjectTable, description="the table [object]")
    capture: CaptureTable = Field(default_factory=CaptureTable, description="the table [capture]")
    calibration: CalibrationTable = Field(default_factory=CalibrationTable, description="the table [calibration]")
    solve: SolveTable = Field(default_factory=SolveTable, description="the table [solve]")
    relays: Annotated[tuple[RelaysTable, ...], Field(strict=False, max_length=16)] = Field(
        default=(), description="a list of [[relays]] tables, one for each relay board"
    )
    light_sensor: LightSensorTable | None = Field(default=None, description="the table [light_sensor]")
    key_panel: KeyPanelTable | None = Field(default=None, description="the table [key_panel]")
    schedule: ScheduleTable = Field(default_factory=ScheduleTable, description="the table [schedule]")
    safety: SafetyTable = Field(default_factory=SafetyTable, description="the table [safety]")
    bundle: BundleTable = Field(default_factory=BundleTable, description="the table [bundle]")
    appearances: Annotated[tuple[AppearanceTable, ...], Field(strict=False)] = Field(
        default=(), description="a list of [[appearances]] tables"
    )
    disk: DiskTable = Field(default_factory=DiskTable, description="the table [disk]")
    backup: BackupTable = Field(default_factory=BackupTable, description="the table [backup]")
    alerts: AlertsTable = Field(default_factory=AlertsTable, description="the table [alerts]")

    @property
    def movable(self) -> tuple[ProjectorTable | RelaysTable, ...]:
        """The devices that may be on other computers."""
        return (*self.projectors, *self.relays)

    @property
    def views(self) -> tuple[tuple[str, CameraTable], ...]:
        """The name of each camera's view, and its table."""
        if self.camera is not None:
            return ((self.camera.name or ONLY_CAMERA, self.camera),)
        return tuple((table.name, table) for table in self.cameras)
