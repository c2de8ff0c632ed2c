"""Support the import names that plug-ins used before the prefix `bodyschema` or a move, for one release."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType

HOME = Path(__file__).resolve().parents[1]
# the parts that docs/extending.md told plug-ins to import from
PARTS = ("drivers", "effects", "interfaces", "vision")
# modules that are elsewhere now
PLACES = {
    "bodyschema.vision.tracker": "bodyschema.vision.ball.tracker",
    "vision.tracker": "bodyschema.vision.ball.tracker",
    **{
        f"interfaces.{name}": f"bodyschema.robot.{name}"
        for name in (
            *("calibrated", "calibrated_files", "limited", "plugins"),
            *("pointing", "rpy", "suggest", "toml_file", "toml_text", "urdf"),
        )
    },
    "interfaces.interval": "bodyschema.vision.calibration.report.page",
    "interfaces.robot": "bodyschema.robot.description",
    "interfaces.recording": "bodyschema.recordings.recording",
    "interfaces.recording_columns": "bodyschema.recordings.columns",
    "interfaces.recording_csv": "bodyschema.recordings.csv_file",
    "interfaces.recording_parquet": "bodyschema.recordings.parquet_file",
}


class OldNames(MetaPathFinder):
    """Finder of moved modules, and of `interfaces.camera` as `bodyschema.interfaces.camera`.

    A package of this name that is not ours is left alone.
    """

    def find_spec(
        self,
        fullname: str,
        path: Sequence[str] | None = None,  # noqa: ARG002
        target: ModuleType | None = None,  # noqa: ARG002
    ) -> ModuleSpec | None:
        """Return the spec of one of our modules that is imported by its old name."""
        part = fullname.partition(".")[0]
        if not (part == "bodyschema" and fullname in PLACES) and (part not in PARTS or _is_anothers(part)):
            return None
        present = PLACES.get(fullname, f"bodyschema.{fullname}")
        warnings.warn(
            f"a plug-in imports {fullname}, which is {present} now: the next release has no other name",
            FutureWarning,
            stacklevel=2,
        )
        return ModuleSpec(fullname, _Alias(present))


class _Alias(Loader):
    """Loader that returns the module loaded under its full name, so that it is loaded once."""

    def __init__(self, name: str) -> None:
        self._name = name

    def create_module(self, spec: ModuleSpec) -> ModuleType:  # noqa: ARG002
        module = import_module(self._name)
        self._spec = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        module.__spec__ = self._spec


def allow() -> None:
    """Allow plug-ins loaded from now on to import by the old names, each with a FutureWarning."""
    if not any(isinstance(finder, OldNames) for finder in sys.meta_path):
        sys.meta_path.insert(0, OldNames())


def _is_anothers(part: str) -> bool:
    found = PathFinder.find_spec(part)
    return found is not None and (found.origin is None or Path(found.origin).resolve().parent != HOME / part)
