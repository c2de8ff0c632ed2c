"""Calibration of two cameras, or of one, from views of a board."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from bodyschema.interfaces.records import FloatArray
from bodyschema.vision.board import Board
from bodyschema.vision.rig.lens import DISTORTION_NAMES, Model
from bodyschema.vision.rig.stereo_rig import (
    CalibrationError,
    CalibrationProvenance,
    OneEyeRig,
    Rig,
    StereoRig,
    lenses_of,
    split,
)

from .bundle import Bundle, solve
from .guidance import Coverage
from .held_out import HeldOut, covariance, held_out
from .initial_estimate import start
from .refocus import focal_spread, refocused
from .requirements import baseline_contradiction, join_reasons, misplacement, undetermined, unmet_requirements
from .settings import FitSettings as _Settings
from .view import EYES, ONE_EYE, Eye, View
from .weights import refit_weighted

ModelChoice = Literal["auto", "pinhole", "fisheye", "rational"]

# Power of the distance from the axis in the last term of the distortion.
_STEEPEST_POWER: dict[Model, int] = {"pinhole": 6, "fisheye": 8, "rational": 6}
_NUMBERS = re.compile(r"-?\d+(\.\d+)?")


@dataclass(frozen=True)
class CalibrationRequest:
    """Request for a calibration."""

    # image_size_px, serials: of the eyes
    image_size_px: tuple[int, int]
    serials: tuple[str, ...]
    date: str  # ISO 8601 in UTC
    # lens model; `auto` takes the simplest that fits, or one that predicts held-out views clearly better
    model: ModelChoice = "auto"
    scale_sigma: float = 0.001  # relative 1-sigma of the board's size
    baseline_m: float | None = None  # baseline measured by hand, for a check [m]

    @property
    def eyes(self) -> tuple[Eye, ...]:
        """The eyes in use."""
        return EYES if len(self.serials) > 1 else ONE_EYE


@dataclass(frozen=True)
class LeftOut:
    """A view that does not fit the others: its name, its RMS error and the median of the others' [px]."""

    name: str
    rms_px: float
    usual_px: float


@dataclass(frozen=True)
class Fitted:
    """One lens model, fitted to the views that agree with it."""

    views: tuple[View, ...]
    left_out: tuple[LeftOut, ...]
    bundle: Bundle
    held_out: HeldOut


@dataclass(frozen=True)
class Calibrated:
    """A calibration with the data it was made from."""

    rig: Rig  # the calibration
    board: Board
    fitted: Fitted  # the selected model
    held_out_by_model_px: dict[Model, float]  # held-out error of each candidate model that fits the cameras [px]
    coverage: Coverage  # image coverage of the views
    # relative 1-sigma of the focal lengths over the views; None without evidence that a lens refocused
    focal_spread: float | None


def calibrate(
    views: Sequence[View], board: Board, request: CalibrationRequest, tell: Callable[[str], None] = lambda _: None
) -> Calibrated:
    """Calibrate the lenses and poses of two cameras, or the lens of one.

    Raises:
        CalibrationError: the result is not good enough; the message says why.
    """
    coverage = Coverage.of(views, board, request.image_size_px, request.eyes)
    if reasons := unmet_requirements(coverage):
        raise CalibrationError(join_reasons(reasons))
    models: tuple[Model, ...] = tuple(DISTORTION_NAMES) if request.model == "auto" else (request.model,)
    fits = _fit_models(views, board, request, models, tell)
    model = _select_model(fits)
    rig = _rig(fits[model], board, request)
    reasons = undetermined(rig)
    if (
        request.baseline_m is not None
        and isinstance(rig, StereoRig)
        and (reason := baseline_contradiction(rig, request.baseline_m)) is not None
    ):
        reasons.append(reason)
    spread = focal_spread(fits[model].views, board.corners_m, fits[model].bundle)
    if reasons:
        raise CalibrationError(join_reasons(reasons if spread is None else [refocused(spread), *reasons]))
    rivals: dict[Model, float] = {each: found.held_out.rms_px for each, found in fits.items()}
    return Calibrated(rig, board, fits[model], rivals, coverage, spread)


def _fit_models(
    views: Sequence[View],
    board: Board,
    request: CalibrationRequest,
    models: Sequence[Model],
    tell: Callable[[str], None],
) -> dict[Model, Fitted]:
    """Fit each model and return those that fit; raise CalibrationError if none does."""
    fits: dict[Model, Fitted] = {}
    refusals: dict[Model, CalibrationError] = {}
    for model in models:
        if model == "rational" and fits and _select_model(fits) == "pinhole":
            continue  # it differs from pinhole at wide angles, where fisheye is better too
        tell(f"fitting {model} lenses to {len(views)} views")
        try:
            fits[model] = fit(views, board.corners_m, request.image_size_px, model, request.eyes)
        except CalibrationError as error:
            if len(models) > 1:
                tell(f"{model} lenses do not fit: {error}")
            refusals[model] = error
    if fits:
        return fits
    first, *others = refusals.values()
    # An unsuitable model may misplace the eyes: a cause is certain only if all models agree on it.
    if len({_NUMBERS.sub("", str(each)) for each in (first, *others)}) == 1:
        raise first
    raise CalibrationError(join_reasons([f"{model} lenses: {error}" for model, error in refusals.items()]))


