"""HTML page of a camera calibration report."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from html import escape
from importlib.resources import files

import numpy as np

from bodyschema.interfaces.records import FloatArray
from bodyschema.vision.calibration.calibrate import Calibrated
from bodyschema.vision.calibration.gather import Gathered
from bodyschema.vision.calibration.report import pictures
from bodyschema.vision.calibration.view import Eye, View, all_px, image_of
from bodyschema.vision.rig.rectified import Rectification
from bodyschema.vision.rig.stereo_rig import StereoRig

NORMAL_95 = 1.96


def page(found: Calibrated, gathered: Gathered) -> str:
    """Return report.html for a calibration and the images it was made from."""
    rig = found.rig
    style = files("bodyschema.vision.calibration.report").joinpath("page.css").read_text(encoding="utf-8")
    head = (
        f"<h1>Cameras calibrated: views that were not fitted are foretold to {rig.provenance.held_out_px:.2f} px</h1>"
        f'<p class="of">{escape(rig.provenance.board)} · {escape(rig.provenance.date[:10])} '
        f"· {' · '.join(_named(eye, serial) for eye, serial in _eyes(found, rig.serials))}</p>"
    )
    parts = (_tiles(found), _coverage(found), _residuals(found), _parameters(found), _views(found, gathered))
    return (
        '<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
        f"<title>Camera calibration</title><style>{style}</style><main>{head}{''.join(parts)}</main></html>\n"
    )


def _tiles(found: Calibrated) -> str:
    rig = found.rig
    calibration = Rectification(rig).calibration
    rivals = ", ".join(f"{model} {px:.3f} px" for model, px in found.held_out_by_model_px.items())
    tiles = (
        *_baseline(found),
        (f"{rig.provenance.held_out_px:.3f} px", "RMS error of views not fitted, per coordinate"),
        (f"{rig.provenance.reprojection_px:.3f} px", "RMS error of the fit, per coordinate"),
        (f"{rig.provenance.views}", f"views; {rig.provenance.left_out} left out"),
        (rig.model, f"lens model, by the error of views not fitted: {rivals}"),
        (f"{calibration.focal_px:.1f} px", "focal length of the rectified images"),
    )
    if found.focal_spread is not None:
        tiles = (*tiles, (f"{found.focal_spread:.1%}", "1-sigma of the focal length over the views: a lens refocused"))
    shown = "".join(f"<div><b>{escape(value)}</b><span>{escape(what)}</span></div>" for value, what in tiles)
    return f'<section><div class="tiles">{shown}</div></section>'


def _baseline(found: Calibrated) -> Iterator[tuple[str, str]]:
    rig = found.rig
    if isinstance(rig, StereoRig):
        half = NORMAL_95 * 1e3 * rig.baseline_sigma_m
        yield f"{1e3 * rig.baseline_m:.2f} ± {half:.2f} mm", "baseline, 95 %"


def _eyes(found: Calibrated, serials: Sequence[str]) -> list[tuple[str, str]]:
    """Return name and device of each eye; a single eye has no name."""
    return list(zip(found.coverage.eyes if len(serials) > 1 else ("",), serials, strict=True))


def _named(eye: str, serial: str) -> str:
    return f"{eye} {escape(serial or 'not named')}".strip()


def _coverage(found: Calibrated) -> str:
    figures = "".join(
        f"<figure>{pictures.coverage(all_px(found.fitted.views, eye), found.coverage.covered(eye), _size(found), eye)}"
        f"<figcaption>{eye if len(found.coverage.eyes) > 1 else ''}</figcaption></figure>"
        for eye in found.coverage.eyes
    )
    missing = found.coverage.missing()
    wishes = f"<ul>{''.join(f'<li>{escape(text)}' for text in missing)}</ul>" if missing else ""
    verdict = "It would be better with these views:" if missing else "Nothing is missing."
    return (
        "<section><h2>Where the board was</h2><p>Every corner that was found. Red parts have too few: there the lens "
        f'is a guess.</p><div class="pair">{figures}</div><p>{verdict}</p>{wishes}</section>'
    )


def _residuals(found: Calibrated) -> str:
    off = {eye: np.concatenate([np.zeros((0, 2)), *_eye_residuals(found, eye)]) for eye in found.coverage.eyes}
    lengths = np.linalg.norm(np.concatenate(list(off.values())), axis=1)
    # The 95 % quantile of the residuals becomes an arrow of 4 % of the image's width.
    stretch = _round(0.04 * _size(found)[0] / float(np.quantile(lengths, 0.95)))
    figures = "".join(
        f"<figure>{pictures.residuals(all_px(found.fitted.views, eye), off[eye], stretch, _size(found), eye)}"
        f"<figcaption>{eye if len(found.coverage.eyes) > 1 else ''}</figcaption></figure>"
        for eye in found.coverage.eyes
    )
    return (
        f"<section><h2>What is left</h2><p>From where each corner should be to where it was found, {stretch:g} times "
        "as long as it is. Arrows that point in all directions are noise. Neighbours that agree are a lens that this "
        f'model does not have, or a board that is not flat.</p><div class="pair">{figures}</div></section>'
    )


def _parameters(found: Calibrated) -> str:
    rig = found.rig
    rows = "".join(
        "<tr><td>{}<td>{}<td>{}".format(name, *to_its_interval(value, NORMAL_95 * sigma))
        for name, value, sigma in zip(rig.names, rig.vector.tolist(), rig.sigma.tolist(), strict=True)
    )
    return (
        "<section><h2>Every parameter</h2><p>With 95 % intervals from the joint least-squares problem of all views. "
        f"Lengths contain that the board's size is known to {rig.provenance.scale_sigma:.2%}.</p>"
        f'<div class="scroll"><table><tr><th>parameter<th>value<th>95 %{rows}</table></div></section>'
    )


def _views(found: Calibrated, gathered: Gathered) -> str:
    used = {view.name: k for k, view in enumerate(found.fitted.views)}
    left_out = {each.name: each for each in found.fitted.left_out}
    rms, foretold = found.fitted.bundle.view_rms_px(), found.fitted.held_out.view_rms_px
    figures = []
    for view in gathered.views:
        if view.name in used:
            k = used[view.name]
            text = f"{rms[k]:.3f} px, {foretold[k]:.3f} px when not fitted"
        else:
            each = left_out[view.name]
            text = f"left out: {each.rms_px:.2f} px, the others have {each.usual_px:.2f}"
        figures.append(_view(view, gathered, text, is_bad=view.name in left_out))
    faults = "".join(
        f"<li>{escape(each.name)}, {image_of(each.eye, gathered.eyes)}: {escape(each.fault.text)}"
        for each in gathered.unusable
    )
    unusable = f"<h2>Images that could not be used</h2><ul>{faults}</ul>" if faults else ""
    return (
        f"<section><h2>The views</h2><p>Circles are the corners that were found; the first one is red.</p>"
        f'<div class="views">{"".join(figures)}</div>{unusable}</section>'
    )


def _view(view: View, gathered: Gathered, text: str, *, is_bad: bool) -> str:
    pair = gathered.images[view.name]
    eyes = zip(pair.images, gathered.eyes, strict=True)
    images = "".join(
        pictures.photograph(image, view.eye(eye), f"{escape(view.name, quote=True)}, {eye}") for image, eye in eyes
    )
    return (
        f'<figure{" class=bad" if is_bad else ""}><div class="eyes">{images}</div>'
        f"<figcaption><b>{escape(view.name)}</b> {escape(text)}</figcaption></figure>"
    )


def _eye_residuals(found: Calibrated, eye: Eye) -> Iterator[FloatArray]:
    for view, residuals in zip(found.fitted.views, found.fitted.bundle.residuals, strict=True):
        corners = view.eye(eye)
        if corners is not None:
            yield residuals[: len(corners)] if eye == "left" else residuals[len(residuals) - len(corners) :]


def _size(found: Calibrated) -> tuple[int, int]:
    return found.rig.image_size_px


def _round(value: float) -> float:
    """Round to one digit."""
    return float(f"{value:.0e}")


def to_its_interval(value: float, half_width: float) -> tuple[str, str]:
    """Format a value and the half width of its interval: the latter with two digits, both with as many decimals."""
    if not 0.0 < half_width < math.inf:
        return f"{value:.6g}", f"± {half_width:g}"
    places = max(0, 1 - math.floor(math.log10(half_width)))
    return f"{value:.{places}f}", f"± {half_width:.{places}f}"
