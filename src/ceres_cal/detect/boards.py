"""Observations of boards in image files: corners of chessboards, ChArUco boards and markers, centres of circles.

OpenCV finds the board; its sub-pixel search, `saddles` or `markers` then measures every corner.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence, Sized
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ceres_cal.base import AnyArray, Array, Frozen, Image, Image8, ImageProgress, InputError, NothingShownError
from ceres_cal.base.threads import for_small_matrices, in_turn
from ceres_cal.base.words import frame_of, no_such, printable
from ceres_cal.detect.images import read_grey
from ceres_cal.detect.partly import NO_PLACE, is_whole, part_of_board
from ceres_cal.detect.saddles import REACH, Saddles, is_begun_dark, measure_saddles, steps_px
from ceres_cal.detect.scatter import scatter_px
from ceres_cal.observations import NO_CURVES, Observations, Points, View
from ceres_cal.scene.targets import Grid, Target

CORNER_FITS = ("saddle", "opencv")
MIN_CORNERS = 6
TARGET_NAME = "board"
_CHECKERED = ("checkerboard", "charuco")
_COUNTED = {**dict.fromkeys(_CHECKERED, "inner corners"), "circle-grid": "circles", "april-grid": "tags"}
_HINTS = {
    **dict.fromkeys(_CHECKERED, " (count the corners between squares, not the squares)"),
    "circle-grid": " (columns are the circles of one row; in an asymmetric grid every other row is half a step off)",
    **dict.fromkeys(("april-grid", "markers"), ""),
}
_MARKERS_SEEN = "though markers of its dictionary"
# (width + height)^2 / _LONG counts as the number of pixels of a long image. That exceeds width x height only from sides
# of 1 : 14 on, longer than any camera's picture.
_LONG = 16
_LEAST_SIDE_PX = 8  # least side of an image that is searched, px: three squares of less than 3 px show no corner
_ADAPTIVE = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
# Number of pixels, and smallest scale, at which a board is searched first. On 62 real boards this finds as many as full
# size does, in a fifth of the time. A smaller scale would not locate corners to a few pixels. Saving less than half of
# the pixels saves no time.
_FAST_PX, _FAST_SCALE = 2e5, 1.0 / 3.0
_LARGE_PX = 2e6  # pixels; larger images are searched at this size first, which is faster and has less noise and blur
_MOST_PX = 1.6e7  # pixels, the largest size searched: on noise OpenCV takes minutes, and 50 MB for every megapixel
_SAMPLED = 4  # every 4th row and column is used to measure the range of a picture's brightness
_SUBPIX_HALF_WINDOW_PX = 5  # upper limit; a third of the spacing keeps neighbouring corners out of the window
# Limit of the absolute log ratio of successive steps (a factor of 1.57): a skipped square gives 2, perspective on three
# squares hardly 1.3.
_UNEVEN = 0.45
_SMALL_PX = 2e6  # pixels; smaller images are searched at twice their size, too: their squares may be few pixels wide


class BoardDetections(Frozen, eq=True):
    """Result of `detect_boards`.

    Attributes:
        observations: one view per image that shows the board.
        found: paths of these images, in the order of the views.
        missed: path and reason of every other image.
    """

    observations: Observations
    found: tuple[str, ...]
    missed: tuple[tuple[str, str], ...]


@for_small_matrices()
def detect_boards(
    images: Sequence[Path],
    board: Target,
    camera: str = "camera",
    station: str | None = None,
    corner_fit: str = "saddle",
    progress: ImageProgress | None = None,
) -> BoardDetections:
    """Detect corners of a chessboard, a ChArUco board or markers, or centres of circles, in the images of one camera.

    Each image is one view; its frame is the file's stem. So is its placement (with as many folders as are needed to
    distinguish equal stems), unless the target is the world, as markers on the floor are. Corners are named so that the
    labelling is never mirrored: a board's x is along columns, y along rows and z away from the camera. Which end of a
    plain chessboard is "0,0" can be seen only if columns + rows is odd: then the square between "0,0" and "1,1" is
    dark. Otherwise x points to the right of the picture rather than to the left. A board that is turned by a right
    angle may get the other name; its placement absorbs that, but the shape of a bent board does not.

    `sigma_px` is one number for all images: the scatter of corners about a smooth picture of their board. In real sets,
    a board that is not flat and an unmodelled lens cause errors of up to ten times that, which only the solve can
    determine.

    Args:
        images: files of any kind OpenCV reads, colour or grey, 8 or 16 bit, all of one size. A rotation noted in the
            file is ignored: intrinsics belong to the pixels as the sensor has them, not to how a viewer turns them.
        board: a target of kind checkerboard, charuco, circle-grid, april-grid or markers. All but a checkerboard and
            circles may be partly seen.
        camera: name of the camera.
        station: name of the station; by default that of the camera.
        corner_fit: one of CORNER_FITS, for a checkerboard. "saddle" fits a blurred saddle to each corner, as is always
            done for other boards. It is about four times more precise on rendered boards (0.005 px against 0.02), and
            has no shift towards the middle of a window as cornerSubPix has. Boards may reach out of the picture, if it
            shows which corners are seen. "opencv" measures with cornerSubPix, as other calibrators do, so that results
            can be compared; boards must be seen whole.
        progress: called after each image.

    Raises:
        InputError: an image cannot be read or has another size (each named), the target is no board or too small, or
            OpenCV has no such markers.
        NothingShownError: no image shows the board.
    """
    paths = [Path(path) for path in images]
    find = finder_of(board, corner_fit)
    placements = _placement_names(paths) if board.movable else dict.fromkeys(paths)
    # OpenCV's marker detectors keep state, which threads would share.
    each = in_turn if board.kind in ("checkerboard", "circle-grid") else map
    size, grids, missed = _find_all(paths, find, each, progress)
    if _is_refuted(grids, missed):
        missed.sort(key=lambda one: NO_PLACE not in one[1])
        seen, searched = _markers_instead(board, *missed[0]), len(grids) + len(missed)
        where = f"any of {searched}" if searched == len(paths) else f"the first {searched} of {len(paths)}"
        reason = f"in {where} images{_HINTS[board.kind]}; {missed[0][0]}: {missed[0][1]}{seen}"
        raise NothingShownError(f"no {_what(board)} {reason}", tuple(missed))
    views = tuple(View(frame_of(path), camera, station or camera, TARGET_NAME, placements[path]) for path in grids)
    points = _points(list(grids.values()), board)
    observations = Observations({TARGET_NAME: board}, {camera: size}, views, points, NO_CURVES)
    return BoardDetections(observations, tuple(map(str, grids)), tuple(missed))


def _is_refuted(grids: Sized, missed: Sequence[tuple[str, str]], to_come: int = 0) -> bool:
    """Whether at least as many images refute the board as show it, whatever the images to come show."""
    return len(grids) + to_come <= sum(NO_PLACE in reason for _, reason in missed)


def _what(board: Target) -> str:
    if board.kind == "markers":
        return f"marker of {len(board.spec['markers'])}"
    return f"board of {board.spec['columns']} x {board.spec['rows']} {_COUNTED[board.kind]}"


# ---- finding --------------------------------------------------------------------------------------------------------

Finder = Callable[[Image], Array | str]
"""Image -> measured grid (rows, columns, 2) px, NaN where a corner was not seen, or the reason why there is none."""
EachImage = Callable[[Callable[[Path], Any], Sequence[Path]], Iterator[Any]]
"""Function that yields the result of its first argument for each image, in the order of the images."""


def _find_all(
    paths: Sequence[Path], find: Finder, each: EachImage, progress: ImageProgress | None
) -> tuple[tuple[int, int], dict[Path, Array], list[tuple[str, str]]]:
    """Return the images' (width, height), the grid in each image that shows the board, and (path, reason) of the
    others. The search ends where images to come cannot change that the board is another one.
    """
    size = (0, 0)
    grids: dict[Path, Array] = {}
    missed: list[tuple[str, str]] = []

    def look(path: Path) -> tuple[tuple[int, int], Array | str]:
        image = read_grey(path)
        return (image.shape[1], image.shape[0]), find(image)

    for number, (path, (own_size, grid)) in enumerate(zip(paths, each(look, paths), strict=True), start=1):
        size = own_size if number == 1 else size
        if own_size != size:
            raise InputError(
                f"{path}: {own_size[0]} x {own_size[1]} px, but {paths[0]} has {size[0]} x {size[1]}: "
                "detect images of another size, which another camera took, separately"
            )
        if isinstance(grid, str):
            missed.append((str(path), grid))
        else:
            grids[path] = grid
        if progress is not None:
            progress(number, len(paths), path.name)
        if _is_refuted(grids, missed, len(paths) - number):
            break
    return size, grids, missed


def _markers_instead(board: Target, path: str, reason: str) -> str:
    """Return an addition to the error message for an image that shows markers the board does not have; else ""."""
    if board.kind not in _CHECKERED or _MARKERS_SEEN in reason:
        return ""
    from ceres_cal.detect.markers import dictionary_shown

    shown = dictionary_shown(_as_8_bit(read_grey(Path(path))))
    kinds = (
        ": a board with markers is of kind charuco or april-grid (`ceres-cal targets charuco` says how to describe it)"
    )
    return f"; it shows markers of {shown}{kinds if board.kind == 'checkerboard' else ''}" if shown else ""


def finder_of(board: Target, corner_fit: str = "saddle") -> Finder:
    """Return a function that finds a board in an image; InputError for no board, too small a one or unknown markers."""
    if board.kind == "circle-grid":
        return lambda image: _circles(image, board)
    if board.kind == "april-grid":
        from ceres_cal.detect.april_grids import measured_april_grid

        return lambda image: _placing(measured_april_grid(image, _as_8_bit(image), board))
    if board.kind == "markers":
        from ceres_cal.detect.markers import markers_finder, measured_markers

        finder = markers_finder(board)
        return lambda image: measured_markers(image, _as_8_bit(image), board, finder)
    if board.grid is None or not board.grid.checkered:
        known = " or ".join(map(repr, _HINTS))
        raise InputError(f"target of kind {board.kind!r}: boards are detected with a target of kind {known}")
    columns, rows = board.grid.columns, board.grid.rows
    if min(columns, rows) < 3:
        raise InputError(f"a board to be found in images needs 3 inner corners a side or more, not {columns} x {rows}")
    if board.kind == "charuco":
        return _charuco_finder(board, board.grid)
    if corner_fit not in CORNER_FITS:
        raise InputError(no_such("corner fit", corner_fit, CORNER_FITS))
    return lambda image: _measured_chessboard(image, columns, rows, corner_fit)


def _circles(image: Image, board: Target) -> Array | str:
    """Find circles in smaller pictures first, which is faster and has less noise; measure them in full size."""
    from ceres_cal.detect.circles import measured_circles

    levels = _stretched(image[::_SAMPLED, ::_SAMPLED], image)
    found: Array | str = "the picture is too narrow for a grid of circles"
    for most, pixels in ((2.0, _FAST_PX), (1.0, _LARGE_PX)):
        scaled = _resized(levels, min(most, float(np.sqrt(pixels / image.size))))
        if min(scaled.shape) < _LEAST_SIDE_PX:
            continue
        found = measured_circles(scaled, board)
        if isinstance(found, str):
            continue
        found = _places_in(image, scaled, found).reshape(found.shape)
        margin = float(np.max(steps_px(found)))
        low = np.maximum(found.min(axis=(0, 1)) - margin, 0.0).astype(int)
        right, below = (found.max(axis=(0, 1)) + margin + 1.0).astype(int)
        again = measured_circles(levels[low[1] : below, low[0] : right], board)
        return found if isinstance(again, str) else again + low
    return found


def _charuco_finder(board: Target, grid: Grid) -> Finder:
    from ceres_cal.scene.targets.charuco_boards import opencv_board

    detector = cv2.aruco.CharucoDetector(opencv_board(board.spec))
    margin = 0.5 * (1.0 - board.spec["marker_m"] / grid.spacing_m)  # width of the white rim around a marker, in squares
    # The disc around a corner must end before the markers on both sides of it begin.
    reach = min(REACH, float(np.sqrt(2.0)) * margin)

    def find(image: Image) -> Array | str:
        corners, ids, _, markers = detector.detectBoard(_as_8_bit(image))
        if ids is None or len(ids) == 0:
            doubt = "" if markers is None else f", {_MARKERS_SEEN}: check columns, rows and legacy"
            return f"no ChArUco corners found{doubt}"
        every = np.full((grid.rows * grid.columns, 2), np.nan)
        every[ids.ravel()] = corners.reshape(-1, 2)
        seen = _enough(every.reshape(grid.rows, grid.columns, 2))
        return seen if isinstance(seen, str) else _enough(measure_saddles(image, seen, reach).grid)

    return find


def _measured_chessboard(image: Image, columns: int, rows: int, corner_fit: str) -> Array | str:
    levels = _as_8_bit(image)
    found, squares = _as_whole(image, _found_fast(levels, columns, rows)), None
    if not found or np.isnan(found[0][1].contrast).any():
        whole, squares = _found_thoroughly(levels, columns, rows)
        found += _as_whole(image, whole)
    if not found and corner_fit == "saddle" and squares is not None:
        return _placing(part_of_board(image, squares, columns, rows))
    if not found:
        return f"no chessboard of {columns} x {rows} inner corners found"
    seen, saddles = max(found, key=lambda one: np.count_nonzero(np.isfinite(one[1].contrast)))
    grid = saddles.grid if corner_fit == "saddle" else _subpixel(levels, seen)
    is_told = (columns + rows) % 2 == 1
    turned = not (is_begun_dark(saddles.contrast) if is_told else _is_upright(grid))
    return _enough(grid[::-1, ::-1] if turned else grid)


def _is_upright(grid: Array) -> bool:
    """Whether x points to the right and y down rather than the other way. It matters for boards that look alike when
    turned: the shape of a board that is not flat is the same in all views only if all of them name its corners alike.
    """
    along_row, along_column = (np.mean(np.diff(grid, axis=axis), axis=(0, 1)) for axis in (1, 0))
    return bool(along_row[0] + along_column[1] > 0.0)


def _as_whole(image: Image, seen: Array | None) -> list[tuple[Array, Saddles]]:
    """Return the grid that was found and its measured corners, in a list that is empty if the grid is not a whole
    board.
    """
    if seen is None or not _is_even(seen):
        return []
    measured = measure_saddles(image, right_handed(seen))
    return [(right_handed(seen), measured)] if is_whole(image, measured) else []


def _subpixel(image: Image8, grid: Array) -> Array:
    """Refine corners by OpenCV's sub-pixel search, in a window that holds no other corner."""
    half = int(np.clip(np.min(steps_px(grid)) / 3.0, 2, _SUBPIX_HALF_WINDOW_PX))
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4)
    corners = grid.reshape(-1, 1, 2).astype(np.float32)
    refined = cv2.cornerSubPix(image, corners, (half, half), (-1, -1), criteria)
    return np.asarray(refined, dtype=float).reshape(grid.shape)


