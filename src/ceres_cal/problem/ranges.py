"""What a stated number can be: the range of each kind of number, asked once of all that is stated before a solve.

A range is wide: what lies beyond is impossible, not unusual. Whatever lies within is judged by the observations
(`robust/conflicts.py`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import InputError
from ceres_cal.base.frozen import Frozen
from ceres_cal.observations import Observations, Prior
from ceres_cal.problem.parameters import Options
from ceres_cal.problem.structure import Tolerance, dimensions_of
from ceres_cal.scene.lens import Lens

PHI_RANGE = (0.15, 15.0)
"""In half image diagonals: 163 to 8 degrees across the image's diagonal. What lies beyond is no lens over a field."""
_REDRAWN = 20.0  # times a dimension as drawn, or the inverse: beyond it another target was drawn
# Of the longest side of the target's bounding box. Paper that is held by hand bends by a fiftieth.
_BUILT = 0.05
_FINEST = 1e-6
"""m and px: a standard deviation below a micrometre, or a millionth of a pixel, was measured by nobody. A hundredth of
it is solved for without loss; at a ten-thousandth the solve no longer converges."""


class Range(Frozen, eq=True):
    """What a number of one kind can be.

    Attributes:
        least, most: in its unit. unit: "m", "px" or "". finest: the least standard deviation. why: what bounds it.
    """

    least: float
    most: float
    unit: str
    finest: float
    why: str

    def holds(self, value: float) -> bool:
        """Whether a number can be such a number."""
        return self.least <= value <= self.most

    def require(self, value: float, what: str) -> None:
        """Raise InputError where a number cannot be such a number."""
        if self.holds(value):
            return
        bound = f"at most {self.most:.3g}" if value > self.most else f"at least {self.least:.3g}"
        unit = f" {self.unit}" if self.unit else ""
        raise InputError(f"{what} is {value:g}{unit}, but it is {bound}{unit}: {self.why}{self._in_mm(value)}")

    def require_sigma(self, sigma: float, what: str) -> None:
        """Raise InputError where a standard deviation is finer than anything measured."""
        if sigma < self.finest:
            unit = f" {self.unit}" if self.unit else ""
            raise InputError(f"{what} has a sigma of {sigma:g}{unit}: give at least {self.finest:.3g}{unit}")

    def _in_mm(self, value: float) -> str:
        """The likely cause: a length, or a focal length, in millimetres."""
        if self.unit == "m":
            return "; is it in mm? Give metres" if self.holds(value / 1000.0) else "; give metres"
        if self.unit == "px" and value < self.least:
            return "; is it in mm? Divide it by the size of a pixel"
        return ""


def require_possible_numbers(observations: Observations, options: Options) -> None:
    """Check everything that is stated: priors of the observations and of the options, numbers that are held, and
    tolerances.

    Raises:
        InputError: a number that is impossible, or a standard deviation that nobody can have measured; naming it.
    """
    for prior in dict.fromkeys((*observations.priors, *options.priors)):
        observations.require_owner(prior)
        here = f"the prior on {prior.quantity} of {prior.owner} {prior.name!r}"
        for bounds, value, sigma in zip(_ranges(prior, observations, options), prior.value, prior.sigma, strict=False):
            bounds.require(value, here)
            bounds.require_sigma(sigma, here)
    lens = None if options.lens == "auto" else options.blank_lens
    for name, value in options.fixed.items():
        for camera, size in observations.cameras.items():
            _of_camera(name, size, lens).require(value, f"{name}, which is held for camera {camera!r},")
    for target, tolerance in options.tolerances.items():
        if target in observations.targets:
            _require_tolerance(tolerance, target, observations)


def _ranges(prior: Prior, observations: Observations, options: Options) -> Iterator[Range]:
    """The range of each of a prior's numbers."""
    if prior.owner == "camera":
        lens = None if options.lens == "auto" else options.blank_lens
        yield from camera_ranges(prior.quantity, observations.cameras[prior.name], lens)
    elif prior.owner == "station":
        yield from [_of_place(prior.name, observations)] * len(prior.value)
    elif prior.dimension:
        drawn_m = dimensions_of(observations.targets).get(prior.dimension, np.nan)
        if np.isfinite(drawn_m):  # another error names a dimension that is not there
            yield dimension_range(drawn_m)
    elif prior.curve:
        yield Range(0.0, 0.0, "m", _FINEST, "an offset is about 0")


