"""Settings of the ball tracker and their sensitivity.

Sensitivity: each at 0.3 and 3 times, over the 354 frames of the tests. An outcome is a fix or the reason for a miss.
"""

from __future__ import annotations

import numpy as np


class OutlineSettings:
    """Settings of the outline by coverage.

    What matters: the narrow ring and its limits (24 to 137 other outcomes), `uneven_px` (27), `background_px` (14),
    `min_level` (11), and `inner` beyond the ball. The others change at most 8 outcomes, and half of the positions by
    less than 0.1 sigma.
    """

    # Half-widths [px] of the ring in which the edge is searched: about a circle right to a pixel, and about others.
    narrow_px, wide_px = 2.0, 4.0
    # A fit in the narrow ring is final if it moved the circle by less than the first of these [px]; a rough circle that
    # is off by more than the second one is fitted in the wide ring.
    settled_px, rough_px = 0.5, 1.0
    step_px, background_px = 0.5, 2.0  # between samples along a ray, and length of the background's [px]
    inner = np.linspace(0.0, 1.0, 6)  # places on the ball that show its colour
    # Difference of any channel between the limb and a little inside, apart from brightness (1-sigma, grey levels).
    # A ray shows the edge if ball and background differ by so many of these sigmas.
    channel_sigma, min_separation = 4.0, 3.0
    min_level = 0.2  # a limb with less than this share of the usual level is occluded
    # Error of one edge point before an even background [px]. An uneven one adds to it; where it adds more than the
    # second, an edge elsewhere hides nothing.
    edge_sigma_px, uneven_px = 0.06, 0.4
    # A residual below the first [px] is edge noise, and so is one below so many times the spread.
    min_gate_px, gate_sigmas = 0.8, 3.5
    arcs = 10  # of the outline; any three give a candidate circle
    # An arc is not the ball's edge if its mean is off by more [px, and share of the radius]: balls have seams, dimples.
    off_px, off_share = 0.35, 0.05
    floor_px = 0.001  # systematic error that averaging does not reduce
    # A larger disagreement between coverage and limb, in sigmas, is added to the covariance.
    largest_contradiction = 4.0
    enough_rays = 60  # rays that suffice for the ball's colour, and to find the circle that most of them agree on


