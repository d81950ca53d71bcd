"""`ceres-cal simulate`: simulated observations with known truth, for experiments."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ceres_cal import simulate
from ceres_cal.base import InputError, plural
from ceres_cal.cli.arguments import output_option
from ceres_cal.cli.command import argument, command, option, switch, whole
from ceres_cal.cli.files import finishing, require_folder
from ceres_cal.report.document import Document, Section


@command(
    "simulate",
    "make observations of a scene, with noise and errors, and their truth",
    "ssl-field -o try/",
    "two-cameras -o try/ --seed 3",
    "--list",
)
def _run(
    scene: str | None = argument("SCENE", "name of a built-in scene, or a scene file (.json)", None),
    output: Path | None = output_option("observations.json and truth.json; made if missing", None, "DIR"),
    seed: int = option("the same seed gives the same observations", "N", 0, read=whole(0)),
    list: bool = switch("list the built-in scenes"),
) -> Document:
    from ceres_cal.simulate import built_in_scene, load_scene, scene_names, simulate, write_simulation

    scenes = scene_names()
    if list:
        width = max(map(len, scenes))
        lines = [f"{name:{width}}  {text}" for name, text in scenes.items()]
        return Document((Section("", lines, {"scenes": scenes}),))
    if scene is None or output is None:
        raise InputError(
            "name a scene and a folder, as in `ceres-cal simulate ssl-field -o DIR`; --list shows the scenes"
        )
    require_folder(output)
    is_file = scene not in scenes and (Path(scene).exists() or Path(scene).suffix)
    simulation = simulate(*(load_scene(scene) if is_file else built_in_scene(scene)), seed)
    with finishing():
        write_simulation(simulation, output)
    return Document((_section(simulation, scene, output),))


def _section(simulation: simulate.Simulation, scene: str, folder: Path) -> Section:
    observations, truths = simulation.observations, (simulation.points, simulation.curves)
    data: dict[str, Any] = {
        "scene": scene,
        "seed": simulation.seed,
        "observations": str(folder / "observations.json"),
        "truth": str(folder / "truth.json"),
        "views": len(observations.views),
        "points": len(observations.points),
        "curves": len(observations.curves),
        "outliers": sum(len(truth.rows(simulate.OUTLIER)) for truth in truths),
        "wrong_labels": sum(len(truth.rows(simulate.WRONG_LABEL)) for truth in truths),
    }
    kinds = (("views", "view"), ("points", "point observation"), ("curves", "curve observation"))
    seen = ", ".join(plural(data[name], word) for name, word in kinds)
    wrong = f"{plural(data['outliers'], 'outlier')} and {plural(data['wrong_labels'], 'wrong label')}"
    lines = [f"{data['observations']}: {seen}, of them {wrong}", f"{data['truth']}: what is true of them"]
    return Section("", lines, data)
