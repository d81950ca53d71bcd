"""Find views that are displaced individually, as by a stabilised lens or a rolling shutter.

A stabilised lens or sensor is shifted against the hand's motion, by some pixels in each picture. What a hand moves is
sheared while rows are read out one after the other (a rolling shutter). In each view of a board, the principal point
and the motion during the read-out are random effects with sigmas that all views of a camera share: a shift of the
picture, which is nearly all of it, and turns, which a pose hides less. Further random effects are smooth displacements
of each view, and those that all views have alike, which are due to the lens. The evidence of each is computed beside
the others (`effects.evidence`): by itself, the principal point of any camera seems to move where views err smoothly.
Where it moves, or where the read-out explains more of the residuals than everything else, best linear unbiased
predictions are subtracted from the observations, and everything else is solved for again (Henderson, Biometrics 31,
1975). The uncertainty of these predictions is added to the covariance of the shared numbers.

Nothing is subtracted where the resulting lens predicts left-out views much worse: then the lens model was wrong, as for
a fisheye whose rays do not meet in one point.

Smooth displacements, and a read-out that explains less, are not subtracted. They are found in nearly all public
photographs of boards, but without them lenses predict other views worse.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from functools import cache, partial
from itertools import pairwise

import numpy as np

from ceres_cal.base import Array, Frozen, Mask, eigh, first_of, inverse_of, replace, two_digits
from ceres_cal.effects import (
    Linearised,
    SparseColumns,
    Weights,
    equation_weights,
    make_linear_model,
    places_in_view,
    posed,
    smooth_image,
    smooth_view,
)
from ceres_cal.effects.effect import Amount, Case, EffectEstimate
from ceres_cal.effects.evidence import (
    CENTRE_MOVES,
    LENS_LEAVES,
    LIKELY,
    READ_OUT,
    SMOOTH_ERRORS,
    Others,
    RepeatedAmounts,
    shifts_by,
)
from ceres_cal.effects.table.lens import lens_changes
from ceres_cal.observations import Observations
from ceres_cal.problem import Estimate, Key, Problem, free_keys
from ceres_cal.problem.residuals import Equations, Residuals, residuals, write_equations
from ceres_cal.robust.as_built import ViewEffects
from ceres_cal.robust.robust import RobustSolution

MOVES, ROLLING = "principal point moves", "rolling shutter"
_KINDS = (MOVES, ROLLING)
_MOVES_WORDS = (
    "its principal point moves by {px} px from view to view, as with optical or digital stabilisation (corners move "
    "most in {named}). The stated point is the average; that of a single picture may differ by as much. Switch "
    "stabilisation off"
)
_ROLLING_WORDS = (
    "its pictures are distorted by {px} px rms, each differently, as by a rolling shutter while the camera or the "
    "target moves (most in {named}). A point in a single picture may be off by as much. Hold both still"
)
# Coefficients of a view, in their order: name, number and prior. The smooth displacements of all views come last.
_CENTRE_OF_VIEW, _READ_OUT, _TURNS = "principal point", "read-out", "read-out, turns"
_MODES = {
    _CENTRE_OF_VIEW: (2, CENTRE_MOVES),
    _READ_OUT: (2, READ_OUT),
    _TURNS: (6, SMOOTH_ERRORS),
    "smooth": (10, SMOOTH_ERRORS),
}
_IMAGE = "image"
_OF_MODE = np.repeat(list(_MODES), [count for count, _ in _MODES.values()])
_CENTRE = [2, 3]  # positions of the principal point in the intrinsics vector
_FEWEST, _ENOUGH = 5, 20  # views of a camera: the least that are tested, and those that determine the sigmas
_LEAST_PX = 3.0  # least sigma of a moving principal point: no lens is stabilised for a third of an arc minute
_TOLD = 1e-4  # share of the largest eigenvalue above which a direction is determined beside the poses
_NONE_PX = 1e-6  # sigma of coefficients that are absent

Sizes = Mapping[str, float]
"""Sigma (px) of each likely kind of coefficients of a camera."""


class ViewDisplacement(Frozen):
    """Displacements of views, for cameras whose principal point moves or whose shutter rolls.

    Attributes:
        sizes: camera -> sigmas. displacement: (N + M, 2) px by which the observations are moved. taken_up: degrees of
            freedom that this uses. keys, shifts: (R, K) of the shared numbers; the outer products of the shifts are
            added to their covariance.
    """

    sizes: Mapping[str, Sizes]
    displacement: Array
    taken_up: float
    keys: Sequence[Key]
    shifts: Array

    def taken_off(self, problem: Problem) -> Problem:
        """The problem with the displacement subtracted from its observations."""
        points = len(problem.observations.points)
        sights = problem.sights.displaced(-self.displacement[:points], -self.displacement[points:])
        return replace(problem, sights=sights, taken_up=self.taken_up)

    @property
    def of_views(self) -> ViewEffects:
        """The displacement for another linear model, see `ViewEffects`."""
        return ViewEffects(self.displacement, self._columns)

    def _columns(self, model: Linearised) -> tuple[SparseColumns, Others]:
        columns, keys = _of_views(model), model.equations.sights.keys
        of_mode = np.tile(_OF_MODE, len(keys))
        camera = np.repeat([key.camera if key.placement else "" for key in keys], len(_OF_MODE))
        likely = ((name, kind, sigma) for name, one in self.sizes.items() for kind, sigma in one.items())
        each = [(np.flatnonzero((camera == name) & (of_mode == kind)), sigma) for name, kind, sigma in likely]
        return columns, [(numbers, sigma) for numbers, sigma in each if len(numbers)]

    def estimates(self, observations: Observations) -> tuple[EffectEstimate, ...]:
        """One estimate for each camera, with its sentence."""
        points = observations.points
        views, moved = len(observations.views), np.sum(self.displacement[: len(points)] ** 2, axis=1)
        count = np.bincount(points.view, minlength=views)
        rms = np.sqrt(np.bincount(points.view, moved, views) / np.maximum(count, 1))
        return tuple(self._estimate(observations, rms, camera) for camera in self.sizes)

    def _estimate(self, observations: Observations, rms: Array, camera: str) -> EffectEstimate:
        own = [number for number, view in enumerate(observations.views) if view.camera == camera and rms[number] > 0.0]
        worst = sorted(own, key=lambda number: -float(rms[number]))
        named = first_of([f"{observations.views[n].frame!r}, {two_digits(rms[n])} px" for n in worst], 3)
        sizes = self.sizes[camera]
        every = tuple(Amount(kind, float(sigma), 0.0, "px") for kind, sigma in sizes.items())
        if _centre_moves(sizes):
            kind, size_px, words = MOVES, sizes[_CENTRE_OF_VIEW], _MOVES_WORDS
        else:
            kind, size_px, words = ROLLING, float(np.sqrt(np.mean(rms[own] ** 2))), _ROLLING_WORDS
        sentence = f"camera {camera!r}: {words.format(px=two_digits(size_px), named=named)}"
        return EffectEstimate(kind, camera, None, float(size_px), 1.0, sentence, every)


def _centre_moves(sizes: Sizes) -> bool:
    return sizes.get(_CENTRE_OF_VIEW, 0.0) > _LEAST_PX


def find_unsteady(problem: Problem, end: RobustSolution, before: ViewDisplacement | None) -> ViewDisplacement | None:
    """The displacement of cameras whose views are likely displaced; None where there is none.

    Args:
        problem: of all the observations, with what was found `before` subtracted. end: of its rounds.
    """
    estimate = end.estimate

    def seen(some: Problem, there: Estimate = estimate) -> tuple[Equations, Weights]:
        return _equations(there, end.residuals, end.weights_of, before, some, problem.private)

    @cache
    def modelled(some: Problem) -> Linearised:
        return make_linear_model(some, estimate, *seen(some))

    # Squared errors with which the others predict a view, relative to those with nothing subtracted: 0.4 to 1.6 in
    # simulations of both kinds, 0.4 to 1.5 for a GoPro and a Sony held by hand. For a public fisheye rig it is 2.5 to
    # 40: what seemed to move was the lens's error, and left-out views were predicted up to six times worse.
    much_worse = 2.0
    sizes, noise = {}, 0.0
    for camera in problem.sights.cameras:
        sights = problem.sights.numbers(camera)
        boards = [number for number in sights.tolist() if problem.sights.keys[number].placement is not None]
        if len(boards) < _FEWEST:
            continue
        chosen = boards[:: -(-len(boards) // _ENOUGH)]
        some = problem if len(chosen) == len(problem.sights) else problem.of_sights(np.array(chosen))
        if before is not None or _seem_displaced(*seen(*some.built_as(estimate))):
            model = modelled(some)
            if before is None and any(lens_changes(Case(some, estimate, model))):
                continue  # pictures of two cameras were joined, or the lens was touched: `diagnose` says so
            own, left = _sizes(model, smooth_image(model.equations, estimate))
            if own and _told(model, estimate, {camera: own}, left).mispredicts(left) < much_worse:
                sizes[camera], noise = own, max(left, noise)
    if not sizes:
        return None
    return _predicted(modelled(problem), problem, estimate, sizes, noise)


def without_unsteadiness(
    problem: Problem, estimate: Estimate, taking_part: tuple[Mask, Mask], effects: Sequence[EffectEstimate]
) -> Problem:
    """The problem of all the observations, with the displacements of the estimated effects subtracted."""
    sizes = {one.subject: {a.name: a.value for a in one.amounts} for one in effects if one.kind in _KINDS}
    if not sizes:
        return problem
    there = residuals(problem.sights, estimate)
    weights_of = partial(equation_weights, problem.weighting, there=there, taking_part=taking_part)
    speaking = _equations(estimate, there, weights_of, None, problem, problem.private)
    model = make_linear_model(problem, estimate, *speaking)
    return _predicted(model, problem, estimate, sizes, 1.0).taken_off(problem)


def _equations(
    estimate: Estimate,
    there: Residuals,
    weights_of: Callable[[Equations], Weights],
    before: ViewDisplacement | None,
    problem: Problem,
    seen_once: Collection[str | None],
) -> tuple[Equations, Weights]:
    """Equations and weights of a problem's sights, with the residuals `before` anything was subtracted. Views that were
    rejected as a whole take part again, since they may be the most displaced. A view of a placement that is not
    `seen_once` does not: another camera determines that placement, and a contradicting view may be of another moment.
    Inliers have full weight: a robust weight would reduce observations of displaced views.
    """
    equations = write_equations(problem.sights, estimate, there)
    if before is not None:
        equations = replace(equations, residual=equations.residual - equations.along(before.displacement))
    weights = weights_of(equations)
    silent = np.bincount(equations.sight, weights.used, len(equations.bounds) - 1) == 0.0
    silent &= [key.placement in seen_once for key in equations.sights.keys]
    used = weights.used | silent[equations.sight]
    return equations, Weights(weights.inverse_sigma, used, np.ones_like(weights.robust))


def _modes(equations: Equations, *, smooth: bool = True) -> list[Array]:
    """(E, 20) px per px of each coefficient of a view, side by side: x and y of the principal point; a shift of the
    picture, and a turn and a shift of the pose, that grow from row to row; and, if `smooth`, polynomials along both
    axes of the image.
    """
    place = places_in_view(equations)
    turns = equations.pose * place[:, 1:]
    turns /= np.sqrt(np.maximum(np.einsum("ei,ei->i", turns, turns) / len(place), 1e-300))
    modes = [equations.intrinsics[:, _CENTRE], equations.direction * place[:, 1:], turns]
    if smooth:
        modes.append(smooth_view(equations, place).reshape(len(place), -1))
    return modes


def _seem_displaced(equations: Equations, weights: Weights) -> bool:
    """A quick test whether views may be displaced, with only poses free: half of all squares are explained by the
    read-out, or principal points seem to move by the method of moments: their scores have the variance T + T^2 sigma^2.
    Beside other displacements of views they move by less.
    """
    columns = np.column_stack([*_modes(equations, smooth=False), equations.pose, equations.residual])
    columns *= (weights.inverse_sigma * weights.used)[:, None]
    left = posed(np.array([columns[start:stop].T @ columns[start:stop] for start, stop in pairwise(equations.bounds)]))
    whole_told, scores, squares = left[:, :-1, :-1], left[:, :-1, -1], left[:, -1, -1]
    values, axes = eigh(whole_told[:, 2:, 2:])
    along = (scores[:, None, 2:] @ axes)[:, 0]
    known = values > _TOLD * values[:, -1:]
    taken = np.sum(along[known] ** 2 / values[known])
    told, score = np.maximum(np.diagonal(whole_told, axis1=1, axis2=2)[:, :2], 1e-300), scores[:, :2]
    mean = np.sum(score, axis=0) / np.sum(told, axis=0)
    moved = float(np.sum((score - told * mean) ** 2 / told - 1.0))
    moves = moved > (0.75 * _LEAST_PX) ** 2 * float(np.sum(told))
    return bool(2.0 * taken > np.sum(squares)) or moves


def _of_views(model: Linearised) -> SparseColumns:
    """The columns of the coefficients of each view, one view after the other."""
    equations = model.equations
    weighted = np.hstack(_modes(equations)) * model.weight[:, None]
    return SparseColumns.of_groups(model, weighted, equations.sight, len(equations.bounds) - 1)


def _sizes(model: Linearised, image: Array) -> tuple[Sizes, float]:
    """Sigmas of the likely kinds, each beside the others, where principal points move or the read-out explains most,
    and the mean square of the noise beside all of them.

    Args:
        model: of some views. image: (E, I) smooth displacements that all views have alike.
    """
    # Ratio of the squares explained by the read-out to those of everything else, and number of views, from which on the
    # read-out is subtracted. Halves of a GoPro set held by hand have 3.7 to 44. Half of a public fisheye set has 0.7 to
    # 1.9, because of stray corners; if subtracted, phi of two halves differed by six standard deviations. At 1.5, in 15
    # views of a public stereo camera, lenses predict other views worse by a tenth. Fewer views may show errors of the
    # lens or of the target.
    says_most, enough_views = 2.5, 10
    of_views, views = _of_views(model), len(model.equations.bounds) - 1
    together = np.zeros(len(image), dtype=np.int64)
    alike = SparseColumns.of_groups(model, image * model.weight[:, None], together, 1)
    repeated = RepeatedAmounts.of(model, SparseColumns.side_by_side([of_views, alike], len(image)))
    if repeated.spare < len(_OF_MODE):
        return {}, 1.0
    numbers = {kind: np.flatnonzero(np.tile(kind == _OF_MODE, views)) for kind in _MODES}
    numbers = {_IMAGE: of_views.size + np.arange(alike.size), **numbers}
    priors = {_IMAGE: LENS_LEAVES, **{kind: prior for kind, (_, prior) in _MODES.items()}}
    each = repeated.scatters(numbers, priors, _TOLD)
    found = {kind: sigma for kind, (sigma, probability) in each.items() if probability > LIKELY}
    squares = {
        kind: sigma**2 * np.trace(repeated.information[np.ix_(*2 * [numbers[kind]])]) for kind, sigma in found.items()
    }
    read_out = squares.get(_READ_OUT, 0.0) + squares.get(_TURNS, 0.0)
    by_others = repeated.rest + sum(squares.values()) - squares.get(_IMAGE, 0.0) - read_out
    rolling = views >= enough_views and read_out > says_most * by_others
    return (found if rolling or _centre_moves(found) else {}), repeated.noise


class _ViewSums(Frozen):
    """Sums over the equations of each of S views: about its C coefficients, beyond its pose, and P shared directions.

    Attributes:
        model: with smooth displacements that all views have alike. modes: (E, C) px per px of each coefficient.
        products: (S, C + P + 1, C + P + 1) of coefficients, shared directions and residuals, over the noise.
        left_open: (S, C, C) covariance of the coefficients given the rest, (T + 1 / sigma^2)^-1.
    """

    model: Linearised
    modes: Array
    products: Array
    left_open: Array

    @property
    def told(self) -> Array:
        """(S, C, C) T, the information on the coefficients."""
        return self.products[:, : self._width, : self._width]

    @property
    def common(self) -> Array:
        """(S, C, P) G, the products of coefficients and shared directions."""
        return self.products[:, : self._width, self._width : -1]

    @property
    def slope(self) -> Array:
        """(S, C, 1) half the derivative of the squares by the coefficients."""
        return self.products[:, : self._width, -1:]

    @property
    def _width(self) -> int:
        return int(self.modes.shape[1])

    def mispredicts(self, noise: float) -> float:
        """Squares that views leave when the others determine what is shared, over those with nothing subtracted."""
        alone = self.products[:, self._width :, self._width :]
        across = self.products[:, : self._width, self._width :]
        prior = np.eye(alone.shape[1] - 1) - np.sum(alone[:, :-1, :-1], axis=0)
        slope = self.model.step / np.sqrt(noise) - np.sum(alone[:, :-1, -1], axis=0)

        def squares(each: Array) -> float:
            others = np.sum(each, axis=0) - each
            steps = np.array([-inverse_of(prior + o[:-1, :-1]) @ (slope + o[:-1, -1]) for o in others])
            ahead = np.column_stack([steps, np.ones(len(steps))])
            return float(np.einsum("si,sij,sj->", ahead, alone, ahead))

        return squares(alone - across.transpose(0, 2, 1) @ self.left_open @ across) / squares(alone)


def _told(own: Linearised, estimate: Estimate, sizes: Mapping[str, Sizes], noise: float) -> _ViewSums:
    """The sums of a model's views at these sizes and this mean square of the noise."""
    equations, image_px = own.equations, max(one.get(_IMAGE, _NONE_PX) for one in sizes.values())
    model = own.with_columns(smooth_image(equations, estimate), image_px / np.sqrt(noise))
    modes = np.hstack(_modes(equations))
    beyond = model.beyond_private(modes * model.weight[:, None])
    every = np.column_stack([beyond, model.shared * np.sqrt(noise), model.placed_score]) * model.used[:, None]
    parts = [every[start:stop] for start, stop in pairwise(equations.bounds)]
    products = np.array([part.T @ part for part in parts]) / noise
    sigma = np.array([_of_sight(sizes.get(key.camera, {}) if key.placement else {}) for key in equations.sights.keys])
    width = modes.shape[1]
    left_open = inverse_of(products[:, :width, :width] + np.eye(width) * sigma[:, None] ** -2.0)
    return _ViewSums(model, modes, products, left_open)


