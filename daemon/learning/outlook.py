"""Whether there is enough data: what further pairs would still gain, and which motion would gain most."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from bodyschema.daemon.status import Outlook
from bodyschema.interfaces.records import FloatArray
from kbmaps import ChainBelief, ChainPosterior, ChainTolerances, candidate_motions, expected_gain, shared_by
from kbmaps.planning.expected_gain import ALL, SAME
from kbmaps.robust import OUTLIER_SIGMAS

from .claims import Claim
from .gate import MEDIAN_TO_SIGMA
from .nominal import NominalModel
from .snapshot import MEAN_OVER_RMS

FURTHER = (100, 300)
# Poses of a motion, and those that stand for where the arm is used. More would make the figures no steadier than the
# belief is.
POSES = 100
# A motion that gains so little more than going on as so far is not worth a word.
WORTH = 0.05
# A gain below this share of the noise of a single measurement is one that nobody notices.
NOTICED = 0.1
# Noise below this is none that a camera has; there has to be some [m].
LEAST_NOISE_M = 1e-6


@dataclass(frozen=True, eq=False)
class Known:
    """What the learner knows of the chain at one moment.

    Attributes:
        nominal: where learning started.
        belief: what the pairs with the present tool let believe of the chain.
        wide: the same, were it not for how well it seems to be made.
        tolerances: how far from the nominal chain it was believed to be at first.
        claim: of the model that answers.
        solved: whether that is a solution, of whose error the belief tells.
        pairs: how many pairs with the present tool were learnt.
        region: poses (m, d) [rad, m] that stand for where the data is.
        seen: poses (n, d) [rad, m] of some of them, evenly spread.
        q, x: the newest that the solver knows, (m, d) [rad, m] and (m, 3) [m].
    """

    nominal: NominalModel
    belief: ChainBelief
    wide: ChainBelief
    tolerances: ChainTolerances
    claim: Claim
    solved: bool
    pairs: int
    region: FloatArray
    seen: FloatArray
    q: FloatArray
    x: FloatArray


@dataclass(frozen=True)
class Scatter:
    """How the newest pairs lie around the most probable chain.

    Attributes:
        noise_m: 1-sigma of a measured coordinate [m], what no chain explains included.
        outliers: pairs that are too far away for this noise.
        shared: so many neighbours on the path tell as much as one pair.
    """

    noise_m: float
    outliers: int
    shared: float

    @classmethod
    def of(cls, known: Known) -> Scatter:
        """That of the newest pairs."""
        predicted, variance = known.belief.predict_with_variance(known.q)
        missed = known.x - predicted
        distances = np.linalg.norm(missed, axis=1)
        # What the fit takes from the residuals is what it is still unsure of at the same places.
        noise = math.hypot(MEDIAN_TO_SIGMA * float(np.median(distances)), math.sqrt(float(np.median(variance))))
        noise = max(noise, LEAST_NOISE_M)
        inliers = distances <= OUTLIER_SIGMAS * noise
        return cls(noise, int((~inliers).sum()), shared_by(missed[inliers]))


def foreseen(known: Known, scatter: Scatter, joints: tuple[str, ...]) -> Outlook:
    """What further pairs would gain where the arm has been, of a solution that answers.

    The error now is the one that is claimed for predictions there. The forecast says by which factor it falls.

    Args:
        joints: their names.
    """
    rng = np.random.default_rng(0)  # the same pairs have the same outlook
    nominal, claim = known.nominal, known.claim
    lower, upper = nominal.lower, np.maximum(nominal.upper, nominal.lower + LEAST_NOISE_M)
    floor = float(np.sqrt(np.square(claim.inside).mean()))
    noise = scatter.noise_m * math.sqrt(scatter.shared)
    posterior = ChainPosterior.of_belief(known.belief, noise=max(noise, floor), floor=floor)
    motions = candidate_motions(known.seen, lower, upper, rng, names=joints, count=POSES)
    forecast = expected_gain(posterior, known.region[:POSES], motions, FURTHER, rng)
    by_motion = {motion.motion: motion.errors for motion in forecast.motions}
    best = forecast.motions[0].motion
    if by_motion[best][-1] > (1.0 - WORTH) * by_motion[SAME][-1]:
        best = SAME
    claimed = _mean_error_m(claim, known.region)
    scale = claimed / forecast.now if forecast.now > 0.0 else 1.0
    gain = scale * (forecast.now - forecast.motions[0].errors[-1])
    return Outlook(
        pairs=known.pairs,
        error_m=claimed,
        least_error_m=scale * forecast.least,
        anywhere_m=_mean_error_m(claim, rng.uniform(lower, upper, (POSES, nominal.joints))),
        further_pairs=list(FURTHER),
        like_so_far_m=[scale * error for error in by_motion[SAME]],
        best_motion=_in_words(best),
        best_motion_m=[scale * error for error in by_motion[best]],
        enough=forecast.is_enough() or gain < NOTICED * scatter.noise_m,
    )


def _mean_error_m(claim: Claim, q: FloatArray) -> float:
    """Mean distance to the truth [m] that is claimed at q (n, d) [rad]."""
    return MEAN_OVER_RMS * float(np.sqrt(claim.variance(q).sum(axis=1)).mean())


def _in_words(motion: str) -> str:
    return {SAME: "going on as so far", ALL: "moving all joints over their ranges"}.get(
        motion, f"moving {motion} over its range"
    )
