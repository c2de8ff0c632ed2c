"""Query the robots of one type, and compare their models: distance from the median model, and outlying figures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import NormalDist

import msgspec
import numpy as np
from rich import box
from rich.console import Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text
from scipy.spatial.transform import Rotation

from bodyschema.calibration.comparison import Distances, aligned_to
from bodyschema.cli.terminal.screen import mm
from bodyschema.daemon.transport.keys import Keys
from bodyschema.daemon.transport.status import JointRange
from bodyschema.daemon.transport.wire import PredictReply, decode, encode
from bodyschema.fleet.roster import Fleet, Member
from bodyschema.interfaces.errors import BusError, RequestError
from bodyschema.interfaces.records import FloatArray
from bodyschema.learning.status import ChainCalibration


class _Settings:
    poses: int = 400
    min_to_judge: int = 3  # with two robots, an outlier cannot be attributed to either
    # A robot is off if one of its figures stands out, or if its model's distance from the median exceeds this multiple
    # of both the models' predicted errors and the robots' median distance.
    far: float = 3.0
    # Probability that chance makes any figure of any robot stand out.
    chance: float = 0.05
    rounds: int = 20


MEDIAN_COSTS = math.sqrt(math.pi / 2.0)  # standard error of a median of normal numbers, over that of their mean

_quantile = NormalDist().inv_cdf


@dataclass(frozen=True, eq=False)
class Model:
    """Predictions of one robot's learner at the common poses."""

    robot: str  # its name
    x: FloatArray  # positions (n, 3) in its own measurement frame [m]
    sigma_m: float  # its predicted error there, root mean square of the distance [m]
    in_support: float  # share of the poses that lie where it has data
    calibration: ChainCalibration | None  # its calibration; None without one


class OutlyingFigure(msgspec.Struct, frozen=True):
    """Figure of a robot that differs from the others' by more than its uncertainty and their spread."""

    figure: str  # in words, as in `zero of elbow`
    # difference, half_width: from the median of the robots, with half its 95 % interval [unit]
    difference: float
    half_width: float
    unit: str  # rad or m


class Unit(msgspec.Struct, frozen=True, kw_only=True):
    """One robot compared with the others."""

    robot: str  # its name
    apart: Distances  # distance of its model from the median model, after a rigid alignment: cameras may stand anywhere
    claimed_mm: float  # predicted error of its learner at the poses, root mean square
    in_support: float  # share of the poses that lie where it has data
    is_off: bool | None  # true if it is an outlier; null if there are too few robots to decide
    odd: tuple[OutlyingFigure, ...]  # its figures that stand out, the most improbable first
    # camera_moved_mm, camera_turned_deg: from the camera pose in its robot.toml
    camera_moved_mm: float | None
    camera_turned_deg: float | None


class TypeComparison(msgspec.Struct, frozen=True):
    """Robots with the same joints."""

    joints: tuple[str, ...]  # their names
    poses: int  # number of common poses
    # low, high: the range of each joint that the poses are from [rad or m]
    low: tuple[float, ...]
    high: tuple[float, ...]
    units: tuple[Unit, ...]  # the robots


def common_poses(coverages: Sequence[Mapping[str, JointRange]], joints: tuple[str, ...]) -> FloatArray:
    """Return poses (n, d) [rad, m] from the median ranges of the robots.

    One robot that hardly moved does not affect them.

    Raises:
        RequestError: no robot reports the ranges of its joints.
    """
    ranges = [[(each[joint].low, each[joint].high) for joint in joints] for each in coverages]
    if not ranges:
        raise RequestError("no sampler of these robots answers, so the ranges of their joints are unknown")
    low, high = np.sort(np.median(np.array(ranges), axis=0), axis=1).T
    return np.random.default_rng(0).uniform(low, high, (_Settings.poses, len(joints)))


