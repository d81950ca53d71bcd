"""Prior knowledge in one form: stated numbers, tolerances and posteriors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
from hypothesis import given
from hypothesis import strategies as st
from scenes import RADIAL

from ceres_cal.base.errors import InputError
from ceres_cal.base.transforms import Pose, rotation_exp
from ceres_cal.observations import Observations, Prior
from ceres_cal.observations.sights import gather_sights
from ceres_cal.problem.information import Information, Key, pose_keys
from ceres_cal.problem.parameters import Estimate, Options, Station, make_layout
from ceres_cal.problem.priors import USUAL_BENDS, GaussianPrior, gather_priors, stated_prior, tolerances
from ceres_cal.problem.problem import Problem
from ceres_cal.problem.quantities import intrinsic_keys, moved
from ceres_cal.problem.structure import Tolerance, make_structure
from ceres_cal.scene.lens import LENSES, Brown, Radial
from ceres_cal.scene.targets import ssl_field
from ceres_cal.simulate import Disturbance, simulate

PHI = Key("camera", "overhead", "phi", "px")
HEIGHT = Key("station", "overhead", "height", "m")
FIELD = ssl_field("B")


def observed() -> Observations:
    return simulate(scenes.SCENES["radial-2-3/corners"](), Disturbance(), 0).observations


def estimated(tolerances: dict[str, Tolerance] | None = None) -> Estimate:
    scene = scenes.SCENES["radial-2-3/corners"]()
    stations = {name: Station(place.camera, place.cam_from_world) for name, place in scene.stations.items()}
    return Estimate(scene.cameras, stations, scene.placements, make_structure(scene.targets, tolerances or {}))


# ---- stated ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "prior, quantities",
    [
        (Prior("camera", "overhead", "phi", (868.0,), (5.0,)), ["phi"]),
        (Prior("camera", "overhead", "principal_point", (640.0, 480.0), (2.0, 3.0)), ["cx", "cy"]),
        (Prior("camera", "overhead", "a2", (-5e-5,), (1e-6,)), ["a2"]),
        (Prior("station", "overhead", "height_m", (4.0,), (0.01,)), ["height"]),
        (Prior("station", "overhead", "position_m", (1.0, 2.0, 4.0), (0.1, 0.2, 0.01)), ["x", "y", "height"]),
    ],
)
def test_a_stated_prior_is_its_numbers_and_sigmas(prior: Prior, quantities: list[str]) -> None:
    stated = stated_prior(prior, Radial((0.0, 0.0)))
    every = {"camera": intrinsic_keys("overhead", Radial((0.0, 0.0))), "station": pose_keys("station", "overhead")}
    assert [key.quantity for key in stated.keys] == quantities
    assert set(stated.keys) <= set(every[prior.owner])
    assert stated.mean.tolist() == list(prior.value)
    assert stated.information.spread.sd == pytest.approx(prior.sigma, rel=1e-12)
    assert not stated.rotations


def test_a_lens_without_such_a_number() -> None:
    prior = Prior("camera", "overhead", "a2", (0.0,), (0.1,))
    with pytest.raises(InputError, match=r"camera 'overhead': it has no 'a2', only phi, aspect, cx, cy, k1"):
        stated_prior(prior, Brown((0.0,) * 5))


def test_priors_of_file_and_options_come_together() -> None:
    one = Prior("camera", "overhead", "phi", (800.0,), (5.0,))
    two = Prior("station", "overhead", "height_m", (4.0,), (0.01,))
    seen = replace(observed(), priors=(one,))
    first, second = gather_priors(
        seen, Options(lens="radial", usual_camera=False, priors=(two,)), estimated().structure
    )
    assert (first.keys, first.mean.tolist()) == ((PHI,), [800.0])
    assert (second.keys, second.mean.tolist()) == ((HEIGHT,), [4.0])


@pytest.mark.parametrize(
    "prior, message",
    [
        (Prior("camera", "b", "phi", (800.0,), (5.0,)), "no camera 'b': choose one of overhead"),
        (Prior("station", "b", "height_m", (4.0,), (0.1,)), "no station 'b': choose one of overhead"),
        (Prior("camera", "overhead", "k1", (0.0,), (0.1,)), "it has no 'k1', only phi, aspect, cx, cy, a2, a3"),
    ],
)
def test_priors_on_what_is_not_there(prior: Prior, message: str) -> None:
    with pytest.raises(InputError, match=message):
        gather_priors(observed(), Options(lens="radial", priors=(prior,)), estimated().structure)


def test_tolerances_are_priors_of_mean_nought() -> None:
    structure = make_structure({"field": FIELD}, {"field": Tolerance(lines_m=0.01)})
    (prior,) = gather_priors(
        replace(observed(), targets={"field": FIELD}), replace(RADIAL, usual_camera=False), structure
    )
    assert [key.structure_name for key in prior.keys] == list(structure.names)
    assert not np.any(prior.mean)
    assert prior.information.spread.sd == pytest.approx(structure.sigma_m, rel=1e-12)
    (rest,) = tolerances(structure, prior.keys[1:])
    assert rest.keys == prior.keys[:1]
    assert not list(tolerances(structure, prior.keys))
    assert not list(tolerances(make_structure({"field": FIELD}, {})))


# ---- offsets and residuals ------------------------------------------------------------------------------------------


def known_prior(estimate: Estimate, seed: int = 0) -> GaussianPrior:
    """A prior on all free numbers together."""
    keys = [*intrinsic_keys("overhead", estimate.cameras["overhead"].lens), *pose_keys("station", "overhead")]
    keys += [Key.of_structure(name) for name in estimate.structure.names]
    rng = np.random.default_rng(seed)
    rows = rng.standard_normal((2 * len(keys), len(keys))) / np.array([SIZES.get(key.unit, 1e-2) for key in keys])
    return GaussianPrior.about(Information(tuple(keys), rows.T @ rows), estimate)


SIZES = {"px": 1.0, "m": 1e-2, "rad": 1e-2, "px^-1": 1e-6, "px^-2": 1e-9}


@given(st.integers(0, 2**31))
def test_offsets_are_the_steps_from_the_mean(seed: int) -> None:
    estimate = estimated({"field": Tolerance(lines_m=0.01)})
    prior = known_prior(estimate)
    sizes = np.array([SIZES.get(key.unit, 1e-2) for key in prior.keys])
    step = sizes * np.random.default_rng(seed).standard_normal(len(prior.keys))
    away = moved(estimate, prior.keys, step)
    assert prior.offsets(away) / sizes == pytest.approx(step / sizes, abs=1e-8)
    assert prior.residuals(away) == pytest.approx(prior.information.root @ step, abs=1e-6)
    chi_squared = step @ prior.information.matrix @ step
    assert np.sum(prior.residuals(away) ** 2) == pytest.approx(chi_squared, rel=1e-8)
    assert np.max(np.abs(prior.residuals(estimate))) < 1e-6


def test_turns_count_from_the_mean_even_near_half_a_turn() -> None:
    """About the camera's own axes; rotation vectors jump there, rotations do not."""
    estimate = estimated()
    pose = Pose.exp([np.pi - 1e-4, 0.0, 0.0, 0.1, 0.2, 4.0])
    here = replace(estimate, stations={"overhead": Station("overhead", pose)})
    prior = GaussianPrior.about(Information.of_sigmas(dict.fromkeys(pose_keys("station", "overhead")[3:], 1e-3)), here)
    assert not np.any(prior.mean)
    turn = np.array([2e-3, 1e-3, -1e-3])
    turned = Pose.looking(pose.position + 0.5, rotation_exp(turn) @ pose.rotation)
    there = replace(here, stations={"overhead": Station("overhead", turned)})
    assert prior.offsets(there) == pytest.approx(turn, abs=1e-12)
    assert prior.residuals(there) == pytest.approx(1e3 * turn, abs=1e-9)
    one = prior.given(prior.keys[1:2])
    assert one.offsets(there) == pytest.approx(turn[1:2], abs=1e-12)


