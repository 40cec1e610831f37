"""What is secret, in one list: which settings hold a secret, and how texts come out without them.

Logs, messages, inventories and diagnostics use it. Tapes and transcripts leave out the secrets that drivers name.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Final

HIDDEN: Final = "***"
_WORDS: Final = (
    r"[\w-]*(?:passw|passphrase|secret|token|community|webhook|credential|api_?key|user(?![a-z]))[\w-]*(?<!_file)"
)
_KEY: Final = re.compile(_WORDS, re.IGNORECASE)
_VALUE: Final = r'"""[\s\S]*?"""|' r"'''[\s\S]*?'''|" r'"(?:[^"\\\n]|\\.)*"?|' r"'[^'\n]*'?|[^\s,;&}\]\"']+"
_GIVEN: Final = re.compile(
    rf"(?<![\w-])({_WORDS}[\"']?[ \t]*=[ \t]*|[\"']{_WORDS}[\"'][ \t]*:[ \t]*)({_VALUE})", re.IGNORECASE
)
"""A key and its value in TOML (also in one that is damaged), in JSON, and in the query of an address."""
_IN_ADDRESS: Final = re.compile(r"(://)([^/?#\s@\"'<>]+)(?=@)")
SHORTEST: Final = 4
"""Characters of a secret that is looked for in other texts: a shorter one would be in many words."""


def is_secret(key: str) -> bool:
    """Whether the setting ``key`` holds a secret: a password, or what is as good as one; not the name of a file."""
    return _KEY.fullmatch(key) is not None


def concealed(text: str, secrets: Iterable[str] = (), *, same_length: bool = False) -> str:
    """``text`` without the values of secret settings, users and passwords in addresses, and ``secrets``.

    ``same_length``: stars in their place, one for each character, for a file whose places must not move.
    """

    def hide(found: re.Match[str]) -> str:
        quoted = found[2][0] in "\"'" or found[1][-1:] in ": "
        return found[1] + ("*" * len(found[2]) if same_length else f'"{HIDDEN}"' if quoted else HIDDEN)

    for pattern in (_GIVEN, _IN_ADDRESS):
        text = pattern.sub(hide, text)
    for secret in sorted(set(secrets), key=len, reverse=True):
        if len(secret) >= SHORTEST:
            text = text.replace(secret, "*" * len(secret) if same_length else HIDDEN)
    return text
