"""What was measured, in a JSON file that later runs, and runs beside this one, add to."""

from __future__ import annotations

import json
import os
from collections.abc import Collection
from pathlib import Path

from benchmarks.goals.study import Study, Values


class Results:
    """Values by study and seed.

    Args:
        path: the file; it need not exist.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._seeds = _read(path)
        self._forgotten: set[str] = set()

    def __contains__(self, job: tuple[Study, int]) -> bool:
        study, seed = job
        return str(seed) in self._seeds.get(study.key, {})

    def add(self, study: Study, seed: int, values: Values) -> None:
        self._seeds.setdefault(study.key, {})[str(seed)] = {name: float(value) for name, value in values.items()}

    def forget(self, studies: Collection[Study]) -> None:
        """Drops what is known of some studies, to measure them again."""
        for study in studies:
            self._seeds.pop(study.key, None)
            self._forgotten.add(study.key)

    def values(self) -> dict[str, list[Values]]:
        """What the seeds gave, by study."""
        return {key: list(seeds.values()) for key, seeds in self._seeds.items()}

    def save(self) -> None:
        """Adds what another run has saved in the meantime, and replaces the file as a whole."""
        for key, seeds in _read(self._path).items():
            if key not in self._forgotten:
                self._seeds[key] = seeds | self._seeds.get(key, {})
        self._forgotten.clear()
        part = self._path.with_suffix(f".{os.getpid()}.part")
        part.write_text(json.dumps(self._seeds, indent=None, separators=(",", ":")))
        os.replace(part, self._path)


def _read(path: Path) -> dict[str, dict[str, Values]]:
    return json.loads(path.read_text()) if path.exists() else {}