def compare_models(joints: tuple[str, ...], q: FloatArray, models: Sequence[Model]) -> TypeComparison:
    """Compare the models of at least two robots, at the poses q (n, d)."""
    middle = median_model([model.x for model in models])
    apart = [Distances.of(aligned_to(middle, model.x)[0] - middle) for model in models]
    typical = float(np.median([each.rms_mm for each in apart]))
    claimed = float(np.median([1e3 * model.sigma_m for model in models]))
    figures = _figures(models)
    can_judge = len(models) >= _Settings.min_to_judge
    odd = [_outlying_figures(k, figures) if can_judge else () for k in range(len(models))]
    far = [_Settings.far * max(typical, math.hypot(1e3 * model.sigma_m, claimed)) for model in models]
    units = tuple(
        Unit(
            robot=model.robot,
            apart=each,
            claimed_mm=1e3 * model.sigma_m,
            in_support=model.in_support,
            is_off=bool(odd[k]) or each.rms_mm > far[k] if can_judge else None,
            odd=odd[k],
            camera_moved_mm=moved[0],
            camera_turned_deg=moved[1],
        )
        for k, (model, each) in enumerate(zip(models, apart, strict=True))
        for moved in [_camera_displacement(model.calibration)]
    )
    low, high = (tuple(map(float, ends)) for ends in (q.min(axis=0), q.max(axis=0)))
    return TypeComparison(joints, len(q), low, high, units)


def median_model(positions: Sequence[FloatArray]) -> FloatArray:
    """Return positions (n, 3), the coordinates' median of all models' (n, 3), each rigidly aligned to it.

    Starts with the model that is nearest to the others, so that an outlier does not determine the frame.
    """

    def distance(x: FloatArray) -> float:
        return float(np.median([np.linalg.norm(aligned_to(x, other)[0] - x) for other in positions]))

    middle = min(positions, key=distance)
    for _ in range(_Settings.rounds):
        middle = np.median([aligned_to(middle, x)[0] for x in positions], axis=0)
    return middle


@dataclass(frozen=True, eq=False)
class _Figure:
    """One figure of all robots: values and half widths (m,), NaN if a robot's pairs do not determine it."""

    name: str
    unit: str
    values: FloatArray
    half_widths: FloatArray


def _figures(models: Sequence[Model]) -> list[_Figure]:
    by_figure: dict[tuple[str, str], dict[int, tuple[float, float]]] = {}
    for k, model in enumerate(models):
        found = model.calibration
        if found is None:
            continue
        for joint, zero in found.zeros.items():
            if zero is not None:
                by_figure.setdefault((f"zero of {joint}", "rad"), {})[k] = zero.value, zero.half_width
        for axis, figure in zip("xyz", found.marker_xyz, strict=True):
            by_figure.setdefault((f"tool in {axis}", "m"), {})[k] = figure.learnt, figure.half_width
    figures = []
    for (name, unit), of_robots in by_figure.items():
        numbers = np.full((2, len(models)), np.nan)
        for k, (value, half_width) in of_robots.items():
            numbers[:, k] = value, half_width
        if len(of_robots) >= _Settings.min_to_judge:
            figures.append(_Figure(name, unit, *numbers))
    return figures


def _outlying_figures(robot: int, figures: Sequence[_Figure]) -> tuple[OutlyingFigure, ...]:
    tried = sum(int(np.isfinite(figure.values).sum()) for figure in figures)
    found: list[tuple[float, OutlyingFigure]] = []
    for figure in figures:
        own, others = figure.half_widths[robot], figure.half_widths[np.isfinite(figure.half_widths)]
        difference = float(figure.values[robot] - np.nanmedian(figure.values))
        half_width = math.hypot(own, MEDIAN_COSTS * float(np.median(others)) / math.sqrt(len(others)))
        expected_spread = math.hypot(half_width, _quantile(0.975) * _spread(figure.values))
        far = abs(difference) / expected_spread if expected_spread > 0.0 else 0.0
        if far > _quantile(1.0 - 0.5 * _Settings.chance / tried) / _quantile(0.975):
            found.append((far, OutlyingFigure(figure.name, difference, half_width, figure.unit)))
    return tuple(odd for _, odd in sorted(found, key=lambda each: -each[0]))


def _spread(values: FloatArray) -> float:
    """Return the robust 1-sigma of a figure among robots, from the median of their distances to the median."""
    finite = values[np.isfinite(values)]
    return float(np.median(np.abs(finite - np.median(finite))) / _quantile(0.75))


def _camera_displacement(found: ChainCalibration | None) -> tuple[float, float] | tuple[None, None]:
    """Return the distance [mm] and the rotation [°] from the camera pose in robot.toml."""
    if found is None:
        return None, None
    moved = math.dist([each.drawn for each in found.camera_xyz], [each.learnt for each in found.camera_xyz])
    drawn, learnt = (
        Rotation.from_euler("xyz", [getattr(each, which) for each in found.camera_rpy]) for which in ("drawn", "learnt")
    )
    return 1e3 * moved, math.degrees((drawn.inv() * learnt).magnitude())


