"""Read robot.toml again while a process runs: find the changes that take effect, and those that need a restart."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import msgspec
import numpy as np

from bodyschema.daemon.config import Config

Key = tuple[str, str]


@dataclass(frozen=True, slots=True)
class Reload:
    """Result of reading robot.toml again."""

    config: Config  # the configuration in force from now on; unchanged if nothing changed that can
    changed: list[str]  # settings that take effect, as in `daemon.min_step_deg = 2.0`
    needs_restart: list[str]  # settings that need a restart

    def message(self, process: str) -> str:
        """Return a summary, with the remedy."""
        parts = [f"in force now: {', '.join(self.changed)}"] if self.changed else []
        if self.needs_restart:
            restart = f"systemctl restart bodyschema-{process}@{self.config.robot.name}"
            parts.append(
                f"{', '.join(self.needs_restart)} cannot change while the {process} runs: restart it (`{restart}`, or "
                "Ctrl-C and again); no sample is lost by that"
            )
        return ". ".join(parts) or "nothing that the process knows of is other than it was"


def reload(config: Config, tables: Collection[str], changeable: Collection[Key]) -> Reload:
    """Read the robot.toml of `config` again.

    Args:
        config: the present configuration; settings overridden on the command line stay overridden.
        tables: tables that the process uses, and single keys, as in `vision.marker`.
        changeable: table and key of settings that may change while it runs.

    Raises:
        ConfigError: robot.toml is invalid now; nothing changed.
    """
    loaded = Config.load(config.file)
    if config.given_state_dir is not None:
        loaded = loaded.with_state_dir(config.given_state_dir)
    changed: list[str] = []
    needs_restart: list[str] = []
    updated: dict[str, msgspec.Struct] = {}
    for table in tables:
        then, now = _table(config, table), _table(loaded, table)
        for key in sorted(then.keys() | now.keys()):
            if then.get(key) == now.get(key):
                continue
            if (table, key) in changeable:
                changed.append(f"{table}.{key} = {msgspec.json.encode(now[key]).decode()}")
                before: msgspec.Struct = updated.get(table) or getattr(config.tables, table)
                updated[table] = msgspec.structs.replace(before, **{key: now[key]})
            else:
                needs_restart.append(f"{table}.{key}".rstrip("."))
    if not _same_arm(config, loaded):
        needs_restart.append("the URDF")
    return Reload(config.with_tables(msgspec.structs.replace(config.tables, **updated)), changed, needs_restart)


def _table(config: Config, name: str) -> dict[str, Any]:
    """Return the settings of a table, defaults included, or the value of a key."""
    described = {"robot": config.robot.robot, "camera": config.robot.camera}
    table = described[name] if name in described else attrgetter(name)(config.tables)
    if isinstance(table, msgspec.Struct):
        return msgspec.structs.asdict(table)
    return {"": table}


def _same_arm(a: Config, b: Config) -> bool:
    """Return True if both have the same chain from camera to marker, apart from robot.toml's settings."""
    if a.robot.robot != b.robot.robot or a.robot.camera != b.robot.camera:
        return True  # reported already
    arrays = ((a.robot.lower, b.robot.lower), (a.robot.upper, b.robot.upper))
    chains = ((getattr(a.robot.chain, name), getattr(b.robot.chain, name)) for name in ("fixed", "axes", "prismatic"))
    return all(np.array_equal(one, other) for one, other in (*arrays, *chains))
