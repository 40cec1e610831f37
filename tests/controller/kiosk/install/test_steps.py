"""The installation below another root: what it writes, what it refuses, that it changes nothing when it is repeated.
The real one is in tests/booted.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path

import pytest

import firmware_configs
from controller.core.errors import UsageError, VelaturaError, WorkError
from controller.core.kiosk_places import RUNTIME
from controller.kiosk import panel_address
from controller.kiosk.install import steps
from controller.kiosk.install.system import System
from controller.play.__main__ import parser
from tests.controller.kiosk.install.test_outputs import LEFT

PREFIX = Path("/opt/velatura")


class Recorded(System):
    """A computer whose files lie in a folder, and whose programs are only noted. ``answers`` by a program's name."""

    fail: tuple[str, ...] = ()

    def __init__(self, root: Path, answers: Mapping[str, str], *, dry: bool = False) -> None:
        self.told: list[str] = []
        super().__init__(self.told.append, dry=dry, root=root)
        self.answers, self.ran = answers, list[str]()

    def look(self, *words: str, more: Mapping[str, str] | None = None) -> str | None:
        return self.answers.get(words[0])

    def run(self, *words: str, may_fail: bool = False) -> None:
        self.ran.append(" ".join(words))
        assert may_fail or words[0] not in self.fail
        if words[0] == "openssl":
            self.write(Path(words[words.index("-keyout") + 1]), "a key")
        if words[0] == "systemd-tmpfiles":
            self.folder(RUNTIME)
            self.folder(RUNTIME / "cluster")


@pytest.fixture
def debian(tmp_path: Path) -> Path:
    (tmp_path / "etc").mkdir()
    (tmp_path / "etc/os-release").write_text('NAME="Debian GNU/Linux"\nVERSION_ID="12"\nID=debian\n')
    return tmp_path


INSTALLED = "".join(f"{name} installed\n" for name in steps.PACKAGES)
FRESH = {"xrandr": LEFT, "hostname": "vase\n", "systemctl": ""}
THERE = {**FRESH, "dpkg-query": INSTALLED, "getent": "velatura", "id": " ".join(("velatura", *steps.GROUPS))}


def installed(
    root: Path, answers: Mapping[str, str], *, again: bool = False, restart: bool = False, dry: bool = False
) -> Recorded:
    system = Recorded(root, answers, dry=dry)
    steps.install(system, outputs_again=again, restart=restart, say=system.told.append, prefix=PREFIX)
    return system


