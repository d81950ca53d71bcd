"""The joint prior's block: root (x - mean) over every camera, station and structure number that it speaks of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pyceres

from ceres_cal.base.arrays import Array
from ceres_cal.base.transforms import Pose, left_jacobian, rotation_exp, rotation_log, skew
from ceres_cal.model.joint import JointPrior
from ceres_cal.model.parameters import (
    Estimate,
    Layout,
    Station,
    intrinsic_names,
    intrinsics_scales,
    intrinsics_vector,
)
from ceres_cal.model.quantities import STATION_QUANTITIES, Key, difference, places_of
from ceres_cal.solve.costs import Run


def offsets(joint: JointPrior, estimate: Estimate) -> Array:
    """(K,) estimate less mean, along the joint prior's keys."""
    here = estimate.stations
    stations = {name: Station(here[name].camera, pose) for name, pose in joint.stations.items() if name in here}
    names, values = estimate.structure.names, estimate.structure.values
    mean = [joint.structure.get(name, value) for name, value in zip(names, values.tolist(), strict=True)]
    reference = replace(
        estimate,
        cameras={**estimate.cameras, **joint.cameras},
        stations={**estimate.stations, **stations},
        structure=estimate.structure.with_values(np.array(mean)),
    )
    return difference(estimate, reference, [Key(*key) for key in joint.keys])


class JointPriorCost(pyceres.CostFunction):
    """root (x - mean), in standard deviations; numbers that are held add what they are off by.

    Attributes:
        owners: whose blocks the solver hands over, as ("camera" or "station", name), or ("structure", "").
    """

    def __init__(self, run: Run, joint: JointPrior, estimate: Estimate, layout: Layout) -> None:
        super().__init__()
        self._run, self._root = run, joint.root
        self._held = offsets(joint, estimate)
        self._parts: list[_Part] = []
        self.owners: list[tuple[str, str]] = []
        structure = [place for place, key in enumerate(joint.keys) if key[0] == "structure"]
        groups = {k: v for k, v in places_of([Key(*key) for key in joint.keys]).items() if k[0] != "structure"}
        for (kind, name), places in groups.items():
            part: _Part | None = None
            if kind == "camera" and len(layout.free[name]):
                part = _camera_part(joint, name, places, estimate, layout)
            elif kind == "station" and name in layout.stations:
                part = _StationPart(joint, name, places)
            if part is not None:
                self._parts.append(part)
                self.owners.append((kind, name))
        if structure:
            self._parts.append(_structure_part(joint, structure, estimate))
            self.owners.append(("structure", ""))
        self.set_num_residuals(len(self._root))
        self.set_parameter_block_sizes([part.size for part in self._parts])

    def Evaluate(self, parameters: Sequence[Array], residuals: Array, jacobians: Sequence[Array] | None) -> bool:
        try:
            off, slopes = self._held.copy(), []
            for part, values in zip(self._parts, parameters, strict=True):
                off[part.places], slope = part.off(values)
                slopes.append(self._root[:, part.places] @ slope)
            residuals[:] = self._root @ off
            for jacobian, slope in zip(jacobians or (), slopes, strict=False):
                jacobian[:] = slope.reshape(-1)
        except BaseException as error:  # an exception must not travel through C++: the solve ends, then it is raised
            self._run.failure = self._run.failure or error
            return False
        return True


class _LinearPart:
    """Numbers of one block: (values - mean) * scale, and the constant slope."""

    def __init__(self, places: Sequence[int], at: Sequence[int], mean: Array, scale: Array, size: int) -> None:
        self.places, self._at, self._mean, self._scale, self.size = list(places), list(at), mean, scale, size
        self._slope = np.zeros((len(self._at), size))
        self._slope[np.arange(len(self._at)), self._at] = scale

    def off(self, values: Array) -> tuple[Array, Array]:
        return (values[self._at] - self._mean) * self._scale, self._slope


class _StationPart:
    """A station's shift of position and turn about its own axes, from its mean."""

    size = 6

    def __init__(self, joint: JointPrior, name: str, places: Sequence[int]) -> None:
        self.places, self._mean = list(places), joint.stations[name]
        self._rows = [STATION_QUANTITIES.index(joint.keys[place][2]) for place in places]

    def off(self, values: Array) -> tuple[Array, Array]:
        pose = Pose.exp(values)
        turn = rotation_log(pose.rotation @ self._mean.rotation.T)
        inverse, left = rotation_exp(values[:3]).T, left_jacobian(values[:3])
        slope = np.zeros((6, 6))
        slope[:3] = np.hstack([-inverse @ skew(values[3:]) @ left, -inverse])
        slope[3:, :3] = np.linalg.solve(left_jacobian(turn), left)
        return np.concatenate([pose.position - self._mean.position, turn])[self._rows], slope[self._rows]


_Part = _LinearPart | _StationPart


def _camera_part(
    joint: JointPrior, name: str, places: Sequence[int], estimate: Estimate, layout: Layout
) -> _LinearPart | None:
    camera, mean = estimate.cameras[name], intrinsics_vector(joint.cameras[name])
    names, free = intrinsic_names(camera.lens), layout.free[name].tolist()
    wanted = {place: names.index(joint.keys[place][2]) for place in places}
    moving = [place for place in places if wanted[place] in free]
    if not moving:
        return None
    numbers = [wanted[place] for place in moving]
    scales = 1.0 / intrinsics_scales(camera)[numbers]
    return _LinearPart(moving, [free.index(number) for number in numbers], mean[numbers], scales, len(free))


def _structure_part(joint: JointPrior, places: Sequence[int], estimate: Estimate) -> _LinearPart:
    names = [f"{joint.keys[place][1]}/{joint.keys[place][2]}" for place in places]
    at = [estimate.structure.names.index(name) for name in names]
    mean = np.array([joint.structure[name] for name in names])
    return _LinearPart(places, at, mean, np.ones(len(at)), len(estimate.structure.names))


def joint_block(run: Run, estimate: Estimate, layout: Layout, blocks: Any) -> tuple[JointPriorCost, list[Array]] | None:
    """The cost of the layout's joint prior and the arrays it depends on; None without one, or where all is held."""
    if layout.joint is None or not layout.joint.rank:
        return None
    cost = JointPriorCost(run, layout.joint, estimate, layout)
    of = {"camera": lambda n: blocks.cameras[n], "station": lambda n: blocks.stations[n]}
    arrays = [of[kind](name) if kind in of else blocks.structure for kind, name in cost.owners]
    return (cost, arrays) if arrays else None
