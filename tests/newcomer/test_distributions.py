"""Wheel and sdist hold the same files, no links, and coexist with a package that brings its own `daemon`."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tarfile
import venv
import zipfile
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LIMIT_S = 600.0
PURE = {**os.environ, "BODYSCHEMA_PURE": "1"}
# Named like python-daemon's package; pip removes a folder that it has emptied.
OTHER = {"daemon/__init__.py": "OTHER = True\n", "daemon/daemon.py": "", "daemon/runner.py": ""}


def build(source: Path, target: str, folder: Path, environment: Mapping[str, str] = PURE) -> Path:
    command = [sys.executable, "-m", "hatchling", "build", "-t", target, "-d", str(folder)]
    subprocess.run(command, cwd=source, env=environment, capture_output=True, check=True, timeout=LIMIT_S)
    return next(folder.glob("*.whl" if target == "wheel" else "*.tar.gz"))


def files_of(wheel: Path) -> set[str]:
    with zipfile.ZipFile(wheel) as archive:
        return {name for name in archive.namelist() if ".dist-info/" not in name}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(ROOT, "wheel", tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def sdist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(ROOT, "sdist", tmp_path_factory.mktemp("sdist"))


@pytest.fixture(scope="module")
def maths(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(ROOT / "kbmaps", "wheel", tmp_path_factory.mktemp("maths"))


def tracked() -> set[str]:
    """Return the tracked files of the parts, under their names in a wheel."""
    links = [link for link in (ROOT / "bodyschema").iterdir() if link.is_symlink()]
    files = [(file, f"bodyschema/{file.relative_to(ROOT)}") for link in links for file in (ROOT / link.name).rglob("*")]
    return {name for file, name in files if file.is_file() and "__pycache__" not in name}


def test_wheel_has_every_file_in_two_packages(wheel: Path) -> None:
    files = files_of(wheel)
    assert {name.partition("/")[0] for name in files} == {"bodyschema", "kbmaps"}
    assert tracked() <= files
    assert "bodyschema/effects/exports/correction_reader.py" in files


@pytest.mark.soak
def test_sdist_has_no_links_and_same_wheel(sdist: Path, wheel: Path, tmp_path: Path) -> None:
    with tarfile.open(sdist) as archive:
        assert [member.name for member in archive if member.issym() or member.islnk()] == []
        archive.extractall(tmp_path, filter="data")
    (source,) = tmp_path.iterdir()
    assert files_of(build(source, "wheel", tmp_path / "built")) == files_of(wheel)


def test_kbmaps_wheel_has_same_files(maths: Path, wheel: Path) -> None:
    assert files_of(maths) - {"kbmaps/LICENSE"} == {name for name in files_of(wheel) if name.startswith("kbmaps/")}
    with zipfile.ZipFile(maths) as archive:
        (name,) = [name for name in archive.namelist() if name.endswith("/METADATA")]
        told = archive.read(name).decode()
    assert re.findall(r"^Requires-Dist: ([a-z]+)", told, re.MULTILINE) == ["numpy", "scipy"]
    assert re.findall(r"^Version: (.*)", told, re.MULTILINE) == [version("bodyschema")]


def test_the_wheel_of_the_maths_computes_alone(maths: Path) -> None:
    code = "import sys, kbmaps; print(kbmaps.__file__, 'bodyschema' in sys.modules); kbmaps.KBMap"
    environment = {**PURE, "PYTHONPATH": str(maths)}
    command = [sys.executable, "-P", "-c", code]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True, timeout=LIMIT_S)
    assert done.stdout == f"{maths}/kbmaps/__init__.py False\n"


def test_the_kernels_run_on_machines_of_2018() -> None:
    """manylinux_2_28 promises glibc 2.28, and nothing beside the C library and its maths."""
    library = ROOT / "kbmaps" / "_kernels.abi3.so"
    if not library.exists():
        pytest.skip("no compiled kernels; to run it: apt install gcc python3-dev, then make setup")
    needed = {tuple(map(int, found)) for found in re.findall(rb"GLIBC_(\d+)\.(\d+)", library.read_bytes())}
    assert max(needed) <= (2, 28)
    assert set(re.findall(rb"lib\w+\.so[.\d]*", library.read_bytes())) <= {b"libc.so.6", b"libm.so.6"}


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler; to run it: apt-get install gcc python3-dev")
def test_auditwheel_finds_the_compiled_wheel_fit_for_manylinux(tmp_path: Path) -> None:
    pytest.importorskip("auditwheel", reason="no auditwheel; to run it: pip install auditwheel")
    compiled = build(ROOT / "kbmaps", "wheel", tmp_path, {**os.environ, "BODYSCHEMA_PURE": "0"})
    command = [sys.executable, "-m", "auditwheel", "show", str(compiled)]
    told = subprocess.run(command, capture_output=True, text=True, check=True, timeout=LIMIT_S).stdout
    (minor,) = re.findall(r'platform tag: "manylinux_2_(\d+)', told.replace("\n", " "))
    assert int(minor) <= 28


def test_links_that_came_as_text_are_mended(tmp_path: Path) -> None:
    """Check the case of a zip archive of the repository that pip unpacked."""
    source = tmp_path / "source"
    for name in ("interfaces", "bodyschema", "kbmaps", "examples"):
        shutil.copytree(ROOT / name, source / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "hatch_build.py", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    for link in [link for link in (source / "bodyschema").iterdir() if link.is_symlink()]:
        target = str(link.readlink())
        link.unlink()
        if link.name == "interfaces":
            link.write_text(target)
    assert "bodyschema/interfaces/errors.py" in files_of(build(source, "wheel", tmp_path / "built"))


def wheel_of_another(folder: Path) -> Path:
    """Return a wheel with a top-level package `daemon`, like python-daemon's."""
    file, info = folder / "other_daemon-1.0-py3-none-any.whl", "other_daemon-1.0.dist-info"
    named = {
        **OTHER,
        f"{info}/METADATA": "Metadata-Version: 2.1\nName: other-daemon\nVersion: 1.0\n",
        f"{info}/WHEEL": "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
    }
    with zipfile.ZipFile(file, "w") as archive:
        for name, text in {**named, f"{info}/RECORD": "".join(f"{name},,\n" for name in named)}.items():
            archive.writestr(name, text)
    return file


