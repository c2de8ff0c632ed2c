"""Settings of the tag tracker and their sensitivity."""

from __future__ import annotations


class EdgeSettings:
    """Settings of a tag's edges.

    Sensitivity, each at 0.3 and 3 times over the 57 frames of the tests: all outcomes stay, half of the positions move
    by less than 0.8 sigma and half of the sigmas change by less than 7 %. What matters: the lengths of the lines,
    `clear_blurs`, `clear_share`, `corner_blurs` and `longest_reach_px` (0.4 to 2.2 sigma, sigma + 4 to + 32 %), and
    `sharpest_px` at 3 times.
    """

    min_contrast = 20.0  # difference of white and black [grey levels]
    min_visible = 0.7  # share of each edge that has to be on a line
    # Distance in blurs that lines across an edge keep from the ends of black border and white margin (one module each),
    # so that little of the modules beyond shows; on small tags they reach over this share of the module. Their distance
    # in blurs from the tag's corners, which are rounded off: at 1.8 without noise tags come out larger by 0.0004 px an
    # edge.
    clear_blurs, clear_share, corner_blurs = 1.7, 0.5, 2.6
    longest_reach_px = 6.0
    sample_px = 0.5
    min_points, max_points = 6, 80
    sharpest_px = 0.45  # edge (1-sigma)
    beyond_share = 0.2  # relative error of the correction for the modules beyond: no lens blurs exactly like a Gaussian
    # Least error of an edge [px]: images without noise leave 0.0004 to 0.0007, as levels are whole numbers. Noise
    # spreads that error over the points, whose scatter has it then.
    floor_px = 0.0007
    # Points farther from their line than this, in medians of all points' distances, are outliers. So much [px] paper
    # that is not flat and a camera's sharpening may bring.
    stray_medians, wavy_px = 5.2, 0.15
    wider_px = 1.5  # what is added to the blur of the filter for an edge's shift [px]
    # Prior variances in units of the noise: of the levels, and of their gradients across the edge [1/px²].
    free, level, gradient = 1e4, 0.5, 0.01
    # Ends of the lines across that show plain black and plain white where an edge may be pixels off, as a share of
    # their reach.
    plain = 0.35


class TagSettings:
    """Settings of a tag's corners, of its pose, and of the search for it.

    Sensitivity, as above: all outcomes stay, half of the positions move by less than 0.3 sigma and half of the sigmas
    change by less than 5 %. What matters: `apart_share` at 0.3 times (3 outcomes), `rounds` at 1 (0.4 sigma), `chance`
    at 0.3 times (sigma + 32 %). The numbers of search and pose change nothing there. Of the limits, in 189 frames:
    `min_side_px` at 3 times (47 outcomes) and `max_reprojection` at 0.3 times (12); the others change none.
    """

    min_side_px = 16.0  # a shorter side is too small to be measured
    max_corner_sigma = 0.05  # 1-sigma of a corner, as a share of the side: edges that are not straight have more
    epipolar_px, epipolar_sigmas = 0.5, 4.0  # largest difference of the eyes' rows [px], on top of so many sigmas
    size_tolerance = 0.03  # largest part by which the printed size may contradict the stereo depth, besides noise
    max_reprojection = 4.0  # largest misfit of the corners to the marker's shape (RMS, in their own sigmas)
    # Most rounds with rough corners, and half of all; converged when no corner would move by more than this [px].
    rounds, settled_px = 4, 0.003
    rough_share = 0.3  # corners are rough until they move by less than this share of a module
    usual_blur_px = 0.85  # usual blur of lens and interpolation (1-sigma) [px]
    max_blur = 0.5  # a blur that is a larger share of a module is the cause where corners are not sure
    smoothed_waves = 10  # weight in waves along the edges of the power that interpolation alone gives them
    slow = 4  # slow waves have half-periods of at least this many points, and this least upper bound of their indices
    chance = 2.5  # standard deviations of chance that a random walk along the edges has to exceed
    shorter = 0.5  # share of their length that lines across edges keep where the usual ones leave the margin
    # Margin of the search region around the last frame's corners: share of their extent, plus pixels.
    region_share, region_px = 0.6, 30
    # Poses farther apart than this [rad] are distinct; the worse must be less likely by this difference of squares.
    two_poses_rad, clearly_worse = 0.05, 12.0
    # Of two poses that the image does not distinguish, take one that is no farther from the last frame's pose than this
    # share of the angle between the two.
    stayed = 1.0 / 3.0
    apart_share = 0.03  # squares are two where their corners are on the mean so far apart, as a share of the perimeter


class BleedSettings:
    """Settings of the bleeding of white into black, which were not varied. It has converged as corners have."""

    max_samples = 80  # along a row of modules; else one a pixel
    rounds = 3  # of the fit: a fourth moves bleeding of a pixel by 0.002 px
    step_share = 0.01  # step of the derivative, in parts of the blur
    widest = 0.5  # bleeding by this share of a module leaves nothing of it
    # Share of the samples that the pattern has to explain; the usual bleeding, in parts of the blur, where it does not.
    explained, usual = 0.9, 0.3
    # Relative error on nine photographed grids (RMS): modules inside are not drawn and lit exactly as the edges are.
    unlike = 0.25
