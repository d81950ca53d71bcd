"""Result of following a field's lines in a photograph, and whether it is the field."""

from __future__ import annotations

import numpy as np

from ceres_cal.base.arrays import distinct
from ceres_cal.base.frozen import Frozen, cached_property
from ceres_cal.detect.courses import Course, predict
from ceres_cal.detect.lines import SPACING_PX, Lines
from ceres_cal.detect.photographs.as_built import AS_DRAWN, FieldAsBuilt
from ceres_cal.scene import Camera, Target

# Least share of the places in view where paint must be found: robots and wear hide a third. Nothing changes from 0.33
# to 0.67.
LEAST_SHARE = 0.5
# Share of the places with paint from which on no other start is tried. At half of its odds nothing changes.
SURE_SHARE = 0.7
# Least share of the places with paint for lines that may be worn to dashes: other fields and wrong places reach it as
# well, so strokes must decide.
_LEAST_IF_WORN = 0.3
# Share of a curve's places below which it is absent; largest share of all places on absent curves.
_ABSENT, _MOST_ABSENT = 0.2, 0.08


class FieldLines(Frozen):
    """A field's lines as they were followed.

    Attributes:
        camera: the posed camera that predicts them.
        target: the target with the dimensions that were found.
        curves: names of the curves that were followed.
        missing: names of the curves that the target may lack, and this field does.
        lines: measurements of the curves, without misplaced ones.
        visible: names of the curves along which there is paint, whether it could be measured or not.
        built: where the curves lie, if the photograph had to determine the lens, too.
        beside: measurements of the misplaced curves.
    """

    camera: Camera
    target: Target
    curves: tuple[str, ...]
    missing: tuple[str, ...]
    lines: Lines
    visible: tuple[str, ...]
    built: FieldAsBuilt = AS_DRAWN
    beside: Lines | None = None

    @cached_property
    def places(self) -> int:
        """Number of places in view, including those on curves that this field lacks."""
        return len(self.lines.found) + len(self._lacking)

    @property
    def share(self) -> float:
        """Share of the places in view where paint was found. Places on curves that the field lacks count, so the rest
        of it must be seen all the better.
        """
        return float(np.count_nonzero(self.lines.found) / self.places) if self.places else 0.0

    @property
    def absent(self) -> tuple[int, ...]:
        """Numbers of the curves in view of which almost nothing was found. Curves that are visible are excluded, unless
        the target may lack them: the visible paint may then be another line's.
        """
        curve, found = self.lines.course.curve, self.lines.found
        numbers, places = np.unique(curve, return_counts=True)
        counts = np.array([np.count_nonzero(found[curve == number]) for number in numbers])
        sure = set(self.visible).difference(*self.target.optional)
        visible = np.isin(numbers, [self.target.curve_index[name] for name in sure])
        return tuple(int(number) for number in numbers[(counts < _ABSENT * places) & ~visible])

    @property
    def lacks_wholly(self) -> tuple[tuple[str, ...], ...]:
        """The optional parts of the target of which nothing is there."""
        none = {*self.missing, *(self.target.curve_names[number] for number in self.absent)}
        return tuple(part for part in self.target.optional if none.issuperset(part))

    @property
    def lacking(self) -> tuple[str, ...]:
        """Names of the missing curves in view."""
        return tuple(self.target.curve_names[number] for number in distinct(self._lacking.curve))

    @cached_property
    def _lacking(self) -> Course:
        return predict(self.target, self.camera, self.missing, SPACING_PX, SPACING_PX)

    @property
    def holds(self) -> bool:
        """Whether this is the field: paint at half of the places in view, and no important line missing."""
        return self.share >= LEAST_SHARE and self._has_all

    @property
    def is_sure(self) -> bool:
        """Whether it holds, with so much paint that no other start is tried."""
        return self.holds and self.share >= SURE_SHARE

    @property
    def is_field(self) -> bool:
        """Whether it holds, and its curves lie where the target says."""
        return self.holds and not self.built.is_other

    @property
    def is_decided(self) -> bool:
        """Whether its lines are surely there, and different dimensions alone explain them: another start would not
        help.
        """
        is_another = self.built.is_other and bool(self.built.dimensions) and not self.built.aside_m
        return is_another and self.is_sure

    @property
    def may_be_worn(self) -> bool:
        """Whether it is at least consistent with the field if its lines are worn to dashes."""
        return self.share >= _LEAST_IF_WORN and self._has_all

    @property
    def _has_all(self) -> bool:
        gone = [number for number in self.absent if self.target.curve_names[number] not in self.visible]
        missing = np.isin(self.lines.course.curve, gone)  # an optional curve that is hidden counts only as lacking
        return float(np.mean(missing)) <= _MOST_ABSENT
