"""Where the panel listens, and how."""

from __future__ import annotations

import contextlib
import logging
import shutil
import socket
import ssl
import subprocess
import threading
import time
from pathlib import Path

import httpx
import pytest

from controller.cli.kiosk_process import PanelAddress, _check_panel
from controller.core.errors import UsageError, WorkError
from controller.panel.app import make_panel
from controller.panel.context import PanelOptions
from controller.panel.server import PanelServer, check_exposure
from controller.panel.tls import out_of_date
from tests.controller.panel.memory_kiosk import MemoryKiosk
from tests.controller.panel.served import PASSWORD, accounts_in, csrf, served
from tests.waiting import wait_for


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.4", "kiosk.local", ""])
def test_beyond_this_machine_only_with_tls(tmp_path: Path, host: str) -> None:
    with pytest.raises(UsageError) as caught:
        check_exposure(PanelOptions(tmp_path, host=host))
    assert caught.value.code == "panel-open-without-tls"
    check_exposure(PanelOptions(tmp_path, host=host, tls_certificate=tmp_path / "c.pem", tls_key=tmp_path / "k.pem"))


def test_it_listens_on_loopback_unless_told_otherwise(tmp_path: Path) -> None:
    assert PanelOptions(tmp_path).host == "127.0.0.1"
    check_exposure(PanelOptions(tmp_path, host="::1"))


def test_a_port_that_is_taken_is_told_and_a_stopped_panel_frees_it(tmp_path: Path) -> None:
    kiosk = MemoryKiosk(tmp_path / "pictures")
    first_options = PanelOptions(tmp_path / "a", port=0)
    first = PanelServer(make_panel(kiosk, accounts_in(tmp_path / "a"), first_options), first_options)
    address = first.start()
    port = int(address.rstrip("/").rpartition(":")[2])
    second_options = PanelOptions(tmp_path / "b", port=port)
    for taken in (True, False):
        second = PanelServer(make_panel(kiosk, accounts_in(tmp_path / "b"), second_options), second_options)
        if taken:
            with pytest.raises(WorkError) as caught:
                second.start()
            assert caught.value.code == "panel-port-taken"
            first.stop()
        else:
            assert second.start() == address
            second.stop()


