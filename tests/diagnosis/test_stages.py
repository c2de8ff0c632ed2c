"""The progress of a diagnosis."""

from __future__ import annotations

from bodyschema.diagnosis.progress import RIVALS, SEARCH, SETS, UNNAMED, Stages


def test_progress_never_falls_and_names_its_stage() -> None:
    lines: list[str] = []
    stages = Stages(lines.append)
    for stage, before in ((SETS, None), (SEARCH, SETS), (UNNAMED, SEARCH), (RIVALS, UNNAMED)):
        stages.begin(stage, before)
        for _ in range(30):
            stages("a step")
        assert stage.what in lines[-1]
    percentages = [float(line.partition(" %")[0]) for line in lines]
    assert percentages == sorted(percentages)
    assert percentages[0] == 0.0 < percentages[-1] < 100.0
