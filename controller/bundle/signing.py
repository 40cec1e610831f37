"""Ed25519 signatures over a bundle's header and index; key files (docs/reference/bundle-format.md, "Signature").

The index holds the SHA-256 of every stripe, so what is signed fixes every pixel.
"""

from __future__ import annotations

import contextlib
import os
import stat
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from nacl.exceptions import BadSignatureError, CryptoError
from nacl.signing import SigningKey, VerifyKey

from controller.bundle.format import damaged
from controller.core.errors import BundleError, UsageError
from controller.core.storage import write_atomically

BLOCK: Final = struct.Struct("<8s32s64s24x")
BLOCK_BYTES: Final = BLOCK.size
UNSIGNED_BLOCK: Final = bytes(BLOCK_BYTES)
_MAGIC: Final = b"VELSIGN1"
_CONTEXT: Final = b"velatura bundle signature 1\0"
_SIGNING_PREFIX: Final = "velatura-signing-key-1 "
_PUBLIC_PREFIX: Final = "velatura-public-key-1 "
_KEY_BYTES: Final = 32
_KEY_FILE_BYTES: Final = 1024


@dataclass(frozen=True, slots=True)
class Trust:
    """Which bundles may be used: signed by one of ``keys``, or unsigned if allowed; never signed by ``revoked``."""

    keys: tuple[bytes, ...] = ()
    allow_unsigned: bool = False
    revoked: tuple[bytes, ...] = ()


ANY_SIGNER: Final = Trust(allow_unsigned=True)
"""For inspecting any bundle: a signature must match its content, but any key may have signed."""


def unsigned_warning(signed_by: bytes | None, trust: Trust) -> BundleError | None:
    """The warning for a bundle that is usable only because unsigned ones are allowed; None if it is trusted.

    Not to be raised: the bundle plays.
    """
    if signed_by is not None and signed_by in trust.keys:
        return None
    how = "has no signature" if signed_by is None else "is signed by a key that stage.toml does not list"
    return BundleError(
        "bundle-unproven",
        what=f"The bundle {how}. Its origin is unknown; it plays because the stage allows unsigned bundles.",
        remedy="Make a key with `velatura bundle key STAGE`, publish again, and remove allow_unsigned from stage.toml.",
    )


def generate_key(path: Path) -> bytes:
    """Make a new key: the secret in ``path`` (mode 0600), the public one in ``path`` with ``.pub`` added.

    Returns the 32 bytes of the public key. Raises UsageError("key-exists") rather than replace a key.
    """
    if path.exists():
        raise UsageError(
            "key-exists",
            what=f"There is already a key in {path}.",
            remedy="Use another name, or remove the old key if no kiosk trusts it any more.",
        )
    key = SigningKey.generate()
    public = bytes(key.verify_key)
    write_atomically(path, f"{_SIGNING_PREFIX}{bytes(key).hex()}\n".encode(), mode=0o600)
    write_public_key(path.with_name(path.name + ".pub"), public)
    return public


def write_public_key(path: Path, public: bytes) -> None:
    """Write the 32 bytes of a public key as a key file, unless it is one already: a full disk stops nothing then."""
    text = f"{_PUBLIC_PREFIX}{public.hex()}\n".encode()
    with contextlib.suppress(OSError):
        if path.read_bytes() == text:
            return
    write_atomically(path, text)


def load_signing_key(path: Path) -> SigningKey:
    """Read a secret key. Raises UsageError("key-unreadable"), or ("key-open-to-others") unless its mode is 0600."""
    data = _key_bytes(path, _SIGNING_PREFIX)
    if path.stat().st_mode & 0o077:
        raise UsageError(
            "key-open-to-others",
            what=f"Other users of this computer can read the secret key {path}.",
            remedy=f"Run 'chmod 600 {path}', and make a new key if someone may have copied it.",
        )
    return SigningKey(data)


def load_public_key(path: Path) -> bytes:
    """The 32 bytes of a public key file. Raises UsageError("key-unreadable")."""
    return _key_bytes(path, _PUBLIC_PREFIX)


def _key_bytes(path: Path, prefix: str) -> bytes:
    try:
        # Not blocking: opening a pipe would otherwise wait for its other end.
        with open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as file:
            if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                raise ValueError("it is not a file")
            text = file.read(_KEY_FILE_BYTES).decode("ascii").strip()
        if not text.startswith(prefix):
            raise ValueError(f"it does not begin with '{prefix.strip()}'")
        data = bytes.fromhex(text.removeprefix(prefix))
        if len(data) != _KEY_BYTES:
            raise ValueError("it does not have 32 bytes")
    except (OSError, ValueError) as error:
        reason = os.strerror(error.errno) if isinstance(error, OSError) and error.errno else str(error)
        raise UsageError(
            "key-unreadable",
            what=f"{path} is not a readable key file ({reason}).",
            remedy="Give a key file that 'velatura bundle key' made.",
        ) from error
    return data


def sign(header: bytes, index: bytes, key: SigningKey) -> bytes:
    """The 128-byte signature block for these header and index bytes."""
    return BLOCK.pack(_MAGIC, bytes(key.verify_key), key.sign(_CONTEXT + header + index).signature)


def check_signature(
    header: bytes,
    index: bytes,
    block: bytes,
    *,
    trusted: Sequence[bytes],
    allow_unsigned: bool,
    revoked: Sequence[bytes] = (),
) -> bytes | None:
    """Who signed: one of the ``trusted`` public keys, or None for an unsigned bundle that ``allow_unsigned`` lets pass.

    ``allow_unsigned`` lets pass only what carries no signature at all; a wrong one is refused in any case. With no
    trusted key and ``allow_unsigned``, a signature is checked against the key that it names. A ``revoked`` key is
    refused in any case, ``trusted`` or not.

    Raises BundleError("bundle-unsigned", "bundle-untrusted", "bundle-revoked", "bundle-signature-wrong" or
    "bundle-damaged").
    """
    if block == UNSIGNED_BLOCK:
        if allow_unsigned:
            return None
        raise BundleError(
            "bundle-unsigned",
            what="The bundle has no signature, so its origin is unknown.",
            remedy="Sign it with 'velatura bundle sign', or allow unsigned bundles in stage.toml on a test stage.",
        )
    magic, public, signature = BLOCK.unpack(block)
    if magic != _MAGIC or block != BLOCK.pack(magic, public, signature):
        raise damaged("its signature block is not valid")
    if public in revoked:
        raise BundleError(
            "bundle-revoked",
            what=f"The bundle is signed with the key {public.hex()[:16]}…, which this stage has revoked.",
            remedy="Build it again with a key that the stage trusts, or sign it with 'velatura bundle sign'.",
        )
    if public not in trusted and (trusted or not allow_unsigned):
        raise BundleError(
            "bundle-untrusted",
            what=f"The bundle is signed with the key {public.hex()[:16]}…, which this stage does not trust.",
            remedy="If the key is yours, add its public key to the stage's trusted keys; otherwise do not use the "
            "bundle.",
        )
    try:
        VerifyKey(public).verify(_CONTEXT + header + index, signature)
    except (BadSignatureError, CryptoError, ValueError) as error:
        raise BundleError(
            "bundle-signature-wrong",
            what="The bundle's signature does not match its content: it was changed after signing.",
            remedy="Copy or publish the bundle again; nothing of this one was used.",
        ) from error
    return bytes(public)
