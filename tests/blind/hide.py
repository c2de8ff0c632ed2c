"""`python -m tests.blind.hide --seed 7 --effect backlash --out DIR`: write a case and print its hidden effects."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path

from .arms import ARMS
from .cases import HiddenCase, hide
from .choice import HOLDS

__all__ = ["HiddenCase", "hide"]


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(prog="python -m tests.blind.hide", description="Hide effects in a recording.")
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument(
        "--effect", action="append", help="effect, effect@joint or effect@joint:source; may be repeated"
    )
    parser.add_argument("--count", type=int, default=1, help="how many to draw where no --effect is given")
    parser.add_argument("--out", type=Path, required=True, help="folder that is written")
    parser.add_argument("--arm", choices=list(ARMS))
    parser.add_argument("--pairs", type=int, default=1600)
    parser.add_argument("--size", type=float, help="in units of the noise; drawn when not given")
    parser.add_argument("--outliers", type=float, default=0.0, help="fraction of false fixes")
    parser.add_argument("--hold", choices=HOLDS)
    parser.add_argument("--rendered", action="store_true", help="paint images and track the marker in them")
    given = parser.parse_args()
    case = hide(
        given.seed,
        given.out,
        given.effect or given.count,
        arm=given.arm,
        pairs=given.pairs,
        size="random" if given.size is None else given.size,
        outliers=given.outliers,
        hold=given.hold,
        rendered=given.rendered,
    )
    print(told(case))


def told(case: HiddenCase) -> str:
    """Return a summary of the case as JSON."""
    return json.dumps(
        {
            "folder": str(case.folder),
            "seed": case.seed,
            "arm": case.arm.name,
            "hold": case.hold,
            "style": case.style,
            "sigma_m": case.sigma_m,
            "truth": [asdict(hidden) for hidden in case.truth],
        },
        indent=2,
    )


if __name__ == "__main__":
    main()
