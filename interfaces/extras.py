"""The optional parts of the installation: the packages of each, and the command that installs it."""

from __future__ import annotations

import shutil
import sys
from importlib.util import find_spec
from pathlib import Path

from bodyschema.interfaces.errors import ConfigError
from bodyschema.interfaces.interpreter import this_interpreter

# Each extra of pyproject.toml and the modules by which it is recognised.
MODULES = {
    "cameras": ("cv2",),
    "sim": ("pybullet", "cv2"),
    "plots": ("matplotlib",),
    "view": ("starlette", "uvicorn"),
    "fleet": ("distributed",),
    "bags": ("rosbags",),
    "realsense": ("pyrealsense2",),
    "av1": ("av",),
}
# These are no extras: pyrealsense2 has no wheels for some machines, and few need PyAV, which LeRobot brings.
_ALONE = {"realsense": "pyrealsense2", "av1": "av"}


def require_extra(extra: str, what: str) -> None:
    """Raise ConfigError with the install command unless the modules of `extra`, which `what` needs, are installed."""
    for module in MODULES[extra]:
        if find_spec(module) is None:
            raise missing(module, extra, what)


def missing_module(error: ModuleNotFoundError) -> ConfigError | None:
    """Return the error to report for a failed import; None for a module that no extra provides."""
    extra = next((extra for extra, modules in MODULES.items() if error.name in modules), None)
    return None if extra is None else missing(str(error.name), extra, "this")


def missing(module: str, extra: str, what: str) -> ConfigError:
    """Return the error for `what`, which needs `module`."""
    name = "OpenCV" if module == "cv2" else module
    if module == "pybullet" and (remedy := no_pybullet()):
        return ConfigError(f"{what} needs pybullet", remedy=remedy)
    return ConfigError(f"{what} needs {name}, which is not installed", remedy=f"Type: {install_command(extra)}")


def install_command(extra: str) -> str:
    """Return the command that adds an extra to this installation; it does not need a published bodyschema."""
    pip, python = shutil.which("pip"), Path(this_interpreter())
    own = pip is not None and Path(pip).absolute().parent == python.parent
    what = _ALONE.get(extra, f"'bodyschema[{extra}]'")
    return f"{'pip' if own else f'{python} -m pip'} install {what}"


def no_pybullet() -> str:
    """Return the remedy if pybullet has no wheel for this Python; empty if it has one."""
    if sys.version_info < (3, 12):
        return ""
    found = f"{sys.version_info.major}.{sys.version_info.minor}"
    return f"The simulator needs Python 3.11: pybullet has no wheel for {found}. All else works with {found}"
