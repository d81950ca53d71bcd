"""The observations of a sight as equations that are homogeneous in a ray, for many poses and focal lengths at once.

A pixel at the offset p has the ray L = (p, phi w) in its camera's frame, d = R L in the world. From C it meets a place
P where (P - C) . (a x d) = 0 for two directions a; it meets a straight line through P along a where that is 0; and it
meets an arc around M where |x - M| is its radius, with x = C - (h / d_z) d and h the height over its plane. Each
equation is n . d = 0, with a normal n that for arcs depends on d. Divided by the length of its derivative by p, it is a
distance in px, to first order.
"""

from __future__ import annotations

import numpy as np

from ceres_cal.base import Array, Frozen, Indices, Mask, Rows, cached_property, distinct, medians, skews

LEAST_PX = 1e-3  # least scale of residuals: below it all data count as exact
_LEAST = 1e-12  # least length that is divided by
_RIDGE = 1e-6  # added to squares of order one


class Candidates(Rows):
    """K candidate cameras: frame_from_cam (K, 3, 3), position (K, 3) m, logarithm of phi in px (K,), and an additional
    coefficient of w for r squared (K,).
    """

    rotations: Array
    positions: Array
    log_phi: Array
    bend: Array

    @classmethod
    def none(cls) -> Candidates:
        """No candidates."""
        return cls(np.empty((0, 3, 3)), np.empty((0, 3)), np.empty(0), np.empty(0))

    def moved(self, step: Array) -> Candidates:
        """The candidates after steps (K, 8): a turn, a shift, and increments of the rest."""
        return Candidates(
            _turns(step[:, :3]) @ self.rotations,
            self.positions + step[:, 3:6],
            self.log_phi + step[:, 6],
            self.bend + step[:, 7],
        )

    def where(self, mask: Mask, others: Candidates) -> Candidates:
        """These where the mask (K,) is set, the others elsewhere."""
        mine, theirs = vars(self).values(), vars(others).values()
        return Candidates(
            *(np.where(mask.reshape(-1, *[1] * (a.ndim - 1)), a, b) for a, b in zip(mine, theirs, strict=True))
        )


class CameraPrior(Frozen):
    """Prior knowledge of a camera: means and standard deviations, which are infinite for unknown and 0 for held
    numbers; and the least scale of residuals.
    """

    position: Array
    position_sd: Array
    log_phi: tuple[float, float]
    bend_sd: float
    least_px: float = LEAST_PX

    @cached_property
    def held(self) -> Mask:
        """(8,) mask of the numbers that do not move."""
        sd = np.array([np.inf, np.inf, np.inf, *self.position_sd, self.log_phi[1], self.bend_sd])
        return np.asarray(sd == 0.0)

    @cached_property
    def _share(self) -> Array:
        """(5,) inverse standard deviations, 0 for held numbers."""
        sd = np.array([*self.position_sd, self.log_phi[1], self.bend_sd])
        return np.where(sd > 0.0, 1.0 / np.maximum(sd, 1e-12), 0.0)

    def residuals(self, poses: Candidates) -> tuple[Array, Array]:
        """(K, 5) residuals of the prior in standard deviations, and the diagonal (5,) of their derivatives."""
        share, off = self._share, np.empty((len(poses), 5))
        off[:, :3] = poses.positions - self.position
        off[:, 3], off[:, 4] = poses.log_phi - self.log_phi[0], poses.bend
        return np.where(share > 0.0, off, 0.0) * share, share


