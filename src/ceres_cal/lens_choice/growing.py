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
from ceres_cal.solve import Problem, Progress, RobustSolution, solve_robustly
from ceres_cal.solve.in_cells import AGREES, agreement
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
    rungs = options.blank_lens.trial_powers if options.coefficients is None else ()
    problem, end = _named(problem), replace(end, problem=_named(end.problem))
    for powers in rungs[1:]:
        if agreement(end, observations.cameras) <= AGREES:
            break
        longer = replace(options, powers=powers)
        with suppress(CalibrationError):
            try_of = problem_of(observations, problem.sights, longer, end.solution.estimate)
            near = _seen_longer(end.solution.estimate, longer)
            found = solve_robustly(try_of, observations, near, progress=progress)
            if not _folds(found):
                problem, end = try_of, found
    return problem, replace(start, estimate=_seen_longer(start.estimate, problem.options)), end


def _named(problem: Problem) -> Problem:
    """The same with the powers of its lens stated."""
    return replace(problem, options=replace(problem.options, powers=problem.options.blank_lens.powers))


def _seen_longer(estimate: Estimate, options: Options) -> Estimate:
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
