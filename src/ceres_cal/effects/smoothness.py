"""Estimate how smooth a lens without a formula is: the likeliest sizes of effects that are numbers of the model."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from ceres_cal.base import NOTHING, Array, eigh, is_diagonal, replace
from ceres_cal.effects.linearised import inverse_root
from ceres_cal.problem import Estimate, Information, Key, Problem, ReducedInformation, values_of
from ceres_cal.scene.lens.base import Roughness


def likeliest_sizes(
    normal: Array, slope: Array, forms: Sequence[Array], sigmas: Array, least: Array, at_rest: float
) -> tuple[Array, Array, Array]:
    """The likeliest standard deviations sigma of effects whose numbers c have the prior information sum F / sigma^2.

    It is the fixed point of MacKay (Neural Computation 4, 1992), sigma^2 = c^T F c / gamma, with gamma = rank F - tr(C
    F) / sigma^2 the number of directions that the data determine: the maximum of the restricted likelihood. One
    additional direction of the least size is counted (an inverse gamma prior).

    Args:
        normal, slope: (Q, Q) and (Q,) normal equations of the data, with the best numbers normal^-1 slope. forms: (Q,
            Q) F of each effect. sigmas: (K,) initial sizes. least: (K,) sizes of the additional direction, so that data
            cannot make a size much smaller. at_rest: relative change of a size at which the iteration has converged.

    Returns:
        (K,) sizes, (Q,) likeliest numbers, (Q, Q) inverse of their covariance.
    """
    one = 1.0  # number of additional directions of the least size, so that few data do not make a size zero
    steps = 200  # iterations at most
    ranks = np.array([_rank(form) for form in forms])
    told = _by_sizes(normal, slope, forms, sigmas)
    for _ in range(steps):
        amount, traces, squares = told(sigmas)
        known = ranks - traces / sigmas**2
        moved = np.sqrt((np.maximum(squares, 0.0) + one * least**2) / (np.maximum(known, 0.0) + one))
        done = np.max(np.abs(np.log(moved / sigmas))) < at_rest
        before, sigmas = sigmas, moved
        if done:
            break
    precision = normal + sum(form / sigma**2 for form, sigma in zip(forms, before, strict=True))
    return sigmas, amount, np.asarray(precision)


def _by_sizes(
    normal: Array, slope: Array, forms: Sequence[Array], first: Array
) -> Callable[[Array], tuple[Array, Array, Array]]:
    """A function of sizes sigma (K,) that returns the likeliest numbers c (Q,), and tr(C F) and c^T F c (K,) of each
    form.

    The numbers of the largest diagonal form are rotated so that the data's information on them is diagonal, too. Then
    another size requires only the inverse of the remainder, a Schur complement. It is taken along directions in which
    the remainder at the `first` sizes is the unit matrix, so that a plain inverse is accurate.
    """
    sizes = [int(np.count_nonzero(form)) if is_diagonal(form) else 0 for form in forms]
    largest = int(np.argmax(sizes))
    turned = np.flatnonzero(np.diagonal(forms[largest]) if sizes[largest] else np.zeros(len(slope)))
    rest = np.delete(np.arange(len(slope)), turned)
    unit = 1.0 / np.sqrt(np.diagonal(forms[largest])[turned])
    values, vectors = eigh(normal[np.ix_(turned, turned)] * unit[:, None] * unit)
    turn = vectors * unit[:, None]
    own, coupling, here = turn.T @ slope[turned], normal[np.ix_(rest, turned)] @ turn, normal[np.ix_(rest, rest)]
    others = np.array([form[np.ix_(rest, rest)] for form in forms])

    left = here + np.tensordot(first**-2, others, 1) - coupling / (values + first[largest] ** -2) @ coupling.T
    root = inverse_root(left, np.diagonal(left), NOTHING * len(slope))
    coupling, here, others = root.T @ coupling, root.T @ here @ root, root.T @ others @ root
    beside, flat = root.T @ slope[rest], others.reshape(len(forms), -1)

    def told(sigmas: Array) -> tuple[Array, Array, Array]:
        along = 1.0 / (values + sigmas[largest] ** -2)
        weighed = coupling * along
        covariance = np.linalg.inv(here + (sigmas**-2 @ flat).reshape(here.shape) - weighed @ coupling.T)
        amount, numbers = covariance @ (beside - weighed @ own), np.empty(len(slope))
        of_turned = along * (own - coupling.T @ amount)
        numbers[rest], numbers[turned] = root @ amount, turn @ of_turned
        traces, squares = flat @ covariance.reshape(-1), others @ amount @ amount
        traces[largest] += np.sum(along) + np.sum(covariance * (weighed @ weighed.T))
        squares[largest] += of_turned @ of_turned
        return numbers, traces, squares

    return told


def _rank(form: Array) -> int:
    rows = np.any(form != 0.0, axis=1)
    own = form[np.ix_(rows, rows)]
    return len(own) if is_diagonal(own) else int(np.linalg.matrix_rank(own, hermitian=True))


def with_smoothness(
    problem: Problem, estimate: Estimate, reduced: ReducedInformation
) -> tuple[Problem, ReducedInformation, float]:
    """The problem with its lenses as smooth as the data say, its information, and the largest squared step, in
    variances, from a lens to its least cost under that smoothness.

    Args:
        estimate: the solution of the problem. reduced: its information there.
    """
    found, moving = {}, 0.0
    for name, camera in estimate.cameras.items():
        forms = camera.lens.roughness
        free = {key.quantity: key for key in reduced.shared.keys if key[:2] == ("camera", name)}
        if (
            not forms
            or problem.knows_lens(name, camera.lens)
            or not all(quantity in free for form in forms for quantity in form.names)
        ):
            continue
        before = problem.smoothness.get(name, tuple(form.loose for form in forms))
        found[name], step = _sigmas(forms, before, free, estimate, reduced)
        moving = max(moving, step)
    if not found:
        return problem, reduced, 0.0
    smooth = replace(problem, smoothness={**problem.smoothness, **found})
    priors = [prior.information for prior in smooth.priors_at(estimate)]
    known = Information.nothing(reduced.shared.keys).beside_all(priors)
    return smooth, replace(reduced, priors=known), moving


def _sigmas(
    forms: Sequence[Roughness],
    before: tuple[float, ...],
    keys: Mapping[str, Key],
    estimate: Estimate,
    reduced: ReducedInformation,
) -> tuple[tuple[float, ...], float]:
    """The standard deviation of each form, px, and the squared step to the least cost under them, in variances."""
    at_rest = 1e-3  # relative change of a standard deviation at which the iteration has converged
    own = tuple(keys[quantity] for form in forms for quantity in form.names)
    every = [Information(tuple(keys[q] for q in form.names), form.matrix).over(own).matrix for form in forms]
    whole = reduced.shared.marginal(own).matrix
    data = whole - sum(form / sigma**2 for form, sigma in zip(every, before, strict=True))
    here = values_of(estimate, own)
    least = np.array([form.least for form in forms])
    sigmas, amount, precision = likeliest_sizes(data, whole @ here, every, np.array(before), least, at_rest)
    away = amount - here
    return tuple(sigmas.tolist()), float(away @ precision @ away)
