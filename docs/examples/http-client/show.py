"""Show an appearance, and wait until the stage plays it: ``python show.py ADDRESS TOKEN NAME``."""

import sys
import time

from velatura_client import AuthenticatedClient
from velatura_client.api.default import play, state
from velatura_client.models import KioskState, PlayBody, Refusal

PATIENCE_S = 600.0  # lamps warm up first when the stage was closed


def show(client: AuthenticatedClient, name: str) -> str:
    """The sentence for the person who asked."""
    asked = play.sync(client=client, body=PlayBody(name=name))
    if isinstance(asked, Refusal):
        return f"{asked.what} {asked.remedy}"
    until = time.monotonic() + PATIENCE_S
    while time.monotonic() < until:
        now = state.sync(client=client)
        if isinstance(now, KioskState):
            if now.state == "playing" and now.playing == name:
                return f"{now.stage} shows {now.playing}."
            print(f"{now.state}: {now.reason}")
        time.sleep(1)
    return f"{name} is not shown after {PATIENCE_S:.0f} s."


if __name__ == "__main__":
    address, token, appearance = sys.argv[1:]
    with AuthenticatedClient(f"{address}/api/v1", token, raise_on_unexpected_status=True) as stage:
        print(show(stage, appearance))
