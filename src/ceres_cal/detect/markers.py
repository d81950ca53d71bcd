"""ArUco and AprilTag markers in images: OpenCV finds them, and corners are intersections of their measured sides.

Corners of a dark square are no saddles: blur rounds them off inwards. So the light's step is measured across each side
(`profiles`), and a line, which a lens may bend a little, is fitted to it. In rendered pictures (sides of 45 to 96 px,
blur of 0.4 to 1.5 px, noise of 2 grey levels) corners are off by 0.02 to 0.03 px, rms per coordinate; OpenCV's by 0.17
to 0.32 px with its best refinement.
"""

from __future__ import annotations

import cv2
import numpy as np

from ceres_cal.base import Array, Array32, Image, Image8, InputError, median
from ceres_cal.detect.profiles import fit_edges
from ceres_cal.scene.targets import Target
from ceres_cal.scene.targets.charuco_boards import dictionary_of
from ceres_cal.scene.targets.marker_targets import CORNERS

_FAR = 4.0  # multiple of the median deviation beyond which a place on a side shows something else
_FEWEST_PLACES = 5
_DICTIONARIES = (
    *(tuple(f"DICT_{bits}_{count}" for count in (50, 100, 250, 1000)) for bits in ("4X4", "5X5", "6X6", "7X7")),
    ("DICT_ARUCO_ORIGINAL",),
    ("DICT_APRILTAG_36h11",),
)
"""Dictionaries that boards are printed with; the smaller ones of a row are the first markers of its last one."""


def dictionary_shown(levels: Image8) -> str:
    """Return the smallest dictionary that has most of the markers in an image; "" where few or none are seen."""
    few = 3  # objects beside a chessboard, or its squares, occasionally look like a marker
    best = ""
    for names in _DICTIONARIES:
        _, numbers, _ = cv2.aruco.ArucoDetector(dictionary_of(names[-1])).detectMarkers(levels)
        seen = np.unique([] if numbers is None else numbers)
        if len(seen) > few:
            few, best = len(seen), next(name for name in names if len(dictionary_of(name).bytesList) > seen[-1])
    return best


def markers_finder(target: Target) -> cv2.aruco.ArucoDetector:
    """Return a detector for the markers of a target; InputError where the dictionary does not have them."""
    name = target.spec["dictionary"]
    dictionary = dictionary_of(name)
    most = len(dictionary.bytesList) - 1
    if wrong := [number for number in target.spec["markers"] if int(number) > most]:
        raise InputError(f"{name} has markers 0 to {most}, and no {wrong[0]}: name the dictionary that was printed")
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    return cv2.aruco.ArucoDetector(dictionary, parameters)


def measured_markers(image: Image, levels: Image8, target: Target, finder: cv2.aruco.ArucoDetector) -> Array | str:
    """Return corners (M markers, 4, 2) px, NaN where a marker was not seen or was seen twice; or why there are none."""
    corners, numbers, _ = finder.detectMarkers(levels)
    seen = [] if numbers is None else [str(number) for number in numbers.ravel().tolist()]
    wanted = list(target.spec["markers"])
    once = [place for place, number in enumerate(seen) if number in wanted and seen.count(number) == 1]
    if not once:
        twice = sorted({number for number in seen if number in wanted})
        also = f"; seen more than once: {', '.join(twice)}" if twice else ""
        return f"none of the {len(wanted)} markers found{also}"
    grid = np.full((len(wanted), len(CORNERS), 2), np.nan)
    cells, grey = finder.getDictionary().markerSize + 2, image.astype(np.float32)
    for place in once:
        quad = np.asarray(corners[place], dtype=float).reshape(4, 2)
        sides = _measured_sides(grey, quad, cells)
        if sides is not None:
            grid[wanted.index(seen[place])] = _crossings(quad, sides)
    if np.isnan(grid).all():
        return f"{len(once)} of {len(wanted)} markers found, too small or too blurred to be measured"
    return grid


def _measured_sides(image: Array32, quad: Array, cells: int) -> Array | None:
    """(4, 3) offset of each measured side outwards from the quad's side, px, as a polynomial of the place along it from
    -1 to 1; None where a side is not seen, or the cells are too small.
    """
    cell = 0.5  # half length of a window, as a share of a cell: the marker's border is one or two cells wide
    least_half_length_px = 1.5  # least half length of a window; with smaller cells sides cannot be measured
    half_width_px, most_half_length_px = 1, 5.0
    every_px, most_places = 2.0, 24  # distance and largest number of places along a side
    ends = 0.12  # share of a side at either end where the corner's rounding is
    along = np.roll(quad, -1, axis=0) - quad
    lengths = np.linalg.norm(along, axis=1)
    half_px = min(cell * float(lengths.min()) / cells, most_half_length_px)
    if half_px < least_half_length_px:
        return None
    outward = np.column_stack([along[:, 1], -along[:, 0]]) / lengths[:, None]  # corners go round clockwise
    count = int(np.clip(lengths.min() / every_px, _FEWEST_PLACES, most_places))
    share = np.linspace(ends, 1.0 - ends, count)
    places = (quad[:, None] + share[:, None] * along[:, None]).reshape(-1, 2)
    normals = np.repeat(outward, count, axis=0)
    _, fits, _ = fit_edges(image, places, normals, np.zeros(len(places)), half_px, half_width_px)
    offsets = np.where(fits.heights[:, 0] > 0.0, fits.offset_px, np.nan).reshape(4, count)
    every = zip(offsets, fits.sigma_px.reshape(4, count), lengths, strict=True)
    sides = [_side(2.0 * share - 1.0, *side) for side in every]
    return None if any(side is None for side in sides) else np.array(sides)


def _side(place: Array, offset_px: Array, sigma_px: Array, length_px: float) -> Array | None:
    """(3,) coefficients of the polynomial through most of a side's offsets (N,); None where too few were measured."""
    sag = 0.003  # prior standard deviation of a side's bend by the lens, as a share of its length
    terms = np.column_stack([np.ones_like(place), place, 1.0 - place**2])
    used = np.isfinite(offset_px)
    solution = np.zeros(3)
    for _ in range(3):
        if np.count_nonzero(used) < _FEWEST_PLACES:
            return None
        spread = max(median(sigma_px[used]), 1e-3)
        rows = np.vstack([terms[used] / spread, [0.0, 0.0, 1.0 / (sag * length_px)]])
        solution = np.linalg.lstsq(rows, np.append(offset_px[used] / spread, 0.0), rcond=None)[0]
        away = np.abs(offset_px - terms @ solution)
        used = np.isfinite(offset_px) & (away <= _FAR * max(median(away[used]), spread))
    return np.asarray(solution)


def _crossings(quad: Array, sides: Array) -> Array:
    """(4, 2) px where neighbouring sides of the quad cross, each moved outwards by its polynomial's end values."""
    along = np.roll(quad, -1, axis=0) - quad
    along /= np.linalg.norm(along, axis=1)[:, None]
    outward = np.column_stack([along[:, 1], -along[:, 0]])
    begins, ends = sides[:, 0] - sides[:, 1], sides[:, 0] + sides[:, 1]
    normals = np.stack([np.roll(outward, 1, axis=0), outward], axis=1)  # of the side before each corner, and after it
    moved = np.linalg.solve(normals, np.stack([np.roll(ends, 1), begins], axis=1)[..., None])
    return np.asarray(quad + moved[..., 0])
