"""The whole covariance: compared with pyceres's, unknown directions, and its form in a file."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pyceres
import pytest
from scenes import SCENES
from scipy.stats import t as student

from ceres_cal.base.arrays import Array, Spread
from ceres_cal.base.errors import InputError
from ceres_cal.base.tails import student_95
from ceres_cal.base.transforms import Pose, left_jacobian, skew
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.observations import Prior
from ceres_cal.observations.sights import STRUCTURE, gather_sights
from ceres_cal.posterior.assess import to_best
from ceres_cal.posterior.posterior import make_posterior
from ceres_cal.problem.bundle import packed, solve
from ceres_cal.problem.costs import CachedCost, PriorCost, Run, SightCost
from ceres_cal.problem.information import Key, pose_keys
from ceres_cal.problem.parameters import Estimate, Layout, Options, intrinsics_scales, make_layout
from ceres_cal.problem.priors import gather_priors
from ceres_cal.problem.problem import Problem, Weighting
from ceres_cal.problem.quantities import difference, free_keys, moved
from ceres_cal.problem.reduced import information
from ceres_cal.problem.structure import Tolerance
from ceres_cal.simulate import Disturbance, simulate

NOISE = Disturbance(points_sigma_px=0.3, curves_sigma_px=0.3)
WEIGHTING = Weighting(0.3, 0.3, "cauchy", 3.0)  # neither blocks nor posterior include the curvature of this loss


def problem(name: str, **more: Any) -> tuple[Problem, Estimate]:
    """A scene that is solved, with its height known to 10 mm and its principal point to 2 px."""
    scene = SCENES[name]()
    lens = next(iter(scene.cameras.values())).lens
    camera, station = next(iter(scene.cameras)), next(iter(scene.stations))
    height = float(scene.camera_at(station).position[2])
    priors = (
        Prior("camera", camera, "principal_point", (651.0, 469.0), (2.0, 3.0)),
        Prior("station", station, "height_m", (height,), (0.01,)),
    )
    options = Options(usual_camera=False, lens=lens.kind, powers=getattr(lens, "powers", (2, 3)), priors=priors, **more)
    observations = simulate(scene, NOISE, 1).observations
    estimate = calibrate(observations, options).estimate
    known = gather_priors(observations, options, estimate.structure)
    whole = Problem(gather_sights(observations), make_layout(observations, options), known, WEIGHTING, options)
    return whole, solve(whole, estimate).estimate


# ---- against pyceres ------------------------------------------------------------------------------------------------


def step_of_block(kind: str, name: str, estimate: Estimate, layout: Layout) -> Array:
    """A step of the solver's block in the numbers of `quantities`."""
    if kind == "camera":
        return np.diag(1.0 / intrinsics_scales(estimate.cameras[name])[layout.free[name]])
    if kind == "structure":
        return np.eye(len(estimate.structure.values))
    pose = estimate.stations[name].cam_from_world if kind == "station" else estimate.placements[name]
    turn = np.hstack([left_jacobian(pose.log()[:3]), np.zeros((3, 3))])
    shift = np.hstack([np.zeros((3, 3)), np.eye(3)])
    if kind == "station":
        return np.vstack([-pose.rotation.T @ (shift + skew(pose.translation) @ turn), turn])
    return np.vstack([shift, pose.rotation.T @ turn])


def covariance_of_pyceres(whole: Problem, estimate: Estimate) -> dict[tuple[str, str], Array]:
    """Covariance of each block by pyceres, without elimination and without the kernels of `information`."""
    layout = whole.layout
    blocks = packed(estimate, layout, frozenset())
    ceres, run = pyceres.Problem(), Run()
    costs: list[CachedCost] = [SightCost(run, sight, whole, estimate) for sight in whole.sights]
    costs += [PriorCost(run, prior, estimate, layout) for prior in whole.priors_at(estimate)]
    for cost in costs:
        arrays = [blocks[owner] for owner in cost.owners]
        cost.evaluate(*arrays)
        ceres.add_residual_block(cost, None, arrays)
    named = {owner: array for owner, array in blocks.items() if owner != STRUCTURE}
    named |= {("structure", "board"): blocks[STRUCTURE]} if len(blocks[STRUCTURE]) else {}
    options = pyceres.CovarianceOptions()
    options.algorithm_type = pyceres.CovarianceAlgorithmType.DENSE_SVD
    options.null_space_rank = 0
    covariance = pyceres.Covariance(options)
    assert covariance.compute([(array, array) for array in named.values()], ceres)
    found = {}
    for (kind, name), array in named.items():
        step = step_of_block(kind, name, estimate, layout)
        found[kind, name] = step @ covariance.get_covariance_block(array, array) @ step.T
    return found