def by_type(members: Sequence[Member]) -> tuple[dict[tuple[str, ...], list[Member]], list[str]]:
    """Group the robots whose learners answer by the names of their joints; also return why others are left out."""
    types: dict[tuple[str, ...], list[Member]] = {}
    left_out: list[str] = []
    for member in members:
        if member.learner is None:
            left_out.append(f"{member.name}: no learner of it answers")
        elif member.joints is None:
            left_out.append(f"{member.name}: no sampler or solution has reported its joints yet")
        else:
            types.setdefault(member.joints, []).append(member)
    return types, left_out


def compare_types(fleet: Fleet, members: Sequence[Member]) -> tuple[list[TypeComparison], list[str]]:
    """Return a comparison for each type with at least two answering models, and the robots left out with the reason."""
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
        found.append(compare_models(joints, q, models))
    return found, left_out


def _model(fleet: Fleet, robot: Member, q: FloatArray) -> Model:
    if robot.route is None:
        raise BusError("its learner was not found")
    payload = fleet.bus(robot.route).ask_one(Keys(robot.name).predict, encode({"q": q.tolist()}))
    reply = decode(payload, PredictReply)
    x, sigma = np.array(reply.x), np.array(reply.sigma)
    if x.shape != (len(q), 3) or sigma.shape != x.shape or not np.isfinite(x).all():
        raise RequestError("its learner's predictions are not one position a pose")
    calibration = None if robot.learner is None else robot.learner.calibration
    distance = float(np.sqrt(np.square(sigma).sum(axis=1).mean()))
    return Model(robot.name, x, distance, float(np.mean(reply.in_support)), calibration)


def view(comparisons: Sequence[TypeComparison], left_out: Sequence[str]) -> RenderableType:
    parts: list[RenderableType] = []
    for comparison in comparisons:
        parts += [*map(Text, sentences(comparison)), Padding(_table(comparison.units), (1, 0, 1, 0))]
    parts += [Text(f"! not compared: {reason}", style="yellow") for reason in left_out]
    return Group(*parts)


def sentences(comparison: TypeComparison) -> list[str]:
    units = comparison.units
    lines = [
        f"{len(units)} robots with the joints {', '.join(comparison.joints)}, at {comparison.poses} common poses, each "
        "model laid on their median as a whole."
    ]
    if len(units) < _Settings.min_to_judge:
        return [*lines, "Of two robots, it is not possible to say which is the odd one."]
    off = [unit for unit in units if unit.is_off]
    if not off:
        lines.append("None is farther from the others than the models claim to be wrong, and no figure stands out.")
    for unit in off:
        why = [format_figure(odd) for odd in unit.odd[:3]]
        reason = f": {'; '.join(why)}" if why else "; none of its figures stands out alone"
        lines.append(f"{unit.robot} is off by {mm(unit.apart.rms_mm / 1e3)} (RMS){reason}.")
    return lines


def format_figure(odd: OutlyingFigure) -> str:
    """Return an outlying figure as text, such as `zero of elbow +2.1 ± 0.2°`."""
    factor, unit = (math.degrees(1.0), "°") if odd.unit == "rad" else (1e3, " mm")
    half = factor * odd.half_width
    digits = min(max(1 - math.floor(math.log10(half)), 0), 4) if half > 0.0 else 3
    return f"{odd.figure} {factor * odd.difference:+.{digits}f} ± {half:.{digits}f}{unit}"


def _table(units: Sequence[Unit]) -> Table:
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False)
    table.add_column("robot", overflow="fold")
    for name in ("RMS", "max", "claimed", "has data"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("camera moved", justify="right", no_wrap=True)
    table.add_column("stands out from the median by", overflow="fold")
    for unit in units:
        moved = "-"
        if unit.camera_moved_mm is not None and unit.camera_turned_deg is not None:
            moved = f"{mm(unit.camera_moved_mm / 1e3)}, {unit.camera_turned_deg:.2g}°"
        style = "bold red" if unit.is_off else ""
        table.add_row(
            Text(unit.robot, style=style),
            Text(mm(unit.apart.rms_mm / 1e3), style=style),
            mm(unit.apart.max_mm / 1e3),
            mm(unit.claimed_mm / 1e3),
            f"{unit.in_support:.0%}",
            moved,
            "\n".join(map(format_figure, unit.odd)) or "-",
        )
    return table
