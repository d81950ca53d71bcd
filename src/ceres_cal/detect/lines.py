"""Painted lines and arcs in a photograph, measured where a camera model predicts them.

Each place of a `Course` is first searched along its normal, then measured in the pixels themselves (`profiles`). A
place gives no observation if it does not look like paint of the expected width, or does not continue its neighbours.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from ceres_cal.base import Array, Array32, Indices, Indices32, Mask, Rows, median, medians, medians_known, quantile
from ceres_cal.detect.asymmetry import drawn_together
from ceres_cal.detect.blur import blur_of, from_middle, no_blur, with_coma
from ceres_cal.detect.courses import Course
from ceres_cal.detect.profiles import Profiles, Windows, cut_windows
from ceres_cal.detect.sampling import drawn_aside

HALF_WIDTH_PX = 3  # half width of a window, along the line
SPACING_PX = 2.0 * HALF_WIDTH_PX + 2.0  # neighbouring windows share no pixels
_BEYOND_PX = 4.5  # extent of a window past the paint's border; larger where the picture is blurred
_SEARCH_STEP_PX = 0.5
_TINY = 1e-9  # grey levels
_BAND_PX = 3.0  # width of the background on either side of the paint, in the search
_NARROW_PX = 1.0  # width of the background in the search where other paint may be near
# Width of the brightest part of a blurred line, in standard deviations of the blur.
_AS_WIDE = 2.5
# How far a blurred line extends past the paint's border, in standard deviations of the blur. Where this exceeds the
# usual window, the line is searched and measured again with a larger window and with smear.
_AS_FAR = 2.5
# Least ratio of contrast to noise. Of 3100 line centres, half of this value accepts two more, double 77 fewer, none of
# them wrong.
_LEAST_CLARITY = 4.0
# Least contrast, as a share of the usual one. Nothing changes from half to double.
_LEAST_CONTRAST = 0.15
# Least and largest contrast, as a share of the contrast nearby: a robot's marker is brighter than paint in shadow. Both
# limits are near 1 and cannot be halved; with 0.9 as the least a tenth of the line centres is lost.
_OF_NEARBY = 0.45, 1.7
# Largest misfit of a window, and of the windows nearby, in units of the usual one. A larger misfit means that something
# else is in the window or runs along the line; along the line only where it is as large relative to the contrast, too.
# Half of the former loses 5 % of the line centres, double adds 1 %.
_NOISY, _NOISY_NEARBY = 3.0, 2.0
_NEARBY = 4  # number of places to each side that a place is compared with
# Largest distance from the neighbours, in standard deviations, but at least so many px. Half of it loses 1 % of the
# line centres, double adds 0.2 %.
_FAR, _FAR_PX = 5.0, 0.25
# Largest distance from the neighbours, in units of their own spread. Half of it loses 0.2 % of the line centres, double
# adds 0.2 %.
_WANDERING = 4.0
# Step between the places whose scatter is measured: on a nearly horizontal line errors depend on its position within
# the pixel, and are alike over shorter distances. And the candidates for additional scatter, px.
_APART = 3
_SCATTER_PX = np.concatenate([[0.0], np.geomspace(0.002, 1.0, 60)])


class Lines(Rows):
    """Measurements of the paint at the places of a course.

    Attributes:
        course: the places that were examined.
        found: (N,) where paint was measured.
        offset_px: (N,) offset along the normal of the paint's middle from the course's place; NaN where not found.
        sigma_px: (N,) standard deviation of offset_px.
        blur_px: standard deviation of the picture's blur by lens, pixel and motion together.
        stretch: ratio of the paint's width to the target's, as far as the blur allows it to be measured.
        coma_px: standard deviation of the displacement by coma that may remain at half a diagonal from the picture's
            middle; it is outwards everywhere and grows with the square of the radius. 0 where no coma was seen.
    """

    course: Course
    found: Mask
    offset_px: Array
    sigma_px: Array
    blur_px: float
    stretch: float
    coma_px: float = 0.0

    @property
    def is_even(self) -> bool:
        """Whether no coma was seen."""
        return self.coma_px == 0.0

    @property
    def pixels(self) -> Array:
        """(N, 2) px of the paint's middle, NaN where it was not found."""
        return np.asarray(self.course.pixels + self.offset_px[:, None] * self.course.normals)

    def edge(self, side: int) -> Array:
        """(N, 2) px of the paint's left (side 1) or right (-1) edge, NaN where it was not found.

        Both edges come from one fit with the width known. To weigh two edges together as much as the one middle, each
        has the middle's sigma times the square root of 2.
        """
        away = self.offset_px + 0.5 * side * self.stretch * self.course.width_px
        return np.asarray(self.course.pixels + away[:, None] * self.course.normals)


