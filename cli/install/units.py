"""Systemd units of sampler, learner and router: templates of the first two, and each robot's own settings."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from bodyschema.daemon.config import Config
from bodyschema.daemon.service.notify import NotifySettings
from bodyschema.daemon.transport.identity import is_local
from bodyschema.daemon.wiring.servos import configured_ports
from bodyschema.interfaces.errors import ConfigError
from bodyschema.interfaces.interpreter import module_command
from bodyschema.robot.plugins import PluginConfig

if TYPE_CHECKING:
    from .router import RouterConfig

PROCESSES = ("sampler", "learner")
FOLDER = Path("etc/systemd/system")
OWN = "robot.conf"
# First words of the drop-in of a learner of several robots; their names follow.
LEARNER_OF = "# The learner of the robots"
ROUTER = "bodyschema-router.service"
# Path prefixes that `ProtectHome=tmpfs` and `PrivateTmp=yes` hide.
HIDDEN = tuple(Path(path) for path in ("/home", "/root", "/run/user", "/tmp", "/var/tmp"))
EVERY_ADDRESS = "IPAddressAllow=any"
# systemd versions that can restart a repeatedly failing service at growing intervals.
WITH_RESTART_STEPS = 254

# zenoh asks the kernel for the machine's interfaces (netlink) and places its memory (mbind); the learner's background
# work lowers its priority (sched_setscheduler, setpriority). No RemoveIPC: it would remove the other unit's shared
# memory, of the same user.
_SANDBOX = """\
UMask=0027
NoNewPrivileges=yes
CapabilityBoundingSet=
AmbientCapabilities=
LockPersonality=yes
MemoryDenyWriteExecute=yes
PrivateMounts=yes
PrivateTmp=yes
ProcSubset=pid
ProtectClock=yes
ProtectControlGroups=yes
ProtectHome=tmpfs
ProtectHostname=yes
ProtectKernelLogs=yes
ProtectKernelModules=yes
ProtectKernelTunables=yes
ProtectProc=invisible
ProtectSystem=strict
RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6 AF_NETLINK
RestrictNamespaces=yes
RestrictRealtime=yes
RestrictSUIDSGID=yes
SystemCallArchitectures=native
SystemCallErrorNumber=EPERM
SystemCallFilter=@system-service
SystemCallFilter=~@privileged @resources
SystemCallFilter=mbind sched_setscheduler setpriority
"""
_ROUTER = """\
# Written by `bodyschema install router`; `bodyschema install router --uninstall` removes it.
[Unit]
Description=bodyschema: the router
Wants=network-online.target
After=network-online.target
# Never give up: an address that is there late is listened on.
StartLimitIntervalSec=0

[Service]
# Ready when it takes connections.
Type=notify
NotifyAccess=main
SyslogIdentifier=%N
ExecStart={command}
WatchdogSec=30
{kept_running}
User={user}
MemoryMax=1G
PrivateDevices=yes
PrivateUsers=yes
{seen}{sandbox}
[Install]
WantedBy=multi-user.target
"""
_UNIT = """\
# Written by `bodyschema install service`; `bodyschema install service --uninstall` removes it.
# What belongs to one robot is in bodyschema-{process}@ROBOT.service.d/{own}.
[Unit]
Description=bodyschema: the {process} of %i
After=network.target
# Never give up: a robot that is switched on late is found.
StartLimitIntervalSec=0

[Service]
# Ready when {ready}.
Type=notify
NotifyAccess=main
SyslogIdentifier=%N
ExecStart={command} run {process}
ExecReload=/bin/kill -HUP $MAINPID
# Fed by the loops that work, so that one which hangs starves it; the abort leaves every thread's place in the journal.
WatchdogSec={watchdog_s}
{kept_running}
# Five times what the learner takes after 60,000 samples, ten times the sampler: what grows beyond it is started again.
MemoryMax={memory_mib}M
# The store and the checkpoint.
StateDirectory=bodyschema/%i
StateDirectoryMode=0750
Environment=XDG_STATE_HOME=%S

