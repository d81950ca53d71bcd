"""Find wrong names of the world's features, where observations fit together in no other way.

Points and curves may be named from different sides of the world. Or one curve has a wrong name: among many curves it is
outvoted, and its observations are taken out. Among few it is not: two lines of six under each other's names left a
camera 1 m above the field, and its right height was contradicted. But a closed form tells at once whether all curves
suit a camera, so each is tried under each other name; a curve that is observed under that one takes the first one's
name.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TypeVar

import numpy as np

from ceres_cal.base import Array, CalibrationError, Frozen, attempt, distinct, replace
from ceres_cal.calibration.lens_forms import papers
from ceres_cal.observations import Observations, gather_sights
from ceres_cal.problem import Options, problem_of
from ceres_cal.robust.robust import solve_robustly
from ceres_cal.robust.usable import NO_FIT
from ceres_cal.scene.symmetry import MIRRORED, TURNED, counterparts
from ceres_cal.start.initialise import initialise

_One = TypeVar("_One")
# Share of the observations that must fit; ratio of what they are off by to that of the next best. With two names
# exchanged among 4 to 13 curves, the ratio was 17 and more where the camera was lost.
_FITTING, _BETTER = 0.9, 10.0


class Renaming(Frozen, eq=True):
    """Another name for a curve that a station shows under a wrong one.

    Attributes:
        station, target: by name. curve, instead: the name that it has, and its own. are_exchanged: whether the other
            curve has the first one's name.
    """

    station: str
    target: str
    curve: str
    instead: str
    are_exchanged: bool

    @property
    def words(self) -> str:
        """The sentence for the user."""
        both = f"{self.curve!r} and {self.instead!r} exchange their names"
        how = both if self.are_exchanged else f"{self.curve!r} is named {self.instead!r}"
        return f"station {self.station!r}: all that it shows of the world fits together if {how}"

    def corrected(self, observations: Observations) -> Observations:
        """Return the observations with the right names."""
        names = observations.targets[self.target].curve_names
        own = [view.target == self.target and view.station == self.station for view in observations.views]
        curves = observations.curves
        seen, (one, other) = np.array(own)[curves.view], (names.index(self.curve), names.index(self.instead))
        feature = np.where(seen & (curves.feature == one), other, curves.feature)
        feature[seen & (curves.feature == other)] = one
        return observations.with_features(observations.points.feature, feature)


def relabelled(observations: Observations, image: Array) -> Observations | None:
    """Return the observations of the world with each feature replaced by the one at x, y, z times `image`; None where
    an observed feature has no such counterpart.
    """
    points, curves = observations.points, observations.curves
    p, c, side = points.feature.copy(), curves.feature.copy(), curves.side.copy()
    shown = [view.target if view.placement is None else "" for view in observations.views]
    for name in {*shown} - {""}:
        to_point, to_curve, flips = counterparts(observations.targets[name], image)
        of_it = np.array([one == name for one in shown])
        own, along = of_it[points.view], of_it[curves.view]
        p[own], c[along] = to_point[p[own]], to_curve[c[along]]
        side[along] *= flips[curves.feature[along]]
    if np.any(p < 0) or np.any(c < 0):
        return None
    return replace(observations, points=replace(points, feature=p), curves=replace(curves, feature=c, side=side))


def find_renaming(observations: Observations, options: Options) -> Renaming | None:
    """Return the only change of one name with which all curves fit together that some station shows of the world.
    Points beside them decide by themselves.
    """
    named, most_searched = _papers(options), 10  # among five curves: a search for the camera takes half a second
    for station, own, as_named in _misfits(observations, named, have_points=False):
        tried = {one: one.corrected(own) for one in _candidates(own, station)}
        exchanges = {one: seen for one, seen in tried.items() if one.are_exchanged}
        found = _only(tried, named, as_named)
        if found is None and len(exchanges) <= most_searched:
            found = _only(exchanges, named, as_named, may_search=True)
        if found:
            return found
    return None


def opposite_names(observations: Observations, options: Options) -> str | None:
    """Return in words which station's curves are named from another side of the world than its points, so that all fits
    together if the names of one of the two are turned or mirrored; None where there is none.
    """
    named = _papers(options)
    images = {"turned by half a turn": TURNED, "mirrored in x": MIRRORED, "mirrored in y": TURNED * MIRRORED}
    for station, own, as_named in _misfits(observations, named, have_points=True):
        curves = own.part(np.zeros(0, dtype=np.intp), np.arange(len(own.curves)))
        other = {words: relabelled(curves, image) for words, image in images.items()}
        tried = {words: replace(own, curves=one.curves) for words, one in other.items() if one}
        if found := _only(tried, named, as_named):
            return (
                f"station {station!r}: its points and its curves are named from different sides: all fits together if "
                f"the names of the curves, or those of the points, are {found}"
            )
    return None


def _papers(options: Options) -> Options:
    return replace(papers(options), priors=())


def _misfits(
    observations: Observations, options: Options, *, have_points: bool
) -> Iterator[tuple[str, Observations, float]]:
    """Yield each station with curves, and with or without points, whose curves no camera suits; with what it shows of
    the world, and how far (px) that is off.
    """
    for station in observations.stations:
        own = _of_world(observations.of_station(station))
        if len(own.curves) and bool(len(own.points)) == have_points:
            off = _off_by(own, options, may_search=not have_points)
            if off > NO_FIT * np.hypot(*observations.cameras[observations.stations[station]]):
                yield station, own, off


def _only(
    tried: Mapping[_One, Observations], options: Options, most: float, *, may_search: bool = False
) -> _One | None:
    """Return the only one of some changes by which all fits together."""
    off = [_off_by(one, options, may_search=may_search) for one in tried.values()]
    least, *others = np.argsort(off) if off else (0,)
    second = min([most, *(off[number] for number in others[:1])])
    return [*tried][int(least)] if off and _BETTER * off[least] < second else None


def _of_world(observations: Observations) -> Observations:
    of_world = np.array([view.placement is None for view in observations.views])
    return observations.part(of_world[observations.points.view], of_world[observations.curves.view])


def _candidates(observations: Observations, station: str) -> Iterator[Renaming]:
    """Yield each observed curve under each other name."""
    most_curves = 12  # of a station: of more, two are outvoted
    for name, target in observations.targets.items():
        own = np.array([view.target == name for view in observations.views])[observations.curves.view]
        shown = [target.curve_names[number] for number in distinct(observations.curves.feature[own])]
        for number, curve in enumerate(shown if len(shown) <= most_curves else ()):
            others = (other for other in target.curve_names if other not in shown[: number + 1])
            yield from (Renaming(station, name, curve, other, other in shown) for other in others)


def _off_by(observations: Observations, options: Options, *, may_search: bool = False) -> float:
    """Return how far (px) all but a few points and curves are off; infinite where no camera suits them."""
    sights = gather_sights(observations)

    def off_by() -> float:
        start = initialise(sights, options, may_search=may_search)
        end = solve_robustly(problem_of(sights, options, start.estimate), start.estimate, most_rounds=2)
        kinds = (np.sort(lengths) for lengths in end.residuals.lengths if len(lengths))  # NaN comes last
        off = [lengths[int(_FITTING * (len(lengths) - 1))] for lengths in kinds]
        return float(np.max(np.nan_to_num(off, nan=np.inf)))

    found = attempt(off_by)  # quiet: where there is no camera, nothing is explained
    return np.inf if isinstance(found, CalibrationError) else found
