"""Measure the tags' poses on a cluster by one least-squares fit to images that show several tags at once."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import FloatArray
from bodyschema.vision.least_squares import damped_step, minimised
from bodyschema.vision.pose import fitted_motion, projection_jacobian, turn_jacobian, whitening
from bodyschema.vision.rig.stereo_rig import CalibrationError
from bodyschema.vision.tags.body import TAG_CORNERS
from bodyschema.vision.tags.config import PlacedTag
from bodyschema.vision.tags.image import TagImage
from bodyschema.vision.triangulate import triangulate

from .shapes import rpy_of


class _Settings:
    # A tag in a view whose corners are this many sigmas off (RMS) is none: covered, bent, or another of its number.
    max_off_sigmas = 6.0
    max_usual = 5.0  # ... in units of what is usual, which calibrated cameras bring to so much at most
    # Largest share of all views, and of the views of one tag, with outliers; a single one is always allowed.
    max_left_out = 0.34
    min_views = 3  # for a rigid cluster


Motion = tuple[FloatArray, FloatArray]  # rotation (3, 3) and place (3,) [m]


@dataclass(frozen=True)
class ClusterView:
    """The tags that each eye sees in one pair of rectified images, by their numbers."""

    name: str
    left: Mapping[int, TagImage]
    right: Mapping[int, TagImage]

    @property
    def ids(self) -> set[int]:
        """Numbers of all tags that are seen."""
        return self.left.keys() | self.right.keys()


@dataclass(frozen=True)
class MeasuredTag:
    """A tag's pose on the cluster, in the frame of the first tag."""

    placed: PlacedTag  # its pose
    # xyz_sigma_m, turn_sigma_rad: 1-sigma of its position along the axes and its rotation about them, each (3,)
    xyz_sigma_m: FloatArray
    turn_sigma_rad: FloatArray
    views: int  # number of views that show it


@dataclass(frozen=True)
class MeasuredCluster:
    """A measured cluster."""

    tags: tuple[MeasuredTag, ...]  # in the order of their numbers, the first one at the origin
    views: int  # number of image pairs used
    misfit: float  # RMS of the residuals, in units of the corners' own sigmas
    left_out: tuple[tuple[str, int], ...]  # names of views, and numbers of the tags in them that did not fit
    unused: tuple[str, ...]  # names of views that do not show two tags to both eyes
    # grown, grown_sigma: relative excess of the printed squares' size over the given one, and its 1-sigma
    grown: float
    grown_sigma: float


def measure_cluster(
    views: Sequence[ClusterView],
    calibration: StereoCalibration,
    side_m: float,
    other_sides_m: Mapping[int, float] | None = None,
) -> MeasuredCluster:
    """Measure the tags' poses on the cluster from rectified views.

    Args:
        side_m: side of the black squares [m].
        other_sides_m: different sides [m], by tag number.

    Raises:
        CalibrationError: too few views show two or more tags, some tags were never seen together with the others, or
            the tags do not fit one rigid body.
    """
    usable = _usable(views)
    if len(usable) < _Settings.min_views:
        raise CalibrationError(
            f"{len(usable)} of {len(views)} pairs of images show two tags or more to both eyes, at least "
            f"{_Settings.min_views} are needed, 20 are good. Turn the cluster slowly, all its edges towards the "
            "cameras"
        )
    all_usable, left_out = usable, list[tuple[str, int]]()
    while True:
        problem = _Problem(usable, calibration, side_m, other_sides_m or {})
        worst = problem.worst()
        if worst is None:
            used = {view.name for view in usable}
            return problem.result(left_out, [view.name for view in views if view.name not in used])
        left_out.append(worst)
        usable = _usable([_without(view, worst) for view in usable])
        if len(usable) < _Settings.min_views or _has_too_many_outliers(left_out, all_usable):
            bad_tag = _bad_tag(all_usable, calibration, side_m, other_sides_m)
            raise CalibrationError(_not_rigid_message(left_out, bad_tag))


def _usable(views: Sequence[ClusterView]) -> list[ClusterView]:
    return [view for view in views if len(view.ids) >= 2 and view.left.keys() & view.right.keys()]


