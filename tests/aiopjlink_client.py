"""aiopjlink, a PJLink client by other authors."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

from aiopjlink import PJLink


def talk(address: str, work: Callable[[Any], Awaitable[Any]], password: str | None = None) -> Any:
    """What ``work`` returns for a client that is connected to this ``host:port``."""
    host, port = address.split(":")

    async def session() -> Any:
        link = PJLink(address=host, port=int(port), password=password, timeout=20)
        try:
            async with link:
                return await work(link)
        finally:
            # The client leaves its connection open when the password is wrong.
            if link._writer is not None:
                link._writer.close()
                await link._writer.wait_closed()

    return asyncio.run(session())
