"""`bodyschema reproduce`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from daemon.commands.options import flag

Name = Literal["fig4", "fig5", "fig6", "fig7", "exactness", "all"]


def reproduce(
    name: Annotated[Name, Parameter(help="Which experiment.")] = "all",
    /,
    *,
    out: Annotated[Path, Parameter(help="Folder for the plots.")] = Path("reproduced"),
    seed: Annotated[int, Parameter(help="Other poses, other noise.")] = 0,
    as_json: Annotated[bool, flag("Print curves and figures as JSON.", name="--json")] = False,
) -> None:
    """Run the experiments of Ulbrich et al. 2009 again, and hold the outcome against the paper's figures.

    The arm is the shipped upper body, simulated; walks go through the sampler's gate, and beside the paper's learning
    rule runs the daemon's own learner. Half a minute in all.

    Needs: no hardware. The plots need matplotlib (pip install 'bodyschema[sim]').

    Next: docs/reproduced.md tells what the paper leaves open, and how it was read here.
    """
    import importlib.util
    import sys

    import msgspec
    import numpy as np
    from rich.console import Console

    from daemon.reproduce import EXPERIMENTS
    from daemon.reproduce.plot import plot
    from daemon.reproduce.show import show
    from interfaces.errors import ConfigError

    if importlib.util.find_spec("matplotlib") is None:
        raise ConfigError("the plots need matplotlib", remedy="Type: pip install 'bodyschema[sim]'")
    progress, console = Console(stderr=True), Console()
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"cannot be made: {error.strerror}", file=out, remedy="Give another --out") from error
    done = []
    for number, (key, run) in enumerate(EXPERIMENTS.items()):
        if name not in (key, "all"):
            continue
        rng = np.random.default_rng([seed, number])
        experiment = run(rng, lambda said, key=key: progress.print(f"{key}: {said}", highlight=False))
        file = out / f"{key}.png"
        plot(experiment, file)
        if not as_json:
            show(console, experiment, file)
        done.append(experiment)
    if as_json:
        sys.stdout.write(msgspec.json.encode({"schema": 1, "experiments": done}).decode() + "\n")
