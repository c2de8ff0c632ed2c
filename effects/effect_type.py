"""Define effects: their parameters, places, influence on a run, search and export.

Each effect is one class in one file of `catalogue`, a subclass of the class of its stage.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, Literal, Protocol, Self, get_args

import numpy as np
from numpy.typing import NDArray

from bodyschema.effects.joint_errors import JointErrors, Rows
from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.errors import RobotError
from bodyschema.interfaces.records import FloatArray, frozen_array
from bodyschema.robot.description import RobotDescription
from bodyschema.robot.suggest import did_you_mean
from bodyschema.robot.urdf import PointMass
from kbmaps import RigidChain

from .gravity import GravityLoad
from .motion import Motion
from .optics import Optics
from .parameter import Parameter, Place

# Name, where, source, and ordinal among effects of one kind at one place.
Identity = tuple[str, str | None, str | None, int]
Stage = Literal["encoder", "structure", "tool", "camera", "time"]
STAGES: tuple[Stage, ...] = get_args(Stage)
# How the last parameter is searched: not at all, as a moment, a number of cycles, a width that is also the amount, one
# of `trial_shapes`, or a load of those shares of the largest one.
ShapeSearch = Literal["none", "moment", "cycles", "width", "shape", "load"]


class EffectSettings:
    # Largest step of a period or a time constant, as a share of it; largest change in one step.
    shape_step, shape_change = 0.3, 2.0
    max_moments = 2  # two moments at one place are told apart; further ones are a drift
    step = 1e-6  # step of numerical derivatives [rad, m, or a parameter's unit]


class SimulatedArm(Protocol):
    """Properties of its simulation that an effect may use; see `Simulation`."""

    @property
    def bears_weight(self) -> bool: ...
    @cached_property
    def gravity(self) -> GravityLoad: ...
    @property
    def latency_s(self) -> float: ...
    @cached_property
    def springs(self) -> FloatArray: ...
    @cached_property
    def upward(self) -> list[bool]: ...
    def place(self, effect: Effect) -> Place: ...
    def unloaded(self, readings: Motion) -> FloatArray: ...


class SimulationRun(Protocol):
    """Properties of a run that an effect may use for its derivatives; see `PipelineRun`."""

    @property
    def simulation(self) -> SimulatedArm: ...
    @property
    def motion(self) -> Motion: ...
    @property
    def readings(self) -> Motion: ...
    @property
    def q(self) -> FloatArray: ...
    @property
    def chain(self) -> RigidChain: ...
    @property
    def frames(self) -> FloatArray: ...
    @property
    def x_true(self) -> FloatArray: ...
    @property
    def x_placed(self) -> FloatArray: ...
    @property
    def x_camera(self) -> FloatArray: ...
    @cached_property
    def by_joint(self) -> FloatArray: ...
    @cached_property
    def by_marker(self) -> FloatArray: ...
    @cached_property
    def torques(self) -> FloatArray: ...
    def by_optics(self, effect: Effect) -> FloatArray: ...
    def by_report(self, effect: Effect) -> FloatArray: ...
    def seen(self, moved: FloatArray) -> FloatArray: ...
    def since_moved(self, moved: FloatArray) -> FloatArray: ...
    def optical(self, moved: FloatArray) -> FloatArray: ...


class EffectType(ABC):
    """One way in which reality may differ from the simulation."""

    name: ClassVar[str]  # as in `diagnosis.json`
    stage: ClassVar[Stage]  # the stage of the simulation at which it acts
    rank: ClassVar[int] = 100  # its place in lists among the effects of its stage; of equal rank, by name
    at_joint: ClassVar[bool] = False  # True if it acts at a joint
    takes_source: ClassVar[bool] = False  # True if another joint causes it
    turns_only: ClassVar[bool] = False  # True if only a revolute joint can have it
    needs_times: ClassVar[bool] = False  # True if it needs times, not only an order
    needs_stereo: ClassVar[bool] = False  # True if it needs the stereo calibration
    needs_weight: ClassVar[bool] = False  # True if it needs joints that bear the arm's weight
    # True if a subset of its amounts may differ from nominal, as for a link that is too long but straight
    in_parts: ClassVar[bool] = False
    rigid: ClassVar[bool] = False  # True if a rigid chain can hold it
    scales_all: ClassVar[bool] = False  # True if a common error of all links' lengths looks like it
    is_spring: ClassVar[bool] = False  # True if its joint deflects in proportion to its load
    is_load: ClassVar[bool] = False  # True if it is a mass that the URDF does not state
    moves_joints: ClassVar[bool] = False  # True if the true joint angles differ from the readings
    is_zero: ClassVar[bool] = False  # True for a joint offset, which is often wrong at several joints
    of_drive: ClassVar[bool] = False  # True for a periodic error, of which every drive has a little
    stays_as: ClassVar[str | None] = None  # name of its permanent form, for an effect that begins at a moment
    drifts: ClassVar[bool] = False  # True if it grows with time
    remembers: ClassVar[bool] = False  # True if it depends on earlier readings
    by_direction: ClassVar[bool] = False  # True if only the direction of the moves matters, not their size
    is_linear: ClassVar[bool] = True  # True if it is proportional to its amounts
    search: ClassVar[ShapeSearch] = "none"  # how its last parameter is searched
    refines: ClassVar[bool] = False  # True if to first order it looks like a simpler effect, which it may replace
    # factor on the number of shapes tried, for one that has a shape more than a simpler effect
    further_trials: ClassVar[int] = 1
    # reason why a model of the arm does not hold it
    no_counterpart: ClassVar[str] = "this effect has no counterpart there"

    @abstractmethod
    def parameters(self, prismatic: bool) -> tuple[Parameter, ...]:
        """Return its parameters at a revolute or prismatic joint; both are the same if it does not act at a joint."""

    @abstractmethod
    def jacobian(self, run: SimulationRun, effect: Effect) -> FloatArray:
        """Return derivatives (n, 3, p) of the measurements by the effect's values; zeros for those not amounts."""

    @cached_property
    def turning(self) -> tuple[Parameter, ...]:
        return self.parameters(False)

    @cached_property
    def sliding(self) -> tuple[Parameter, ...]:
        return self.parameters(True)

    @cached_property
    def begins(self) -> bool:
        """True if it begins at a moment, its last parameter `t0`."""
        return "t0" in [parameter.name for parameter in self.turning]

    @property
    def is_like_tolerances(self) -> bool:
        """True if small errors of every link may replace it."""
        return (self.rigid and not self.is_zero) or self.scales_all

    @property
    def depends_on_path(self) -> bool:
        """True if it depends on the path between two readings, which was not observed."""
        return self.remembers

    @property
    def changes_with_time(self) -> bool:
        """True if the same pose is measured differently later, as with correlated noise."""
        return self.begins or self.drifts

    @property
    def is_transient(self) -> bool:
        """True if it disappears once the arm is at rest and warm."""
        return self.depends_on_path or self.drifts

    @property
    def is_periodic(self) -> bool:
        """True if its last parameter is a number of cycles per turn or metre."""
        return self.search == "cycles"

    @property
    def most_at_one_place(self) -> int:
        """Maximum of effects of this type at one place."""
        return EffectSettings.max_moments if self.begins else 1

    def is_free(self, robot: RobotDescription) -> bool:
        """Return True if it changes a parameter unknown to robot.toml: it is fitted first, and never a finding."""
        return False

    def trial_shapes(self, motion: Motion) -> FloatArray:
        """Return the values (m,) of its last parameter to try, in increasing order."""
        raise NotImplementedError(f"{self.name} has no shape to search")

    def growth(self, motion: Motion, shape: float) -> FloatArray:
        """Return the fraction of its amounts (n,) that has developed, for a drift whose last parameter is `shape`."""
        raise NotImplementedError(f"{self.name} does not grow")

    def shape_step(self, run: SimulationRun, effect: Effect, k: int) -> float:
        """Return the largest step of value k, a smooth shape, for which its derivative is still valid."""
        return EffectSettings.shape_step * float(effect.values[k])

    def bounded(self, effect: Effect, k: int, value: float, motion: Motion) -> float:
        """Limit value k, a smooth shape, to its valid range and to one step from the present one."""
        factor = EffectSettings.shape_change
        return float(np.clip(value, effect.values[k] / factor, factor * effect.values[k]))

    def unknown_state(self, run: SimulationRun, effect: Effect) -> NDArray[np.bool_]:
        """Return rows (n,) at which its state is not known well enough, as before the first contact of a backlash."""
        return np.zeros(len(run.motion), dtype=np.bool_)

    def correction_rows(self, effect: Effect, place: Place) -> Rows | None:
        """Return its entries in the tables of correction.json; None if the format cannot hold it."""
        return None

    def add_to(self, joint: JointErrors, effect: Effect) -> str | None:
        """Add it to the errors of its joint for a rigid-body simulator; return the reason if it cannot be added."""
        return self.no_counterpart

    def finding(self, at: str, numbers: Mapping[str, float]) -> str:
        """Describe it in a clause, if no presenter has a sentence. `at` names the joint, if any."""
        amounts = ", ".join(f"{name} = {value:.3g}" for name, value in numbers.items())
        return f"{at or 'the arm'} has {self.name.replace('_', ' ')} ({amounts})"

    def remedy(self, at: str) -> str:
        """Return a remedy, if no presenter has one."""
        return f"See what could cause it{f' at {at}' if at else ''}; extended.toml takes it into account"


