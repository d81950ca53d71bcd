"""The solve alone: its optimum, fixed numbers, interruption, and convergence."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import scenes
from hypothesis import given
from hypothesis import strategies as st
from scenery import field_scene, overhead_pose
from scenes import SCENES
from scipy.optimize import least_squares
from thorough import partly

from ceres_cal.base.arrays import Array, Indices
from ceres_cal.base.errors import DegenerateError
from ceres_cal.base.transforms import Pose, rotation_exp, rotation_log
from ceres_cal.observations import Observations, Prior, taken
from ceres_cal.observations.sights import gather_sights
from ceres_cal.problem.bundle import Progress, _left_to_gain, solve
from ceres_cal.problem.information import Information
from ceres_cal.problem.parameters import (
    Chart,
    Estimate,
    Layout,
    Options,
    Station,
    chart_of,
    intrinsics_vector,
    make_layout,
    with_intrinsics,
)
from ceres_cal.problem.priors import GaussianPrior, gather_priors
from ceres_cal.problem.problem import Problem, Weighting
from ceres_cal.problem.quantities import intrinsic_keys
from ceres_cal.problem.residuals import residuals
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import Brown, Radial
from ceres_cal.scene.targets import ssl_field
from ceres_cal.simulate import Disturbance, simulate
from ceres_cal.start.initialise import initialise

NOISE = Disturbance(points_sigma_px=0.3, curves_sigma_px=0.3, outliers=0.03, outlier_spread_px=5.0)
LOSSES = ["trivial", "huber", "soft_l1", "cauchy", "tukey"]


@cache
def case(name: str) -> tuple[Observations, Options]:
    """Noisy observations, some of them 5 px off, and the options that fit the scene's lens."""
    scene = SCENES[name]()
    lens = next(iter(scene.cameras.values())).lens
    return simulate(scene, NOISE, 3).observations, Options(
        lens=lens.kind, powers=getattr(lens, "powers", (2, 3)), usual_camera=False
    )


def start_of(name: str) -> Estimate:
    """The true estimate with phi 0.1 % off, moved by 0.2 mm and 0.2 mrad; even a redescending loss
    converges from it.
    """
    scene = SCENES[name]()
    observations, options = case(name)
    start = initialise(gather_sights(observations), options).estimate
    moved = Pose.exp([2e-4, -1e-4, 2e-4, 2e-4, 1e-4, -2e-4])
    cameras = {key: replace(camera, phi=1.001 * camera.phi) for key, camera in scene.cameras.items()}
    stations = {key: Station(place.camera, moved @ place.cam_from_world) for key, place in scene.stations.items()}
    placements = {key: pose @ moved for key, pose in scene.placements.items()}
    return replace(start, cameras=cameras, stations=stations, placements=placements)


def problem_of(observations: Observations, options: Options, weighting: Weighting, start: Estimate) -> Problem:
    priors = gather_priors(observations, options, start.structure)
    return Problem(gather_sights(observations), make_layout(observations, options), priors, weighting, options)


def solved(name: str, weighting: Weighting, start: Estimate | None = None, **more: Any) -> Any:
    observations, options = case(name)
    start = start or start_of(name)
    return solve(problem_of(observations, replace(options, **more), weighting, start), start)


def distance(a: Estimate, b: Estimate) -> float:
    """Largest difference: intrinsics in the solver's units, relative to phi; rotations in rad, translations in m."""
    found = [0.0]
    for name, camera in a.cameras.items():
        difference = np.abs(intrinsics_vector(camera) - intrinsics_vector(b.cameras[name]))
        difference[[0, 2, 3]] /= camera.phi
        found.append(float(np.max(difference)))
    pairs = [(a.stations[name].cam_from_world, b.stations[name].cam_from_world) for name in a.stations]
    pairs += [(a.placements[name], b.placements[name]) for name in a.placements]
    for one, other in pairs:
        found.append(float(np.linalg.norm(rotation_log(one.rotation @ other.rotation.T))))
        found.append(float(np.linalg.norm(one.translation - other.translation)))
    return max(found)


# ---- the optimum ----------------------------------------------------------------------------------------------------


