"""Targets: rigid things of known geometry, one module for each kind of them, and the table of the kinds."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from ceres_cal.base.lazy import names_of
from ceres_cal.scene.curves import SIDES as SIDES
from ceres_cal.scene.curves import Arc as Arc
from ceres_cal.scene.curves import Curve as Curve
from ceres_cal.scene.curves import Segment as Segment
from ceres_cal.scene.targets.painted_fields import painted_field as painted_field
from ceres_cal.scene.targets.painted_fields import ssl_field as ssl_field
from ceres_cal.scene.targets.registry import TARGET_KINDS as TARGET_KINDS
from ceres_cal.scene.targets.registry import target_from_spec as target_from_spec
from ceres_cal.scene.targets.registry import target_named as target_named
from ceres_cal.scene.targets.registry import targets_by_name as targets_by_name
from ceres_cal.scene.targets.registry import targets_from_specs as targets_from_specs
from ceres_cal.scene.targets.target import Grid as Grid
from ceres_cal.scene.targets.target import Target as Target
from ceres_cal.scene.targets.target import TargetKind as TargetKind

if TYPE_CHECKING:
    from ceres_cal.scene.targets.april_grids import april_grid as april_grid
    from ceres_cal.scene.targets.checkerboards import checkerboard as checkerboard
    from ceres_cal.scene.targets.circle_grids import circle_grid as circle_grid
    from ceres_cal.scene.targets.custom_targets import custom as custom
    from ceres_cal.scene.targets.marker_targets import Marker as Marker
    from ceres_cal.scene.targets.marker_targets import markers as markers
    from ceres_cal.scene.targets.ring_sheets import rings as rings
    from ceres_cal.scene.targets.tape_grids import tape_grid as tape_grid

__getattr__: Callable[[str], Any] = names_of(
    __name__,
    {
        "april_grid": "april_grids",
        "checkerboard": "checkerboards",
        "circle_grid": "circle_grids",
        "custom": "custom_targets",
        "Marker": "marker_targets",
        "markers": "marker_targets",
        "rings": "ring_sheets",
        "tape_grid": "tape_grids",
    },
)
