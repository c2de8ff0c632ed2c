"""cameras.toml: a calibration as a file."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from bodyschema.interfaces.camera import LARGEST_SIDE_PX
from bodyschema.interfaces.errors import ConfigError
from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.toml_file import Positive, convert, line_of, read_toml
from bodyschema.robot.toml_text import toml_text

from .lens import DISTORTION_NAMES, Lens, Model
from .stereo_rig import CalibrationProvenance, OneEyeRig, Rig, StereoRig, parameter_names

FORMAT, FORMAT_OF_ONE = "bodyschema stereo rig 1", "bodyschema camera 1"
_AGAIN = "Take the file from a copy, or calibrate again: `bodyschema calibrate cameras`"

NotNegative = Annotated[float, Meta(ge=0)]
Pixels = Annotated[int, Meta(ge=16, le=LARGEST_SIDE_PX)]
Turn = Annotated[float, Meta(ge=-3.2, le=3.2)]
Place = Annotated[float, Meta(ge=-10, le=10)]


class _Eye(msgspec.Struct, forbid_unknown_fields=True):
    serial: str
    focal_px: tuple[Positive, Positive]
    principal_point_px: tuple[float, float]
    distortion: tuple[float, ...]


class _Right(msgspec.Struct, forbid_unknown_fields=True):
    rotation_rad: tuple[Turn, Turn, Turn]
    translation_m: tuple[Place, Place, Place]


class _Provenance(msgspec.Struct, forbid_unknown_fields=True):
    date: str
    board: str
    views: Annotated[int, Meta(ge=1)]
    left_out: Annotated[int, Meta(ge=0)]
    reprojection_px: NotNegative
    held_out_px: NotNegative
    scale_sigma: NotNegative


class _Uncertainty(msgspec.Struct, forbid_unknown_fields=True):
    names: tuple[str, ...]
    sigma: tuple[Positive, ...]
    correlation: tuple[tuple[Annotated[float, Meta(ge=-1.000001, le=1.000001)], ...], ...]


class _File(msgspec.Struct, forbid_unknown_fields=True):
    format: str
    model: Model
    image_size_px: tuple[Pixels, Pixels]
    left: _Eye
    right: _Eye
    right_from_left: _Right
    made: _Provenance
    uncertainty: _Uncertainty


class _FileOfOne(msgspec.Struct, forbid_unknown_fields=True):
    format: str
    model: Model
    image_size_px: tuple[Pixels, Pixels]
    camera: _Eye
    made: _Provenance
    uncertainty: _Uncertainty


def read_rig(file: Path) -> Rig:
    """Read the calibration in `file`, of two cameras or of one.

    Raises:
        ConfigError: it cannot be read, is damaged or is another kind of file; names the line.
    """
    tables, text = read_toml(file, written_by="`bodyschema calibrate cameras` writes one", damaged=_AGAIN)
    form = tables.get("format")
    if form not in (FORMAT, FORMAT_OF_ONE):
        what = f"of another format: {form!r}" if form is not None else "no camera calibration"
        raise ConfigError(f"{what}, not {FORMAT!r}", file=file, line=line_of(text, ("format",)), remedy=_AGAIN)
    try:
        found = convert(tables, _File if form == FORMAT else _FileOfOne, file=file, text=text)
    except ConfigError as error:
        raise ConfigError(error.what, file=file, line=error.line, remedy=error.remedy or _AGAIN) from error
    return _checked(found, file, text)


def write_rig(rig: Rig, file: Path) -> None:
    """Write the calibration, replacing the file atomically; raise ConfigError if the folder cannot be written to."""
    heading = "# Written by `bodyschema calibrate cameras`. docs/calibrating_cameras.md says what each entry is."
    text = f"{heading}\n{_text(rig)}"
    part = file.with_name(f"{file.name}.part")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with part.open("w", encoding="utf-8") as stream:
            stream.write(text)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(part, file)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise ConfigError(f"cannot be written: {error.strerror}", file=file, remedy="Fix folder or disk") from error


def _text(rig: Rig) -> str:
    sigma = rig.sigma
    correlation = rig.covariance / np.outer(sigma, sigma)
    eyes: dict[str, object] = {"camera": _eye_table(rig.left, rig.serials[0])}
    if isinstance(rig, StereoRig):
        eyes = {
            "left": _eye_table(rig.left, rig.serials[0]),
            "right": _eye_table(rig.right, rig.serials[1]),
            "right_from_left": {"rotation_rad": rig.rotation_rad.tolist(), "translation_m": rig.translation_m.tolist()},
        }
    tables = {
        "format": FORMAT if isinstance(rig, StereoRig) else FORMAT_OF_ONE,
        "model": rig.model,
        "image_size_px": rig.image_size_px,
        **eyes,
        "made": {name: getattr(rig.provenance, name) for name in CalibrationProvenance.__dataclass_fields__},
        "uncertainty": {
            "names": rig.names,
            "sigma": [float(f"{each:.6g}") for each in sigma],
            "correlation": [[round(each, 9) for each in row] for row in correlation.tolist()],
        },
    }
    return toml_text(tables).replace("], [", "],\n    [")


def _eye_table(lens: Lens, serial: str) -> dict[str, object]:
    return {
        "serial": serial,
        "focal_px": lens.focal_px,
        "principal_point_px": lens.principal_point_px,
        "distortion": lens.distortion,
    }


def _checked(found: _File | _FileOfOne, file: Path, text: str) -> Rig:
    def wrong(what: str, *keys: str) -> ConfigError:
        return ConfigError(f"{'.'.join(keys)}: {what}", file=file, line=line_of(text, keys), remedy=_AGAIN)

    eyes = {"camera": found.camera} if isinstance(found, _FileOfOne) else {"left": found.left, "right": found.right}
    for name, eye in eyes.items():
        expected = len(DISTORTION_NAMES[found.model])
        if len(eye.distortion) != expected:
            raise wrong(f"{len(eye.distortion)} coefficients, {found.model} has {expected}", name, "distortion")
        for at, size in zip(eye.principal_point_px, found.image_size_px, strict=True):
            if not 0 <= at <= size:
                raise wrong(f"{at:g} is outside an image of {found.image_size_px}", name, "principal_point_px")
    if isinstance(found, _File) and not float(np.linalg.norm(found.right_from_left.translation_m)) >= 1e-3:
        raise wrong("the eyes are in one place", "right_from_left", "translation_m")
    uncertainty = found.uncertainty
    names = parameter_names(found.model)
    if isinstance(found, _FileOfOne):
        names = tuple(name for name in names if name.startswith("left."))
    if uncertainty.names != names:
        raise wrong(f"not the parameters of a {found.model} rig", "uncertainty", "names")
    if len(uncertainty.sigma) != len(names):
        raise wrong(f"{len(uncertainty.sigma)} numbers, not {len(names)}", "uncertainty", "sigma")
    try:
        covariance = _covariance(uncertainty)
    except ValueError as error:
        raise wrong(str(error), "uncertainty", "correlation") from error
    lenses = [Lens(found.model, e.focal_px, e.principal_point_px, e.distortion) for e in eyes.values()]
    made = CalibrationProvenance(**msgspec.structs.asdict(found.made))
    if isinstance(found, _FileOfOne):
        return OneEyeRig(lenses[0], found.image_size_px, (found.camera.serial,), covariance, made)
    left, right = lenses
    return StereoRig(
        left,
        right,
        np.array(found.right_from_left.rotation_rad),
        np.array(found.right_from_left.translation_m),
        found.image_size_px,
        (found.left.serial, found.right.serial),
        covariance,
        made,
    )


def _covariance(uncertainty: _Uncertainty) -> FloatArray:
    """Return the covariance from sigmas and correlation; raise ValueError if they are invalid."""
    n = len(uncertainty.sigma)
    if len(uncertainty.correlation) != n or any(len(row) != n for row in uncertainty.correlation):
        raise ValueError(f"not {n} rows of {n} numbers")
    correlation, rounding = np.array(uncertainty.correlation), 1e-6
    if np.abs(correlation - correlation.T).max() > rounding or np.abs(np.diag(correlation) - 1.0).max() > rounding:
        raise ValueError("not symmetric with 1 on its diagonal")
    if np.linalg.eigvalsh(correlation)[0] < -rounding * n:
        raise ValueError("not positive")
    sigma = np.array(uncertainty.sigma)
    return correlation * np.outer(sigma, sigma)
