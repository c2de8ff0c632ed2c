"""Print a camera calibration and its check on a terminal of 80 columns."""

from __future__ import annotations

from rich import box
from rich.console import Group
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from bodyschema.cli.cameras.calibration import AHEAD_M, CamerasFile, CheckFile
from bodyschema.vision.calibration.report.page import to_its_interval

_WISHES = 3


def cameras_view(found: CamerasFile) -> Group:
    """Return a table of the eyes' parameters, followed by sentences on their accuracy."""
    width, height = found.image_size_px
    eyes = ("left", "right") if found.baseline_mm is not None else ("left",)
    titles = ("left", "95 %", "right", "95 %") if len(eyes) > 1 else ("value", "95 %")
    table = _table(f"{found.model} {'lenses' if len(eyes) > 1 else 'lens'}, {width}x{height}", *titles)
    values = {each.name: each for each in found.parameters}
    own = [name.removeprefix("left.") for name in values if name.startswith("left.")]
    for name in own:
        own_of = (values[f"{eye}.{name}"] for eye in eyes)
        pairs = (to_its_interval(each.value, each.half_width) for each in own_of)
        table.add_row(Text(_with_unit(name)), *(text for pair in pairs for text in pair))
    return Group(table, *(Padding(Text(text), (1, 0, 0, 0), expand=False) for text in _sentences(found)))


def check_view(found: CheckFile, name: str) -> Group:
    """Return a table of measured and expected figures, followed by the verdict."""
    table = _table(f"{name}: {found.corners} corners", "measured", "95 %", "should be")
    table.add_row(
        Text("rows of both eyes apart [px]"), f"{found.rows_px:+.3f}", f"± {found.rows_half_width_px:.3f}", "0"
    )
    table.add_row(Text("  RMS of all corners [px]"), f"{found.epipolar_px:.3f}", "", "")
    table.add_row(Text("one eye rolled [°]"), f"{found.roll_deg:+.3f}", f"± {found.roll_half_width_deg:.3f}", "0")
    table.add_row(
        Text("square [mm]"), f"{found.square_mm:.3f}", f"± {found.square_half_width_mm:.3f}", f"{found.nominal_mm:.3f}"
    )
    texts = ["The calibration holds."]
    if not found.holds:
        texts = [
            f"The calibration does not hold: {'; '.join(found.wrong)}.",
            "Put that right, or calibrate again: `bodyschema calibrate cameras`.",
        ]
    return Group(table, *(Padding(Text(text), (1, 0, 0, 0), expand=False) for text in texts))


def _sentences(found: CamerasFile) -> list[str]:
    said: list[str] = []
    if found.position_half_widths_mm is not None:
        across, down, ahead = found.position_half_widths_mm
        said.append(
            f"Baseline {found.baseline_mm:.2f} ± {found.baseline_half_width_mm:.2f} mm (95 %). A position "
            f"{AHEAD_M:g} m ahead is known to ± {across:.2f} mm across, {down:.2f} down, {ahead:.2f} in depth, as far "
            "as the calibration goes."
        )
    said.append(
        f"Views that were not fitted are foretold to {found.held_out_px:.3f} px (RMS per coordinate; fitted "
        f"{found.reprojection_px:.3f}); {len(found.views)} views of {found.board}. {_rivals(found)}"
    )
    said.extend(f"Warning: {text}." for text in found.refocused)
    if found.left_out:
        names = "; ".join(f"{each.name} ({each.rms_px:.2f} px, others {each.usual_px:.2f})" for each in found.left_out)
        said.append(f"Left out, since they do not fit the others: {names}.")
    if found.unusable:
        said.append(f"{len(found.unusable)} images could not be used; the report names them.")
    # The size of the board moves it nearer or farther, and changes nothing of a lens.
    if not found.size_was_measured and found.baseline_mm is not None:
        said.append(
            "No image shows whether the board has its stated size: measure the line below it and give --ruler-mm, "
            "or the distance of the lenses and give --baseline-mm."
        )
    if found.missing:
        more = "" if len(found.missing) <= _WISHES else f"; and {len(found.missing) - _WISHES} more, in the report"
        said.append(f"It would be better with: {'; '.join(found.missing[:_WISHES])}{more}.")
    return said


def _rivals(found: CamerasFile) -> str:
    if len(found.held_out_by_model_px) < 2:
        return ""
    errors = ", ".join(f"{model} {px:.3f} px" for model, px in found.held_out_by_model_px.items())
    return f"Lens models by that error: {errors}."


def _with_unit(name: str) -> str:
    return f"{name.removesuffix('_px')} [px]" if name.endswith("_px") else name


def _table(first: str, *others: str) -> Table:
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False)
    table.add_column(Text(first), overflow="fold")
    for name in others:
        table.add_column(name, justify="right", no_wrap=True)
    return table
