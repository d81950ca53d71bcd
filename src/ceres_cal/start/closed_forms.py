"""The closed forms: those of the paper, corrected where it errs (docs/mathematics.md), and others that it lacks.

Plane points are (x, y) of a plane of constant z; image points are offsets from the principal point in pixels. A radial
profile w(r) = 1 + c_1 r^2 + c_2 r^4, with r in units of `unit_px`, turns a measured offset p into the direction (p, phi
w(r)). It is the same for every lens, and finite where a fisheye looks beyond 90 degrees. With a profile, a homography
maps a plane point to (p, w(r)), up to scale.

Also the effect of a lens along the radius, as an initial estimate finds it, and the nearest lens of a given kind.
"""

from __future__ import annotations

from collections.abc import Container, Sequence

import numpy as np
from numpy.typing import ArrayLike

from ceres_cal import kernels
from ceres_cal.base import Array, DegenerateError, Frozen, Indices, Pose, dots, eigh, median, parts_of, run_parts
from ceres_cal.scene import Camera, Lens

# Length of a wrong residual in median errors: no clean residual is that long, nine standard deviations. Halving it
# changes nothing.
_WRONG = 8.0


class RadialProfile(Frozen, eq=True):
    """w(r) = 1 + sum c_k r^(2k), r in units of `unit_px`."""

    coefficients: tuple[float, ...]
    unit_px: float

    def lift(self, offsets: Array) -> Array:
        """(N, 3) homogeneous undistorted image points (p, w(r)) of offsets (N, 2)."""
        squared = dots(offsets, offsets) / self.unit_px**2
        w = np.ones(len(offsets))
        for k, c in enumerate(self.coefficients, start=1):
            w += c * squared**k
        return np.column_stack([offsets, w])

    def slope(self, radius: Array) -> Array:
        """(N,) derivative of w by the radius r, divided by r, per px^2."""
        squared = (radius / self.unit_px) ** 2
        terms = [2.0 * k * c * squared ** (k - 1) for k, c in enumerate(self.coefficients, start=1)]
        return np.asarray(sum(terms, np.zeros(len(radius))) / self.unit_px**2)

    def bent(self, bend: float) -> RadialProfile:
        """The profile with `bend` added to the coefficient of r^2."""
        first, *rest = self.coefficients or (0.0,)
        return RadialProfile((first + bend, *rest), self.unit_px)


def _normaliser(points: Array) -> Array:
    """(3, 3) T that moves 2D points to their centroid and scales them to a mean distance of sqrt 2."""
    centre = points.mean(axis=0)
    scale = np.sqrt(2.0) / max(float(np.mean(np.linalg.norm(points - centre, axis=1))), 1e-12)
    return np.array([[scale, 0.0, -scale * centre[0]], [0.0, scale, -scale * centre[1]], [0.0, 0.0, 1.0]])


def homography_from_points(plane_points: ArrayLike, image_points: ArrayLike) -> Array:
    """H (3, 3) with image ~ H (x, y, 1), from at least four points (paper, section 3.2).

    The rows are (x y 1 0 0 0 -x''x -x''y -x'') and (0 0 0 x y 1 -y''x -y''y -y''). H is their null vector in normalised
    coordinates, so no entry of H is assumed to differ from 0. Its sign gives the points positive depth.

    Args:
        image_points: (N, 2), or (N, 3) homogeneous.

    Raises:
        DegenerateError: fewer than four points, or no four points of which no three lie on one line.
    """
    plane = np.asarray(plane_points, dtype=float)
    image = np.asarray(image_points, dtype=float)
    if image.shape[1] == 2:
        image = np.column_stack([image, np.ones(len(image))])
    require_spread(plane)
    t = _normaliser(plane)
    x = np.column_stack([plane, np.ones(len(plane))]) @ t.T
    scale = np.diag([1.0, 1.0, max(float(np.mean(np.linalg.norm(image[:, :2], axis=1))), 1e-12)])
    u = image @ scale
    zero = np.zeros_like(x)
    rows = np.vstack([np.hstack([u[:, 2:] * x, zero, -u[:, :1] * x]), np.hstack([zero, u[:, 2:] * x, -u[:, 1:2] * x])])
    _, s, vt = np.linalg.svd(rows, full_matrices=len(rows) < rows.shape[1])
    if s[7] <= 1e-9 * s[0]:
        raise DegenerateError(f"three of any four of the {len(plane)} points lie on one line: add points off it")
    h = np.linalg.inv(scale) @ vt[-1].reshape(3, 3) @ t
    return facing(h, plane, image)


