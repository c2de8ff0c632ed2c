"""Rerun the experiments of Ulbrich et al. 2009."""

from __future__ import annotations

from .experiment import Column, Comparison, Curve, Experiment, Panel, Reading, Run
from .registry import EXPERIMENTS

__all__ = ["EXPERIMENTS", "Column", "Comparison", "Curve", "Experiment", "Panel", "Reading", "Run"]
