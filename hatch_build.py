"""Build the compiled kernels of kbmaps if there is a C compiler, else a pure Python wheel.

BODYSCHEMA_PURE=1 in the environment leaves them out, for a wheel that installs anywhere. CC and CFLAGS are honoured.
"""

from __future__ import annotations

import os
import shlex
import subprocess
import sysconfig
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

SOURCES = "kbmaps/csrc"
LIBRARY = "kbmaps/_kernels.abi3.so"
PACKAGE = "bodyschema"
READER = {"examples/correction/correction.py": "bodyschema/effects/exports/correction_reader.py"}
# The oldest Python whose limited API the sources use.
ABI_TAG = "cp311-abi3"
FLAGS = ["-O3", "-std=gnu11", "-fPIC", "-shared", "-fvisibility=hidden", "-fno-math-errno"]
TIMEOUT_S = 300.0


class KernelBuildHook(BuildHookInterface):
    """Adds the shared library to wheels; editable installs get it beside the sources. Mends links that came as text."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile the kernels, or report why not and leave the wheel pure Python."""
        # The maths has a pyproject.toml of its own, in its folder.
        root, place = Path(self.root), LIBRARY
        if (root / PACKAGE).is_dir():
            mend_links(root / PACKAGE)
            if version != "editable":  # `export --measured` runs the reader that users copy
                build_data["force_include"].update(READER)
        else:
            root, place = root.parent, Path(LIBRARY).name
        if os.environ.get("BODYSCHEMA_PURE", "") not in ("", "0"):
            return
        library = Path(self.root, place) if version == "editable" else Path(self._scratch()) / Path(LIBRARY).name
        complaint = compile_kernels(root / SOURCES, library)
        if complaint:
            self.app.display_warning(
                "kbmaps: no compiled kernels, its NumPy path is used instead (slower, otherwise the same). "
                f"{complaint}\n"
                "To have them: install a C compiler and Python's headers (Debian: apt install gcc python3-dev), "
                "then install again."
            )
            return
        platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
        build_data["pure_python"] = False
        build_data["tag"] = f"{ABI_TAG}-{platform}"
        if version != "editable":
            build_data["force_include"][str(library)] = place

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:  # noqa: ARG002
        """Remove the temporary files of the wheel build."""
        if self._directory is not None:
            self._directory.cleanup()

    def clean(self, versions: list[str]) -> None:  # noqa: ARG002
        """Remove the library of an editable install."""
        Path(self.root, LIBRARY).unlink(missing_ok=True)

    _directory: tempfile.TemporaryDirectory[str] | None = None

    def _scratch(self) -> str:
        self._directory = tempfile.TemporaryDirectory()
        return self._directory.name


def mend_links(folder: Path) -> None:
    """Replace files that hold a link's target, as zip archives and git without core.symlinks leave them, by links."""
    for file in folder.iterdir():
        if file.suffix or file.is_symlink() or not file.is_file():
            continue
        target = file.read_text(encoding="utf-8")
        file.unlink()
        file.symlink_to(target)


def compile_kernels(folder: Path, library: Path) -> str:
    """Compile the sources into the library; return what went wrong, or nothing."""
    library.unlink(missing_ok=True)
    compiler = shlex.split(os.environ.get("CC") or sysconfig.get_config_var("CC") or "cc")
    include = sysconfig.get_path("include")
    sources = sorted(str(path) for path in folder.glob("*.c"))
    flags = [*FLAGS, *shlex.split(os.environ.get("CFLAGS", "")), f"-I{include}"]
    command = [*compiler, *flags, *sources, "-o", str(library), "-lm"]
    try:
        result = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT_S, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"The compiler did not run: {error}."
    if result.returncode == 0:
        return ""
    errors = [line for line in result.stderr.splitlines() if "error" in line] or result.stderr.splitlines()[-1:]
    return f"{compiler[0]} failed with {result.returncode}: {errors[0] if errors else 'no message'}"
