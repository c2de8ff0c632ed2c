"""A folder whose files have the names of modules that the project's processes import."""

from __future__ import annotations

import sys
from pathlib import Path

PARTS = {link.name for link in (Path(__file__).parents[2] / "bodyschema").iterdir() if link.is_symlink()}
FIRST_PARTY = {"bodyschema", "kbmaps"} | PARTS
THIRD_PARTY = {"cv2", "cyclopts", "lxml", "msgspec", "numpy", "pybullet", "rich", "scipy", "serial", "uvicorn", "zenoh"}


class HostileFolder:
    """A folder with a module of every such name; each leaves a mark when it is executed."""

    def __init__(self, folder: Path) -> None:
        self.path = folder
        for name in set(sys.stdlib_module_names) | FIRST_PARTY | THIRD_PARTY:
            text = "open(__file__ + '.executed', 'w').close()\nraise ImportError(__file__)"
            (folder / f"{name}.py").write_text(text)

    @property
    def executed(self) -> list[str]:
        """The modules that were executed."""
        return sorted(file.name for file in self.path.glob("*.executed"))
