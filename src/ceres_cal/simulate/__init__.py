"""Simulation of scenes: observations with noise, outliers and hidden stretches, and their truth.

A scene may also say how photographs of it look, for scripts/rendering, which draws them.
"""

from ceres_cal.problem.parameters import Station as Station
from ceres_cal.simulate.built_in import built_in_scene as built_in_scene
from ceres_cal.simulate.built_in import scene_names as scene_names
from ceres_cal.simulate.compose import BoardRanges as BoardRanges
from ceres_cal.simulate.compose import board_placements as board_placements
from ceres_cal.simulate.compose import board_pose as board_pose
from ceres_cal.simulate.compose import board_scene as board_scene
from ceres_cal.simulate.compose import field_scene as field_scene
from ceres_cal.simulate.compose import join as join
from ceres_cal.simulate.compose import overhead_pose as overhead_pose
from ceres_cal.simulate.compose import rings_scene as rings_scene
from ceres_cal.simulate.compose import well_inside as well_inside
from ceres_cal.simulate.files import load_scene as load_scene
from ceres_cal.simulate.files import scene_from_json as scene_from_json
from ceres_cal.simulate.files import scene_to_json as scene_to_json
from ceres_cal.simulate.files import truth_to_json as truth_to_json
from ceres_cal.simulate.files import write_simulation as write_simulation
from ceres_cal.simulate.scene import Disturbance as Disturbance
from ceres_cal.simulate.scene import Scene as Scene
from ceres_cal.simulate.scene import ViewPlan as ViewPlan
from ceres_cal.simulate.simulation import CLEAN as CLEAN
from ceres_cal.simulate.simulation import OUTLIER as OUTLIER
from ceres_cal.simulate.simulation import WRONG_LABEL as WRONG_LABEL
from ceres_cal.simulate.simulation import Simulation as Simulation
from ceres_cal.simulate.simulation import simulate as simulate
