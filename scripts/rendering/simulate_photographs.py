"""Observations of a simulated scene, and photographs of it: SCENE -o DIR [--images png|jpg] [--seed N]

Like `ceres-cal simulate` it writes observations.json and truth.json, and also photographs/. Observations that robots
and balls hide in the photographs are left out.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from ceres_cal.base.errors import InputError
from ceres_cal.simulate import built_in_scene, load_scene, scene_names, simulate
from rendering.album import ENDINGS, take_album


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0], allow_abbrev=False)
    parser.add_argument("scene", help=f"a scene file (.json), or one of {', '.join(scene_names())}")
    parser.add_argument("-o", "--output", metavar="DIR", type=Path, required=True, help="made if missing")
    parser.add_argument("--images", choices=ENDINGS, default="png", help="default: png")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="the same seed gives the same; default: 0")
    given = parser.parse_args(arguments)
    if given.seed < 0:
        parser.error(f"--seed must be a whole number from 0 on, not {given.seed}")
    try:
        named = given.scene in scene_names() or not given.scene.endswith(".json")
        scene, disturbance = built_in_scene(given.scene) if named else load_scene(given.scene)
        album = take_album(simulate(scene, disturbance, given.seed), given.images)
        album.write(given.output)
    except InputError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    print(f"{given.output}: observations.json, truth.json, {len(album.images)} photographs")
    return 0
