"""Settings of a learner of tensor trains."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

from kbmaps.errors import SettingError
from kbmaps.packed import count, flag, named


@dataclass(frozen=True)
class TensorSettings:
    """Settings of a TensorLearner.

    Attributes:
        window: number of the last pairs to keep; None keeps all.
        refit_every: number of new pairs after which `learn` refits; earlier if they are a quarter of all kept pairs.
            Until then they wait, or for `refit`.
        robust: leave out pairs that lie more than five robust standard deviations off.
        starts: maximum number of random chains to start from without a prior.
        seed: of these random chains, so that the same pairs give the same train.

    Raises:
        SettingError: window, refit_every or starts below 1, seed below 0.
    """

    window: int | None = None
    refit_every: int = 25
    robust: bool = True
    starts: int = 12
    seed: int = 0

    def __post_init__(self) -> None:
        lower = {"window": 1 if self.window is None else self.window, "refit_every": self.refit_every}
        for name, value in {**lower, "starts": self.starts}.items():
            if value < 1:
                raise SettingError(f"{name} must be at least 1, got {value}")
        if self.seed < 0:
            raise SettingError(f"seed must be at least 0, got {self.seed}")


def parse_settings(value: Any) -> TensorSettings:
    """Return the settings from `dataclasses.asdict`. Raises ModelFormatError, SettingError."""
    stored = named(value, "the settings", [field.name for field in fields(TensorSettings)])
    whole = {name: count(stored[name], f"the setting {name}") for name in ("refit_every", "starts", "seed")}
    window = None if stored["window"] is None else count(stored["window"], "the setting window")
    return TensorSettings(window, robust=flag(stored["robust"], "the setting robust"), **whole)
