"""The marker ball, ray-cast: an exact sphere, unlike a mesh."""

from __future__ import annotations

import numpy as np

from bodyschema.interfaces.records import FloatArray

_AMBIENT, _DIFFUSE, _SPECULAR = 0.55, 0.4, 0.12
_SHININESS = 20


def cast_ball(
    directions: FloatArray,
    centre: FloatArray,
    radius: float,
    depth: FloatArray,
    bgr: FloatArray,
    to_light: FloatArray | None,
) -> tuple[np.ndarray, FloatArray]:
    """Return the mask of the rays that hit the ball before anything else, and its colour there.

    Args:
        directions: rays (n, m, 3) in the eye's optical frame with z = 1.
        centre: of the ball in that frame (3,) [m].
        depth: distance along z of everything else (n, m) [m].
        bgr: the ball's colour (3,), 0 to 1.
        to_light: unit vector to the light (3,) in that frame; None: the ball glows by itself.

    Returns:
        The mask (n, m) and the colours (k, 3), 0 to 255, of the rays in the mask.
    """
    along = directions @ centre
    length2 = np.einsum("ijk,ijk->ij", directions, directions)
    discriminant = along**2 - length2 * (centre @ centre - radius**2)
    near = (along - np.sqrt(np.maximum(discriminant, 0.0))) / length2
    mask = (discriminant > 0) & (near > 0) & (near < depth)
    if to_light is None:
        return mask, np.tile(255.0 * bgr, (int(mask.sum()), 1))
    rays = directions[mask]
    normals = (near[mask][:, None] * rays - centre) / radius
    facing = np.maximum(normals @ to_light, 0.0)
    mirrored = 2 * facing[:, None] * normals - to_light
    to_eye = -rays / np.linalg.norm(rays, axis=1, keepdims=True)
    shine = np.maximum(np.einsum("ij,ij->i", mirrored, to_eye), 0.0) ** _SHININESS
    colours = (_AMBIENT + _DIFFUSE * facing)[:, None] * bgr + (_SPECULAR * shine)[:, None]
    return mask, np.minimum(colours, 1.0) * 255.0
