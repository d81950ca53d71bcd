"""Rendered photographs with varied lens, light, blur, wear and robots, whose truth is known, and a real one; accuracy
of lines, crossings and rings that are detected in them.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from rendering.photograph import Photograph, photograph
from rendering.photography import Photography, taken_as
from runner import Row
from scenery import field_scene, overhead_pose

from ceres_cal.base.arrays import Array, Array32, Indices32, Mask
from ceres_cal.base.errors import CalibrationError
from ceres_cal.base.transforms import Pose, rotation_exp
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.detect.crossings import find_crossings
from ceres_cal.detect.images import light
from ceres_cal.detect.photographs import Clicks, FieldDetections, detect_field
from ceres_cal.detect.photographs.follow import follow
from ceres_cal.detect.rings import detect_rings
from ceres_cal.problem.parameters import Options
from ceres_cal.problem.structure import Tolerance
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.curves import along_track, nearest_on_track
from ceres_cal.scene.lens import Brown, KannalaBrandt, Lens, Radial
from ceres_cal.scene.targets import Target, ssl_field
from ceres_cal.simulate import Scene, Station, built_in_scene

LENSES: tuple[tuple[float, Lens], ...] = (
    (868.0, Radial((-5.2e-5, 6.1e-7), (2, 3))),
    (840.0, Radial((6.0e-7,), (3,))),
    (825.0, Brown((-0.24, 0.082, 4e-4, -3e-4, -0.011))),
    (700.0, Radial((0.0, 0.0), (2, 3))),
    (760.0, KannalaBrandt((-0.012, 0.004, -0.003, 0.0006))),
)
OPTIONS = {kind: Options(lens=kind) for kind in ("brown", "kannala-brandt", "radial")}
CORNERS = ("TopLeftCorner", "BottomLeftCorner", "TopHalfwayCrossing", "BottomHalfwayCrossing")
OFF_PX, OFF_DEG, CLICK_PX = 100.0, 5.0, 8.0
NEAR_PX = 1.5
TIGERS_CLICKS = {
    "BottomLeftCorner": (55.0, 984.0),
    "TopLeftCorner": (184.0, 412.0),
    "TopRightCorner": (803.0, -18.0),
    "BottomRightCorner": (1169.0, 933.0),
}
NOT_PAINTED = ("HalfwayLine", "CenterLine", "CenterCircle")


# ---- photographs ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Shot:
    """A photograph of half a division B field, and its truth."""

    scene: Scene
    camera: Camera
    target: Target
    picture: Photograph
    good_light: bool

    @property
    def grey(self) -> Array32:
        return light(self.picture.image)


def varied(seed: int) -> Photography:
    """Light, blur, wear and robots of one photograph; every other one has good light."""
    rng = np.random.default_rng([7, seed])
    how = Photography(
        blur_px=float(rng.uniform(0.4, 1.0)),
        vignetting=float(rng.uniform(0.0, 0.4)),
        unevenness=float(rng.uniform(0.0, 0.3)),
        robots=int(rng.integers(0, 13)),
        balls=int(rng.integers(0, 3)),
        wear=float(rng.uniform(0.0, 0.03)),
        carpet_texture=float(rng.uniform(0.02, 0.08)),
    )
    if seed % 2 == 0:
        return how
    return replace(
        how,
        blur_px=float(rng.uniform(0.4, 1.6)),
        exposure=float(rng.uniform(80.0, 230.0)),
        shadows=int(rng.integers(1, 4)),
        shadow_depth=float(rng.uniform(0.3, 0.6)),
        wear=float(rng.uniform(0.0, 0.2)),
        read_noise=float(rng.uniform(1.0, 4.0)),
        carpet_texture=float(rng.uniform(0.05, 0.2)),
        jpeg_quality=int(rng.integers(75, 100)),
    )


@lru_cache(maxsize=8)
def take(seed: int) -> Shot:
    """Photograph number `seed`."""
    rng = np.random.default_rng(seed)
    phi, lens = LENSES[seed // 2 % len(LENSES)]
    optics = Camera((1280, 960), phi, (640.0 + rng.normal(0.0, 8.0), 480.0 + rng.normal(0.0, 8.0)), lens)
    tilt_x, tilt_y = rng.uniform(-8.0, 8.0, size=2)
    pose = overhead_pose(-2.27, -0.12, 4.02, tilt_x, tilt_y, 90.0 + rng.uniform(-5.0, 5.0))
    field = ssl_field("B")
    scene = field_scene(field, {"overhead": optics}, {"overhead": Station("overhead", pose)})
    scene = taken_as(scene, varied(seed))
    picture = photograph(scene, "overhead", "0001", seed=seed)
    return Shot(scene, scene.camera_at("overhead"), field, picture, seed % 2 == 0)


def turned(camera: Camera, turn: Sequence[float] | Array) -> Camera:
    """The camera rotated in its place by a rotation vector (rad) in its own frame."""
    return camera.at(Pose.looking(camera.position, rotation_exp(turn) @ camera.cam_from_world.rotation))


def off_by(camera: Camera, angle_rad: float, seed: int) -> Camera:
    """The camera rotated by an angle about a random axis in the image plane."""
    direction = np.random.default_rng([3, seed]).uniform(0.0, 2.0 * np.pi)
    return turned(camera, [angle_rad * np.cos(direction), angle_rad * np.sin(direction), 0.0])


def distances_px(shot: Shot, curve: Indices32, pixels: Array) -> Array:
    """(N,) signed distance of pixels from their true curves, px, positive on the left."""
    target, camera = shot.target, shot.camera
    floor = np.column_stack([camera.locate(pixels), np.zeros(len(pixels))])
    tracks, is_arc = target.tracks[0][curve], target.is_arc[curve]
    s = nearest_on_track(tracks, is_arc, floor)
    first, second = np.where(is_arc, np.cos(s), s), np.where(is_arc, np.sin(s), 0.0)
    foot = along_track(tracks, is_arc, s)
    along = np.where(is_arc[:, None], -second[:, None] * tracks[:, 1] + first[:, None] * tracks[:, 2], tracks[:, 1])
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    left = np.column_stack([-along[:, 1], along[:, 0], np.zeros(len(along))])
    there, step_m = camera.project(foot), 1e-3
    tangent = camera.project(foot + step_m * along) - there
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]]) / np.linalg.norm(tangent, axis=1, keepdims=True)
    normal *= np.sign(np.sum(normal * (camera.project(foot + step_m * left) - there), axis=1))[:, None]
    return np.asarray(np.sum((pixels - there) * normal, axis=1))


def hidden_places(shot: Shot, pixels: Array) -> Mask:
    """(N,) whether a place and two pixels around it are hidden; at a robot's rim a search window still sees paint."""
    steps = [(0.0, 0.0), (2.0, 0.0), (-2.0, 0.0), (0.0, 2.0), (0.0, -2.0)]
    return np.asarray(np.all([shot.picture.hides(pixels + step) for step in steps], axis=0))


