"""The fifty settings that matter most: with half or twice the number every decision stays, and no figure moves far."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from importlib import import_module

import figures
import pytest
from figures import Figures

# By scene and class: the settings, and how far half or twice of each may move a figure of the scene.
LIMITS: dict[tuple[Callable[[], Figures], str], dict[str, float]] = {
    (figures.learner, "kbmaps.chains.rigid_fit._Settings"): {"scales_per_sigma": 0.01, "min_share": 0.01},
    (figures.learner, "kbmaps.prequential.ContestSettings"): {"worse_ratio": 0.01, "recent_pairs": 0.01, "cap": 0.01},
    (figures.learner, "kbmaps.maps.block_choice.BlockSettings"): {"first_precision": 0.01},
    (figures.learner, "bodyschema.learning.changes.monitor.MonitorSettings"): {"min_known": 0.01},
    (figures.learner, "bodyschema.learning.regime.RegimeSettings"): {
        "recent": 0.01,
        "max_late_pairs": 0.01,
        "restart_share": 0.01,
    },
    (figures.learner, "bodyschema.learning.solvers.solver.SolverSettings"): {
        "shared": 0.02,
        "growth": 0.01,
        "first_growth": 0.01,
        "retune": 0.01,
    },
    (figures.models, "kbmaps.chains.rigid_fit._Settings"): {"misfit_chance": 0.01},
    (figures.models, "kbmaps.residual.evidence.GroupSettings"): {"window": 0.01, "min_gain": 0.05, "settled": 0.01},
    (figures.models, "kbmaps.residual.features._Settings"): {"path_correlation": 0.01},
    (figures.models, "kbmaps.residual.fit._Settings"): {"misfit_sigmas": 0.01},
    (figures.ball, "bodyschema.vision.ball.settings.OutlineSettings"): {
        "step_px": 0.15,
        "background_px": 0.15,
        "channel_sigma": 0.02,
        "edge_sigma_px": 0.02,
        "floor_px": 0.05,
    },
    (figures.ball, "bodyschema.vision.ball.settings.ContourSettings"): {
        "inside_px": 0.1,
        "usual_blur_px": 0.25,
        "inner_part": 0.25,
        "beyond_blurs": 0.25,
        "usual_disagreement": 0.15,
        "disagreement_power": 0.05,
        "freedom": 0.1,
        "min_density": 0.25,
        "channels_noise": 0.15,
        "usual_density": 0.15,
        "measured": 0.25,
    },
    (figures.tag, "bodyschema.vision.tags.settings.EdgeSettings"): {
        "clear_share": 0.25,
        "sample_px": 0.1,
        "beyond_share": 0.02,
        "wider_px": 0.3,
        "level": 0.05,
        "plain": 0.15,
    },
    (figures.tag, "bodyschema.vision.tags.settings.TagSettings"): {
        "settled_px": 0.05,
        "usual_blur_px": 0.05,
        "smoothed_waves": 0.02,
    },
    (figures.diagnosis, "bodyschema.diagnosis.assess.explanation._Settings"): {"margin": 0.01},
    (figures.diagnosis, "bodyschema.diagnosis.fit.fit.FitSettings"): {"slack": 0.01, "untold": 0.01},
    (figures.diagnosis, "bodyschema.diagnosis.fit.noise.NoiseSettings"): {"noise_alike": 0.01},
    (figures.diagnosis, "bodyschema.diagnosis.search.scan.ScanSettings"): {"between": 0.01},
    (figures.diagnosis, "bodyschema.diagnosis.search.search._Settings"): {
        "clearly": 0.01,
        "equal": 0.01,
        "worth_in_full": 0.01,
    },
}


class Scaled:
    """A setting with another value, which knows if it was read."""

    def __init__(self, value: float, factor: float) -> None:
        self.value = value * factor if isinstance(value, float) else max(1, round(value * factor))
        self.is_read = False

    def __get__(self, *_: object) -> float:
        self.is_read = True
        return self.value


@cache
def unscaled(scene: Callable[[], Figures]) -> Figures:
    return scene()


def moved(before: Figures, after: Figures) -> float:
    """Return the largest relative change of a figure; infinite if a decision changed."""
    assert before.keys() == after.keys()
    changes = [0.0]
    for name, value in before.items():
        now = after[name]
        if isinstance(value, str) or isinstance(now, str):
            changes.append(0.0 if now == value else math.inf)
        else:
            changes.append(abs(now / value - 1.0))
    return max(changes)


@pytest.mark.parametrize("factor", [0.5, 2.0])
@pytest.mark.parametrize(
    ("scene", "owner", "name", "limit"),
    [
        pytest.param(scene, owner, name, limit, id=f"{owner.rpartition('.')[0]}-{name}")
        for (scene, owner), settings in LIMITS.items()
        for name, limit in settings.items()
    ],
)
def test_no_result_hinges_on_a_setting(scene, owner, name, limit, factor, monkeypatch: pytest.MonkeyPatch) -> None:
    module, _, cls = owner.rpartition(".")
    settings = getattr(import_module(module), cls)
    before = unscaled(scene)
    scaled = Scaled(getattr(settings, name), factor)
    monkeypatch.setattr(settings, name, scaled)
    assert moved(before, scene()) < limit
    assert scaled.is_read


def test_fifty_settings_are_tried() -> None:
    assert sum(map(len, LIMITS.values())) >= 50
