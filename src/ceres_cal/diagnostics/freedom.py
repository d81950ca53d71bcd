"""What the free numbers of a calibration can take up of the residuals, and what they must leave.

The linear model of the bundle at its end, in standard deviations: placements that one sight shows are projected out
sight by sight, everything shared by one triangular factor, priors as equations of their own. Then a column over the
equations (an alternative to the model) has a part that the calibration would have absorbed and a part that it cannot;
the score test (Rao 1948) looks at the second part alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ceres_cal.base.arrays import Array, Indices, Mask
from ceres_cal.base.transforms import skew
from ceres_cal.diagnostics.equations import Equations
from ceres_cal.model.parameters import Estimate, Layout, Station, intrinsics_vector
from ceres_cal.model.structure import Structure
from ceres_cal.solve import prior_on_intrinsics, private_placements

_SINGULAR = 1e-12  # share of its own information that a number must keep beside the others


@dataclass(frozen=True, eq=False)
class Freedom:
    """Equations in standard deviations, and an orthonormal basis of what the free numbers do to them.

    Attributes:
        weight: (E,) 1 / standard deviation, px^-1. used: (E,) which equations take part.
        score: (E,) robust residuals, in standard deviations; 0 where an equation is not used.
        private: (E, 6) basis of what each private placement does to its sight's equations, 0 elsewhere.
        shared: (E, P) basis of what shared numbers do beyond that; with priors of less than unit length.
        pull: (P,) how far each direction of `shared` is from its best value, in standard deviations.
        unknowns: how many free numbers the equations determine. prior_equations: how many equations priors add.
    """

    equations: Equations
    weight: Array
    used: Mask
    score: Array
    private: Array
    shared: Array
    pull: Array
    unknowns: int
    prior_equations: int

    @property
    def spare(self) -> int:
        """Equations left over, priors counted."""
        return int(np.count_nonzero(self.used)) + self.prior_equations - self.unknowns

    def beyond_private(self, columns: Array) -> Array:
        """Columns (E, Q), in standard deviations, without what private placements take up."""
        rest = columns.copy()
        for start, stop in self._private_ranges():
            basis, here = self.private[start:stop], columns[start:stop]
            rest[start:stop] -= basis @ (basis[self.used[start:stop]].T @ here[self.used[start:stop]])
        return rest

    def _private_ranges(self) -> list[tuple[int, int]]:
        bounds = self.equations.bounds
        filled = np.flatnonzero(np.any(self.private[bounds[:-1]] != 0.0, axis=1))
        return [(int(bounds[i]), int(bounds[i + 1])) for i in filled]

    @cached_property
    def placed_score(self) -> Array:
        """(E,) `score` with every private placement at its best."""
        return self.beyond_private(self.score[:, None])[:, 0]

    @cached_property
    def left_over(self) -> Array:
        """(E,) the residuals, in standard deviations, once every free number is at its best value; 0 where not used."""
        return np.where(self.used, self.placed_score - self.shared @ self.pull, 0.0)

    def with_columns(self, columns: Array) -> Freedom:
        """The same model with more free numbers: columns (E, Q), in standard deviations, not yet projected."""
        rest = self.beyond_private(columns)
        inside = rest[self.used]
        taken = self.shared[self.used].T @ inside
        normal = inside.T @ inside - taken.T @ taken
        root = inverse_root(normal, np.sum(columns[self.used] ** 2, axis=0), 1e-7)
        basis = (rest - self.shared @ taken) @ root
        pull = root.T @ (inside.T @ self.score[self.used] - taken.T @ self.pull)
        return replace(
            self,
            shared=np.hstack([self.shared, basis]),
            pull=np.concatenate([self.pull, pull]),
            unknowns=self.unknowns + root.shape[1],
        )

    @cached_property
    def leverage(self) -> Array:
        """(E,) the share of each equation that went into the fit; of unused ones, how much the fit's own uncertainty
        adds to their variance.
        """
        return np.asarray(np.sum(self.private**2, axis=1) + np.sum(self.shared**2, axis=1))

    def overlap(self, first: Indices, second: Indices) -> Array:
        """Entries of the hat matrix between pairs of equations of one sight, (N,)."""
        private = np.sum(self.private[first] * self.private[second], axis=1)
        return np.asarray(private + np.sum(self.shared[first] * self.shared[second], axis=1))


def inverse_root(normal: Array, sizes: Array, least: float) -> Array:
    """W (Q, rank) with W W^T = normal^-1 on what is determined.

    Directions that keep less than `least` of `sizes`, the squared lengths before anything was projected out, are left
    out.
    """
    scale = 1.0 / np.sqrt(np.where(sizes > 0.0, sizes, 1.0))
    values, vectors = np.linalg.eigh(scale[:, None] * normal * scale)
    kept = values > least
    return np.asarray(scale[:, None] * vectors[:, kept] / np.sqrt(values[kept]))


def make_freedom(
    equations: Equations, estimate: Estimate, layout: Layout, weight: Array, used: Mask, robust: Array
) -> Freedom:
    """The linear model of a calibration.

    Args:
        weight: (E,) px^-1. used: (E,). robust: (E,) rho' of each equation's observation.
    """
    score = np.where(used, robust * weight * equations.residual, 0.0)
    columns = _shared_columns(equations, estimate, layout) * weight[:, None]
    private, count = _private_basis(equations, layout, weight, used)
    blank = Freedom(equations, weight, used, score, private, np.zeros((len(equations), 0)), np.zeros(0), count, 0)
    rest = blank.beyond_private(columns)
    prior_rows, prior_values = _prior_equations(estimate, layout, _places(estimate, layout, equations))
    inside = rest[used]
    normal = inside.T @ inside + prior_rows.T @ prior_rows
    sizes = np.sum(columns[used] ** 2, axis=0) + np.sum(prior_rows**2, axis=0)
    root = inverse_root(normal, sizes, _SINGULAR)
    gradient = inside.T @ score[used] + prior_rows.T @ prior_values
    return replace(
        blank,
        shared=rest @ root,
        pull=root.T @ gradient,
        unknowns=count + root.shape[1],
        prior_equations=len(prior_rows),
    )


def _private_basis(equations: Equations, layout: Layout, weight: Array, used: Mask) -> tuple[Array, int]:
    """(E, 6) see `Freedom`, and how many numbers it stands for."""
    basis, count = np.zeros((len(equations), 6)), 0
    private = private_placements(equations.sights, layout)
    for number, key in enumerate(equations.sights.keys):
        if key.placement not in private:
            continue
        here = slice(equations.bounds[number], equations.bounds[number + 1])
        columns = equations.pose[here] * weight[here, None]
        inside = columns[used[here]]
        normal = inside.T @ inside
        root = inverse_root(normal, np.diag(normal), _SINGULAR)
        basis[here, : root.shape[1]] = columns @ root
        count += root.shape[1]
    return basis, count


# ---- where shared numbers stand -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Places:
    """First column of each owner's numbers."""

    cameras: Mapping[str, int]
    stations: Mapping[str, int]
    placements: Mapping[str, int]
    structure: int
    size: int