class StructureEffect(EffectType):
    """An effect on the links' poses: a moved joint frame, or a joint that deflects under the arm's weight."""

    stage = "structure"
    has_slack: ClassVar[bool] = False  # True if `slack` gives a deflection

    def frame(self, values: FloatArray) -> FloatArray | None:
        """Return the pose (4, 4) of its joint's frame in the nominal frame; None if it does not move it."""
        return None

    def compliance(self, values: FloatArray) -> float:
        """Return the deflection of its joint per load [rad/(N·m), m/N]."""
        return 0.0

    def slack(self, torque: FloatArray, values: FloatArray, side: float) -> tuple[FloatArray, float]:
        """Return the further deflection of its joint (n,) [rad, m] under a torque (n,), and its side at the last row.

        Args:
            side: side before the first row: 1 or -1; 0 if unknown.
        """
        return np.zeros_like(torque), side

    def load(self, gravity: GravityLoad, values: FloatArray) -> GravityLoad | None:
        """Return the load of a mass that the URDF does not state; None without one."""
        return None

    def point_mass(self, values: FloatArray) -> PointMass | None:
        """Return this mass, its centre in the marker's link; None without one."""
        return None


class ToolEffect(EffectType):
    """An effect on the marker's position in its link, from its moment on if it has one."""

    stage = "tool"

    @abstractmethod
    def shift(self, values: FloatArray) -> FloatArray:
        """Return the marker's displacement (3,) [m] in its link."""


