"""Who belongs to a house: its certificate authority, which it keeps itself, and the certificate of each member.

A house, or the controller of several players, has an ``Authority`` in a folder below ``keys/`` of its stage. A member
has a ``Membership`` in such a folder. A private key never leaves the computer that made it.

Who solves for the others has a second certificate, by which it also serves (``Authority.peers``). Those have an
authority of their own: by a certificate that may serve, a member could pass for the house.
"""

from __future__ import annotations

import json
import re
import secrets
import shutil
import time
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from controller.core.errors import UsageError
from controller.core.storage import sync_folder, write_atomically

AUTHORITY, CERTIFICATE, KEY = "authority.pem", "certificate.pem", "key.pem"
"""The files of TLS in either folder; only ``KEY``, and the authority's own key, are secret."""
_AUTHORITY_KEY, _MEMBERS, _HOUSE, _PEERS = "authority-key.pem", "members.json", "house.json", "peers"
_NAME: Final = re.compile(r"[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?")
_BEGIN: Final = datetime(2020, 1, 1, tzinfo=UTC)
"""A computer whose clock lost its battery must not be shut out."""
_VALID: Final = timedelta(days=7300)


@dataclass(frozen=True, slots=True)
class Member:
    """``certified``: the name in its certificate, which no other has; ``address``: where it was when it joined."""

    name: str
    certified: str
    address: str
    joined_unix_s: float


@dataclass(frozen=True, slots=True)
class Membership:
    """A member's side. ``endpoints``: where the house listens, "tls/house.local:7447"."""

    folder: Path
    name: str
    house: str
    endpoints: tuple[str, ...]


def checked_name(name: str) -> str:
    """Raises UsageError("house-name-wrong")."""
    if _NAME.fullmatch(name):
        return name
    raise UsageError(
        "house-name-wrong",
        what=f'"{name[:80]}" can\'t be the name of a computer in a house.',
        remedy="Use small letters, digits and hyphens, at most 63.",
    )


@dataclass(frozen=True, slots=True)
class Certified:
    """What ``Authority.certify`` answers, PEM."""

    certificate: str
    authority: str


class Authority:
    """The certificate authority of a house; made at its first use. ``name``: of the house.

    Two processes must not change one at the same time.
    """

    _uses: tuple[x509.ObjectIdentifier, ...] = (ExtendedKeyUsageOID.CLIENT_AUTH,)
    """Of the certificates of members."""

    def __init__(self, folder: Path, name: str) -> None:
        """Raises UsageError("house-keys-damaged")."""
        self.folder, self.name = folder, name
        if not (folder / _MEMBERS).exists():
            self._make()
        try:
            self._certificate = x509.load_pem_x509_certificate((folder / AUTHORITY).read_bytes())
            self._key = _private((folder / _AUTHORITY_KEY).read_bytes())
            listed = json.loads((folder / _MEMBERS).read_bytes())
            self._members = {one["name"]: Member(**one) for one in listed}
        except (OSError, ValueError, TypeError, KeyError) as error:
            raise _damaged(folder) from error

    @property
    def members(self) -> Mapping[str, Member]:
        """By name."""
        return self._members

    def admit(self, request: bytes, name: str, address: str) -> bytes:
        """The certificate (PEM) for a request of ``requested``; ``name`` belongs to the house from now on.

        Raises UsageError("house-name-taken", "house-name-wrong" or "house-request-wrong").
        """
        if checked_name(name) in self._members:
            raise UsageError(
                "house-name-taken",
                what=f"The house has a member with the name {name}.",
                remedy="Choose another name, or remove that member first.",
            )
        certified = f"{name}.{secrets.token_hex(8)}"
        certificate = self.certify(request, certified).certificate
        self._list({**self._members, name: Member(name, certified, address, time.time())})
        return certificate.encode()

    def certify(self, request: bytes, name: str) -> Certified:
        """A certificate for a request of ``requested``. Raises UsageError("house-request-wrong")."""
        try:
            asked = x509.load_pem_x509_csr(request)
            valid = asked.is_signature_valid and isinstance(asked.public_key(), ec.EllipticCurvePublicKey)
        except ValueError:
            valid = False
        if not valid:
            raise UsageError(
                "house-request-wrong",
                what=f"{name} sent no valid request for a certificate.",
                remedy="Install the same version of Velatura on both computers, and join again.",
            )
        certificate = _signed(name, asked.public_key(), self._certificate.subject, self._key, *self._uses)
        return Certified(certificate.decode(), (self.folder / AUTHORITY).read_text())

    def peers(self) -> Authority:
        """Of those who solve for each other; another one after a member was removed."""
        return _Peers(self.folder / _PEERS, self.name)

    def remove(self, name: str) -> None:
        """Its certificate counts no more, also not when it joins again. Raises UsageError("house-member-unknown")."""
        if name not in self._members:
            raise UsageError(
                "house-member-unknown", what=f"The house has no member {name}.", remedy="Choose one of its page."
            )
        self._list({key: one for key, one in self._members.items() if key != name})
        shutil.rmtree(self.folder / _PEERS, ignore_errors=True)

    def _list(self, members: dict[str, Member]) -> None:
        listed = [{slot: getattr(one, slot) for slot in Member.__slots__} for one in members.values()]
        write_atomically(self.folder / _MEMBERS, json.dumps(listed, indent=1).encode(), mode=0o600)
        self._members = members

    def _make(self) -> None:
        """The list of members last: where it is, all the rest is."""
        self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, f"house {secrets.token_hex(8)}")])
        key = ec.generate_private_key(ec.SECP256R1())
        certificate = _signed(subject, key.public_key(), subject, key)
        server = ec.generate_private_key(ec.SECP256R1())
        for file, data in (
            (_AUTHORITY_KEY, _pem(key)),
            (AUTHORITY, certificate),
            (KEY, _pem(server)),
            (CERTIFICATE, _signed("house", server.public_key(), subject, key, ExtendedKeyUsageOID.SERVER_AUTH)),
            (_MEMBERS, b"[]"),
        ):
            write_atomically(self.folder / file, data, mode=0o600)