def camera_ranges(quantity: str, image_size: tuple[int, int], lens: Lens | None) -> Iterator[Range]:
    """Of each number of a quantity that a prior on a camera may name."""
    names = ("cx", "cy") if quantity == "principal_point" else (quantity,)
    yield from (_of_camera(name, image_size, lens) for name in names)


def dimension_range(drawn_m: float) -> Range:
    """Of a dimension of a target, by how it is drawn."""
    why = f"the target is drawn with {drawn_m:g} m"
    return Range(drawn_m / _REDRAWN, drawn_m * _REDRAWN, "m", _FINEST, why)


def _of_camera(name: str, image_size: tuple[int, int], lens: Lens | None) -> Range:
    """Of a camera's number, by its name."""
    finest_ratio = 1e-9  # of numbers without a unit, which are of order one
    # In the solver's unit, in which it is of order one; the rational model's reach a few hundred.
    coefficient = 1e6
    skew = (-1.0, 1.0)  # columns that lean by 45 degrees
    aspect = (0.1, 10.0)  # anamorphic lenses and skipped rows have 0.5 to 2
    off_centre = 10.0  # image diagonals: a picture that was cropped from one ten times as large
    # In half image diagonals: from a fisheye whose image circle takes a tenth of the picture to a telescope that shows
    # one degree. Millimetres of a lens lie below it.
    phi = (0.05, 100.0)
    size = np.array(image_size, dtype=float)
    half = 0.5 * float(np.hypot(*size))
    image = f"the image is {image_size[0]} x {image_size[1]} px"
    if name == "phi":
        return Range(phi[0] * half, phi[1] * half, "px", _FINEST, f"the focal length in pixels, where {image}")
    if name in ("cx", "cy"):
        middle, reach = 0.5 * (size[int(name == "cy")] - 1.0), off_centre * 2.0 * half
        return Range(middle - reach, middle + reach, "px", _FINEST, image)
    if name == "aspect":
        return Range(*aspect, "", finest_ratio, "it is fy / fx, near 1")
    if name == "skew":
        return Range(*skew, "", finest_ratio, "it is 0 unless columns of pixels lean")
    scale = 1.0 if lens is None or name not in lens.names else lens.scales(half)[lens.names.index(name)]
    return Range(-coefficient / scale, coefficient / scale, "", finest_ratio / scale, "more bends no image")


def _of_place(station: str, observations: Observations) -> Range:
    """Of a coordinate of a station's position: from farther away no lens would show what was observed as large.

    Points at most L apart, seen from d, lie at most phi L / d apart in the image.
    """
    spread_px, places = 0.0, [np.empty((0, 3))]
    for number, view in enumerate(observations.views):
        if view.station != station or view.placement is not None:
            continue
        places.append(observations.targets[view.target].places)
        for ends, column in zip(observations.ends, (observations.points, observations.curves), strict=True):
            pixels = column.pixels[ends[number] : ends[number + 1]]
            if len(pixels):
                spread_px = max(spread_px, float(np.hypot(*(pixels.max(axis=0) - pixels.min(axis=0)))))
    seen = np.concatenate(places)
    if not len(seen) or spread_px == 0.0:  # boards alone, whose world is wherever one likes
        return Range(-np.inf, np.inf, "m", _FINEST, "")
    diagonal_px = float(np.hypot(*observations.cameras[observations.stations[station]]))
    return place_range(seen, spread_px / diagonal_px, f"{spread_px:.0f} px")


def place_range(seen: Array, spread: float, said: str) -> Range:
    """Of a coordinate of a station that sees places (P, 3) m over so much of its image's diagonal; `said` in words."""
    size_m = 2.0 * float(np.linalg.norm(seen.max(axis=0) - seen.min(axis=0)))  # of arcs half is among the places
    most_m = 0.5 * PHI_RANGE[1] * size_m / spread + float(np.max(np.linalg.norm(seen, axis=1)))
    return Range(-most_m, most_m, "m", _FINEST, f"no lens shows its target {said} large from farther away")


def _require_tolerance(tolerance: Tolerance, target: str, observations: Observations) -> None:
    sizes_m = {name: float(np.max(np.diff(one.box, axis=0))) for name, one in observations.targets.items()}
    size_m = sizes_m[target] or max(sizes_m.values()) or np.inf  # a pole's top is placed on the field
    bounds = Range(0.0, _BUILT * size_m, "m", 0.0, f"the target is {size_m:.3g} m long")
    plain: Mapping[str, float] = {name: value for name, value in vars(tolerance).items() if name != "curve_m"}
    for name, value in {**plain, **tolerance.curve_m}.items():
        bounds.require(value, f"the tolerance {name} of target {target!r}")
