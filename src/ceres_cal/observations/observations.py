"""Observations: what the frames show, as columns, with their targets, cameras, views and priors.

The row of an observation in `points` or `curves` is its permanent id: nothing here reorders or drops rows.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from operator import attrgetter
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from ceres_cal.base import Indices, Indices32, InputError, Mask, cached_property, checked, field, naming, replace
from ceres_cal.base.words import no_such, plural
from ceres_cal.observations.columns import (
    Columns,
    Curves,
    Prior,
    View,
    each_block,
    in_blocks,
    joined,
    taken,
    view_label,
)
from ceres_cal.observations.files import Content, header_of, read_content, write_content
from ceres_cal.observations.validation import Copies, find_copies, odd_sizes, require_alike, require_names, stray_pixels
from ceres_cal.scene.targets import Target

_NAMES = attrgetter("camera", "station", "target", "placement")


def _with_target(view: View) -> str:
    return f"{view.camera}/{view.target}"


class Observations(Content):
    """All observations of a calibration.

    Attributes:
        targets: by name.
        cameras: name -> (width, height) px.
        views: which frame shows which target.
        points: point observations, in the order of their views and in pixels with (0, 0) at the centre of the top-left
            pixel. `sigma_px` is the standard deviation of each coordinate, 1 where none was stated (only ratios matter
            then: the solve estimates the scale).
        curves: curve observations, in the order of their views; `sigma_px` is that of the distance to the curve.
        priors: prior knowledge. notes: plain data that a user keeps with the observations.
        noise: name of `noise_names` -> factor on the stated sigmas that `sigma_px` contains already, as a calibration
            estimated it; in no file.

    Raises:
        InputError: on construction, naming the view and the feature: an unknown name, a number that is not finite, a
            camera without any observation.
    """

    noise: Mapping[str, float] = field(default_factory=dict)

    def __repr__(self) -> str:
        points, curves = plural(len(self.points), "point"), plural(len(self.curves), "curve observation")
        stations = ", ".join(self.stations) or "nothing"
        return f"Observations({points}, {curves} in {plural(len(self.views), 'view')} of {stations})"

    def __post_init__(self) -> None:
        self._check_names()
        for kind, column in (("point", self.points), ("curve", self.curves)):
            count = len(column.view)
            if column.pixels.shape != (count, 2) or any(len(array) != count for array in vars(column).values()):
                raise InputError(f"the columns of the {kind} observations differ in length: write them again")
            targets = {
                name: target.points if kind == "point" else target.curves for name, target in self.targets.items()
            }
            known = np.array([len(targets[view.target]) for view in self.views])
            each_block(partial(self._check_columns, kind, known), column)
        shown = np.flatnonzero(np.diff(self.ends[0]) + np.diff(self.ends[1]))
        seen = {self.views[i].camera for i in shown.tolist()}
        for name in self.cameras:
            if name not in seen:
                raise InputError(f"camera {name!r} has no observation: add views of it or remove the camera")
        for prior in self.priors:
            self.require_owner(prior)

    def __add__(self, other: Observations) -> Observations:
        """Combine two sets, as from several files: `field + board`."""
        if not isinstance(other, Observations):
            return NotImplemented
        if twice := next((v for v in self.views if v.placement is not None and v in other.views), None):
            raise InputError(
                f"both show target {twice.target!r} in frame {twice.frame!r} of camera {twice.camera!r}: give the "
                "frames different names, such as by a dict of pixels"
            )
        return combine([self, other])

    # ---- from arrays, as detectors give them ---------------------------------------------------------------------

    @classmethod
    @checked
    def from_points(
        cls,
        pixels: ArrayLike | Sequence[ArrayLike | None] | Mapping[str, ArrayLike | None],
        points: Target | ArrayLike,
        image_size: tuple[int, int],
        *,
        camera: str = "camera",
        sigma_px: float = 1.0,
        moves: bool | None = None,
    ) -> Observations:
        """Make observations of points of one target by one camera, in one frame or in many.

        Args:
            pixels: (N, 2) or OpenCV's (N, 1, 2) of one frame, a list of those, or a dict by name of the frame; one row
                for each point, NaN where it was not seen. None, OpenCV's answer where it found no board, is a frame in
                which no point was seen.
            points: a target, such as `checkerboard(9, 6, 0.025)` with corners row by row, or places (N, 3) or (N, 2) m.
            image_size: (width, height) px. sigma_px: standard deviation of each coordinate.
            moves: whether the target was elsewhere in every frame; by default as the target states. Places do not move:
                they are in the world.

        Raises:
            InputError: shapes or counts that do not fit; naming the frame.
        """
        from ceres_cal.observations.from_points import points_by_frame

        return cls(**vars(points_by_frame(pixels, points, image_size, camera, sigma_px, moves)))

    @classmethod
    @checked
    def from_curves(
        cls,
        pixels: Mapping[str, ArrayLike],
        target: Target,
        image_size: tuple[int, int],
        *,
        camera: str = "camera",
        frame: str = "0",
        sigma_px: float = 1.0,
        side: str = "centre",
    ) -> Observations:
        """Make observations of painted lines and arcs of one target in one frame of one camera.

        Args:
            pixels: name of each line -> pixels (N, 2) anywhere along it, such as `{"HalfwayLine": [[640.1, 92.4],
                [641.0, 180.2]]}`.
            image_size: (width, height) px. sigma_px: standard deviation of the distance to the line.
            side: "centre" of the paint, or its "left" or "right" edge, as seen along the line.

        Raises:
            InputError: a line that the target does not have, or a shape that does not fit; naming the line.
        """
        from ceres_cal.observations.from_points import pixels_by_curve

        return cls(**vars(pixels_by_curve(pixels, target, image_size, camera, frame, sigma_px, side)))

    # ---- files --------------------------------------------------------------------------------------------------

    @classmethod
    def load(cls, path: str | Path) -> Observations:
        """Read `.json`, `.npz`, or a folder `.columns`, whose columns stay in their files (docs/files.md).

        Raises:
            InputError: one line that names the file, the view and the feature; also for pixels outside their images.
        """
        with naming(path):
            observations = cls(**vars(read_content(Path(path))))
            observations.require_inside()
            return observations

    def save(self, path: str | Path) -> None:
        """Write `.json`, for large sets `.npz`, beyond memory a folder `.columns`; every number is preserved."""
        write_content(self, Path(path))

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the content, the same for the JSON and the NPZ file, by which calibrations refer to it."""
        header = msgspec.structs.replace(header_of(self), notes=msgspec.UNSET)
        content = hashlib.sha256(msgspec.json.encode(header))
        for column in (self.points, self.curves):
            for name in vars(column):  # one whole column before the next
                for _, block in in_blocks(getattr(column, name)):
                    content.update(np.ascontiguousarray(block).data)
        return content.hexdigest()

    @cached_property
    def ends(self) -> tuple[Indices, Indices]:
        """(V + 1,) row at which the points of each view begin, and row at which its curve observations begin."""
        counts = np.zeros((2, len(self.views)), dtype=np.int64)
        for own, column in zip(counts, (self.points, self.curves), strict=True):
            for first, some in each_block(_counted, column.view):
                own[first : first + len(some)] += some
        ends = np.pad(np.cumsum(counts, axis=1), ((0, 0), (1, 0)))
        return ends[0], ends[1]

    # ---- reading ------------------------------------------------------------------------------------------------

    @cached_property
    def copies(self) -> Copies:
        """Which observations repeat others, to the last bit or, of a board held still, far within the noise."""
        return find_copies(self.views, self.points, self.curves)

    @cached_property
    def warnings(self) -> tuple[str, ...]:
        """One line for each thing that may be wrong with the observations: strays outside an image, odd sizes."""
        return (*self.require_inside(), *odd_sizes(self))

    @cached_property
    def remarks(self) -> tuple[str, ...]:
        """One line for each thing done with the observations: which are copies, so that they count once."""
        return tuple(self.copies.words(self.views, (self.points, self.curves)))

    @cached_property
    def shown_views(self) -> tuple[View, ...]:
        """The views with observations that are no copies; names in other views do not exist for the solve."""
        points, curves = self.copies.originals
        shown = np.zeros(len(self.views), dtype=bool)
        shown[self.points.view[points]] = shown[self.curves.view[curves]] = True
        return tuple(self.views[number] for number in np.flatnonzero(shown))

    @property
    def stations(self) -> dict[str, str]:
        """Name of the camera of each station, in order of appearance."""
        return {view.station: view.camera for view in self.views}

    @property
    def placements(self) -> tuple[str, ...]:
        """Names of the placements, in order of appearance."""
        return tuple(dict.fromkeys(view.placement for view in self.views if view.placement is not None))

    @property
    def counts(self) -> dict[str, int]:
        """Numbers of views, cameras, stations, placements, points and curve observations."""
        names = ("views", "cameras", "stations", "placements", "points", "curves")
        return {name: len(getattr(self, name)) for name in names}

    # ---- parts --------------------------------------------------------------------------------------------------

    @property
    def originals(self) -> Observations:
        """The observations that are no copies of others."""
        return self.part(*self.copies.originals) if self.copies.are_there else self

    def part(self, points: Mask | Indices, curves: Mask | Indices) -> Observations:
        """Return the same views with some of the observations, given by number or by a mask."""
        part = replace(self, points=taken(self.points, points), curves=taken(self.curves, curves))
        if "copies" in vars(self):  # a part of a view need not look like a copy
            vars(part)["copies"] = Copies(self.copies.points[points], self.copies.curves[curves])
        return part

    def with_features(self, points: Indices32, curves: Indices32) -> Observations:
        """Return the same pixels under other names: (N,) and (M,) numbers of features."""
        return replace(self, points=replace(self.points, feature=points), curves=replace(self.curves, feature=curves))

    def with_targets(self, targets: Mapping[str, Target]) -> Observations:
        """Return the same observations of targets with another drawing; the digest is kept."""
        each = [(target, targets[name]) for name, target in self.targets.items()]
        if all(one == other and one.movable == other.movable for one, other in each):
            return self
        drawn = replace(self, targets=dict(targets))
        vars(drawn).update(digest=self.digest, copies=self.copies)
        return drawn

    @property
    def noise_names(self) -> tuple[str, ...]:
        """(V,) names of the noise of each view: its camera, or "camera/target" if the camera sees several targets,
        which may be clicked and detected, or has "/" in its own name, so that no two have one name.
        """
        seen = {(view.camera, view.target) for view in self.views}
        several = {name for name, count in Counter(camera for camera, _ in seen).items() if count > 1 or "/" in name}
        return tuple(_with_target(view) if view.camera in several else view.camera for view in self.views)

    def at_noise(self, noise: Mapping[str, float]) -> Observations:
        """Return the same observations with sigmas scaled by `noise` alone; the digest is kept."""
        if noise == self.noise:
            return self
        after, before = (
            np.array([one.get(_with_target(view), one.get(view.camera, 1.0)) for view in self.views])
            for one in (noise, self.noise)
        )
        factors = after / before
        points, curves = (replace(c, sigma_px=c.sigma_px * factors[c.view]) for c in (self.points, self.curves))
        rated = replace(self, points=points, curves=curves, noise=dict(noise))
        vars(rated).update(digest=self.digest, copies=self.copies)
        return rated

    def of_station(self, name: str) -> Observations:
        """Return one station's views with all their observations, without priors."""
        return self._of_views([view.station == name for view in self.views])

    def of_camera(self, name: str) -> Observations:
        """Return the views of one camera, with the priors on what they show."""
        return self if [*self.cameras] == [name] else self._about([view.camera == name for view in self.views])

    def without_camera(self, name: str) -> Observations:
        """Return the views of the other cameras, with the priors on what they show."""
        return self._about([view.camera != name for view in self.views])

    def about_shown(self, priors: Sequence[Prior]) -> tuple[Prior, ...]:
        """Return those priors that are on what the views show."""
        owners = {*self.cameras, *self.stations, *self.placements, *self.targets}
        return tuple(prior for prior in priors if prior.name in owners)

    def _about(self, which: Sequence[bool]) -> Observations:
        some = self._of_views(which)
        return replace(some, priors=some.about_shown(self.priors))

    def _of_views(self, which: Sequence[bool]) -> Observations:
        chosen = np.array(which)
        order, views = np.cumsum(chosen, dtype=np.int32) - 1, tuple(np.array(self.views, object)[chosen])
        points, curves = taken(self.points, chosen[self.points.view]), taken(self.curves, chosen[self.curves.view])
        return Observations(
            self.targets,
            {view.camera: self.cameras[view.camera] for view in views},
            views,
            replace(points, view=order[points.view]),
            replace(curves, view=order[curves.view]),
            noise=self.noise,
        )

    # ---- checks -------------------------------------------------------------------------------------------------

    def _check_names(self) -> None:
        for name, size in self.cameras.items():
            if len(size) != 2 or min(size) < 1:
                raise InputError(f"camera {name!r}: image_size must be two positive whole numbers, not {size}")
        owner: dict[str, str] = {}
        placed: dict[str, str] = {}
        for number, (camera, station, target, placement) in enumerate(map(_NAMES, self.views)):
            wrong = ""
            if camera not in self.cameras:
                wrong = no_such("camera", camera, self.cameras)
            elif target not in self.targets:
                wrong = no_such("target", target, self.targets)
            elif (own := owner.setdefault(station, camera)) != camera:
                wrong = f"station {station!r} belongs to camera {own!r} already"
            elif placement is not None and (held := placed.setdefault(placement, target)) != target:
                own_place = "give each rigid thing a placement of its own"
                wrong = f"placement {placement!r} holds target {held!r} already; {own_place}"
            if wrong:
                raise InputError(f"{view_label(number, self.views)}: {wrong}")
        names = {"camera": self.cameras, "target": self.targets, "station": owner, "placement": placed}
        require_names({**names, "frame": {view.frame: None for view in self.views}})

    def _check_columns(self, kind: str, known: Indices, first: int, column: Columns) -> None:
        """Check a block that begins with row `first`; known: number of features of each view's target."""
        if not len(column):
            return
        if column.view.min() < 0 or column.view.max() >= len(self.views):
            wrong = (column.view < 0) | (column.view >= len(self.views))
            raise InputError(
                f"a {kind} observation names view {column.view[np.argmax(wrong)]}, but there are {len(self.views)}"
            )
        whole: Columns = self.points if kind == "point" else self.curves
        if (first and whole.view[first - 1] > column.view[0]) or np.any(column.view[1:] < column.view[:-1]):
            raise InputError(f"the {kind} observations are not in the order of their views: sort the columns by view")
        if np.any(wrong := (column.feature < 0) | (column.feature >= known[column.view])):
            row = int(np.argmax(wrong))
            here, target = view_label(column.view[row], self.views), self.views[column.view[row]].target
            raise InputError(
                f"{here}: {kind} feature number {column.feature[row]} is unknown in target {target!r}, "
                f"which has {known[column.view[row]]}"
            )
        self._check_numbers(kind, column, first)

    def _check_numbers(self, kind: str, column: Columns, first: int) -> None:
        sigma, side = column.sigma_px, column.side if isinstance(column, Curves) else np.zeros(1, np.int8)
        for what, good in (
            ("its pixel is not finite", np.isfinite(column.pixels)),
            ("its sigma_px must be positive and finite, 1e-12 to 1e12", (sigma >= 1e-12) & (sigma <= 1e12)),
            ("its side must be 0, 1 or -1", (side >= -1) & (side <= 1)),
        ):
            if not good.all():
                row = int(np.argmin(good)) // (good.size // len(good))
                here = view_label(column.view[row], self.views)
                raise InputError(
                    f"{here}, {kind} {self.feature_name(kind, first + row)!r}: {what}: correct or remove it"
                )

    def require_inside(self) -> tuple[str, ...]:
        """Return one line for each camera of which a few observations lie outside its image.

        Raises:
            InputError: many lie outside, or one far outside, naming the likely cause, and view, feature and pixel of
                the first; or a sigma differs so much from the others that one observation would decide alone.
        """
        return self._strays

    @cached_property
    def _strays(self) -> tuple[str, ...]:
        require_alike(self)
        return stray_pixels(self)

    def require_owner(self, prior: Prior) -> None:
        """Raise InputError where a prior names a camera, station, target or curve that does not exist."""
        every: dict[str, Iterable[str]] = {"camera": self.cameras, "station": self.stations, "target": self.targets}
        names = every[prior.owner]
        if prior.name not in names:
            raise InputError(f"a prior: {no_such(prior.owner, prior.name, names)}")
        if prior.curve and prior.curve not in self.targets[prior.name].curves:
            raise InputError(f"a prior: {no_such('curve', prior.curve, self.targets[prior.name].curves)}")


