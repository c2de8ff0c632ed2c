"""Find installed drivers, trackers and effects of other packages by their entry points.

A robot.toml names one by its entry point, so it can only name installed packages.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec

from bodyschema.interfaces.errors import ConfigError

from .suggest import did_you_mean
from .toml_file import line_of

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

Group = Literal["bodyschema.drivers", "bodyschema.trackers", "bodyschema.effects"]


class PluginConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The table [drivers.plugin] or [vision.plugin]."""

    name: str  # of the entry point
    settings: dict[str, Any] = {}  # passed to it unchanged
    # the files in /dev that it opens; the service grants access to no others
    devices: tuple[Annotated[str, msgspec.Meta(pattern=r"^/dev/.+\Z")], ...] = ()
    network: bool = False  # True if it uses the network, to which the service otherwise grants no access

    def check(self, _: Sequence[str], file: Path, text: str) -> None:
        """Raise ConfigError if no installed package has such a driver."""
        try:
            _entry("bodyschema.drivers", self.name)
        except ConfigError as error:
            line = line_of(text, ("drivers", "plugin"))
            raise ConfigError(error.what, file=file, line=line, remedy=error.remedy) from None


def load(group: Group, name: str) -> Any:
    """Return the object of the entry point `name` of `group`.

    Raises:
        ConfigError: no installed package has it, or it cannot be imported.
    """
    try:
        return _entry(group, name).load()
    except (ImportError, AttributeError) as error:
        raise ConfigError(
            f"the plugin {name!r} cannot be loaded: {error}", remedy="Fix or reinstall the package that it is in"
        ) from error


def installed(group: Group) -> tuple[EntryPoint, ...]:
    from importlib.metadata import entry_points

    found = tuple(entry_points(group=group))
    if found:
        from bodyschema.interfaces import old_names

        old_names.allow()
    return found


def _entry(group: Group, name: str) -> EntryPoint:
    offered = {entry.name: entry for entry in installed(group)}
    if name not in offered:
        remedy = (
            did_you_mean(name, offered) if offered else f"Install a package with an entry point in the group {group!r}"
        )
        raise ConfigError(f"no installed package has a plugin {name!r} of {group}", remedy=remedy)
    return offered[name]
