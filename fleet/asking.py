"""Queries of the fleet's models at common poses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bodyschema.daemon.transport.keys import Keys
from bodyschema.daemon.transport.wire import PredictReply, decode, encode
from bodyschema.interfaces.errors import BusError, RequestError
from bodyschema.interfaces.records import FloatArray

from .comparison import Model, TypeComparison, common_poses, compared
from .roster import Fleet, Member


def by_type(members: Sequence[Member]) -> tuple[dict[tuple[str, ...], list[Member]], list[str]]:
    """Group the robots whose learners answer by the names of their joints; return also why others are left out."""
    types: dict[tuple[str, ...], list[Member]] = {}
    left_out: list[str] = []
    for member in members:
        if member.learner is None:
            left_out.append(f"{member.name}: no learner of it answers")
        elif member.joints is None:
            left_out.append(f"{member.name}: neither a sampler nor a solution tells its joints yet")
        else:
            types.setdefault(member.joints, []).append(member)
    return types, left_out


def compare_types(fleet: Fleet, members: Sequence[Member]) -> tuple[list[TypeComparison], list[str]]:
    """Return a comparison for each type with at least two answering models, and who was left out and why."""
    types, left_out = by_type(members)
    found: list[TypeComparison] = []
    for joints, robots in types.items():
        try:
            coverages = [robot.sampler.coverage for robot in robots if robot.sampler is not None]
            q = common_poses([each for each in coverages if tuple(each) == joints], joints)
        except RequestError as error:
            left_out += [f"{robot.name}: {error}" for robot in robots]
            continue
        models: list[Model] = []
        for robot in robots:
            try:
                models.append(_model(fleet, robot, q))
            except (BusError, RequestError) as error:
                left_out.append(f"{robot.name}: {error}")
        if len(models) < 2:
            left_out += [f"{model.robot}: there is no other of its type" for model in models]
            continue
        found.append(compared(joints, q, models))
    return found, left_out


def _model(fleet: Fleet, robot: Member, q: FloatArray) -> Model:
    if robot.route is None:
        raise BusError("its learner was not found")
    payload = fleet.bus(robot.route).ask_one(Keys(robot.name).predict, encode({"q": q.tolist()}))
    said = decode(payload, PredictReply)
    x, sigma = np.array(said.x), np.array(said.sigma)
    if x.shape != (len(q), 3) or sigma.shape != x.shape or not np.isfinite(x).all():
        raise RequestError("its learner's predictions are not one position a pose")
    calibration = None if robot.learner is None else robot.learner.calibration
    distance = float(np.sqrt(np.square(sigma).sum(axis=1).mean()))
    return Model(robot.name, x, distance, float(np.mean(said.in_support)), calibration)