def require_spread(plane_points: Array) -> None:
    """Raise DegenerateError unless there are at least four points that do not all lie on one line."""
    if len(plane_points) < 4:
        raise DegenerateError(f"{len(plane_points)} points cannot fix a plane's pose: give at least four")
    spread = np.linalg.svd(plane_points - plane_points.mean(axis=0), compute_uv=False)
    if spread[-1] <= 1e-7 * spread[0]:
        raise DegenerateError(f"all {len(plane_points)} points lie on one line: add points off this line")


def facing(homography: Array, plane_points: Array, image_points: Array) -> Array:
    """The homography with the sign that maps plane points to their image points, not to their opposites."""
    sent = np.column_stack([plane_points, np.ones(len(plane_points))]) @ homography.T
    agree = np.sum(sent * image_points, axis=1)
    return homography if median(agree) >= 0.0 else -homography


def poses_from_homographies(homographies: Array, phi: float = 1.0) -> Array:
    """[R t] (S, 3, 4) of each H (S, 3, 3), whose image points are offsets in px; phi is 1 if they are normalised.

    lambda is the larger norm of h1 and h2 (paper, section 3.5) and t = h3 / lambda. R is the rotation nearest to (h1,
    h2, h1 x h2), which for any lambda also minimises the paper's E = |h1 / lambda - r1|^2 + |h2 / lambda - r2|^2
    (section 3.6): with B = [h1 h2] = U S V^T, [r1 r2] = U V^T = B (B^T B)^-1/2. The root of a 2 x 2 matrix M is (M + d)
    / s with d = (det M)^1/2 and s = (tr M + 2 d)^1/2; its inverse is (s - root) / d. The pose is NaN where H maps the
    plane to a line.
    """
    h = homographies * np.array([[1.0 / phi], [1.0 / phi], [1.0]])
    b = h[:, :, :2]
    m = np.swapaxes(b, 1, 2) @ b
    d = np.sqrt(np.maximum(m[:, 0, 0] * m[:, 1, 1] - m[:, 0, 1] ** 2, 0.0))[:, None, None]
    s = np.sqrt((m[:, 0, 0] + m[:, 1, 1])[:, None, None] + 2.0 * d)
    root = (m + d * np.eye(2)) / s
    with np.errstate(divide="ignore", invalid="ignore"):
        r = b @ ((s * np.eye(2) - root) / d)
    first, second = r[:, :, 0].T, r[:, :, 1].T
    third = np.stack([first[i - 2] * second[i - 1] - first[i - 1] * second[i - 2] for i in range(3)], axis=1)
    largest = np.sqrt(np.maximum(m[:, 0, 0], m[:, 1, 1]))
    return np.concatenate([r, third[:, :, None], (h[:, :, 2] / largest[:, None])[:, :, None]], axis=2)


def pose_from_homography(homography: Array, phi: float = 1.0) -> Pose:
    """The pose of one homography: see `poses_from_homographies`."""
    (matrix,) = poses_from_homographies(homography[None], phi)
    return Pose(matrix[:, :3], matrix[:, 3])


