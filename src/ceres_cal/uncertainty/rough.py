"""By how much numbers are off where a lens is rougher than its model follows.

What a lens that is too smooth leaves displaces an image in the same way in all views: no number of views makes that
less. Bumps along the radius and over the image are columns X beside the free numbers; their coefficients scatter by tau
(px). With P what all free numbers leave, the residuals r say u = X^T P r of them, and

    Cov u = kappa V + tau^2 V V,    V = X^T P X,

kappa for what goes together within a view. The restricted likelihood of tau, of each kind of bumps, says how rough the
lens is. By what the free numbers take up of them they are off.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ceres_cal.base.arrays import Array, Mask
from ceres_cal.effects.evidence import likeliest_sizes
from ceres_cal.model.equations import Equations, equations_of
from ceres_cal.model.keys import Key
from ceres_cal.observations import Observations
from ceres_cal.scene.camera import Camera
from ceres_cal.solve import ReducedInformation, RobustSolution, information
from ceres_cal.solve.in_cells import AGREES, agreement, agreement_in_rings
from ceres_cal.solve.linear_model import LinearModel, equation_weights, without_shared
from ceres_cal.uncertainty.sample import known_root

_MOST_EQUATIONS = 12_000  # that tell how rough a lens is: of more, those of some views
_ALONG, _OVER = (
    36,
    (6, 12, 24),
)  # bumps from the middle to the farthest observation, or along the longer side of the image
_LOOSE_PX, _LEAST_PX = 3.0, 1e-3  # of bumps, before the data have spoken, and what they cannot talk below
_AT_REST = 0.02  # relative change of a size


def shifts_by_roughness(end: RobustSolution, observations: Observations) -> tuple[Sequence[Key], Sequence[Array]]:
    """Numbers (K), and shifts (K,) of them whose products with themselves, added up, are the covariance of what rough
    lenses do to them; none where views do not agree on anything that is left.
    """
    if max(agreement(end, observations.cameras), agreement_in_rings(end)) <= AGREES:
        return (), ()
    reduced = end.reduced or information(end.problem, end.solution.estimate)
    left = _Left.of(end, observations, reduced)
    every = [left.shifts_of(name, camera) for name, camera in end.solution.estimate.cameras.items()]
    return reduced.shared.keys, [shift for shifts in every for shift in shifts]


@dataclass(frozen=True, eq=False)
class _Left:
    """What the free numbers leave of some equations, in standard deviations.

    Attributes:
        model: of private placements alone. shared: (E, P) directions of the shared numbers beyond these. root: (K, P)
            from them to the numbers. normal: (P, P) what the equations and the priors say of them.
    """

    model: LinearModel
    shared: Array
    root: Array
    normal: Array

    @classmethod
    def of(cls, end: RobustSolution, observations: Observations, reduced: ReducedInformation) -> _Left:
        problem, estimate = end.problem, end.solution.estimate
        every = max(1, -(-problem.sights.equations // _MOST_EQUATIONS))
        sights = problem.sights[::every]
        equations = equations_of(observations, sights, estimate, end.residuals)
        weights = equation_weights(observations, problem.weighting, equations, end.residuals).within_sigma
        model, columns = without_shared(problem, estimate, equations, weights)
        root = known_root(reduced.shared)
        shared = model.beyond_private(columns @ root)
        share = sights.equations / problem.sights.equations
        prior = root.T @ reduced.priors.over(reduced.shared.keys).matrix @ root
        return cls(model, shared, root, shared.T @ shared + share * prior)

    def shifts_of(self, name: str, camera: Camera) -> Array:
        """(R, K) by the bumps of a camera's image."""
        equations, rows = self.model.equations, self.model.equations.bounds[:-1]
        own = equations.of_sights(np.array([key.camera == name for key in equations.sights.keys]))
        every = list(_bumps(equations, camera, own))
        kind = np.repeat(np.arange(len(every)), [columns.shape[1] for columns in every])
        inside = self.model.beyond_private(np.hstack(every) * (own * self.model.weight)[:, None])
        taken = self.shared.T @ inside
        moved = np.linalg.solve(self.normal, taken)
        normal = inside.T @ inside - taken.T @ moved
        score = self.model.placed_score
        score = score - self.shared @ np.linalg.solve(self.normal, self.shared.T @ score)
        slope = inside.T @ score
        best = np.linalg.solve(normal + np.eye(len(kind)) / _LOOSE_PX**2, slope)
        rest = score - inside @ best + self.shared @ (moved @ best)
        scatter = np.add.reduceat(inside * rest[:, None], rows), np.add.reduceat(inside**2, rows)
        within = max(1.0, float(np.sum(scatter[0] ** 2) / np.sum(scatter[1])))
        forms = [np.diag((kind == number).astype(float)) for number in range(len(every))]
        loose, least = np.full((2, len(every)), [[_LOOSE_PX], [_LEAST_PX]])
        sizes = likeliest_sizes(normal / within, slope / within, forms, loose, least, _AT_REST)
        covariance = np.linalg.inv(sizes.precision)
        values, vectors = np.linalg.eigh(covariance + np.outer(sizes.amount, sizes.amount))
        half = vectors * np.sqrt(np.maximum(values, 0.0))
        return np.asarray(np.linalg.qr((self.root @ moved @ half).T, mode="r"))


def _bumps(equations: Equations, camera: Camera, own: Mask) -> Iterator[Array]:
    """(E, Q) px per px of bumps along the radius and over the image, as far as a camera's own equations (E,) reach."""
    offsets = camera.offsets(equations.pixel)
    radius = np.maximum(np.linalg.norm(offsets, axis=1), 1e-12)
    outward = np.sum(equations.direction * offsets * (1.0, camera.aspect), axis=1) / radius
    yield _hats(radius / np.max(radius[own], initial=1e-12) * _ALONG, _ALONG) * outward[:, None]
    for count in _OVER:
        step_px = max(camera.image_size) / count
        x, y = (_hats(equations.pixel[:, k] / step_px, -int(-camera.image_size[k] // step_px)) for k in (0, 1))
        over = (x[:, :, None] * y[:, None, :]).reshape(len(x), -1)
        yield np.hstack([over * equations.direction[:, axis, None] for axis in (0, 1)])


def _hats(place: Array, count: int) -> Array:
    """(E, count + 1) straight up to 1 at each whole number from 0 to the count, and down."""
    return np.asarray(np.maximum(0.0, 1.0 - np.abs(place[:, None] - np.arange(count + 1))))
