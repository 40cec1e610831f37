"""A house with stages that really join it over the loopback: its page, its orders, its log and its backups."""

from __future__ import annotations

import contextlib
import hashlib
import json
import re
import subprocess
import sys
import threading
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from importlib import metadata
from pathlib import Path

import pytest

from controller.bundle.signing import write_public_key
from controller.cli.kiosk_process import serve
from controller.core.errors import UsageError, VelaturaError, WorkError
from controller.kiosk.api.control import call_kiosk
from controller.kiosk.house.house import House, HouseSettings, house_settings
from controller.kiosk.house.member import Member
from controller.kiosk.install.system import System
from controller.kiosk.install.update import OFFERED, sign_package
from controller.kiosk.operations import house as operations
from controller.kiosk.operations.dispatch import CALLER
from controller.kiosk.operations.table import compute
from controller.kiosk.state import DriftCheck
from controller.kiosk.store import archive
from controller.run.progress import Silent
from hal.notices import Level
from tests.controller.kiosk.install.test_update import KEY, OTHER_KEY, debian_package
from tests.controller.kiosk.vase import vase
from tests.controller.panel.memory_kiosk import MemoryKiosk
from tests.controller.panel.served import PASSWORD, Served, csrf, served
from tests.controller.panel.test_uploads import png_of
from tests.ports import free_port
from tests.waiting import wait_for


class Reports(Silent):
    """Keeps the texts."""

    def __init__(self) -> None:
        self.texts: list[str] = []

    def say(self, text: str, level: Level = Level.INFO) -> None:
        self.texts.append(text)


class Museum:
    """A house and its stages. Each stage is a kiosk in memory with the folder of a real one."""

    def __init__(self, folder: Path, groups: Mapping[str, list[str]], names: tuple[str, ...]) -> None:
        self.folder, self.stack = folder, contextlib.ExitStack()
        self.recorded: list[tuple[str, str]] = []
        (folder / "backups").mkdir()
        self.settings = HouseSettings(
            name="City museum", groups=dict(groups), addresses=["127.0.0.1"], port=free_port(),
            backups=folder / "backups", keep=2,
        )  # fmt: skip
        self.kiosks: dict[str, MemoryKiosk] = {}
        self.members: dict[str, Member] = {}
        self.house = self.stack.enter_context(self.opened())
        for name in names:
            self.join(name)
        wait_for(lambda: all(one.linked and one.state for one in self.house.now().stages))

    def opened(self) -> House:
        return House(
            self.folder / "house", self.settings, lambda code, what, level: self.recorded.append((code, what)),
            host="127.0.0.1",
        )  # fmt: skip

    def join(self, name: str) -> None:
        kiosk = self.kiosks[name] = MemoryKiosk(self.folder / name / "pictures")
        port = free_port()
        computer = System(lambda line: None, root=self.folder / name / "root")
        stage = vase(self.folder / name / "stage")
        member = self.members[name] = Member(kiosk, stage, host="127.0.0.1", port=port, computer=computer)
        self.stack.enter_context(member)
        self.house.admit(f"127.0.0.1:{port}", member.invite(name).code)

    def stage(self, name: str) -> operations.StageNow:
        return next(one for one in self.house.now().stages if one.name == name)


@pytest.fixture
def museum(tmp_path: Path) -> Iterator[Museum]:
    made = Museum(tmp_path, {"east wing": ["knight", "vase"]}, ("bust", "knight", "vase"))
    with made.stack:
        yield made


@contextlib.contextmanager
def page(museum: Museum, needs_setup: bool = False) -> Iterator[Served]:
    kiosk = MemoryKiosk(museum.folder / "own pictures")
    kiosk.change(needs_setup=needs_setup)
    house = operations.House(open=lambda: museum.house)
    with served(kiosk, museum.folder / "private", house=house) as panel:
        yield panel


def test_the_house_knows_what_each_stage_is_and_shows_those_with_problems_first(museum: Museum) -> None:
    for name in ("bust", "vase"):
        museum.kiosks[name].change(devices=(), state="playing")
    museum.kiosks["knight"].change(drifts=(DriftCheck("night", 1.8e9, "full", 4.5),), state="fault", reason="Burnt.")
    wait_for(lambda: (state := museum.stage("knight").state) is not None and state.state == "fault")
    wait_for(lambda: [one.urgency for one in museum.house.now().stages] == [2, 0, 0])
    assert [one.name for one in museum.house.now().stages] == ["knight", "bust", "vase"]
    knight = museum.stage("knight")
    assert knight.groups == ("east wing",)
    state = knight.state
    assert state is not None
    assert (state.state, state.drifts[0].moved_px, state.dose_klx_h) == ("fault", 4.5, 12.34)
    assert [(one.projector, one.lit) for one in state.lamps] == [("left", True), ("right", False)]
    wait_for(lambda: museum.house.picture("knight"))
    picture = museum.house.picture("knight")
    assert picture is not None
    assert picture.startswith(b"\xff\xd8")
    assert len(picture) < 4000


