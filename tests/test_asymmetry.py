"""Lines beside which something lies on one side only."""

import numpy as np
import pytest
from scenery import overhead_pose

from ceres_cal.base.arrays import Array, Array32
from ceres_cal.detect.courses import predict
from ceres_cal.detect.lines import SPACING_PX, Lines, measure
from ceres_cal.kernels import normal_cdf
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import Radial
from ceres_cal.scene.targets import Segment, custom

BLUR_PX, COUNT = 0.9, 12
CAMERA = Camera((640, 480), 100.0, (319.5, 239.5), Radial((0.0,), (3,)), 1.0, overhead_pose(0.0, 0.0, 5.0))


def measured(seam_px: float, darker: float, rng: np.random.Generator) -> Lines:
    """Twelve lines of 2.4 px, each with a seam of 1 px so far from its middle, darker by so many grey levels."""
    heights, slopes = np.linspace(-9.0, 9.0, COUNT), rng.uniform(-0.03, 0.03, COUNT)
    ends = [
        ((-15.0, y - 15.0 * slope, 0.0), (15.0, y + 15.0 * slope, 0.0))
        for y, slope in zip(heights, slopes, strict=True)
    ]
    target = custom(curves={f"line {k}": Segment(*two, 0.12) for k, two in enumerate(ends)})
    x, y = np.meshgrid(np.arange(640.0), np.arange(480.0))
    image = 60.0 + rng.normal(0.0, 2.0, x.shape)
    for start, end in ends:
        pixels = CAMERA.project(np.array([start, end]))
        along = (pixels[1] - pixels[0]) / np.linalg.norm(pixels[1] - pixels[0])
        away = (x - pixels[0, 0]) * -along[1] + (y - pixels[0, 1]) * along[0]
        image += 110.0 * _stripe(away, 2.4) - darker * _stripe(away - seam_px, 1.0)
    grey: Array32 = np.round(image).astype(np.float32)
    return measure(grey, predict(target, CAMERA, target.curve_names, SPACING_PX, 12.0), 3.0)


def _stripe(away: Array, width_px: float) -> Array:
    blur = np.hypot(BLUR_PX, 12**-0.5)
    return normal_cdf((away + 0.5 * width_px) / blur) - normal_cdf((away - 0.5 * width_px) / blur)


def off_by(found: Lines) -> Array:
    """(12,) the mean error of each line, in units of its standard deviation with places independent."""
    seen, curve = found.found, found.course.curve
    weight = np.where(seen, found.sigma_px**-2.0, 0.0)
    totals = [np.bincount(curve, one, COUNT) for one in (weight * np.nan_to_num(found.offset_px), weight)]
    return np.asarray(totals[0] / np.sqrt(totals[1]))


@pytest.mark.parametrize("seam_px", [2.5, 3.5, 4.5])
def test_a_seam_beside_lines_is_in_their_sigma(seam_px: float) -> None:
    """Without it lines were 6 to 14 standard deviations off."""
    found = measured(seam_px, 10.0, np.random.default_rng(1))
    assert np.mean(found.found) > 0.9
    assert np.median(np.abs(off_by(found))) < 4.0  # 1.5 to 3.5


def test_lines_without_one_keep_their_sigma() -> None:
    found = [measured(3.5, 0.0, np.random.default_rng(seed)) for seed in (1, 2)]
    assert np.sqrt(np.mean([off_by(one) ** 2 for one in found])) < 1.3  # 0.9
    assert all(np.max(one.sigma_px[one.found]) < 0.03 for one in found)  # 0.018