# No other machine is reached, unless robot.toml has endpoints there.
IPAddressDeny=any
IPAddressAllow=localhost
{devices}
{sandbox}
[Install]
WantedBy=multi-user.target
"""
# Longer than the slowest round of any loop: the learner's background work took 6 s with twelve joints on a busy
# machine.
_WATCHDOG_S = {"sampler": 30, "learner": 60}


class _Settings:
    memory_mib, more_mib = 2048, 64  # a learner of 50 robots takes 16 MB for each robot


_READY = {
    "sampler": "encoders and cameras are read, the store is open and zenoh answers",
    "learner": "the checkpoint is read and zenoh answers",
}
_DEVICES = {
    "sampler": """\
# No device but the ports and cameras that robot.toml names.
DevicePolicy=closed
SupplementaryGroups=dialout video""",
    "learner": """\
PrivateDevices=yes
PrivateUsers=yes""",
}


@dataclass(frozen=True, slots=True)
class Installed:
    """The bodyschema installation that the units start."""

    command: Sequence[str]  # path of the command
    folders: Sequence[Path]  # folders of the installation
    systemd: int  # version of the machine's systemd

    @classmethod
    def here(cls, systemd: int) -> Installed:
        """Return the running installation."""
        folders = (Path(sys.prefix), Path(sys.base_prefix), Path(__file__).parents[3])
        return cls(module_command("bodyschema"), folders, systemd)


def template(process: str, installed: Installed) -> str:
    """Return the unit `bodyschema-<process>@.service`."""
    return _UNIT.format(
        process=process,
        own=OWN,
        ready=_READY[process],
        command=_command(installed.command),
        watchdog_s=_WATCHDOG_S[process],
        memory_mib=_Settings.memory_mib,
        kept_running=_kept_running(installed),
        devices=_DEVICES[process],
        sandbox=_SANDBOX,
    )


def of_robot(process: str, config: Config, user: str, installed: Installed) -> str:
    """Return `bodyschema-<process>@<robot>.service.d/robot.conf`: user, readable files and devices."""
    lines = [f"# {config.robot.name}, as {config.file.absolute()} described it.", "[Service]", f"User={user}"]
    lines.append(f"Environment={_quoted(f'BODYSCHEMA_ROBOT={config.file.absolute()}')}")
    lines += _seen([config], installed)
    if process == "sampler":
        lines += [f"DeviceAllow={_quoted(device)} rw" for device in devices_of(config)]
        if any(plugin.network for plugin in _plugins(config)) and EVERY_ADDRESS not in lines:
            lines.append(EVERY_ADDRESS)
    return "\n".join(lines) + "\n"


def of_host(configs: Sequence[Config], user: str, installed: Installed) -> str:
    """Return `bodyschema-learner@<name>.service.d/robot.conf` for one learner of several robots."""
    named = [word for config in configs for word in ("--robot", config.file.absolute())]
    names = " ".join(config.robot.name for config in configs)
    kept = " ".join(f"bodyschema/{config.robot.name}" for config in configs if config.tables.daemon.state_dir is None)
    lines = [
        f"{LEARNER_OF} {names}",
        "[Unit]",
        f"Description=bodyschema: the learner of {len(configs)} robots (%i)",
        "[Service]",
        f"User={user}",
        f"MemoryMax={_Settings.memory_mib + _Settings.more_mib * len(configs)}M",
        "ExecStart=",
        f"ExecStart={_command([*installed.command, 'run', 'learner', *named])}",
        "StateDirectory=",
        *([f"StateDirectory={kept}"] if kept else []),
        *_seen(configs, installed),
    ]
    return "\n".join(lines) + "\n"


def of_router(config: RouterConfig, user: str, installed: Installed) -> str:
    """Return the unit `bodyschema-router.service`."""
    file = config.file.absolute()
    seen = hidden([*installed.folders, file.parent, *(path.parent for path in config.identity.files)])
    return _ROUTER.format(
        command=_command([*installed.command, "router", file]),
        user=user,
        kept_running=_kept_running(installed),
        seen="".join(f"BindReadOnlyPaths={_bound(path)}\n" for path in seen),
        sandbox=_SANDBOX,
    )


def devices_of(config: Config) -> list[str]:
    """Return the ports and cameras that robot.toml names, each once, and those of plug-in drivers and trackers."""
    cameras = config.tables.vision.cameras
    named = [*configured_ports(config).values(), *({} if cameras is None else cameras.devices).values()]
    named += [device for further in config.tables.vision.further_cameras for device in further.devices.values()]
    named += [device for plugin in _plugins(config) for device in plugin.devices]
    return list(dict.fromkeys(name for name in named if name.startswith("/dev/")))


def _plugins(config: Config) -> list[PluginConfig]:
    tables = config.tables
    return [plugin for plugin in (tables.drivers.plugin, tables.vision.plugin) if plugin is not None]


def endpoints_of(config: Config) -> list[str]:
    """Return the endpoints that the two processes listen on or connect to."""
    zenoh, ros2 = config.tables.zenoh, config.tables.drivers.ros2
    routers = [zenoh.router, "" if ros2 is None else ros2.router]
    sources = [table.endpoint for table in config.tables.marker_source]
    return [zenoh.sampler, zenoh.learner, *(router for router in routers if router), *sources]


def folders_of(config: Config) -> list[Path]:
    """Return the folders of robot.toml and of the files that it names."""
    tables, home = config.tables, config.file.absolute().parent
    cameras, unexplained = tables.vision.cameras, tables.unexplained
    named = [
        tables.drivers.recording,
        None if cameras is None else cameras.calibration,
        None if unexplained is None else unexplained["model"],
        *tables.zenoh.files,
    ]
    files = [config.file, config.robot.tree.file, *(home / name for name in named if name is not None)]
    return [Path(os.path.abspath(file)).parent for file in files]


def hidden(folders: Iterable[Path]) -> list[Path]:
    """Return those of `folders` that a service sees only by an explicit rule, without those inside others."""
    found = sorted({Path(os.path.abspath(folder)) for folder in folders})
    seen = [folder for folder in found if any(folder.is_relative_to(hiding) for hiding in HIDDEN)]
    return [folder for folder in seen if not any(folder.is_relative_to(other) for other in seen if other != folder)]


def _seen(configs: Sequence[Config], installed: Installed) -> list[str]:
    """Return the lines for files and network that a service of these robots needs beyond the template."""
    folders = [*installed.folders, *(folder for config in configs for folder in folders_of(config))]
    lines = [f"BindReadOnlyPaths={_bound(path)}" for path in hidden(folders)]
    states = [config.state_dir for config in configs if config.tables.daemon.state_dir is not None]
    for state in dict.fromkeys(states):
        lines.append(f"{'BindPaths' if hidden([state]) else 'ReadWritePaths'}={_bound(state)}")
    if not all(is_local(endpoint) for config in configs for endpoint in endpoints_of(config)):
        lines.append(EVERY_ADDRESS)
    return lines


def _bound(path: Path) -> str:
    """Return the path as optional: if it is missing, the process reports it; systemd would say 226/NAMESPACE."""
    return _quoted(f"-{path}")


def _kept_running(installed: Installed) -> str:
    """Return the settings for restarting a process that hung or ended."""
    steps = ["RestartSec=5"]
    if installed.systemd >= WITH_RESTART_STEPS:
        steps = ["RestartSec=1", "RestartSteps=6", "RestartMaxDelaySec=60"]
    times = [f"TimeoutStartSec={NotifySettings.start_limit_s}", "TimeoutStopSec=30"]
    return "\n".join(["WatchdogSignal=SIGABRT", *times, "KillMode=mixed", "Restart=on-failure", *steps])


def _command(words: Iterable[object]) -> str:
    """Return a command line for systemd.service(5), where a dollar sign starts a variable."""
    return " ".join(_quoted(str(word).replace("$", "$$")) for word in words)


def _quoted(word: object) -> str:
    """Quote a word for a unit file by systemd.syntax(7): a percent sign starts a specifier, a colon another path.

    Raises:
        ConfigError: it has a character that ends a line, or is not valid in text.
    """
    text = str(word).replace("%", "%%")
    if not text.isprintable():
        raise ConfigError(f"{str(word)!r} cannot stand in a unit of systemd", remedy="Rename the file or folder")
    if not re.search(r"[\s\"'\\:;#]", text):
        return text
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'
