"""Checks the files of TLS before anything starts: each fault has a sentence that names the file."""

from __future__ import annotations

import re
import ssl
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from controller.core.errors import UsageError

_PEM: Final = "Use files in PEM format: text that contains BEGIN CERTIFICATE, and BEGIN PRIVATE KEY."
_CERTIFICATE: Final = re.compile(r"-----BEGIN CERTIFICATE-----.+?-----END CERTIFICATE-----", re.DOTALL)
_TIME: Final = rb"(?:\x17\x0d|\x18\x0f)(\d{12,14})Z"
_VALIDITY: Final = re.compile(rb"\x30." + _TIME + _TIME, re.DOTALL)
"""The first two times of a certificate, as X.509 has them (RFC 5280, section 4.1.2.5)."""


class _PassphraseAsked(Exception):
    """OpenSSL asked for the passphrase of a key, which no service can type."""


def check_server_files(certificate: Path | None, key: Path | None) -> None:
    """Certificate and key of a server, which can be read; the key may be in the file of the certificate.

    Raises UsageError("tls-files-wrong").
    """
    if certificate is None:
        if key is not None:
            raise _wrong(f"The TLS key {key} has no certificate", "Set --certificate too, or omit --key.")
        return
    check_certificates(certificate)
    file = key or certificate
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(certificate, key, password=_refuse)
    except _PassphraseAsked:
        remedy = f"Write it without one: `openssl pkey -in {file} -out key.pem`, readable only by its user."
        raise _wrong(f"The TLS key {file} has a passphrase, which a service can't type", remedy) from None
    except ssl.SSLError as error:
        if error.reason == "KEY_VALUES_MISMATCH":
            what = f"The TLS key {file} does not belong to the certificate {certificate}"
            raise _wrong(what, "Set --key to the key that the certificate was made for.") from error
        raise _wrong(f"{file} has no private key in PEM format that can be used", _PEM) from error


def check_certificates(file: Path) -> None:
    """Raises UsageError("tls-files-wrong") for a file without certificates."""
    try:
        ssl.create_default_context(cafile=str(file))
    except ssl.SSLError as error:
        raise _wrong(f"{file} has no certificate in PEM format", _PEM) from error


def out_of_date(certificate: Path) -> str:
    """A sentence if the certificate is not valid now, else "". The stage can play without, so it is no refusal."""
    first = _CERTIFICATE.search(certificate.read_text("utf-8", "replace"))
    validity = _VALIDITY.search(ssl.PEM_cert_to_DER_cert(first[0])) if first is not None else None
    if validity is None:
        return ""
    now, begins, ends = datetime.now(UTC), _moment(validity[1]), _moment(validity[2])
    if begins <= now <= ends:
        return ""
    when = f"expired on {ends:%Y-%m-%d}" if now > ends else f"begins on {begins:%Y-%m-%d}"
    return f"The panel's certificate {certificate} {when}, so browsers refuse it."


def _moment(digits: bytes) -> datetime:
    """Years of two digits are 1950 to 2049."""
    text = digits.decode("ascii")
    text = text if len(text) == 14 else f"{'19' if text >= '5' else '20'}{text}"
    return datetime.strptime(text, "%Y%m%d%H%M%S").replace(tzinfo=UTC)


def _refuse() -> str:
    raise _PassphraseAsked


def _wrong(what: str, remedy: str) -> UsageError:
    return UsageError("tls-files-wrong", what=f"{what}.", remedy=remedy)