def right_handed(grid: Array) -> Array:
    """Return a whole grid (rows, columns, 2) px, its columns reversed if rows x columns made it a mirrored board."""
    along_row, along_column = np.diff(grid, axis=1)[:-1], np.diff(grid, axis=0)[:, :-1]
    turn = along_row[..., 0] * along_column[..., 1] - along_row[..., 1] * along_column[..., 0]
    return grid[:, ::-1] if np.sum(turn) < 0.0 else grid


def _found_fast(image: Image8, columns: int, rows: int) -> Array | None:
    """Locate the corners roughly, (rows, columns, 2) px, by OpenCV's fast finder in a reduced picture, then in the
    whole one. It finds most boards that are seen whole.
    """
    scale = max(float(np.sqrt(_FAST_PX / image.size)), _FAST_SCALE) if image.size > 2.0 * _FAST_PX else 1.0
    if scale * min(image.shape) < _LEAST_SIDE_PX:
        return None
    scaled = _resized(image, scale)
    # Where there is a board the check takes as long as the search; where there is none, the search of a large picture
    # takes seconds.
    flags = _ADAPTIVE | (cv2.CALIB_CB_FAST_CHECK if scaled.size > 2.0 * _FAST_PX else 0)
    shown, corners = cv2.findChessboardCorners(scaled, (columns, rows), flags=flags)
    if not shown and scaled.size < image.size <= _LARGE_PX:  # this takes a tenth of the time of the thorough search
        scaled = image
        shown, corners = cv2.findChessboardCorners(image, (columns, rows), flags=_ADAPTIVE | cv2.CALIB_CB_FAST_CHECK)
    return _places_in(image, scaled, corners).reshape(rows, columns, 2) if shown else None