class DenseSolver:
    """The same robust problem for scipy: one row for each component, finite differences, no elimination.

    An observation of length s contributes rho(s^2): its components are multiplied by the root of rho(s^2) / s^2.
    """

    def __init__(self, name: str, weighting: Weighting) -> None:
        self.observations, self.options = case(name)
        self.sights, self.start, self.weighting = gather_sights(self.observations), start_of(name), weighting
        self.layout = make_layout(self.observations, self.options)
        self.poses = [("stations", n) for n in self.start.stations if n in self.layout.stations]
        self.poses += [("placements", n) for n in self.start.placements]

    def estimate(self, unknowns: Array) -> Estimate:
        """Unknowns: the free intrinsics of each camera, then a left perturbation of each free pose."""
        cameras, at = {}, 0
        for name, camera in self.start.cameras.items():
            free, vector = self.layout.free[name], intrinsics_vector(camera)
            vector[free] += unknowns[at : at + len(free)]
            cameras[name], at = with_intrinsics(camera, vector), at + len(free)
        stations, placements = dict(self.start.stations), dict(self.start.placements)
        for number, (kind, name) in enumerate(self.poses):
            change = unknowns[at + 6 * number : at + 6 * number + 6]
            change_of_frame = Pose(rotation_exp(change[:3]), change[3:])
            if kind == "stations":
                stations[name] = replace(stations[name], cam_from_world=change_of_frame @ stations[name].cam_from_world)
            else:
                placements[name] = change_of_frame @ placements[name]
        return replace(self.start, cameras=cameras, stations=stations, placements=placements)

    def rows(self, unknowns: Array) -> Array:
        found = residuals(self.sights, self.estimate(unknowns))
        points = found.points / (self.weighting.point_scale * self.observations.points.sigma_px[:, None])
        curves = found.curves / (self.weighting.curve_scale * self.observations.curves.sigma_px)
        points *= self._bend(np.sum(points**2, axis=1))[:, None]
        return np.concatenate([points.ravel(), curves * self._bend(curves**2)])

    def _bend(self, s: Array) -> Array:
        b, s = self.weighting.loss_scale**2, np.maximum(s, 1e-12)
        rho = {
            "trivial": s,
            "huber": np.where(s <= b, s, 2.0 * np.sqrt(b * s) - b),
            "soft_l1": 2.0 * b * (np.sqrt(1.0 + s / b) - 1.0),
            "cauchy": b * np.log1p(s / b),
            "tukey": b / 3.0 * (1.0 - np.maximum(1.0 - s / b, 0.0) ** 3),
        }[self.weighting.loss]
        return np.sqrt(rho / s)

    def solve(self) -> tuple[Estimate, float]:
        count = sum(len(free) for free in self.layout.free.values()) + 6 * len(self.poses)
        tight = {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15}
        found = least_squares(self.rows, np.zeros(count), "3-point", method="trf", x_scale="jac", **tight)
        return self.estimate(found.x), float(found.cost)


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("name", partly(["radial-2-3/lines-arcs", "radial-3/corners"], ["radial-2-3/lines-arcs"]))
def test_robust_optimum_is_scipys(name: str, loss: str) -> None:
    weighting = Weighting(1.1, 0.9, loss, 2.5)
    found = solved(name, weighting)
    expected, cost = DenseSolver(name, weighting).solve()
    assert found.converged and not found.failed
    # With a robust loss scipy stops early, with a cost at most 1e-8 above ours.
    assert found.cost < cost * (1.0 + 1e-12)
    assert found.cost == pytest.approx(cost, rel=1e-7)  # 4e-15 (trivial), 1e-8 (tukey) measured
    assert distance(found.estimate, expected) < (1e-7 if loss == "trivial" else 1e-4)  # 8e-9, 2e-5 measured


