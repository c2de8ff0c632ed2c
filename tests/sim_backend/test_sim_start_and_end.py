from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest
from guided_run import shipped

from bodyschema.interfaces.errors import ConfigError
from bodyschema.robot.description import RobotDescription
from bodyschema.robot.toml_file import read_toml
from bodyschema.sim_backend import SimConfig, SimWorld, model_file

ROOT = Path(__file__).resolve().parents[2]
LIMIT_S = 500.0  # only ends a test that would never end
HOLD_OPEN = """
import select, signal, sys
from bodyschema.robot.description import RobotDescription
from bodyschema.sim_backend import SimConfig, SimWorld, model_file
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
try:
    with SimWorld(RobotDescription.load(model_file("upper_body")), SimConfig()) as world, world.joints, world.camera:
        world.camera.read(300.0)
        print(world._renderer.process.pid, flush=True)
        # A signal that comes just before a call blocks does not end it: Python looks for signals in between only.
        while not select.select([sys.stdin], [], [], 0.05)[0]:
            pass
except KeyboardInterrupt:
    pass
"""


def run_python(code, **options):
    return subprocess.Popen(
        [sys.executable, "-W", "error", "-c", code],
        cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options,
    )  # fmt: skip


def test_a_killed_parent_leaves_no_renderer_behind():
    with run_python(HOLD_OPEN, stdin=subprocess.PIPE) as parent:
        renderer = os.pidfd_open(int(parent.stdout.readline()))
        parent.kill()
    ended, _, _ = select.select([renderer], [], [], LIMIT_S)
    os.close(renderer)
    assert ended


def test_interrupted_world_closes_its_renderer_silently():
    with run_python(HOLD_OPEN, stdin=subprocess.PIPE) as parent:
        renderer = os.pidfd_open(int(parent.stdout.readline()))
        parent.send_signal(signal.SIGINT)
        complaints = parent.stderr.read()
    ended, _, _ = select.select([renderer], [], [], LIMIT_S)
    os.close(renderer)
    assert ended
    assert (parent.returncode, complaints) == (0, "")


def test_importing_the_package_does_not_load_pybullet():
    with run_python("import sys, sim_backend; sys.exit('pybullet' in sys.modules)") as python:
        assert python.wait(LIMIT_S) == 0


def test_without_pybullet_the_remedy_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "pybullet", None)
    with pytest.raises(ConfigError, match=r"pip install 'bodyschema\[sim\]'"), SimWorld(shipped(), SimConfig()):
        pass


def test_missing_stereo_calibration_error_names_missing_keys():
    file = model_file("upper_body")
    tables, text = read_toml(file)
    for key in ("focal_px", "principal_point_px", "baseline_m", "image_size_px"):
        del tables["camera"][key]
    robot = RobotDescription.from_tables(tables, text, file)
    with pytest.raises(ConfigError, match="focal_px, principal_point_px, image_size_px"), SimWorld(robot, SimConfig()):
        pass


def test_unknown_model_error_lists_known_models():
    with pytest.raises(ConfigError, match="upper_body"):
        model_file("upper_bodi")


def test_unknown_keys_of_the_table_sim_are_refused():
    with pytest.raises(msgspec.ValidationError, match="speed"):
        msgspec.convert({"guide": {"speed": 1.0}}, SimConfig)


def test_the_table_sim_reads_from_toml():
    config = msgspec.toml.decode("seed = 4\n[camera]\nrate_hz = 25\n[errors]\ntool_m = 0.0\n", type=SimConfig)
    assert (config.seed, config.camera.rate_hz, config.errors.tool_m) == (4, 25, 0.0)
