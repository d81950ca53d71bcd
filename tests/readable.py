"""The maps of the compiled lenses in plain Python, with which the kernels are compared."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import BSpline

from ceres_cal.base.arrays import Array
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import Brown, KannalaBrandt, Lens, Spline
from ceres_cal.scene.lens.spline import COLUMNS, COUNT, EXTENTS, NODES, ROWS, profile_columns


def project(camera: Camera, points: Array) -> Array:
    """Points (N, 3) m in front of the camera -> pixels (N, 2)."""
    rays = camera.cam_from_world.transform(points)
    x, y = offsets(camera.lens, rays, camera.phi).T
    return np.column_stack([x + camera.skew * y, camera.aspect * y]) + camera.principal_point


def offsets(lens: Lens, rays: Array, phi: float) -> Array:
    """Rays (N, 3) -> measured offsets (N, 2) px."""
    if isinstance(lens, Spline):
        return _of_spline(lens, rays, phi)
    known = dict.fromkeys(("k4", "k5", "k6", "p1", "p2", "s1", "s2", "s3", "s4"), 0.0) | dict(lens.coefficients)
    if isinstance(lens, KannalaBrandt):
        across = np.hypot(rays[:, 0], rays[:, 1])
        angle = np.arctan2(across, rays[:, 2])
        x, y = rays[:, :2].T * np.where(across > 0.0, angle / np.where(across > 0.0, across, 1.0), 1.0 / rays[:, 2])
        below = np.ones(len(rays))
    else:
        assert isinstance(lens, Brown), "the paper's lens is in arrays already"
        x, y = rays[:, :2].T / rays[:, 2]
        r2 = x * x + y * y
        below = 1.0 + known.pop("k4") * r2 + known["k5"] * r2**2 + known["k6"] * r2**3
    r2 = x * x + y * y
    radial = (1.0 + sum(known.get(f"k{n}", 0.0) * r2**n for n in range(1, 5))) / below
    p1, p2, s1, s2, s3, s4 = (known[name] for name in ("p1", "p2", "s1", "s2", "s3", "s4"))
    measured_x = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) + r2 * (s1 + r2 * s2)
    measured_y = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y + r2 * (s3 + r2 * s4)
    return phi * np.column_stack([measured_x, measured_y])


def _of_spline(lens: Spline, rays: Array, phi: float) -> Array:
    rim, known = lens.values[0], lens.coefficients
    q = 2.0 * phi / rim * rays[:, :2] / (np.linalg.norm(rays, axis=1) + rays[:, 2])[:, None]
    z, u = q @ (1.0, 1j), np.maximum(np.linalg.norm(q, axis=1), 1e-150)
    moved = (rim * u + profile_columns(u) @ lens.values[1 : 1 + COUNT]) * z / u
    for k in range(3 if "p1" in known else 0):  # Conrady's decentring
        c = known[f"p{2 * k + 2}"] + 1j * known[f"p{2 * k + 1}"]
        moved += u ** (2 * k) * (2.0 * c * z * z.conj() + c.conjugate() * z**2) / 3.0
    for name in (name for name in known if name.startswith("c")):
        c, m, n = known[name] + 1j * known[f"d{name[1:]}"], int(name[1]), int(name[2])
        moved += c * z**m * z.conj() ** n
    surface = displacements(lens, q) if lens.terms else np.zeros_like(q)
    return np.column_stack([moved.real, moved.imag]) + surface


def displacements(lens: Lens, places: Array) -> Array:
    """(N, 2) px by which a surface displaces places (N, 2), in rims: cubic B-splines, constant beyond the grid."""
    known = lens.coefficients
    weights = []
    for side, count, place in zip(EXTENTS, (COLUMNS, ROWS), places.T, strict=True):
        cells = 0.5 * (count - 3)
        knots = np.arange(-3.0, count + 1.0)
        at = (np.clip(place / known[side], -1.0, 1.0) + 1.0) * cells
        weights.append(BSpline.design_matrix(np.minimum(at, 2.0 * cells - 1e-12), knots, 3).toarray())
    nodes = np.reshape([known[name] for name in NODES], (COLUMNS, ROWS, 2))
    return np.asarray(np.einsum("ni,nj,ijk->nk", *weights, nodes))
