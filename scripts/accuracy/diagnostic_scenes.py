"""Scenes for the diagnostics: correct ones of every kind, and the same scenes with one fault."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scenery import BoardRanges, board_scene, field_scene, join, overhead_pose

from ceres_cal.base.arrays import Array
from ceres_cal.base.transforms import Pose
from ceres_cal.observations import Observations, Prior
from ceres_cal.problem.parameters import Options
from ceres_cal.problem.structure import Tolerance
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import Brown, KannalaBrandt, Lens, Radial
from ceres_cal.scene.targets import Segment, checkerboard, custom, ssl_field
from ceres_cal.simulate import Disturbance, Scene, Station, built_in_scene, simulate

RADIAL = Options(lens="radial", usual_camera=False)
NOISE = Disturbance(points_sigma_px=0.3, curves_sigma_px=0.3)
OUTLIERS = replace(NOISE, outliers=0.1, hidden_stretches=4, hidden_points=0.1)
USUAL: Lens = Radial((-5.2e-5, 6.1e-7), (2, 3))


def overhead(
    lens: Lens = USUAL, frames: int = 10, boards: int = 6, phi: float = 868.0, height_m: float = 4.02
) -> Scene:
    """One station above half of a division B field, tilted by 7 degrees, and a board at some places."""
    cameras = {"overhead": Camera((1280, 960), 868.0, (646.5, 473.8), lens)}
    pose = overhead_pose(-2.27, -0.12, 4.02, tilt_x_deg=6.8, tilt_y_deg=-2.4, yaw_deg=90.6)
    stations = {"overhead": Station("overhead", pose)}
    field = field_scene(ssl_field("B"), cameras, stations, frames=frames, spacing_m=0.2)
    if not boards:
        return field
    return join(field, board_scene(checkerboard(9, 6, 0.1), cameras, stations, count=boards, seed=1))


def held_boards(lens: Lens, phi: float = 868.0, count: int = 12) -> Scene:
    """A board held in front of one camera at some places."""
    cameras = {"camera": Camera((1280, 960), phi, (646.5, 473.8), lens)}
    stations = {"camera": Station("camera", Pose.identity())}
    return board_scene(checkerboard(9, 6, 0.05), cameras, stations, count=count, seed=3, held=BoardRanges((0.5, 1.5)))


@dataclass(frozen=True)
class Problem:
    """Observations for a seed, and the options of the calibration."""

    observe: Callable[[int], Observations]
    options: Options


def _plain(scene: Callable[[], Scene], disturbance: Disturbance = NOISE, **options: object) -> Problem:
    def observe(seed: int) -> Observations:
        return simulate(scene(), disturbance, seed).observations

    return Problem(observe, Options(**{"lens": "radial", "usual_camera": False, **options}))  # type: ignore[arg-type]


def _with_prior(seed: int) -> Observations:
    height_m = 4.02 + 0.01 * float(np.random.default_rng(seed).standard_normal())
    prior = Prior("station", "overhead", "height_m", (height_m,), (0.01,))
    return replace(simulate(overhead(boards=0), NOISE, seed).observations, priors=(prior,))


CLEAN: dict[str, Problem] = {
    "field and boards": _plain(overhead),
    "field and boards, 10 % outliers": _plain(overhead, OUTLIERS),
    "field alone": _plain(lambda: overhead(boards=0)),
    "field alone, one frame": _plain(lambda: overhead(boards=0, frames=1)),
    "field, height measured": Problem(_with_prior, RADIAL),
    "field, lines solved for": _plain(
        lambda: overhead(boards=0, frames=4), tolerances={"field": Tolerance(lines_m=0.01)}
    ),
    "boards, radial lens": _plain(lambda: held_boards(USUAL)),
    "boards, brown lens": _plain(lambda: held_boards(Brown((-0.24, 0.082, 4e-4, -3e-4, -0.011)), 825.0), lens="brown"),
    "boards, kannala-brandt lens": _plain(
        lambda: held_boards(KannalaBrandt((-0.012, 0.004, -0.003, 0.0006)), 548.0), lens="kannala-brandt"
    ),
    "two cameras, shared boards": _plain(lambda: built_in_scene("two-cameras")[0]),
    "three stations": _plain(lambda: built_in_scene("moved-camera")[0]),
}
"""Data that agree with the model."""


# ---- faults ---------------------------------------------------------------------------------------------------------


def short_polynomial(seed: int) -> Observations:
    """A lens with the paper's two powers, to be calibrated with one."""
    return simulate(overhead(), NOISE, seed).observations


