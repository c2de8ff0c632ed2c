"""Measured results in a JSON file that later and concurrent runs extend."""

from __future__ import annotations

import json
import os
from collections.abc import Collection
from pathlib import Path

from benchmarks.goals.study import Study, Values


class Results:
    """Values by study and seed.

    Args:
        path: the file, which need not exist.
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
        """Drop the results of some studies, to measure them again."""
        for study in studies:
            self._seeds.pop(study.key, None)
            self._forgotten.add(study.key)

    def values(self) -> dict[str, list[Values]]:
        """Return the values of all seeds, by study."""
        return {key: list(seeds.values()) for key, seeds in self._seeds.items()}

    def save(self) -> None:
        """Merge the results that another run has saved meanwhile, and replace the file atomically."""
        for key, seeds in _read(self._path).items():
            if key not in self._forgotten:
                self._seeds[key] = seeds | self._seeds.get(key, {})
        self._forgotten.clear()
        part = self._path.with_suffix(f".{os.getpid()}.part")
        part.write_text(json.dumps(self._seeds, indent=None, separators=(",", ":")))
        os.replace(part, self._path)


def _read(path: Path) -> dict[str, dict[str, Values]]:
    return json.loads(path.read_text()) if path.exists() else {}
