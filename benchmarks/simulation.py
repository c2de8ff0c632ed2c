"""Figures of the simulation: `python -m benchmarks.simulation [--seeds N] [--seconds S] [--frames F]`.

Over seeds, on the shipped upper body: share of frames 1..3 degrees after their predecessor, share in which both eyes
see the ball, covered share of each joint's range, distance of the nominal model from the truth, and the real-time
factor of the mechanics alone. Then stereo frames a second with the renderer running in parallel.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from benchmarks.tables import Column, Table, tables_option
from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.description import RobotDescription
from bodyschema.sim_backend import SimConfig, SimWorld, model_file, true_chain
from bodyschema.sim_backend.physics import Physics
from bodyschema.sim_backend.truth import TrueRobot

# The longer tool: the shipped one's ball moved by 250 mm.
LONG_TOOL = (0.23, 0.0, -0.37)


def guide(
    robot: RobotDescription, calibration: StereoCalibration, config: SimConfig, seconds: float, tool: FloatArray
) -> tuple[FloatArray, float, float]:
    """Return readings (n, d) [rad] at the frames' times, the share of visible frames, and the real-time factor."""
    truth = TrueRobot.draw(robot, config)
    q, readings, visible = np.zeros(len(robot.joints)), [], []
    spent = 0.0
    with Physics(truth, calibration, config) as physics:
        if not np.array_equal(tool, physics.marker_xyz):
            physics.change_tool(tool)
        while physics.steps < seconds * physics.rate_hz:
            start = time.perf_counter()
            physics.step()
            if physics.steps % (physics.rate_hz // config.encoders.rate_hz) == 0:
                q = physics.read_encoders()
            spent += time.perf_counter() - start
            if physics.steps % (physics.rate_hz // config.camera.rate_hz) == 0:
                readings.append(q)
                seen = physics.sight.visible((physics.scene().angles + truth.offsets)[None])
                visible.append(bool(seen[0]))
    return np.array(readings), float(np.mean(visible)), seconds / spent


def report_guiding(
    robot: RobotDescription, calibration: StereoCalibration, seeds: int, seconds: float, tool: FloatArray
) -> FloatArray:
    """Print one line a seed, and the mean; return the figures (seeds, 7)."""
    print("seed   1..3 deg   < 1 deg   > 3 deg   visible   least covered   nominal error   times real time")
    rows = []
    for seed in range(1, seeds + 1):
        config = SimConfig(seed=seed)
        q, visible, speed = guide(robot, calibration, config, seconds, tool)
        steps = np.degrees(np.linalg.norm(np.diff(q, axis=0), axis=1))
        nominal = robot.chain.with_tool(tool - np.array(robot.robot.marker_xyz))
        error_mm = 1e3 * np.linalg.norm(nominal.positions(q) - true_chain(robot, config, tool).positions(q), axis=1)
        covered = np.ptp(q, axis=0) / (robot.upper - robot.lower)
        good, short, far = ((steps >= 1) & (steps <= 3)).mean(), (steps < 1).mean(), (steps > 3).mean()
        rows.append([good, short, far, visible, covered.min(), error_mm.mean(), speed])
        _print_row(f"{seed:4}", rows[-1])
    _print_row("mean", list(np.mean(rows, axis=0)))
    return np.array(rows)


def report_frames(robot: RobotDescription, frames: int) -> None:
    """Print stereo frames a second with the renderer's process running beside the mechanics, without tracking."""
    with SimWorld(robot, SimConfig()) as world, world.joints, world.camera:
        world.camera.read(30.0)
        start, simulated = time.perf_counter(), world.now()
        for _ in range(frames):
            frame = world.camera.read(30.0)
            while (reading := world.joints.read(0.0)) is not None and frame is not None and reading.t < frame.t:
                continue
        seconds = time.perf_counter() - start
        print(f"{frames / seconds:.1f} stereo frames/s, {(world.now() - simulated) / seconds:.2f} times real time")


def _print_row(label: str, row: list[float]) -> None:
    good, short, far, visible, covered, error_mm, speed = row
    print(
        f"{label}   {good:8.1%}   {short:7.1%}   {far:7.1%}   {visible:7.1%}   {covered:13.0%}"
        f"   {error_mm:10.1f} mm   {speed:15.1f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10, help="number of seeds, from 1")
    parser.add_argument("--seconds", type=float, default=60.0, help="simulated seconds of each")
    parser.add_argument("--frames", type=int, default=200, help="stereo frames to time")
    tables_option(parser)
    arguments = parser.parse_args()
    robot = RobotDescription.load(model_file("upper_body"))
    assert robot.calibration is not None
    columns = [
        Column("guided with"),
        Column("frames 1° to 3° after their predecessor, mean (worst)", "%", "{:.1f} ({:.1f})"),
        Column("farther than 3°", "%", "{:.1f}"),
        Column("ball visible to both cameras, mean (worst)", "%", "{:.1f} ({:.1f})"),
        Column("nominal model's error, mean (range)", "mm", "{:.1f} ({:.0f} to {:.0f})"),
        Column("times real time", "", "{:.1f}"),
    ]
    table = Table("simulated_robot", columns)
    for name, tool in (("the shipped tool", robot.robot.marker_xyz), ("a tool 250 mm longer", LONG_TOOL)):
        print(f"guided with {name} for {arguments.seconds:g} s")
        found = report_guiding(robot, robot.calibration, arguments.seeds, arguments.seconds, np.array(tool))
        good, _, far, visible, _, error_mm, speed = found.T
        shares = [[100.0 * each.mean(), 100.0 * each.min()] for each in (good, visible)]
        errors_mm = [error_mm.mean(), error_mm.min(), error_mm.max()]
        table.add(name, shares[0], 100.0 * far.mean(), shares[1], errors_mm, speed.mean())
    table.save(arguments.tables)
    report_frames(robot, arguments.frames)


if __name__ == "__main__":
    main()