def longer_polynomial(seed: int) -> Observations:
    """A lens with powers 2, 3 and 5, to be calibrated with 2 and 3."""
    return simulate(overhead(Radial((-5.2e-5, 3.1e-7, 5.0e-13), (2, 3, 5))), NOISE, seed).observations


def line_aside(seed: int, line: str = "LeftPenaltyStretch", aside_m: float = 0.012) -> Observations:
    """One line painted to the left of its drawn place; the target is the drawing."""
    scene, drawn = overhead(), ssl_field("B")
    curve = drawn.curves[line]
    assert isinstance(curve, Segment)
    along = np.subtract(curve.end, curve.start)
    move = aside_m * np.array([-along[1], along[0], 0.0]) / np.linalg.norm(along)
    start, end = (tuple(float(v) for v in np.add(place, move)) for place in (curve.start, curve.end))
    painted = custom(drawn.points, {**drawn.curves, line: Segment(start, end, curve.width_m)})  # type: ignore[arg-type]
    seen = simulate(replace(scene, targets={**scene.targets, "field": painted}), NOISE, seed).observations
    order = np.array([drawn.curve_names.index(name) for name in painted.curve_names])
    curves = replace(seen.curves, feature=order[seen.curves.feature])  # boards have no curves
    return Observations({**seen.targets, "field": drawn}, seen.cameras, seen.views, seen.points, curves)


def wrong_label(seed: int) -> Observations:
    """In frame 3 one corner has the name of another."""
    seen = simulate(overhead(), NOISE, seed).observations
    names = seen.targets["field"].point_names
    feature = seen.points.feature.copy()
    view = next(number for number, one in enumerate(seen.views) if one.frame == "0003")
    corner = names.index("TopLeftCorner")
    row = np.flatnonzero((seen.points.view == view) & (feature == corner))[0]
    feature[row] = names.index("LeftFieldRightPenaltyCorner")
    return replace(seen, points=replace(seen.points, feature=feature))


def bumped(seed: int, degrees: tuple[float, float, float] = (0.05, 0.0, 0.0), frames: int = 5) -> Observations:
    """After frame 5 the camera is rotated in place about its own axes."""
    scene = overhead()
    station = scene.stations["overhead"]
    turned = Pose.exp((*np.deg2rad(degrees), 0.0, 0.0, 0.0)) @ station.cam_from_world
    field, *rest = scene.views
    views = (
        replace(field, frames=field.frames[:frames]),
        replace(field, frames=field.frames[frames:], station="after"),
    )
    stations = {"overhead": station, "after": Station("overhead", turned)}
    seen = simulate(replace(scene, stations=stations, views=(*views, *rest)), NOISE, seed).observations
    return replace(seen, views=tuple(replace(view, station="overhead") for view in seen.views))


def noisier(seed: int) -> Observations:
    """Points with twice the noise that is stated."""
    seen = simulate(overhead(), replace(NOISE, points_sigma_px=0.6), seed).observations
    return replace(seen, points=replace(seen.points, sigma_px=0.5 * seen.points.sigma_px))


def agreeing(seed: int) -> Observations:
    """Curve observations whose errors are correlated between neighbours (coefficient 0.5)."""
    seen = simulate(overhead(), NOISE, seed).observations
    rng = np.random.default_rng(seed)
    pixels = simulate(overhead(), Disturbance(), seed).observations.curves.pixels
    noise = rng.standard_normal((len(pixels), 2))
    for row in range(1, len(noise)):
        noise[row] = 0.5 * noise[row - 1] + np.sqrt(0.75) * noise[row]
    return replace(seen, curves=replace(seen.curves, pixels=pixels + 0.3 * noise))


def _displaced(seed: int, shift: Callable[[Array], Array]) -> Observations:
    """Every pixel moved by a displacement (N, 2), a function of its offset from the principal point."""
    seen = simulate(overhead(), NOISE, seed).observations
    middle = overhead().cameras["overhead"].principal_point
    points, curves = (
        np.clip(column.pixels + shift(column.pixels - middle), 0.0, (1279.0, 959.0))
        for column in (seen.points, seen.curves)
    )
    return replace(seen, points=replace(seen.points, pixels=points), curves=replace(seen.curves, pixels=curves))


