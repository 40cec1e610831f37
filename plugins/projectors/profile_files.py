"""Finds a projector's profile: a shipped one by its name, or a file of the stage."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from hal.codecs.projectors.profiles import ProjectorProfile, parse_profile
from hal.errors import PluginError
from hal.runtime.files import read_text


def shipped_profiles() -> tuple[str, ...]:
    """Names of the shipped projector profiles, sorted."""
    folder = resources.files("firmware_configs") / "projectors"
    return tuple(sorted(entry.name.removesuffix(".toml") for entry in folder.iterdir() if entry.name.endswith(".toml")))


def profile_text(profile: str, stage: Path) -> tuple[str, str]:
    """The text of a profile, and its name for messages.

    ``profile`` is the name of a shipped profile, or a path, relative to the stage folder, that ends in ``.toml``.
    Raises PluginError("profile-missing") or PluginError("profile-unreadable").
    """
    if not profile.endswith(".toml"):
        if profile not in shipped_profiles():
            raise _missing(f"The projector profile {profile!r} does not exist.")
        shipped = resources.files("firmware_configs") / "projectors" / f"{profile}.toml"
        return shipped.read_text(encoding="utf-8"), f"{profile}.toml"
    path = stage / profile
    try:
        return read_text(path), str(path)
    except FileNotFoundError as error:
        raise _missing(f"The profile file {path} does not exist.") from error
    except OSError as error:
        raise _unreadable(path, error.strerror or "it can't be read") from error
    except UnicodeDecodeError as error:
        raise _unreadable(path, "it is not UTF-8 text") from error


def load_profile(profile: str, stage: Path) -> ProjectorProfile:
    """Find and read a profile; as ``profile_text``, and ProtocolError("profile-wrong") for wrong content."""
    text, file = profile_text(profile, stage)
    return parse_profile(text, file=file)


def _missing(what: str) -> PluginError:
    return PluginError(
        "profile-missing",
        what=what,
        remedy=f"Use one of {', '.join(shipped_profiles())}, or a .toml file in the stage folder.",
    )


def _unreadable(path: Path, why: str) -> PluginError:
    return PluginError(
        "profile-unreadable", what=f"The profile {path} could not be read: {why}.", remedy="Check the file."
    )