# ---- figures --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class LineErrors:
    """Errors (N,) px of one photograph's line centres, the same in stated sigmas, and numbers of hidden places."""

    good_light: bool
    errors_px: Array
    pulls: Array
    hidden: int
    hidden_found: int


def line_errors(seed: int) -> LineErrors | None:
    """Errors in one photograph from an initial camera that is some pixels off; None where the field is missed."""
    shot = take(seed)
    start = off_by(shot.camera, NEAR_PX / shot.camera.phi, seed)
    found = follow(shot.grey, shot.target, [start], shot.target.curve_names)
    if not found.holds:
        return None
    lines, rows = found.lines, found.lines.found
    error = distances_px(shot, lines.course.curve[rows], lines.pixels[rows])
    covered = hidden_places(shot, lines.course.pixels)
    counts = int(np.count_nonzero(covered)), int(np.count_nonzero(covered & rows))
    return LineErrors(shot.good_light, error, error / lines.sigma_px[rows], *counts)


def line_figures(seeds: Sequence[int]) -> Iterator[Row]:
    """Line centres and their sigmas in photographs with these numbers."""
    every = [line_errors(seed) for seed in seeds]
    seen = [one for one in every if one is not None]
    missed = len(every) - len(seen)
    yield Row("lines", "photographs where the field was missed", missed, most=0.0, note=f"{len(every)} photographs")
    worst = max(abs(float(np.mean(one.errors_px))) for one in seen)
    yield Row("lines", "largest mean error of one photograph, px", worst, most=0.03)
    if good := [one.errors_px for one in seen if one.good_light]:
        errors = np.concatenate(good)
        yield Row("lines", "mean error of line centres, good light, px", float(np.mean(errors)), 0.0, -0.03, 0.03)
        yield Row("lines", "spread of line centres, good light, px", float(np.std(errors)), most=0.15)
    for good_light, name in ((True, "good"), (False, "bad")):
        if pulls := [one.pulls for one in seen if one.good_light == good_light]:
            pull = np.concatenate(pulls)
            note = f"{len(pull)} observations, largest {np.max(np.abs(pull)):.1f}"
            yield Row("lines", f"spread over stated sigma, {name} light", float(np.std(pull)), 0.0, 0.8, 1.2, note)
    hidden, found = sum(one.hidden for one in seen), sum(one.hidden_found for one in seen)
    yield Row("lines", "observations of what is hidden", found, most=0.0, note=f"of {hidden} places behind robots")