@pytest.mark.parametrize("loss", ["trivial", "huber"])
@pytest.mark.parametrize("name", ["brown/two-cameras", "kannala-brandt/rings-field"])
def test_no_step_leads_further_down(name: str, loss: str) -> None:
    """Placements seen twice, eliminated ones and rings: the finite-difference gradient of the plain
    problem vanishes.
    """
    weighting = Weighting(1.1, 0.9, loss, 2.5)
    dense = DenseSolver(name, weighting)
    dense.start = solved(name, weighting).estimate
    count = sum(len(free) for free in dense.layout.free.values()) + 6 * len(dense.poses)
    rows, jacobian = dense.rows(np.zeros(count)), np.empty((len(dense.rows(np.zeros(count))), count))
    for k in range(count):
        step = np.zeros(count)
        step[k] = 1e-3 if k < count - 6 * len(dense.poses) and dense_is_px(dense, k) else 1e-6
        jacobian[:, k] = (dense.rows(step) - dense.rows(-step)) / (2.0 * step[k])
    size = np.linalg.norm(jacobian, axis=0) * np.linalg.norm(rows)
    told = size > 1e-6 * np.max(size)  # the rotation of the rings about their centre has no effect
    assert np.max(np.abs(jacobian.T @ rows)[told] / size[told]) < 1e-6  # 4e-8 measured


def dense_is_px(dense: DenseSolver, k: int) -> bool:
    """Whether unknown k is phi or a principal point, in px."""
    numbers = np.concatenate([dense.layout.free[name] for name in dense.start.cameras])
    return int(numbers[k]) in (0, 2, 3)


@pytest.mark.parametrize(
    "name", ["brown/two-cameras", "radial-2-3/field-boards", "kannala-brandt/lines", "brown/boards"]
)
def test_its_own_answer_is_where_it_stays(name: str) -> None:
    weighting = Weighting(loss="huber")
    first = solved(name, weighting)
    again = solved(name, weighting, first.estimate)
    assert again.cost == pytest.approx(first.cost, rel=1e-12)
    assert distance(again.estimate, first.estimate) < 1e-7  # 3e-9 measured


def test_threads_do_not_change_the_answer() -> None:
    one, two = (solved("brown/boards", Weighting(), threads=threads) for threads in (1, 2))
    assert distance(one.estimate, two.estimate) == 0.0


def test_history_falls_to_the_cost() -> None:
    found = solved("radial-2-3/field-boards", Weighting(loss="trivial"))
    assert found.history[0] > 1.05 * found.history[-1]
    assert min(found.history) == pytest.approx(found.cost, rel=1e-12)


def test_noise_scales_weigh_points_against_curves() -> None:
    """Halving a noise scale has the same effect as halving the sigmas."""
    observations, options = case("radial-2-3/field-boards")
    sure = replace(observations, curves=replace(observations.curves, sigma_px=0.5 * observations.curves.sigma_px))
    start = start_of("radial-2-3/field-boards")
    by_scale = solve(problem_of(observations, options, Weighting(1.0, 0.5), start), start)
    by_sigma = solve(problem_of(sure, options, Weighting(), start), start)
    assert distance(by_scale.estimate, by_sigma.estimate) < 1e-12
    assert distance(by_scale.estimate, solved("radial-2-3/field-boards", Weighting()).estimate) > 1e-5


# ---- what it leaves alone -------------------------------------------------------------------------------------------


def test_the_start_is_not_touched() -> None:
    start, same = start_of("brown/two-cameras"), start_of("brown/two-cameras")
    solved("brown/two-cameras", Weighting(), start)
    assert distance(start, same) == 0.0


@pytest.mark.parametrize("held", ["cameras", "stations", "placements", "one placement", "all"])
def test_what_is_held_comes_back_as_it_was(held: str) -> None:
    name = "brown/two-cameras"
    observations, options = case(name)
    whole, start = make_layout(observations, options), start_of(name)
    none: Indices = np.empty(0, dtype=np.int64)
    layout = Layout(
        dict.fromkeys(whole.free, none) if held in ("cameras", "all") else whole.free,
        frozenset() if held in ("stations", "all") else whole.stations,
        {"placements": frozenset(), "all": frozenset(), "one placement": whole.placements - {"board_02"}}.get(
            held, whole.placements
        ),
    )
    problem = replace(problem_of(observations, options, Weighting(), start), layout=layout)
    found = solve(problem, start).estimate
    for camera in start.cameras:
        assert (found.cameras[camera] == start.cameras[camera]) == (held in ("cameras", "all"))
    for station in start.stations:
        assert (found.stations[station] == start.stations[station]) == (held in ("stations", "all"))
    for placement, pose in start.placements.items():
        stays = held in ("placements", "all") or (held == "one placement" and placement == "board_02")
        assert (found.placements[placement] == pose) == stays