class CameraEffect(EffectType):
    """An effect on the camera's pose, or on the positions that it reports.

    An effect of any other kind overrides `reported` and sets `alters_report`; its derivative is then numerical.
    """

    stage = "camera"
    no_counterpart = "an error of the measurement, not of the arm"
    alters_report: ClassVar[bool] = False

    def pose(self, values: FloatArray) -> FloatArray | None:
        """Return the camera's pose (4, 4) in its previous frame, from its moment on if it has one; None if unmoved."""
        return None

    def optics(self, values: FloatArray) -> Optics | None:
        """Return the differences of the lenses from the calibration; None without any."""
        return None

    def reported(
        self, x: FloatArray, motion: Motion, values: FloatArray, calibration: StereoCalibration | None
    ) -> FloatArray:
        """Return the reported points (n, 3) [m] with this effect, from those without it x (n, 3) [m]."""
        return x

    def jacobian(self, run: SimulationRun, effect: Effect) -> FloatArray:
        """Return derivatives (n, 3, p) of the measurements by the effect's values, by central differences."""
        return run.by_report(effect)


class TimeEffect(EffectType):
    """An effect of time: a delay of the images, or a drift of the measurements."""

    stage = "time"
    needs_times = True
    no_counterpart = "it depends on time"

    def delay_s(self, values: FloatArray) -> float:
        """Return the delay of the images' timestamps [s]."""
        return 0.0

    def drift(self, motion: Motion, values: FloatArray) -> FloatArray | None:
        """Return the shift (n, 3) [m] added to the measurements; None without one."""
        return None