def skewed(seed: int) -> Observations:
    """Pixels whose axes are skewed by 4 mrad."""
    return _displaced(seed, lambda away: away[:, 1:] * (0.004, 0.0))


def decentred(seed: int) -> Observations:
    """Brown's tangential displacement, 1 px at half the image diagonal, for a lens model that has none."""

    def shift(away: Array) -> Array:
        x, y = away.T / 800.0
        return np.column_stack([2.0 * x * y, x * x + 3.0 * y * y])

    return _displaced(seed, shift)


def _on_floor(seed: int, height_m: Callable[[Array], Array]) -> Observations:
    """The field on a floor whose height (N,) is a function of places (N, 2)."""
    scene = overhead()
    seen = simulate(scene, NOISE, seed).observations
    camera, drawn = scene.camera_at("overhead"), scene.targets["field"]
    world = np.array([view.target == "field" for view in seen.views])
    own, kept = world[seen.points.view], seen.points.pixels.copy()
    ground = drawn.point_array[seen.points.feature[own]], _on_ground(camera, seen.curves.pixels)
    for pixels, rows, places in ((kept, own, ground[0]), (curves := seen.curves.pixels.copy(), slice(None), ground[1])):
        higher = places + np.column_stack([np.zeros((len(places), 2)), height_m(places[:, :2])])
        pixels[rows] += camera.project(higher) - camera.project(places)
    points, curves = (np.clip(pixels, 0.0, (1279.0, 959.0)) for pixels in (kept, curves))
    return replace(seen, points=replace(seen.points, pixels=points), curves=replace(seen.curves, pixels=curves))


def _on_ground(camera: Camera, pixels: Array) -> Array:
    """(N, 3) where rays meet the plane z = 0."""
    rays = camera.rays(pixels) @ camera.cam_from_world.rotation
    return np.asarray(camera.position - rays * (camera.position[2] / rays[:, 2:]))


def bowed_floor(seed: int) -> Observations:
    """A floor that is 15 mm lower at both ends of the half that is seen."""
    return _on_floor(seed, lambda place: -0.015 * ((place[:, 0] + 2.25) / 2.25) ** 2)


def bump(seed: int) -> Observations:
    """A floor with a bump of 20 mm, 1 m wide, on the touch line."""
    return _on_floor(seed, lambda place: 0.02 * np.exp(-2.0 * np.sum((place - (-2.0, 3.0)) ** 2, axis=1) / 0.25))


def drawn_longer(seed: int) -> Observations:
    """A field whose drawing is 45 mm longer than the painted field."""
    seen = simulate(overhead(), NOISE, seed).observations
    return replace(seen, targets={**seen.targets, "field": ssl_field("B", field_length_m=9.045)})


FAULTS: dict[str, tuple[Problem, str, str]] = {
    "polynomial too short (r^2)": (
        Problem(short_polynomial, Options(powers=(3,), usual_camera=False)),
        "radius",
        "overhead",
    ),
    "polynomial too short (r^5)": (Problem(longer_polynomial, RADIAL), "radius", "overhead"),
    "line 12 mm aside": (Problem(line_aside, RADIAL), "curve aside", "field/LeftPenaltyStretch"),
    "one mislabelled corner": (
        Problem(wrong_label, RADIAL),
        "wrong label",
        "field/LeftFieldRightPenaltyCorner",
    ),
    "bumped by 0.05 degrees after frame 5": (Problem(bumped, RADIAL), "moved after", "overhead"),
    "noise of points twice what was stated": (Problem(noisier, RADIAL), "noise", "points"),
    "pixels lean by 4 mrad": (Problem(skewed, RADIAL), "skew", "overhead"),
    "tangential displacement of 1 px": (Problem(decentred, RADIAL), "decentring", "overhead"),
    "floor bowed by 15 mm": (Problem(bowed_floor, RADIAL), "floor bowed", "field"),
    "bump of 20 mm": (Problem(bump, RADIAL), "floor uneven", "field at x -2.0, y 3.0 m"),
    "a field drawn 45 mm longer": (Problem(drawn_longer, RADIAL), "other length", "field/field_length_m"),
    "neighbours along lines agree": (Problem(agreeing, RADIAL), "correlated", "curves"),
}
"""Name -> problem, and kind and subject of the one finding it must give."""
