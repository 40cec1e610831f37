"""How the computers of a house solve for each other: by Dask, with its scheduler on the house and TLS by certificates
that the house gives its members for this alone (``Authority.peers``).
"""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Final

from controller.core.storage import runtime_path
from controller.stage.link import membership as house
from controller.stage.link.membership import Certified, Membership

PORT: Final = 8786
_TRY_S: Final = 2.0


def peer_folder(stage: Path) -> Path:
    """What the kiosk of this stage tells the service of its workers, while the kiosk runs."""
    return runtime_path(stage) / "cluster"


def peer(folder: Path) -> Membership | None:
    """The membership, with its certificate for solves, in a ``peer_folder``; None where there is none."""
    return house.membership(folder / "peer")


def keep_peer(folder: Path, member: Membership, ask: Callable[[bytes], Certified]) -> None:
    """Have a certificate of the authority of now; ``ask`` sends the house a request. Raises CodedError, OSError."""
    key, request = house.requested()
    answer, there = ask(request), peer(folder)
    if there is not None and (there.folder / house.AUTHORITY).read_text() == answer.authority:
        return
    folder.parent.mkdir(mode=0o700, exist_ok=True)
    folder.mkdir(mode=0o750, exist_ok=True)
    new = replace(member, folder=folder / "peer")
    house.join(new, key, answer.certificate.encode(), answer.authority.encode())
    # The workers' service is another user, of this one's group.
    for path in (new.folder, *new.folder.iterdir()):
        path.chmod(0o750 if path == new.folder else 0o640)


def tls_files(peer: Membership) -> tuple[Path, Path, Path]:
    """Authority, certificate and key."""
    return peer.folder / house.AUTHORITY, peer.folder / house.CERTIFICATE, peer.folder / house.KEY


def scheduler_at(peer: Membership) -> str | None:
    """The address of the house's scheduler; None where none is reached."""
    for endpoint in peer.endpoints:
        host = endpoint.removeprefix("tls/").rpartition(":")[0]
        with contextlib.suppress(OSError), socket.create_connection((host.strip("[]"), PORT), _TRY_S):
            return f"tls://{host}:{PORT}"
    return None
