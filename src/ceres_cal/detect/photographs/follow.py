"""Following a field's lines in a photograph: search along normals, refit the camera, search nearer, until converged."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice, product
from typing import Any, TypeVar, cast

import numpy as np

from ceres_cal.base.arrays import Array32, median, quantile
from ceres_cal.base.frozen import replace
from ceres_cal.detect.courses import Course, clear_px, predict
from ceres_cal.detect.lines import SPACING_PX, Lines, measure, search
from ceres_cal.detect.photographs.as_built import AS_DRAWN, FieldAsBuilt, as_built
from ceres_cal.detect.photographs.beside import among_others
from ceres_cal.detect.photographs.field_lines import FieldLines
from ceres_cal.detect.photographs.painted import painted_curves, visible_curves
from ceres_cal.detect.photographs.refit import (
    TARGET,
    FreeIntrinsics,
    best_fit,
    misfit,
    moved_px,
    observations_of,
    redrawn_px,
    refit_camera,
    squared_pixels,
)
from ceres_cal.detect.registration import nearness, shifted
from ceres_cal.observations import Observations
from ceres_cal.problem.parameters import intrinsic_names
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.targets import Target, target_from_spec

FAR_PX = 130.0  # largest error of a start, px
_ROUGH_SPACING_PX = 12.0
_NEAR_REACHES_PX = (12.0, 6.0, 4.0)
# Reaches for a start from points that a user showed: a line farther off than these points' errors cannot attract it.
_SHOWN_REACHES_PX = (12.0, 12.0, 12.0, 8.0, 8.0, 5.0)
_FAR_REACHES_PX = (45.0, 45.0, 30.0, 30.0, 20.0, 12.0, 8.0, 5.0)
# Limits within which square pixels suit a picture: least ratio of the share of paint found with them to that with free
# pixels, and largest ratio of the misfits. The latter is 1.3 for pictures that were not stretched, and 9 for pictures
# stretched by 2 to 7 %.
_KEPT, _WORSE = 0.95, 2.0
_LAST_REACH_PX = 5.0
_CANDIDATES = 5
_FEWEST = 12
_MOST_OTHERS = 3  # number of other solutions that are tried where the best one looks like another field
_ROUNDS = 6
_NEARER = 2  # how often lines of changed dimensions are searched again
_LESS = 0.02  # a share of paint lower by at most this is no worse
_AT_REST_PX = 0.1  # lines whose prediction moves by less are not measured again: they are found up to 5 px off
# Cameras closer than this converge to the same result: wrong ones moved by 0.8 px at most, to that result.
_SAME_PX = 1.0

_T = TypeVar("_T")


def follow(
    grey: Array32, target: Target, starts: Sequence[Camera], curves: Collection[str], free: FreeIntrinsics | None = None
) -> FieldLines:
    """Follow a target's painted curves in a photograph, from the best of several starts.

    A near start is tried as it is; after that shifts, turns and scales of it, by up to 130 px and 7.5 degrees.

    Args:
        starts: posed cameras, any of which may be right.
        curves: names of the painted curves.
        free: what the photograph may change besides the pose.

    Returns:
        The best result; `FieldLines.holds` says whether it is the field.
    """
    tracker = Tracker(grey, target, curves, free or FreeIntrinsics())
    tried = tracker.tried(starts)
    best = next(tried)
    if not tracker.free.names:
        return best
    if best.may_be_worn:
        best = tracker.told(best)
        for one in islice(tried, _MOST_OTHERS):
            if best.is_field or best.is_decided:
                break
            again = tracker.told(one) if one.holds else one
            if again.is_field and not again.built.dimensions:
                best = again
    return best


@dataclass(frozen=True, eq=False)
class Tracker:
    """A photograph, the target's painted curves that are followed in it, and what is free in the camera.

    Attributes:
        missing: curves that the target may lack, and this field does.
        reached: results so far of all starts.
        known: cache of results by camera.
        is_even: whether the picture is known to have no coma.
    """

    grey: Array32
    target: Target
    curves: Collection[str]
    free: FreeIntrinsics
    missing: tuple[str, ...] = ()
    reached: list[FieldLines] = field(default_factory=list)
    known: list[tuple[Camera, tuple[object, ...], Any]] = field(default_factory=list)
    is_even: bool = False

    def refined_from(self, camera: Camera, lacking: Sequence[tuple[str, ...]] = ()) -> FieldLines:
        """Refine a camera that is right except for its lens: choose the kind of lens that fits best, and leave out
        misplaced curves. Lines that look like another field's are searched again from farther off, and a stretched
        picture is tried.

        Args:
            lacking: parts that this field is known to lack.
        """
        tracker = self.lacking(lacking).of_painted(camera)
        lines = tracker.measured(camera)
        # Whether the picture has coma does not depend on where its lines are now.
        tracker = replace(tracker, is_even=lines.is_even)
        return tracker.told(tracker.followed(camera, lines))

    def followed(self, camera: Camera, lines: Lines) -> FieldLines:
        """Return the measured lines of a camera, with the curves that are visible."""
        visible = visible_curves(self.grey, self.target, camera, self.curves)
        return FieldLines(camera, self.target, tuple(self.curves), self.missing, lines, visible)

    def of_painted(self, camera: Camera) -> Tracker:
        """Return the tracker without optional parts of the target that this camera does not see."""
        painted = painted_curves(self.grey, self.target, camera, self.curves)
        missing = (*self.missing, *(name for name in self.curves if name not in painted))
        return replace(self, curves=painted, missing=missing)

    def lacking(self, parts: Sequence[tuple[str, ...]]) -> Tracker:
        """Return the tracker without some optional parts of the target."""
        names = [name for part in parts for name in part]
        return replace(self, curves=[one for one in self.curves if one not in names], missing=tuple(names))

    def tried(self, starts: Sequence[Camera]) -> Iterator[FieldLines]:
        """Yield the results of the starts: one that is surely the field at once, then the others, the best first."""
        is_sure: dict[FieldLines, bool] = {}
        for one in self._reached(starts):
            if one not in is_sure:
                is_sure[one] = one.is_sure
                if is_sure[one]:
                    yield one
        left = [one for one in is_sure if not is_sure[one]]
        yield from sorted(left, key=lambda one: (one.holds, one.share), reverse=True)

    def _reached(self, starts: Sequence[Camera]) -> Iterator[FieldLines]:
        if self.free.hints is None:
            yield self.close_in(starts[0], _NEAR_REACHES_PX)
            if self.free.keep:
                return
        shifted = self.shifted_starts(starts)
        shown = (_SHOWN_REACHES_PX,) if self.free.hints is not None else ()
        for reaches, camera in product(shown if self.free.keep else (*shown, _FAR_REACHES_PX), shifted):
            yield self.close_in(camera, reaches)
        if not shifted:
            yield self.close_in(starts[0], ())  # as it is: no line to search

    def shifted_starts(self, starts: Sequence[Camera]) -> list[Camera]:
        """Return cameras that put the lines near something thin and bright, the best first."""
        courses = [self._predicted(camera) for camera in starts]
        usable = [number for number, course in enumerate(courses) if len(course) >= _FEWEST]
        if not usable:
            return []
        width = median(courses[usable[0]].width_px)
        near = nearness(self.grey, max(width, 2.0))
        usable.sort(key=lambda number: -near.score(courses[number].pixels))
        if self.free.hints is not None:
            return [starts[number] for number in usable[:_CANDIDATES]]
        camera = starts[usable[0]]
        wide, sigma_px = self._predicted(camera, -FAR_PX), 5.0
        refitted = []
        for places in shifted(wide, near, camera.image_size, FAR_PX, _CANDIDATES):
            moved = observations_of(self.target, camera.image_size, wide.curve, places, np.full(len(wide), sigma_px))
            there = refit_camera(camera, moved)
            refitted.append(camera if there is None else there[0])
        return refitted

    def close_in(self, camera: Camera, reaches_px: Sequence[float]) -> FieldLines:
        """Search ever nearer, freeing one intrinsic after the other; then measure and refit until convergence."""
        tracker = self
        for number, reach in enumerate(reaches_px):
            names = self.free.names[: max(0, 2 * number - 1)]
            tracker, camera = tracker._search_step(camera, names, reach) or (tracker, camera)
        tracker = tracker.of_painted(camera)
        other = among_others(self.grey, tracker.target, camera, tracker.curves, self.free)
        if other is not None:
            tracker, camera = replace(tracker, target=other[1]), other[0]
        there = tracker._reached_before(camera)
        if there is None:
            there = tracker.at_rest(camera, self.free.names)
            there = tracker._reached_before(there.camera) or there
        self.reached.append(there)
        return there

    def _reached_before(self, camera: Camera) -> FieldLines | None:
        """Return an earlier result of the same lines, if it is so near that this camera would converge to it."""
        own = self.target.spec, tuple(self.curves)
        alike = [one for one in self.reached if (one.target.spec, one.curves) == own]
        return next((one for one in alike if moved_px(one.camera, camera, one.lines.course.pixels) < _SAME_PX), None)

    def at_rest(self, camera: Camera, names: tuple[str, ...]) -> FieldLines:
        """Measure and refit, with these intrinsics free, until the lines stop moving, or move no less than before."""
        return self._once(camera, (names,), lambda: self._at_rest(camera, names))

    def _once(
        self,
        camera: Camera,
        what: tuple[object, ...],
        made: Callable[[], _T],
        is_same: Callable[[Camera, _T], bool] = lambda start, came: False,
    ) -> _T:
        """Return `made()`, or its earlier result for the same lines from this camera or an equivalent one: results are
        asked for repeatedly.
        """
        asked = *what, tuple(self.curves), self.target.spec
        for start, before, came in self.known:
            if before == asked and (start is camera or is_same(start, came)):
                return cast(_T, came)
        came = made()
        self.known.append((camera, asked, came))
        return came

    def _at_rest(self, camera: Camera, names: tuple[str, ...]) -> FieldLines:
        # A step must be smaller than this share of the last one: lines that alternate, or do not fit, never converge.
        no_nearer = 0.8
        tracker, lines, moved, there = self, self.measured(camera), np.inf, camera
        for _ in range(_ROUNDS):
            if np.count_nonzero(lines.found) < _FEWEST:
                break
            refitted = tracker._refitted(there, tracker._observed(lines, there), names)
            if refitted is None:
                break
            last, before, (tracker, there) = moved, there, refitted
            moved = moved_px(before, there, lines.course.pixels)
            lines = tracker.measured(there, is_even=lines.is_even)
            if moved < _AT_REST_PX or moved > no_nearer * last:
                break
        return tracker.followed(there, lines)

    def refined(self, followed: FieldLines) -> FieldLines:
        """Refine the result: predict with the lens that fits the curves best, without the misplaced curves."""
        whole = self._with(followed)
        followed = whole.without_aside(followed)
        # Possibly because of an unsuitable lens: a polynomial bends the lines of a strong one.
        if followed.built.is_other:
            other = whole.without_aside(whole.farther(whole.with_best_lens(followed)))
            if other.built.is_other:  # the dimensions are those under the lens that fits better with them
                return min(followed, other, key=lambda one: whole._misfit(whole.as_built(one)[1]))
            followed = other
        curves = [name for name in whole.curves if name not in followed.built.aside_m]
        left = replace(whole, curves=curves, target=followed.target)
        there = whole.without_aside(left.with_best_lens(followed))
        if followed.camera.aspect == 1.0 or there.is_field:
            return there
        stretched = whole.without_aside(left.with_best_lens(followed, is_stretched=True))
        return stretched if stretched.is_field else there

    def farther(self, followed: FieldLines) -> FieldLines:
        """Search again from farther off, with the kind of lens found. A lens that was too simple for a wide one put the
        ends of lines elsewhere, and what is found near there would mislead another lens.
        """
        tracker, camera = self, followed.camera
        for reach in _NEAR_REACHES_PX:
            tracker, camera = tracker._search_step(camera, _free(camera), reach) or (tracker, camera)
        there = tracker.at_rest(camera, _free(camera))
        return there if there.may_be_worn and there.share > followed.share else followed

    def told(self, followed: FieldLines) -> FieldLines:
        """Refine with square pixels. Other pixels, for a picture stretched in one direction, are used only where they
        show the field and square pixels either fit clearly worse, even with different dimensions, or show neither the
        field nor different dimensions alone.
        """
        square = self.squared(followed)
        even = self.refined(square)
        built, nearest = self._with(square).as_built(square)
        is_told = even.is_field or bool(built.dimensions and not built.aside_m)
        if is_told and not self._suits_worse(nearest, followed):
            return even
        stretched = self.refined(followed)
        return even if not stretched.is_field or (is_told and not self._suits_worse(nearest, stretched)) else stretched

    def _suits_worse(self, one: FieldLines, other: FieldLines) -> bool:
        """Whether less paint is found at the first result's lines than at the second's, or the first fits it worse."""
        return one.share < _KEPT * other.share or self._misfit(one) > _WORSE * self._misfit(other)

    def _misfit(self, followed: FieldLines) -> float:
        return misfit(followed.camera, self._with(followed)._observed(followed.lines, followed.camera))

    def _with(self, followed: FieldLines) -> Tracker:
        """Return the tracker for the curves, and the target as drawn, of a result."""
        return replace(self, curves=followed.curves, missing=followed.missing, target=followed.target)

    def squared(self, followed: FieldLines) -> FieldLines:
        """Refit the same lines with a camera of square pixels."""
        camera = squared_pixels(followed.camera)
        return self._with(followed).at_rest(camera, _free(camera))

    def without_aside(self, followed: FieldLines) -> FieldLines:
        """Leave out the misplaced curves in turn, so that none pulls the camera to where others seem misplaced."""
        free = _free(followed.camera)
        whole, built = replace(self, target=followed.target), AS_DRAWN
        left = whole
        for _ in range(_ROUNDS):
            known, built = built, whole.as_built(followed)[0]
            if built.is_other or built.aside_m.keys() == known.aside_m.keys():
                break
            left = replace(whole, curves=[name for name in whole.curves if name not in built.aside_m])
            followed = left.at_rest(followed.camera, free)
            whole, left = (replace(one, target=followed.target) for one in (whole, left))
        lines, beside = left.measured(followed.camera), None
        if built.aside_m:
            every = whole.measured(followed.camera)
            aside = [followed.target.curve_index[name] for name in built.aside_m]
            beside = every.take(np.isin(every.course.curve, aside))
        return replace(followed, curves=tuple(self.curves), built=built, lines=lines, beside=beside)

    def as_built(self, followed: FieldLines) -> tuple[FieldAsBuilt, FieldLines]:
        """Return where all curves lie, and the result of following them with the dimensions found.

        With different dimensions lines are several pixels from where they were searched, and some are missed or
        confused. So they are searched and measured again where those dimensions put them.
        """
        return self._once(followed.camera, ("as built",), lambda: self._as_built(followed))

    def _as_built(self, followed: FieldLines) -> tuple[FieldAsBuilt, FieldLines]:
        free, target = _free(followed.camera), self.target
        nearest = replace(followed, lines=self.measured(followed.camera))
        built = as_built(nearest.lines, nearest.camera, target, self.free.priors)
        for _ in range(_NEARER):
            if not built.dimensions:
                break
            there = replace(self, target=target_from_spec({**target.spec, **built.dimensions}, target.kind))
            if redrawn_px(nearest.camera, nearest.lines.course, there.target) < _AT_REST_PX:
                break
            nearer = there.at_rest(nearest.camera, free)
            if nearer.share < nearest.share - _LESS:
                break
            nearest = nearer
            built = as_built(nearest.lines, nearest.camera, target, self.free.priors)
        return built, nearest

    def with_best_lens(self, followed: FieldLines, *, is_stretched: bool = False) -> FieldLines:
        """Return the lines predicted with the kind of lens that fits them best.

        A polynomial that is a pixel off bends the lines from which crossings are extrapolated; one that folds in the
        picture does so where nothing was measured.
        """
        lengths = tuple(prior for prior in self.free.priors if prior.dimension)
        observed = self._observed(followed.lines, followed.camera)
        best = best_fit(followed.camera, observed, lengths, is_stretched=is_stretched)
        if best is None:
            return followed
        camera, target = best.station(), best.targets[TARGET]
        lines = replace(self, target=target).measured(camera)
        refined = replace(self, target=target).followed(camera, lines)
        return refined if refined.may_be_worn and refined.share > followed.share - _LESS else followed

    def _refitted(
        self, camera: Camera, observations: Observations, names: tuple[str, ...]
    ) -> tuple[Tracker, Camera] | None:
        """Return the tracker with the refitted target, and the camera refitted with these intrinsics free."""
        refitted = refit_camera(camera, observations, names, self.free.priors)
        return None if refitted is None else (replace(self, target=refitted[1]), refitted[0])

    def _search_step(self, camera: Camera, names: tuple[str, ...], reach_px: float) -> tuple[Tracker, Camera] | None:
        """Refit to the brightest places along the normals; None where too few are found."""
        course = self._predicted(camera, 2.0)
        if len(course) < _FEWEST:
            return None
        offset, bright = search(self.grey, course, reach_px, 0.6 * reach_px)
        clear = bright > 0.4 * quantile(bright, 0.8)
        if np.count_nonzero(clear) < _FEWEST:
            return None
        course, offset = course.take(clear), offset[clear]
        places = course.pixels + offset[:, None] * course.normals
        sigma = np.full(len(course), max(0.1 * reach_px, 0.5))
        hints = self.free.hints if reach_px > 10.0 else None
        observations = observations_of(self.target, camera.image_size, course.curve, places, sigma, hints)
        return self._refitted(camera, observations, names)

    def _predicted(self, camera: Camera, margin_px: float = 0.0) -> Course:
        return predict(self.target, camera, self.curves, _ROUGH_SPACING_PX, margin_px)

    def measured(self, camera: Camera, *, is_even: bool = False) -> Lines:
        """Measure the lines near where a camera predicts them; return an earlier measurement if it has the same kind of
        lens and predicts them almost there.
        """
        is_even = is_even or self.is_even

        def is_same(start: Camera, came: Lines) -> bool:
            return bool(len(came.course)) and moved_px(start, camera, came.course.pixels) < _AT_REST_PX

        what = "lines", camera.lens.kind
        return self._once(camera, what, lambda: self._measured(camera, is_even), is_same)

    def _measured(self, camera: Camera, is_even: bool) -> Lines:
        course = predict(self.target, camera, self.curves, SPACING_PX, SPACING_PX)
        clear = clear_px(self.target, camera, course, self.curves)
        return measure(self.grey, course, _LAST_REACH_PX, clear, is_even=is_even)

    def _observed(self, lines: Lines, camera: Camera) -> Observations:
        rows = lines.found
        return observations_of(
            self.target, camera.image_size, lines.course.curve[rows], lines.pixels[rows], lines.sigma_px[rows]
        )


def _free(camera: Camera) -> tuple[str, ...]:
    """Names of the intrinsics that a photograph may change; pixels that are square so far remain square, and a skew as
    it is.
    """
    held = {"skew"} if camera.aspect != 1.0 else {"skew", "aspect"}
    return tuple(name for name in intrinsic_names(camera.lens) if name not in held)