EFFECT_TYPES: dict[str, EffectType] = {}  # all effects by name, in order; `registry` enters them


@dataclass(frozen=True, eq=False)
class Effect:
    """An effect of a robot."""

    kind: EffectType  # its type
    # where, source: the joint it acts on, and the joint that causes it; None without one
    where: str | None
    source: str | None
    values: FloatArray  # its numbers (p,), in the order of `parameters`
    prismatic: bool = False  # True for a prismatic joint
    ordinal: int = 0  # number among several of one kind at one place, counted from 0
    free: tuple[int, ...] | None = None  # indices of the amounts that may differ from nominal; None for all

    @classmethod
    def at(
        cls,
        robot: RobotDescription,
        name: str,
        where: str | None = None,
        source: str | None = None,
        values: Mapping[str, float] | Sequence[float] | FloatArray | None = None,
    ) -> Self:
        """Create the effect called `name`; without `values` it has no influence yet.

        Raises:
            RobotError: the effect, joint or number does not exist, or the effect cannot act there.
        """
        if name not in EFFECT_TYPES:
            raise RobotError(f"there is no effect {name!r}", remedy=did_you_mean(name, EFFECT_TYPES))
        kind = EFFECT_TYPES[name]
        for joint, required, field_name in ((where, kind.at_joint, "where"), (source, kind.takes_source, "source")):
            if required and joint is None:
                raise RobotError(f"{name} needs a joint: {field_name} is missing", remedy=f"Name one of {_list(robot)}")
            if not required and joint is not None:
                raise RobotError(f"{name} has no {field_name}", remedy=f"Take {field_name} = {joint!r} out")
            if joint is not None and joint not in robot.joints:
                raise RobotError(
                    f"{field_name} = {joint!r}: no joint of this robot", remedy=did_you_mean(joint, robot.joints)
                )
        if source is not None and source == where:
            raise RobotError(f"{name}: where and source are the same joint", remedy="Name another joint as source")
        prismatic = where is not None and bool(robot.chain.prismatic[robot.joints.index(where)])
        if prismatic and kind.turns_only:
            remedy = "An eccentric pinion of a slide is a joint_ripple of its turns a metre (cycles_per_m)"
            raise RobotError(f"{name} cannot sit at {where!r}, which slides", remedy=remedy)
        if kind.needs_stereo and robot.calibration is None:
            raise RobotError(f"{name} needs a stereo camera", remedy="Add focal_px and its fellows to [camera]")
        parameters = kind.sliding if prismatic else kind.turning
        return cls(kind, where, source, _values(parameters, values, name), prismatic)

    @property
    def name(self) -> str:
        return self.kind.name

    @property
    def key(self) -> tuple[str, str | None, str | None]:
        """Identity without numbers: name, where, source."""
        return self.kind.name, self.where, self.source

    @property
    def identity(self) -> Identity:
        """Identity among the effects of one simulation: `key` and `ordinal`."""
        return *self.key, self.ordinal

    @cached_property
    def frame(self) -> FloatArray | None:
        """Pose (4, 4) of its joint's frame in the nominal frame; None if it does not move it."""
        return self.kind.frame(self.values) if isinstance(self.kind, StructureEffect) else None

    @cached_property
    def pose(self) -> FloatArray | None:
        """Pose (4, 4) of the camera in its previous frame; None if it does not move it."""
        return self.kind.pose(self.values) if isinstance(self.kind, CameraEffect) else None

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return self.kind.sliding if self.prismatic else self.kind.turning

    @cached_property
    def all_amounts(self) -> list[int]:
        """Indices of the values that are amounts."""
        return [k for k, parameter in enumerate(self.parameters) if parameter.is_amount]

    @cached_property
    def amounts(self) -> list[int]:
        """Indices of the values that are amounts, and free."""
        own = self.all_amounts
        return own if self.free is None else [k for k in own if k in self.free]

    @property
    def described(self) -> list[int]:
        """Indices of the values that describe it: all except amounts that are not free."""
        amounts = self.amounts
        return [k for k, parameter in enumerate(self.parameters) if k in amounts or not parameter.is_amount]

    @cached_property
    def shapes(self) -> list[int]:
        """Indices of the smooth shape values: periods and time constants."""
        return [k for k, parameter in enumerate(self.parameters) if parameter.smooth]

    @property
    def is_valid(self) -> bool:
        """True if every value that must not be negative is not."""
        return not any(p.never_negative and value < 0.0 for p, value in zip(self.parameters, self.values, strict=True))

    def with_values(self, values: FloatArray) -> Effect:
        """Return the same effect with other values (p,)."""
        # Several times as fast as `replace`.
        frozen = frozen_array(values)
        return Effect(self.kind, self.where, self.source, frozen, self.prismatic, self.ordinal, self.free)

    def with_amounts(self, amounts: FloatArray | float) -> Effect:
        """Return the same effect with other amounts (p,), or with all of them equal."""
        values = self.values.copy()
        values[self.amounts] = amounts
        return self.with_values(values)

    def with_free_amounts(self, free: tuple[int, ...] | None) -> Effect:
        """Return the same effect with these amounts free (None for all) and the others nominal."""
        freed = replace(self, free=free)
        fixed = [k for k in range(len(self.values)) if k not in freed.described]
        values = self.values.copy()
        values[fixed] = [self.parameters[k].nominal for k in fixed]
        return freed.with_values(values)

    def with_ordinal(self, ordinal: int) -> Effect:
        """Return another effect of the same kind and place, with the same numbers."""
        return replace(self, ordinal=ordinal)

    def value(self, name: str) -> float:
        """Return the value called `name`; raise KeyError if it is missing."""
        named = dict(zip([parameter.name for parameter in self.parameters], self.values.tolist(), strict=True))
        return named[name]

    def table(self) -> dict[str, Any]:
        """Return the effect as a table of `extended.toml`."""
        head = {"effect": self.name, "where": self.where, "source": self.source}
        numbers = {self.parameters[k].name: float(self.values[k]) for k in self.described}
        return {key: value for key, value in head.items() if value is not None} | numbers


def _values(
    parameters: tuple[Parameter, ...], given: Mapping[str, float] | Sequence[float] | FloatArray | None, name: str
) -> FloatArray:
    defaults = [p.usual if p.nominal is None else p.nominal for p in parameters]
    if given is None:
        return frozen_array(defaults)
    if isinstance(given, Mapping):
        names = [p.name for p in parameters]
        for key in given:
            if key not in names:
                raise RobotError(f"{name} has no number {key!r}", remedy=did_you_mean(key, names))
        given = [given.get(p.name, default) for p, default in zip(parameters, defaults, strict=True)]
    values = np.asarray(given, dtype=np.float64)
    if values.shape != (len(parameters),):
        raise RobotError(f"{name} has {len(parameters)} numbers, not {values.size}")
    for parameter, value in zip(parameters, values, strict=True):
        if not np.isfinite(value) or (parameter.positive and value <= 0.0):
            raise RobotError(f"{name}: {parameter.name} = {value:g} cannot be")
    return frozen_array(values)


def _list(robot: RobotDescription) -> str:
    return ", ".join(robot.joints)
