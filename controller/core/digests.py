"""The digest that is stored in the place of a secret."""

from __future__ import annotations

import hashlib


def digest_of(secret: str) -> str:
    """What is kept of a session's or a token's secret: SHA-256, in hex; the secret has too many bits to be guessed."""
    return hashlib.sha256(secret.encode()).hexdigest()
