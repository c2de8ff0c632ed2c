"""Kinematic Bézier Maps: forward kinematics that is linear in its parameters, and learners for it.

Needs only numpy and scipy: no I/O, no clock, no logging. Angles [rad], lengths [m], float64. The innermost loops are
compiled if a C compiler was present at installation: see `kernels_in_use()`. BODYSCHEMA_PURE=1 disables them.

Arrays of a wrong shape raise `ShapeError`, arrays of anything but numbers `NotNumbersError`, values that are not finite
`NonFiniteError`, matrices or quaternions that are not rotations `RotationError`, and damaged bytes `ModelFormatError`.
Docstrings name other errors.
"""

import re
from importlib import import_module
from pkgutil import get_data

__version__ = "0.1.0"

# Each public name is imported on first use: importing all of them takes 0.7 s of CPU. The list is read by way of the
# loader, since a wheel may be imported as it is, without being unpacked.
_STUB = (get_data(__name__, "__init__.pyi") or b"").decode()
_HOMES = {name: module for module, name in re.findall(r"^from (\S+) import (\w+)", _STUB, re.MULTILINE)}
__all__ = list(_HOMES)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module 'kbmaps' has no attribute {name!r}")
    found = getattr(import_module(_HOMES[name]), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