class ContourSettings:
    """Settings of the limb: filters across the edge, the ellipse through it, and the waves that it leaves.

    What matters: `aliased_px` (20 of 181 other outcomes), `worst_sigma_blurs` (as 0.5 px), `farthest_px` at 0.3 times
    (22, 20), `iterations` at 1 (15), `wave_radius_px` at 1 (13), `smoothing_px` at 3 (115), `best_sigma_px` at 3 times
    (sigma + 50 %). The four densities change sigma by - 10 to + 30 % and no outcome. The others change at most 9
    outcomes, and half of the positions by less than 0.7 sigma.
    """

    # Between samples [px]; sampled lengths on the ball and beyond [px], for the usual blur; a wider one needs longer.
    step_px, inside_px, outside_px, usual_blur_px = 0.5, 4.0, 8.0, 0.86
    # Textures that are told apart: 1-sigma of the random walk over 1 px, and the slope's variance [1/px²], in units of
    # the noise.
    textures = ((0.02, 0.003), (0.5, 1.0), (2.0, 1.0), (8.0, 1.0), (30.0, 1.0))
    # Priors' variances, in units of the noise: what is free, the ball's level across its own colour, and a blur that is
    # not quite the true one, times the contrast.
    free, across, blur = 1e4, 0.1, 300.0
    # Gloss and uneven light: 1-sigma that a sample on the ball gets for each px² from where the edge's blur ends.
    gloss, edge_blurs = 2.0, 1.4
    fine_px = 0.05  # integration step of what the lens blurs
    # Where the samples on the ball for its colour and the noise begin (share of the radius), and their places.
    inner_part, inner = 0.3, np.linspace(0.0, 1.0, 4)
    # Least noise of a sample [grey levels]; share of the rays whose background is assumed to show little but noise.
    min_noise, even_rays = 1.0, 0.3
    beyond_blurs = 2.0  # from the edge, the ball no longer shows
    # Smallest sigma of a ray's edge [px]; a ray with a sigma above the largest (share of the blur) is ignored.
    best_sigma_px, worst_sigma_blurs = 0.03, 0.6
    # The channels' disagreement (chi-squared, 2 degrees of freedom): more than this, and than this times the median of
    # the ball's rays, is no noise, and makes a ray's variance larger by that power of it; what its median is of noise.
    min_disagreement, usual_disagreement, disagreement_power, of_noise = 2.0, 1.5, 3, 3.0
    largest_widening = 1.5  # factor of the blur from one iteration to the next
    iterations, settled_px = (
        4,
        0.06,
    )  # most iterations; converged when the limb and its blur changed by less than this [px]
    # An edge sharper than this after interpolation [px] was not anti-aliased: coverage is then the better measure.
    aliased_px = 0.55
    # Student's degrees of freedom of an edge's error, which set the weight of outliers; residual limit [px]; rounds.
    freedom, farthest_px, rounds = 4.0, 1.0, 3
    # The wave once round is at least so large: this, and so many times the noise that the channels show; that the other
    # waves are small is no sign that it is. Beside that it is this part of what the few waves tell, and where they tell
    # of far more it is the square, over the last: a bend that shows is a sign of one that the fit has removed.
    min_density, channels_noise, measured, usual_density = 0.5, 1.75, 0.4, 12.0
    # If a smaller share of the rays carries the circle, their errors are not averaged out: sigma grows in proportion.
    min_evenness = 0.5
    # What covers a ball breaks its limb at sharp corners, which shows in the quick waves; what is behind it bends whole
    # arcs, in the slow ones, which the claim follows. Beyond so many times the variance of the samples, as far as the
    # channels agree on that, it is no ball's limb alone.
    largest_density = 10.0
    # A larger deviation from the circle (RMS without noise, share of the radius, and of the blur) is angular: a square.
    max_angular, max_angular_blurs = 0.05, 0.25
    # Smaller deviations (RMS, share of the radius) occur on every ball (seams, dust, dents) and are no occlusion.
    round_share = 0.0075
    # Least number of slow waves; larger outlines count those up to the wave number radius / wave_radius_px.
    min_waves, wave_radius_px = 3, 3.0
    # Lens and interpolation smooth along the outline too, which takes power from the quicker waves (1-sigma) [px].
    smoothing_px = 1.0


class PatchSettings:
    """Settings of patches of the ball's colour.

    What matters: `max_uneven` at 0.3 times (20 of 181 other outcomes), `whole_disc_fill` (10) and `strong_shares` (8).
    The others change at most 6 outcomes; `min_fill` only saves time.
    """

    min_fill = 0.45  # a patch that fills a smaller share of its enclosing circle is not a ball
    whole_disc_fill = 0.8  # below this share a patch may be the ball joined with a background of similar hue
    strong_shares = (0.5, 0.7)  # of the strongest colour, that separate the ball from its background
    # Part of a ball or a brick has an edge on some sides only; on the others its surroundings are as colourful.
    max_uneven = 0.3
    max_outlier_share = 0.15  # the ball is occluded if a larger share of its outline leaves the ellipse
    max_white = 0.35  # share of over-exposed pixels on a ball that can be measured
    min_pixels = 30  # a patch of the marker's colour smaller than this is no candidate [px²]
    max_patches = 12  # so many patches of an eye are looked at closely, the most disc-like first
    border_px = 3.0  # how far the outline has to stay from the border of the image
    min_visible = 0.75  # share of the outline that has to be seen where the fitted ellipse says
    # A centre less certain than this [px] is doubtful: what was fitted is no ellipse. It applies up to this radius
    # [px], and in proportion to larger ones.
    max_sigma_px, small_px = 0.4, 5.0
    # A circle about a patch that could not be measured, or that the border cuts, is right to this share of its radius.
    rough_share = 0.1
    apron_px = 12  # around a patch, for its outline