class Sightlines(Frozen):
    """Equations of a camera from N rows: points first, twice each (their rows in x, then those in y), then lines, then
    arcs.

    Attributes:
        known: the prior. pixels: (N, 2) offsets p, px. w: (N,). slope: (N,) derivative of w by r, over r.
        unit_px: unit of the radius that the bend multiplies. places: (N, 3) P or M, m. along: (N, 3) a for lines; for
            arcs the radius and two zeros.
        counts: numbers of points, of line rows and of arc rows. curve: (N,) curve of each row, -1 for points.
    """

    known: CameraPrior
    pixels: Array
    w: Array
    slope: Array
    unit_px: float
    places: Array
    along: Array
    counts: tuple[int, int, int]
    curve: Indices

    @cached_property
    def groups(self) -> Indices:
        """(F,) where the rows of each curve begin, after those of points."""
        own = self.curve[self._points.stop :]
        return np.asarray(self._points.stop + np.flatnonzero(np.append(True, own[1:] != own[:-1])[: len(own)]))

    @property
    def spans(self) -> list[tuple[int, int]]:
        """First row of each curve, and the one after its last."""
        return list(zip(self.groups.tolist(), [*self.groups[1:].tolist(), len(self.curve)], strict=False))

    @cached_property
    def weight(self) -> Array:
        """(N,) weight of each row: all rows of a line together count as two numbers, those of an arc as five."""
        weight = np.ones(len(self.curve))
        for first, last in self.spans:
            says = 5.0 if first >= self._arcs.start else 2.0
            weight[first:last] = min(1.0, says / (last - first))
        return weight

    @property
    def independent(self) -> int:
        """Number of independent equations at most: two for each point and line, five for each arc."""
        straight = distinct(self.curve[self._points.stop : self._arcs.start])
        return 2 * self.counts[0] + 2 * len(straight) + 5 * len(distinct(self.curve[self._arcs]))

    @classmethod
    def of_points(cls, known: CameraPrior, pixels: Array, places: Array, unit_px: float, bend: float) -> Sightlines:
        """Equations of places (N, 3) m seen at offsets (N, 2) px by a lens with w = 1 + bend (r / unit_px)^2."""
        twice, count, bent = np.vstack([pixels, pixels]), len(pixels), bend / unit_px**2
        w, slope = 1.0 + bent * np.sum(twice**2, axis=1), np.full(2 * count, 2.0 * bent)
        none, along = np.full(2 * count, -1), np.zeros((2 * count, 3))
        return cls(known, twice, w, slope, unit_px, np.vstack([places, places]), along, (count, 0, 0), none)

    @property
    def _points(self) -> slice:
        return slice(0, 2 * self.counts[0])

    @property
    def _arcs(self) -> slice:
        return slice(2 * self.counts[0] + self.counts[1], None)

    @cached_property
    def _squared(self) -> Array:
        return np.asarray(np.sum(self.pixels**2, axis=1) / self.unit_px**2)

    def _rays(self, log_phi: Array, bend: Array) -> Array:
        """(K, 3, N) L. Here and below, numbers of one component are contiguous in memory."""
        rays = np.empty((len(log_phi), 3, len(self.w)))
        rays[:, :2] = self.pixels.T
        rays[:, 2] = np.exp(log_phi)[:, None] * (self.w + bend[:, None] * self._squared)
        return rays

    def _to(self, poses: Candidates) -> Array:
        """(K, 3, N) P - C."""
        return np.asarray(self.places.T - poses.positions[:, :, None])

    def distances(self, poses: Candidates) -> Array:
        """(K, N) distances, px."""
        d = poses.rotations @ self._rays(poses.log_phi, poses.bend)
        normals = self._normals(self._to(poses), self._directions(poses.rotations), d)
        return _dot(normals, d) * self._shares(poses, np.swapaxes(poses.rotations, 1, 2) @ normals)

    def equations(self, poses: Candidates) -> tuple[Array, Array]:
        """Distances (K, N) px and their derivatives (K, 8, N) by the steps of `Candidates.moved`."""
        rays = self._rays(poses.log_phi, poses.bend)
        d, to, along = poses.rotations @ rays, self._to(poses), self._directions(poses.rotations)
        normals = self._normals(to, along, d)
        before = np.swapaxes(poses.rotations, 1, 2) @ normals  # n in the camera's frame
        share, derivatives = self._shares(poses, before), np.empty((len(d), 8, d.shape[2]))
        derivatives[:, :3], derivatives[:, 3:6] = self._slopes(to, along, d, normals)
        derivatives[:, 6] = before[:, 2] * rays[:, 2]
        derivatives[:, 7] = before[:, 2] * np.exp(poses.log_phi)[:, None] * self._squared
        return _dot(normals, d) * share, derivatives * share[:, None]

    def _shares(self, poses: Candidates, before: Array) -> Array:
        """(K, N) px of distance for each unit of n . d; `before`: n in the camera's frame."""
        bent = self.slope + 2.0 * poses.bend[:, None] / self.unit_px**2
        lean = before[:, 2] * np.exp(poses.log_phi)[:, None] * bent
        across, down = before[:, 0] + lean * self.pixels[:, 0], before[:, 1] + lean * self.pixels[:, 1]
        return np.asarray(1.0 / np.maximum(np.sqrt(across**2 + down**2), _LEAST))

    def _normals(self, to: Array, along: Array, d: Array) -> Array:
        """n (K, 3, N)."""
        normals, straight, arcs = np.empty_like(d), slice(0, self._arcs.start), self._arcs
        normals[:, :, straight] = _cross(to[:, :, straight], along[:, :, straight])
        if self.counts[2]:
            unit = self._outwards(to, d)
            normals[:, :2, arcs] = to[:, 2:, arcs] * unit
            normals[:, 2, arcs] = -_dot(unit, to[:, :2, arcs]) - np.sign(to[:, 2, arcs]) * self.along[arcs, 0]
        return normals

    def _outwards(self, to: Array, d: Array) -> Array:
        """(K, 2, A) unit vectors from an arc's centre to where the ray meets its plane."""
        to, e = to[:, :, self._arcs], d[:, :, self._arcs]
        away = to[:, 2:] * e[:, :2] - to[:, :2] * e[:, 2:]  # times d_z
        return np.asarray(away / np.maximum(np.sqrt(_dot(away, away)), _LEAST)[:, None])

    def _slopes(self, to: Array, along: Array, d: Array, normals: Array) -> tuple[Array, Array]:
        """(K, 3, N) derivatives of n . d by a turn, and by the position."""
        by_position, points, arcs = np.empty_like(d), self._points, self._arcs
        straight = slice(0, arcs.start)
        by_position[:, :, straight] = _cross(d[:, :, straight], along[:, :, straight])
        by_turn = _cross(d, normals)
        by_turn[:, :, points] = _cross(to[:, :, points], by_position[:, :, points])  # a turns with the camera
        if self.counts[2]:
            unit = self._outwards(to, d)
            by_position[:, :2, arcs] = unit * d[:, 2:, arcs]
            by_position[:, 2, arcs] = -_dot(unit, d[:, :2, arcs])
        return by_turn, by_position

    def seen(self, poses: Candidates) -> Mask:
        """(K, N) whether each row's place lies ahead and, for a line, between its ends."""
        beyond = 0.05  # share of a line's length by which an initial estimate may be beyond its ends
        d, to = poses.rotations @ self._rays(poses.log_phi, poses.bend), self._to(poses)
        good = _dot(to, d) > 0.0
        lines, arcs = slice(self._points.stop, self._arcs.start), self._arcs
        a, e, p = self.along[lines].T[None], d[:, :, lines], to[:, :, lines]
        # The place P + s a nearest to the ray t d: both ends of the common perpendicular.
        aa, ee, ae, ap, ep = _dot(a, a), _dot(e, e), _dot(a, e), _dot(a, p), _dot(e, p)
        det = np.maximum(aa * ee - ae**2, _LEAST)
        s, t = (ae * ep - ee * ap) / det, (aa * ep - ae * ap) / det
        good[:, lines] = (t > 0.0) & (np.abs(s - 0.5) < 0.5 + beyond)
        good[:, arcs] = to[:, 2, arcs] * d[:, 2, arcs] > 0.0
        return np.asarray(good)

    def positions(self, rotations: Array, log_phi: Array) -> Array:
        """(K, 3) m, positions of cameras with these rotations: linear in the observations; for an arc, by the circle in
        which its rays meet a plane one metre below. Where everything leaves it undetermined, the position is above the
        middle of the places.
        """
        rounds = 2  # rounds of reweighting against wrong labels
        d = rotations @ self._rays(log_phi, np.zeros(len(log_phi)))
        d /= np.sqrt(_dot(d, d))[:, None]
        straight = slice(0, self._arcs.start)
        rows = _cross(self._directions(rotations)[:, :, straight], d[:, :, straight])
        sides = _dot(rows, self.places[straight].T[None])
        for number in distinct(self.curve[self._arcs]):
            own = np.flatnonzero(self.curve == number)
            where, weight = _over_circle(d[:, :, own], self.places[own[0]], self.along[own[0], 0])
            rows = np.concatenate([rows, weight[:, None, None] * np.eye(3)], axis=2)
            sides = np.concatenate([sides, weight[:, None] * where], axis=1)
        middle, weights = self.places.mean(axis=0), np.ones(sides.shape)
        for _ in range(rounds):
            weighted = rows * weights[:, None]
            matrix = weighted @ np.swapaxes(rows, 1, 2) + _RIDGE * np.eye(3)
            right = weighted @ sides[..., None] + _RIDGE * middle[:, None]
            positions = np.linalg.solve(matrix, right)[..., 0]
            off = sides - (positions[:, None] @ rows)[:, 0]
            usual = np.maximum(medians(np.abs(off))[:, None], _LEAST)
            weights = 1.0 / (1.0 + (off / usual) ** 2)
        return np.asarray(positions)

    def _directions(self, rotations: Array) -> Array:
        """(K, 3, N) a of each row, of unit length except for arcs; for points, a is the camera's x or y axis."""
        lines = slice(self._points.stop, self._arcs.start)
        along = self.along.T.copy()
        along[:, lines] /= np.linalg.norm(along[:, lines], axis=0)
        every, half = np.empty((len(rotations), *along.shape)), self.counts[0]
        every[:, :, 2 * half :] = along[:, 2 * half :]
        every[:, :, :half], every[:, :, half : 2 * half] = rotations[:, :, :1], rotations[:, :, 1:2]
        return every