def fit(
    views: Sequence[View],
    corners_m: FloatArray,
    image_size_px: tuple[int, int],
    model: Model,
    eyes: tuple[Eye, ...] = EYES,
) -> Fitted:
    """Fit one lens model, leaving out views that do not fit the others, the worst first.

    Raises:
        CalibrationError: the eyes are misplaced, the views do not determine the lenses, the model folds the image
            over, or too many views are outliers.
    """
    try:
        fitted = _fit(views, corners_m, image_size_px, model, eyes)
    except np.linalg.LinAlgError as error:
        raise CalibrationError(
            f"the views do not determine {model} lenses. Take more views, tilted and all over the image"
        ) from error
    if _is_one_to_one(fitted.bundle, image_size_px):
        return fitted
    raise CalibrationError(
        f"the {model} model folds over within the image: it would show two directions at one point. Show the board in "
        "the image's corners, or take another lens model"
    )


def _fit(
    views: Sequence[View], corners_m: FloatArray, image_size_px: tuple[int, int], model: Model, eyes: tuple[Eye, ...]
) -> Fitted:
    kept = list(views)
    left_out: list[LeftOut] = []
    vector, poses = start(kept, corners_m, image_size_px, model, eyes)
    while True:
        bundle = refit_weighted(kept, corners_m, solve(kept, corners_m, model, vector, poses))
        worst = _outlier(bundle.view_rms_px())
        if worst is None:
            break
        rms = bundle.view_rms_px()
        left_out.append(LeftOut(kept.pop(worst).name, float(rms[worst]), float(np.median(rms))))
        if len(left_out) > _Settings.max_left_out * len(views):
            if (spread := focal_spread(kept, corners_m, solve(kept, corners_m, model, vector, poses))) is not None:
                raise CalibrationError(refocused(spread))
            raise CalibrationError(
                f"{len(left_out)} of {len(views)} views do not fit the others, {left_out[0].name} with "
                f"{left_out[0].rms_px:.1f} px the least. Is the board flat, held still, and are both images of one "
                "instant?"
            )
        vector, poses = bundle.vector, np.delete(bundle.poses, worst, axis=0)
    _require_placement(model, bundle.vector)
    if not _is_one_to_one(bundle, image_size_px):
        bundle = _refit_with_prior(kept, corners_m, bundle, image_size_px)
    return Fitted(tuple(kept), tuple(left_out), bundle, held_out(kept, corners_m, bundle))


def _is_one_to_one(bundle: Bundle, image_size_px: tuple[int, int]) -> bool:
    return all(lens.is_one_to_one(image_size_px) for lens in lenses_of(bundle.model, bundle.vector))


def _refit_with_prior(
    views: Sequence[View], corners_m: FloatArray, bundle: Bundle, image_size_px: tuple[int, int]
) -> Bundle:
    """Refit a lens that folds over, with a prior that keeps the steepest term of its polynomial small.

    A narrow lens hardly determines that term, so it may fold the image over where the board was never seen.
    """
    count = 4 + len(DISTORTION_NAMES[bundle.model])
    prior, vector = np.zeros(len(bundle.vector)), bundle.vector.copy()
    for number, lens in enumerate(lenses_of(bundle.model, bundle.vector)):
        # The last coefficient is of the largest power.
        corner = 0.5 * np.linalg.norm(np.array(image_size_px) / np.array(lens.focal_px))
        last = (number + 1) * count - 1
        prior[last] = (bundle.sigma_px * corner ** _STEEPEST_POWER[bundle.model] / _Settings.steepest_term) ** 2
        vector[last] = 0.0
    stiff = solve(views, corners_m, bundle.model, vector, bundle.poses, bundle.weights, prior)
    return refit_weighted(views, corners_m, stiff)


def _select_model(fits: dict[Model, Fitted]) -> Model:
    """Select the simplest model, unless a later one predicts the views shared by both fits clearly better."""
    best, *others = fits
    for model in others:
        shared = {view.name for view in fits[best].views} & {view.name for view in fits[model].views}
        if _subset(fits[model], shared).is_better_than(_subset(fits[best], shared)):
            best = model
    return best


def _subset(fitted: Fitted, names: set[str]) -> HeldOut:
    is_shared = np.array([view.name in names for view in fitted.views])
    return HeldOut(fitted.held_out.squares[is_shared], fitted.held_out.freedom[is_shared])


def _outlier(rms_px: FloatArray) -> int | None:
    """Return the index of the view farthest from the median, if it is an outlier."""
    usual = float(np.median(rms_px))
    spread = 1.4826 * float(np.median(np.abs(rms_px - usual)))
    worst = int(np.argmax(rms_px))
    return worst if rms_px[worst] > usual + _Settings.outlier_spreads * spread else None


def _require_placement(model: Model, vector: FloatArray) -> None:
    if len(lenses_of(model, vector)) == 1:
        return
    _, _, rotation, translation = split(model, vector)
    reason = misplacement(np.asarray(cv2.Rodrigues(rotation)[0], dtype=np.float64), translation)
    if reason is not None:
        raise CalibrationError(reason)


def _rig(fitted: Fitted, board: Board, request: CalibrationRequest) -> Rig:
    bundle = fitted.bundle
    parameter_covariance = covariance(fitted.views, board.corners_m, bundle)
    provenance = CalibrationProvenance(
        date=request.date,
        board=board.name,
        views=len(fitted.views),
        left_out=len(fitted.left_out),
        reprojection_px=bundle.sigma_px,
        held_out_px=fitted.held_out.rms_px,
        scale_sigma=request.scale_sigma,
    )
    lenses = lenses_of(bundle.model, bundle.vector)
    if len(lenses) == 1:
        return OneEyeRig(lenses[0], request.image_size_px, (request.serials[0],), parameter_covariance, provenance)
    left, right, rotation, translation = split(bundle.model, bundle.vector)
    # An error of the board's size only scales all lengths.
    parameter_covariance[-3:, -3:] += request.scale_sigma**2 * np.outer(translation, translation)
    serials = request.serials[0], request.serials[1]
    return StereoRig(
        left, right, rotation, translation, request.image_size_px, serials, parameter_covariance, provenance
    )