def _places(estimate: Estimate, layout: Layout, equations: Equations) -> _Places:
    shown = {key.placement for key in equations.sights.keys}
    shared = (layout.placements & shown) - private_placements(equations.sights, layout)
    at = 0
    groups: list[dict[str, int]] = []
    for names, sizes in (
        (list(estimate.cameras), [len(layout.free[name]) for name in estimate.cameras]),
        ([name for name in estimate.stations if name in layout.stations], None),
        ([name for name in estimate.placements if name in shared], None),
    ):
        group = {}
        for number, name in enumerate(names):
            group[name] = at
            at += 6 if sizes is None else sizes[number]
        groups.append(group)
    return _Places(groups[0], groups[1], groups[2], at, at + len(estimate.structure.values))


def _shared_columns(equations: Equations, estimate: Estimate, layout: Layout) -> Array:
    """(E, P) px per free intrinsic, left perturbation of a station or shared placement, and structure number."""
    places = _places(estimate, layout, equations)
    columns = np.zeros((len(equations), places.size))
    for number, key in enumerate(equations.sights.keys):
        here = slice(equations.bounds[number], equations.bounds[number + 1])
        free, at = layout.free[key.camera], places.cameras[key.camera]
        columns[here, at : at + len(free)] = equations.intrinsics[here][:, free]
        station = estimate.stations[key.station].cam_from_world
        if key.station in places.stations:
            # The camera turns about its own origin: what is moved by dw x (R_s t_p) comes on top.
            lever = equations.poses[number, :, 3] - station.translation
            at = places.stations[key.station]
            columns[here, at : at + 6] = equations.pose[here]
            columns[here, at : at + 3] += equations.motion[here] @ -skew(lever)
        if key.placement is not None and key.placement in places.placements:
            at = places.placements[key.placement]
            columns[here, at : at + 3] = equations.pose[here, :3] @ station.rotation
            columns[here, at + 3 : at + 6] = equations.motion[here] @ station.rotation
    add_structure(equations, estimate.structure, columns[:, places.structure :])
    return columns


