"""The joints of a ROS 2 robot as a `JointSource`."""

from __future__ import annotations

import logging
import math
import re
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Self

from bodyschema.drivers.checks import Check, CheckSettings, warned
from bodyschema.drivers.ros2 import rmw
from bodyschema.drivers.ros2.cdr import Malformed
from bodyschema.drivers.ros2.config import Ros2Config
from bodyschema.drivers.ros2.link import Link, LinkSettings, OpenLink, Sample, open_zenoh
from bodyschema.drivers.ros2.messages import JOINT_STATE, JointState, decode_joint_state
from bodyschema.drivers.ros2.senders import Refusal, Sender, SpeedGates
from bodyschema.drivers.speed_gate import FASTEST_M_S, FASTEST_RAD_S
from bodyschema.interfaces.errors import SourceError, SourceLost
from bodyschema.interfaces.protocols import Clock
from bodyschema.interfaces.records import JointReading, frozen_array
from bodyschema.interfaces.waits import Waits


class _Settings:
    points_kept: int = 4096  # of each joint
    max_shown: int = 12  # names in a message
    slack_rad, slack_m = 0.02, 2e-3  # on top of what the fastest joint moves between two messages
    max_gap_s: float = 0.1  # no position is interpolated between two messages of a joint that are farther apart
    max_senders: int = 64  # that are kept apart
    max_names: int = 256  # upper bound of the names kept for messages
    few_per_s: float = 20.0  # readings: fewer get a warning


@dataclass(frozen=True, slots=True)
class MergedJoints:
    """All joints at one time."""

    t: float  # the time of a message [s], never between two messages
    stamp_ns: int  # that message's stamp
    q: tuple[float, ...]  # positions
    gap_s: float  # the longest time between the two messages that a joint's position was interpolated from
    sigma_s: float  # the largest 1-sigma of their times


@dataclass(frozen=True, slots=True)
class _Point:
    t: float
    sigma_s: float
    stamp_ns: int
    q: float


class JointMerger:
    """Buffer of the positions of each joint since the last reading.

    The next reading is at the time of the newest message of the joint that was updated least recently. The other joints
    are interpolated to this time.
    """

    def __init__(self, joints: int) -> None:
        """Start with empty buffers for `joints` joints."""
        self._tracks: list[deque[_Point]] = [deque(maxlen=_Settings.points_kept) for _ in range(joints)]
        self._last_t = float("-inf")

    def missing(self) -> list[int]:
        """Return the joints without any position so far."""
        return [place for place, track in enumerate(self._tracks) if not track]

    def put(
        self, t: float, sigma_s: float, stamp_ns: int, places: Sequence[int], q: Sequence[float]
    ) -> MergedJoints | None:
        """Add positions `q` of the joints at `places`; return the reading that they complete."""
        for place, value in zip(places, q, strict=True):
            track = self._tracks[place]
            if not track or t > track[-1].t:
                track.append(_Point(t, sigma_s, stamp_ns, value))
        if self.missing():
            return None
        slowest = min((track[-1] for track in self._tracks), key=lambda point: point.t)
        if slowest.t <= self._last_t:
            return None
        found = [_at(slowest.t, track) for track in self._tracks]
        if any(part is None for part in found):
            return None
        self._last_t = slowest.t
        parts = [part for part in found if part is not None]
        sigma_s = max(track[0].sigma_s for track in self._tracks)
        return MergedJoints(
            slowest.t, slowest.stamp_ns, tuple(q for q, _ in parts), max(gap for _, gap in parts), sigma_s
        )


def _at(t: float, track: deque[_Point]) -> tuple[float, float] | None:
    """Return a joint's position at `t` and the time between the two it is interpolated from; drop older ones.

    Return None when it was not known yet at `t`.
    """
    while len(track) > 1 and track[1].t <= t:
        track.popleft()
    before = track[0]
    if before.t > t:
        return None
    if before.t == t:
        return before.q, 0.0
    after = next(islice(track, 1, 2))
    gap = after.t - before.t
    return before.q + (after.q - before.q) * (t - before.t) / gap, gap


