"""Golden outputs: `python -m tests.goldens FILE [--data FOLDER] [--seeds N]` writes FILE, or compares with it.

Written before a change and compared after it: a move keeps every figure, a merge keeps it to 1e-9. Figures are the
predictions and sigmas of each model, the online learner on a guided arm, diagnoses of hidden cases, and the opening of
files that earlier releases wrote; with --data, the online learner on the recordings in that folder as well.
Every figure is one line of JSON, so that `diff` shows what changed.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # sums in another order differ in the last digits

import msgspec
import numpy as np

from benchmarks.rough_arm import ROUGH, rough_arm
from bodyschema.daemon.learner.checkpoint import CheckpointError, read_checkpoint
from bodyschema.diagnosis.diagnosis import diagnose
from bodyschema.diagnosis.report.conclusion import conclusion
from bodyschema.effects import load_simulation
from bodyschema.interfaces.records import FloatArray, Pair
from bodyschema.learning.config import LearnerConfig
from bodyschema.learning.nominal import NominalModel
from bodyschema.learning.online_learner import OnlineLearner
from bodyschema.learning.solvers.solver import DirectSolver
from bodyschema.recordings.recording import Recording
from bodyschema.recordings.store.store import PairReader
from kbmaps import (
    KernelLearner,
    Model,
    RecursiveRigidLearner,
    ResidualLearner,
    RigidLearner,
    TensorLearner,
    learning_bases,
)

SAME = 1e-9
SCENARIOS = ("none", "one", "two")
CASE_PAIRS = 300
LEARNT_ROWS = 200
OLDER = Path(__file__).parent / "daemon" / "older_versions"
Golden = tuple[str, object]


def models() -> Iterator[Golden]:
    """Yield predictions, sigmas and stored bytes of each model, of a bent arm with four joints."""
    rng = np.random.default_rng(1)
    arm = rough_arm(4, rng, ROUGH)
    reach = np.full(4, np.radians(80.0))
    bases, chain = learning_bases(-reach, reach), arm.drawing
    taught: dict[str, Model] = {
        "kernel": KernelLearner(bases, chain),
        "rigid": RigidLearner(chain, ROUGH),
        "recursive rigid": RecursiveRigidLearner(chain, ROUGH),
        "residual": ResidualLearner(chain, ROUGH),
        "tensor": TensorLearner.around(chain, bases),
    }
    q, asked = arm.angles(150, 60.0, rng), arm.angles(5, 70.0, rng)
    x = arm.measured(q + 0.02 * np.sin(q), 0.002, rng)
    for name, model in taught.items():
        model.learn(q, x, 0.002)
        estimate = model.estimate(asked)
        yield f"model/{name}", {"x": estimate.x, "sigma": estimate.sigma, "jacobian": model.jacobian(asked)}


def learnt(nominal: NominalModel, q: FloatArray, x: FloatArray, sigma_m: float) -> dict[str, object]:
    """Return what the online learner answers after these rows, one pair a second."""
    learner = OnlineLearner(nominal, LearnerConfig(), DirectSolver())
    for seq, (angles, position) in enumerate(zip(q, x, strict=True), 1):
        learner.learn(Pair("", seq, 0, float(seq), "", angles, position, sigma_m**2 * np.eye(3)), float(seq))
        while seq % 10 == 0 and learner.work():
            pass
    while learner.work():
        pass
    snapshot = learner.snapshot
    return {"answering": snapshot.answering, "x": snapshot.predict(q[::20]).x, "counters": learner.counters}


def guided() -> Iterator[Golden]:
    """Yield what the online learner knows of a simulated arm that is guided by hand."""
    rng = np.random.default_rng(2)
    arm = rough_arm(5, rng, ROUGH)
    steps = np.cumsum(np.radians(rng.normal(0.0, 1.0, (LEARNT_ROWS, 5))), axis=0)
    limit = np.full(5, np.radians(90.0))
    nominal = NominalModel(arm.drawing, -limit, limit, True, True)
    yield "learner/guided", learnt(nominal, steps, arm.measured(steps, 0.003, rng), 0.003)


def recorded(data: Path) -> Iterator[Golden]:
    """Yield what the online learner knows after the first rows of each recording in the folder."""
    for folder in sorted(path.parent for path in data.glob("*/measured.csv")):
        simulation = load_simulation(folder / "robot.toml")
        recording = Recording.read(folder / "measured.csv", simulation.robot.joints)
        rows = recording.rows(np.arange(min(LEARNT_ROWS, len(recording))))
        yield f"learner/{folder.name}", learnt(NominalModel.extended_by(simulation), rows.q, rows.x, 1e-4)


def diagnoses(seeds: int) -> Iterator[Golden]:
    """Yield the diagnosis of hidden cases, the first seeds of each scenario."""
    from tests.blind.cases import hide
    from tests.blind.sealed import SCENARIOS as KINDS

    for name in SCENARIOS:
        for seed in range(1, seeds + 1):
            with tempfile.TemporaryDirectory() as folder:
                kind = KINDS[name]
                case = hide(seed, Path(folder), kind.effects, pairs=CASE_PAIRS, size=kind.size(seed))
                simulation = load_simulation(case.robot_file)
                recording = Recording.read(case.folder / "measured.csv", simulation.robot.joints)
                yield f"diagnosis/{name}-{seed}", conclusion(diagnose(recording, simulation, seed=seed))


def older_files() -> Iterator[Golden]:
    """Yield the contents of checkpoints and stores of earlier releases."""
    for file in sorted(OLDER.glob("*.ckpt")):
        yield f"file/{file.name}", checkpoint(file)
    for file in sorted(OLDER.glob("*.sqlite")):
        with tempfile.TemporaryDirectory() as folder, PairReader(Path(shutil.copy(file, folder))) as reader:
            pairs = list(reader.read())
        yield f"file/{file.name}", {"q": [pair.q for pair in pairs], "x": [pair.x for pair in pairs]}


def checkpoint(file: Path) -> object:
    """Return size and sum of each array in a checkpoint, or why it is refused."""
    try:
        state = read_checkpoint(file, robot="arm")
    except CheckpointError as error:
        return str(error).replace(str(file), file.name)
    assert state is not None
    return {name: [array.size, float(np.abs(array).sum())] for name, array in state.arrays.items()}


def plain(value: object) -> object:
    """Return the value as JSON holds it."""
    return json.loads(json.dumps(msgspec.to_builtins(value, enc_hook=lambda array: np.asarray(array).tolist())))


def differences(name: str, before: object, after: object) -> Iterator[str]:
    """Yield a line for each leaf in which the two differ by more than `SAME`, relative to its size or to one."""
    if isinstance(before, dict) and isinstance(after, dict):
        for key in sorted({*before, *after}):
            yield from differences(f"{name}.{key}", before.get(key), after.get(key))
    elif isinstance(before, list) and isinstance(after, list) and len(before) == len(after):
        for number, (one, other) in enumerate(zip(before, after, strict=True)):
            yield from differences(f"{name}[{number}]", one, other)
    elif isinstance(before, float) and isinstance(after, float):
        if not math.isclose(before, after, rel_tol=SAME, abs_tol=SAME):
            yield f"{name}: {before!r} -> {after!r}"
    elif before != after:
        yield f"{name}: {before!r} -> {after!r}"


def main() -> None:
    """Write the golden outputs, or compare with those of an earlier run; exit code 1 where they differ."""
    parser = argparse.ArgumentParser(prog="python -m tests.goldens")
    parser.add_argument("file", type=Path, help="written if it does not exist, else compared with")
    parser.add_argument("--data", type=Path, help="folder with a folder of each recording")
    parser.add_argument("--seeds", type=int, default=2, help="hidden cases of each scenario")
    given = parser.parse_args()
    found: dict[str, object] = {}
    for part in (models(), guided(), older_files(), diagnoses(given.seeds), recorded(given.data) if given.data else ()):
        for name, value in part:
            found[name] = plain(value)
            print(name, file=sys.stderr, flush=True)
    if not given.file.exists():
        lines = ",\n".join(f"{json.dumps(name)}: {json.dumps(value)}" for name, value in found.items())
        given.file.write_text(f"{{\n{lines}\n}}\n")
        return
    changed = list(differences("", json.loads(given.file.read_text()), found))
    print("\n".join(changed) or "nothing differs")
    sys.exit(bool(changed))


if __name__ == "__main__":
    main()
