"""The digest that is stored instead of a secret."""

from __future__ import annotations

import hashlib


def digest_of(secret: str) -> str:
    """SHA-256 in hex of a session's or a token's secret; the secret has too many bits to be guessed."""
    return hashlib.sha256(secret.encode()).hexdigest()