def test_orders_reach_one_a_group_or_all_and_stand_in_the_stages_own_log(museum: Museum) -> None:
    CALLER.set("vera")
    kiosks = museum.kiosks
    museum.house.do("all", "close")
    assert {one.snapshot().state for one in kiosks.values()} <= {"off", "cooling"}
    museum.house.do("east wing", "play", name="warm wood")
    assert [kiosks[name].snapshot().playing for name in ("knight", "vase")] == ["warm wood"] * 2
    assert kiosks["bust"].snapshot().state in ("off", "cooling")
    assert any("vera at the house City museum" in text for _, text in kiosks["vase"].recorded)
    with pytest.raises(UsageError) as caught:
        museum.house.do("west wing", "open")
    assert caught.value.code == "house-stages-unknown"


def test_a_new_appearance_is_asked_of_a_group_and_each_stage_computes_its_own(museum: Museum) -> None:
    picture, name = png_of(4, 2, zlib.compress(bytes(2 * (1 + 3 * 4)))), "new-wood"
    with page(museum, needs_setup=True) as panel, panel.entered("otto") as otto:
        form = {"csrf": csrf(otto.get("/house").text)}
        uploaded = otto.post("/do/upload-target", data=form, files={"file": ("wood.png", picture)})
        target = uploaded.headers["location"]
        text = otto.get(target).text
        assert 'value="wood"' in text
        assert "What the object will look like" not in text, "this kiosk has no stage of its own"
        form |= {"target": target.rsplit("/", 1)[1], "stages": "east wing", "fit": "fill"}
        again = otto.post("/do/house-compute", data={**form, "name": "../wood"})
        assert (again.status_code, again.headers.get("location")) != (303, "/house")
        assert otto.post("/do/house-compute", data={**form, "name": name}).headers["location"] == "/house"
    for one in ("knight", "vase"):
        kiosk = museum.kiosks[one]
        assert ("compute", (name, b"\x89PNG")) in kiosk.asked
        wait_for(lambda kiosk=kiosk: name in [row.name for row in kiosk.appearances()])  # type: ignore[misc]
        assert any(f"otto at the house City museum: {compute.about} ({name})" in text for _, text in kiosk.recorded)
    assert not [asked for asked in museum.kiosks["bust"].asked if asked[0] == "compute"]
    no_picture = museum.folder / "house.toml"
    no_picture.write_text("name = 3")
    with pytest.raises(WorkError, match="vase: The target can't be used"):
        museum.house.do("vase", "compute", target=no_picture, name=name, fit="fit")


def test_one_stage_that_fails_stops_no_other(museum: Museum) -> None:
    museum.members["bust"].leave()
    wait_for(lambda: not museum.stage("bust").linked)
    with pytest.raises(WorkError) as caught:
        museum.house.do("all", "play", name="warm wood")
    assert caught.value.code == "house-order-failed"
    assert "1 of 3" in caught.value.what
    assert [museum.kiosks[name].snapshot().playing for name in ("knight", "vase")] == ["warm wood"] * 2
    with pytest.raises(WorkError, match="There is no"):
        museum.house.do("knight", "play", name="no such thing")


@pytest.mark.parametrize("verb", ["save-settings", "restore", "recalibrate", "add-account", "backup", ""])
def test_a_house_can_only_change_what_is_shown(museum: Museum, verb: str) -> None:
    with pytest.raises(WorkError, match="no such verb"):
        museum.house.do("vase", verb, text="x")


def test_a_stage_needs_nothing_of_its_house(museum: Museum) -> None:
    museum.house.__exit__()
    kiosk = museum.kiosks["vase"]
    kiosk.play("warm wood")
    kiosk.note("warning", "It rains in.", "rain")
    with museum.opened() as again:
        wait_for(lambda: all(one.linked and one.state is not None for one in again.now().stages))
        state = next(one for one in again.now().stages if one.name == "vase").state
        assert state is not None
        assert state.playing == "warm wood"
        wait_for(lambda: any(row.event.text == "It rains in." for row in again.events()))


def test_the_log_has_each_event_of_all_stages_once(museum: Museum) -> None:
    museum.kiosks["vase"].note("error", "A lamp burst.", "lamp")
    museum.kiosks["bust"].note("info", "Somebody waved.", "wave")
    wait_for(lambda: {"A lamp burst.", "Somebody waved."} <= {row.event.text for row in museum.house.events()})
    rows = [(row.stage, row.event.number) for row in museum.house.events()]
    assert len(set(rows)) == len(rows)
    assert {stage for stage, _ in rows} == {"bust", "knight", "vase"}


