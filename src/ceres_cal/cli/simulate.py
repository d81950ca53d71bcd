"""`ceres-cal simulate`: observations whose truth is known, to try things on."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ceres_cal.base.errors import InputError
from ceres_cal.base.words import plural
from ceres_cal.cli.command import Answer, Command
from ceres_cal.cli.outputs import finishing

if TYPE_CHECKING:
    from ceres_cal.simulate import Simulation


def _add_arguments(parser: ArgumentParser) -> None:
    add = parser.add_argument
    add("scene", nargs="?", metavar="SCENE", help="name of a built-in scene, or a scene file (.json)")
    add("-o", "--output", metavar="DIR", type=Path, help="folder for observations.json and truth.json; made if missing")
    add("--seed", type=int, default=0, metavar="N", help="the same seed gives the same observations; default: 0")
    add("--list", action="store_true", help="list the built-in scenes")


def _run(args: Namespace) -> Answer:
    from ceres_cal.simulate import built_in_scene, load_scene, scene_names, simulate, write_simulation

    scenes = scene_names()
    if args.list:
        width = max(map(len, scenes))
        return Answer({"scenes": scenes}, lambda: "\n".join(f"{name:{width}}  {text}" for name, text in scenes.items()))
    if args.scene is None or args.output is None:
        raise InputError(
            "name a scene and a folder, as in `ceres-cal simulate ssl-field -o DIR`; --list shows the scenes"
        )
    if args.seed < 0:
        raise InputError(f"--seed must be a whole number from 0 on, not {args.seed}")
    if args.output.exists() and not args.output.is_dir():
        raise InputError(f"{args.output}: is a file: name a folder")
    is_file = args.scene not in scenes and (Path(args.scene).exists() or args.scene.endswith(".json"))
    scene, disturbance = load_scene(args.scene) if is_file else built_in_scene(args.scene)
    simulation = simulate(scene, disturbance, args.seed)
    with finishing():
        write_simulation(simulation, args.output)
    data = _data(simulation, args.scene, args.output)
    return Answer(data, lambda: _text(data))


COMMANDS = (
    Command(
        "simulate",
        "make observations of a scene, with noise and errors, and their truth",
        _add_arguments,
        _run,
        ("ssl-field -o try/", "two-cameras -o try/ --seed 3", "--list"),
    ),
)


def _data(simulation: Simulation, scene: str, folder: Path) -> dict[str, Any]:
    from ceres_cal.simulate import OUTLIER, WRONG_LABEL

    observations, truths = simulation.observations, (simulation.points, simulation.curves)
    return {
        "scene": scene,
        "seed": simulation.seed,
        "observations": str(folder / "observations.json"),
        "truth": str(folder / "truth.json"),
        "views": len(observations.views),
        "points": len(observations.points),
        "curves": len(observations.curves),
        "outliers": sum(len(truth.rows(OUTLIER)) for truth in truths),
        "wrong_labels": sum(len(truth.rows(WRONG_LABEL)) for truth in truths),
    }


def _text(data: dict[str, Any]) -> str:
    return (
        f"{data['observations']}: {plural(data['views'], 'view')}, {plural(data['points'], 'point observation')}, "
        f"{plural(data['curves'], 'curve observation')}, of them {plural(data['outliers'], 'outlier')} and "
        f"{plural(data['wrong_labels'], 'wrong label')}\n"
        f"{data['truth']}: what is true of them"
    )
