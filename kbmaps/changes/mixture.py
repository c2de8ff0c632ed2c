"""Evidence for a change of unknown size: its likelihood ratio, averaged over sizes."""

from __future__ import annotations

import numpy as np

from kbmaps.arrays import FloatArray

# Sizes of a change over the noise of one measurement, equally probable: from a fraction of it to far beyond it.
SIZES = (0.5, 2.5, 12.0, 60.0)


def log_ratios(information: FloatArray, score: FloatArray, sizes: FloatArray) -> FloatArray:
    """Return the log likelihood ratio of a change θ ~ N(0, s² 1) to none, averaged over the sizes s, (m,).

    With the information G and the score u = G θ̂ that a linear model has of θ, and in G's eigenvectors:

        log Λ_s = ½ Σ_j u_j² s² / (1 + s² g_j) − ½ Σ_j log(1 + s² g_j)

    Without a change its expectation is 1, whatever the prior (Lai 1998, "Information bounds and quick detection of
    parameter changes in stochastic systems").

    Args:
        information: G (m, k, k).
        score: u (m, k).
        sizes: s (s,), in θ's units.
    """
    if score.shape[1] == 1:
        values, along = information[:, :, 0], score
    else:
        values, vectors = np.linalg.eigh(information)
        along = np.matvec(vectors.transpose(0, 2, 1), score)
    squares = np.square(sizes)[:, None]
    widened = 1.0 + squares * np.maximum(values, 0.0)[:, None]
    ratios = 0.5 * (squares * np.square(along)[:, None] / widened - np.log(widened)).sum(axis=2)
    return np.logaddexp.reduce(ratios, axis=1) - np.log(len(sizes))