# ---- some of its numbers --------------------------------------------------------------------------------------------


def test_given_and_without() -> None:
    estimate = estimated()
    prior = known_prior(estimate)
    given, without = prior.given({PHI, HEIGHT}), prior.without({PHI, HEIGHT})
    assert given.keys == (PHI, HEIGHT)
    assert without.keys == tuple(key for key in prior.keys if key not in given.keys)
    for part, information in (
        (given, prior.information.given(given.keys)),
        (without, prior.information.marginal(without.keys)),
    ):
        assert part.information.matrix == pytest.approx(information.matrix, rel=1e-12)
        assert part.mean.tolist() == prior.mean[prior.information.columns(part.keys)].tolist()
    assert prior.without([Key("camera", "another", "phi", "px")]) is prior
    assert prior.given([]).keys == ()
    assert prior.given([]).residuals(estimate).shape == (0,)


@given(st.integers(0, 2**31))
def test_given_where_an_estimate_has_the_others(seed: int) -> None:
    """The rise of the whole prior above its minimum with those numbers fixed, for any change of the others."""
    estimate, rng = estimated({"field": Tolerance(lines_m=0.01)}), np.random.default_rng(seed)
    prior = known_prior(estimate, seed)
    small = {**SIZES, "rad": 1e-5}  # rotations do not add up
    sizes = np.array([small.get(key.unit, 1e-2) for key in prior.keys])
    held = moved(estimate, prior.keys, sizes * rng.standard_normal(len(prior.keys)))
    free = [key for number, key in enumerate(prior.keys) if number % 3]
    given = prior.given(free, held)
    steps = sizes[prior.information.columns(free)] * rng.standard_normal((2, len(free)))
    costs = np.array([[one.cost(moved(held, free, step)) for step in steps] for one in (prior, given)])
    assert costs[0, 1] - costs[0, 0] == pytest.approx(costs[1, 1] - costs[1, 0], rel=1e-2, abs=1e-2)