def _predicted(
    own: Linearised, problem: Problem, estimate: Estimate, sizes: Mapping[str, Sizes], noise: float
) -> ViewDisplacement:
    """The best linear unbiased predictions at these sizes and this mean square of the noise, with everything that is
    free at its best.

    The information on the shared directions is 1 - sum of G^T C G (see `_ViewSums`); their step corrects the
    coefficients.
    """
    equations, all_told = own.equations, _told(own, estimate, sizes, noise)
    model, modes, common, slope = all_told.model, all_told.modes, all_told.common, all_told.slope
    through = all_told.left_open @ common
    covariance = np.linalg.inv(np.eye(model.shared.shape[1]) - np.sum(common.transpose(0, 2, 1) @ through, axis=0))
    step = model.step / np.sqrt(noise) - np.sum(through.transpose(0, 2, 1) @ slope, axis=0)[:, 0]
    coefficients = through @ (covariance @ step) - (all_told.left_open @ slope)[:, :, 0]
    moved = np.sum(modes * coefficients[equations.sight], axis=1)
    moved = model.beyond_private((moved * model.weight)[:, None])[:, 0] / model.weight  # what poses do not absorb
    return ViewDisplacement(
        sizes,
        equations.displacement(moved, problem.observations.rows),
        float(np.einsum("sij,sji->", all_told.told, all_told.left_open)),
        free_keys(estimate, problem.layout, problem.private),
        _shifts(own, common, through, covariance) * np.sqrt(noise),
    )


def _of_sight(sizes: Sizes) -> Array:
    """(20,) the sigma of each coefficient of a view."""
    return np.array([sizes.get(kind, _NONE_PX) for kind in _OF_MODE.tolist()])


def _shifts(own: Linearised, common: Array, through: Array, covariance: Array) -> Array:
    """(R, K) by how much the uncertainty of the coefficients moves the shared numbers, over the noise."""
    taken = common[:, :, : own.shared.shape[1]].transpose(0, 2, 1)
    across = np.sum(taken @ through, axis=0)
    alone = across[:, : taken.shape[1]]
    return shifts_by(own.root, alone + across @ covariance @ across.T)
