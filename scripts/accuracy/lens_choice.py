"""Which lens the default choice takes for scenes with a known lens: python scripts/run.py lens_choice [--help]

The lens radial (2, 3) must be recognised in 95 of 100 runs with 0.3 px of noise: with boards, with a field, and with
both. There is no such rule for other lenses, since the data may not distinguish a lens from one with another name; the
lenses chosen instead are printed. Exits with 1 when a figure is missed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from functools import partial

from runner import Row, script
from scenery import board_scene, field_scene, join, overhead_pose

from ceres_cal.base.transforms import Pose
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.calibration.lens_forms import PAPER
from ceres_cal.problem.parameters import Options
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import Brown, KannalaBrandt, Lens, Radial, Spline
from ceres_cal.scene.targets import checkerboard, ssl_field
from ceres_cal.simulate import Disturbance, Scene, Station, simulate

_NOISE = Disturbance(points_sigma_px=0.3, curves_sigma_px=0.3)
_BOARD, _FIELD = checkerboard(9, 6, 0.1), ssl_field("B")
_ALONG = (-1.2, -4.0, -9.0, -15.0, -21.0, -26.0, -29.0, -30.0, -29.5, -28.0, -27.0)  # px, from the axis to the rim
_ACROSS = (0.9, -1.3, 0.4, 0.7) * 3 + (0.9, -1.3)
LENSES: Mapping[str, tuple[float, Lens]] = {
    PAPER: (868.0, Radial((-5.2e-5, 6.1e-7))),
    "brown k1 k2": (825.0, Brown((-0.24, 0.082, 0.0, 0.0, 0.0))),
    "kannala-brandt k1 k2 p1 p2": (548.0, KannalaBrandt((-0.012, 0.004, 0.0, 0.0, 3e-3, -2e-3), ("tangential",))),
    "spline 2,3": (825.0, Spline((620.0, *_ALONG, *_ACROSS))),
}


def _over(camera: Camera) -> tuple[dict[str, Camera], dict[str, Station]]:
    pose = overhead_pose(-0.5, -1.2, 4.2, tilt_x_deg=-14.0, tilt_y_deg=-11.5, yaw_deg=4.0)
    return {"camera": camera}, {"camera": Station("camera", pose)}


def _boards(camera: Camera, seed: int) -> Scene:
    return board_scene(_BOARD, {"camera": camera}, {"camera": Station("camera", Pose.identity())}, 12, seed)


def _field(camera: Camera, seed: int) -> Scene:
    return field_scene(_FIELD, *_over(camera))


def _both(camera: Camera, seed: int) -> Scene:
    return join(_field(camera, seed), board_scene(_BOARD, *_over(camera), 6, seed))


SCENES: Mapping[str, Callable[[Camera, int], Scene]] = {"boards": _boards, "field": _field, "both": _both}


def choices(scene: str, name: str, runs: int) -> Counter[str]:
    """Counts of the chosen lenses where the true lens has this name."""
    phi, lens = LENSES[name]
    chosen: Counter[str] = Counter()
    for seed in range(runs):
        seen = simulate(SCENES[scene](Camera((1280, 960), phi, (651.3, 468.9), lens), seed), _NOISE, seed)
        choice = calibrate(seen.observations, Options()).lens_choice
        chosen[choice.chosen if choice else ""] += 1
    return chosen


def rows(scene: str, runs: int) -> Iterator[Row]:
    """Share of runs in which each lens is recognised, and the most frequent choices."""
    for name in LENSES:
        chosen = choices(scene, name, runs)
        note = ", ".join(f"{label} {count}" for label, count in chosen.most_common(3))
        least = 0.95 if name == PAPER else 0.0
        yield Row(scene, f"{name}: recognised", chosen[name] / runs, least=least, note=note)


main = script({name: partial(rows, name) for name in SCENES}, __doc__, (100, "runs of each lens"))
