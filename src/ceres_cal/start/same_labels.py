"""Label a symmetric board in the same way in all cameras that see it at once.

A detector cannot distinguish a board of 4 x 6 corners from the same board turned by half a turn. With one camera, the
placement absorbs that; two cameras then see the board at two places. But the cameras do not move, so the pose of one in
the other's frame, computed by way of the board, is the same at every moment if the labels are right. The labelling on
which most moments agree is taken.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterator, Mapping, Sequence

import numpy as np

from ceres_cal.base import CalibrationError, Frozen, Pose, attempt, median, rotation_exp
from ceres_cal.observations import Observations, gather_sights
from ceres_cal.problem.parameters import Options
from ceres_cal.scene.targets import Target
from ceres_cal.start.initialise import posed_sights

_START = Options(lens="radial")
Both = Mapping[str, tuple[Pose, Pose]]
"""Placement -> cam_from_target of the first camera and of another one, each by itself."""


class Labels(Frozen, eq=True):
    """The result of comparing labels.

    Attributes:
        observations: with labels that agree. turned: (station, placement) of each board that was relabelled.
        open: stations whose labels cannot be decided: they share only one placement, or poses that suit either
            labelling.
    """

    observations: Observations
    turned: tuple[tuple[str, str], ...]
    open: tuple[str, ...]


def open_words(station: str) -> str:
    """The message about a station whose labels cannot be decided."""
    return (
        f"station {station!r}: it is unknown whether its boards are labelled the other way round: show the board to it "
        "and to the first camera at once in more poses, or use a board whose columns + rows are odd"
    )


def with_same_labels(observations: Observations) -> Labels:
    """The observations with every symmetric board labelled alike by all stations that see it at a placement.

    Raises:
        DegenerateError: the pose of a sight cannot be determined.
    """
    turned, unsaid, labelled = [], [], observations
    for station, turns in _beside_the_first(observations, symmetries):
        if turns is None:
            unsaid.append(station)
        for placement, turn in (turns or {}).items():
            turned.append((station, placement))
            labelled = _relabelled(labelled, station, placement, turn)
    return Labels(labelled, tuple(turned), tuple(unsaid))


def listed_otherwise(observations: Observations) -> dict[tuple[str, str], str]:
    """(station, placement) -> how its points are ordered differently from those that the first station sees, in
    words.
    """
    # quiet: this only adds a cause to what the user reads
    compared = attempt(lambda: list(_beside_the_first(observations, _listings)))
    return {
        (station, placement): (
            f"its points are {'mirrored' if turn.rotation[2, 2] < 0.0 else 'turned'} relative to those of other "
            "cameras: list them in the same order"
        )
        for station, turns in ([] if isinstance(compared, CalibrationError) else compared)
        for placement, turn in (turns or {}).items()
    }


def beside_the_first(observations: Observations, boards: Container[str]) -> Iterator[tuple[str, str, Both]]:
    """The first station that shows some boards, given by the names of their targets, and each other station that shows
    them at the same placements, with the poses of both.

    Raises:
        CalibrationError: the pose of a sight cannot be determined.
    """
    sights = gather_sights(observations)
    shown = {(v.station, v.placement) for v in observations.views if v.placement is not None and v.target in boards}
    shared = {key for key in sights.keys if key.placement not in sights.seen_once and key[1:] in shown}
    poses: dict[str, dict[str, Pose]] = {}
    for key, pose in posed_sights(sights, _START).by_key(sights).items() if shared else ():
        if key in shared:
            poses.setdefault(key.station, {})[str(key.placement)] = pose
    first, *others = poses or ("",)
    for station in others:
        both = {name: (poses[first][name], pose) for name, pose in poses[station].items() if name in poses[first]}
        if both:
            yield first, station, both


def _beside_the_first(
    observations: Observations, turns_of: Callable[[Target], list[Pose]]
) -> Iterator[tuple[str, dict[str, Pose] | None]]:
    """Stations that see boards with the first one, and the turns that their sights need, by placement; None where they
    cannot be decided.
    """
    turns = {name: turns_of(target) for name, target in observations.targets.items()}
    target_of = {view.placement: view.target for view in observations.views}
    for _, station, both in beside_the_first(observations, [name for name, own in turns.items() if len(own) > 1]):
        yield station, _turns(both, [turns[target_of[placement]] for placement in both])


def symmetries(target: Target) -> list[Pose]:
    """Turns about a board's middle after which its corners look the same; the first is the identity."""
    grid = target.grid
    if grid is not None and grid.checkered and (grid.columns + grid.rows) % 2 == 1:
        return [Pose.identity()]
    return [turn for turn in _listings(target) if turn.rotation[2, 2] > 0.0]


def _listings(target: Target) -> list[Pose]:
    """Turns after which points of a grid lie where others were, including those that show its mirrored picture."""
    grid = target.grid
    if grid is None:
        return [Pose.identity()]
    middle = np.append(0.5 * grid.spacing_m * (np.array([grid.columns, grid.rows]) - 1.0), 0.0)
    count = 4 if grid.columns == grid.rows else 2
    about = [rotation_exp([0.0, 0.0, 2.0 * np.pi * n / count]) for n in range(count)]
    rotations = [*about, *(one @ np.diag([1.0, -1.0, -1.0]) for one in about)]
    return [Pose(rotation, middle - rotation @ middle) for rotation in rotations]


def _turns(both: Both, turns: Sequence[Sequence[Pose]]) -> dict[str, Pose] | None:
    """The turns, out of those possible, that the second station's sights need, by placement; None where they cannot be
    decided.
    """
    alike = 0.15  # difference (rad, and shift over distance) that initial estimates of equal labels may have
    between = [[b @ turn @ a.inverse for turn in own] for (a, b), own in zip(both.values(), turns, strict=True)]
    depth = median(np.array([b.position @ b.position for _, b in both.values()])) ** 0.5
    answers, most = [], max(map(len, turns))
    for pose in (one for own in between for one in own):
        off = [[apart(pose, other, depth) for other in own] for own in between]
        answers.append((float(np.mean(np.min([row + [np.inf] * (most - len(row)) for row in off], axis=1))), off, pose))
    cost, off, best = min(answers, key=lambda answer: answer[0])
    others = [answer[0] for answer in answers if apart(answer[2], best, depth) > alike]
    if len(both) < 2 or not all(is_clearly_more(other, cost) for other in others):
        return None
    numbers = [int(np.argmin(row)) for row in off]
    return {name: own[number] for name, own, number in zip(both, turns, numbers, strict=True) if number}


def is_clearly_more(off: float, least: float) -> bool:
    """Whether one of two such differences is clearly excluded by the other."""
    clearly, alike = 3.0, 0.01  # factor that is clear; least difference of two initial estimates
    return off > clearly * max(least, alike)


def apart(a: Pose, b: Pose, depth: float) -> float:
    """The difference between two poses of a camera: the sine of half the angle, plus the shift over a depth."""
    turn = np.linalg.norm(a.rotation - b.rotation) / np.sqrt(8.0)
    return float(turn + np.linalg.norm(a.position - b.position) / depth)


def _relabelled(observations: Observations, station: str, placement: str, turn: Pose) -> Observations:
    points, feature = observations.points, observations.points.feature.copy()
    for number, view in enumerate(observations.views):
        if (view.station, view.placement) == (station, placement):
            places = observations.targets[view.target].point_array
            rows = np.flatnonzero(points.view == number)
            sought = turn.inverse.transform(places[points.feature[rows]])
            feature[rows] = np.argmin(np.linalg.norm(sought[:, None] - places, axis=2), axis=1)
    return observations.with_features(feature, observations.curves.feature)
