"""Simulated observations of a scene: what each frame shows, with noise, outliers, wrong labels and hidden stretches."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ceres_cal.base import Array, Codes, Frozen, Indices, Indices32, Mask, numbers_of, replace
from ceres_cal.observations import Curves, Observations, Points, View, joined, taken
from ceres_cal.scene import SIDES, Camera, Target, along_curve, distance_to_curve, in_image, is_crossing
from ceres_cal.simulate.scene import Disturbance, Scene, ViewPlan

CLEAN, OUTLIER, WRONG_LABEL = 0, 1, 2


class Truth(Frozen):
    """True values of the rows of a simulation's points or curves.

    Attributes:
        flag: (N,) CLEAN, OUTLIER or WRONG_LABEL.
        feature: (N,) index of the feature that is seen; differs from the observation's where the label is wrong.
        pixels: (N, 2) where it is seen without noise, px.
    """

    flag: Codes
    feature: Indices32
    pixels: Array

    def rows(self, flag: int) -> Indices:
        """Numbers of the rows with this flag."""
        return np.flatnonzero(self.flag == flag)


class Simulation(Frozen):
    """Observations of a scene, and their true values row by row."""

    scene: Scene
    disturbance: Disturbance
    seed: int
    observations: Observations
    points: Truth
    curves: Truth


class _InView(Frozen):
    """The N places on a target that a plan's camera can see, from which all frames of the plan choose.

    `position_m` is the place along the plan's curves laid end to end, ascending; `neighbour` is the nearest other
    curve. Both are None for points. `features` is the number of names from which a wrong label is drawn.
    """

    feature: Indices32
    pixels: Array
    features: int
    image_size: tuple[int, int]
    side: int = 0
    position_m: Array | None = None
    neighbour: Indices32 | None = None


_Rows = tuple[Curves, Truth]
"""Columns of the observations of one plan, with views numbered across all plans, and their true values."""


def simulate(scene: Scene, disturbance: Disturbance | None = None, seed: int = 0) -> Simulation:
    """Simulate the observations of a scene.

    Only what is in front of the camera, within the lens's monotone radius and inside the image is observed; an
    observation that noise moves out of the image is lost. Views without any observation are left out. `sigma_px` of the
    observations is the disturbance's, 1 where that is 0. The same scene, disturbance and seed give the same rows.

    Raises:
        InputError: a camera sees nothing at all.
    """
    disturbance = disturbance or Disturbance()
    point_rng, curve_rng = np.random.default_rng(seed).spawn(2)
    views: list[View] = []
    point_rows, curve_rows = list[_Rows](), list[_Rows]()
    for plan in scene.views:
        camera = scene.camera_at(plan.station)
        some_points, some_curves = _points_in_view(scene, plan, camera), _curves_in_view(scene, plan, camera)
        for in_view, rng, rows in ((some_points, point_rng, point_rows), (some_curves, curve_rng, curve_rows)):
            hidden = _hidden(in_view, len(plan.frames), disturbance, rng)
            rows.append(_observe(in_view, hidden, len(views), disturbance, rng))
        camera_name = scene.stations[plan.station].camera
        views.extend(View(frame, camera_name, plan.station, plan.target, plan.placement) for frame in plan.frames)
    (points, of_points), (curves, of_curves) = _joined(point_rows), _joined(curve_rows)
    return Simulation(scene, disturbance, seed, _observations(scene, views, points, curves), of_points, of_curves)


# ---- what can be seen -----------------------------------------------------------------------------------------------


def _project_seen(scene: Scene, plan: ViewPlan, camera: Camera, points: Array) -> tuple[Indices, Array]:
    """Return which of the target's points (N, 3) the camera sees, and their pixels."""
    points_world = scene.world_from_target(plan.placement).transform(points)
    ahead = np.flatnonzero(camera.cam_from_world.transform(points_world)[:, 2] > 0.0)
    pixels = camera.project(points_world[ahead])
    seen = in_image(pixels, camera.image_size)  # False for the NaN beyond the lens
    return ahead[seen], pixels[seen]


def _chosen(names: tuple[str, ...] | None, known: tuple[str, ...]) -> Indices32:
    return np.sort(numbers_of(known if names is None else names, known)).astype(np.int32)


def _points_in_view(scene: Scene, plan: ViewPlan, camera: Camera) -> _InView:
    target = scene.targets[plan.target]
    named = tuple(name for name in target.point_names if not is_crossing(name))
    chosen = _chosen(named if plan.points is None else plan.points, target.point_names)
    rows, pixels = _project_seen(scene, plan, camera, target.point_array[chosen])
    return _InView(chosen[rows], pixels, len(target.points), camera.image_size)


def _curves_in_view(scene: Scene, plan: ViewPlan, camera: Camera) -> _InView:
    target, side = scene.targets[plan.target], SIDES[plan.side]
    chosen = _chosen(plan.curves, target.curve_names)
    places, positions, features, start = [np.empty((0, 3))], [np.empty(0)], [chosen[:0]], 0.0
    for i in chosen:
        curve = target.curves[target.curve_names[i]]
        # Places are in the middle of equal pieces: none at an end, and none twice on a closed circle.
        pieces = max(1, round(curve.length_m / plan.spacing_m))
        share = (np.arange(pieces) + 0.5) / pieces
        low, high = curve.parameter_range
        places.append(along_curve(curve, low + share * (high - low), side))
        positions.append(start + share * curve.length_m)
        features.append(np.full(pieces, i, dtype=np.int32))
        start += curve.length_m
    there, feature = np.concatenate(places), np.concatenate(features)
    rows, pixels = _project_seen(scene, plan, camera, there)
    neighbour = _neighbours(target, feature[rows], there[rows])
    position = np.concatenate(positions)[rows]
    return _InView(feature[rows], pixels, len(chosen), camera.image_size, side, position, neighbour)