def fit_rings(measured_radius: ArrayLike, ring_radius: ArrayLike, powers: Sequence[int] = (1, 2, 3)) -> Array:
    """The paper's fit of r' = a1 r + a2 r^2 + a3 r^3 to rings (section 2): coefficients in the order of `powers`.

    Args:
        measured_radius: (N,) px. ring_radius: (N,) px, r' without distortion. A common factor on it enters every
            coefficient (and phi), which is the gauge freedom of the paper's triple.
    """
    r = np.asarray(measured_radius, dtype=float)
    unit = float(np.max(r))
    basis = (r / unit)[:, None] ** np.asarray(powers, dtype=float)
    solution = np.linalg.lstsq(basis, np.asarray(ring_radius, dtype=float), rcond=None)[0]
    return np.asarray(solution / unit ** np.asarray(powers, dtype=float))


def ring_profile(measured_radius: Array, ring_radius: Array, unit_px: float) -> tuple[RadialProfile, float]:
    """Profile and magnification (px per metre at the centre) from rings: r = kappa R w(r), linear in kappa, kappa c."""
    squared = (measured_radius / unit_px) ** 2
    basis = np.column_stack([ring_radius, ring_radius * squared, ring_radius * squared**2])
    kappa, *rest = np.linalg.lstsq(basis, measured_radius, rcond=None)[0]
    return RadialProfile(tuple(float(c / kappa) for c in rest), unit_px), float(kappa)


class PlaneData(Frozen):
    """Points of several sights of one camera, ordered by sight.

    Attributes:
        bounds: (S + 1,) where each sight begins. plane: (N, 2) m. offsets: (N, 2) px.
    """

    bounds: Indices
    plane: Array
    offsets: Array


def radial_alignment(data: PlaneData, unit_px: float, terms: int, rounds: int) -> tuple[RadialProfile, Array, Array]:
    """Fit a profile to points of several sights, for any radial distortion (design, section 7).

    p_x (h2 . X) - p_y (h1 . X) = 0 holds for any radial lens and gives h1 and h2 of each sight. Then, along p, r (h3 .
    X) - q sum c_k r^2k = q with q = (h1 . X, h2 . X) . p / r is linear in h3 of each sight and in the shared c. Rounds
    of reweighting reduce the influence of wrong labels. With fewer than six points in a sight, its result is
    unreliable.

    Returns:
        The profile, and each point's error: (N,) px, and in units of what is usual at that distance from the centre.
    """
    profile, (errors, usual) = np.empty(terms), np.empty((2, len(data.plane)))
    kernels.radial_alignment(data.bounds, data.plane, data.offsets, unit_px, rounds, profile, errors, usual)
    return RadialProfile(tuple(profile.tolist()), unit_px), errors * unit_px, errors / usual


def homographies_of_sights(data: PlaneData, profile: RadialProfile) -> tuple[Array, Array]:
    """H (S, 3, 3) of every sight under a known profile, and each point's error (N,) px.

    It is the normalised DLT, reweighted to distances in the image, and against wrong labels where some points do not
    fit.
    """
    point_ns = 100.0  # time (ns) that a homography takes for each of its points
    homographies, errors = np.empty((len(data.bounds) - 1, 3, 3)), np.empty(len(data.plane))
    coefficients = np.array(profile.coefficients)

    def solve(first: int, last: int) -> None:
        bounds, part = data.bounds[first : last + 1], homographies[first:last]
        kernels.plane_homographies(
            bounds, data.plane, data.offsets, coefficients, profile.unit_px, _WRONG, part, errors
        )

    run_parts(solve, parts_of(len(homographies), len(errors), point_ns))
    return np.array([[profile.unit_px], [profile.unit_px], [1.0]]) * homographies, errors * profile.unit_px


