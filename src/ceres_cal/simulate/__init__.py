"""Simulation of scenes: observations with noise, outliers and hidden stretches, and their truth.

A scene also says how photographs of it look (`Photography`); scripts/rendering draws them.
"""

from ceres_cal.problem.parameters import Station
from ceres_cal.simulate.built_in import built_in_scene, scene_names
from ceres_cal.simulate.compose import (
    BoardRanges,
    board_placements,
    board_pose,
    board_scene,
    field_scene,
    join,
    overhead_pose,
    rings_scene,
    well_inside,
)
from ceres_cal.simulate.files import load_scene, scene_from_json, scene_to_json, truth_to_json, write_simulation
from ceres_cal.simulate.photography import Photography
from ceres_cal.simulate.scene import Disturbance, Scene, ViewPlan
from ceres_cal.simulate.simulation import CLEAN, OUTLIER, WRONG_LABEL, Simulation, Truth, simulate

__all__ = [
    "CLEAN",
    "OUTLIER",
    "WRONG_LABEL",
    "BoardRanges",
    "Disturbance",
    "Photography",
    "Scene",
    "Simulation",
    "Station",
    "Truth",
    "ViewPlan",
    "board_placements",
    "board_pose",
    "board_scene",
    "built_in_scene",
    "field_scene",
    "join",
    "load_scene",
    "overhead_pose",
    "rings_scene",
    "scene_from_json",
    "scene_names",
    "scene_to_json",
    "simulate",
    "truth_to_json",
    "well_inside",
    "write_simulation",
]
