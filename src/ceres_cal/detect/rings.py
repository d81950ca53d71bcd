"""The paper's concentric rings (section 2) in a photograph: sub-pixel edges along rays from an estimated centre.

The light's gradient points to or from the centre everywhere on the rings, whatever the lens does along the radius. From
the centre outwards each ring's edge is followed on all rays at once and smoothed, so that a ray that misses an edge (a
shadow, a hand) does not miscount the rings farther out.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from ceres_cal.base import Array, Array32, Frozen, Indices32, InputError, Mask, frame_of, naming
from ceres_cal.detect.images import read_grey
from ceres_cal.detect.profiles import fit_edges
from ceres_cal.observations import NO_POINTS, Curves, Observations, View, taken
from ceres_cal.scene.targets import rings

TARGET_NAME = "rings"
RAYS = 360
_ANGLES = 2.0 * np.pi * np.arange(RAYS) / RAYS  # (RAYS,) directions of the rays, rad
_STEP_PX = 0.5
# Least share of the rays that show a ring (among those that reach it inside the image). Nothing changes from half to
# double.
_FEWEST_RAYS = 0.25
_HARMONICS = 3  # harmonics of a ring's radius as a function of its angle, for tilt and a centre beside the optical axis
_HALF_LENGTH_PX, _HALF_WIDTH_PX = 5.0, 2
# Least contrast of an edge, in units of the noise. Nothing changes from half to double.
_LEAST_CONTRAST = 8.0
# Largest misfit of a window, in units of the usual one: beyond it something else is in the window. Half of it rejects
# 0.5 % of the edges, double none fewer.
_NOISY = 3.0
# Largest distance from the ring's smooth course, in units of the usual one. Half of it rejects 3 % of the edges, double
# next to none fewer.
_FAR = 5.0
# Largest misfit of a ring, as a share of the largest radius; rings miscounted by one give more. Nothing changes from
# half to double.
_MOST_MISFIT = 0.004


class RingsDetection(Frozen):
    """Result of `detect_rings`.

    Attributes:
        observations: one view, with its edges as curve observations.
        centre: (2,) px, image of the rings' common centre.
        rings: number of rings found, from the inside out; those beyond are outside the image.
        polynomial: (3,) the paper's a1, a2, a3 (section 2): r' = a1 r + a2 r^2 + a3 r^3 px, with r' scaled so that the
            first ring's measured and real radius agree.
        rms_px: root mean square residual of the rings' radii about that polynomial, in measured pixels.
        blur_px: standard deviation of the picture's blur by lens and pixel together.
    """

    observations: Observations
    centre: Array
    rings: int
    polynomial: Array
    rms_px: float
    blur_px: float


def detect_rings(
    image: str | Path, radii_m: Sequence[float], camera: str = "camera", station: str | None = None
) -> RingsDetection:
    """Detect the edges of concentric rings in a photograph that shows them approximately from the front.

    `sigma_px` of each observation is that of its own fit to the pixels, times a common factor that is estimated from
    the scatter about the rings' smooth courses.

    Args:
        image: a file of any kind OpenCV reads.
        radii_m: radii of the edges between dark and bright, from the inside out; those outside the image need not be
            seen.

    Raises:
        InputError: not an image, no rings in it, or other rings than the radii describe; the message names the file.
    """
    sheet = rings(radii_m)
    grey = read_grey(image).astype(np.float32)
    with naming(image):
        centre = ring_centre(grey)
        tracks = _follow(grey, centre, len(radii_m))
        edges, blur = _measured(grey, centre, tracks)
        _require_all_seen(grey, centre, tracks, len(radii_m))
        polynomial, rms = _polynomial(edges, centre, np.array(sheet.spec["radii_m"]))
    frame, size = frame_of(image), (int(grey.shape[1]), int(grey.shape[0]))
    views = (View(frame, camera, station or camera, TARGET_NAME, frame),)
    observations = Observations({TARGET_NAME: sheet}, {camera: size}, views, NO_POINTS, edges)
    # The centre is the first ring's own middle: farther out, tilt makes the gradients miss the centre.
    own = tracks[0].series[[1, 1 + _HARMONICS]]
    return RingsDetection(observations, centre + own, len(tracks), polynomial, rms, blur)


# ---- following ring after ring --------------------------------------------------------------------------------------


class _Track(Frozen):
    """A ring's edge around the centre: its radius as a Fourier series of the angle, and whether it gets brighter
    outwards.
    """

    series: Array
    rises: bool

    def radius(self, angle: Array) -> Array:
        return np.asarray(_waves(angle) @ self.series)


def _waves(angle: Array, harmonics: int = _HARMONICS) -> Array:
    """(N, 1 + 2 harmonics) columns 1, cos t, cos 2t, ..., sin t, sin 2t, ... for angles t (N,)."""
    orders = np.arange(1, harmonics + 1) * angle[:, None]
    return np.column_stack([np.ones(len(angle)), np.cos(orders), np.sin(orders)])


def _follow(grey: Array32, centre: Array, most: int) -> list[_Track]:
    """Return the rings' edges from the inside out, at most `most`, as far as enough rays show them.

    One more than `most` is an error.
    """
    least_spacing_px = 3.0
    slope, reach = _slopes(grey, centre)
    limit = 0.25 * float(np.quantile(np.abs(slope[np.isfinite(slope)]), 0.995))
    tracks: list[_Track] = []
    while True:
        inner = tracks[-1].radius(_ANGLES) + 1.5 if tracks else np.full(RAYS, 2.0)
        before = _next_edges(slope, inner, limit, None if not tracks else not tracks[-1].rises)
        track = _smooth(before, reach)
        if track is None:
            break
        if len(tracks) == most:
            raise InputError(f"more than {most} rings found, for {most} radii: give the radius of every edge")
        if tracks and np.median(track.radius(_ANGLES) - tracks[-1].radius(_ANGLES)) < least_spacing_px:
            break
        tracks.append(track)
    if len(tracks) < min(3, most):
        raise InputError(f"only {len(tracks)} rings found around ({centre[0]:.0f}, {centre[1]:.0f}): 3 are needed")
    return tracks


def _slopes(grey: Array32, centre: Array) -> tuple[Array, Array]:
    """(RAYS, N) derivative of the light along each ray, NaN outside the image, and (RAYS,) how far a ray stays inside,
    px.
    """
    height, width = grey.shape
    steps = np.arange(0.0, float(np.hypot(height, width)), _STEP_PX)
    x = centre[0] + np.cos(_ANGLES)[:, None] * steps
    y = centre[1] + np.sin(_ANGLES)[:, None] * steps
    soft = cv2.GaussianBlur(grey, (0, 0), 0.8)
    light = cv2.remap(
        soft, x.astype(np.float32), y.astype(np.float32), cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
    )
    inside = (x >= 2.0) & (x <= width - 3.0) & (y >= 2.0) & (y <= height - 3.0)
    inside = np.logical_and.accumulate(inside, axis=1)
    slope = np.gradient(light.astype(float), _STEP_PX, axis=1)
    return np.where(inside, slope, np.nan), np.sum(inside, axis=1) * _STEP_PX


def _next_edges(slope: Array, inner: Array, limit: float, rises: bool | None) -> tuple[Array, bool]:
    """(RAYS,) radius, px, of the first edge beyond `inner` on each ray, NaN without one, and whether edges rise.

    Args:
        rises: whether light must increase outwards there; None for the sign that most rays have.
    """
    if rises is None:
        up, down = (_next_edges(slope, inner, limit, sign)[0] for sign in (True, False))
        rises = bool(np.nanmedian(up) < np.nanmedian(down))
    signed = np.nan_to_num(slope if rises else -slope)
    peak = np.zeros(signed.shape, dtype=bool)
    middle = signed[:, 1:-1]
    peak[:, 1:-1] = (middle > limit) & (middle >= signed[:, :-2]) & (middle > signed[:, 2:])
    peak &= np.arange(signed.shape[1]) * _STEP_PX > inner[:, None]
    first = np.argmax(peak, axis=1)
    return np.where(peak.any(axis=1), first * _STEP_PX, np.nan), rises


def _smooth(edges: tuple[Array, bool], reach: Array) -> _Track | None:
    """Fit the smooth course of most of the edges; None where too few rays have one."""
    radius, rises = edges
    seen = np.isfinite(radius)
    if np.count_nonzero(seen) < 8:
        return None
    usual = float(np.median(radius[seen]))
    used = seen & (np.abs(radius - usual) < 0.15 * usual + 2.0)
    waves, series = _waves(_ANGLES), np.zeros(1 + 2 * _HARMONICS)
    pull = np.diag([0.0] + [1e-2] * (2 * _HARMONICS)) * RAYS  # keeps the series from oscillating where there is no edge
    for limit in (6.0, 3.0, 2.0, 2.0, 2.0):
        if np.count_nonzero(used) < 8:
            return None
        rows = waves[used]
        series = np.linalg.solve(rows.T @ rows + pull, rows.T @ radius[used])
        used = seen & (np.abs(radius - waves @ series) < limit)
    could = reach > waves @ series + 3.0
    enough = np.count_nonzero(used & could) >= max(_FEWEST_RAYS * np.count_nonzero(could), 12)
    return _Track(series, rises) if enough else None


def _require_all_seen(grey: Array32, centre: Array, tracks: Sequence[_Track], expected: int) -> None:
    """Raise InputError where a ring is missing although its place would be well inside the image."""
    if len(tracks) == expected:
        return
    means = np.array([track.series[0] for track in tracks])
    following = means[-1] + (means[-1] - means[-2])
    place = centre + following * np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES)])
    inside = np.all((place > 5.0) & (place < np.array(grey.shape[::-1]) - 6.0), axis=1)
    if np.mean(inside) > 0.5:
        raise InputError(
            f"{len(tracks)} rings found, but {expected} radii were given: give the radius of every edge in the picture"
        )


# ---- measuring ------------------------------------------------------------------------------------------------------


def _measured(grey: Array32, centre: Array, tracks: Sequence[_Track]) -> tuple[Curves, float]:
    """Return the edges as observations of the rings by number, and the usual blur, px."""
    radii = np.array([track.radius(_ANGLES) for track in tracks])
    # A window ends before the next edge begins, and neighbouring windows of a ring do not overlap.
    gap = np.min(np.diff(np.vstack([np.zeros(RAYS), radii, 2.0 * radii[-1] - radii[-2]]), axis=0), axis=1)
    parts, blurs = [], []
    for number, (track, mean) in enumerate(zip(tracks, radii, strict=True)):
        every = max(1, int(np.ceil((2 * _HALF_WIDTH_PX + 2) * RAYS / (2.0 * np.pi * float(mean.min())))))
        half = min(_HALF_LENGTH_PX, 0.5 * float(min(gap[number], gap[number + 1])) - 0.5)
        measured = _measured_ring(grey, centre, track, _ANGLES[::every], max(half, 2.0))
        blurs.append(measured[2])
        parts.append((np.full(len(_ANGLES[::every]), number, np.int32), *measured[:2]))
    ring, pixels, sigma = (np.concatenate(column) for column in zip(*parts, strict=True))
    away = pixels - centre
    kept, factor = _usual(ring, np.linalg.norm(away, axis=1), sigma, np.arctan2(*away.T[::-1]))
    edges = Curves(np.zeros(len(ring), np.int32), ring, pixels, factor * sigma, np.zeros(len(ring), np.int8))
    return taken(edges, kept), float(np.median(blurs))


def _measured_ring(
    grey: Array32, centre: Array, track: _Track, angle: Array, half_length_px: float
) -> tuple[Array, Array, float]:
    """Return pixels (N, 2), NaN where there is no edge, their sigmas (N,) px, and the blur, px."""
    radius = track.radius(angle)
    outward = np.column_stack([np.cos(angle), np.sin(angle)])
    places = centre + radius[:, None] * outward
    inside, fits, blur = fit_edges(grey, places, outward, -1.0 / radius, half_length_px, _HALF_WIDTH_PX)
    if not inside.any():
        return np.full((len(angle), 2), np.nan), np.full(len(angle), np.inf), np.nan
    height = fits.heights[:, 0] * (1.0 if track.rises else -1.0)
    clear = height > np.maximum(_LEAST_CONTRAST * fits.noise, 0.3 * np.median(height[inside]))
    clear |= height > 0.7 * np.median(height[inside])
    clear &= fits.noise < _NOISY * np.median(fits.noise[inside])
    offset = np.where(clear, fits.offset_px, np.nan)
    return places + offset[:, None] * outward, fits.sigma_px, blur


def _usual(ring: Indices32, radius: Array, sigma: Array, angle: Array) -> tuple[Mask, float]:
    """Return which edges lie on their ring's smooth course, and the factor on sigma that explains their scatter."""
    kept, pulls = np.isfinite(radius), [np.zeros(0)]
    for number in range(int(ring.max()) + 1):
        rows = np.flatnonzero(kept & (ring == number))
        waves = _waves(angle[rows], min(_HARMONICS, max((len(rows) - 4) // 4, 0)))
        columns, used = waves.shape[1], rows
        for _ in range(4):
            if len(used) <= columns:
                break
            inside = np.isin(rows, used)
            series = np.linalg.lstsq(waves[inside] / sigma[used, None], radius[used] / sigma[used], rcond=None)[0]
            pull = (radius[rows] - waves @ series) / sigma[rows]
            spread = max(float(np.median(np.abs(pull[inside]))) / 0.6745, 0.3)
            used = rows[np.abs(pull) < _FAR * spread]
        kept[rows] = np.isin(rows, used) if len(used) > columns else False
        if len(used) > columns:
            pulls.append(pull[np.isin(rows, used)] * np.sqrt(len(used) / (len(used) - columns)))
    every = np.concatenate(pulls)
    if not len(every):
        raise InputError("no ring could be measured: the picture is too blurred or too noisy")
    return kept, float(np.sqrt(np.mean(every**2)))


# ---- the paper's polynomial, and observations -----------------------------------------------------------------------


def _polynomial(edges: Curves, centre: Array, radii_m: Array) -> tuple[Array, float]:
    """Fit the paper's polynomial (section 2) to all edges; return it and its rms in measured pixels.

    Tilt, and a centre beside the lens's axis, add first and second harmonics of the angle. These are fitted along with
    the polynomial; otherwise rings of which the image shows only a part would bias it.
    """
    number, away = edges.feature, edges.pixels - centre
    angle, radius = np.arctan2(*away.T[::-1]), np.linalg.norm(away, axis=1)
    unit = float(np.max(radius))
    ring = radii_m[number] * float(np.mean(radius[number == number.min()])) / radii_m[number.min()]
    share = radius / unit
    once = np.power.outer(share, np.arange(6))
    twice = np.power.outer(share, np.arange(1, 5))
    turning = [wave(n * angle)[:, None] * powers for n, powers in ((1, once), (2, twice)) for wave in (np.cos, np.sin)]
    basis = np.column_stack([np.power.outer(share, [1, 2, 3]), *turning])
    solution = np.linalg.lstsq(basis, ring, rcond=None)[0]
    polynomial = solution[:3] / unit ** np.array([1.0, 2.0, 3.0])
    slope = np.power.outer(radius, [0, 1, 2]) @ (polynomial * (1.0, 2.0, 3.0))
    misfit = (basis @ solution - ring) / slope
    worst = max(abs(float(np.median(misfit[number == one]))) for one in np.unique(number))
    if worst > _MOST_MISFIT * unit:
        raise InputError(
            f"the {len(np.unique(number))} rings found do not have these radii (no smooth lens fits: one is "
            f"{worst:.1f} px off): give the radius of every edge between dark and bright, from the inside out"
        )
    rms = float(np.sqrt(np.mean(misfit**2)))
    return polynomial, rms


# ---- their centre ---------------------------------------------------------------------------------------------------


def ring_centre(grey: Array32) -> Array:
    """Return the point (2,) px where the gradients' lines meet: by votes on a grid, then by least squares."""
    clear = 12.0  # least ratio of black-to-white contrast to noise: rings have been found from 8 on
    soft = cv2.GaussianBlur(grey, (0, 0), 1.5)
    gradient = np.dstack([cv2.Sobel(soft, cv2.CV_32F, 1, 0), cv2.Sobel(soft, cv2.CV_32F, 0, 1)]).astype(float)
    strength = np.hypot(gradient[..., 0], gradient[..., 1])
    strong = np.argwhere(strength > 0.3 * np.quantile(strength, 0.99))
    if not len(strong) or strength.max() < 1e-3:
        raise InputError("no rings found: the picture has no edges: take it in better light")
    chosen = strong[np.random.default_rng(0).permutation(len(strong))[:20_000]]
    places = chosen[:, ::-1].astype(float)
    direction = gradient[chosen[:, 0], chosen[:, 1]] / strength[chosen[:, 0], chosen[:, 1], None]
    normal = np.column_stack([-direction[:, 1], direction[:, 0]])
    centre = _voted(places[:2000], normal[:2000], grey.shape)
    for scale in (20.0, 10.0, 5.0, 3.0, 3.0, 3.0, 3.0):
        away = np.sum((places - centre) * normal, axis=1)
        weight = 1.0 / (1.0 + (away / scale) ** 2) ** 2
        weighted = normal * weight[:, None]
        centre = centre + np.linalg.solve(weighted.T @ normal + 1e-9 * np.eye(2), weighted.T @ away)
    share = float(np.mean(np.abs(np.sum((places - centre) * normal, axis=1)) < 6.0))
    if share < 0.3:
        contrast, noise = float(np.ptp(np.quantile(soft, (0.01, 0.99)))), 1.48 * float(np.median(np.abs(grey - soft)))
        if contrast < clear * noise:
            raise InputError(
                f"no rings found: too dark, from black to white {contrast:.0f} grey levels in a noise of {noise:.1f}: "
                "give more light, expose longer, or take the mean of several pictures"
            )
        raise InputError(
            "no concentric rings found: edges point to no common centre: let the rings fill most of the picture"
        )
    return np.asarray(centre)


def _voted(places: Array, normal: Array, shape: tuple[int, ...]) -> Array:
    step = max(shape) / 60.0
    y, x = np.mgrid[0.0 : shape[0] : step, 0.0 : shape[1] : step]
    grid = np.column_stack([x.ravel(), y.ravel()])
    away = np.abs(grid @ normal.T - np.sum(places * normal, axis=1))
    return np.asarray(grid[np.argmax(np.sum(away < step, axis=1))])
