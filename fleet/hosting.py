"""Robots of one learner host, and their distribution over processes."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path

from bodyschema.daemon.config import Config
from bodyschema.daemon.learner.host import session_settings
from bodyschema.daemon.service.signals import on_termination
from bodyschema.daemon.service.supervise import Child, Supervisor
from bodyschema.interfaces.errors import ConfigError
from bodyschema.interfaces.interpreter import module_command
from bodyschema.robot.limited import read_at_most


def descriptions(named: Sequence[Path]) -> list[Path]:
    """Return descriptions of robots, each once: the named files, and those in named folders and their subfolders.

    In a folder, TOML files with a table `[robot]` count, because calibrations and other files are there too. In a
    subfolder, only its robot.toml counts.

    Raises:
        ConfigError: a folder has none.
    """
    found: list[Path] = []
    for path in named:
        inside = [path]
        if os.path.isdir(path):  # False also without permission: reading it reports the reason
            inside = sorted([*filter(_describes_a_robot, path.glob("*.toml")), *path.glob("*/robot.toml")])
        if not inside:
            raise ConfigError("no robot.toml is in this folder", file=path, remedy="Name the robots' descriptions")
        found += inside
    return list(dict.fromkeys(found))


def _describes_a_robot(file: Path) -> bool:
    try:
        return re.search(r"^\s*\[robot\]", read_at_most(file).decode("utf-8"), re.MULTILINE) is not None
    except (OSError, UnicodeDecodeError):
        return True  # reading it as a description reports what is wrong


def configs_of(files: Sequence[Path], state_dir: Path | None) -> list[Config]:
    """Return the robots, with their states in `state_dir` if given, each in its own folder if there are several.

    Raises:
        ConfigError: a description is wrong, or of a robot that cannot be learnt.
    """
    configs = [Config.load(file) for file in files]
    for config in configs:
        config.require_learnable()
    if state_dir is None:
        return configs
    if len(configs) == 1:
        return [configs[0].with_state_dir(state_dir)]
    return [config.with_state_dir(state_dir / config.robot.name) for config in configs]


def shares(configs: Sequence[Config], processes: int) -> list[list[Config]]:
    """Distribute the robots over at most `processes` shares of similar size; robots of one endpoint stay together.

    Raises:
        ConfigError: there are fewer endpoints than processes.
    """
    by_endpoint: dict[str, list[Config]] = {}
    for config in configs:
        by_endpoint.setdefault(config.tables.zenoh.learner, []).append(config)
    if len(by_endpoint) < processes:
        raise ConfigError(
            f"{processes} processes cannot share the {len(by_endpoint)} endpoints of these robots' learners",
            remedy="Give each robot a `learner` of its own in [zenoh], or fewer --processes",
        )
    parts: list[list[Config]] = [[] for _ in range(processes)]
    for group in sorted(by_endpoint.values(), key=len, reverse=True):
        min(parts, key=len).extend(group)
    return parts


def spread(configs: Sequence[Config], processes: int, options: Sequence[str]) -> None:
    """Learn in several processes, each with its share of the robots, until SIGTERM or Ctrl-C.

    Raises:
        ConfigError: they cannot be distributed, or one process cannot serve its share.
        BodyschemaError: a process refused to start.
    """
    children: list[Child] = []
    for number, share in enumerate(shares(configs, processes), 1):
        session_settings(share)  # refuse here what would end the process
        command = module_command("bodyschema", "run", "learner", *options)
        for config in share:
            command += ["--robot", str(config.file)]
        if share[0].given_state_dir is not None:
            folder = share[0].given_state_dir
            command += ["--state-dir", str(folder if len(share) == 1 else folder.parent)]
        children.append(Child(f"learner {number}", command))
    supervisor = Supervisor(children)
    with on_termination(supervisor.stop):
        supervisor.run()
