"""How smooth a lens without a formula is: the likeliest sizes of effects that are numbers of the model."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from ceres_cal.base import NOTHING, Array, is_diagonal, replace
from ceres_cal.effects.linearised import inverse_root
from ceres_cal.problem import Estimate, Information, Key, Problem, ReducedInformation, values_of
from ceres_cal.scene.lens.base import Roughness


def likeliest_sizes(
    normal: Array, slope: Array, forms: Sequence[Array], sigmas: Array, least: Array, at_rest: float
) -> tuple[Array, Array, Array]:
    """The standard deviations sigma of effects whose numbers c have the prior information sum F / sigma^2.

    The fixed point of MacKay (Neural Computation 4, 1992), sigma^2 = c^T F c / gamma, with gamma = rank F - tr(C F) /
    sigma^2 the number of directions that the data determine: the maximum of the restricted likelihood. One more
    direction of the least size counts along (an inverse gamma distribution beforehand).

    Args:
        normal, slope: (Q, Q) and (Q,) what data say of the numbers, whose best is normal^-1 slope. forms: (Q, Q) F of
            each. sigmas: (K,) to begin from. least: (K,) what data cannot talk a size below. at_rest: relative change
            of a size that ends the search.

    Returns:
        (K,) sizes, (Q,) likeliest numbers, (Q, Q) inverse of their covariance.
    """
    one = 1.0  # directions of the least size that count along, so that few data do not make a size zero
    steps = 200  # of the search for sizes
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
    """Of sizes sigma (K,): the likeliest numbers c (Q,), and tr(C F) and c^T F c (K,) of each form.

    The numbers of the largest form that is diagonal are turned to where what data say of them is diagonal, too. Then
    another size takes the inverse of what is left alone, a Schur complement, not of everything; along directions in
    which it is one at the `first` sizes, so that inverses are plain.
    """
    sizes = [int(np.count_nonzero(form)) if is_diagonal(form) else 0 for form in forms]
    largest = int(np.argmax(sizes))
    turned = np.flatnonzero(np.diagonal(forms[largest]) if sizes[largest] else np.zeros(len(slope)))
    rest = np.delete(np.arange(len(slope)), turned)
    unit = 1.0 / np.sqrt(np.diagonal(forms[largest])[turned])
    values, vectors = np.linalg.eigh(normal[np.ix_(turned, turned)] * unit[:, None] * unit)
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
    """The problem with its lenses as smooth as the data say, what it then says, and the largest squared step, in
    variances, that a lens is then off its least cost.

    Args:
        estimate: where the problem was solved. reduced: what it says there.
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
    at_rest = 1e-3  # relative change of a standard deviation
    own = tuple(keys[quantity] for form in forms for quantity in form.names)
    every = [Information(tuple(keys[q] for q in form.names), form.matrix).over(own).matrix for form in forms]
    whole = reduced.shared.marginal(own).matrix
    data = whole - sum(form / sigma**2 for form, sigma in zip(every, before, strict=True))
    here = values_of(estimate, own)
    least = np.array([form.least for form in forms])
    sigmas, amount, precision = likeliest_sizes(data, whole @ here, every, np.array(before), least, at_rest)
    away = amount - here
    return tuple(sigmas.tolist()), float(away @ precision @ away)