def _found_thoroughly(image: Image8, columns: int, rows: int) -> tuple[Array | None, Array | None]:
    """Locate the corners by OpenCV's newer detector at several scales, which also finds boards that are blurred, far
    away or dark. Where no whole board is found, return None and the corners of neighbouring squares, (h, w, 2) px,
    right-handed, three or more each way, if there are any.
    """
    squares, levels = None, _stretched(image[::_SAMPLED, ::_SAMPLED], image)  # the detector fails on dark pictures
    for scale in _scales(image.shape):
        scaled = _resized(levels, scale)
        # Any three by three squares are looked for first: without them there is no board either.
        shown, corners, meta = cv2.findChessboardCornersSBWithMeta(scaled, (3, 3), cv2.CALIB_CB_LARGER)
        if not shown:
            continue
        some = _places_in(image, scaled, corners).reshape(*meta.shape, 2)
        shown, corners = cv2.findChessboardCornersSB(scaled, (columns, rows))
        if shown:
            return _places_in(image, scaled, corners).reshape(rows, columns, 2), None
        if squares is None and _is_even(some):
            squares = right_handed(some)
    return None, squares


def _is_even(grid: Array) -> bool:
    """Whether no square was skipped. If so, successive steps along a line differ little."""
    steps = [np.maximum(np.linalg.norm(np.diff(grid, axis=axis), axis=-1), 1e-9) for axis in (0, 1)]
    ratios = [np.abs(np.diff(np.log(step), axis=axis)) for axis, step in enumerate(steps)]
    return max(float(np.max(ratio, initial=0.0)) for ratio in ratios) < _UNEVEN


