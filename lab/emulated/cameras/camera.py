"""An emulated camera of any maker on PTP/IP."""

from __future__ import annotations

from typing import Final, Literal

from lab.emulated.cameras.eos import EmulatedEosBody, EmulatedOldEosBody
from lab.emulated.cameras.nikon import EmulatedNikonBody
from lab.emulated.cameras.sony import EmulatedSonyBody
from plugins.emulated.cameras.body import CameraFaults, CameraNames
from plugins.emulated.cameras.camera import PtpIpCamera
from plugins.emulated.cameras.generic import EmulatedGenericBody
from plugins.emulated.core.shot import Expose

Flavour = Literal["generic", "eos-new", "eos-old", "nikon", "sony"]
BODIES: Final = {
    "generic": EmulatedGenericBody,
    "eos-new": EmulatedEosBody,
    "eos-old": EmulatedOldEosBody,
    "nikon": EmulatedNikonBody,
    "sony": EmulatedSonyBody,
}


class EmulatedPtpCamera(PtpIpCamera):
    """A camera of a ``flavour`` on PTP/IP.

    Parameters
    ----------
    flavour : "generic" (standard PTP), "eos-new" (9128/9129) or "eos-old" (910F: the operations of an EOS 400D),
        "nikon" (9207 and 90C7), "sony" (protocol 3)
    ports : see ``PtpIpCamera``
    expose, names, time_scale, raw, faults : see ``EmulatedBody``
    """

    def __init__(
        self,
        expose: Expose,
        *,
        flavour: Flavour = "generic",
        ports: tuple[int, int] = (0, 0),
        names: CameraNames | None = None,
        time_scale: float = 1.0,
        raw: bool = True,
        faults: CameraFaults | None = None,
    ) -> None:
        body = BODIES[flavour](expose, names=names, time_scale=time_scale, raw=raw, faults=faults)
        super().__init__(body, ports)
