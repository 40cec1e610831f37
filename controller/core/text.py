"""Text for people: safe text of devices and files; durations."""

from __future__ import annotations


def printable(text: str) -> str:
    """Text without control characters; line breaks and tabs become spaces."""
    return "".join(
        character if character.isprintable() else " " if character.isspace() else "\ufffd" for character in text
    )


def well_formed(text: str) -> str:
    """Text that can be written as UTF-8: "?" for each byte of a file's name that is not."""
    return text.encode(errors="replace").decode()


def duration(seconds: float) -> str:
    """A duration for people: ``8 s``, ``2 min 05 s``, ``1 h 20 min``."""
    whole = max(0, round(seconds))
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
