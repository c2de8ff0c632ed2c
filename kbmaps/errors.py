"""All errors raised by kbmaps, as one tree.

KBMapsError
├── ShapeError            an array has the wrong shape
├── NotNumbersError       an argument is not an array of numbers
├── NonFiniteError        a number is NaN or infinite
├── BasisError            a basis cannot be built from these parameters
│   ├── SingularAlphaError    alpha is too near to 90 degrees
│   └── NetSizeError          a control net would be too large
├── ChainError            transforms or axes do not describe a rigid chain
├── RotationError         matrices or quaternions do not describe rotations
├── SettingError          a learner's setting is outside its range
├── DegenerateDataError   the data do not determine the requested result
└── ModelFormatError      these bytes are not a stored map
"""

from __future__ import annotations

LARGEST_NET = 3**13  # Control points, 3^13: 38 MB for positions, 153 MB with orientations


class KBMapsError(Exception):
    """Root of all errors raised by kbmaps."""


class ShapeError(KBMapsError):
    """An array has the wrong shape."""

    def __init__(self, name: str, expected: str, got: tuple[int, ...]) -> None:
        super().__init__(f"{name} must have shape {expected}, got {got}")


class NotNumbersError(KBMapsError):
    """An argument is not an array of numbers."""

    def __init__(self, name: str, got: object) -> None:
        shown = repr(got)
        super().__init__(
            f"{name} must be an array of numbers, got {shown if len(shown) <= 60 else type(got).__name__}; "
            "rows must be of one length"
        )


class NonFiniteError(KBMapsError):
    """A number is NaN or infinite; nothing was changed."""

    def __init__(self, name: str) -> None:
        super().__init__(f"{name} holds NaN or infinite values; drop or fix these samples before passing them on")


class BasisError(KBMapsError):
    """A basis cannot be built from these parameters, or the bases do not fit each other."""


class SingularAlphaError(BasisError):
    """alpha lies within 80..100 degrees, where the Bernstein basis degenerates."""

    def __init__(self, alpha_deg: float) -> None:
        super().__init__(
            f"alpha = {alpha_deg:.6g} deg is refused: from 80 to 100 deg the middle weight cos(alpha) vanishes and "
            "control points grow without bound; choose e.g. 60 deg, or an orthonormal basis for wide ranges"
        )


class NetSizeError(BasisError):
    """A control net would be too large for memory."""

    def __init__(self, points: int, outputs: int) -> None:
        gibibytes = 8.0 * outputs * points / 2**30
        super().__init__(
            f"a map of these joints has {points:,} control points, {gibibytes:.3g} GiB; at most {LARGEST_NET:,} are "
            "made. "
            "Work with the chain or the learner itself: it predicts, has a jacobian, and InverseKinematics takes it; "
            "learn with RigidLearner, ResidualLearner or TensorLearner, which need no net"
        )


class ChainError(KBMapsError):
    """Transforms or axes do not describe a rigid chain."""


class RotationError(KBMapsError):
    """Matrices or quaternions do not describe rotations."""

    def __init__(self, name: str, what: str) -> None:
        super().__init__(f"{name}: {what}; give rotation matrices, or unit quaternions in the order x, y, z, w")


class SettingError(KBMapsError):
    """A learner's setting is outside its range."""


class DegenerateDataError(KBMapsError):
    """The data do not determine the requested result."""


class ModelFormatError(KBMapsError):
    """These bytes are not a stored map: damaged, truncated, or of another format."""
