"""Sights: every observation once, with its feature, and with the number of its row."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenery import overhead_pose
from scenes import SCENES
from scipy.optimize import minimize_scalar

from ceres_cal.base.arrays import Array
from ceres_cal.base.transforms import Pose
from ceres_cal.detect.photographs.refit import observations_of, problem_of
from ceres_cal.observations import Observations
from ceres_cal.observations.sights import SightKey, Sights, gather_sights, nearest_feet
from ceres_cal.problem.residuals import residuals, write_equations
from ceres_cal.scene import Camera
from ceres_cal.scene.curves import along_track
from ceres_cal.scene.lens import Radial
from ceres_cal.scene.targets import Arc, Segment, checkerboard, custom, ssl_field
from ceres_cal.simulate import Disturbance, Scene, Station, ViewPlan, simulate

NOISE = Disturbance(points_sigma_px=0.3, curves_sigma_px=0.5, hidden_points=0.2)


def several() -> Scene:
    """Two cameras, one of them at two stations; a court seen at three sides, and a board at two placements."""
    court = custom(
        {"a": (1.0, 0.5, 0.0), "b": (-1.0, 0.5, 0.3)},
        {
            "line": Segment((-1.5, -1.0, 0.0), (1.5, -0.9, 0.0), 0.1),
            "circle": Arc((0.2, 0.1, 0.0), 0.5, width_m=0.06),
            "edge": Segment((-1.5, 1.0, 0.0), (1.5, 1.0, 0.0)),
        },
    )
    base = SCENES["radial-2-3/corners"]()
    lens = base.cameras["overhead"]
    stations = {
        "left": Station("left", overhead_pose(-0.5, 0.0, 4.0, 4.0, 3.0)),
        "moved": Station("left", overhead_pose(-0.3, 0.1, 4.1, -3.0, 3.0)),
        "right": Station("right", overhead_pose(0.5, 0.0, 4.0, 2.0, -3.0)),
    }
    placements = {"near": Pose.exp((0.2, 0.1, 0.0, 0.1, 0.2, 1.0)), "far": Pose.exp((-0.2, 0.3, 0.0, -0.2, 0.1, 0.5))}
    sides = ("centre", "left", "right")
    views = [ViewPlan((side, side + "2"), "left", "court", spacing_m=0.2, side=side) for side in sides]
    views += [ViewPlan(("7",), "right", "board", "near"), ViewPlan(("8",), "left", "board", "near")]
    views += [ViewPlan(("9",), "moved", "court", spacing_m=0.3), ViewPlan(("10",), "right", "board", "far")]
    cameras = {"left": lens, "right": replace(lens, phi=850.0)}
    return Scene({"court": court, "board": checkerboard(4, 3, 0.1)}, cameras, stations, placements, tuple(views))


def seen() -> Observations:
    return simulate(several(), NOISE, 3).observations


def test_sights_are_stations_and_frames() -> None:
    """All frames of a static camera's court are one sight; each frame of a board is its own sight."""
    sights = gather_sights(seen())
    assert sights.keys == (
        SightKey("left", "left", None),
        SightKey("right", "right", "near"),
        SightKey("left", "left", "near"),
        SightKey("left", "moved", None),
        SightKey("right", "right", "far"),
    )
    assert sights.views == (tuple(range(6)), (6,), (7,), (8,), (9,))
    assert [str(key) for key in sights.keys[:2]] == ["station 'left'", "station 'right', placement 'near'"]


def assert_true_to(observations: Observations, sights: Sights) -> None:
    """Each row has its own pixel, sigma and feature."""
    for number, key in enumerate(sights.keys):
        sight = sights[number]
        assert sight.keys == (key,) and sight.key == key
        for row, place, pixel, sigma in zip(sight.point_rows, sight.points, sight.pixels, sight.sigma_px, strict=True):
            view = observations.views[observations.points.view[row]]
            assert (view.camera, view.station, view.placement) == key
            target = observations.targets[view.target]
            assert np.array_equal(place, target.points[observations.feature_name("point", row)])
            assert np.array_equal(pixel, observations.points.pixels[row])
            assert sigma == observations.points.sigma_px[row]
        for row, track, pixel in zip(sight.curve_rows, sight.track_index, sight.curve_pixels, strict=True):
            view = observations.views[observations.curves.view[row]]
            assert (view.camera, view.station, view.placement) == key
            curve = observations.targets[view.target].curves[observations.feature_name("curve", row)]
            assert np.array_equal(sight.tracks[track], curve.track(int(observations.curves.side[row])))
            assert sight.is_arc[track] == isinstance(curve, Arc)
            assert np.array_equal(pixel, observations.curves.pixels[row])