@pytest.mark.soak
@pytest.mark.parametrize("first", ["bodyschema", "other"])
@pytest.mark.parametrize("source", ["wheel", "sdist"])
def test_it_lives_beside_another_daemon_and_outlives_it(
    request: pytest.FixtureRequest, tmp_path: Path, source: str, first: str
) -> None:
    venv.create(tmp_path / "venv", with_pip=True, system_site_packages=True)
    python = tmp_path / "venv" / "bin" / "python"
    # The dependencies are those of the interpreter that tests; its own bodyschema is not.
    packages = next((tmp_path / "venv" / "lib").glob("*/site-packages"))
    needed = next(Path(entry) for entry in sys.path if Path(entry, "numpy").is_dir())
    (packages / "needed.pth").write_text(f"{needed}\n")

    def pip(*words: object) -> None:
        command = [python, "-m", "pip", "--disable-pip-version-check", "--quiet", *words]
        environment = {name: value for name, value in PURE.items() if name != "PYTHONPATH"}
        subprocess.run(list(map(str, command)), check=True, timeout=LIMIT_S, cwd=tmp_path, env=environment)

    def says() -> str:
        code = "import bodyschema.cli.main as c, kbmaps; print(c.__file__); c.main()"
        command = [python, "-P", "-c", code, "--version"]
        return subprocess.run(command, check=True, capture_output=True, text=True, timeout=LIMIT_S).stdout

    install = ("install", "--no-deps", "--no-build-isolation", "--no-index", "--force-reinstall")
    own, other = request.getfixturevalue(source), wheel_of_another(tmp_path)
    for package in (own, other) if first == "bodyschema" else (other, own):
        pip(*install, package)
    assert says().startswith(str(packages / "bodyschema" / "cli" / "main.py"))
    pip("uninstall", "--yes", "other-daemon")
    assert says().startswith(str(packages / "bodyschema" / "cli" / "main.py"))
