"""The experiments by name."""

from __future__ import annotations

from collections.abc import Callable

from .exactness import exactness
from .experiment import Experiment, Run
from .fig4 import fig4
from .fig5 import fig5
from .fig6 import fig6
from .fig7 import fig7

EXPERIMENTS: dict[str, Callable[[Run], Experiment]] = {
    "fig4": fig4,
    "fig5": fig5,
    "fig6": fig6,
    "fig7": fig7,
    "exactness": exactness,
}