def test_it_makes_user_packages_units_and_the_outputs_that_are_there(
    debian: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(panel_address, "own_addresses", lambda: ("10.0.0.9",))
    system = installed(debian, FRESH)
    assert "Panel: https://10.0.0.9:8377" in system.told
    assert (debian / "var/lib/velatura/backups").is_dir(), "the example of the documentation"
    ran = system.ran
    assert any(line.startswith("useradd --system") for line in ran)
    (packages,) = (line for line in ran if line.startswith("apt-get install"))
    assert set(steps.PACKAGES) <= set(packages.split())
    assert "systemctl enable --quiet velatura.target velatura-update.path" in ran
    assert '"1400x1050_59.98"' in (debian / "etc/X11/xorg.conf.d/20-velatura-outputs.conf").read_text()
    assert "--name vase.local" in (debian / "etc/velatura/controller.env").read_text()
    options = (debian / "var/lib/velatura/player.options").read_text().split("\n")[:-1]
    read = parser().parse_args(["--socket", "/run/velatura/player.sock", "--resume", *options])
    assert (read.outputs, read.windows, read.trusted) == ("HDMI-1:1400x1050", True, [])


def test_once_more_it_changes_nothing(debian: Path) -> None:
    installed(debian, FRESH)
    before = {path: path.read_bytes() for path in debian.rglob("*") if path.is_file()}
    again = installed(debian, THERE)
    assert {path: path.read_bytes() for path in debian.rglob("*") if path.is_file()} == before
    assert [line for line in again.ran if not line.startswith(("systemctl enable", "systemctl start", "ln "))] == []


def test_another_version_starts_controller_and_player_again_and_not_the_x_server(debian: Path) -> None:
    installed(debian, FRESH)
    ran = installed(debian, THERE, restart=True).ran
    assert [line for line in ran if "restart" in line] == [
        "systemctl restart velatura-controller velatura-player",
        "systemctl try-restart velatura-worker",
    ]


def test_a_dry_run_writes_nothing_and_tells_all_of_it(debian: Path) -> None:
    before = sorted(debian.rglob("*"))
    system = installed(debian, FRESH, dry=True)
    assert sorted(debian.rglob("*")) == before
    assert {"write /etc/systemd/system/velatura-player.service", "make folder /etc/velatura"} <= set(system.told)


def test_a_projector_that_is_off_later_stays_in_the_settings_until_somebody_asks(debian: Path) -> None:
    installed(debian, FRESH)
    written = debian / "etc/X11/xorg.conf.d/20-velatura-outputs.conf"
    other = {**THERE, "xrandr": LEFT.replace("HDMI-1", "DP-7")}
    installed(debian, other)
    assert "HDMI-1" in written.read_text()
    installed(debian, other, again=True)
    assert "DP-7" in written.read_text()
    assert "DP-7:1400x1050" in (debian / "var/lib/velatura/player.options").read_text()


def test_without_projectors_it_says_so_and_the_player_starts_all_the_same(debian: Path) -> None:
    system = installed(debian, {**FRESH, "xrandr": ""})
    assert any("--outputs" in line for line in system.told)
    assert not (debian / "etc/X11/xorg.conf.d/20-velatura-outputs.conf").exists()
    assert "projector:1024x768" in (debian / "var/lib/velatura/player.options").read_text()


def test_the_options_of_a_stage_are_left_alone(debian: Path) -> None:
    installed(debian, FRESH)
    (debian / "var/lib/velatura/stage/stage.toml").write_text("[stage]")
    (debian / "var/lib/velatura/player.options").write_text("mine")
    installed(debian, THERE, again=True)
    assert (debian / "var/lib/velatura/player.options").read_text() == "mine"


@pytest.mark.parametrize(
    ("release", "active", "prefix", "code"),
    [
        ("ID=ubuntu\nVERSION_ID=24.04\n", "", PREFIX, "kiosk-system-unknown"),
        ("ID=debian\nVERSION_ID=11\n", "", PREFIX, "kiosk-system-unknown"),
        ("ID=debian\n", "", PREFIX, "kiosk-system-unknown"),
        ("", "", PREFIX, "kiosk-system-unknown"),
        ("ID=debian\nVERSION_ID=13\n", "active\n", PREFIX, "kiosk-has-desktop"),
        ("ID=debian\nVERSION_ID=13\n", "", Path("/home/somebody/venv"), "kiosk-place-hidden"),
    ],
)
def test_a_computer_on_which_it_would_not_work_is_refused(
    debian: Path, release: str, active: str, prefix: Path, code: str
) -> None:
    (debian / "etc/os-release").write_text(release)
    system = Recorded(debian, {**FRESH, "systemctl": active})
    with pytest.raises(VelaturaError) as caught:
        steps.install(system, outputs_again=False, restart=False, say=system.told.append, prefix=prefix)
    assert isinstance(caught.value, UsageError)
    assert (caught.value.code, system.ran) == (code, [])


def test_a_kiosk_that_solves_for_its_house_has_one_service_more_until_it_is_taken_back(debian: Path) -> None:
    system = installed(debian, FRESH)
    steps.install_worker(system)
    assert system.ran[-1] == "systemctl enable --quiet --now velatura-worker"
    restarted = installed(debian, THERE, restart=True).ran
    assert restarted.index("systemctl try-restart velatura-worker") > restarted.index(
        "systemctl restart velatura-controller velatura-player"
    )
    again = Recorded(debian, THERE)
    steps.uninstall(again, purge=False, prefix=PREFIX)
    assert "systemctl disable --now --quiet velatura-worker" in again.ran


def test_uninstalling_takes_everything_back_but_the_stage(debian: Path) -> None:
    before = sorted(path for path in debian.rglob("*") if path.is_file())
    installed(debian, FRESH)
    (debian / "var/lib/velatura/stage/stage.toml").write_text("[stage]")
    system = Recorded(debian, THERE)
    system.fail = "systemctl", "udevadm"  # as in a container
    steps.uninstall(system, purge=False, prefix=PREFIX)
    left = {path for path in debian.rglob("*") if path.is_file()} - set(before)
    assert {path.relative_to(debian).parts[:2] for path in left} == {("etc", "velatura"), ("var", "lib")}
    steps.uninstall(system, purge=True, prefix=PREFIX)
    assert sorted(path for path in debian.rglob("*") if path.is_file()) == before
    assert "userdel velatura" in system.ran


def test_a_program_that_fails_ends_it_with_what_it_said(debian: Path) -> None:
    system = System(lambda line: None, root=debian)
    with pytest.raises(WorkError, match="no such luck") as caught:
        system.run("sh", "-c", "echo no such luck; exit 3")
    assert caught.value.code == "kiosk-step-failed"
    with pytest.raises(WorkError, match="no such program"):
        system.run("velatura-is-no-such-program")
    system.run("false", may_fail=True)


def test_a_computer_with_outputs_of_another_stage_runs_the_agent_and_nothing_else(debian: Path) -> None:
    system = Recorded(debian, FRESH)
    steps.install_player(system, say=system.told.append, prefix=PREFIX)
    assert "systemctl stop --quiet velatura-player velatura-controller" in system.ran
    units = {path.stem for path in system.at(Path("/etc/systemd/system")).glob("*.service")}
    assert "velatura-agent" in units
    assert not units & {"velatura-player", "velatura-controller"}, "systemd masks no unit whose file is there"
    assert "systemctl enable --quiet velatura.target velatura-agent velatura-update.path" in system.ran
    assert any(line.startswith("apt-get install") and "chrony" in line for line in system.ran)
    assert (debian / "etc/systemd/system/velatura-agent.service").exists()
    assert not (debian / "etc/velatura/controller.env").exists()
    # Another version leaves the outputs, also where a projector is off just then.
    outputs = (debian / steps.X_OUTPUTS.relative_to("/")).read_text()
    other = Recorded(debian, {**FRESH, "xrandr": ""})
    steps.install_player(other, say=other.told.append, restart=True, prefix=PREFIX)
    assert (debian / steps.X_OUTPUTS.relative_to("/")).read_text() == outputs
    assert other.ran[-1] == "systemctl restart velatura-agent"


def test_the_player_of_a_stage_with_other_computers_may_use_the_network(debian: Path) -> None:
    network = debian / "etc/systemd/system/velatura-player.service.d/network.conf"
    stage = debian / "var/lib/velatura/stage/stage.toml"
    stage.parent.mkdir(parents=True)
    stage.write_text('[[display.outputs]]\nname = "P1"\n')
    installed(debian, FRESH)
    assert not network.exists()
    stage.write_text('[[display.outputs]]\nname = "P1"\nhost = "left"\n')
    assert "systemctl restart velatura-controller velatura-player" in installed(debian, THERE).ran
    assert "AF_INET" in network.read_text()


def test_every_unit_and_profile_is_in_the_package() -> None:
    root = Path(firmware_configs.__file__).parent
    patterns = tomllib.loads((root.parent / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]
    packed = {path for pattern in patterns["firmware_configs"] for path in root.glob(pattern)}
    there = {path for path in root.rglob("*") if path.is_file() and path.suffix not in (".py", ".pyc")}
    assert there == packed
