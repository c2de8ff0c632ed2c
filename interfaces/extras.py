"""The optional parts of the installation: which packages each brings, and the command that installs it."""

from __future__ import annotations

from importlib.util import find_spec

from bodyschema.interfaces.errors import ConfigError

# Each extra of pyproject.toml and the modules by which it is recognised.
MODULES = {
    "cameras": ("cv2",),
    "sim": ("pybullet", "cv2"),
    "plots": ("matplotlib",),
    "view": ("starlette", "uvicorn"),
    "fleet": ("distributed",),
    "bags": ("rosbags",),
    "realsense": ("pyrealsense2",),
}


def require_extra(extra: str, what: str) -> None:
    """Raise ConfigError with the command to type unless the modules of `extra`, which `what` needs, are installed."""
    for module in MODULES[extra]:
        if find_spec(module) is None:
            raise missing(module, extra, what)


def missing_module(error: ModuleNotFoundError) -> ConfigError | None:
    """Return what to tell of an import that failed; None for a module that no extra brings."""
    extra = next((extra for extra, modules in MODULES.items() if error.name in modules), None)
    return None if extra is None else missing(str(error.name), extra, "this")


def missing(module: str, extra: str, what: str) -> ConfigError:
    """Return the error for `what`, which needs `module`."""
    name = "OpenCV" if module == "cv2" else module
    return ConfigError(
        f"{what} needs {name}, which is not installed", remedy=f"Type: pip install 'bodyschema[{extra}]'"
    )