@pytest.mark.parametrize(
    "name, tolerances",
    [
        ("radial-2-3/field-boards", {}),
        ("radial-3-5/boards", {}),
        ("brown/two-cameras", {}),
        ("kannala-brandt/several-stations", {}),
        ("radial-2-3/field-boards", {"board": Tolerance(warp_m=0.001)}),
    ],
)
def test_covariance_is_that_of_pyceres(name: str, tolerances: dict[str, Tolerance]) -> None:
    whole, estimate = problem(name, **({"tolerances": tolerances} if tolerances else {}))
    posterior = make_posterior(information(whole, estimate), np.inf)
    expected = covariance_of_pyceres(whole, estimate)
    assert {kind for kind, _ in expected} >= {"camera"}
    for (kind, owner), block in expected.items():
        if kind == "placement":
            found = posterior.placement(owner).matrix
        else:
            at = [i for i, key in enumerate(posterior.keys) if (key.kind, key.owner) == (kind, owner)]
            found = posterior.covariance[np.ix_(at, at)]
        sd = np.sqrt(np.diag(block))
        assert found / np.outer(sd, sd) == pytest.approx(block / np.outer(sd, sd), abs=1e-6), (kind, owner)


# ---- what is unknown ------------------------------------------------------------------------------------------------


def test_the_roll_of_a_ring_sheet_is_unknown_and_nothing_else() -> None:
    """An exact null direction: a sheet of rings looks the same after a rotation about its axis."""
    posterior = make_posterior(information(*problem("radial-2-3/rings-field")), np.inf)
    sheet = posterior.placement("rings")
    assert np.isinf(sheet.sd[5]) and np.all(np.isfinite(sheet.sd[:5])) and np.all(sheet.sd[:5] > 1e-6)
    assert np.all(np.isfinite(posterior.sd))


def test_an_unknown_number_makes_unknown_what_depends_on_it_alone() -> None:
    """Two numbers with only their sum known, a known third one, and an unknown fourth one."""
    total = np.array([1.0, 1.0, 0.0, 0.0])
    alone = np.array([0.0, 0.0, 1.0, 0.0])
    spread = Spread.of(25.0 * np.outer(total, total) + 4.0 * np.outer(alone, alone), 1e6 * np.ones(4))
    assert spread.sd.tolist() == [np.inf, np.inf, 0.5, np.inf]
    known = spread.through(np.array([total, alone, total + 2.0 * alone]))
    assert known == pytest.approx(np.array([[0.04, 0.0, 0.04], [0.0, 0.25, 0.5], [0.04, 0.5, 1.04]]), abs=1e-12)
    assert np.isinf(spread.through(np.array([[1.0, -1.0, 0.0, 0.0]]))[0, 0])


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_units_do_not_matter(scale: float) -> None:
    rng = np.random.default_rng(0)
    rows = rng.standard_normal((3, 4))  # one direction of four is unknown
    units = np.array([1.0, scale, 1.0, 1.0 / scale])
    plain, other = (Spread.of((rows * u).T @ (rows * u), 1e6 / u) for u in (np.ones(4), units))
    wanted = rng.standard_normal(3) @ rows
    assert other.through((wanted * units)[None]) == pytest.approx(plain.through(wanted[None]), rel=1e-9)
    assert np.all(np.isinf(other.sd)) and np.all(np.isinf(plain.sd))


def test_placements_follow_what_their_station_does_not_know() -> None:
    """Boards in front of a station without a known height: unknown in the world like the station,
    but not relatively.
    """
    whole, estimate = problem("radial-2-3/field-boards")
    boards = whole.of_sights(np.array([i for i, key in enumerate(whole.sights.keys) if key.placement is not None]))
    posterior = make_posterior(information(replace(boards, priors=()), estimate), np.inf)
    assert np.all(np.isfinite(posterior.sd[:5]))  # the camera
    assert np.all(np.isinf(posterior.sd[5:]))  # its station
    assert np.all(np.isinf(posterior.placement("board_01").sd))


def test_one_number_at_a_time() -> None:
    posterior = make_posterior(information(*problem("radial-2-3/field-boards")), np.inf)
    assert posterior.sd_of("camera", "overhead", "phi") == pytest.approx(0.9, rel=0.9)  # px
    assert posterior.sd_of("station", "overhead", "height") < 0.01  # the prior alone
    two = posterior.information.marginal([posterior.keys[0], posterior.keys[3]])
    assert np.linalg.inv(two.matrix) == pytest.approx(posterior.covariance[np.ix_([0, 3], [0, 3])], rel=1e-9)
    with pytest.raises(InputError, match="camera 'overhead' has no free number 'aspect'"):
        posterior.sd_of("camera", "overhead", "aspect")
    with pytest.raises(InputError, match="placement 'gone' has no free pose"):
        posterior.placement("gone")
    with pytest.raises(InputError, match=r"no free number 'height_m': did you mean 'height'\?"):
        posterior.sd_of("station", "overhead", "height_m")


