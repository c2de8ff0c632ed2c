"""Run the sampler: marker fixes and joint readings in, pairs into the store and onto zenoh."""

from __future__ import annotations

import logging
import math
import threading
import time
from contextlib import ExitStack
from importlib.metadata import version

import numpy as np

from bodyschema.daemon.config import Config
from bodyschema.daemon.sampler.devices import DeviceWatch, SamplerRules, Servos, accept_turns
from bodyschema.daemon.service.service import Service, with_health
from bodyschema.daemon.service.signals import tell_parent_serving
from bodyschema.daemon.transport.keys import Keys
from bodyschema.daemon.transport.session import Request, ZenohSession
from bodyschema.daemon.transport.status import SamplerStatus
from bodyschema.daemon.transport.wire import CommandReply, CommandRequest, decode, encode, pair_to_wire
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import ConfigError, RequestError, SourceEnded
from bodyschema.interfaces.records import FloatArray, JointReading, MarkerFix, MarkerMiss, Reason
from bodyschema.interfaces.waits import Waits
from bodyschema.recordings.store.file import LOW_DISK_BYTES, disk_free
from bodyschema.recordings.store.store import PairStore

from .align import JointBuffer
from .counters import SamplerCounters
from .gate import PairGate
from .gaze_loop import gaze_of
from .history import LARGEST_REPLY, answer_pairs
from .pair_writer import ResilientWriter
from .reconnect import ReconnectingSource
from .sources import ReportsHealth, Sources, answer_simulation, request_power

log = logging.getLogger(__name__)


class _Settings:
    joints_timeout_s: float = 1.0  # how long a frame waits for the encoders to reach its time
    around_s: float = 0.1  # [s] around a frame whose time is uncertain, to estimate the joints' speed


ZERO_FORCE = "zero_force"  # value of [robot] hold, and name of the drive
# Loops that must keep running.
LOOPS = ("encoders", "frames")


