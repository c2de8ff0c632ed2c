"""`bodyschema reproduce`."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter
from rich.console import Console

from bodyschema.cli.commands.options import flag
from bodyschema.interfaces.errors import ConfigError
from bodyschema.interfaces.extras import require_extra
from bodyschema.interfaces.whole_files import raising_write_errors

Name = Literal["fig4", "fig5", "fig6", "fig7", "exactness", "all"]


def reproduce(
    name: Annotated[Name, Parameter(help="Which experiment.")] = "all",
    /,
    *,
    out: Annotated[Path, Parameter(help="Folder for the plots.")] = Path("reproduced"),
    seed: Annotated[int, Parameter(help="Other poses, other noise, another simulated robot.")] = 0,
    real: Annotated[
        bool,
        Parameter(
            negative="--no-real",
            help="The curves measured on the simulated robot: rendered, tracked, sampled. --no-real saves most of the "
            "time.",
        ),
    ] = True,
    as_json: Annotated[bool, flag("Print curves and figures as JSON.", name="--json")] = False,
) -> None:
    """Rerun the experiments of Ulbrich et al. 2009, and compare the results with the paper's figures.

    The arm is the shipped upper body, simulated. Walks go through the sampler. The daemon's learner and other models
    learn the same samples as the paper's method. In figures 5 and 7 the marker is also measured: stereo images are
    rendered and tracked, and encoders are read in ticks.

    Time on two idle cores: fig4 half a minute, fig5 and fig7 about a minute and a half each, fig6 one minute, exactness
    a few seconds. With --no-real fig5 takes half a minute and fig7 one minute.

    Needs: no hardware; pybullet and matplotlib (pip install 'bodyschema[sim,plots]').

    Next: docs/results/paper.md describes what the paper leaves open, how it was interpreted, and what --json prints.
    """
    import msgspec

    require_extra("plots", "a figure")
    if seed < 0:
        raise ConfigError(f"--seed is {seed}", remedy="Give 0 or more")
    if real and name in ("fig5", "fig7", "all"):
        require_extra("sim", "a measured curve (--no-real leaves it out)")
    with raising_write_errors(out, what="made", remedy="Give another --out"):
        out.mkdir(parents=True, exist_ok=True)
    done = list(_experiments(name, out, seed, real=real, quiet=as_json))
    if as_json:
        result = {"schema": 3, "version": version("bodyschema"), "seed": seed, "real": real, "experiments": done}
        sys.stdout.write(msgspec.json.encode(result).decode() + "\n")


def _experiments(name: Name, out: Path, seed: int, *, real: bool, quiet: bool) -> Iterator[dict[str, object]]:
    """Run the experiments and plot each into `out`; yield curves and figures, which are shown unless `quiet`."""
    import msgspec
    import numpy as np

    from bodyschema.cli.terminal.screen import shown_on
    from bodyschema.reproduce import EXPERIMENTS, Run
    from bodyschema.reproduce.plot import plot
    from bodyschema.reproduce.show import show

    progress, console = Console(stderr=True), Console()
    for number, (key, run) in enumerate(EXPERIMENTS.items()):
        if name not in (key, "all"):
            continue
        begin = time.perf_counter()
        rng = np.random.default_rng([seed, number])
        with shown_on(progress, key) as say:
            experiment = run(Run(rng, seed, real, say))
        file = out / f"{key}.png"
        plot(experiment, file)
        took = time.perf_counter() - begin
        if not quiet:
            show(console, experiment, file)
            console.print(f"took  {took:.0f} s", highlight=False)
        yield {**msgspec.to_builtins(experiment), "plot": str(file), "took_s": round(took, 1)}