def fit_lines(lines: Array, image_points: Array, rounds: int) -> tuple[Array | None, float]:
    """H (3, 3) from the plane to image points d (N, 3) that are observed on its lines l (N, 3), all homogeneous.

    A point of the plane is given by two lines that cross in it. The sign of H gives observations positive depth.

    Returns:
        H, or None where the lines do not determine it; and the median distance on the plane, in units of its size.
    """
    singular = 1e-12
    no_second = 1e-6  # root of the second least eigenvalue, below which the null vector is one of many
    plane_scale, image_scale, found, second, sent, distance = _fitted_lines(lines, image_points[None], rounds)
    inverse, typical = found[0] * np.copysign(1.0, median(sent[0, :, 2])), float(distance[0])
    # More than one G fits, or G maps the image to a line.
    if second[0] < no_second**2 or abs(np.linalg.det(inverse)) < singular:
        return None, typical
    return np.asarray(np.linalg.inv(plane_scale @ inverse @ image_scale[0])), typical


def misfits_of_lines(lines: Array, image_points: Array, rounds: int) -> Array:
    """(C,) median distances on the plane, in units of its size, for image points (C, N, 3) undistorted by C lenses."""
    return _fitted_lines(lines, image_points, rounds)[-1]


def _fitted_lines(lines: Array, image_points: Array, rounds: int) -> tuple[Array, Array, Array, Array, Array, Array]:
    """The DLT of points on lines, l . G d = 0 with G = H^-1 (design, section 7), reweighted to distances on the plane
    and against wrong labels; for C lenses at once, with image points (C, N, 3) on lines (N, 3).

    Returns:
        (3, 3) and (C, 3, 3) scales from the plane and from images to the units of the fit, (C, 3, 3) G in these, (C,)
        the second least eigenvalue, (C, N, 3) G d, and (C,) the middle distance on the plane.
    """
    of_a_plane = 8  # degrees of freedom of a homography
    plane_scale = np.array([1.0, 1.0, 1.0 / max(float(np.max(np.abs(lines[:, 2]))), 1e-9)])
    reach = np.max(np.abs(image_points[:, :, :2]), axis=(1, 2))
    image_scale = np.column_stack([1.0 / reach, 1.0 / reach, np.ones_like(reach)])
    lines, image_points = lines * plane_scale, image_points * image_scale[:, None]
    rows = (lines[:, :, None] * image_points[:, :, None, :]).reshape(*image_points.shape[:2], 9)
    weights = np.ones(image_points.shape[:2])
    # The middle of the distances that G's eight numbers cannot fit exactly: the median of all may be 0.
    middle = min((len(lines) + of_a_plane) // 2, len(lines) - 1)
    for _ in range(rounds):
        values, vectors = eigh(np.swapaxes(rows * weights[:, :, None], 1, 2) @ rows / len(lines))
        inverse = vectors[:, :, 0].reshape(-1, 3, 3)
        sent = image_points @ np.swapaxes(inverse, 1, 2)
        distance = np.abs(dots(lines, sent)) / np.maximum(np.abs(sent[:, :, 2]), 1e-9)
        typical = np.partition(distance, middle, axis=1)[:, middle]
        bound = np.maximum(3.0 * typical, 1e-9)[:, None]
        weights = 1.0 / (np.maximum(sent[:, :, 2] ** 2, 1e-9) * (1.0 + (distance / bound) ** 2))
        weights /= weights.mean(axis=1, keepdims=True)
    return np.diag(plane_scale), image_scale[:, :, None] * np.eye(3), inverse, values[:, 1], sent, typical


def point_lines(points: Array) -> Array:
    """(2 N, 3) the lines x = const of points (N, 2), then their lines y = const, which cross in the points."""
    x, y = points.T
    one, zero = np.ones(len(points)), np.zeros(len(points))
    return np.vstack([np.column_stack([one, zero, -x]), np.column_stack([zero, one, -y])])


def profile_from_lines(lines: Array, offsets: Array, unit_px: float, terms: int) -> tuple[float, ...]:
    """Coefficients of the profile under which offsets (N, 2) px lie on lines (N, 3) of the plane.

    l . (g1 p_x + g2 p_y + g3 (1 + sum c_k r^2k)) = 0 is linear in the nine numbers of G and its products g3 c_k: the
    null vector contains g3 x (1, c), whose best approximation of rank one gives c.
    """
    p = offsets / unit_px
    squared = np.sum(p * p, axis=1)
    factors = np.column_stack([p, *(squared**k for k in range(terms + 1))])
    rows = (factors[:, :, None] * lines[:, None, :]).reshape(len(lines), -1)
    products = eigh(rows.T @ rows)[1][6:, 0].reshape(terms + 1, 3)
    left = np.linalg.svd(products)[0][:, 0]
    return tuple(float(c / left[0]) for c in left[1:]) if abs(left[0]) > 1e-9 else (0.0,) * terms


def orthogonality_error(homographies: Array, phi: ArrayLike) -> Array:
    """(len(phi), count) deviation of r1 and r2 from being orthogonal and equally long, for each phi; 0 for the true
    phi.
    """
    phi = np.atleast_1d(np.asarray(phi, dtype=float))[:, None]
    a, b = homographies[:, :, 0], homographies[:, :, 1]
    dot = a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + phi**2 * a[:, 2] * b[:, 2]
    aa = a[:, 0] ** 2 + a[:, 1] ** 2 + phi**2 * a[:, 2] ** 2
    bb = b[:, 0] ** 2 + b[:, 1] ** 2 + phi**2 * b[:, 2] ** 2
    return np.asarray(np.sqrt(4.0 * dot**2 + (aa - bb) ** 2) / (aa + bb))


RADII = np.linspace(0.02, 1.0, 50)  # shares of the largest observed radius at which lenses are compared


def edge_over(camera: Camera, reach_px: float) -> float:
    """The largest radius at which a camera's lens will be evaluated, over the largest observed radius."""
    margin = 1.15  # on the edge of the picture by an initial estimate, whose profile is least certain there
    return margin * max(1.0, camera.corner_radius / reach_px)


class LensProfile(Frozen):
    """The effect of a lens: angles (n,), rad, to the axis of the rays at radii (n,), px, up to the largest observed
    one.
    """

    radii_px: Array
    angles: Array

    @classmethod
    def of(cls, camera: Camera, reach_px: float) -> LensProfile:
        """The profile of a camera's lens up to a radius."""
        r, lens = RADII * reach_px, camera.lens
        across = {*lens.decentring, *lens.more_terms.get("tangential", ())}
        lens = lens.with_values([0.0 if name in across else lens.coefficients[name] for name in lens.names])
        rays = lens.undistort(np.column_stack([r, np.zeros_like(r)]), camera.phi)
        angles = np.arctan2(rays[:, 0], rays[:, 2])
        known = np.isfinite(angles)
        return cls(r[known], angles[known])

    @property
    def reach_px(self) -> float:
        return float(np.max(self.radii_px, initial=0.0))

    def nearest(self, blank: Lens, phi: float, held: Container[str]) -> Lens:
        """The lens of a kind that is nearest to the profile: every model is linear in its coefficients at given radii.
        Fewer coefficients are used where it would fold.

        Args:
            blank: the lens with its held coefficients. held: their names.
        """
        grazing = 0.02  # cosine of the angle beyond which a ray has no ideal radius
        r = self.radii_px
        with np.errstate(divide="ignore", invalid="ignore"):
            ideal = np.where(np.cos(self.angles) > grazing, phi * np.tan(self.angles), np.nan)
        columns, right = blank.start_equations(r, ideal, self.angles, phi)
        free = [i for i, name in enumerate(blank.names) if name in columns and name not in held]
        ahead = np.isfinite(right)
        right = right - sum(
            np.nan_to_num(columns[n]) * blank.coefficients[n] for n in blank.names if n in columns and n in held
        )
        for count in range(len(free), 0, -1):
            basis = np.column_stack([columns[blank.names[i]] for i in free[:count]])[ahead]
            values = np.array(blank.values)
            values[free[:count]] = np.linalg.lstsq(basis, right[ahead], rcond=1e-8)[0]
            lens = blank.with_values(values)
            if lens.monotone_radius(phi) > 1.05 * self.reach_px:
                return lens
        return blank