ADVICE = {
    Refusal.MALFORMED: "it is no intact sensor_msgs/JointState; see what publishes it: ros2 topic info -v",
    Refusal.NO_POSITIONS: "it has names and no positions; take a topic that has them",
    Refusal.TWICE: "it names a joint twice; fix the node that publishes it",
    Refusal.NOT_FINITE: "a position is not finite; the robot does not know where that joint is",
    Refusal.NO_STAMP: "its stamp is zero; the node that publishes it has to fill in header.stamp",
    Refusal.DUPLICATE: "its stamp is that of the message before; the positions are not newer than its stamp",
    Refusal.OUT_OF_ORDER: "its stamp is earlier than that of the message before; two nodes may share one publisher",
    Refusal.DELAYED: "it came much later than others; fix the network, or set max_delay_s",
    Refusal.TOO_FAST: "a joint cannot have come there so fast; fix names in robot.toml, or the node that publishes it",
    Refusal.RIVAL: "two nodes publish the same joint; end one, joint_state_publisher for example",
    Refusal.GAP: "the joints come in several messages, too far apart in time; publish faster",
}


def silence(
    config: Ros2Config,
    missing: Sequence[str],
    names: Collection[str],
    refused: Counter[Refusal],
    tokens: Callable[[], Sequence[str]],
) -> str:
    """Explain in one sentence why there are no readings.

    Args:
        missing: joints, by their names in ROS, without any message.
        names: all joint names received.
        refused: number of unused messages, by reason.
        tokens: returns the tokens of existing publishers.
    """
    if refused:
        why, count = refused.most_common(1)[0]
        return f"nothing of {config.topic} can be used; {count} times: {ADVICE[why]}"
    if names and missing:
        there = ", ".join(sorted(names)[: _Settings.max_shown])
        return (
            f"{config.topic} does not name {', '.join(missing)}; it names {there}. "
            "Say in [drivers.ros2] names what ROS calls each joint"
        )
    if names:
        return f"{config.topic} has fallen silent; see whether the robot publishes: ros2 topic hz {config.topic}"
    return _why_unheard(config, list(rmw.topics_in(list(tokens()))))


def _why_unheard(config: Ros2Config, topics: Sequence[rmw.Topic]) -> str:
    name = "/" + config.topic.strip("/")
    if config.via == "ros2dds":
        return (
            f"the bridge at {config.router} passes on nothing of {name}; see whether the robot publishes it in the "
            f"bridge's domain: ros2 topic hz {name}"
        )
    in_domain = [topic for topic in topics if topic.domain == config.domain]
    other_types = {topic.type for topic in in_domain if topic.name == name} - {JOINT_STATE.name}
    if other_types:
        return f"{name} is no topic of sensor_msgs/JointState but of {', '.join(sorted(other_types))}; fix topic"
    if any(topic.name == name for topic in in_domain):
        return f"a node publishes {name}, but says nothing; see whether the robot runs: ros2 topic hz {name}"
    elsewhere = sorted({topic.domain for topic in topics if topic.name == name})
    if elsewhere:
        return f"{name} is published in the domain {elsewhere[0]}, not {config.domain}; fix domain"
    others = sorted({topic.name for topic in in_domain if topic.type == JOINT_STATE.name})[: _Settings.max_shown]
    if others:
        return f"nothing publishes {name}; there are joint states on {', '.join(others)}. Fix topic"
    return (
        f"nothing publishes {name} at the router {config.router}; start the robot with "
        "RMW_IMPLEMENTATION=rmw_zenoh_cpp, and its nodes with the same router"
    )


log = logging.getLogger(__name__)


SenderKey = bytes | tuple[str, ...]


