"""What a newcomer meets: the wheel alone, closed and full output, no home folder, a mesh with a strange name."""

from __future__ import annotations

import json
import os
import shutil
import site
import subprocess
import sys
import sysconfig
import venv
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
pytestmark = [pytest.mark.long, pytest.mark.timeout(600)]


def environment(**changed: str) -> dict[str, str]:
    """The environment without this checkout on Python's path."""
    return {name: value for name, value in os.environ.items() if name != "PYTHONPATH"} | changed


def called(
    command: Sequence[str | Path], env: Mapping[str, str] | None = None, folder: Path | None = None
) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*map(str, command)],
        capture_output=True,
        text=True,
        env=env or environment(),
        cwd=folder,
        timeout=300,
        check=False,
    )


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built from a copy, without the network."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for name in ("controller", "hal", "plugins", "firmware_configs"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    build = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "--no-index"]
    done = called([*build, "--wheel-dir", out, source])
    assert done.returncode == 0, done.stderr
    (found,) = out.glob("*.whl")
    return found


def installed(wheel: Path, folder: Path) -> Path:
    """A new environment that has the wheel and nothing else; returns its Python."""
    venv.create(folder)
    python = folder / "bin" / "python"
    pip: list[str | Path] = [sys.executable, "-m", "pip", "--python", python]
    done = called([*pip, "install", "--quiet", "--no-deps", "--no-index", wheel])
    assert done.returncode == 0, done.stderr
    return python


def test_the_wheel_alone_has_a_help_that_names_the_extras(wheel: Path, tmp_path: Path) -> None:
    python = installed(wheel, tmp_path / "plain")
    program = python.with_name("velatura")
    lines: list[list[str | Path]] = [[program, "--help"], [program], [python, "-m", "controller", "--help"]]
    for words in lines:
        done = called(words, folder=tmp_path)
        assert (done.returncode, done.stderr) == (0, "")
        assert all(f"\n  {extra} " in done.stdout for extra in ("controller", "panel", "bench", "gphoto2", "cluster"))
        assert 'pip install "velatura[controller]"' in done.stdout
    refused = called([program, "calibrate", "x"], folder=tmp_path)
    assert (refused.returncode, refused.stdout, refused.stderr.count("\n")) == (2, "", 2)
    refused = called([program, "calibrate", "x", "--json"], folder=tmp_path)
    assert json.loads(refused.stdout)["error"]["code"] == "extra-missing"
    metadata = next((tmp_path / "plain").rglob("velatura-*.dist-info")) / "METADATA"
    assert "License-Expression: Apache-2.0" in metadata.read_text()
    assert list((tmp_path / "plain").rglob("licenses/LICENSE"))


