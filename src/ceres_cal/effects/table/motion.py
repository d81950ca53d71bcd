"""A camera that moved: from some frame on, or in one frame alone."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from typing import ClassVar

import numpy as np

from ceres_cal.base.arrays import Array, Indices, numbers_of
from ceres_cal.base.transforms import skew
from ceres_cal.effects.columns import EffectColumns, grouped
from ceres_cal.effects.effect import Case, Effect, Evidence, Words, amounts


class _PoseTest(Effect):
    """Each station turned about the camera's axes, shifted in the world."""

    onwards: ClassVar[bool]
    advice: ClassVar[str]

    @abstractmethod
    def groups(self, group: Indices, count: int) -> Indices:
        """(E,) the frames of `count` that are tested."""

    def columns(self, case: Case) -> Iterator[EffectColumns]:
        equations = case.equations
        frames = [(view.station, view.frame) for view in case.observations.views]
        known = list(dict.fromkeys(frames))
        frame = numbers_of(frames, known)[equations.view]
        bounds = zip(equations.bounds, equations.bounds[1:], strict=False)
        several = np.array([bool(np.any(frame[start:stop] != frame[start])) for start, stop in bounds])
        tied = np.array([key.placement not in case.problem.private for key in equations.sights.keys])
        of_station = np.array([key.station for key in equations.sights.keys])
        columns = motion_columns(case)
        for station in case.observations.stations:
            present, group = grouped(frame, equations.of_sights((of_station == station) & (tied | several)))
            group, names = self.groups(group, len(present)), tuple(known[number][1] for number in present)
            if np.any(group >= 0):
                yield EffectColumns(self.kind, columns, group, (station,) * len(names), names, self.onwards)

    def words(self, evidence: Evidence) -> Words:
        score, others = evidence.score, evidence.others
        turn, step, both = (others.freed(score.columns[:, part]) for part in (slice(3), slice(3, 6), slice(6)))
        angle, angle_sd = np.degrees(_length(turn.amount, turn.sd))
        mm, mm_sd = 1e3 * np.array(_length(step.amount, step.sd))
        ways = [
            (turn.decrease, f"turned by {angle:.3f} ± {angle_sd:.3f} degrees"),
            (step.decrease, f"shifted by {mm:.1f} ± {mm_sd:.1f} mm"),
        ]
        ways.sort(key=lambda way: -way[0])
        whole = max(both.decrease, 1e-300)
        how = " or ".join(f"{text} (explains {100.0 * min(part / whole, 1.0):.0f} %)" for part, text in ways)
        when = f"after frame {score.frame!r}" if self.onwards else f"in frame {score.frame!r} alone"
        turns, steps = [f"turn about the camera's {axis}" for axis in "xyz"], [f"shift along {axis}" for axis in "xyz"]
        return Words(
            f"station {score.subject!r} moved {when}: {how}; {evidence.size}",
            self.advice,
            (
                *amounts(turns, np.degrees(score.amount[:3]), np.degrees(score.sd[:3]), "deg"),
                *amounts(steps, 1e3 * score.amount[3:], 1e3 * score.sd[3:], "mm"),
            ),
        )


class MovedAfter(_PoseTest):
    """From some frame on."""

    kind = "moved after"
    onwards = True
    advice = "give the frames after it a station of their own"

    def groups(self, group: Indices, count: int) -> Indices:
        return group if count > 1 else np.full(len(group), -1)


class MovedIn(_PoseTest):
    """In one frame alone."""

    kind = "moved in"
    onwards = False
    advice = "leave this frame out, or give it a station of its own"

    def groups(self, group: Indices, count: int) -> Indices:
        return np.where((group > 0) & (group < count - 1), group, -1)  # the first or last is the same as from there on


def motion_columns(case: Case) -> Array:
    """(E, 6) px per radian about the camera's axes through its own position, and per metre along the world's."""
    equations = case.equations
    columns = np.empty((len(equations), 6))
    for number, key in enumerate(equations.sights.keys):
        here = slice(equations.bounds[number], equations.bounds[number + 1])
        turned = equations.motion[here] @ -skew(equations.poses[number, :, 3])
        columns[here, :3] = equations.pose[here, :3] + turned
        columns[here, 3:] = -equations.motion[here] @ case.estimate.stations[key.station].cam_from_world.rotation
    return columns


def _length(vector: Array, sd: Array) -> tuple[float, float]:
    """Length of a vector, and its standard deviation by that of its parts."""
    length = float(np.linalg.norm(vector))
    known = np.isfinite(sd)
    return length, float(np.linalg.norm(vector[known] * sd[known])) / max(length, 1e-300)


EFFECTS = (MovedAfter(), MovedIn())