class Ros2Joints:
    """Reader of sensor_msgs/JointState from a robot's router.

    A reading refers to one time: that of a message. If several nodes publish the joints, the others are interpolated to
    it. Doubtful messages are dropped and counted. SourceLost is raised when the router goes away or a joint jumps. A
    silent robot only delays the next reading.

    Attributes:
        joints: names of the joints in the order of q.
        refused: messages and readings that were not used, by reason.
        lost: messages that never arrived, by the senders' own count.
        stamp_ns: the robot's own timestamp of the newest reading [ns]; None before the first.
    """

    def __init__(
        self,
        config: Ros2Config,  # checked; see `Ros2Config.check`
        joints: Sequence[str],
        clock: Clock,
        *,
        prismatic: Sequence[bool] | None = None,  # True for each prismatic joint; none by default
        open_link: OpenLink = open_zenoh,
    ) -> None:
        self._config, self.joints, self._clock, self._open_link = config, tuple(joints), clock, open_link
        self._ros_names = config.ros_names(joints)
        slides = [False] * len(joints) if prismatic is None else list(prismatic)
        self._fastest = [FASTEST_M_S if sliding else FASTEST_RAD_S for sliding in slides]
        self._slack = [_Settings.slack_m if sliding else _Settings.slack_rad for sliding in slides]
        self._link: Link | None = None
        self._last_t = -math.inf
        self._forget()
        self.received = self.lost = 0
        self.refused: Counter[Refusal] = Counter()
        self.stamp_ns: int | None = None

    @property
    def health(self) -> tuple[str, ...]:
        """Current problems, with the remedy."""
        return () if self._complaint is None else (self._complaint,)

    def __enter__(self) -> Self:
        self._link = self._open_link(self._config, self._clock)
        self._forget()
        return self

    def __exit__(self, *_: object) -> None:
        if self._link is not None:
            self._link.close()
            self._link = None

    def read(self, timeout_s: float) -> JointReading | None:
        """Return the next reading; see `JointSource.read`.

        Raises:
            SourceLost: the router is gone, or a joint jumped.
        """
        if self._link is None:
            raise SourceError("the robot's joint states are not open; use them in a with statement")
        deadline = self._clock.now() + timeout_s
        while True:
            sample = self._link.receive(deadline)
            reading = None if sample is None else self._take(sample)
            if reading is not None:
                self._complaint = None
                self._read_at = self._clock.now()
                return reading
            if sample is None and not self._link.is_connected:
                raise SourceLost(f"the zenoh router {self._config.router} is gone", retry_s=LinkSettings.retry_s)
            self._complain(self._link)
            if sample is None or self._clock.now() >= deadline:
                return None

    def _forget(self) -> None:
        """Reset everything learnt from earlier messages."""
        self._senders: dict[SenderKey, Sender] = {}
        self._gates = SpeedGates(self._fastest, self._slack)
        self._owners: list[tuple[SenderKey, float] | None] = [None] * len(self.joints)
        self._sequences: dict[bytes, int] = {}
        self._merger = JointMerger(len(self.joints))
        self._names: set[str] = set()
        self._logged: set[Refusal] = set()
        self._lately: Counter[Refusal] = Counter()
        self._complaint: str | None = None
        self._read_at = self._clock.now()

    def _take(self, sample: Sample) -> JointReading | None:
        self.received += 1
        try:
            message = decode_joint_state(sample.payload)
        except Malformed as error:
            self._refuse(Refusal.MALFORMED, str(error))
            return None
        gid, sequence = rmw.sender_of(sample.attached)
        self._count_lost(gid, sequence)
        if len(self._names) < _Settings.max_names:
            self._names.update(message.names)
        merged = self._accepted(gid or message.names, message, sample.arrived)
        if merged is None:
            return None
        if merged.gap_s > _Settings.max_gap_s:
            self._refuse(Refusal.GAP, f"{merged.gap_s:.3f} s")
            return None
        if merged.t <= self._last_t:
            return None
        self._last_t, self.stamp_ns = merged.t, merged.stamp_ns
        return JointReading(merged.t, frozen_array(merged.q), merged.sigma_s)

    def _accepted(self, who: SenderKey, message: JointState, arrived: float) -> MergedJoints | None:
        columns = {name: column for column, name in enumerate(message.names)}
        places = [place for place, name in enumerate(self._ros_names) if name in columns]
        if not places:
            return None
        t = self._stamp_time(who, message, places, arrived)
        if isinstance(t, Refusal):
            self._refuse(t, self._ros_names[places[0]])
            return None
        q = [message.positions[columns[self._ros_names[place]]] for place in places]
        if not all(map(math.isfinite, q)):
            self._refuse(Refusal.NOT_FINITE, self._ros_names[places[0]])
            return None
        for place in places:
            self._owners[place] = who, arrived
        verdict = self._gates.offer(t, places, q)
        if self._gates.jumped:
            raise SourceLost(
                "a joint is suddenly somewhere else, or the names were changed", retry_s=LinkSettings.retry_s
            )
        if verdict is False:
            self._refuse(Refusal.TOO_FAST, self._ros_names[places[0]])
        sigma_s = self._sender(who).sigma_s
        return self._merger.put(t, sigma_s, message.header.stamp_ns, places, q) if verdict else None

    def _stamp_time(
        self, who: SenderKey, message: JointState, places: Sequence[int], arrived: float
    ) -> float | Refusal:
        """Return the time of the message's positions [s], or the reason to reject it."""
        owners = [owner for place in places if (owner := self._owners[place]) is not None]
        if any(owner != who and arrived - heard < Waits.rival_after_s for owner, heard in owners):
            return Refusal.RIVAL
        if len(set(message.names)) < len(message.names):
            return Refusal.TWICE
        if not message.positions:
            return Refusal.NO_POSITIONS
        sender = self._sender(who)
        times_set = sender.times_set
        t = sender.time_of(message.header.stamp_ns, places, arrived)
        if sender.times_set != times_set:
            log.warning("the clock of the stamps in %s was set; its time is learnt again", self._config.topic)
        return t

    def _sender(self, who: SenderKey) -> Sender:
        sender = self._senders.get(who)
        if sender is None:
            if len(self._senders) >= _Settings.max_senders:
                del self._senders[min(self._senders, key=lambda known: self._senders[known].heard)]
            self._senders[who] = sender = Sender(self._config.max_delay_s)
        return sender

    def _count_lost(self, gid: bytes, sequence: int | None) -> None:
        if sequence is None:
            return
        before = self._sequences.get(gid)
        if before is not None and sequence > before + 1:
            self.lost += sequence - before - 1
        if before is not None or len(self._sequences) < _Settings.max_senders:
            self._sequences[gid] = sequence

    def _refuse(self, why: Refusal, detail: str) -> None:
        self.refused[why] += 1
        self._lately[why] += 1
        if why not in self._logged:
            self._logged.add(why)
            log.warning("a message of %s was not used (%s): %s", self._config.topic, detail, ADVICE[why])

    def _complain(self, link: Link) -> None:
        """Report once why there are no readings."""
        if self._complaint is not None or self._clock.now() - self._read_at < Waits.silent_after_s:
            return
        missing = [self._ros_names[place] for place in self._merger.missing()]
        self._complaint = silence(self._config, missing, self._names, self._lately, link.tokens)
        log.warning("%s", self._complaint)