class _Peers(Authority):
    _uses = (ExtendedKeyUsageOID.CLIENT_AUTH, ExtendedKeyUsageOID.SERVER_AUTH)


def requested() -> tuple[bytes, bytes]:
    """A new private key and a request for a certificate, PEM."""
    key = ec.generate_private_key(ec.SECP256R1())
    request = x509.CertificateSigningRequestBuilder().subject_name(x509.Name([])).sign(key, hashes.SHA256())
    return _pem(key), request.public_bytes(serialization.Encoding.PEM)


def join(membership: Membership, key: bytes, certificate: bytes, authority: bytes) -> None:
    """Write the membership into its folder, in place of an old one.

    Raises UsageError("house-certificate-wrong") if the three do not belong together.
    """
    try:
        ours, theirs = x509.load_pem_x509_certificate(certificate), x509.load_pem_x509_certificate(authority)
        ours.verify_directly_issued_by(theirs)
        if ours.public_key() != _private(key).public_key():
            raise ValueError
    except (ValueError, TypeError, InvalidSignature) as error:
        raise UsageError(
            "house-certificate-wrong",
            what="The house sent a certificate that does not fit.",
            remedy="Join again with a new code.",
        ) from error
    folder = membership.folder
    new = folder.with_name(f".{folder.name}.new")
    shutil.rmtree(new, ignore_errors=True)
    new.mkdir(mode=0o700, parents=True)
    about = {"name": membership.name, "house": membership.house, "endpoints": list(membership.endpoints)}
    for file, data in (
        (KEY, key), (CERTIFICATE, certificate), (AUTHORITY, authority), (_HOUSE, json.dumps(about).encode())
    ):  # fmt: skip
        write_atomically(new / file, data, mode=0o600)
    leave(folder)
    new.rename(folder)
    sync_folder(folder.parent)


def membership(folder: Path) -> Membership | None:
    """None where this computer belongs to no house. Raises UsageError("house-keys-damaged")."""
    if not folder.exists():
        return None
    try:
        about = json.loads((folder / _HOUSE).read_bytes())
        return Membership(folder, str(about["name"]), str(about["house"]), tuple(map(str, about["endpoints"])))
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise _damaged(folder) from error


def leave(folder: Path) -> None:
    """Forget the house; the house itself has to remove this member, too."""
    shutil.rmtree(folder, ignore_errors=True)


def _private(pem: bytes) -> ec.EllipticCurvePrivateKey:
    key = serialization.load_pem_private_key(pem, None)
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise TypeError("it is no key on an elliptic curve")
    return key


def _pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def _signed(
    subject: str | x509.Name, public: object, issuer: x509.Name, key: ec.EllipticCurvePrivateKey,
    *uses: x509.ObjectIdentifier,
) -> bytes:  # fmt: skip
    """A certificate (PEM) for these ``uses``; none: of the authority itself. A member's can't serve: no member can pass
    for the house.
    """
    assert isinstance(public, ec.EllipticCurvePublicKey)
    name = subject if isinstance(subject, x509.Name) else x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, subject)])
    builder = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(issuer)
        .public_key(public)
        .serial_number(x509.random_serial_number())
        .not_valid_before(_BEGIN)
        .not_valid_after(datetime.now(UTC) + _VALID)
        .add_extension(x509.BasicConstraints(not uses, None if uses else 0), critical=True)
    )
    if uses:
        builder = builder.add_extension(x509.ExtendedKeyUsage(uses), critical=True)
        # The TLS library of Zenoh refuses a certificate without one; addresses change, so it is not compared.
        builder = builder.add_extension(x509.SubjectAlternativeName([x509.DNSName("velatura")]), critical=False)
    return builder.sign(key, hashes.SHA256()).public_bytes(serialization.Encoding.PEM)


def _damaged(folder: Path) -> UsageError:
    return UsageError(
        "house-keys-damaged",
        what=f"The keys of the house in {folder} can't be read.",
        remedy="Copy the folder from where it is whole, or remove it and join again.",
    )
