"""Figure 6: seven joints, the exact map, and a marker displaced by 250 mm."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bodyschema.interfaces.records import FloatArray
from kbmaps import ChainTolerances, RigidChain

from .arm import JOINTS, arm, beside, longer_tool
from .experiment import Column, Comparison, Curve, Experiment, Panel, Reading, Run, Tests
from .models import Knowledge
from .stream import EARLY, RULE, Stream, background, bernstein_map, in_stages, learn_stream, papers_rule
from .walk import WALK_SIGMA, walk

MOVED_M = 0.250
TEST_POSES = 1_000
PAPERS_CYCLES = 1_800
SIGMAS_M = {"without noise": 0.0, "σ = 20 mm": 0.020}
COLOURS = {"without noise": ("tab:red", "lightcoral", "--"), "σ = 20 mm": ("tab:orange", "burlywood", "-")}
NEAR, ANYWHERE = "near the walk", "anywhere"
_PAPER = "about 50 mm"


def fig6(run: Run, *, online: int = 1_700, cycles: int = 3_000) -> Experiment:
    """Run the paper's rule from the exact map of the old tool, and other models that know the arm but not the tool."""
    nominal = arm(7)
    chain = longer_tool(nominal, MOVED_M)
    run.say(f"a walk of {online:,} pairs through the sampler")
    q = walk(run.rng, online, JOINTS[7], say=run.say)
    order, tests = in_stages(run.rng, online, cycles), _tests(run.rng, q, chain)
    known = Knowledge(nominal, ChainTolerances(tool=MOVED_M / np.sqrt(3.0)), np.pi)
    streams = {
        noise: Stream(noise, q, chain.positions(q) + sigma * run.rng.normal(size=(online, 3)), sigma, order, tests)
        for noise, sigma in SIGMAS_M.items()
    }
    found = {
        noise: learn_stream(stream, nominal, known, run.say, tool_changed=True) for noise, stream in streams.items()
    }
    readings = [
        Reading(
            f"after {PAPERS_CYCLES:,} cycles", f"{noise}; {test}", _PAPER, found[noise][RULE][test].at(PAPERS_CYCLES)
        )
        for test in tests
        for noise in streams
    ]
    readings += _other_readings(run, nominal, chain, streams, online, cycles)
    behind = background(bernstein_map(nominal), streams["without noise"], run.say)
    panels = [
        Panel(
            "as in the paper, tested near the walk (pale: anywhere)", [*behind, *_papers_curves(found)], as_paper=True
        ),
        Panel(
            f"other models, {NEAR}",
            _models_curves(found),
            styles={style: noise for noise, (*_, style) in reversed(COLOURS.items())},
        ),
    ]
    title = "Figure 6: tool moved by 250 mm, 7 joints, 1,700 online, then permuted"
    return Experiment("fig6", title, "cycles", panels, readings, _comparison(found, online), _NOTES)


_NOTES = (
    "The paper does not say where its test poses lie: near the walk and anywhere (normally distributed, σ = 22°) are "
    "both given. A walk in steps of 1° to 3° over all joints sees little of seven dimensions in 1,700 steps.",
    "The paper's rule: eq. (20) with μ0 = 1, α = 60° unless said, 1,700 pairs as they come, then permuted. The marker "
    "is moved along the tool.",
    "This learner is told of the other tool; it learns the 1,700 pairs once and replays by itself. The other models "
    "know the arm exactly, and of the marker that it was moved by 250 mm somewhere. Nobody but this learner is told "
    "the noise.",
)


def _tests(rng: np.random.Generator, q: FloatArray, chain: RigidChain) -> Tests:
    near, far = beside(rng, q, TEST_POSES), WALK_SIGMA * rng.normal(size=(TEST_POSES, chain.joints))
    return {NEAR: (near, chain.positions(near)), ANYWHERE: (far, chain.positions(far))}


def _other_readings(
    run: Run, nominal: RigidChain, chain: RigidChain, streams: dict[str, Stream], online: int, cycles: int
) -> list[Reading]:
    """Run the paper's rule under other interpretations of its set-up."""
    run.say("a walk of larger steps")
    noisy = streams["σ = 20 mm"]
    true = chain.positions(noisy.q)
    per_vector = replace(noisy, x=true + (noisy.x - true) / np.sqrt(3.0))
    q = walk(run.rng, online, JOINTS[7], each_joint=True, say=run.say)
    tests = _tests(run.rng, q, chain)
    each_joint = Stream("", q, chain.positions(q), 0.0, in_stages(run.rng, online, cycles), tests)
    across = nominal.with_tool(MOVED_M * _across(nominal.fixed[-1][:3, 3]))
    tests_across = {test: (poses, across.positions(poses)) for test, (poses, _) in noisy.tests.items()}
    sideways = replace(streams["without noise"], x=across.positions(noisy.q), tests=tests_across)
    start = bernstein_map(nominal)
    variants = {
        "σ = 20 mm per vector": (start, per_vector),
        "without noise; steps of 1° to 3° a joint": (start, each_joint),
        "without noise; marker moved across the tool": (start, sideways),
        "without noise; α = 45°": (bernstein_map(nominal, np.radians(45.0)), streams["without noise"]),
    }
    readings: list[Reading] = []
    for name, (prior, stream) in variants.items():
        short = replace(stream, name=name, order=stream.order[:PAPERS_CYCLES])
        for test, curve in papers_rule(prior, short, run.say).items():
            readings.append(Reading(f"after {PAPERS_CYCLES:,} cycles", f"{name}; {test}", _PAPER, curve.mean[-1]))
    return readings


def _across(tool: FloatArray) -> FloatArray:
    """Return a unit vector (3,) perpendicular to the tool."""
    across: FloatArray = np.cross(tool, np.eye(3)[np.argmin(np.abs(tool))]).astype(np.float64)
    return across / np.linalg.norm(across)


def _papers_curves(found: dict[str, dict[str, dict[str, Curve]]]) -> list[Curve]:
    curves: list[Curve] = []
    for noise, (colour, pale, _) in COLOURS.items():
        near, far = found[noise][RULE][NEAR], found[noise][RULE][ANYWHERE]
        curves.append(replace(far, name=f"{noise}, {ANYWHERE}", colour=pale, largest=[]))
        curves.append(replace(near, name=f"{noise}, {NEAR}", colour=colour))
    return curves


def _models_curves(found: dict[str, dict[str, dict[str, Curve]]]) -> list[Curve]:
    return [
        replace(curves[NEAR], style=COLOURS[noise][2])
        for noise, of_noise in reversed(found.items())
        for curves in of_noise.values()
    ]


def _comparison(found: dict[str, dict[str, dict[str, Curve]]], online: int) -> Comparison:
    columns = [(noise, test, n) for noise in found for test in (NEAR, ANYWHERE) for n in (EARLY, online)]
    return Comparison(
        "mean error of other models on the same pairs",
        [Column(f"{noise}, {test}", n) for noise, test, n in columns],
        {name: [found[noise][name][test].at(n) for noise, test, n in columns] for name in next(iter(found.values()))},
    )
