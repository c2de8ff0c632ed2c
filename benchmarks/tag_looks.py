"""Moving tags seen by a rolling shutter, and tags on a display whose pixels alias with the camera's.

Run `python -m benchmarks.tag_looks moving|display [--tags N] [--eyes 1|2]`. A tag of 50 mm at 0.45 to 0.7 m swings at
0.7 Hz; each row is rendered at its own time, 20 ms from first to last, exposed for 5 ms. The second frame is compared
with the truth at the time of the tag's middle row. A display has pixels of three coloured stripes on black; its truth
is the position of their luminance.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parent.parent / "tests" / "vision"))

from ball_renderer import SMALL, VGA, Look
from tag_renderer import Sheet, photograph

from benchmarks.tables import Column, Table, tables_option
from bodyschema.interfaces.records import FloatArray, MarkerFix, MarkerMiss
from bodyschema.vision.tags.body import TagBody
from bodyschema.vision.tags.config import TagConfig
from bodyschema.vision.tags.tracker import TagTracker

READOUT_S, SWING_HZ, SIDE_M = 0.02, 0.7, 0.05
TAG = TagConfig(side_m=SIDE_M)
# What the tracker is given: the readout, and the RMS of one that is not known at 30 frames a second.
TOLD = {
    "0": (0.0, 0.0),
    "20 ms": (READOUT_S, 0.0),
    "26 ms, wrong by 30 %": (1.3 * READOUT_S, 0.0),
    "absent": (0.0, 1.0 / 30.0 / 3.0**0.5),
}
# Luminance of red, green and blue stripes is left of a pixel's middle by this share of it.
LEFT = 0.062


@dataclass
class Judged:
    """Errors of fixes (n, 6), position [m] and rotation [rad], beside their claimed uncertainty."""

    errors: list[FloatArray] = field(default_factory=list)
    sigmas: list[FloatArray] = field(default_factory=list)
    misses: Counter[str] = field(default_factory=Counter)

    def add(self, found: MarkerFix | MarkerMiss, rotation: Rotation, x: FloatArray) -> None:
        """Add the errors of one fix."""
        if isinstance(found, MarkerMiss) or found.R is None or found.cov_R is None:
            self.misses[str(getattr(found, "reason", ""))] += 1
            return
        turn = (Rotation.from_quat(found.R) * rotation.inv()).as_rotvec()
        self.errors.append(np.array([*(found.x - x), *turn]))
        self.sigmas.append(np.sqrt([*np.diag(found.cov), *np.diag(found.cov_R)]))

    def cells(self) -> list[object]:
        """Return the cells under `COLUMNS`."""
        misses = "".join(f", {number} `{reason}`" for reason, number in self.misses.items())
        fixes = f"{len(self.errors)}{misses}"
        if not self.errors:
            return [fixes, None, None, None, None]
        off, sigma = np.array(self.errors), np.array(self.sigmas)
        rms = [np.sqrt(np.square(each).mean(axis=0)) for each in (off, sigma)]
        place = [1e3 * each[:3] for each in rms]
        turn = [np.degrees(np.sqrt(np.square(each[3:]).mean())) for each in rms]
        return [fixes, *place, turn, [100.0 * (np.abs(off) < times * sigma).mean() for times in (1.0, 2.0)]]


COLUMNS = (
    Column("fixes"),
    Column("RMS error x y z", "mm", "{:.3f} {:.3f} {:.3f}"),
    Column("claimed", "mm", "{:.3f} {:.3f} {:.3f}"),
    Column("of the turn, claimed", "°", "{:.3f}, {:.3f}"),
    Column("within 1 sigma, 2 sigma", "%", "{:.0f}, {:.0f}"),
)


def some_rotation(rng: np.random.Generator) -> Rotation:
    """Return the random orientation of a tag tilted by 10 to 45° from the camera."""
    axis = np.append(rng.normal(size=2), 0.0)
    tilt = Rotation.from_rotvec(np.radians(rng.uniform(10.0, 45.0)) * axis / np.linalg.norm(axis))
    spin = Rotation.from_euler("z", rng.uniform(0.0, 2.0 * np.pi))
    return tilt * Rotation.from_matrix(np.diag([1.0, -1.0, -1.0])) * spin


def moving(tags: int, eyes: int) -> Table:
    """Return the errors of moving tags, with and without a known readout time."""
    table = Table("tag_moving", [Column("speed"), Column("`readout_s`"), *COLUMNS])
    camera = VGA if eyes == 2 else replace(VGA, baseline_m=0.0)
    look = Look(samples=6, noise_sd=2.0, blur_px=0.6, wall=0.5)
    for speed, spin_deg in ((0.02, 3.0), (0.05, 6.0), (0.1, 12.0), (0.3, 30.0)):
        rng, judged = np.random.default_rng(7), {told: Judged() for told in TOLD}
        for _ in range(tags):
            z = rng.uniform(0.45, 0.7)
            x0 = np.array([rng.uniform(-0.05, 0.15) * z, rng.uniform(-0.22, 0.22) * z, z])
            R0, v, w = some_rotation(rng), rng.normal(size=3), rng.normal(size=3)
            v, w = v * speed / np.linalg.norm(v), w * np.radians(spin_deg) / np.linalg.norm(w)
            omega, phase = 2.0 * np.pi * SWING_HZ, rng.uniform(-1.0, 1.0)

            def at(t: float) -> tuple[Rotation, FloatArray]:
                swung = (np.sin(omega * t + phase) - np.sin(phase)) / omega  # noqa: B023
                return Rotation.from_rotvec(w * swung) * R0, x0 + v * swung  # noqa: B023

            trackers = {told: TagTracker(camera, TagBody.single(TAG), TAG, None, *TOLD[told]) for told in judged}
            for t in (0.0, 1.0 / 30.0):
                (rotation, x), now = at(t), READOUT_S * np.cos(omega * t + phase)
                sheet = Sheet(0, rotation.as_matrix(), x, SIDE_M, moved_m=tuple(now * v), turned_rad=tuple(now * w))
                frame = photograph([replace(sheet, exposed=0.25)], VGA, look, rng, t=t)
                late_s = READOUT_S * (VGA.project(x)[1] / VGA.image_size_px[1] - 0.5)
                for told, tracker in trackers.items():
                    found = tracker.track(frame if eyes == 2 else replace(frame, right=None))
                    if t > 0.0:
                        judged[told].add(found, *at(t + late_s))
        for told, each in judged.items():
            table.add(f"{speed:g} m/s, {spin_deg:g} °/s", told, *each.cells())
    return table


def display(tags: int) -> Table:
    """Return the errors of tags on a display, by display pixels per camera pixel."""
    table = Table("tag_display", [Column("camera"), Column("display pixels a camera pixel"), *COLUMNS])
    camera = replace(SMALL, baseline_m=0.0)
    phone = {"bayer": True, "tone": 1.0 / 2.2, "jpeg": 85}
    for name, kind in (("linear", {}), ("colour mosaic, tone curve, JPEG 85", phone)):
        look = Look(samples=8, noise_sd=2.0, blur_px=0.5, wall=0.4, exposure=0.7, **kind)
        for ratio in (0.5, 0.9, 1.1, 2.0, 0.0):
            rng, judged = np.random.default_rng(3), Judged()
            for k in range(tags):
                side_px = rng.uniform(70.0, 110.0)
                z = SMALL.focal_px * SIDE_M / side_px
                screen = max(1, round(ratio * side_px / 8.0)) if ratio else 0
                x, rotation = (
                    np.array([rng.uniform(-0.08, 0.08) * z, rng.uniform(-0.05, 0.05) * z, z]),
                    some_rotation(rng),
                )
                frame = photograph(
                    [Sheet(0, rotation.as_matrix(), x, SIDE_M, screen=screen)], SMALL, look, rng, t=10.0 * k
                )
                found = TagTracker(camera, TagBody.single(TAG), TAG).track(replace(frame, right=None))
                left = LEFT * SIDE_M / 8.0 / screen if screen else 0.0
                judged.add(found, rotation, x - left * rotation.as_matrix()[:, 0])
            table.add(name, f"{ratio:g}" if ratio else "paper", *judged.cells())
    return table


def main() -> None:
    """Run one of the two benchmarks."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("look", choices=("moving", "display"))
    parser.add_argument("--tags", type=int, default=20)
    parser.add_argument("--eyes", type=int, choices=(1, 2), default=1)
    tables_option(parser)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    table = moving(arguments.tags, arguments.eyes) if arguments.look == "moving" else display(arguments.tags)
    table.save(arguments.tables)


if __name__ == "__main__":
    main()
