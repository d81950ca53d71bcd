"""The camera that a photograph's lines, as far as they are known yet, belong to: from a start, in one robust solve."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ceres_cal.base.arrays import Array, Indices32
from ceres_cal.base.errors import CalibrationError
from ceres_cal.model.parameters import Estimate, Layout, Options, Station, intrinsic_names
from ceres_cal.model.priors import stated_prior
from ceres_cal.model.structure import make_structure
from ceres_cal.observations import Curves, Observations, Points, Prior, View
from ceres_cal.observations.sights import gather_sights
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.targets import Target
from ceres_cal.solve import Problem, Weighting, solve

CAMERA, STATION, TARGET = "camera", "station", "field"
_QUICK = Options(max_iterations=30, threads=1)


@dataclass(frozen=True, eq=False)
class Shown:
    """Points that somebody showed: index (P,) among the target's, pixels (P, 2), sigma_px (P,)."""

    feature: Indices32
    pixels: Array
    sigma_px: Array


_NONE_SHOWN = Shown(np.empty(0, np.int32), np.empty((0, 2)), np.empty(0))


def observations_of(
    target: Target,
    image_size: tuple[int, int],
    curve: Indices32,
    pixels: Array,
    sigma_px: Array,
    shown: Shown | None = None,
) -> Observations:
    """One view of a field in the world: pixels (N, 2) on curves (N,), and points."""
    count = len(curve)
    points = shown or _NONE_SHOWN
    return Observations(
        {TARGET: target},
        {CAMERA: image_size},
        (View("frame", CAMERA, STATION, TARGET),),
        Points(np.zeros(len(points.feature), np.int32), points.feature, points.pixels, points.sigma_px),
        Curves(np.zeros(count, np.int32), curve, pixels, sigma_px, np.zeros(count, np.int8)),
    )


def refit_camera(
    camera: Camera, observations: Observations, free: tuple[str, ...] = (), priors: tuple[Prior, ...] = ()
) -> Camera | None:
    """The posed camera that one view's observations tell, from one that is near; None where they tell none.

    Args:
        free: names of the intrinsics that are free too. priors: on them.
    """
    names = intrinsic_names(camera.lens)
    freed = np.array(sorted(names.index(name) for name in free), dtype=np.int64)
    estimate = Estimate(
        {CAMERA: camera.at(camera.cam_from_world)},
        {STATION: Station(CAMERA, camera.cam_from_world)},
        {},
        make_structure(observations.targets, {}),
    )
    layout = Layout({CAMERA: freed}, frozenset({STATION}), frozenset())
    known = tuple(stated_prior(prior, camera.lens) for prior in priors)
    problem = Problem(gather_sights(observations), layout, known, Weighting(loss="cauchy", loss_scale=2.0), _QUICK)
    try:
        solution = solve(problem, estimate, precision=1e-6)
        found = solution.estimate.camera_at(STATION)
    except CalibrationError:
        return None
    usable = not solution.failed and not found.folds and np.all(np.isfinite(found.position)) and found.position[2] > 0.0
    return found if usable else None
