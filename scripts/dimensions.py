"""Fields whose dimensions are not known, from simulated observations and from rendered photographs: how often the truth
lies in the 95 % intervals, and how far off they come out. `python scripts/dimensions.py --runs 60 --photographs 10`
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from rendering.photograph import photograph

from ceres_cal.base.errors import CalibrationError
from ceres_cal.calibrating import calibrate
from ceres_cal.calibration import Calibration
from ceres_cal.model.parameters import Options
from ceres_cal.observations import Prior
from ceres_cal.photographs import Auto, Facing, FieldOptions, detect_field
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import Radial
from ceres_cal.scene.targets import ssl_field
from ceres_cal.simulate import Disturbance, Photography, Scene, Station, field_scene, overhead_pose, simulate

CAMERA = Camera((1280, 960), 600.0, (651.3, 468.9), Radial((-5.2e-5, 6.1e-7)))
KNOWN = {
    "the circle": ("field_length_m", "field_width_m"),
    "the length": ("field_width_m", "penalty_area_depth_m", "penalty_area_width_m", "center_circle_radius_m"),
}
FIELD = ssl_field("B")


def odd_field(names: tuple[str, ...], rng: np.random.Generator, most: float) -> dict[str, float]:
    """Dimensions of a field that is by up to so much another one in those."""
    return {name: FIELD.dimensions[name] * float(rng.uniform(1.0 - most, 1.0 + most)) for name in names}


def scene_of(true: Mapping[str, float], rng: np.random.Generator) -> Scene:
    """A whole field of these dimensions under one camera, tilted by up to 12 degrees."""
    x, y, tilt_x, tilt_y = rng.uniform((-0.5, -0.3, -12.0, -12.0), (0.5, 0.3, 12.0, 12.0))
    pose = overhead_pose(x, y, 5.0, tilt_x, tilt_y, rng.uniform(-10.0, 10.0))
    return field_scene(ssl_field("B", **true), {"a": CAMERA}, {"s": Station("a", pose)}, spacing_m=0.15)


def simulated(seed: int, names: tuple[str, ...]) -> tuple[dict[str, float], Calibration]:
    """Truth, and what comes of observations of a field that is said to be division B's."""
    rng = np.random.default_rng([11, seed])
    true = odd_field(names, rng, 0.15)
    seen = simulate(scene_of(true, rng), Disturbance(0.2, 0.2), seed).observations
    seen = replace(seen, targets={"field": FIELD})
    return true, calibrate(seen, Options(lens="radial", dimensions=tuple(f"field/{name}" for name in names)))


def photographed(seed: int, names: tuple[str, ...], folder: Path) -> tuple[dict[str, float], Calibration]:
    """The same through a rendered photograph, in which the field is found without a start."""
    rng = np.random.default_rng([12, seed])
    true = odd_field(names, rng, 0.08)
    scene = replace(scene_of(true, rng), photography=Photography(robots=4, unevenness=0.15, carpet_texture=0.05))
    path = folder / f"{seed}.png"
    cv2.imwrite(str(path), photograph(scene, "s", "0001", seed=seed).image)
    open_ = tuple(Prior("target", "field", name, (FIELD.dimensions[name],), (np.inf,)) for name in names)
    facing = Auto((Facing("LeftGoalLine", "left"),))
    found = detect_field([path], FIELD, facing, None, FieldOptions("a", "s", lengths=open_))
    return true, calibrate(found.observations, Options())


def row(what: str, outcomes: list[tuple[dict[str, float], Calibration]], failed: list[str], seconds: float) -> str:
    """Coverage and errors, of all dimensions together."""
    inside, errors, scaled = [], [], []
    for true, calibration in outcomes:
        for verdict in calibration.uncertainty.verdicts:
            if verdict.key.kind == "dimension":
                off = verdict.value - true[verdict.key.quantity]
                inside.append(verdict.low <= true[verdict.key.quantity] <= verdict.high)
                errors.append(1e3 * abs(off))
                scaled.append((off / verdict.sd) ** 2)
    if not inside:
        return f"{what:42}none of {len(failed)}: {failed[0]}"
    return (
        f"{what:42}{len(outcomes):4} of {len(outcomes) + len(failed)}   {np.mean(inside):5.3f}   "
        f"{np.sqrt(np.mean(scaled)):4.2f}   {np.median(errors):5.2f}   {np.max(errors):6.2f}   {seconds:.0f} s"
        + "".join(f"\n    {words}" for words in failed)
    )


def main() -> None:
    """Print a row each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=60)
    parser.add_argument("--photographs", type=int, default=10)
    args = parser.parse_args()
    print(f"{'':42}solved    in 95 %  error over sd, rms   median, mm   largest, mm")
    with tempfile.TemporaryDirectory() as folder:
        for known, names in KNOWN.items():
            for what, count in (("observations", args.runs), ("photographs", args.photographs)):
                outcomes, failed, began = [], [], time.monotonic()
                for seed in range(count):
                    try:
                        one = (
                            simulated(seed, names)
                            if what == "observations"
                            else photographed(seed, names, Path(folder))
                        )
                        outcomes.append(one)
                    except CalibrationError as error:
                        failed.append(f"{seed}: {error}")
                if count:
                    print(row(f"{what}, {known} known", outcomes, failed, time.monotonic() - began), flush=True)


if __name__ == "__main__":
    main()
