"""Chooses how to release a camera: by the operations that it lists, never by its model's name."""

from __future__ import annotations

from typing import Final

from hal.codecs.ptp.datasets import DeviceInfo
from hal.codecs.ptp.values import Operation, Vendor
from hal.deadline import Deadline
from hal.errors import DeviceRefused
from plugins.ptp.body import Body, Channel
from plugins.ptp.canon.body import EosBody
from plugins.ptp.generic import GenericBody
from plugins.ptp.nikon import NikonBody
from plugins.ptp.sony import SonyBody

_SONY: Final = frozenset({Operation.SONY_CONNECT, Operation.SONY_PRESS, Operation.SONY_GET_ALL_PROPERTIES})


def choose_body(channel: Channel, info: DeviceInfo, *, to_card: bool, keep_on_card: bool, both: bool) -> Body:
    """The options are those of ``ptp_still.PtpCamera``. Raises DeviceRefused("camera-no-remote-release")."""
    eos = {Operation.EOS_SET_PROPERTY, Operation.EOS_GET_EVENT} <= info.operations
    if eos and info.operations & {Operation.EOS_RELEASE, Operation.EOS_RELEASE_ON}:
        return EosBody(channel, to_card=to_card, keep_on_card=keep_on_card, both=both)
    if info.vendor_extension == Vendor.NIKON and Operation.NIKON_GET_EVENT in info.operations:
        return NikonBody(channel, info, keep_on_card=keep_on_card, both=both)
    # On the network they call themselves MTP devices.
    if (info.vendor_extension == Vendor.SONY or info.manufacturer.startswith("Sony")) and info.operations >= _SONY:
        return SonyBody(channel)
    if Operation.INITIATE_CAPTURE in info.operations:
        return GenericBody(channel, info, keep_on_card=keep_on_card)
    raise DeviceRefused(
        "camera-no-remote-release",
        what=f"The {info.model or 'camera'} can't be released over its cable.",
        remedy="Set its USB or network mode to PTP or remote control, or use another camera.",
    )


def device_info(channel: Channel, deadline: Deadline) -> DeviceInfo:
    """The camera's identity and capabilities."""
    return DeviceInfo.parse(channel.request(Operation.GET_DEVICE_INFO, doing="identify itself", deadline=deadline).data)