def _resized(image: Image8, scale: float) -> Image8:
    """Return the image at another scale. For a smaller one the mean over about as many pixels as become one is sampled,
    which takes a quarter of the time of OpenCV's own area means.
    """
    if scale == 1.0:
        return image
    around, how = (2 * int(0.5 / scale) + 1, cv2.INTER_LINEAR) if scale < 1.0 else (1, cv2.INTER_CUBIC)
    smooth = cv2.blur(image, (around, around)) if around > 1 else image
    return np.asarray(cv2.resize(smooth, None, fx=scale, fy=scale, interpolation=how), dtype=np.uint8)


def _places_in(image: Image8, scaled: Image8, corners: AnyArray) -> Array:
    """Convert corners that OpenCV found in a scaled image to pixels of the image, (N, 2) px."""
    ratio = np.array(image.shape[::-1]) / np.array(scaled.shape[::-1])
    return np.asarray((corners.reshape(-1, 2).astype(float) + 0.5) * ratio - 0.5)


def _scales(shape: tuple[int, ...]) -> list[float]:
    height, width = shape
    # OpenCV turns the picture by 45 degrees, into a square that a long picture hardly fills.
    pixels = max(height * width, (height + width) ** 2 // _LONG)
    first = [(_LARGE_PX / pixels) ** 0.5] if pixels > _LARGE_PX else []
    last = [2.0] if pixels <= _SMALL_PX else []
    every = (*first, min(1.0, (_MOST_PX / pixels) ** 0.5), *last)
    return [scale for scale in every if scale * min(shape) >= _LEAST_SIDE_PX]


def _placing(found: Array | str) -> Array | str:
    """Return the grid that was found, or the reason why it cannot place a board."""
    return found if isinstance(found, str) else _enough(found)


def _enough(grid: Array) -> Array | str:
    """Return the grid, or why its corners cannot place a board: too few, or all but one in one row or column."""
    row, column = np.nonzero(~np.isnan(grid[..., 0]))
    if len(row) < MIN_CORNERS:
        return f"only {len(row)} corners, {MIN_CORNERS} are needed"
    if max(np.bincount(row).max(), np.bincount(column).max()) >= len(row) - 1:
        return f"its {len(row)} corners lie in one row or column (except for one at most)"
    return grid


def _as_8_bit(image: Image) -> Image8:
    """Return the image as OpenCV's detectors take it; deeper images are stretched, with half a percent clipped at
    either end.
    """
    return image.astype(np.uint8, copy=False) if image.dtype == np.uint8 else _stretched(image, image)


def _stretched(sample: Image, image: Image) -> Image8:
    """Stretch an image from black to white, with half a percent of a sample clipped at either end."""
    low, high = np.percentile(sample, [0.5, 99.5])
    stretched: Array = (image - low) * (255.0 / max(float(high - low), 1e-12))
    return np.clip(stretched, 0.0, 255.0).astype(np.uint8)


# ---- observations ---------------------------------------------------------------------------------------------------


def _placement_names(paths: Sequence[Path]) -> dict[Path, str]:
    """Return the name of each path: its stem, with as many folders as are needed to distinguish equal stems."""
    if not paths:
        raise InputError("no images were given: name at least one file")
    if len(set(paths)) < len(paths):
        twice = next(path for number, path in enumerate(paths) if path in paths[:number])
        raise InputError(f"{twice}: given twice: name every image once")
    names = {path: frame_of(path) for path in paths}
    for depth in range(2, max(len(path.parts) for path in paths) + 2):
        taken = list(names.values())
        for path in paths:
            if taken.count(names[path]) > 1:
                own = path.stem if depth <= len(path.parts) else path.name
                names[path] = printable("/".join((*path.parts[-depth:-1], own)))
    return names


def _points(grids: Sequence[Array], board: Target) -> Points:
    # in the order of the target's points
    features = np.arange(len(board.points), dtype=np.int32).reshape(grids[0].shape[:2])
    seen = [~np.isnan(grid[..., 0]) for grid in grids]
    count = [int(np.count_nonzero(s)) for s in seen]
    return Points(
        view=np.repeat(np.arange(len(grids), dtype=np.int32), count),
        feature=np.concatenate([features[s] for s in seen]),
        pixels=np.concatenate([grid[s] for grid, s in zip(grids, seen, strict=True)]),
        sigma_px=np.full(sum(count), scatter_px(grids, board.point_array[features, :2])),
    )
