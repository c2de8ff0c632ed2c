"""Serve the simulated world over zenoh: its ground truth for evaluation, and its tool for the simulated user."""

from __future__ import annotations

import math

import msgspec

from bodyschema.daemon.transport.bus import Request
from bodyschema.daemon.transport.wire import SCHEMA, CommandReply, decode, encode
from bodyschema.interfaces.errors import RequestError
from bodyschema.interfaces.protocols import Clock

from .sources import GroundTruth

# A longer tool is a mistake of units.
LONGEST_TOOL_M = 2.0


class ToolRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """`{"tool": [x, y, z]}`: the marker of the new tool in the marker link [m]."""

    tool: tuple[float, float, float]


class TruthReply(msgspec.Struct, frozen=True):
    """The true chain from measurement frame to marker, as `kbmaps.RigidChain`.

    Attributes:
        fixed: shape (d + 1, 4, 4).
        axes: shape (d, 3).
        prismatic: shape (d,).
        t: simulated time [s].
        turn: rotation of the marker in the chain's last frame, shape (3, 3).
    """

    fixed: list[list[list[float]]]
    axes: list[list[float]]
    prismatic: list[bool]
    t: float
    turn: list[list[float]]
    schema: int = SCHEMA


def answer_simulation(world: GroundTruth, clock: Clock, request: Request) -> bytes:
    """Answer an empty request with the ground truth; change the tool on a `ToolRequest`.

    Raises:
        RequestError: the tool is not three finite numbers, or is longer than `LONGEST_TOOL_M`.
    """
    if not request.payload:
        chain = world.true_chain()
        turn = world.true_turn().tolist()
        truth = TruthReply(chain.fixed.tolist(), chain.axes.tolist(), chain.prismatic.tolist(), clock.now(), turn)
        return encode(truth, request.encoding)
    tool = decode(request.payload, ToolRequest, request.encoding).tool
    if not math.dist(tool, (0.0, 0.0, 0.0)) <= LONGEST_TOOL_M:
        raise RequestError(f"a tool at {list(tool)} m is not within {LONGEST_TOOL_M} m of the hand; units are metres")
    changed_at = world.change_tool(tool)
    return encode(CommandReply("tool", f"the tool in the hand changed at t = {changed_at:.3f} s"), request.encoding)