def clicks(shot: Shot, seed: int) -> Clicks:
    """Four corners of the visible half, clicked with random errors."""
    rng = np.random.default_rng([5, seed])
    pixels = shot.camera.project([shot.target.points[name] for name in CORNERS])
    shown = pixels + rng.normal(0.0, CLICK_PX, size=pixels.shape)
    return Clicks({name: (float(x), float(y)) for name, (x, y) in zip(CORNERS, shown, strict=True)})


def _detected(shot: Shot, start: Camera | Clicks, folder: Path) -> FieldDetections:
    path = folder / "photograph.png"
    cv2.imwrite(str(path), shot.picture.image)
    return detect_field([path], shot.target, start)


def floor_error_mm(shot: Shot, camera: Camera) -> Array:
    """Errors of the map on the floor of the half field, at places in view, mm."""
    x, y = np.meshgrid(np.linspace(-4.5, 0.0, 19), np.linspace(-3.0, 3.0, 25))
    floor = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    pixels = shot.camera.project(floor)
    inside = np.all((pixels >= 0.0) & (pixels <= np.array(shot.camera.image_size) - 1.0), axis=1)
    return np.asarray(1e3 * np.linalg.norm(camera.locate(pixels[inside]) - floor[inside, :2], axis=1))


def floor_rows(runs: int) -> Iterator[Row]:
    """From four rough clicks in a photograph to a calibration."""
    means, point_pulls, failed = [], [], 0
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(runs):
            shot = take(seed)
            try:
                found = _detected(shot, clicks(shot, seed), Path(folder))
                calibration = calibrate(found.observations, OPTIONS[shot.camera.lens.kind])
            except CalibrationError as error:
                failed += 1
                print(f"photograph {seed}: {error}", file=sys.stderr)
                continue
            means.append(float(np.mean(floor_error_mm(shot, calibration.station()))))
            (followed,) = found.found.values()
            met, _ = find_crossings(shot.target, followed.camera, followed.lines)
            truth = shot.camera.project(shot.target.point_array[met.feature])
            point_pulls.append(((met.pixels - truth) / met.sigma_px[:, None]).ravel())
    pull = np.concatenate(point_pulls)
    yield Row("clicks to calibration", "mean floor error, mm", float(np.mean(means)), most=1.0, note=f"{runs} runs")
    yield Row("clicks to calibration", "mean floor error of the worst photograph, mm", float(np.max(means)))
    yield Row("clicks to calibration", "photographs without a calibration", failed, most=0.05 * runs)
    yield Row("clicks to calibration", "spread of crossings over stated sigma", float(np.std(pull)))


def start_rows(runs: int) -> Iterator[Row]:
    """Initial cameras that are far off: how many converge, and whether failures are reported."""
    for name, angle in (("100 px off", None), ("5 degrees off, tilt", OFF_DEG), ("5 degrees off, any axis", OFF_DEG)):
        arrived = silent = 0
        for seed in range(runs):
            shot = take(seed)
            if name.endswith("any axis"):
                axis = np.random.default_rng([4, seed]).standard_normal(3)
                start = turned(shot.camera, np.deg2rad(OFF_DEG) * axis / np.linalg.norm(axis))
            else:
                start = off_by(shot.camera, OFF_PX / shot.camera.phi if angle is None else np.deg2rad(angle), seed)
            found = follow(shot.grey, shot.target, [start], shot.target.curve_names)
            if not found.holds:
                continue
            right = bool(np.max(floor_error_mm(shot, found.camera)) < 5.0)
            arrived += right
            silent += not right
        yield Row(f"starts, {name}", "share that arrives", arrived / runs, least=0.95, note=f"{runs} photographs")
        yield Row(f"starts, {name}", "wrong without saying so", silent, most=0.0)


