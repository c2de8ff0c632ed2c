"""The experiments of Ulbrich et al. 2009, run again."""

from __future__ import annotations

from .experiment import Curve, Experiment, Reading
from .registry import EXPERIMENTS

__all__ = ["EXPERIMENTS", "Curve", "Experiment", "Reading"]