def test_priors_on_what_is_held_are_no_contradiction() -> None:
    """A prior on a fixed number has no effect; the other component of a prior on the principal point still has."""
    name = "radial-2-3/corners"
    observations, options = case(name)
    options = replace(options, fixed={"cx": 651.3})
    prior = Prior("camera", "overhead", "principal_point", (600.0, 470.0), (0.1, 0.001))
    start = start_of(name)
    problem = problem_of(observations, replace(options, priors=(prior,)), Weighting(), start)
    camera = solve(problem, start).estimate.cameras["overhead"]
    assert camera.principal_point[0] == 651.3
    assert camera.principal_point[1] == pytest.approx(470.0, abs=0.001)


def test_fewer_numbers_than_unknowns() -> None:
    observations, options = case("radial-2-3/corners")
    few = replace(observations, points=taken(observations.points, np.arange(5)))
    start = start_of("radial-2-3/corners")
    with pytest.raises(DegenerateError, match=r"10 measured numbers .* cannot determine 11 unknowns: add observations"):
        solve(problem_of(few, options, Weighting(), start), start)


# ---- how it ends ----------------------------------------------------------------------------------------------------


def test_iterations_may_run_out() -> None:
    found = solved("radial-2-3/field-boards", Weighting(), max_iterations=1)
    assert not found.converged and not found.failed
    assert len(found.history) == 2
    assert "iterations" in found.termination


class EnoughError(Exception):
    pass


@pytest.mark.parametrize("name", ["brown/boards", "brown/two-cameras", "radial-2-3/lines"])
def test_a_failure_in_progress_comes_out_and_nothing_is_left_behind(name: str) -> None:
    observations, options = case(name)
    start, before = start_of(name), start_of(name)
    problem = problem_of(observations, options, Weighting(), start)
    calls: list[Progress] = []

    def progress(now: Progress) -> None:
        calls.append(now)
        if now.iteration == 1:
            raise EnoughError

    for _ in range(20):  # a crash of the process might need more than one try
        calls.clear()
        with pytest.raises(EnoughError):
            solve(problem, start, progress)
        assert [now.iteration for now in calls] == [0, 1]
    assert distance(start, before) == 0.0
    assert solve(problem, start).converged


def test_a_start_that_shows_nothing_fails_without_a_crash() -> None:
    """The camera looks the other way, so that no residual can be evaluated."""
    name = "radial-2-3/corners"
    observations, options = case(name)
    start = start_of(name)
    away = Pose.exp([0.0, np.pi, 0.0, 0.0, 0.0, 0.0])
    stations = {key: Station(place.camera, away @ place.cam_from_world) for key, place in start.stations.items()}
    lost = replace(start, stations=stations)
    found = solve(problem_of(observations, options, Weighting(), lost), lost)
    assert found.failed and not found.converged and found.cost == np.inf


def test_an_exact_fit_leaves_nothing_to_gain() -> None:
    assert _left_to_gain([3.0, 1.0, 0.0]) == 0.0


# ---- where phi and height trade off ---------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [2])
def test_phi_against_height_does_not_creep(seed: int) -> None:
    """Seen from straight above with a lens whose coefficients scale with powers of phi: 15 to 31 iterations, and over
    80 to more than 100 where Ceres varies them directly.
    """
    leaning = overhead_pose(-0.5, 0.1, 3.2, tilt_x_deg=1.0, tilt_y_deg=-0.5, yaw_deg=90.0)
    scene = field_scene(ssl_field("B"), {"c": scenes.camera("brown")}, {"c": Station("c", leaning)}, spacing_m=0.1)
    seen = simulate(scene, Disturbance(points_sigma_px=0.1, curves_sigma_px=0.1), seed).observations
    options = Options(lens="brown", coefficients=("k1", "k2"), usual_camera=False)
    start = initialise(gather_sights(seen), options).estimate
    found = solve(problem_of(seen, options, Weighting(), start), start, is_near=False)
    assert found.converged and len(found.history) < 45


