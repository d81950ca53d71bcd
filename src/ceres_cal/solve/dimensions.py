"""Dimensions of targets that are not known: where their solve starts, and which of them nothing measures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ceres_cal.base.errors import DegenerateError
from ceres_cal.model.dimensions import redrawn
from ceres_cal.model.parameters import Estimate, Options
from ceres_cal.model.structure import Tolerance
from ceres_cal.observations import Observations, Prior
from ceres_cal.scene.targets import Target
from ceres_cal.solve.information import information
from ceres_cal.solve.problem import Problem

# Of a dimension, its standard deviation from which on it is not measured. What nothing measures has an infinite one,
# but for rounding.
_UNMEASURED = 0.3


def free_dimensions(observations: Observations, options: Options) -> tuple[Observations, Options]:
    """The observations of targets drawn with the lengths that are stated of them, and options that name those, and the
    tolerances of curves that lie beside their drawing.
    """
    priors = (*observations.priors, *options.priors)
    names = dict.fromkeys((*options.dimensions, *(prior.dimension for prior in priors if prior.dimension)))
    drawn = observations.with_targets(drawn_as_stated(observations.targets, priors))
    tolerances = dict(options.tolerances)
    for prior in priors:
        if prior.curve:
            known = tolerances.get(prior.name, Tolerance())
            sigma_m = max(prior.sigma[0], known.lines_m)
            tolerances[prior.name] = replace(known, curve_m={**known.curve_m, prior.curve: sigma_m})
    return drawn, replace(options, dimensions=tuple(names), tolerances=tolerances)


def drawn_as_stated(targets: Mapping[str, Target], priors: Sequence[Prior]) -> dict[str, Target]:
    """The targets with the dimensions that priors state."""
    stated: dict[str, dict[str, float]] = {}
    for prior in sorted(priors, key=lambda prior: not prior.is_open):  # what is known better comes last
        if prior.dimension and prior.name in targets and prior.quantity in targets[prior.name].dimensions:
            stated.setdefault(prior.name, {})[prior.quantity] = prior.value[0]
    return {name: redrawn(target, stated.get(name, {})) for name, target in targets.items()}


def require_measured(problem: Problem, estimate: Estimate) -> None:
    """Raise DegenerateError where nothing says how long something is that is solved for.

    Raises:
        DegenerateError: which measurement is missing.
    """
    lengths = estimate.structure.dimensions
    if not lengths:
        return
    known = information(problem, estimate).shared
    keys = estimate.structure.keys[estimate.structure.own :]
    alone = np.diagonal(known.given(keys).matrix)
    sd = known.spread.sd[known.columns(keys)]
    with np.errstate(divide="ignore"):
        unseen = [
            key for key, says in zip(keys, alone, strict=True) if says**-0.5 > _UNMEASURED * lengths[key.structure_name]
        ]
    if unseen:
        raise DegenerateError(
            f"nothing that was observed depends on {unseen[0].quantity} of target {unseen[0].owner!r}: "
            "it cannot be solved for: leave it out"
        )
    open_ = [key for key, one in zip(keys, sd, strict=True) if not one < _UNMEASURED * lengths[key.structure_name]]
    if open_:
        names = ", ".join(key.quantity for key in open_)
        raise DegenerateError(
            f"nothing says how large target {open_[0].owner!r} is, since all of {names} are to be solved for: measure "
            f"one of them (--estimate {open_[0].quantity}=VALUE:SIGMA), another length of it, or a camera's height "
            "(--prior height_m=VALUE:SIGMA)"
        )
