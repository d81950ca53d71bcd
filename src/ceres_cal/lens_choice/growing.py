"""A lens without a formula becomes longer while residuals of different views agree from place to place.

How large its numbers are the data say in any case (`solve/smoothness.py`): more of them cost time, and are asked for
where the lens leaves something behind.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

from ceres_cal.base.errors import CalibrationError
from ceres_cal.lens_choice.seen import problem_of
from ceres_cal.model.parameters import Estimate, Options
from ceres_cal.observations import Observations
from ceres_cal.scene.lens import make_lens
from ceres_cal.solve import Problem, RobustSolution
from ceres_cal.solve.in_cells import AGREES, agreement


def grown(
    problem: Problem,
    observations: Observations,
    end: RobustSolution,
    solved: Callable[[Problem, Estimate], RobustSolution],
) -> tuple[Problem, RobustSolution]:
    """The problem with the lens that the residuals ask for, and its end; as they are where its powers were stated.

    Args:
        end: of the problem. solved: a problem from an estimate.
    """
    options = problem.options
    if options.powers:
        return problem, end
    rungs = options.blank_lens.trial_powers if options.coefficients is None else ()
    problem, end = _named(problem), replace(end, problem=_named(end.problem))
    for powers in rungs:
        if agreement(end, observations.cameras) <= AGREES:
            break
        # First an aspect and a skew, which are what displaces by the first power.
        aspect, skew = (name not in options.fixed for name in ("aspect", "skew"))
        longer = replace(options, powers=powers, free_aspect=aspect, free_skew=skew)
        with suppress(CalibrationError):
            try_of = problem_of(observations, problem.sights, longer, end.solution.estimate)
            found = solved(try_of, seen_longer(end.solution.estimate, longer))
            if not _folds(found):
                problem, end = try_of, found
    return problem, end


def _named(problem: Problem) -> Problem:
    """The same with the powers of its lens stated."""
    return replace(problem, options=replace(problem.options, powers=problem.options.blank_lens.powers))


def seen_longer(estimate: Estimate, options: Options) -> Estimate:
    """The estimate with the lens of the options, which holds its own."""
    cameras = dict(estimate.cameras)
    for name, camera in cameras.items():
        cameras[name] = replace(camera, lens=make_lens(options.lens, options.powers, camera.lens.coefficients))
    return replace(estimate, cameras=cameras)


def _folds(end: RobustSolution) -> bool:
    """Whether a lens folds inside what was observed."""
    for name, camera in end.solution.estimate.cameras.items():
        reach_px = end.problem.sights.of_camera(name).about(camera).reach_px
        if camera.lens.monotone_radius(camera.phi) <= reach_px:
            return True
    return False
