"""Makes the sample data sets anew, the same bytes every time: python scripts/make_data.py [FOLDER]"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from ceres_cal.files import write_json
from ceres_cal.simulate import Simulation, built_in_scene, simulate, truth_to_json, write_simulation

DATA = Path(__file__).resolve().parents[1] / "data"
SEED = 1
DECIMALS = 4  # px; a hundredth of the least noise would already do, and every machine rounds to the same digits


def sample(scene_name: str) -> Simulation:
    """A built-in scene as it is observed, its pixels rounded."""
    simulation = simulate(*built_in_scene(scene_name), seed=SEED)
    observations = simulation.observations
    points = replace(observations.points, pixels=np.round(observations.points.pixels, DECIMALS))
    curves = replace(observations.curves, pixels=np.round(observations.curves.pixels, DECIMALS))
    return replace(simulation, observations=replace(observations, points=points, curves=curves))


def make_ssl_field(folder: Path) -> None:
    write_simulation(sample("ssl-field"), folder)


def make_field_2004(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    simulations = {"rings.json": sample("rings-2004"), "field.json": sample("field-2004")}
    for name, simulation in simulations.items():
        simulation.observations.save(folder / name)
    write_json(folder / "truth.json", truth_to_json(simulations))


def main(root: Path) -> None:
    make_ssl_field(root / "ssl_field")
    make_field_2004(root / "field_2004")
    for path in sorted(root.glob("*/*.json")):
        print(f"{path.relative_to(root)}: {path.stat().st_size / 1000:.1f} kB")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else DATA)
