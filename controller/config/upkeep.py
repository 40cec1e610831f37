"""The tables of stage.toml for an unattended kiosk: its disk, its backups, and who gets alerts."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from controller.config.table import ConfigTable

_Address = Annotated[str, Field(pattern=r"^[^@\s]+@[^@\s]+$", max_length=254)]


class DiskTable(ConfigTable):
    warn_free_gb: float = Field(
        default=5.0, ge=0, le=100_000,
        description="gigabytes of free space below which the kiosk removes old photographs and runs, and then warns, "
        "0 to 100000",
    )  # fmt: skip
    keep_runs: int = Field(
        default=5, ge=2, le=10_000, description="how many runs of each kind are never removed, 2 to 10000"
    )


class BackupTable(ConfigTable):
    folder: str | None = Field(
        default=None, min_length=1,
        description="the folder that gets a backup every night, best on another disk; relative to the stage's folder; "
        "if omitted: no backup",
    )  # fmt: skip
    usb: str | None = Field(
        default=None, min_length=1, max_length=64,
        description="the label or UUID of the file system of a mounted USB stick that gets a backup every night",
    )  # fmt: skip
    ssh: str | None = Field(
        default=None, max_length=1000,
        pattern=r"^ssh://[A-Za-z0-9_][A-Za-z0-9._-]{0,63}@(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9][A-Za-z0-9.-]{0,252})(:[0-9]{1,5})?/[^\s\"\\*?\[\]]*$",
        description='a folder on a server that gets a backup every night by SFTP: "ssh://USER@HOST/FOLDER", or with '
        "HOST:PORT",
    )  # fmt: skip
    ssh_key_file: str | None = Field(
        default=None, min_length=1, pattern=r'^[^"\n]+$',
        description="a file with the private key for that server, without a passphrase; relative to the stage's "
        "folder; needed for ssh",
    )  # fmt: skip
    ssh_host_key: str | None = Field(
        default=None, pattern=r"^(ssh-ed25519|ssh-rsa|ecdsa-sha2-nistp(256|384|521)) [A-Za-z0-9+/=]{16,2000}$",
        description='the public key of that server, such as "ssh-ed25519 AAAA...": two words of '
        "/etc/ssh/ssh_host_ed25519_key.pub there; needed for ssh",
    )  # fmt: skip
    at: str = Field(
        default="04:30", pattern=r"^([01][0-9]|2[0-3]):[0-5][0-9]$", description='the local time "HH:MM" of the backup'
    )
    keep: int = Field(default=7, ge=1, le=366, description="how many backups stay in the folder, 1 to 366")


class AlertsTable(ConfigTable):
    """Who gets the events: people by mail, programs by a webhook."""

    least: Literal["warning", "error"] = Field(
        default="error", description='"warning" or "error": the least level of an event that is sent'
    )
    mail_to: Annotated[tuple[_Address, ...], Field(strict=False, max_length=20)] = Field(
        default=(), description="a list of mail addresses, at most 20; none: no mail"
    )
    mail_from: _Address | None = Field(default=None, description="the sender's mail address; needed for mail")
    mail_host: str | None = Field(
        default=None, min_length=1, max_length=253, description="the name of the mail server (SMTP); needed for mail"
    )
    mail_port: int = Field(default=587, ge=1, le=65_535, description="its port, 1 to 65535")
    mail_security: Literal["starttls", "tls", "none"] = Field(
        default="starttls", description='"starttls", "tls" or "none"; with "none" no password is sent'
    )
    mail_user: str | None = Field(default=None, min_length=1, max_length=254, description="the name to log in with")
    mail_password_file: str | None = Field(
        default=None, min_length=1, description="a file that has only the password, relative to the stage's folder"
    )
    certificates: str | None = Field(
        default=None, min_length=1,
        description="a file with certificate authorities (PEM) for servers whose certificate is not public",
    )  # fmt: skip
    webhook: str | None = Field(
        default=None, pattern=r"^https?://[^\s]+$", max_length=2000,
        description='an address that gets each alert as JSON by POST, for example "https://example.org/velatura"',
    )  # fmt: skip