class Sampler:
    """Sampler that turns measurements into pairs: aligned in time, gated, committed to the store, and then published.

    One thread reads the encoders, the thread that calls `run` does the rest, and zenoh's threads answer queries.
    """

    def __init__(
        self,
        config: Config,
        sources: Sources,
        bus: ZenohSession,
        store: PairStore,
        *,
        exit_at_end: bool = False,  # return from `run` when the sources end, instead of continuing to serve the history
        # is notified of the completed start, of working `LOOPS`, and of the sampler's state
        service: Service | None = None,
    ) -> None:
        """Prepare a sampler over an open bus and an open store; `run` opens the sources.

        Raises:
            ConfigError: the encoders' joints differ from robot.toml's.
        """
        if sources.joints.joints != config.robot.joints:
            raise ConfigError(
                f"the encoders give the joints {', '.join(sources.joints.joints)}, [robot] joints are "
                f"{', '.join(config.robot.joints)}",
                file=config.file,
                remedy="Make both the same, in the same order",
            )
        self._config, self._bus, self._store, self._exit_at_end = config, bus, store, exit_at_end
        self._wall = SystemClock()  # for rates and UTC; all other times are the sources'
        self._service = Service.unsupervised(self._wall) if service is None else service
        self._keys = Keys(config.robot.name)
        self._version = version("bodyschema")  # reads a file: once, while descriptors are available
        self._powered = {drive.name: drive for drive in sources.powered}
        held = config.robot.robot.hold == "zero_force"
        self._arm_support = self._powered.get(ZERO_FORCE) if held else None
        self._cameras, self._marker_source_name = sources.cameras, sources.marker_source_name
        self._gaze = gaze_of(config.robot, sources, bus, self._wall)
        self._picture = sources.picture
        self._simulation, self._source_clock = sources.simulation, sources.clock
        self._joints = ReconnectingSource(sources.joints, "the encoders", self._wall, forbidden=self._service.forbidden)
        self._encoders, self._devices = sources.joints, DeviceWatch(sources.joints, store, self._wall)
        self._marker = ReconnectingSource(
            sources.marker, sources.marker_source_name, self._wall, forbidden=self._service.forbidden
        )
        rules, prismatic = config.tables.daemon, config.robot.chain.prismatic
        self._buffer = JointBuffer(prismatic, rules.max_reading_gap_s, live=sources.live, kept_s=_Settings.around_s)
        self._gate = PairGate(rules, prismatic, store.last())
        self._writer = ResilientWriter(store, self._wall)
        self._counters = SamplerCounters(config.robot, self._wall, store.audit.joint_ranges)
        self._seq = store.audit.newest
        self._publish = bus.publisher(self._keys.pair, cache=LARGEST_REPLY)
        self._publish_status = bus.publisher(self._keys.status("sampler"))
        self._stopping = self._reloading = False
        # After a pause is acknowledged, no pair may follow.
        self._pair_lock = threading.Lock()
        self._rules = SamplerRules(
            config, store, self._devices, self._wall, gate=self._gate, buffer=self._buffer, pair_lock=self._pair_lock
        )
        self._paused = False
        self._resumed_at = -math.inf
        self._ended = False
        self._failure: Exception | None = None
        self._bad_readings = 0
        self._losses = 0
        self._last_reading = self._last_frame = self._next_status = self._wall.now()

    def stop(self) -> None:
        """Request the end of `run`. Only sets a flag: a signal handler may call it."""
        self._stopping = True

    def reload(self) -> None:
        """Request that `run` reads robot.toml again. Only sets a flag: a signal handler may call it."""
        self._reloading = True

    def run(self) -> None:
        """Sample until `stop`, or with `exit_at_end` until the sources end.

        Raises:
            StoreError: the store is damaged; the pair was not published, and no pair followed.
            SourceError: a source could not be opened at the start.
        """
        self._service.report_status("opening encoders and cameras")
        with ExitStack() as stack:
            stack.callback(self._service.stopping)
            stack.enter_context(self._joints)
            stack.enter_context(self._marker)
            self._devices.check()
            reader = threading.Thread(target=self._read_encoders, name="encoders")
            reader.start()
            stack.callback(reader.join)
            stack.callback(self._buffer.close)
            stack.callback(self.stop)
            if self._gaze is not None:
                stack.enter_context(self._gaze)
            self._serve()
            name, endpoint = self._config.robot.name, self._config.tables.zenoh.sampler
            log.info(
                "the sampler of %s answers on %s; %d samples are in %s", name, endpoint, self._seq, self._store.file
            )
            tell_parent_serving()
            try:
                self._sample()
                self._serve_history()
            except Exception as error:
                self._failure = error
                self._publish_state()
                raise

    def status(self) -> SamplerStatus:
        """Return the sampler's state; from any thread."""
        counters = self._counters
        servos = self._encoders if isinstance(self._encoders, Servos) else None
        return SamplerStatus(
            robot=self._config.robot.name,
            store=self._store.identity,
            state=self._state(),
            pairs=self._seq,
            segment=self._gate.segment,
            uptime_s=counters.uptime_s,
            frames=counters.frames,
            frames_per_s=counters.frames_per_s,
            readings_per_s=counters.readings_per_s,
            pairs_per_s=counters.pairs_per_s,
            rejected=counters.rejected,
            coverage=counters.coverage,
            disk_free_bytes=disk_free(self._store.file),
            health=self._health(),
            servos={} if servos is None else dict(servos.servo_health),
            buses={} if servos is None else dict(servos.bus_health),
            version=self._version,
            unreadable=self._store.reader.present_damage().count,
        )

    def _serve(self) -> None:
        bus, keys = self._bus, self._keys
        bus.answer(keys.pairs, lambda request: answer_pairs(self._store.reader, request))
        bus.answer(keys.status("sampler"), lambda request: encode(self.status(), request.encoding))
        bus.answer(keys.command("sampler"), self._handle_command)
        if self._picture is not None:
            bus.answer(keys.picture, lambda _: self._picture_bytes(), encoding="image/jpeg")
        if self._simulation is not None:
            world, clock = self._simulation, self._source_clock
            bus.answer(keys.simulation, lambda request: answer_simulation(world, clock, request))
        bus.token(keys.alive("sampler"))

    def _picture_bytes(self) -> bytes:
        picture = None if self._picture is None else self._picture()
        if picture is None:
            raise RequestError("no image has come yet")
        return picture

    def _sample(self) -> None:
        while not self._stopping:
            self._publish_state_when_due()
            try:
                detection = self._marker.read(Waits.read_s)
            except SourceEnded:
                break
            self._check_sources()
            if detection is None:
                self._buffer.make_room()
                continue
            self._last_frame = self._wall.now()
            self._counters.frames += 1
            if self._counters.readings:
                self._service.ready()
            reason = self._process(detection)
            if reason is not None:
                self._counters.reject(reason)

    def _serve_history(self) -> None:
        self._check_sources()
        if self._stopping:
            return
        self._ended = True
        self._service.ready()
        log.info("the sources are through; %d samples are in the store", self._seq)
        self._publish_state()
        while not (self._stopping or self._exit_at_end):
            time.sleep(Waits.read_s)
            self._publish_state_when_due()

    def _process(self, detection: MarkerFix | MarkerMiss) -> Reason | None:
        """Make a pair from a detection, or return the reason why not."""
        self._buffer.forget_before(detection.t)
        if self._paused or detection.t <= self._resumed_at:
            self._gate.break_segment()
            return Reason.PAUSED
        if isinstance(detection, MarkerMiss):
            return detection.reason
        if not (np.isfinite(detection.x).all() and np.isfinite(detection.cov).all()):
            return Reason.NOT_FINITE
        q = self._angles(detection)
        if isinstance(q, Reason):
            return q
        if self._arm_support is not None and self._arm_support.state != "on":
            self._gate.break_segment()
            return Reason.NOT_BORNE
        with self._pair_lock:
            if self._paused:
                self._gate.break_segment()
                return Reason.PAUSED
            devices_changed = self._writer.attempt(self._devices.check)
            if devices_changed is None:
                return Reason.NOT_STORED
            if devices_changed:
                self._gate.break_segment()
            verdict = self._gate.offer(detection.t, q, detection.x)
            if isinstance(verdict, Reason):
                return verdict
            return self._accept(verdict, q, detection)

    def _angles(self, fix: MarkerFix) -> FloatArray | Reason:
        """Return the joint angles at the time of a fix, if they are accurate enough despite that time's uncertainty."""
        if fix.t_sigma > 0:
            moved = self._buffer.moved(fix.t, fix.t_sigma, _Settings.joints_timeout_s)
            if isinstance(moved, Reason):
                return moved
            if self._gate.is_too_fast(moved):
                return Reason.MOVING
        q = self._buffer.at(fix.t, _Settings.joints_timeout_s)
        if not isinstance(q, Reason) and self._gate.is_too_fast(self._buffer.time_uncertainty_motion(fix.t)):
            return Reason.LATE_JOINTS
        return q

    def _accept(self, segment: int, q: FloatArray, fix: MarkerFix) -> Reason | None:
        pair = self._writer.append(segment, q, fix)
        if pair is None:
            self._gate.break_segment()
            return Reason.NOT_STORED
        self._seq = pair.seq
        self._counters.accept(q)
        self._publish(encode(pair_to_wire(pair)))
        return None

    def _check_sources(self) -> None:
        if self._failure is not None:
            raise self._failure
        losses = self._joints.losses + self._marker.losses
        if losses != self._losses:
            self._losses = losses
            self._gate.break_segment()

    def _read_encoders(self) -> None:
        try:
            while not self._stopping:
                self._service.beat("encoders")
                reading = self._joints.read(Waits.read_s)
                if reading is not None:
                    self._take_reading(reading)
                elif self._joints.trouble is not None:
                    self._buffer.expect_no_readings()
        except SourceEnded:
            self._service.remove_loop("encoders")
            self._buffer.expect_no_readings()
        except Exception as error:
            log.exception("the encoders' thread failed")
            self._failure = error
            self._buffer.close()

    def _take_reading(self, reading: JointReading) -> None:
        self._last_reading = self._wall.now()
        self._counters.readings += 1
        if np.isfinite(reading.q).all():
            self._buffer.put(reading)
            return
        self._bad_readings += 1
        if self._bad_readings == 1:
            joint = self._config.robot.joints[int(np.argmin(np.isfinite(reading.q)))]
            log.warning("the encoder of joint %r gave a number that is not finite; such readings are not used", joint)

    def _handle_command(self, request: Request) -> bytes:
        command = decode(request.payload, CommandRequest, request.encoding).command
        if command == "accept_turns":
            return encode(CommandReply(command, accept_turns(self._encoders)), request.encoding)
        name, _, switch = command.rpartition("_")
        if switch in ("on", "off"):
            return encode(CommandReply(command, self._power(name, on=switch == "on")), request.encoding)
        if command == "reload":
            message = self._rules.reload()
            log.info("robot.toml was read again: %s", message)
            return encode(CommandReply(command, message), request.encoding)
        if command not in ("pause", "resume"):
            raise RequestError(
                f"the sampler has nothing to do with {command}. Send it to {self._keys.command('learner')}"
            )
        if command == "resume" and self._paused:
            # A frame still in transit shows the arm during the pause.
            self._resumed_at = self._source_clock.now()
        with self._pair_lock:
            self._paused = command == "pause"
        message = "no samples are accepted until resume" if self._paused else "samples are accepted, in a new segment"
        log.info("%s: %s", command, message)
        return encode(CommandReply(command, message), request.encoding)

    def _power(self, name: str, *, on: bool) -> str:
        if self._simulation is not None:
            raise RequestError(f"{name} is of a real arm: in the simulation the head follows the hand by itself")
        if name not in self._powered:
            raise RequestError(f"{name} is not configured: docs/zero_force.md has its table [drivers.dynamixel.{name}]")
        answer = request_power(self._powered[name], on=on)
        log.info("%s", answer)
        return answer

    def _publish_state_when_due(self) -> None:
        self._service.beat("frames")
        if self._reloading:
            self._reloading = False
            # In a separate thread, because frames do not wait.
            threading.Thread(target=self._service.reload_and_report, args=(self._rules.reload,), name="reload").start()
        self._counters.tick()
        if self._wall.now() >= self._next_status:
            self._rules.trim()
            self._publish_state()

    def _publish_state(self) -> None:
        self._next_status = self._wall.now() + Waits.status_every_s
        status = self.status()
        self._publish_status(encode(status))
        line = f"{status.state}, {status.pairs} samples, {status.pairs_per_s:.1f}/s"
        self._service.report_status(with_health(line, status.health))

    def _state(self) -> str:
        if self._failure is not None:
            return "failed"
        if self._ended:
            return "ended"
        return "paused" if self._paused else "running"

    def _health(self) -> list[str]:
        problems: list[str] = [trouble for trouble in (self._joints.trouble, self._marker.trouble) if trouble]
        problems += self._encoders.health if isinstance(self._encoders, ReportsHealth) else ()
        problems += self._devices.changes + self._writer.complaints
        if self._failure is not None:
            problems.append(str(self._failure))
        elif not self._ended:
            problems += self._silent_sources() + self._counters.complaints
        problems += [text for drive in self._powered.values() for text in drive.complaints]
        if self._cameras is not None and self._marker.trouble is None:
            problems += self._cameras.health
        if self._arm_support is not None and self._arm_support.state != "on":
            problems.append(
                f"{ZERO_FORCE} is to bear the arm ([robot] hold) and is {self._arm_support.state}: no samples are taken"
            )
        if self._bad_readings:
            problems.append(f"{self._bad_readings} encoder readings were not finite and were not used")
        if disk_free(self._store.file) < LOW_DISK_BYTES:
            problems.append(f"the disk of {self._store.file} is nearly full")
        problems += self._store.complaints
        return list(dict.fromkeys(problems))  # servos repeat the complaints of their drives

    def _silent_sources(self) -> list[str]:
        now = self._wall.now()
        silent = (
            ("the encoders", self._joints.trouble, self._last_reading),
            (self._marker_source_name, self._marker.trouble, self._last_frame),
        )
        return [
            f"nothing has come from {name} for {now - since:.0f} s"
            for name, trouble, since in silent
            if trouble is None and now - since > Waits.silent_after_s
        ]