def test_every_row_is_there_once_with_what_it_shows() -> None:
    observations = seen()
    sights = gather_sights(observations)
    assert sorted(sights.point_rows) == list(range(len(observations.points)))
    assert sorted(sights.curve_rows) == list(range(len(observations.curves)))
    assert_true_to(observations, sights)


def test_taking_some_sights() -> None:
    observations = seen()
    sights = gather_sights(observations)
    some = sights.take(np.array([3, 0]))
    assert some.keys == (sights.keys[3], sights.keys[0])
    assert_true_to(observations, some)
    assert sights[-1].key == sights.keys[4]
    assert sights[1:3].keys == sights.keys[1:3]
    with pytest.raises(IndexError):
        sights[5]
    assert len(list(sights)) == len(sights) == 5


def test_only_the_rows_that_are_used() -> None:
    observations = seen()
    sights = gather_sights(observations)
    rng = np.random.default_rng(0)
    points, curves = rng.random(len(observations.points)) < 0.6, rng.random(len(observations.curves)) < 0.6
    used = sights.used(points, curves)
    assert sorted(used.point_rows) == np.flatnonzero(points).tolist()
    assert sorted(used.curve_rows) == np.flatnonzero(curves).tolist()
    assert_true_to(observations, used)


@pytest.mark.parametrize("run", [1, 10**6])
def test_rows_move_alike_one_by_one_and_in_runs(run: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ceres_cal.observations.sights._RUN", run)
    sights, rng = gather_sights(seen()), np.random.default_rng(1)
    points, curves = rng.random(len(sights.point_rows)) > 0.2, rng.random(len(sights.curve_rows)) > 0.2
    points[[0, -1]] = curves[[0, -1]] = False
    used = sights.used(points, curves)
    for name in ("point_rows", "point_index", "points", "pixels", "sigma_px"):
        np.testing.assert_array_equal(getattr(used, name), getattr(sights, name)[points[sights.point_rows]])
    for name in ("curve_rows", "track_index", "curve_pixels", "curve_sigma_px"):
        np.testing.assert_array_equal(getattr(used, name), getattr(sights, name)[curves[sights.curve_rows]])
    for number, key in enumerate(used.keys):
        before, after = sights[sights.keys.index(key)], used[number]
        np.testing.assert_array_equal(after.point_rows, before.point_rows[points[before.point_rows]])
        np.testing.assert_array_equal(after.curve_rows, before.curve_rows[curves[before.curve_rows]])


def test_sights_of_which_nothing_is_left_are_left_out() -> None:
    observations = seen()
    sights = gather_sights(observations)
    points = observations.points.view != 7
    used = sights.used(points, np.ones(len(observations.curves), dtype=bool))
    assert used.keys == (*sights.keys[:2], *sights.keys[3:])
    assert sights.used(np.ones(len(points), dtype=bool), np.ones(len(observations.curves), dtype=bool)) is sights


def test_parts_make_the_whole() -> None:
    """A large sight in three parts, for as many threads."""
    sight = gather_sights(seen())[0]
    parts = [sight.part(number, 3) for number in range(3)]
    assert all(part.keys == sight.keys for part in parts)
    for name in ("point_rows", "points", "pixels", "curve_rows", "track_index", "curve_pixels", "curve_sigma_px"):
        assert np.array_equal(np.concatenate([getattr(part, name) for part in parts]), getattr(sight, name))


def test_a_view_without_observations_is_no_sight() -> None:
    observations = seen()
    empty = replace(observations.views[-1], frame="11", placement="nowhere")
    assert (
        gather_sights(replace(observations, views=(*observations.views, empty))).keys
        == gather_sights(observations).keys
    )


# ---- where the search for a foot starts -----------------------------------------------------------------------------


def test_nearest_places_are_where_the_ray_passes() -> None:
    """Compared with a search along each line and circle for the least distance from the pixel's ray, in space."""
    observations = seen()
    sights, scene = gather_sights(observations), several()
    for number in (0, 3):
        sight = sights[number]
        camera = scene.camera_at(sight.key.station)
        found = nearest_feet(sight, camera)
        rays = camera.rays(sight.curve_pixels) @ camera.cam_from_world.rotation
        for place, track, ray in zip(found, sight.track_index, rays, strict=True):
            is_arc = bool(sight.is_arc[track])
            best = nearest_to_ray(sight.tracks[track], is_arc, camera.position, ray, place)
            # On a line they are equal; on a circle the place is the ray's intersection with its plane, moved radially.
            assert place == pytest.approx(best, abs=0.01 if is_arc else 1e-6)  # 4e-4, 7e-9 measured


def nearest_to_ray(track: Array, is_arc: bool, origin: Array, ray: Array, start: float) -> float:
    """Place on a track, within 0.3 of the start, that is nearest to a line in space."""

    def away(s: float) -> float:
        there = along_track(track, is_arc, [s])[0] - origin
        return float(np.linalg.norm(there - (there @ ray) * ray))

    bounds = (start - 0.2, start + 0.3)
    return float(minimize_scalar(away, bounds=bounds, method="bounded", options={"xatol": 1e-9}).x)


def test_places_of_no_observation_at_all() -> None:
    sight = gather_sights(seen())[1]
    assert len(sight.curve_rows) == 0
    assert nearest_feet(sight, several().camera_at("right")).shape == (0,)


def test_a_pixel_without_a_ray_has_a_place_all_the_same() -> None:
    """Beyond the lens's monotone radius, or for a ray along the line or the plane: a finite start, never NaN."""
    sight = gather_sights(seen())[0]
    camera = several().camera_at("left")
    folding = replace(camera, lens=camera.lens.with_values((0.0, -1e-6)))
    assert folding.folds
    far = replace(sight, curve_pixels=sight.curve_pixels + 900.0)
    assert np.all(np.isnan(folding.rays(far.curve_pixels)[:, 0]))
    assert np.all(np.isfinite(nearest_feet(far, folding)))
    level = camera.at(Pose.looking((0.0, 0.0, 0.0), [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]))  # edge-on
    assert np.all(np.isfinite(nearest_feet(replace(sight, curve_pixels=np.full_like(far.curve_pixels, 480.0)), level)))


def test_placements_seen_once() -> None:
    """Two stations show the board at "near"; the court, which two see as well, is no placement."""
    assert gather_sights(seen()).seen_once == {"far"}


@pytest.mark.parametrize("seed", range(4))
def test_observations_beside_a_fold_have_an_equation_or_none(seed: int) -> None:
    """The search for a foot near a fold of the lens may not converge. A residual without derivatives made the normal
    equations NaN, and one photograph of 200 ended with a traceback.
    """
    rng = np.random.default_rng(seed)
    lens = Radial((-0.0156345528, 1.103223e-04, -3.404591e-07, 3.962506e-10), (2, 3, 4, 5))
    pose = overhead_pose(0.2, -0.3, rng.uniform(3.0, 6.0), *rng.normal(0.0, 8.0, 2).tolist())
    camera = Camera((780, 580), 97.59, (383.2, 280.7), lens, 1.0, pose)
    field, count = ssl_field("B"), 300
    curve, pixels = rng.integers(0, len(field.curve_names), count), rng.uniform((0.0, 0.0), (780.0, 580.0), (count, 2))
    seen = observations_of(field, camera.image_size, curve.astype(np.int32), pixels, np.ones(count))
    problem, estimate = problem_of(camera, seen, (), ())
    there = residuals(problem.sights, estimate)
    equations = write_equations(problem.sights, estimate, there)
    assert np.all(np.isfinite(equations.pose)) and np.all(np.isfinite(equations.residual))
    assert 0.9 * count < len(equations) <= np.count_nonzero(np.isfinite(there.curves))  # 284 to 300
