"""A scheduler that speaks TLS: with a certificate on both sides work is done, without one no one is let in."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import dask
import distributed  # noqa: F401  (its defaults are read when it is imported, and would be undone with what was set before)
import pytest

from controller.core.errors import WorkError
from controller.stage.cluster import Outcome, connected
from tests.controller.stage.cluster.machines import machines

OPENSSL = shutil.which("openssl")


def certificate(folder: Path, name: str) -> tuple[str, str]:
    """A certificate that vouches for itself, and its key."""
    assert OPENSSL is not None
    cert, key = folder / f"{name}.pem", folder / f"{name}.key"
    asked = ("req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes", "-days", "2")
    named = ("-subj", f"/CN={name}", "-keyout", str(key), "-out", str(cert))
    subprocess.run([OPENSSL, *asked, *named], check=True, capture_output=True)
    return str(cert), str(key)


def doubled(value: int) -> Outcome[int]:
    return Outcome(2 * value, None)


def configured(authority: str, cert: str, key: str) -> dict[str, str]:
    """As a technician's configuration of Dask names them."""
    tls = "distributed.comm.tls"
    return {f"{tls}.ca-file": authority, f"{tls}.client.cert": cert, f"{tls}.client.key": key}


@pytest.mark.skipif(OPENSSL is None, reason="openssl, which makes the certificates, is not installed")
def test_certificates_let_in_and_a_stranger_is_kept_out(tmp_path: Path) -> None:
    cert, key = certificate(tmp_path, "ours")
    arguments = ("--protocol", "tls", "--tls-ca-file", cert, "--tls-cert", cert, "--tls-key", key)
    with machines(tmp_path, 1, arguments=arguments) as made:
        assert made.address.startswith("tls://")
        with dask.config.set(configured(cert, cert, key)), connected(made.address) as cluster:
            assert cluster.submit(doubled, 21).result() == 42
        stranger = certificate(tmp_path, "stranger")
        with (
            dask.config.set(configured(cert, *stranger)),
            pytest.raises(WorkError) as refused,
            connected(made.address, timeout_s=5),
        ):
            pass
        assert refused.value.code == "scheduler-unreachable"
        with pytest.raises(WorkError) as bare, connected(made.address, timeout_s=5):
            pass
        assert bare.value.code == "scheduler-unreachable"
