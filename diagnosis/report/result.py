"""Define `diagnosis.json`, the machine-readable result of a diagnosis."""

from __future__ import annotations

from typing import Literal

import msgspec


class ResultSettings:
    small_percent = 5.0  # a cause with less weight [%] is told last and leaves the verdict as it is
    sure = 0.9  # a less probable cause leaves the verdict open, and is to be confirmed first
    # Probability of what is no more probable than not.
    even = 0.5


OUTLIERS = "outliers"  # fixes that are not the marker, as a cause
Verdict = Literal["explained", "nothing_found", "undecided", "unexplained"]


class Interval(msgspec.Struct, frozen=True):
    """A number with its 95 % interval."""

    value: float
    ci95: tuple[float, float]


class Gain(msgspec.Struct, frozen=True, rename={"from_": "from"}):
    """Reduction of the RMS on held-out rows, relative to the aligned simulation [%]."""

    held_out_percent: float
    ci95: tuple[float, float]  # its 95 % interval on new poses: of another recording of the same kind, half as long
    from_: str = "aligned"
    # with_outliers_percent, with_outliers_ci95: the same if the fixes that are not the marker are counted; null where
    # there are none
    with_outliers_percent: float | None = None
    with_outliers_ci95: tuple[float, float] | None = None


class Indistinguishable(msgspec.Struct, frozen=True):
    """A rival of a cause."""

    effect: str  # its name; "unexplained" where it has none
    where: str | None
    source: str | None
    # "this_motion" where another motion would separate them, "any_motion" where none would
    by: Literal["this_motion", "any_motion"]
    probability: float  # probability of this rival
    what: str = ""  # description, where it has no name


class Cause(msgspec.Struct, frozen=True):
    """One cause with its numbers."""

    effect: str
    where: str | None
    source: str | None
    parameters: dict[str, Interval]
    probability: float
    share_of_gain_percent: float  # share of the explained squared error, tolerances included
    held_out_gain_percent: float  # rise of the held-out RMS without it, all else refitted
    indistinguishable_from: tuple[Indistinguishable, ...]
    rivals: tuple[Indistinguishable, ...]
    evidence: str

    @property
    def weight_percent(self) -> float:
        """The larger of its share of the gain, which others might take over, and the loss without it [%]."""
        return max(self.share_of_gain_percent, self.held_out_gain_percent)

    @property
    def is_small(self) -> bool:
        """True for an effect of little weight; fixes that are not the marker have none."""
        return self.effect != OUTLIERS and self.weight_percent < ResultSettings.small_percent

    @property
    def leaves_open(self) -> bool:
        """True if a rival is not much less probable, and the cause is not small."""
        return self.probability < ResultSettings.sure and bool(self.rivals) and not self.is_small

    @property
    def is_outvoted(self) -> bool:
        """True if a rival is more probable, in the whole percents of a report."""
        return any(round(100.0 * rival.probability) > round(100.0 * self.probability) for rival in self.rivals)

    @property
    def is_correction(self) -> bool:
        """True if it makes a small difference and is no more probable than not: its cause is unknown."""
        return self.is_small and self.probability <= ResultSettings.even


class Rejected(msgspec.Struct, frozen=True):
    """A hypothesis that was tested and rejected."""

    effect: str
    where: str | None
    source: str | None
    held_out_gain_percent: float  # gain on top of the causes
    p_value: float  # p-value of no gain, corrected for all hypotheses tried
    why: str = ""  # reason for rejection despite a small p-value; empty where chance suffices


class Unexplained(msgspec.Struct, frozen=True):
    """Structure that no effect fits: its size, the joints it depends on (`time` among them), and its p-value."""

    rms_mm: float
    depends_on: tuple[str, ...]
    p_value: float
    # descriptions of the erring part and its dependence; the joints are also in `depends_on`
    what: tuple[str, ...] = ()
    model_joints: tuple[str, ...] = ()  # joints whose readings are inputs of the smooth model in extended.toml
    not_in_model: tuple[str, ...] = ()  # parts of `what` that change with time and cannot be in that model


class Tolerances(msgspec.Struct, frozen=True):
    """Manufacturing tolerances of the arm without the causes found: 1-sigma, each with its 95 % interval.

    A lower end of 0 means that the recording does not show them: they are no larger than the upper end.
    """

    length_mm: Interval  # tolerance of the positions of links
    angle_deg: Interval  # tolerance of axes and joint offsets
    drive_deg: Interval  # RMS of a drive's periodic error over a turn
    # links_share_percent, drives_share_percent: shares of the gain of links and axes, and of drives
    links_share_percent: float = 0.0
    drives_share_percent: float = 0.0
    in_extended: bool = True  # False where extended.toml leaves them out, since it would not surely be better elsewhere
    # causes that may be there instead of tolerances several times a workshop's, the most probable first
    rivals: tuple[Indistinguishable, ...] = ()

    @property
    def share_percent(self) -> float:
        return self.links_share_percent + self.drives_share_percent

    @property
    def leaves_open(self) -> bool:
        """True if a cause may exist instead of them, and they are not small."""
        probable = any(rival.probability > 1.0 - ResultSettings.sure for rival in self.rivals)
        return self.links_share_percent >= ResultSettings.small_percent and probable


class Pairs(msgspec.Struct, frozen=True):
    """Numbers of samples in total, held out, and classified as outliers."""

    total: int
    held_out: int
    outliers: int


class Errors(msgspec.Struct, frozen=True):
    """Errors on held-out rows [mm]."""

    nominal: float
    aligned: float
    geometry: float | None
    extended: float
    noise_floor: float | None


class DiagnosisFile(msgspec.Struct, frozen=True):
    """The contents of `diagnosis.json`."""

    verdict: Verdict
    sentence: str
    pairs: Pairs
    rms_mm: Errors
    mean_mm: Errors
    gain: Gain
    causes: tuple[Cause, ...]
    rejected: tuple[Rejected, ...]
    unexplained: Unexplained
    advice: tuple[str, ...]
    limitations: tuple[str, ...]
    tolerances: Tolerances | None = None
    # the kind of measuring device: a camera, or an instrument such as a laser tracker
    seen_by: Literal["camera", "instrument"] = "camera"
    weighed: bool = True  # True if the URDF states masses; otherwise compliances are those of links of 1 kg per metre
    schema: int = 2
