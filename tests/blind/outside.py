"""Effects outside the table, which no named effect fits."""

from __future__ import annotations

import numpy as np

from .arms import FLOOR, MOUNT
from .hidden import Kind, Parameters, Site, direction, sign

WANDER_CORNERS = 60


def _mount(_: Site, rng: np.random.Generator) -> Parameters:
    return {"tilt_rad_per_Nm": 1e-4, "sink_m_per_N": 1e-4 * float(rng.uniform(0.02, 0.2))}


def _bend(_: Site, rng: np.random.Generator) -> Parameters:
    return {"bend_rad_per_Nm": 1e-4}


def _of_other(_: Site, rng: np.random.Generator) -> Parameters:
    return {"amplitude": 0.003 * sign(rng)}


def _touch(site: Site, rng: np.random.Generator) -> Parameters:
    lower, upper = site.arm.ranges[site.arm.read.index(str(site.source))]
    at, width = lower + (upper - lower) * rng.uniform(0.3, 0.7), (upper - lower) * rng.uniform(0.04, 0.1)
    return {"amplitude": 0.003 * sign(rng), "at": float(at), "width": float(width)}


def _wander(site: Site, rng: np.random.Generator) -> Parameters:
    return {"amplitude": 0.003, "seed": float(rng.integers(2**31)), "interval_s": site.duration_s / WANDER_CORNERS}


def _vergence(_: Site, rng: np.random.Generator) -> Parameters:
    return {"vergence_rad": 0.001 * sign(rng)}


def _growth(site: Site, rng: np.random.Generator) -> Parameters:
    along = 0.003 * direction(rng)
    return {"dx_m": along[0], "dy_m": along[1], "dz_m": along[2], "tau_s": rng.uniform(0.1, 0.5) * site.duration_s}


def _bearing(site: Site) -> tuple[str, ...]:
    """Return the joints that move the arm's weight: all from floor to marker but a first vertical one."""
    names = _on_arm(site)
    first = site.arm.joint(names[0])
    upright = site.arm.joint(MOUNT).rpy == (0.0, 0.0, 0.0) and first.axis == (0.0, 0.0, 1.0) and not any(first.rpy)
    return names[1:] if upright else names


def _on_arm(site: Site) -> tuple[str, ...]:
    """Return the joints that are read between floor and marker, from the floor on."""
    parents = {joint.child: joint for joint in site.arm.joints}
    link, way = site.arm.marker_link, []
    while link != FLOOR:
        way.append(parents[link].name)
        link = parents[link].parent
    return tuple(name for name in reversed(way) if name in site.arm.read)


def _source_only(site: Site) -> tuple[str, ...]:
    return (str(site.source),)


def _both(site: Site) -> tuple[str, ...]:
    return (str(site.where), str(site.source))


OUTSIDE: dict[str, Kind] = {
    "soft_mount": Kind(
        "robot",
        ("tilt_rad_per_Nm", "sink_m_per_N"),
        _mount,
        0.01,
        "springs under the base: turn about the mount's x and y per moment, and sinking per force, of the arm's weight",
        bears=True,
        outside=True,
        drivers=_on_arm,
        beside_only=True,
    ),
    "link_bend": Kind(
        "joint",
        ("bend_rad_per_Nm",),
        _bend,
        0.02,
        "the joint's link bends half way to the next joint, about both axes across it, per moment of the weight beyond",
        bears=True,
        outside=True,
        drivers=_bearing,
    ),
    "square_of_other": Kind(
        "pair",
        ("amplitude",),
        _of_other,
        0.2,
        "reading minus true position is amplitude times the square of the source's position",
        outside=True,
        drivers=_source_only,
    ),
    "product_of_two": Kind(
        "pair",
        ("amplitude",),
        _of_other,
        0.2,
        "reading minus true position is amplitude times the joint's own times the source's position",
        outside=True,
        drivers=_both,
    ),
    "cable_touches": Kind(
        "pair",
        ("amplitude",),
        _touch,
        0.2,
        "reading minus true position is amplitude times tanh((source − at) / width): a hose comes to lie on the link",
        outside=True,
        drivers=_source_only,
    ),
    "wandering_zero": Kind(
        "joint",
        ("amplitude",),
        _wander,
        0.1,
        "reading minus true position is amplitude times a slow random walk of RMS 1, drawn from seed",
        outside=True,
        drivers=lambda _: (),
    ),
    "growing_link": Kind(
        "joint",
        ("dx_m", "dy_m", "dz_m"),
        _growth,
        0.1,
        "shift of the joint's frame in its parent at the end of warming up; before that times 1 − exp(−t/tau)",
        outside=True,
        drivers=lambda _: (),
    ),
    "vergence": Kind(
        "robot",
        ("vergence_rad",),
        _vergence,
        0.02,
        "the right eye is turned by this about its y axis (to its right)",
        outside=True,
        drivers=lambda _: (),
    ),
}
