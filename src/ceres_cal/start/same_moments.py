"""Test whether the cameras of a rig show a board at the same moments. Names of frames may be exchanged or off by one,
cameras may be out of step while a board moves, or somebody may have turned a camera.

Each camera by itself shows where a board is. At the same moment, the others must see it there, up to the noise.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ceres_cal.base import Array, CalibrationError, Pose, SolutionError, attempt, counted, median
from ceres_cal.effects.evidence import LEAST_PX
from ceres_cal.observations import Observations
from ceres_cal.problem import Estimate, Problem
from ceres_cal.problem.residuals import residuals, write_equations
from ceres_cal.start.same_labels import Both, apart, beside_the_first, is_clearly_more, listed_otherwise

_FEWEST = 4  # moments from which on the cameras can be compared: of three, two agree by chance
_ADVICE = (
    "the pictures were not taken at the same moment, or a camera was moved: take them all at once, hold the board "
    "still meanwhile, or give the frames of each camera names of their own"
)


def require_same_moments(problem: Problem, estimate: Estimate) -> str:
    """A warning where cameras contradict one another about most boards by more than their noise; "" if they do not.

    Raises:
        SolutionError: they do by so much that nothing that they show together can be used.
    """
    # Ratios to the noise. Beside boards that moved by 0.3 mm between two shutters, 0.5 to 1.1 times the noise, the
    # numbers of the cameras are within their uncertainty; beside 1 mm, 1.8 to 9 times, they were thousands of standard
    # deviations off.
    named, refused = 1.0, 1.5
    shares = _by_own_poses(problem, estimate)
    if len(shares) < _FEWEST:
        return ""
    share = median(np.array(list(shares.values())))
    times = float(np.sqrt(share / max(1.0 - share, 1e-9)))
    if times < named:
        return ""
    stations = " and ".join(map(repr, problem.observations.stations))
    words = f"in most frames {stations} see the board at different places, {times:.1f} times the noise apart"
    if times > refused:
        raise SolutionError(f"{next(shifted(problem.observations), words)}: {_ADVICE}")
    return f"{words}: {_ADVICE}"


def _by_own_poses(problem: Problem, estimate: Estimate) -> dict[str, float]:
    """Placement that several sights show -> the largest share of the squared residuals of one of these sights that a
    pose of its own would explain. Empty where a field shows where cameras stand: the field may be wrong.
    """
    sights, alone = problem.sights, problem.sights.seen_once
    shared = [n for n, key in enumerate(sights.keys) if key.placement not in (None, *alone)]
    if not shared or sights.of_world:
        return {}
    own = sights.take(np.array(shared))
    equations = write_equations(own, estimate, residuals(own, estimate))
    found: dict[str, float] = {}
    for key, start, stop in zip(equations.sights.keys, equations.bounds[:-1], equations.bounds[1:], strict=True):
        left = equations.residual[start:stop]
        basis = np.linalg.qr(equations.pose[start:stop])[0]
        share = float(np.sum((left @ basis) ** 2) / (left @ left + LEAST_PX**2 * len(left)))
        found[str(key.placement)] = max(share, found.get(str(key.placement), 0.0))
    return found


def shifted(observations: Observations) -> Iterator[str]:
    """Descriptions of stations whose frames match those of the first one only after a shift."""
    for moments in _moments(observations):
        costs = {shift: moments.cost(shift) for shift in range(-moments.most_shift, moments.most_shift + 1)}
        best = min(costs, key=costs.__getitem__)
        if is_clearly_more(costs[0], costs[best]) and costs[best] < moments.alike:
            where = f"{counted(abs(best), 'frame')} {'later' if best > 0 else 'earlier'}"
            yield (
                f"frames of {moments.first!r} and {moments.second!r} are shifted: what {moments.first!r} shows in a "
                f"frame, {moments.second!r} shows {where}"
            )


def told_apart(observations: Observations) -> Iterator[str]:
    """Descriptions of why stations may contradict one another: their frames, or the order of boards' points."""
    yield from shifted(observations)
    if every := listed_otherwise(observations):
        (station, placement), words = next(iter(every.items()))
        others = f" and at {counted(len(every) - 1, 'other')}" if len(every) > 1 else ""
        yield f"station {station!r}, placement {placement!r}{others}: {words}"
    for moments in _moments(observations):
        if is_clearly_more(moments.cost(0), moments.alike):
            stations = f"{moments.first!r} and {moments.second!r}"
            yield f"in most frames {stations} see the board at different places: {_ADVICE}"


def shown_otherwise(observations: Observations) -> dict[tuple[str, str], str]:
    """(station, placement) -> advice where another camera sees the board differently: at another placement, or with its
    points in another order.
    """
    found = listed_otherwise(observations)
    for moments in _moments(observations):
        for key, other in moments.exchanged():
            found[key] = f"it shows the board where another camera sees it at {other!r}: exchange their frames"
    return found


class _Moments:
    """Two stations, with the poses of boards by each of them, moment by moment."""

    alike = 0.15  # difference that initial estimates of equal poses may have, see `same_labels`

    def __init__(self, first: str, second: str, poses: Both) -> None:
        most = 40  # moments used, since all are compared with all, for all shifts
        self.first, self.second, self._names = first, second, list(poses)[:most]
        seen = [poses[name] for name in self._names]
        self._depth = median(np.array([np.linalg.norm(b.position) for _, b in seen]))
        # Pose of the second camera in the first one's frame, from what they show at moments i and j.
        self._between = [[b @ a.inverse for _, b in seen] for a, _ in seen]

    @property
    def most_shift(self) -> int:
        return len(self._names) // 2

    def _apart(self, pose: Pose, other: Pose) -> float:
        return apart(pose, other, self._depth)

    def _at(self, shift: int) -> list[Pose]:
        return [self._between[i][i + shift] for i in range(len(self._names)) if 0 <= i + shift < len(self._names)]

    def _off(self, shift: int) -> Array:
        """(N, N) differences of the cameras' relative pose between all moments."""
        poses = self._at(shift)
        return np.array([[self._apart(one, other) for other in poses] for one in poses])

    def cost(self, shift: int) -> float:
        """The median difference from the moment that agrees best with the others; infinite for too few moments."""
        off = self._off(shift)
        return float(np.min(np.median(off, axis=1))) if len(off) >= _FEWEST else np.inf

    def exchanged(self) -> Iterator[tuple[tuple[str, str], str]]:
        """The second station's placements that match others of the first, and these."""
        off = self._off(0)
        likeliest, usual = self._at(0)[int(np.argmin(np.median(off, axis=1)))], self.cost(0)
        suits = np.array([[self._apart(one, likeliest) for one in row] for row in self._between])
        for number, name in enumerate(self._names):
            best = int(np.argmin(suits[:, number]))
            # It must match as well as the others do: wrongly turned labels match another frame by chance.
            as_well = not is_clearly_more(suits[best, number], usual)
            if as_well and is_clearly_more(suits[number, number], suits[best, number]):
                yield (self.second, name), self._names[best]
                yield (self.first, self._names[best]), name


def _moments(observations: Observations) -> list[_Moments]:
    """The comparison of the first station with each other station that sees boards with it."""
    # quiet: this only adds a cause to what the user reads of it
    pairs = attempt(lambda: list(beside_the_first(observations, observations.targets)))
    several = [] if isinstance(pairs, CalibrationError) else pairs
    return [_Moments(*pair) for pair in several if len(pair[-1]) >= _FEWEST]