def test_what_is_raised_on_the_way_to_a_cost_ends_the_solve(monkeypatch: pytest.MonkeyPatch) -> None:
    """For example Ctrl-C: exceptions cannot propagate through C++."""

    def interrupted(*given: Any) -> Array:
        raise KeyboardInterrupt

    start = start_of("brown/boards")
    monkeypatch.setattr(Chart, "chained", interrupted)
    with pytest.raises(KeyboardInterrupt):
        solved("brown/boards", Weighting(), start)


@given(
    phi=st.floats(200.0, 3000.0),
    values=st.lists(st.floats(-0.5, 0.5), min_size=5, max_size=5),
    held=st.sets(st.integers(1, 9)),
)
def test_what_ceres_moves_says_the_same_in_other_numbers(phi: float, values: list[float], held: set[int]) -> None:
    seen_by = Camera((1280, 960), phi, (640.0, 480.0), Brown(tuple(values)))
    free = np.array([number for number in range(10) if number not in held])
    chart, numbers = chart_of(seen_by, free), intrinsics_vector(seen_by)[free]
    assert chart is not None
    moved = chart.moved(numbers)
    np.testing.assert_allclose(chart.numbers(moved), numbers, rtol=1e-13, atol=1e-300)
    steps = 1e-6 * np.maximum(np.abs(moved), 1e-3)
    slopes = [(chart.numbers(moved + d) - chart.numbers(moved - d)) / (2.0 * d.sum()) for d in np.diag(steps)]
    np.testing.assert_allclose(chart.chained(np.eye(len(free)), numbers), np.array(slopes).T, rtol=1e-6, atol=1e-9)
    assert chart_of(seen_by, np.array([1, 2, 4, 5])) is None  # phi is held
    assert chart_of(replace(seen_by, lens=Radial((0.1, 0.1))), free) is None  # which acts on pixels


# ---- parts of a rig -------------------------------------------------------------------------------------------------


def test_cameras_that_share_nothing_are_solved_for_one_by_one() -> None:
    """Each part ends where the solve of all ends, and holds the other camera; priors and boards tie cameras."""
    cameras, stations = scenes.side_by_side(scenes.camera("radial-2-3"))
    above = simulate(field_scene(ssl_field("B"), cameras, stations, spacing_m=0.3), NOISE, 3).observations
    options = Options(lens="radial", usual_camera=False)
    start = initialise(gather_sights(above), options).estimate
    problem = problem_of(above, options, Weighting(loss="cauchy"), start)
    whole = solve(problem, start).estimate
    parts = [problem.about(name, start) for name in cameras]
    assert sum(part.equations for part in parts) == problem.equations
    for name, part in zip(cameras, parts, strict=True):
        end, other = solve(part, start).estimate, next(key for key in cameras if key != name)
        assert (end.cameras[other], end.stations[other]) == (start.cameras[other], start.stations[other])
        alone = replace(whole, cameras={**whole.cameras, other: start.cameras[other]})
        alone = replace(alone, stations={**whole.stations, other: start.stations[other]})
        assert distance(end, alone) < 1e-6  # 1e-7 measured, where Cauchy's loss ends

    both = GaussianPrior(Information(intrinsic_keys("left", cameras["left"].lens)[:1], np.eye(1)), np.zeros(1))
    keys = tuple(intrinsic_keys(name, cameras[name].lens)[0] for name in cameras)
    tied = GaussianPrior(Information(keys, np.ones((2, 2))), np.zeros(2))
    assert replace(problem, priors=(both,)).about("left", start).equations == parts[0].equations
    assert replace(problem, priors=(tied,)).about("left", start).equations == problem.equations
    seen, named = case(f"{scenes.LENSES[0]}/two-cameras")
    shared = problem_of(seen, named, Weighting(), start_of(f"{scenes.LENSES[0]}/two-cameras"))
    assert shared.about("west", start_of(f"{scenes.LENSES[0]}/two-cameras")) is shared
