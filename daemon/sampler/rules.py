"""Apply those settings of robot.toml to the sampler that may change while it runs."""

from __future__ import annotations

import logging
import threading

from bodyschema.daemon.config import Config, DaemonConfig
from bodyschema.daemon.sampler.devices import session_of
from bodyschema.daemon.service.reload import reload
from bodyschema.daemon.service.service import Service
from bodyschema.interfaces.errors import BodyschemaError
from bodyschema.interfaces.protocols import Clock
from bodyschema.recordings.store.retention import Keep
from bodyschema.recordings.store.store import PairStore

from .align import JointBuffer
from .devices import DeviceWatch
from .gate import Gate

log = logging.getLogger(__name__)

TABLES = ("robot", "camera", "zenoh", "daemon", "drivers", "vision", "sim", "effects", "background", "unexplained")
CHANGEABLE = {("daemon", key) for key in DaemonConfig.__struct_fields__ if key != "state_dir"}


class SamplerRules:
    """Applies robot.toml's rules to the sampler's parts; from any thread."""

    def __init__(
        self,
        config: Config,
        store: PairStore,
        devices: DeviceWatch,
        wall: Clock,
        *,
        gate: Gate,
        buffer: JointBuffer,
        deciding: threading.Lock,
    ) -> None:
        """Start with the rules of `config`.

        Args:
            deciding: held while a pair is decided on and stored, so that no pair sees half of a change.
        """
        self._config, self._store, self._devices, self._wall = config, store, devices, wall
        self._gate, self._buffer, self._deciding = gate, buffer, deciding
        self._one_at_a_time = threading.Lock()

    def reload(self) -> str:
        """Read robot.toml again and return a message about the result; sampling continues meanwhile.

        Raises:
            ConfigError: robot.toml is invalid; nothing changed.
            StoreError: the new session cannot be stored; nothing changed.
        """
        with self._one_at_a_time:
            found = reload(self._config, TABLES, CHANGEABLE)
            if found.changed:
                self._follow(found.config)
        message = found.message("sampler")
        log.info("robot.toml was read again: %s", message)
        return message

    def reload_aside(self, service: Service) -> None:
        """Run `reload` in a separate thread, because frames do not wait.

        Log the result, as the request came by a signal.
        """
        threading.Thread(target=self._reload_for, args=(service,), name="reload").start()

    def trim(self) -> None:
        """Delete a batch of the pairs that are no longer kept, if there are any.

        Raises:
            StoreError: the disk is full or broken.
        """
        with self._deciding:
            deleted = self._store.trim(_kept(self._config.tables.daemon), self._wall.utc())
        if deleted:
            log.info("the oldest %d pairs were deleted, as [daemon] keep_days and keep_mb say", deleted)

    def _follow(self, config: Config) -> None:
        session, rules = session_of(config, self._wall), config.tables.daemon
        with self._deciding:
            self._store.go_on_with(session)
            self._devices.note_again()
            self._gate.follow(rules)
            self._buffer.max_gap_s = rules.max_reading_gap_s
            self._config = config

    def _reload_for(self, service: Service) -> None:
        service.reloading()
        try:
            self.reload()
        except BodyschemaError as error:
            log.error("robot.toml was read again and is not followed: %s", error)
        finally:
            service.reloaded()


def _kept(rules: DaemonConfig) -> Keep:
    return Keep(rules.keep_days, None if rules.keep_mb is None else 1e6 * rules.keep_mb, rules.keep_newest)
