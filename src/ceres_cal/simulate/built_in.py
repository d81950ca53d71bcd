"""The scenes in the package, files in `scenes/`: `ceres-cal simulate` takes them by name, and the sample data are made
from them.
"""

from __future__ import annotations

from importlib.resources import files

from ceres_cal.base import InputError, no_such, parse_json
from ceres_cal.simulate.files import scene_from_json
from ceres_cal.simulate.scene import Disturbance, Scene

_SCENES = {
    "ssl-field": "one overhead camera over half of a division B field, and boards: data/ssl_field",
    "rings-2004": "the paper's camera before a sheet of concentric rings: data/field_2004/rings.json",
    "field-2004": "the paper's camera over half of a field of 4.9 x 3.4 m: data/field_2004/field.json",
    "two-cameras": "two overhead cameras over a division B field, and boards that both see at once",
    "moved-camera": "one camera at three stations over half of a division B field",
    "photographs": "half of a division B field, to be drawn with robots, lamps, shadows and worn paint",
    "boards": "a checkerboard held before one camera at 20 places",
    "fisheye": "a camera of over 120 degrees over a division B field",
}


def scene_names() -> dict[str, str]:
    """Return the built-in scenes, each with a line of description."""
    return dict(_SCENES)


def built_in_scene(name: str) -> tuple[Scene, Disturbance]:
    """Return a built-in scene and its disturbance.

    Raises:
        InputError: there is none of this name.
    """
    if name not in _SCENES:
        raise InputError(f"{no_such('scene', name, _SCENES)} (or name a file)")
    content = files("ceres_cal.simulate").joinpath("scenes", f"{name}.json").read_bytes()
    return scene_from_json(parse_json(content, name), name)