def test_a_removed_stage_is_gone_and_plays_on(museum: Museum) -> None:
    museum.house.remove("bust")
    wait_for(lambda: [one.linked for one in museum.house.now().stages] == [True, True])
    museum.kiosks["bust"].change(state="fault")
    with pytest.raises(UsageError):
        museum.house.picture("bust")
    with pytest.raises(UsageError):
        museum.members["knight"].invite("knight-2")
    assert museum.kiosks["bust"].snapshot().playing == "marble"


def test_the_backups_of_all_stages_are_in_one_place(museum: Museum, monkeypatch: pytest.MonkeyPatch) -> None:
    stage = museum.folder / "vase" / "stage"
    monkeypatch.setattr(museum.kiosks["vase"], "backup", lambda **_: archive.backup(stage))
    monkeypatch.setattr("controller.stage.link.transfer.PART_BYTES", 1000)
    file = museum.house.fetch_backup("vase")
    archive.check_backup(file)
    assert file.parent == museum.folder / "backups" / "vase"
    assert [one.name for one in file.parent.iterdir()] == [file.name]
    assert museum.stage("vase").backup_unix_s == pytest.approx(file.stat().st_mtime)
    before = file.read_bytes()
    monkeypatch.setattr(museum.kiosks["vase"], "backup", lambda **_: museum.folder / "nothing")
    with pytest.raises(WorkError):
        museum.house.fetch_backup("vase")
    assert file.read_bytes() == before


def test_an_update_goes_to_one_stage_and_to_the_others_once_that_is_well(
    museum: Museum, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    roots = {name: tmp_path / name / "root" for name in ("knight", "vase")}
    offered = {name: root / OFFERED.relative_to("/") for name, root in roots.items()}
    for root in roots.values():
        (root / "opt").mkdir()
        (root / "etc/velatura/update-keys").mkdir(parents=True)
        write_public_key(root / "etc/velatura/update-keys/house.pub", bytes(KEY.verify_key))
    with pytest.raises(UsageError, match=r"update\.deb"):
        museum.house.update("east wing")
    changelog = f"## 2\n\n- It <sings>.\n\n## {metadata.version('velatura')}\n\n- It hums.\n"
    package = debian_package(tmp_path, "2-1", changelog=changelog).rename(tmp_path / "house/update.deb")
    digest = hashlib.sha256(package.read_bytes()).hexdigest()

    def tell(name: str, state: str) -> None:
        told = {"name": digest, "state": state, "why": "It is dark."}
        (roots[name] / "opt/velatura.update").write_text(json.dumps(told))
        museum.kiosks[name].note("info", state)
        wait_for(lambda: museum.stage(name).update.startswith(state))

    first, *new = museum.house.plan("east wing")
    assert re.match(r"Version 2-1 goes to knight .* proved itself there: vase", first)
    assert new == ["It <sings>."]
    with page(museum) as panel, panel.entered("tina", PASSWORD) as tina:
        text = tina.get("/house/update").text
        assert "Version 2-1" in text
        assert "<li>It &lt;sings&gt;.</li>" in text
        assert "It hums" not in text
        form = {"csrf": csrf(text), "stages": "east wing"}
        assert "Update east wing?" in tina.post("/do/house-update", data=form).text
        assert tina.post("/do/house-update", data={**form, "sure": "yes"}).headers["location"] == "/house/update"
        text = tina.get("/house/update").text
        assert re.findall(r"<h2>(\w+)(?: <small>(\w+)</small>)?</h2>", text) == [
            ("knight", "first"),
            ("vase", ""),
            ("bust", ""),
        ]
        wait_for(lambda: "Gets the package" in tina.get("/house/update").text)
        assert "Waits" in text
        # It can be stopped, and begun again.
        assert tina.post("/do/house-update-stop", data={"csrf": form["csrf"]}).headers["location"] == "/house/update"
        assert not museum.house.rollout().begun
        assert "Begin the update" in tina.get("/house/update").text
    museum.house.update("east wing")
    wait_for(offered["knight"].exists)
    assert offered["knight"].read_bytes() == package.read_bytes()
    hashed: list[Path] = []
    monkeypatch.setattr("controller.kiosk.house.house.sha256_of", hashed.append)
    for state in ("trial", "done"):
        assert not offered["vase"].exists()
        tell("knight", state)
        museum.house.roll_out()
    assert hashed == [], "it was hashed once"
    assert offered["vase"].read_bytes() == package.read_bytes()
    tell("vase", "failed")
    museum.house.roll_out()
    assert museum.recorded[-1] == (
        "house-update-failed",
        "The update goes to no more stages. vase went back. It is dark.",
    )
    monkeypatch.undo()
    # What a stage does not trust ends it, too.
    sign_package(package, OTHER_KEY, package)
    museum.house.update("vase")
    wait_for(lambda: "No key that this computer trusts" in museum.recorded[-1][1])
    assert not museum.house.rollout().begun


def test_the_page_has_every_stage_and_asks_before_it_closes_all(museum: Museum) -> None:
    wait_for(lambda: museum.house.picture("vase"))
    with page(museum) as panel, panel.entered("otto") as otto:
        assert otto.get("/see/house/stages/vase/picture").content.startswith(b"\xff\xd8")
        text = otto.get("/house").text
        assert re.findall(r"<h2>(\w+)</h2>", text) == ["bust", "knight", "vase"]
        form = {"csrf": csrf(text), "stages": "all"}
        assert "Close all?" in otto.post("/do/house-close", data=form).text
        assert museum.kiosks["vase"].snapshot().state == "playing"
        assert otto.post("/do/house-close", data={**form, "sure": "yes"}).headers["location"] == "/house"
        assert museum.kiosks["vase"].snapshot().state != "playing"
        wait_for(lambda: "house-open" in otto.get("/late/house").text)
        assert otto.post("/do/house-remove", data={"csrf": csrf(text), "member": "vase"}).status_code == 403


def test_a_viewer_looks_and_changes_nothing(museum: Museum) -> None:
    with page(museum, needs_setup=True) as panel, panel.entered("vera") as vera:
        first = vera.get("/")
        assert (first.status_code, first.headers["location"]) == (303, "/house")
        text = vera.get("/house").text
        assert "/do/house" not in text
        assert vera.post("/do/house-open", data={"csrf": csrf(text), "stages": "all"}).status_code == 403


def test_a_stage_shows_its_code_on_its_page(tmp_path: Path) -> None:
    kiosk = MemoryKiosk(tmp_path / "pictures")
    with Member(kiosk, vase(tmp_path / "stage"), host="127.0.0.1", port=free_port()) as member:
        house = operations.House(member=lambda: member)
        with served(kiosk, tmp_path / "private", house=house) as panel, panel.entered("tina", PASSWORD) as tina:
            text = tina.get("/house").text
            tina.post("/do/house-join", data={"csrf": csrf(text), "name": "vase"})
            assert re.search(r"\b[0-9]{4}-[0-9]{4}\b", tina.get("/house").text)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "name"),
        ('name = "x"\nport = 0', "port"),
        ('name = "x"\ngroups = 3', "groups"),
        ('name = "x"\nnonsense = 1', "nonsense"),
        ('name = "x"\nbackup_at = "25:00"', "backup_at"),
        ("name = ", "can't be used"),
    ],
)
def test_a_wrong_house_toml_names_the_key(tmp_path: Path, text: str, says: str) -> None:
    assert house_settings(tmp_path) is None
    (tmp_path / "house.toml").write_text(text)
    with pytest.raises(UsageError, match=says) as caught:
        house_settings(tmp_path)
    assert caught.value.code == "house-toml-wrong"