def test_the_wheel_holds_the_product_alone(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        tops = {name.partition("/")[0] for name in archive.namelist()}
    assert {name for name in tops if not name.endswith(".dist-info")} == {
        "controller", "hal", "plugins", "firmware_configs",
    }  # fmt: skip


def test_an_uninstall_leaves_nothing(wheel: Path, tmp_path: Path) -> None:
    python = installed(wheel, tmp_path / "used")
    (packages,) = (tmp_path / "used" / "lib").glob("python*/site-packages")
    # What it needs comes from this environment.
    ours = [sysconfig.get_path("purelib"), *site.getsitepackages()]
    (packages / "others.pth").write_text("\n".join(dict.fromkeys(ours)) + "\n")
    used = environment(VELATURA_CACHE=str(tmp_path / "cache"))
    out = tmp_path / "out"
    for words in (["demo", "--prepare-only", "--out", out], ["--version"], ["kiosk", "diagnostics", out / "stage"]):
        done = called([python, "-m", "controller", *words], used, tmp_path)
        assert done.returncode == 0, done.stderr
    done = called([python, "-c", "import hal, controller.core.jit; print(hal.__file__)"], used, tmp_path)
    assert done.stdout.startswith(str(packages))
    done = called([sys.executable, "-m", "pip", "--python", python, "uninstall", "--quiet", "--yes", "velatura"])
    assert done.returncode == 0, done.stderr
    left = [path.name for path in packages.iterdir() if path.name not in ("others.pth", "__pycache__")]
    assert left == []


def shell(line: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """``velatura`` in a line of the shell stands for the program."""
    line = line.replace("velatura", f"{sys.executable} -m controller")
    return called(["bash", "-c", line], environment(PYTHONPATH=str(ROOT), XDG_STATE_HOME=str(folder / "state")), folder)


@pytest.mark.parametrize("words", ["--version", "bundle --help", "--help", "kiosk status nowhere --json"])
def test_output_that_can_not_be_written_is_told_in_two_sentences(words: str, tmp_path: Path) -> None:
    done = shell(f"velatura {words} > /dev/full", tmp_path)
    assert done.returncode == 1
    assert done.stderr.splitlines()[0] == "velatura: The output could not be written: No space left on device."
    assert done.stderr.count("\n") == 2
    assert not (tmp_path / "state").exists()


@pytest.mark.parametrize(("closed", "code"), [(">&-", 2), ("2>&-", 2), ("<&- >&- 2>&-", 2), ("<&-", 2)])
def test_closed_streams_do_no_harm(closed: str, code: int, tmp_path: Path) -> None:
    assert shell(f"velatura kiosk status nowhere {closed}", tmp_path).returncode == code
    assert shell(f"velatura --version {closed}", tmp_path).returncode == 0
    assert not (tmp_path / "state").exists()


def test_a_reader_that_goes_away_is_no_crash(tmp_path: Path) -> None:
    done = shell("velatura --help | true; exit ${PIPESTATUS[0]}", tmp_path)
    assert done.returncode in (0, 1)
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "state").exists()


def test_without_a_home_folder_everything_works_and_leaves_nothing(tmp_path: Path) -> None:
    out, temporary = tmp_path / "out", tmp_path / "tmp"
    temporary.mkdir()
    gone = ("VELATURA_CACHE", "XDG_CACHE_HOME", "XDG_STATE_HOME", "XDG_RUNTIME_DIR", "MPLCONFIGDIR", "XDG_CONFIG_HOME")
    env = {name: value for name, value in os.environ.items() if name not in gone}
    env |= {"HOME": "/proc/nowhere", "TMPDIR": str(temporary), "PYTHONPATH": str(ROOT)}
    drawing = (
        "from hal.runtime.caches import prepare_libraries; prepare_libraries()\n"
        "from controller.core.plotting import figure_of, picture_of\n"
        "figure = figure_of((1, 1), dpi=50); figure.add_subplot().set_title('x'); print(picture_of(figure).shape)"
    )
    for words in (
        ["-m", "controller", "demo", "--prepare-only", "--out", out],
        ["-m", "controller", "kiosk", "diagnostics", out / "stage"],
        ["-c", drawing],
    ):
        done = called([sys.executable, *words], env, tmp_path)
        assert (done.returncode, done.stderr) == (0, "")
    crash = "from controller.cli.error_reports import report_error; report_error(ZeroDivisionError())"
    done = called([sys.executable, "-c", crash], env, tmp_path)
    assert str(temporary) in done.stderr
    assert [path.name for path in temporary.iterdir() if not path.name.startswith(("crash-", "velatura-"))] == []


def test_make_keeps_spaces_and_quotes_of_a_mesh(tmp_path: Path) -> None:
    done = called(["make", "-n", "demo", "OBJECT=my dir/a b's $$x.obj"], folder=ROOT)
    line = next(line for line in done.stdout.splitlines() if "velatura demo" in line)
    words = called(["bash", "-c", f"printf '%s\\n' {line.partition('velatura ')[2]}"]).stdout.splitlines()
    assert words[words.index("--object") + 1] == "my dir/a b's $x.obj"
    assert words[words.index("--out") + 1] == "demo/small-a_b's_$x"
