"""A lens without a formula has all of its terms where residuals of different views agree from place to place.

How large their numbers are the data say in any case (`effects/smoothness.py`): they cost time, and are asked for where
the lens leaves something behind.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from ceres_cal.base.errors import attempt
from ceres_cal.observations import Observations
from ceres_cal.posterior.other_lenses import AGREES, agreement
from ceres_cal.problem.bundle import Progress
from ceres_cal.problem.parameters import Estimate, Options
from ceres_cal.problem.problem import Problem, problem_of
from ceres_cal.robust.robust import RobustSolution, solve_robustly
from ceres_cal.robust.usable import all_shown
from ceres_cal.scene.lens import make_lens
from ceres_cal.start.initialise import Start


def grown(
    problem: Problem,
    observations: Observations,
    start: Start,
    end: RobustSolution,
    progress: Callable[[Progress], None] | None = None,
) -> tuple[Problem, Start, RobustSolution]:
    """The problem with the lens that the residuals ask for, its start and its end.

    Args:
        problem: whose powers are not stated. end: of its rounds.
    """
    options = problem.options
    problem, end = _named(problem), replace(end, problem=_named(end.problem))
    longer = replace(options, terms=tuple(options.blank_lens.more_terms))
    may_grow = bool(options.blank_lens.roughness) and options.coefficients is None and not options.terms
    if may_grow and agreement(end, observations.cameras) > AGREES:
        near = _seen_longer(end.solution.estimate, longer)
        try_of = problem_of(observations, problem.sights, longer, near)
        # quiet: the lens without these terms stays; what it leaves is diagnosed
        found = attempt(lambda: solve_robustly(try_of, observations, near, progress=progress))
        if isinstance(found, RobustSolution) and _shows_all(found):
            problem, end = _named(try_of), replace(found, problem=_named(found.problem))
    return problem, replace(start, estimate=_seen_longer(start.estimate, problem.options)), end


def _named(problem: Problem) -> Problem:
    """The same with the powers of its lens stated."""
    return replace(problem, options=replace(problem.options, powers=problem.options.blank_lens.powers))


def _seen_longer(estimate: Estimate, options: Options) -> Estimate:
    """The estimate with the lens of the options, which holds its own."""
    cameras = dict(estimate.cameras)
    for name, camera in cameras.items():
        lens = make_lens(options.lens, options.blank_lens.powers, camera.lens.coefficients, options.terms)
        # Its own span is set, and nothing else is asked for.
        cameras[name] = replace(camera, lens=lens.spanning(0.0, camera.phi, 1.0, camera.image_size))
    return replace(estimate, cameras=cameras)


def _shows_all(end: RobustSolution) -> bool:
    """Whether no lens folds inside what was observed."""
    sights = end.problem.sights
    cameras = end.solution.estimate.cameras.items()
    return all(all_shown(camera, sights.of_camera(name).about(camera)) for name, camera in cameras)