def search(
    grey: Array32, course: Course, reach_px: float, spare_px: float = 0.0, blur_px: Array | float = 0.0
) -> tuple[Array, Array]:
    """Return where paint is most likely along the normals: offsets (N,) px, and how much brighter it is, grey levels.

    Args:
        reach_px: how far to search to either side.
        spare_px: a line nearer by this distance is preferred to another even if the other is twice as bright.
        blur_px: standard deviation of what makes lines wider, (N,) or one for all.
    """
    steps, response = _responses(grey, course, reach_px, blur_px, _BAND_PX)
    best = np.argmax(_preferred(response, steps / spare_px) if spare_px > 0.0 else response, axis=1)
    return steps[best], response[np.arange(len(best)), best]


def peaks(grey: Array32, course: Course, reach_px: float) -> tuple[Array, Array]:
    """Return every place along the normals where there may be paint, however near to other paint: offsets (S,) px, and
    how much brighter than both sides each of them is (N, S), 0 where it is no peak.
    """
    steps, response = _responses(grey, course, reach_px, 0.0, _NARROW_PX)
    return steps, np.where(_is_peak(response), np.maximum(response, 0.0), 0.0)


def _responses(
    grey: Array32, course: Course, reach_px: float, blur_px: Array | float, band_px: float
) -> tuple[Array, Array]:
    """Steps (S,) px along the normals, and (N, S) how much brighter a line there is than bands to either side."""
    half_px = 0.5 * np.maximum(course.width_px, np.maximum(_AS_WIDE * np.asarray(blur_px), 1.0))
    count = int(reach_px / _SEARCH_STEP_PX)
    beyond = int(np.ceil((np.max(half_px) + band_px + 1.0) / _SEARCH_STEP_PX)) + 1
    steps = np.arange(-count - beyond, count + beyond + 1.0) * _SEARCH_STEP_PX
    light = _along_normals(grey, course, steps, (-2.0, 0.0, 2.0))
    # Sums of means between steps, so that a mean extends as far to one side of its place as to the other.
    total = np.cumsum(np.pad(0.5 * (light[:, 1:] + light[:, :-1]), ((0, 0), (1, 0))), axis=1)
    own, rows = sliding_window_view(total, 2 * count + 1, axis=1), np.arange(len(total))

    def mean(low: Array, high: Array) -> Array:
        """(N, S) mean light from `low` to `high` (N,) px beyond each step."""
        first, last = (np.round(edge / _SEARCH_STEP_PX).astype(int) for edge in (low, high))
        return np.asarray((own[rows, beyond + last] - own[rows, beyond + first]) / (last - first)[:, None])

    left, right = mean(-half_px - 1.0 - band_px, -half_px - 1.0), mean(half_px + 1.0, half_px + 1.0 + band_px)
    return steps[beyond:-beyond], mean(-half_px, half_px) - np.maximum(left, right)


def _preferred(response: Array, away: Array) -> Array:
    """(N, S) preference for each step (S,) as the line's place: a peak that is near. Brightness beyond that of usual
    paint hardly counts: a boundary line beside the field's own line may be wider.
    """
    bright, usual = np.maximum(response, 0.0), max(median(np.max(response, axis=1)), _TINY)
    return np.asarray(_is_peak(response) * bright / (bright + 0.5 * usual) * np.exp(-0.5 * away**2))


def _is_peak(response: Array) -> Mask:
    higher = np.pad(response, ((0, 0), (1, 1)), constant_values=-np.inf)
    return np.asarray((response >= higher[:, :-2]) & (response >= higher[:, 2:]))


