"""Whether one feature of new observations lies beside its place: without it, the known lens explains all the others."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ceres_cal.base import Pose, distinct, replace
from ceres_cal.moves.agreement import NOISIER
from ceres_cal.moves.poses import PoseCandidate, PoseSearch, pose_candidates
from ceres_cal.observations import Observations, gather_sights
from ceres_cal.problem import make_structure

# Share of observations that may be rejected where another lens is said to explain the rest. Nothing changes from half
# to double.
FEW = 0.2
# Nats by which another explanation must be better than one that the user stated: a factor of 20 000. Nothing changes
# from half to double. Where nothing was stated the better one is taken: a freed number has its price already.
SUPPORTED = 10.0


def is_good(candidate: PoseCandidate, known: float) -> bool:
    """Return whether a pose explains the observations about as well as the old calibration did its own, and better than
    the known lens and labels, whose least misfit is `known`: stray observations fit neither.
    """
    return candidate.fits and candidate.scale < NOISIER and candidate.misfit < known - SUPPORTED


def seen_as(search: PoseSearch, observations: Observations) -> PoseSearch:
    """Return the search with renamed observations or exchanged targets; the structure of targets is left out."""
    sights = gather_sights(observations)
    number = sights.keys.index(search.sight.key)
    estimate = replace(search.estimate, structure=make_structure(observations.targets, {}))
    return replace(search, sight=sights[number], estimate=estimate)


class Without(NamedTuple):
    """A search without one feature: its label, and poses with the known lens, the best one first."""

    label: str
    search: PoseSearch
    candidates: list[PoseCandidate]

    def is_better(self, known: float) -> bool:
        """Return whether all else is explained by the known lens, and far better than with it, `known` nats."""
        all_else = 0.9  # share of the others: with more strays it is not this feature that is wrong
        return bool(self.candidates) and is_good(self.candidates[0], known) and self.candidates[0].share > all_else

    @property
    def misfit(self) -> float:
        """The least one, in nats; infinite without a pose."""
        return min((one.misfit for one in self.candidates), default=np.inf)

    @property
    def words(self) -> str:
        """What is wrong, and what to do."""
        what = "it lies beside its place or has a wrong label, unless the lens is wrong there"
        return f"without {self.label} they do: {what}: correct or remove it"


def without_worst(search: PoseSearch, old: list[Pose]) -> Without | None:
    """Return the search without the feature that its best pose explains worst; None without a pose or feature left."""
    fewest = 8  # features: without one of them the others still determine the pose by far
    best = pose_candidates(search, old, patience=0)[:1]
    sight, seen = search.sight, search.sight.observations
    if not best or len(sight.point_rows) + len(distinct(sight.track_index)) < fewest:
        return None
    columns = seen.points.feature, seen.curves.feature
    rows, sigmas = (sight.point_rows, sight.curve_rows), search.residuals(best[0].pose).in_sigmas(sight, search.scales)
    nats = [
        np.bincount(feature[own], np.log1p(np.minimum(np.nan_to_num(off, nan=np.inf), 1e6) ** 2))
        for feature, own, off in zip(columns, rows, sigmas, strict=True)
    ]
    which = int(np.argmax([one.max(initial=0.0) for one in nats]))
    feature = int(np.argmax(nats[which]))
    gone = rows[which][columns[which][rows[which]] == feature]
    kept = [np.ones(len(own), dtype=bool) for own in columns]
    kept[which][gone] = False
    kind = "curve" if which else "point"
    label = f"{kind} {seen.feature_name(kind, int(gone[0]))!r}"
    rest = seen_as(search, seen.part(*kept))
    return Without(label, rest, pose_candidates(rest, old, patience=0))
