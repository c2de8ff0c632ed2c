"""The experiments by their names."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .batch import exactness, fig4, fig5
from .experiment import Experiment
from .incremental import fig6, fig7

EXPERIMENTS: dict[str, Callable[[np.random.Generator, Callable[[str], None]], Experiment]] = {
    "fig4": fig4,
    "fig5": fig5,
    "fig6": fig6,
    "fig7": fig7,
    "exactness": exactness,
}
