"""Check that a ROS 2 robot's joint states arrive, and at what rate. Only listens."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

from bodyschema.drivers.checks import MANY_TROUBLES, READ_S, Check, warned
from bodyschema.interfaces.errors import SourceError
from bodyschema.interfaces.protocols import Clock
from bodyschema.interfaces.waits import POLL_S

from .config import Ros2Config
from .joints import SILENT_AFTER_S, Ros2Joints
from .link import OpenLink, open_zenoh

FEW_PER_S = 20.0
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
                yield Check("joint states", "wrong", *_parted(robot.health))
                return
            yield Check("joint states", "ok", f"all {len(joints)} joints of robot.toml are in {config.topic}")
            lost, heard = _counted(robot)
            end, readings = clock.now() + READ_S, 0
            while clock.now() < end:
                readings += robot.read(end - clock.now()) is not None
            lost_since, heard_since = _counted(robot)
            rate_hz, lost, messages = readings / READ_S, lost_since - lost, heard_since - heard
            fix = "let the robot's nodes publish more often"
            yield warned("rate", f"{rate_hz:.0f} readings/s come", fix, when=rate_hz < FEW_PER_S)
            fix = "bodyschema watch joints    # its log says why, once for each reason"
            said = f"{lost} of {messages} messages were lost or not used"
            yield warned("errors", said, fix, when=lost > MANY_TROUBLES * messages)
    except SourceError as error:
        yield Check("router", "wrong", *_parted((str(error),)))


def _begins(robot: Ros2Joints, clock: Clock) -> bool:
    """Return True if a reading arrives before the robot counts as silent."""
    end = clock.now() + SILENT_AFTER_S + POLL_S
    while clock.now() < end:
        if robot.read(POLL_S) is not None:
            return True
    return False


def _parted(complaints: Sequence[str]) -> tuple[str, str]:
    """Split a complaint into what was found and its last part, what to do."""
    if not complaints:
        return "too few joint states come", "let the robot's nodes publish more often"
    *said, fix = LAST_PART.split(complaints[0])
    return "".join(said), fix


def _counted(robot: Ros2Joints) -> tuple[int, int]:
    """Return the number of unusable messages, and of all messages sent, so far."""
    return robot.lost + robot.refused.total(), robot.lost + robot.received