def _neighbours(target: Target, feature: Indices32, places: Array) -> Indices32:
    """For each place (N, 3) on a curve, return the nearest other curve of the target; the same curve if it is the only
    one.
    """
    nearest, distance = feature.copy(), np.full(len(places), np.inf)
    for i, curve in enumerate(target.curves.values()):
        away = distance_to_curve(curve, places)
        nearer = (away < distance) & (feature != i)
        nearest[nearer], distance[nearer] = i, away[nearer]
    return nearest


# ---- what is seen ---------------------------------------------------------------------------------------------------


def _hidden(in_view: _InView, frames: int, disturbance: Disturbance, rng: np.random.Generator) -> Mask:
    """(frames, N) which points or places on curves are hidden; a stretch is centred on one of the places in view."""
    count, stretches, position = len(in_view.feature), disturbance.hidden_stretches, in_view.position_m
    if position is None and disturbance.hidden_points > 0.0:
        return rng.random((frames, count)) < disturbance.hidden_points
    if position is None or count == 0 or stretches == 0:
        return np.zeros((frames, count), dtype=bool)
    middle = rng.integers(count, size=(frames, stretches))
    curve_start = np.searchsorted(in_view.feature, in_view.feature, side="left")
    curve_end = np.searchsorted(in_view.feature, in_view.feature, side="right")
    reach = 0.5 * disturbance.hidden_length_m
    start = np.maximum(curve_start[middle], np.searchsorted(position, position[middle] - reach, side="left"))
    end = np.minimum(curve_end[middle], np.searchsorted(position, position[middle] + reach, side="right"))
    # The number of stretches that cover a place increases by one at each start and decreases by one at each end.
    change = np.zeros((frames, count + 1), dtype=np.int32)
    frame = np.arange(frames)[:, None]
    np.add.at(change, (frame, start), 1)
    np.add.at(change, (frame, end), -1)
    return np.asarray(np.cumsum(change[:, :-1], axis=1) > 0)


def _observe(
    in_view: _InView, hidden: Mask, first_view: int, disturbance: Disturbance, rng: np.random.Generator
) -> _Rows:
    frame, place = np.nonzero(~hidden)
    sigma_px = disturbance.points_sigma_px if in_view.position_m is None else disturbance.curves_sigma_px
    lot = rng.random(len(place))
    flag = np.zeros(len(place), dtype=np.int8)
    flag[lot < disturbance.outliers + disturbance.wrong_labels] = WRONG_LABEL
    flag[lot < disturbance.outliers] = OUTLIER
    true_pixels = in_view.pixels[place]
    pixels = true_pixels.copy()
    if sigma_px > 0.0:
        pixels += sigma_px * rng.standard_normal(pixels.shape)
    far = np.flatnonzero(flag == OUTLIER)
    pixels[far] += disturbance.outlier_spread_px * rng.standard_normal((len(far), 2))
    true_feature = in_view.feature[place]
    feature = _mislabel(in_view, place, flag, rng)
    flag[(flag == WRONG_LABEL) & (feature == true_feature)] = CLEAN  # no other name exists
    view, side = (first_view + frame).astype(np.int32), np.full(len(place), in_view.side, dtype=np.int8)
    rows = Curves(view, feature, pixels, np.full(len(place), sigma_px or 1.0), side)
    kept = np.flatnonzero(in_image(pixels, in_view.image_size))
    return taken(rows, kept), taken(Truth(flag, true_feature, true_pixels), kept)


def _mislabel(in_view: _InView, place: Indices, flag: Codes, rng: np.random.Generator) -> Indices32:
    """Return the features as named: WRONG_LABEL rows get another name, if there is one."""
    feature = in_view.feature[place]
    wrong = np.flatnonzero(flag == WRONG_LABEL)
    if in_view.neighbour is not None:
        feature[wrong] = in_view.neighbour[place[wrong]]
    elif in_view.features > 1:
        feature[wrong] = (feature[wrong] + rng.integers(1, in_view.features, size=len(wrong))) % in_view.features
    return feature


# ---- all together ---------------------------------------------------------------------------------------------------


def _observations(scene: Scene, views: Sequence[View], points: Curves, curves: Curves) -> Observations:
    """Return the rows of points and of curves as observations, with the views that have any."""
    used = np.zeros(len(views), dtype=bool)
    used[points.view] = used[curves.view] = True
    number = (np.cumsum(used) - 1).astype(np.int32)
    kept_views = tuple(view for view, keep in zip(views, used, strict=True) if keep)
    return Observations(
        {name: target for name, target in scene.targets.items() if any(view.target == name for view in kept_views)},
        {name: camera.image_size for name, camera in scene.cameras.items()},
        kept_views,
        Points(number[points.view], points.feature, points.pixels, points.sigma_px),
        replace(curves, view=number[curves.view]),
    )


def _joined(parts: Sequence[_Rows]) -> _Rows:
    return joined([rows for rows, _ in parts]), joined([truth for _, truth in parts])