def speed_rows(runs: int) -> Iterator[Row]:
    """Time to search a frame from a good initial camera, and to render it."""
    searched, rendered = [], []
    for seed in range(runs):
        began = time.perf_counter()
        shot = take(seed)
        rendered.append(time.perf_counter() - began)
        grey, start = shot.grey, off_by(shot.camera, NEAR_PX / shot.camera.phi, seed)
        began = time.perf_counter()
        follow(grey, shot.target, [start], shot.target.curve_names)
        searched.append(time.perf_counter() - began)
    yield Row("speed", "a frame is searched, good start, s", float(np.median(searched)), most=0.5)
    yield Row("speed", "a frame is rendered, s", float(np.median(rendered)), most=1.0)


def rings_rows(runs: int) -> Iterator[Row]:
    """The paper's polynomial from photographs of data/field_2004's rings."""
    scene, _ = built_in_scene("rings-2004")
    camera, radii = scene.camera_at("overhead"), scene.targets["rings"].spec["radii_m"]
    lens = camera.lens
    assert isinstance(lens, Radial)
    radius, worst = np.linspace(0.0, camera.corner_radius, 200), 0.0
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(runs):
            path = Path(folder) / "rings.png"
            cv2.imwrite(str(path), photograph(scene, "overhead", "rings", varied(seed), seed).image)
            polynomial = detect_rings(path, radii).polynomial
            solved = np.power.outer(radius, [1, 2, 3]) @ (polynomial / polynomial[0])
            worst = max(worst, float(np.max(np.abs(solved - lens.ideal_radius(radius)))))
    yield Row("rings", "worst error of the paper's polynomial, px", worst, most=0.3, note=f"{runs} photographs")


def real_target() -> Target:
    """A field with the proportions in the real photograph; its size is unknown, 4.05 m is a guess."""
    length, width = 4.05, 3.0
    return ssl_field(
        "B",
        field_length_m=length,
        field_width_m=width,
        penalty_area_depth_m=0.15 * length,
        penalty_area_width_m=0.4 * width,
        line_thickness_m=0.02,
    )


def real_detection(folder: Path) -> tuple[Path, FieldDetections]:
    """Detection in the real photograph of `ssl_tigers_line_corners`, from its four published clicks."""
    path = folder / "ssl_tigers_line_corners" / "camera_frame_1224x1024_crop.png"
    target = real_target()
    painted = [name for name in target.curve_names if name not in NOT_PAINTED]
    return path, detect_field([path], target, Clicks(TIGERS_CLICKS), painted)


def real_calibration(found: FieldDetections) -> Calibration:
    """The camera that took the real photograph."""
    tolerances = {"field": Tolerance(lines_m=0.03, points_m=0.03)}
    return calibrate(found.observations, Options(lens="radial", tolerances=tolerances))


def real_rows(
    folder: Path, picture: Path | None, made: tuple[tuple[Path, FieldDetections], Calibration] | None = None
) -> Iterator[Row]:
    """A real photograph of a field of unknown size: lines followed, and their residuals with free dimensions.

    Args:
        made: results of earlier `real_detection` and `real_calibration`.
    """
    path, found = made[0] if made else real_detection(folder)
    followed = found.found[str(path)]
    lines, names = followed.lines, real_target().curve_names
    for number in np.unique(lines.course.curve):
        share = float(np.mean(lines.found[lines.course.curve == number]))
        yield Row("real photograph", f"share of {names[number]} followed", share, least=0.3)
    calibration = made[1] if made else real_calibration(found)
    yield Row("real photograph", "rms of line residuals, px", calibration.fit.curves_rms_px, most=0.7)
    taken_out = sum(entry.kind == "curve" for entry in calibration.rejected)
    yield Row("real photograph", "line observations taken out", taken_out, note=f"of {len(lines.course)} places")
    if picture is not None:
        draw(path, found, picture)


def draw(path: Path, found: FieldDetections, picture: Path) -> None:
    """Draws the photograph with the model (yellow; red where it was not found) and line centres (blue)."""
    image = cv2.imread(str(path))
    assert image is not None
    lines = found.found[str(path)].lines
    for (x, y), seen in zip(lines.course.pixels, lines.found, strict=True):
        cv2.circle(image, (round(x), round(y)), 2, (0, 255, 255) if seen else (0, 0, 255), -1)
    for x, y in lines.pixels[lines.found]:
        cv2.circle(image, (round(16 * x), round(16 * y)), 20, (255, 0, 0), -1, cv2.LINE_AA, 4)
    cv2.imwrite(str(picture), image)