def _along_normals(grey: Array32, course: Course, steps: Array, shifts_px: Sequence[float]) -> Array:
    """(N, S) light at steps (S,) px along the normals, averaged over places shifted along the line by `shifts_px`."""
    nx, ny = course.normals.T[..., None]
    x, y = course.pixels[:, 0, None] + steps * nx, course.pixels[:, 1, None] + steps * ny
    shape = len(shifts_px), *x.shape
    there = np.empty((2, *shape), np.float32)
    for number, shift in enumerate(shifts_px):
        np.add(x, shift * ny, out=there[0, number], casting="same_kind")
        np.subtract(y, shift * nx, out=there[1, number], casting="same_kind")
    map_x, map_y = there.reshape(2, -1, len(steps))
    light = cv2.remap(grey, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(light.reshape(shape).sum(axis=0, dtype=float) / len(shifts_px))


def measure(
    grey: Array32, course: Course, reach_px: float, clear_px: Array | float = np.inf, *, is_even: bool = False
) -> Lines:
    """Measure the paint at the places of a course whose windows hold no other paint.

    Args:
        reach_px: how far the course may be off.
        clear_px: (N,) or one, px from each place to other paint (see `courses.clear_px`).
        is_even: whether the search for coma is skipped.
    """
    clear, blur, beyond = np.broadcast_to(clear_px, len(course)), no_blur(len(course)), _BEYOND_PX
    for _ in range(2):
        # A window is used only if other paint, as blurred as its own, is farther away than the window reaches.
        alone = clear > 1.2 * (course.width_px + beyond) + HALF_WIDTH_PX + beyond - _BEYOND_PX
        course, clear, blur = course.take(alone), clear[alone], blur.take(alone)
        if not len(course):
            none = np.empty(0)
            return Lines(course, np.empty(0, dtype=bool), none, none, 1.0, 1.0)
        rough, bright = search(grey, course, reach_px, 0.5 * reach_px, blur.blur_px)
        windows = _windows(grey, course, rough, beyond)
        blur = blur_of(windows, course, bright, blur)
        if _AS_FAR * np.max(blur.blur_px) <= beyond:
            break
        beyond = _AS_FAR * float(np.max(blur.blur_px))
    fits, coma_px = blur.fitted(windows, course), 0.0
    size = (grey.shape[0], grey.shape[1])
    coma = None if is_even else with_coma(windows, course, blur, fits, size)
    if coma is not None:
        leaning, remains = coma[0].fitted(windows, course), coma[1]
        out, by = np.prod(from_middle(course, size), axis=0), np.nan_to_num(leaning.offset_px - fits.offset_px)
        coma_px = remains * float(abs(out @ by) / (out @ out))
        blur, fits = (coma[0], leaning) if remains < 1.0 else (blur, fits)
    contrast = np.minimum(fits.heights[:, 0], -fits.heights[:, 1])
    # Blur along a line moves it towards the inside of its bend.
    offset = rough + fits.offset_px - 0.5 * blur.usual_px**2 * course.curvature
    found = _is_paint(course, fits, contrast, medians(windows.values))
    found = _goes_on(course, found, offset, fits.sigma_px)
    aside, open_px = drawn_aside(course, np.where(found, offset, np.nan), _threes(course, found), HALF_WIDTH_PX)
    offset = offset - aside
    sigma = np.hypot(_as_scattered(_threes(course, found), offset, fits.sigma_px), open_px)
    found = _goes_on(course, found, offset, sigma)
    offset = np.where(found, offset, np.nan)
    if coma is None and not np.any(blur.smear_px):  # coma is asymmetric, too, and has a standard deviation of its own
        middle, half = np.where(found, fits.offset_px, np.nan), 0.5 * blur.stretch * course.width_px
        # Largest common displacement, in standard deviations of the places. They are treated as independent: a larger
        # one would take away what a line says about direction and lens, too. 3 and 5 are as good.
        most = 4.0
        together = drawn_together(windows, course, middle, contrast, half, blur.blur_px)
        sigma = np.hypot(sigma, np.minimum(together, most * sigma))
    return Lines(course, found, offset, sigma, blur.usual_px, blur.stretch, coma_px)


def _windows(grey: Array32, course: Course, rough_px: Array, beyond_px: float) -> Windows:
    """Cut windows around the rough places (N,) px along the normals that reach `beyond_px` past the paint's border."""
    places = course.pixels + rough_px[:, None] * course.normals
    usual_length = quantile(0.5 * course.width_px + beyond_px, 0.9)
    return cut_windows(grey, places, course.normals, course.curvature, usual_length, HALF_WIDTH_PX)


def _is_paint(course: Course, fits: Profiles, contrast: Array, around: Array) -> Mask:
    """Whether the window shows a bright line: darker on both sides, with the usual contrast, and nothing else in it.

    The contrast is compared with that nearby, absolutely or relative to the light `around` (N,): sun changes paint and
    carpet alike.
    """
    # What the profile model itself leaves of clean paint, as a share of its contrast: up to 0.025 where pictures have
    # hardly any noise, at some directions of a line more than at others.
    model = 0.025
    fitted = np.isfinite(fits.offset_px)
    if not np.any(fitted):
        return fitted
    clear = fitted & (contrast > _LEAST_CLARITY * fits.noise)
    if not np.any(clear):
        return clear
    usual = median(contrast[clear])
    clear &= contrast > _LEAST_CONTRAST * usual
    alike = np.zeros(len(clear), dtype=bool)
    for height in (contrast, contrast / np.maximum(around, 1.0)):
        nearby = _medians(np.where(clear, height, np.nan), course.curve)
        alike |= (height > _OF_NEARBY[0] * nearby) & (height < _OF_NEARBY[1] * nearby)
    clear &= alike
    shares = fits.noise / np.maximum(contrast, _TINY)
    even = max(1.0, model / median(shares[clear]))
    misfit, share = (one / (even * median(one[clear])) for one in (fits.noise, shares))
    along = _medians(np.where(fitted, np.minimum(misfit, share), np.nan), course.curve)
    return np.asarray(clear & (misfit < _NOISY) & (along < _NOISY_NEARBY))


def _neighbours(values: Array, curve: Indices32) -> Array:
    """(N, 2 * _NEARBY) the values of the places before and after on the same curve, NaN where there are none."""
    count = len(values)
    steps = np.array([step for step in range(-_NEARBY, _NEARBY + 1) if step != 0])
    rows = np.arange(count)[:, None] + steps
    there = np.clip(rows, 0, max(count - 1, 0))
    same = (rows >= 0) & (rows < count) & (curve[there] == curve[:, None])
    return np.where(same, values[there], np.nan)


def _medians(values: Array, curve: Indices32) -> Array:
    """(N,) the median of each place and its neighbours; its own value where there are no neighbours."""
    return medians_known(np.column_stack([_neighbours(values, curve), values]))


def _goes_on(course: Course, found: Mask, offset: Array, sigma: Array) -> Mask:
    """Whether a found place agrees with its neighbours; a place without neighbours is rejected."""
    around = _neighbours(np.where(found, offset, np.nan), course.curve)
    alone = np.count_nonzero(np.isfinite(around), axis=1) < 2
    middle = medians_known(around)
    # A wavy line is still paint: a place may deviate as much as its neighbours do among themselves.
    wander = medians_known(np.abs(around - middle[:, None])) / 0.6745
    near = np.abs(offset - middle) < np.maximum(np.maximum(_FAR * sigma, _FAR_PX), _WANDERING * wander)
    return np.asarray(found & near & ~alone)


def _threes(course: Course, found: Mask) -> Indices:
    """(M, 3) places on a curve, each `_APART` from the next, that were all found."""
    first = np.arange(max(len(found) - 2 * _APART, 0))
    three = first[:, None] + (0, _APART, 2 * _APART)
    same = course.curve[three[:, 0]] == course.curve[three[:, 2]]
    return np.asarray(three[same & np.all(found[three], axis=1)])


def _as_scattered(three: Indices, offset: Array, sigma: Array) -> Array:
    """(N,) the standard deviations, px, enlarged to the scatter of the offsets of three places on a curve.

    Carpet, wear and compression are not white noise, which is all that a window's own sigma contains. Windows in good
    light suffer from them no less, so the same amount is added to all. Sigmas are never reduced: places that scatter by
    less may have a common error.
    """
    if len(three) < 20:
        return sigma
    change, weight = np.abs(offset[three] @ (1.0, -2.0, 1.0)), np.array([1.0, 4.0, 1.0])
    more = _SCATTER_PX[:, None]
    usual = medians(change / np.sqrt(sigma[three] ** 2 @ weight + np.sum(weight) * more**2))
    return np.asarray(np.hypot(sigma, _SCATTER_PX[np.argmin(np.abs(usual / 0.6745 - 1.0))]))
