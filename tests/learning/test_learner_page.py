"""docs/learner.md agrees with the code."""

from __future__ import annotations

import re
from pathlib import Path

from bodyschema.daemon.config import _Settings
from bodyschema.learning.changes.outlier_gate import OutlierSettings
from bodyschema.learning.model_bank import TRUSTED
from bodyschema.learning.nominal import NominalSettings
from bodyschema.learning.online_learner import OnlineSettings
from bodyschema.learning.snapshot import IN_SUPPORT
from bodyschema.learning.solvers.orientation import BatchSettings
from bodyschema.learning.solvers.solver import SolverSettings
from kbmaps.prequential import ContestSettings

PAGE = (Path(__file__).parents[2] / "docs" / "learner.md").read_text(encoding="utf-8")


def test_the_page_has_every_model() -> None:
    assert re.findall(r"^\| `(\w+)` \|", PAGE, re.MULTILINE) == list(TRUSTED)


def test_the_page_s_numbers_are_the_code_s() -> None:
    words = {2: "two", 3: "three", 5: "five", 6: "six", 100: "hundred"}
    text = " ".join(PAGE.split())
    assert f"more than {words[round(OutlierSettings.times_farther)]} times as far" in text
    assert f"{words[OutlierSettings.explained_change_pairs]} outliers in a row" in text
    assert f"or any {words[OutlierSettings.change_pairs]} outliers in a row" in text
    assert f"After {words[NominalSettings.pairs_to_refit]} samples (at once if the change was detected)" in text
    assert f"at {SolverSettings.largest_net:,} control points" in text
    assert f"the other models at {_Settings.largest_map:,} (twelve)" in text
    assert f"the newest {BatchSettings.window:,} samples" in text
    assert f"within {words[round(57.29578 * OnlineSettings.region_rad)]} degrees a joint" in text
    assert ("less than a quarter of the prior's variance" in text) == (IN_SUPPORT == 0.25)
    assert f"the last {words[ContestSettings.shortest]} samples" in text
    assert f"by {words[round(ContestSettings.clearly)]} standard errors" in text
    assert f"the newest {BatchSettings.kept:,} samples" in text