def add_structure(equations: Equations, structure: Structure, columns: Array) -> None:
    """Add px per metre of each structure number into columns (E, Q)."""
    if not len(structure.values):
        return
    slots, values = structure_columns(equations, structure)
    for k in range(slots.shape[1]):
        rows = np.flatnonzero(slots[:, k] >= 0)
        columns[rows, slots[rows, k]] += values[rows, k]


def structure_columns(equations: Equations, structure: Structure) -> tuple[Indices, Array]:
    """Which structure numbers move each equation, (E, 4), -1 for none, and by how many px per metre, (E, 4).

    Points: x, y, first and second bow. Curves: a segment's offset to the left, or an arc's centre and radius.
    """
    count = len(equations)
    slots, values = np.full((count, 4), -1), np.zeros((count, 4))
    points = np.flatnonzero(~equations.is_curve)
    axes = np.array([equations.moved_along(np.tile(axis, (count, 1))) for axis in np.eye(3)]).T
    feature = equations.feature[points]
    slots[points] = structure.point_slots[feature]
    values[points, :2] = axes[points, :2]
    values[points, 2:] = axes[points, 2:] * structure.bends[feature]
    curves = np.flatnonzero(equations.is_curve)
    track = equations.feature[curves]
    slots[curves, :3] = structure.track_slots[track]
    c, a = equations.sights.tracks[track, 0], equations.sights.tracks[track, 1]
    arc = equations.sights.is_arc[track]
    outward = equations.place[curves] - c
    left = np.column_stack([-a[:, 1], a[:, 0], np.zeros(len(a))])
    radius = np.where(arc[:, None], outward * [1.0, 1.0, 0.0], left)
    radius /= np.maximum(np.linalg.norm(radius, axis=1, keepdims=True), 1e-300)
    full = np.zeros((count, 3))
    full[curves] = radius
    along = equations.moved_along(full)[curves]
    values[curves, 0] = np.where(arc, axes[curves, 0], along)
    values[curves, 1] = np.where(arc, axes[curves, 1], 0.0)
    values[curves, 2] = np.where(arc, along, 0.0)
    return slots, values


# ---- priors ---------------------------------------------------------------------------------------------------------


def _prior_equations(estimate: Estimate, layout: Layout, places: _Places) -> tuple[Array, Array]:
    """What priors say of the shared numbers, as rows (K, P) and values (K,) in their sigmas."""
    rows: list[Array] = [np.zeros((0, places.size))]
    values: list[Array] = [np.zeros(0)]

    def add(block: Array, at: int, value: Array) -> None:
        row = np.zeros((len(block), places.size))
        row[:, at : at + block.shape[1]] = block
        rows.append(row)
        values.append(value)

    for prior in layout.priors:
        if prior.owner == "station":
            if prior.name in places.stations:
                axes = [2] if prior.quantity == "height_m" else [0, 1, 2]
                turning, sigma = _position_columns(estimate.stations[prior.name])[axes], np.asarray(prior.sigma)
                off = estimate.stations[prior.name].cam_from_world.position[axes] - prior.value
                add(turning / sigma[:, None], places.stations[prior.name], off / sigma)
            continue
        at, mean, sigma = prior_on_intrinsics(prior, estimate, layout.free)
        free = layout.free[prior.name]
        off = intrinsics_vector(estimate.cameras[prior.name])[free[at]] - mean
        add(np.eye(len(free))[at] / sigma[:, None], places.cameras[prior.name], off / sigma)
    structure = estimate.structure
    if len(structure.values):
        add(np.diag(1.0 / structure.sigma_m), places.structure, structure.values / structure.sigma_m)
    return np.vstack(rows), np.concatenate(values)


def _position_columns(station: Station) -> Array:
    """(3, 6) how a left perturbation of cam_from_world moves the position -R^T t."""
    pose = station.cam_from_world
    return np.hstack([-pose.rotation.T @ skew(pose.translation), -pose.rotation.T])