def test_of_numbers_that_are_held_a_problem_hears_nothing() -> None:
    """The other numbers of the prior still count, given the fixed ones; a prior uses up no equation."""
    estimate, seen = estimated(), observed()
    options = Options(lens="radial", usual_camera=False, fixed={"cx": 651.3})
    prior = known_prior(estimate)
    problem = Problem(gather_sights(seen), make_layout(seen, options), (prior,), options=options)
    (heard,) = problem.priors_at(estimate)
    assert [key.quantity for key in prior.keys if key not in heard.keys] == ["aspect", "cx", "skew"]
    assert heard.information.matrix == pytest.approx(prior.information.given(heard.keys).matrix)
    assert problem.unknowns(estimate) == problem.layout.size - len(heard.keys) == 0
    nobody = GaussianPrior(Information.of_sigmas({Key("camera", "overhead", "cx", "px"): 1.0}), np.array([651.3]))
    assert replace(problem, priors=(nobody,)).priors_at(estimate) == []


# ---- usual cameras --------------------------------------------------------------------------------------------------


def test_a_principal_point_that_nobody_states_lies_near_the_middle() -> None:
    """Not if it is stated, fixed by the options, or known from an earlier calibration."""
    seen, structure, options = observed(), estimated().structure, replace(RADIAL, usual_camera=True)
    (usual,) = (one for one in gather_priors(seen, options, structure) if one.is_usual)
    assert [key.quantity for key in usual.logs] == ["phi"]
    assert [key.quantity for key in usual.keys] == ["cx", "cy", "aspect", "phi"]
    assert usual.mean[:2] == pytest.approx(0.5 * (np.array(next(iter(seen.cameras.values()))) - 1.0))
    name = next(iter(seen.cameras))
    stated = replace(options, priors=(Prior("camera", name, "cx", (640.0,), (1.0,)),))
    carried = gather_priors(seen, options, structure, GaussianPrior(usual.information, usual.mean))
    for priors in (gather_priors(seen, RADIAL, structure), carried):
        assert not any(one.is_usual for one in priors)
    (beside,) = (one for one in gather_priors(seen, stated, structure) if one.is_usual)
    assert [key.quantity for key in beside.keys] == ["cy", "aspect", "phi"]


@pytest.mark.parametrize("lens", LENSES)
def test_every_lens_is_little_decentred_as_is_usual(lens: str) -> None:
    options = Options(lens=lens, terms=("tangential",) if "tangential" in LENSES[lens].more_terms else ())
    priors = gather_priors(observed(), options, estimated().structure)
    names = {key.quantity for one in priors if one.is_usual for key in one.keys}
    assert names == {"phi", "cx", "cy", "aspect", *options.blank_lens.tangential}


@given(st.floats(0.05, 20.0))
def test_the_usual_phi_pulls_as_its_cost_rises(ratio: float) -> None:
    """The linearised prior has the derivative of its cost, for lenses of any phi."""
    seen, estimate = observed(), estimated()
    every = gather_priors(seen, replace(RADIAL, usual_camera=True), estimate.structure)
    whole = next(one for one in every if one.logs)
    prior = whole.given(whole.logs)
    (name,), mean = seen.cameras, float(prior.mean[0])

    def at(phi: float) -> Estimate:
        return replace(estimate, cameras={name: replace(estimate.cameras[name], phi=phi)})

    phi, step = ratio * mean, 1e-4 * ratio * mean
    slope = (prior.cost(at(phi + step)) - prior.cost(at(phi - step))) / (2.0 * step)
    local = prior.weighted_at(at(phi))
    pull = 2.0 * float(local.information.matrix[0, 0] * local.offsets(at(phi))[0])
    assert pull == pytest.approx(slope, rel=1e-5, abs=1e-9)
    assert prior.cost(at(phi)) == pytest.approx(prior.cost(at(mean**2 / phi)))  # as far above as below


@given(st.floats(0.0, 1e4))
def test_what_is_usual_gives_way(off: float) -> None:
    """The farther off, the weaker the pull: Cauchy's weight, with the largest pull at its bend."""
    key, estimate = Key("camera", "overhead", "aspect", "1"), estimated()
    aspect = estimate.cameras["overhead"].aspect
    prior = GaussianPrior(Information.of_sigmas({key: 1e-3}), np.array([aspect - 1e-3 * off]), gives_way=True)
    pull = abs(float(prior.weighted_at(estimate).residuals(estimate)[0])) / 1e-3
    sd = float(prior.weighted_at(estimate).information.spread.sd[0])
    assert sd == pytest.approx(1e-3 * np.hypot(1.0, off / USUAL_BENDS))
    assert pull * sd <= 1.001 * off + 1e-12  # rounding
    stated = replace(prior, gives_way=False)
    assert stated.weighted_at(estimate) is stated
