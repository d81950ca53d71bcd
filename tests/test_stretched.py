"""Pictures stretched in one direction, of a field alone, by OpenCV's formulas, without any option."""

import cv2
import numpy as np
import pytest
from thorough import partly

from ceres_cal.base.arrays import Array
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.calibration.stretched import _probability
from ceres_cal.observations import Observations
from ceres_cal.scene.curves import Segment
from ceres_cal.scene.targets import ssl_field

_CAMERAS = {  # phi, centre, k1 k2, rotation, place
    "tilted": (1197.2, (644.7, 505.6), (-0.1405, 0.0052), (-2.9379, -0.0406, 0.7903), (1.116, 1.121, 3.1)),
    "about straight down": (664.5, (634.0, 507.4), (-0.0702, 0.0008), (-2.977, -0.0054, 0.0658), (-1.23, 0.387, 4.692)),
}
_SIZE = (1280, 1024)


class _StretchedCamera:
    """A camera above a division B field with different fx and fy."""

    def __init__(self, camera: str, aspect: float) -> None:
        phi, (x, y), (k1, k2), turn, place = _CAMERAS[camera]
        self.matrix = np.array([[phi, 0.0, x], [0.0, aspect * phi, y], [0.0, 0.0, 1.0]])
        self.lens, self.turn = np.array([k1, k2, 0.0, 0.0, 0.0]), np.array(turn)
        self.shift = -cv2.Rodrigues(self.turn)[0] @ np.array(place)

    def shown(self, places: Array) -> Array:
        """Pixels (N, 2), NaN outside the picture, and beyond a fold of the lens."""
        pixels = np.array(cv2.projectPoints(places, self.turn, self.shift, self.matrix, self.lens)[0], dtype=float)
        flat = pixels.reshape(-1, 2)
        rays = places @ cv2.Rodrigues(self.turn)[0].T + self.shift
        unfolded = np.hypot(rays[:, 0], rays[:, 1]) < rays[:, 2]
        inside = np.all((flat > 2.0) & (flat < np.array(_SIZE) - 3.0), axis=1) & unfolded
        return np.where(inside[:, None], flat, np.nan)

    def seen(self, seed: int, camera: str = "camera") -> Observations:
        """Corners and places on lines, with errors of 0.15 px."""
        field, rng = ssl_field("B"), np.random.default_rng(seed)
        corners = self.shown(field.point_array)
        corners += rng.normal(0.0, 0.15, corners.shape)
        lines = {}
        for name, curve in field.curves.items():
            if isinstance(curve, Segment):
                start, end = np.array(curve.start), np.array(curve.end)
                pixels = self.shown(start + rng.uniform(0.0, 1.0, 40)[:, None] * (end - start))
                pixels = pixels[np.isfinite(pixels[:, 0])]
                if len(pixels) > 3:
                    lines[name] = pixels + rng.normal(0.0, 0.15, pixels.shape)
        points = Observations.from_points(corners, field, _SIZE, sigma_px=0.15, camera=camera)
        return points + Observations.from_curves(lines, field, _SIZE, sigma_px=0.15, camera=camera)


def _off_over_stated(calibration: Calibration, camera: _StretchedCamera, name: str = "camera") -> float:
    """Largest error of places 0.15 m above the field, over its 95 % radius."""
    x, y = np.meshgrid(np.linspace(-4.0, 4.0, 9), np.linspace(-2.5, 2.5, 6))
    places = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 0.15)])
    pixels = camera.shown(places)
    inside = np.isfinite(pixels[:, 0])
    known = calibration.uncertainty.located(pixels[inside], 0.15, station=name)
    return float(np.max(np.linalg.norm(known.located - places[inside, :2], axis=1) / known.radius_95_m))


@pytest.mark.parametrize(("name", "aspect"), [("tilted", 1.0263), ("about straight down", 0.971)])
def test_a_stretched_picture_is_one_by_itself(name: str, aspect: float) -> None:
    """It was taken as square to 0.0005, against 5 standard deviations; errors at robot height were 20 radii."""
    camera = _StretchedCamera(name, aspect)
    calibration = calibrate(camera.seen(3))
    known = calibration.uncertainty.verdict("camera", "camera", "aspect")
    assert _off_over_stated(calibration, camera) < 1.5  # .50 and .32
    assert known.low < aspect < known.high
    assert any("fy / fx" in words for words in calibration.warnings)


@pytest.mark.parametrize("name", _CAMERAS)
def test_square_pixels_stay_square(name: str) -> None:
    camera = _StretchedCamera(name, 1.0)
    calibration = calibrate(camera.seen(4))
    assert abs(calibration.station().aspect - 1.0) < 1e-3
    assert calibration.uncertainty.verdict("camera", "camera", "aspect").sd < 1e-3
    assert _off_over_stated(calibration, camera) < 1.5  # .82 and .20


@pytest.mark.parametrize("aspects", partly([(1.02, 1.02), (1.0, 1.03), (1.0, 1.0)], always=[(1.0, 1.0), (1.02, 1.02)]))
@pytest.mark.thorough
def test_two_cameras_over_one_field_are_asked_as_well(aspects: tuple[float, float]) -> None:
    """Both were taken as square to 0.0005: errors at robot height were 19 radii."""
    cameras = {name: _StretchedCamera(name, aspect) for name, aspect in zip(_CAMERAS, aspects, strict=True)}
    tilted, straight = (camera.seen(5, name) for name, camera in cameras.items())
    calibration = calibrate(tilted + straight)
    for (name, camera), aspect in zip(cameras.items(), aspects, strict=True):
        known = calibration.uncertainty.verdict("camera", name, "aspect")
        assert known.low < aspect < known.high
        assert _off_over_stated(calibration, camera, name) < 1.5  # .06 to .73


def test_what_is_not_told_is_no_stretched_picture() -> None:
    """From straight above fy / fx is open, and the calibration failed: its probability was NaN."""
    assert _probability({}) == _probability({"a": (1.002, np.inf)}) == 0.0
    assert _probability({"a": (1.03, 0.005), "b": (1.0, np.inf)}) == _probability({"a": (1.03, 0.005)}) > 0.9


def test_what_is_usual_of_cameras_is_no_stretched_picture() -> None:
    """fy / fx of 1.0003, known to 3e-5, freed it for every camera of a rig: for one the result was
    0.991 instead of 1.
    """
    assert _probability({"a": (1.0003, 3e-5), "b": (0.991, 0.011)}) < 0.01