def _bad_tag(
    views: Sequence[ClusterView],
    calibration: StereoCalibration,
    side_m: float,
    other_sides_m: Mapping[int, float] | None,
) -> int | None:
    """Return the tag without which all the others fit, or None."""
    fits: dict[int, float] = {}
    for id in sorted(set[int]().union(*(view.ids for view in views))):
        rest = _usable([_only(view, lambda other, id=id: other != id) for view in views])
        if len(rest) < _Settings.min_views:
            continue
        with suppress(CalibrationError):
            problem = _Problem(rest, calibration, side_m, other_sides_m or {})
            if problem.worst() is None:
                fits[id] = problem.residual_rms
    best = min(fits, key=lambda id: fits[id], default=None)
    return best if best is not None and fits[best] < _Settings.max_usual else None


def _has_too_many_outliers(left_out: Sequence[tuple[str, int]], views: Sequence[ClusterView]) -> bool:
    """Return True if too many views, or too many views of one tag, have outliers for this to be chance."""
    shown, times = Counter(id for view in views for id in view.ids), Counter(id for _, id in left_out)
    if len({name for name, _ in left_out}) > max(1.0, _Settings.max_left_out * len(views)):
        return True
    return any(count > max(1.0, _Settings.max_left_out * shown[id]) for id, count in times.items())


def _not_rigid_message(left_out: Sequence[tuple[str, int]], tag: int | None) -> str:
    """Return the error message for tags whose positions differ from view to view."""
    if tag is not None:
        return (
            f"the tags do not fit one rigid body, and without tag {tag} all others do. Is its number there twice, does "
            "it hang loose, and is its side right (--side-mm, --other-sides-mm)? Else leave it out: --ids"
        )
    first = ", ".join(f"tag {id} in {name}" for name, id in left_out[:4])
    return (
        f"the tags do not fit one rigid body: their places differ from view to view, first {first}. Is the cluster "
        "stiff, are the sides right (--side-mm, --other-sides-mm), and is no number there twice?"
    )


def _without(view: ClusterView, worst: tuple[str, int]) -> ClusterView:
    return _only(view, lambda id: id != worst[1]) if view.name == worst[0] else view


def _only(view: ClusterView, is_kept: Callable[[int], bool]) -> ClusterView:
    left, right = ({id: tag for id, tag in eye.items() if is_kept(id)} for eye in (view.left, view.right))
    return ClusterView(view.name, left, right)


@dataclass(frozen=True)
class _Block:
    """Measurements of one eye in one view."""

    view: int  # number of the view
    eye: FloatArray  # position (3,) of the eye in the left eye's frame [m]
    ids: tuple[int, ...]
    pixels: FloatArray
    root: FloatArray  # matrix that whitens the residuals


@dataclass(frozen=True)
class _Linearised:
    """Residuals in sigmas at poses of tags and bodies, with derivatives by all rotations, positions and the size."""

    tags: Mapping[int, Motion]
    bodies: Sequence[Motion]
    residuals: FloatArray
    J: FloatArray
    by_size: FloatArray

    @property
    def squares(self) -> float:
        return float(self.residuals @ self.residuals)

    @property
    def residual_rms(self) -> float:
        """RMS of the residuals, in units of the corners' own sigmas."""
        return float(np.sqrt(self.squares / max(len(self.residuals) - self.J.shape[1], 1)))