class ColourSettings:
    """Settings of the ball's colour: how it is learnt from images, and followed.

    `adapted`, `farthest` and `room` change no outcome. The others, with which it is learnt, were not measured: what is
    learnt is a range, which people see and can change.
    """

    # Share of the way to the ball's present colour that the band moves at a fix; limit of its shift (half-widths).
    adapted, farthest = 0.05, 0.5
    room = 0.6  # lower limits of saturation and brightness, relative to the ball's own
    # Radius around a click for the first colour [px]; the ball is the connected region of nearly that colour.
    seed_px, hues_of_a_click_deg = 3, 25.0
    min_saturation, min_value = 64, 40  # pixels nearer to grey or black than this have no usable hue (parts of 255)
    share, margin_deg = 0.02, 8.0  # quantile of the ball's hues cut off on either side, and margin for other light [°]
    # Lowest saturation and brightness of the ball in other light, relative to those seen here.
    dimmer_saturation, dimmer_value = 0.6, 0.35
    # Change that marks a moving pixel [grey levels], and the fewest moving pixels of a ball.
    changed, min_pixels = 25, 30


class TrackSettings:
    """Settings of the two eyes' match, of the ball's size, and of its track.

    What matters: `longest_memory_s` at 3 times (25 of 181 other outcomes), `mirrored_light` (10), `rough_limit` at 0.3
    times (6), `fastest_m_s` at 3 times (7), `level_ratio` (4). The others change at most 3 outcomes; sigmas of size
    change single sigmas by 15 to 200 %.
    """

    # Largest difference of the eyes' rows [px], on top of so many sigmas of the two centres, which count in sizes too.
    epipolar_px, epipolar_sigmas = 0.5, 4.0
    eye_size_ratio = 1.05  # largest ratio of the sizes that the two eyes see, besides noise
    depth_size_ratio = 1.3  # largest ratio between the radius seen and the one expected at the triangulated depth
    fastest_m_s = 3.0  # the marker does not move faster; what is farther off is something else
    mirrored_light = 0.8  # a mirror gives back less than this of the light, and its copy stands farther off
    # Fingertips over a limb show in both eyes: where both limbs leave their ellipses by more, in variances of the
    # samples, something covers the ball. What is behind it is not the same in both.
    rough_limit = 4.2
    size_tolerance = 0.002  # relative 1-sigma of what calibration leaves of a difference between the eyes' sizes
    min_shown = 0.6  # how much of a thing's place has to show its colour
    # Relative 1-sigma of a ball's radius measured by hand, and of the size from one place to another after calibration.
    radius_sigma, place_tolerance = 0.03, 0.004
    memory, free_sigmas = 31, 1.5  # number of fixes whose size is remembered; a size error of fewer sigmas is ignored
    # After this many fixes a size that differs by more sigmas, and by more than this share, is another object.
    fewest, max_sigmas, max_size_error = 5, 4.0, 0.06
    # Distances that follow from the ball's size, each better than the last by a factor of its squared size in the
    # image.
    distance_rounds = 5
    # Half the side of the region searched around the predicted centre: radii, plus pixels, plus steps between frames.
    region_radii, region_px, region_steps = 1.6, 14.0, 0.7
    prediction_tolerance = (
        0.25  # a disc fits the prediction if position and size differ by less, in radii of the marker
    )
    # So long after the last fix the marker is expected within reach of it [s], if it moved on for no longer than this
    # [s]; the reach is so many radii larger. Without a fix, what is left of two is the marker after that time.
    longest_memory_s, fair_pause_s, jump_radii = 0.9, 0.1, 2.0
    # What looks like the marker's copy in a mirror is the marker in the shade where it is no more radii from the last
    # fix.
    copy_radii = 4.0
    # Of two things one after the other that are one thing, the brighter is not brighter than this times the other.
    level_ratio = 1.25
    colour_every = 5  # fixes between two looks at the ball's colour