def _over_circle(d: Array, centre: Array, radius: float) -> tuple[Array, Array]:
    """(K, 3) m, positions of cameras whose rays d (K, 3, n) show a circle, and weights (K,), 0 where they do not."""
    least_down = 0.03  # sine of the angle below the horizon, under which a ray has no usable place on the floor
    down = np.maximum(-d[:, 2:], least_down)
    u = d[:, :2] / down
    rows = np.concatenate([2.0 * u, np.ones_like(down)], axis=1)
    matrix = rows @ np.swapaxes(rows, 1, 2) + _RIDGE * np.eye(3)
    solved = np.linalg.solve(matrix, rows @ _dot(u, u)[..., None])[..., 0]
    seen = np.sqrt(np.maximum(solved[:, 2] + np.sum(solved[:, :2] ** 2, axis=1), _RIDGE))  # radius on that plane
    height = radius / seen
    where = centre - np.column_stack([solved[:, :2] * height[:, None], -height])
    return where, np.where((d[:, 2] < -least_down).all(axis=1), np.sqrt(float(d.shape[2])), 0.0)


def _dot(a: Array, b: Array) -> Array:
    """(K, N) inner products of (K, 3, N), or of arrays with another middle size."""
    return np.asarray(np.einsum("kin,kin->kn", a, b))


def _cross(a: Array, b: Array) -> Array:
    """np.cross along the middle axis, several times as fast."""
    x, y, z = a[:, 0], a[:, 1], a[:, 2]
    u, v, w = b[:, 0], b[:, 1], b[:, 2]
    crossed = np.empty(b.shape)
    crossed[:, 0], crossed[:, 1], crossed[:, 2] = y * w - z * v, z * u - x * w, x * v - y * u
    return crossed


def _turns(vectors: Array) -> Array:
    """(K, 3, 3) rotations of rotation vectors (K, 3), rad."""
    angle = np.linalg.norm(vectors, axis=1)
    skew = skews(vectors / np.maximum(angle, _LEAST)[:, None])
    return np.asarray(
        np.eye(3) + np.sin(angle)[:, None, None] * skew + (1.0 - np.cos(angle))[:, None, None] * (skew @ skew)
    )
