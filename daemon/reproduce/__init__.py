"""The experiments of Ulbrich et al. 2009, run again."""

from __future__ import annotations

from .experiment import Comparison, Curve, Experiment, Panel, Reading, Run
from .registry import EXPERIMENTS

__all__ = ["EXPERIMENTS", "Comparison", "Curve", "Experiment", "Panel", "Reading", "Run"]