LAST_PART = re.compile(r"[;.] (?!.*[;.] )", re.DOTALL)


def joint_state_checks(
    config: Ros2Config,
    joints: Sequence[str],
    clock: Clock,
    *,
    prismatic: Sequence[bool] | None = None,
    open_link: OpenLink = open_zenoh,
) -> Iterator[Check]:
    """Yield checks of the router, of the joints and of their rate. Open a session for that.

    Args:
        joints, prismatic, open_link: as for `Ros2Joints`.
    """
    try:
        with Ros2Joints(config, joints, clock, prismatic=prismatic, open_link=open_link) as robot:
            yield Check("router", "ok", f"{config.router} answers")
            if not _begins(robot, clock):
                yield Check("joint states", "wrong", *_split_remedy(robot.health))
                return
            yield Check("joint states", "ok", f"all {len(joints)} joints of robot.toml are in {config.topic}")
            lost, heard = _lost_and_sent(robot)
            end, readings = clock.now() + CheckSettings.read_s, 0
            while clock.now() < end:
                readings += robot.read(end - clock.now()) is not None
            lost_since, heard_since = _lost_and_sent(robot)
            rate_hz, lost, messages = readings / CheckSettings.read_s, lost_since - lost, heard_since - heard
            fix = "let the robot's nodes publish more often"
            yield warned("rate", f"{rate_hz:.0f} readings/s come", fix, when=rate_hz < _Settings.few_per_s)
            fix = "bodyschema watch joints    # its log says why, once for each reason"
            message = f"{lost} of {messages} messages were lost or not used"
            yield warned("errors", message, fix, when=lost > CheckSettings.many_troubles * messages)
    except SourceError as error:
        yield Check("router", "wrong", *_split_remedy((str(error),)))


def _begins(robot: Ros2Joints, clock: Clock) -> bool:
    """Return True if a reading arrives before the robot counts as silent."""
    end = clock.now() + Waits.silent_after_s + Waits.poll_s
    while clock.now() < end:
        if robot.read(Waits.poll_s) is not None:
            return True
    return False


def _split_remedy(complaints: Sequence[str]) -> tuple[str, str]:
    """Split a complaint into the finding and its last part, the remedy."""
    if not complaints:
        return "too few joint states come", "let the robot's nodes publish more often"
    *finding, fix = LAST_PART.split(complaints[0])
    return "".join(finding), fix


def _lost_and_sent(robot: Ros2Joints) -> tuple[int, int]:
    """Return the number of unusable messages, and of all messages sent, so far."""
    return robot.lost + robot.refused.total(), robot.lost + robot.received