class _Problem:
    """Least-squares problem of all poses: the cluster's in the views and the tags' on it, in the first tag's frame."""

    def __init__(
        self,
        views: Sequence[ClusterView],
        calibration: StereoCalibration,
        side_m: float,
        other_sides_m: Mapping[int, float],
    ) -> None:
        self._views, self._calibration, self._other_sides_m = list(views), calibration, other_sides_m
        self.ids = sorted(set[int]().union(*(view.ids for view in views)))
        self._corners = {id: other_sides_m.get(id, side_m) * TAG_CORNERS for id in self.ids}
        self._blocks = [
            self._block(k, tags, calibration.baseline_m * right)
            for k, view in enumerate(views)
            for right, tags in enumerate((view.left, view.right))
            if tags
        ]
        located = [self._located(view) for view in views]
        tags = self._initial_tag_poses(
            [{id: fitted_motion(self._corners[id], seen) for id, seen in each.items()} for each in located]
        )
        self._found = minimised(
            self._linearised(tags, [self._initial_body_pose(tags, each) for each in located]), self._stepped
        )

    def _block(self, view: int, tags: Mapping[int, TagImage], x: float) -> _Block:
        ids = tuple(sorted(tags))
        pixels = np.concatenate([tags[id].corners_px for id in ids])
        own = np.asarray(block_diag(*(tags[id].cov_px for id in ids)))
        return _Block(view, np.array([x, 0.0, 0.0]), ids, pixels, whitening(own, self._calibration.pixel_sigma))

    # --- where it begins

    def _located(self, view: ClusterView) -> dict[int, FloatArray]:
        """Triangulate the corners (4, 3) [m] of each tag that both eyes see."""
        found: dict[int, FloatArray] = {}
        for id in sorted(view.left.keys() & view.right.keys()):
            px = np.hstack([view.left[id].corners_px, view.right[id].corners_px])
            corners = [triangulate(self._calibration, each, np.ones(4)) for each in px]
            whole = [each[0] for each in corners if each is not None]
            if len(whole) == len(px):
                found[id] = np.array(whole)
        return found

    def _initial_tag_poses(self, tag_poses: Sequence[Mapping[int, Motion]]) -> dict[int, Motion]:
        """Return initial tag poses in the first tag's frame, from tag to tag through views that show both."""
        known: dict[int, Motion] = {self.ids[0]: (np.eye(3), np.zeros(3))}
        while len(known) < len(self.ids):
            # The tag that most views show together with one of known pose.
            counts = {
                (a, b): sum(a in poses and b in poses for poses in tag_poses)
                for a in known
                for b in self.ids
                if b not in known
            }
            a, b = max(counts, key=lambda pair: counts[pair])
            if not counts[a, b]:
                lost = ", ".join(str(id) for id in self.ids if id not in known)
                raise CalibrationError(
                    f"no pair of images shows tags {lost} to both eyes together with tags "
                    f"{', '.join(map(str, sorted(known)))}. Take images across those edges"
                )
            between = [_compose(_inverse(poses[a]), poses[b]) for poses in tag_poses if a in poses and b in poses]
            known[b] = _compose(known[a], _median_motion(between))
        return known

    def _initial_body_pose(self, tags: Mapping[int, Motion], located: Mapping[int, FloatArray]) -> Motion:
        if not located:
            raise CalibrationError("a view in which no tag's corners can be located by both eyes")
        body = [self._corners[id] @ tags[id][0].T + tags[id][1] for id in located]
        return fitted_motion(np.concatenate(body), np.concatenate(list(located.values())))

    # --- the joint problem

    @property
    def _columns(self) -> dict[int, int]:
        """First column of each tag that is not the first."""
        return {id: 6 * k for k, id in enumerate(self.ids[1:])}

    def _stepped(self, now: _Linearised, damping: float) -> _Linearised:
        def moved(motion: Motion, by: FloatArray) -> Motion:
            return Rotation.from_rotvec(by[:3]).as_matrix() @ motion[0], motion[1] + by[3:]

        step = damped_step(now.J, now.residuals, damping)
        columns = self._columns
        tags = {id: moved(m, step[columns[id] : columns[id] + 6]) if id in columns else m for id, m in now.tags.items()}
        first = 6 * len(columns)
        return self._linearised(
            tags, [moved(m, step[first + 6 * k : first + 6 * k + 6]) for k, m in enumerate(now.bodies)]
        )

    def _linearised(self, tags: Mapping[int, Motion], bodies: Sequence[Motion]) -> _Linearised:
        columns, first = self._columns, 6 * (len(self.ids) - 1)
        width = first + 6 * len(self._views)
        residuals: list[FloatArray] = []
        slopes: list[FloatArray] = []
        growths: list[FloatArray] = []
        for block in self._blocks:
            turn, x = bodies[block.view]
            J = np.zeros((len(block.pixels), 2, width))
            seen = np.zeros_like(block.pixels)
            by_size = np.zeros((len(block.pixels), 2))
            for k, id in enumerate(block.ids):
                rows = slice(4 * k, 4 * k + 4)
                on_tag = self._corners[id] @ tags[id][0].T
                arms = (on_tag + tags[id][1]) @ turn.T
                points = arms + x - block.eye
                slope = projection_jacobian(self._calibration.focal_px, points)
                seen[rows] = self._calibration.focal_px * points[:, :2] / points[:, 2:]
                body = first + 6 * block.view
                J[rows, :, body : body + 3], J[rows, :, body + 3 : body + 6] = slope @ turn_jacobian(arms), slope
                if id in columns:
                    J[rows, :, columns[id] : columns[id] + 3] = slope @ turn @ turn_jacobian(on_tag)
                    J[rows, :, columns[id] + 3 : columns[id] + 6] = slope @ turn
                by_size[rows] = (slope @ (on_tag @ turn.T)[..., None])[..., 0]
            residual = block.pixels - seen - np.array(self._calibration.principal_point_px)
            residuals.append(block.root @ residual.ravel())
            slopes.append(block.root @ J.reshape(-1, width))
            growths.append(block.root @ by_size.ravel())
        together = (np.concatenate(each) for each in (residuals, slopes, growths))
        return _Linearised(tags, bodies, *together)

    # --- what comes out

    @property
    def residual_rms(self) -> float:
        """RMS of the residuals, in units of the corners' own sigmas."""
        return self._found.residual_rms

    def worst(self) -> tuple[str, int] | None:
        """Return the view's name and the tag's number of the worst outlier, or None.

        Squares that are all larger or smaller than stated are not outliers: their common size is free here.
        """
        residuals, J, by_size = self._found.residuals, self._found.J, self._found.by_size
        full = np.column_stack([J, by_size])
        residuals = residuals - full @ np.linalg.solve(full.T @ full, full.T @ residuals)
        squares: dict[tuple[str, int], list[FloatArray]] = {}
        place = 0
        for block in self._blocks:
            for id in block.ids:
                squares.setdefault((self._views[block.view].name, id), []).append(residuals[place : place + 8] ** 2)
                place += 8
        rms = {key: float(np.sqrt(np.mean(np.concatenate(each)))) for key, each in squares.items()}
        key = max(rms, key=lambda each: rms[each])
        usual = float(np.median(list(rms.values())))
        return key if rms[key] > _Settings.max_off_sigmas * min(max(usual, 1.0), _Settings.max_usual) else None

    def result(self, left_out: Sequence[tuple[str, int]], unused: Sequence[str]) -> MeasuredCluster:
        """Return the solution with its uncertainty, scaled up if the residuals exceed the assumed noise."""
        residuals, J, by_size = self._found.residuals, self._found.J, self._found.by_size
        residual_rms = self.residual_rms**2
        cov = np.linalg.inv(J.T @ J) * max(residual_rms, 1.0)
        full = np.column_stack([J, by_size])
        inverse = np.linalg.inv(full.T @ full)
        columns, tags = self._columns, []
        for id in self.ids:
            rotation, xyz = self._found.tags[id]
            sigma = np.sqrt(np.diag(cov)[columns[id] : columns[id] + 6]) if id in columns else np.zeros(6)
            place = float(xyz[0]), float(xyz[1]), float(xyz[2])
            placed = PlacedTag(id=id, xyz=place, rpy=rpy_of(rotation), side_m=self._other_sides_m.get(id))
            tags.append(MeasuredTag(placed, sigma[3:], sigma[:3], sum(id in view.ids for view in self._views)))
        size = float((inverse @ full.T @ residuals)[-1]), float(np.sqrt(inverse[-1, -1] * max(residual_rms, 1.0)))
        views, rest = len(self._views), (tuple(left_out), tuple(unused))
        return MeasuredCluster(tuple(tags), views, float(np.sqrt(residual_rms)), *rest, *size)


def _compose(outer: Motion, inner: Motion) -> Motion:
    return outer[0] @ inner[0], outer[0] @ inner[1] + outer[1]


def _inverse(motion: Motion) -> Motion:
    return motion[0].T, -motion[0].T @ motion[1]


def _median_motion(motions: Sequence[Motion]) -> Motion:
    """Return the motion whose rotation has the smallest median angle to the others."""
    turns = [Rotation.from_matrix(rotation) for rotation, _ in motions]
    median_angles = [np.median([(turn * other.inv()).magnitude() for other in turns]) for turn in turns]
    return motions[int(np.argmin(median_angles))]
