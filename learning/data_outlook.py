"""Data outlook: the expected gain of further pairs, and the motion that gains most."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from bodyschema.interfaces.records import FloatArray
from bodyschema.learning.changes.outlier_gate import MEDIAN_TO_SIGMA
from bodyschema.learning.nominal import NominalModel
from bodyschema.learning.snapshot import MEAN_OVER_RMS
from bodyschema.learning.status import DataOutlook
from bodyschema.learning.uncertainty import PredictiveUncertainty
from kbmaps import ChainBelief, ChainPosterior, ChainTolerances, candidate_motions, expected_gain, shared_by
from kbmaps.chains.rigid_filter import FilterSettings
from kbmaps.planning.expected_gain import ALL, SAME
from kbmaps.robust import RobustSettings


class _Settings:
    further: tuple[int, ...] = (100, 300)
    # Number of poses of a motion, and of the region where the arm is used. More would not make the figures steadier
    # than the posterior is.
    poses: int = 100
    min_benefit: float = 0.05  # a motion that gains this little more than continuing as so far is not reported
    min_noticeable: float = 0.1  # a gain below this share of the noise of a single measurement is not noticeable


@dataclass(frozen=True, eq=False)
class LearnerEvidence:
    nominal: NominalModel
    belief: ChainBelief  # posterior of the chain from the pairs with the current tool
    wide: ChainBelief  # the same without the selection of narrower tolerances
    tolerances: ChainTolerances  # those of the first prior
    uncertainty: PredictiveUncertainty  # uncertainty of the answering model
    solved: bool  # True if that model was solved together with `belief`
    pairs: int  # number of learnt pairs with the current tool
    region: FloatArray  # poses (k, d) [rad, m] that represent the data's region
    seen: FloatArray  # poses (n, d) [rad, m] of some of them, evenly spread
    # q, x: the newest pairs of the solver, (m, d) [rad, m] and (m, 3) [m]
    q: FloatArray
    x: FloatArray


@dataclass(frozen=True)
class ResidualScatter:
    """Scatter of the newest pairs around the most probable chain."""

    noise_m: float  # 1-sigma of a measured coordinate [m], including errors that no chain explains
    outliers: int  # number of pairs too far away for this noise
    shared: float  # number of neighbours on the path that carry as much information as one pair

    @classmethod
    def of(cls, evidence: LearnerEvidence) -> ResidualScatter:
        """Return the scatter of the newest pairs."""
        predicted, variance = evidence.belief.predict_with_variance(evidence.q)
        residuals = evidence.x - predicted
        distances = np.linalg.norm(residuals, axis=1)
        # The part of the residuals that the fit absorbs equals its uncertainty at the same places.
        noise = math.hypot(MEDIAN_TO_SIGMA * float(np.median(distances)), math.sqrt(float(np.median(variance))))
        noise = max(noise, FilterSettings.min_noise_m)
        inliers = distances <= RobustSettings.outlier_sigmas * noise
        return cls(noise, int((~inliers).sum()), shared_by(residuals[inliers]))


def forecast(evidence: LearnerEvidence, scatter: ResidualScatter, joints: tuple[str, ...]) -> DataOutlook:
    """Return the expected gain of further pairs in the region visited so far, for an answering solution.

    The current error is the predicted one there. The forecast gives the factor by which it falls.

    Args:
        scatter: scatter of the newest pairs.
        joints: names of the joints.
    """
    rng = np.random.default_rng(0)  # the same pairs have the same outlook
    nominal, uncertainty = evidence.nominal, evidence.uncertainty
    lower, upper = nominal.lower, np.maximum(nominal.upper, nominal.lower + FilterSettings.min_noise_m)
    floor = float(np.sqrt(np.square(uncertainty.in_sample).mean()))
    noise = scatter.noise_m * math.sqrt(scatter.shared)
    posterior = ChainPosterior.of_belief(evidence.belief, noise=max(noise, floor), floor=floor)
    motions = candidate_motions(evidence.seen, lower, upper, rng, names=joints, count=_Settings.poses)
    forecast = expected_gain(posterior, evidence.region[: _Settings.poses], motions, _Settings.further, rng)
    by_motion = {motion.motion: motion.errors for motion in forecast.motions}
    best = forecast.motions[0].motion
    if by_motion[best][-1] > (1.0 - _Settings.min_benefit) * by_motion[SAME][-1]:
        best = SAME
    claimed = _mean_error_m(uncertainty, evidence.region)
    scale = claimed / forecast.now if forecast.now > 0.0 else 1.0
    gain = scale * (forecast.now - forecast.motions[0].errors[-1])
    return DataOutlook(
        pairs=evidence.pairs,
        error_m=claimed,
        least_error_m=scale * forecast.least,
        anywhere_m=_mean_error_m(uncertainty, rng.uniform(lower, upper, (_Settings.poses, nominal.joints))),
        further_pairs=list(_Settings.further),
        like_so_far_m=[scale * error for error in by_motion[SAME]],
        best_motion={SAME: "moving as so far", ALL: "moving all joints over their ranges"}.get(
            best, f"moving {best} over its range"
        ),
        best_motion_m=[scale * error for error in by_motion[best]],
        enough=forecast.is_enough() or gain < _Settings.min_noticeable * scatter.noise_m,
    )


def _mean_error_m(uncertainty: PredictiveUncertainty, q: FloatArray) -> float:
    """Return the expected mean distance to the truth [m] at q (n, d) [rad]."""
    return MEAN_OVER_RMS * float(np.sqrt(uncertainty.variance(q).sum(axis=1)).mean())
