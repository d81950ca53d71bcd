"""Whether the followed lines are where the target says: which are off their nominal position, which dimensions differ.

One linear model contains the camera and all that may be painted differently: every curve's offset, and the target's own
dimensions, which move several curves at once. The camera is projected out. The evidence (marginal likelihood) of the
residuals then decides between curves that scatter as paint usually does, single misplaced curves, and different
dimensions: a spike and slab prior (Mitchell and Beauchamp, JASA 83, 1988), whose sets are searched by beam.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ceres_cal.base import Array, CalibrationError, Frozen, Indices, SolutionError, attempt, distinct, median, replace
from ceres_cal.detect.lines import Lines
from ceres_cal.detect.photographs.refit import observations_of, problem_of
from ceres_cal.effects.evidence import RandomEffects
from ceres_cal.effects.linearised import Weights, make_linear_model
from ceres_cal.observations import Prior
from ceres_cal.problem import dimension_slopes, dimensions_of, intrinsic_names
from ceres_cal.problem.residuals import residuals, whole_structure, write_equations
from ceres_cal.scene import Camera, Target
from ceres_cal.scene.targets.target import PAINT_WANDERS

# In units of the usual offset of a misplaced curve: candidates for the scatter of all paint about its drawing; and the
# largest root sum of squares of all misplaced curves' offsets, beyond which this is another field.
_SCATTER, _FARTHEST = PAINT_WANDERS * 0.5 ** np.arange(4.0, -0.5, -0.5), 3.0
_OTHER = 0.1  # prior standard deviation of a dimension that differs, as a share of the dimension
_LOG_ODDS = np.log(0.1 / 0.9)  # prior log odds that a curve is misplaced, or that a dimension differs
# Beam search: number of sets that are extended, largest number of parts of a set, and number of further parts without
# improvement after which the search ends. Of 46 pictures one needed the third, where misplaced lines hide one another.
_BEAM, _MOST, _IN_VAIN = 24, 9, 3
# Least change of a dimension that makes another field: as a share of it, and in units of the usual offset of a
# misplaced curve. A tape measure, an unusual lens and a floor that is not flat cause smaller changes, and the standard
# deviation contains none of these: through a decentred lens, 9 m seemed 9.073 with one of 2 mm.
_OTHER_FIELD, _LONGER = 0.02, 4.0
# Least change of a dimension in its standard deviations, which assume that lines are taped independently of each other.
_SURELY = 10.0
_APART, _ALIKE = 40, 0.1  # largest distance, in places, and least correlation at which errors count as correlated


class FieldAsBuilt(Frozen):
    """The most likely explanation of where the curves lie.

    Attributes:
        aside_m: name of a misplaced curve -> its offset from its drawing, m.
        dimensions: name of a dimension that differs from the target's -> its most likely value, m.
        sd_m: name of each of those curves and dimensions -> its standard deviation, m.
        drawn: name of a dimension -> its value in the target, m. names: of the curves used.
        usual_m: usual offset of a misplaced curve, m. scatter_m: standard deviation of the other curves' offsets, m; 0
            where none is seen.
        wander_m: standard deviation of the lines' deviations, m, that none of this nor the stated sigmas explain;
            infinite where the camera shows no line.
    """

    aside_m: Mapping[str, float]
    dimensions: Mapping[str, float]
    sd_m: Mapping[str, float]
    drawn: Mapping[str, float]
    names: tuple[str, ...]
    usual_m: float
    scatter_m: float = 0.0
    wander_m: float = 0.0

    @property
    def laid_m(self) -> Mapping[str, float]:
        """Name of a curve -> the standard deviation of its offset from its drawing, m, for curves that may have one."""
        every = self.names if self.scatter_m else ()
        return dict.fromkeys(every, self.scatter_m) | dict.fromkeys(self.aside_m, self.usual_m)

    @property
    def is_other(self) -> bool:
        """Whether this is another field: a dimension differs by too much for a tape measure, lines are misplaced
        everywhere, or they are bent as by no lens.
        """
        changed = any(map(self._is_unusual, self.dimensions))
        far = float(np.linalg.norm(list(self.aside_m.values())))
        elsewhere = far > _FARTHEST * self.usual_m or 2 * len(self.aside_m) > len(self.names)
        return changed or elsewhere or self._is_bent

    def _is_unusual(self, dimension: str) -> bool:
        """Whether a dimension differs by more than a tape measure, an unusual lens and a floor that is not flat do."""
        drawn_m = self.drawn[dimension]
        usual_m = max(_SURELY * self.sd_m[dimension], min(_OTHER_FIELD * drawn_m, _LONGER * self.usual_m))
        return abs(self.dimensions[dimension] - drawn_m) > usual_m

    @property
    def _is_bent(self) -> bool:
        """Whether the lines wander farther than paint scatters. Tape laid by hand wanders by 3 mm on a field of 9 m."""
        return not self.wander_m < _SCATTER[-1] * self.usual_m

    def words(self) -> tuple[str, ...]:
        """One sentence for each dimension and each curve that differs from the drawing."""
        dimensions = [
            f"{_spoken(name)} is {_change(length / self.drawn[name])} than the target says, "
            f"{length:.3f} ± {self.sd_m[name]:.3f} m instead of {self.drawn[name]:g}: other dimensions?"
            if self._is_unusual(name)
            else f"{_spoken(name)} seems {_change(length / self.drawn[name])} than the target says "
            f"({self.drawn[name]:g} m): it differs, or the lens is unusual, or the floor is not flat"
            for name, length in self.dimensions.items()
        ]
        curves = [
            f"{name} lies {1e3 * abs(aside):.0f} ± {1e3 * self.sd_m[name]:.0f} mm off its nominal position"
            for name, aside in self.aside_m.items()
        ]
        bent = f"its lines are bent, which no lens explains, by {1e3 * self.wander_m:.0f} mm"
        return (*dimensions, *curves, *([bent] if self._is_bent else []))


AS_DRAWN = FieldAsBuilt({}, {}, {}, {}, (), np.inf)
"""The state in which nothing is known of how a target is painted."""


def _spoken(name: str) -> str:
    """center_circle_radius_m -> the center circle radius"""
    return f"the {name.removesuffix('_m').replace('_', ' ')}"


def _change(factor: float) -> str:
    return f"{100.0 * abs(factor - 1.0):.1f} % {'larger' if factor > 1.0 else 'smaller'}"


def as_built(lines: Lines, camera: Camera, target: Target, priors: tuple[Prior, ...]) -> FieldAsBuilt:
    """Estimate from the lines that were found how the target is painted; as drawn where they do not determine it.

    All of the camera but its aspect and skew is free.

    Args:
        priors: on the camera's intrinsics.
    """
    together = 4.0  # least number of neighbouring places whose errors are correlated
    least_sigma_px = 0.05  # least sigma of a place on a curve: the accuracy of a model of its shape
    determined = 1e-12  # share of the trace of the curves' normal matrix, below which information is rounding
    rows = lines.found
    sigma = np.sqrt(together) * np.maximum(lines.sigma_px[rows], least_sigma_px)
    seen = observations_of(target, camera.image_size, lines.course.curve[rows], lines.pixels[rows], sigma)
    free = tuple(name for name in intrinsic_names(camera.lens) if name not in ("aspect", "skew"))
    problem, estimate = problem_of(camera, seen, free, priors)
    left = residuals(problem.sights, estimate)
    # reads: "..." of `FieldAsBuilt.words`: this is another field
    equations = attempt(lambda: write_equations(problem.sights, estimate, left), SolutionError)
    if isinstance(equations, CalibrationError):
        return replace(AS_DRAWN, wander_m=np.inf)
    every = np.ones(len(equations), dtype=bool)
    weights = Weights(1.0 / sigma[equations.observation], every, np.ones(len(equations)))
    model = make_linear_model(problem, estimate, equations, weights)
    structure = whole_structure(seen.targets)
    columns = equations.structure_columns(structure)
    there = np.flatnonzero(np.any(columns != 0.0, axis=0))
    normal, slope = model.left_of(columns[:, there])
    # Residuals of lines that no offset straightens show wavy tape, or another lens.
    bent = model.with_columns(columns[:, there])
    misfit = float(bent.left_over @ bent.left_over) / max(bent.spare, 1)
    noise = max(1.0, misfit) * max(1.0, _places_together(bent.left_over, equations.feature) / together)
    _, moves = dimension_slopes(structure.names, seen.targets, dimensions_of(seen.targets))
    owner = np.array([_curve_of(structure.names[row]) for row in there])
    effects = RandomEffects.of(normal / noise, slope / noise, determined * float(np.trace(normal)) / noise)
    wander_m = _wander_m(lines, target, bent.left_over * sigma[equations.observation], equations.observation)
    return replace(_explained(effects, owner, moves[there], target), wander_m=wander_m)


def _wander_m(lines: Lines, target: Target, left_px: Array, places: Indices) -> float:
    """Standard deviation, m, of the paint's deviation from the drawing, from the residuals of the places that were
    found; 0 up to twice the stated sigma, which a calibration estimates as noise.
    """
    # Median of the absolute value of a normal variable, in its standard deviations.
    found, usual = lines.take(lines.found).take(places), 0.6745
    times = median(np.abs(left_px) / found.sigma_px) / usual
    wide_m = np.array([target.curves[name].width_m for name in target.curve_names])
    left_m = np.abs(left_px) * wide_m[found.course.curve] / found.course.width_px
    return median(left_m) / usual * (1.0 - times**-2) ** 0.5 if times > 2.0 else 0.0


def _places_together(residuals: Array, curve: Indices) -> float:
    """How many neighbouring places count as one: the sum of their correlations until these have fallen to nothing."""
    products, pairs = np.zeros(_APART), np.zeros(_APART)
    for number in distinct(curve):
        own = residuals[curve == number]
        for apart in range(min(_APART, len(own))):
            products[apart] += float(own[: len(own) - apart] @ own[apart:])
            pairs[apart] += len(own) - apart
    correlation = products / np.maximum(pairs, 1.0) * pairs[0] / max(products[0], 1e-300)
    ends = int(np.argmax(np.append(correlation, 0.0) < _ALIKE))
    return float(1.0 + 2.0 * np.sum(correlation[1:ends]))


def _curve_of(name: str) -> str:
    """field/CenterCircle.x -> CenterCircle"""
    return name.partition("/")[2].partition(".")[0]


def _explained(effects: RandomEffects, owner: Array, moves: Array, target: Target) -> FieldAsBuilt:
    """Find the set of curves and dimensions with the most evidence.

    Args:
        effects: Q numbers of curves, with the camera projected out. owner: (Q,) names of the curves.
        moves: (Q, D) derivatives of the numbers by the target's dimensions.
    """
    curves, drawn, usual_m = list(dict.fromkeys(owner.tolist())), dict(target.dimensions), target.usual_aside_m
    moving = {name: column for name, column in zip(drawn, moves.T, strict=True) if np.any(column != 0.0)}
    roots = [usual_m * np.eye(len(owner))[:, owner == name] for name in curves]
    roots += [_OTHER * drawn[name] * column[:, None] for name, column in moving.items()]
    names, (chosen, scatter_m) = [*curves, *moving], _searched(effects, roots, usual_m)
    together = np.hstack([np.empty((len(owner), 0)), *(roots[n] for n in chosen)])
    mean, sd = effects.amounts(together, scatter_m)
    aside, dimensions, sds, at = {}, {}, {}, 0
    for number in chosen:
        name, size = names[number], roots[number].shape[1]
        values, own = mean[at : at + size], sd[at : at + size]
        at += size
        if number < len(curves):
            worst = int(np.argmax(np.abs(values)))
            aside[name] = usual_m * float(values[worst])
            sds[name] = usual_m * float(own[worst])
        else:
            dimensions[name] = drawn[name] * (1.0 + _OTHER * float(values[0]))
            sds[name] = drawn[name] * _OTHER * float(own[0])
    scatter_m *= scatter_m > _SCATTER[0] * usual_m
    return FieldAsBuilt(aside, dimensions, sds, drawn, tuple(curves), usual_m, scatter_m)


def _searched(effects: RandomEffects, roots: Sequence[Array], usual_m: float) -> tuple[list[int], float]:
    """Return the best set of the parts, each a root (Q, Z) of a covariance, and the scatter of paint beside it, m."""
    width = max((root.shape[1] for root in roots), default=1)
    padded = [np.pad(root, ((0, 0), (0, width - root.shape[1]))) for root in roots]
    modes = effects.modes(np.array(padded).reshape(len(roots), len(effects.turn), width))
    beam: list[frozenset[int]] = [frozenset()]
    scatters_m = _SCATTER * usual_m
    best, most, seen = frozenset[int](), -np.inf, list[Array]()
    for _ in range(_MOST + 1):
        sets = np.swapaxes(modes[np.array([sorted(one) for one in beam], dtype=int)], 1, 2)
        evidence = effects.log_evidence(sets.reshape(*sets.shape[:2], len(beam[0]) * width), scatters_m)[:, 0]
        seen.append(evidence + _LOG_ODDS * len(beam[0]))
        score = seen[-1].max(axis=1)
        order = np.argsort(-score)
        if score[order[0]] > most:
            best, most = beam[order[0]], float(score[order[0]])
            likeliest = int(np.argmax(evidence[order[0]]))
        if len(beam[0]) - len(best) >= _IN_VAIN:
            break
        kept = [beam[row] for row in order[:_BEAM]]
        beam = list({one | {n} for one in kept for n in range(len(roots)) if n not in one})
        if not beam:
            break
    likely = np.exp(np.concatenate(seen) - most).sum(axis=0)
    scatter_m = float(np.sqrt(np.average(scatters_m**2, weights=likely))) if likeliest else float(scatters_m[0])
    return sorted(best), scatter_m