def _counted(_: int, views: Indices32) -> tuple[int, Indices]:
    """Return the first view of a block sorted by view, and the number of rows of it and of each later view."""
    first = int(views[0]) if len(views) else 0
    return first, np.bincount(views - first)


def combine(parts: Sequence[Observations]) -> Observations:
    """Combine several sets into one: views one after the other, targets, cameras and priors merged.

    Raises:
        InputError: a target or camera means different things in two sets.
    """
    if len(parts) == 1:
        return parts[0]
    targets: dict[str, Target] = {}
    cameras: dict[str, tuple[int, int]] = {}
    for part in parts:
        for name, target in part.targets.items():
            if targets.setdefault(name, target) != target:
                raise InputError(f"target {name!r} is described in two ways: give one of them another name")
        for name, size in part.cameras.items():
            if cameras.setdefault(name, size) != size:
                raise InputError(f"camera {name!r} has image sizes {cameras[name]} and {size}: these are two cameras")
    starts = np.cumsum([0, *(len(part.views) for part in parts)], dtype=np.int32)
    each = list(zip(parts, starts[:-1], strict=True))
    return Observations(
        targets,
        cameras,
        tuple(view for part in parts for view in part.views),
        joined([replace(part.points, view=part.points.view + start) for part, start in each]),
        joined([replace(part.curves, view=part.curves.view + start) for part, start in each]),
        tuple(dict.fromkeys(prior for part in parts for prior in part.priors)),
    )