@pytest.mark.parametrize("freedom", [5.0, 12.0, 100.0, np.inf])
def test_student(freedom: float) -> None:
    assert student_95(freedom) == pytest.approx(student.ppf(0.975, freedom), rel=2e-3)


# ---- steps along the numbers ----------------------------------------------------------------------------------------


def test_a_step_and_back() -> None:
    whole, estimate = problem("brown/two-cameras", tolerances={"field": Tolerance(lines_m=0.01)})
    keys = free_keys(estimate, whole.layout, whole.private)
    assert len(set(keys)) == len(keys)
    assert {key.kind for key in keys} == {"camera", "station", "placement", "structure"}
    assert Key("structure", "field", "CenterCircle.radius", "m") in keys
    assert pose_keys("placement", "board_01")[2] in keys
    step = 1e-3 * np.random.default_rng(1).standard_normal(len(keys))
    there = moved(estimate, keys, step)
    assert difference(there, estimate, keys) == pytest.approx(step, abs=1e-10)  # 3e-13 measured, of phi in px
    assert difference(estimate, estimate, keys) == pytest.approx(np.zeros(len(keys)), abs=1e-15)


def test_a_step_of_a_pose_near_half_a_turn() -> None:
    """Rotation vectors jump there, rotations do not."""
    _, estimate = problem("radial-2-3/field-boards")
    station = replace(estimate.stations["overhead"], cam_from_world=Pose.exp([np.pi - 1e-4, 0.0, 0.0, 0.1, 0.2, 4.0]))
    here = replace(estimate, stations={"overhead": station})
    step = np.array([0.01, -0.02, 0.03, 2e-3, 1e-3, -1e-3])
    keys = pose_keys("station", "overhead")
    assert difference(moved(here, keys, step), here, keys) == pytest.approx(step, abs=1e-12)


@pytest.mark.parametrize("name", ["radial-2-3/corners", "radial-2-3/lines"])
def test_where_errors_go_together_the_best_lies_nearer_to_what_is_stated(name: str) -> None:
    """A solve with accordingly less weight for the observations moves everything by the predicted amount."""
    whole, found = problem(name)
    scales = 0.3, 3.0  # px
    short, wide = (replace(whole, weighting=Weighting(one, one, "trivial", 3.0)) for one in scales)
    here, best = (solve(one, found).estimate for one in (short, wide))
    says, says_less = (information(one, here) for one in (short, wide))
    keys = says.shared.keys
    moved_by, said = difference(best, here, keys), to_best(says_less.shared, says)
    sd = says_less.shared.spread.sd
    assert np.max(np.abs(moved_by) / sd) > 0.2  # 0.49 and 0.45
    assert said / sd == pytest.approx(moved_by / sd, abs=0.02)  # 0.004 measured


# ---- in a calibration -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise_scale", ["estimate", "stated"])
def test_a_calibration_knows_how_well_it_is_known(noise_scale: str) -> None:
    """With the estimated noise, four times the stated one, or with the stated one."""
    observations = simulate(SCENES["radial-2-3/lines"](), NOISE, 1).observations
    stated = replace(observations, curves=replace(observations.curves, sigma_px=0.25 * observations.curves.sigma_px))
    told = calibrate(
        observations,
        Options(usual_camera=False, lens="radial", noise_scale="stated", loss="trivial", reject_sigma=50.0),
    ).posterior
    found = calibrate(
        stated, Options(usual_camera=False, lens="radial", noise_scale=noise_scale, loss="trivial", reject_sigma=50.0)
    )
    assert told is not None and found.posterior is not None
    assert found.posterior.by_model is not None and told.by_model is not None
    ratio = found.posterior.by_model.spread.sd / told.by_model.spread.sd
    assert ratio == pytest.approx(np.full(11, 0.25 * found.fit.curve_scale), rel=1e-3)
    assert (found.posterior.degrees_of_freedom < np.inf) == (noise_scale == "estimate")


def test_the_closed_form_alone_knows_nothing_of_it() -> None:
    observations = simulate(SCENES["radial-2-3/corners"](), NOISE, 1).observations
    assert calibrate(observations, Options(usual_camera=False, lens="radial", closed_form_only=True)).posterior is None