def test_a_stop_ends_the_pages_that_follow_live_without_waiting_for_them(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    options = PanelOptions(tmp_path / "p", port=0)
    server = PanelServer(make_panel(MemoryKiosk(tmp_path / "pictures"), accounts_in(tmp_path / "p"), options), options)
    address = server.start()
    with httpx.Client(base_url=address, trust_env=False) as client:
        token = csrf(client.get("/login").text)
        client.post("/login", data={"csrf": token, "name": "vera", "password": PASSWORD})
        with client.stream("GET", "/live") as live:
            lines = live.iter_lines()
            assert next(lines).startswith("retry:")
            server.stop()
            assert list(lines)
    # A server that had to lose its patience with an open page would say so as an error.
    assert not [record for record in caplog.records if record.levelno >= logging.ERROR]


@pytest.mark.parametrize("again", range(5))
def test_a_stop_closes_connections_that_begin_at_that_moment(tmp_path: Path, again: int) -> None:
    """A browser opens spare connections, and would wait for good on one that is open and that no one reads.

    Without the closing, about every second time is caught.
    """
    options = PanelOptions(tmp_path / "p", port=0)
    server = PanelServer(make_panel(MemoryKiosk(tmp_path / "pictures"), accounts_in(tmp_path / "p"), options), options)
    address = server.start()
    port = int(address.rstrip("/").rpartition(":")[2])
    lines: list[socket.socket] = []
    stopped = threading.Event()

    def connect() -> None:
        while not stopped.is_set():
            with contextlib.suppress(OSError):
                lines.append(socket.create_connection(("127.0.0.1", port), timeout=5))
            time.sleep(0.0002)

    browsers = [threading.Thread(target=connect) for _ in range(2)]
    for browser in browsers:
        browser.start()
    wait_for(lambda: len(lines) > 5)
    server.stop()
    stopped.set()
    for browser in browsers:
        browser.join()
    with contextlib.ExitStack() as closing:
        for line in lines:
            closing.enter_context(line)
            with contextlib.suppress(ConnectionResetError):
                assert line.recv(1) == b""


@pytest.mark.skipif(shutil.which("openssl") is None, reason="needs openssl to make a certificate")
def test_with_tls_nothing_crosses_in_the_clear_and_cookies_stay(tmp_path: Path) -> None:
    certificate, key = tmp_path / "c.pem", tmp_path / "k.pem"
    command = [
        "openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes", "-days", "2",
    ]  # fmt: skip
    command += ["-keyout", str(key), "-out", str(certificate), "-subj", "/CN=localhost"]
    subprocess.run([*command, "-addext", "subjectAltName=IP:127.0.0.1"], check=True, capture_output=True)
    options = PanelOptions(tmp_path / "p", port=0, tls_certificate=certificate, tls_key=key)
    app = make_panel(MemoryKiosk(tmp_path / "pictures"), accounts_in(tmp_path / "p"), options)
    server = PanelServer(app, options)
    address = server.start()
    try:
        trust = ssl.create_default_context(cafile=str(certificate))
        with httpx.Client(base_url=address, verify=trust, trust_env=False) as client:
            page = client.get("/login")
            assert page.headers["strict-transport-security"]
            answer = client.post("/login", data={"csrf": csrf(page.text), "name": "vera", "password": PASSWORD})
            cookie = next(text for text in answer.headers.get_list("set-cookie") if text.startswith("__Host-velatura="))
            assert "Secure" in cookie
            assert client.get("/").status_code == 200
        with httpx.Client(trust_env=False) as client, pytest.raises(httpx.HTTPError):
            client.get(address.replace("https", "http") + "login")
    finally:
        server.stop()


def openssl(*arguments: str) -> None:
    subprocess.run(["openssl", *arguments], check=True, capture_output=True)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Certificates and keys by OpenSSL: ``c.pem`` with ``k.pem``, another key, one with a passphrase, other formats."""
    if shutil.which("openssl") is None:
        pytest.skip("needs openssl to make a certificate")
    folder = tmp_path_factory.mktemp("tls")
    curve = ("ec", "-pkeyopt", "ec_paramgen_curve:P-256")
    key, certificate = str(folder / "k.pem"), str(folder / "c.pem")
    openssl("req", "-x509", "-newkey", *curve, "-nodes", "-days", "2", "-keyout", key, "-out", certificate,
            "-subj", "/CN=localhost")  # fmt: skip
    openssl("genpkey", "-algorithm", *curve, "-out", str(folder / "other.pem"))
    openssl("pkey", "-in", key, "-aes256", "-passout", "pass:secret", "-out", str(folder / "locked.pem"))
    openssl("x509", "-in", certificate, "-outform", "DER", "-out", str(folder / "c.der"))
    (folder / "both.pem").write_bytes((folder / "c.pem").read_bytes() + (folder / "k.pem").read_bytes())
    (folder / "empty.pem").write_bytes(b"")
    return folder


@pytest.mark.parametrize(
    ("certificate", "key", "words"),
    [
        ("c.pem", "k.pem", ""),
        ("both.pem", None, ""),
        ("c.pem", "other.pem", "does not belong to the certificate"),
        ("c.pem", "locked.pem", "has a passphrase"),
        ("c.pem", "c.pem", "no private key"),
        ("c.pem", None, "no private key"),
        ("c.der", "k.pem", "no certificate in PEM format"),
        ("k.pem", "k.pem", "no certificate in PEM format"),
        ("empty.pem", "k.pem", "no certificate in PEM format"),
        (None, "k.pem", "has no certificate"),
        ("missing.pem", "k.pem", "can't be read"),
    ],
)
def test_the_files_of_tls_are_checked_before_anything_starts(
    files: Path, certificate: str | None, key: str | None, words: str
) -> None:
    where = PanelAddress(
        port=free_port(), certificate=certificate and files / certificate, key=key and files / key  # type: ignore[arg-type]
    )  # fmt: skip
    if not words:
        _check_panel(where)
        return
    with pytest.raises(UsageError, match=words) as caught:
        _check_panel(where)
    named = key if words in ("has a passphrase", "no private key") and key else certificate or key
    assert str(files / str(named)) in caught.value.what


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as one:
        return int(one.getsockname()[1])


def test_a_certificate_that_is_not_valid_now_is_told(files: Path, tmp_path: Path) -> None:
    assert out_of_date(files / "c.pem") == ""
    for days, words in ((("20010101000000Z", "20020101000000Z"), "expired on 2002-01-01"),
                        (("20700101000000Z", "20800101000000Z"), "begins on 2070-01-01")):  # fmt: skip
        certificate = tmp_path / "dated.pem"
        request, database = tmp_path / "request.pem", tmp_path / "index.txt"
        openssl("req", "-new", "-key", str(files / "k.pem"), "-subj", "/CN=localhost", "-out", str(request))
        database.write_text("")
        (tmp_path / "ca.cnf").write_text(
            f"[ca]\ndefault_ca = own\n[own]\ndatabase = {database}\nrand_serial = yes\nnew_certs_dir = {tmp_path}\n"
            "default_md = sha256\npolicy = any\n[any]\ncommonName = supplied\n"
        )
        signing = ("ca", "-batch", "-config", str(tmp_path / "ca.cnf"), "-selfsign", "-keyfile", str(files / "k.pem"))
        times = ("-startdate", days[0], "-enddate", days[1])
        openssl(*signing, "-in", str(request), *times, "-notext", "-out", str(certificate))
        assert words in out_of_date(certificate)


def test_the_address_of_a_panel_by_ipv6_stands_in_brackets(tmp_path: Path) -> None:
    options = PanelOptions(tmp_path / "p", host="::1", port=0)
    server = PanelServer(make_panel(MemoryKiosk(tmp_path / "pictures"), accounts_in(tmp_path / "p"), options), options)
    try:
        address = server.start()
    except WorkError:
        pytest.skip("this computer has no IPv6")
    try:
        assert address.startswith("http://[::1]:")
        with httpx.Client(trust_env=False) as client:
            assert client.get(f"{address}login").status_code == 200
    finally:
        server.stop()


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"origin": "https://kiosk.museum", "sec-fetch-site": "same-origin"}, 303),
        ({"origin": "https://kiosk.museum", "x-forwarded-host": "kiosk.museum"}, 303),
        ({"origin": "https://named.museum"}, 303),
        ({"origin": "https://kiosk.museum"}, 403),
        ({"origin": "https://evil.example", "x-forwarded-host": "kiosk.museum"}, 403),
        ({"origin": "https://named.museum:444"}, 403),
        ({"origin": "https://kiosk.museum", "sec-fetch-site": "same-site"}, 403),
        ({"origin": "null"}, 403),
    ],
)
def test_a_reverse_proxy_may_rewrite_the_host(tmp_path: Path, headers: dict[str, str], status: int) -> None:
    options = PanelOptions(tmp_path, names=("named.museum",))
    with served(MemoryKiosk(tmp_path / "pictures"), tmp_path, options=options) as panel, panel.client() as client:
        token = csrf(client.get("/login").text)
        answer = client.post("/login", data={"csrf": token, "name": "vera", "password": PASSWORD}, headers=headers)
        assert answer.status_code == status
        assert ("--name" in answer.text) is (status == 403)