@pytest.mark.slow
def test_a_wrong_house_toml_keeps_no_stage_dark(tmp_path: Path) -> None:
    stage, cancel, heard = vase(tmp_path / "stage"), threading.Event(), Reports()
    (stage / "house.toml").write_text("name = 3")
    work = threading.Thread(
        target=serve, daemon=True,
        kwargs={"stage": stage, "panel": None, "leave_lit": False, "setup": False, "reporter": heard, "cancel": cancel},
    )  # fmt: skip
    work.start()
    wait_for(lambda: any("is running" in text for text in heard.texts))
    assert any("house.toml can't be used: name" in text for text in heard.texts)
    with pytest.raises(VelaturaError) as caught:
        call_kiosk(stage, "house")
    assert caught.value.code == "house-toml-wrong"
    cancel.set()
    work.join(60)


@pytest.mark.slow
def test_a_kiosk_by_itself_does_not_load_zenoh() -> None:
    code = (
        "import sys; import controller.cli.kiosk_process, controller.panel.app, controller.cli.commands.kiosk; "
        "assert not {'zenoh', 'spake2', 'controller.stage.link'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_what_needs_a_person_comes_first(museum: Museum) -> None:
    stage = museum.stage("vase")
    assert stage.state is not None
    well = replace(stage, state=replace(stage.state, devices=(), failures=(), warnings=(), drifts=()))
    assert well.urgency == 0
    assert replace(well, linked=False).urgency == 2
    assert replace(well, state=None).urgency == 2
    drifted = replace(stage.state, devices=(), drifts=(DriftCheck("x", 1.0, "quick", 1.0),))
    assert replace(well, state=drifted).urgency == 1
