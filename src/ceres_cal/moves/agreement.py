"""Does a calibration hold? The answer that `check`, `score`, `audit` and `compare` give, and their common parts.

Each of them compares a calibration with something else, observations or another calibration. For every station, camera
or view they say what differs, whether chance explains the difference, and otherwise what does.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np

from ceres_cal.base import HEIGHTS_M, Array, InputError, Mask, SolutionError, rms, text_of
from ceres_cal.base.frozen import Frozen, cached_property, field, replace
from ceres_cal.base.tails import NORMAL_95_ONE_SIDED, quadratic_tail
from ceres_cal.calibration import Calibration
from ceres_cal.moves.poses import movement
from ceres_cal.observations import Observations
from ceres_cal.posterior import ErrorMap, FieldGrid, field_grid, visible_pixels
from ceres_cal.problem import Estimate, Information, Key
from ceres_cal.scene import Camera, Target

# Rate at which a calibration that holds is reported not to, unless the user states another rate. At half of it nothing
# changes; at double one of six pairs of calibrations of one camera differs.
FALSE_ALARMS = 0.01
# Factor on the old calibration's noise above which the lens is doubted. Below 1 no explanation has little enough noise
# to be named; at double nothing changes.
NOISIER = 1.5
# Nats that an unchanged number gains in one case of 100: 2.58 standard deviations. Of 60 refits to five clicks of a
# camera that stands still, where one click is a stray, 3 say that its lens has changed; at half of it 10, at double 1,
# without it 21.
_SEEN_NATS = 0.5 * 2.576**2


class FieldDifference(ErrorMap):
    """The difference between the places where two cameras locate the same pixels, over the field.

    Attributes:
        difference_mm: (Y, X, 2) place where the second camera locates the pixel at which the first shows a place, minus
            that place; NaN where the first does not show it. lost: (Y, X) where the second has no answer although the
            first shows the place.
        expected_mm: (Y, X) standard deviation of its length if they differ by noise only; NaN where unknown.
    """

    difference_mm: Array
    expected_mm: Array
    lost: Mask

    @property
    def errors_mm(self) -> Array:
        """(Y, X) length of the difference; NaN where the first does not show the place."""
        return np.asarray(np.linalg.norm(self.difference_mm, axis=2))

    @property
    def rms_mm(self) -> float:
        """Root mean square of the difference; infinite where the second has no answer somewhere."""
        return np.inf if self.lost.any() else rms(self.errors_mm)

    @property
    def most_mm(self) -> float:
        """Largest difference; infinite where the second has no answer somewhere."""
        return np.inf if self.lost.any() else self.worst_mm

    @property
    def known_mm(self) -> float:
        """Root mean square of the expected standard deviations, where known; infinite where none is known."""
        return rms(np.where(np.isinf(self.expected_mm), np.nan, self.expected_mm), np.inf)


class MapChange(Frozen):
    """The change of a station from one camera to another.

    Attributes:
        moved_mm, turned_deg: change of its pose; moved_mm is NaN where unknown. phi_px: of both cameras.
        shift_px: root mean square shift of the picture over the first map. maps: one for each height.
    """

    moved_mm: float
    turned_deg: float
    phi_px: tuple[float, float]
    shift_px: float
    maps: tuple[FieldDifference, ...]


class ImageDifference(Frozen):
    """The difference between the pixels at which two cameras see the same directions, over the image.

    Attributes:
        phi_px: of both. x_px (X,), y_px (Y,): a grid over the image.
        difference_px: (Y, X, 2) pixel at which the second sees the direction that the first sees at a pixel, minus that
            pixel; NaN where either has no answer. angles_deg: (Y, X) between the directions that the two see at a
            pixel.
        turn_deg: rotation of the second's directions to the first's that was subtracted; 0 where none was requested.
    """

    phi_px: tuple[float, float]
    x_px: Array
    y_px: Array
    difference_px: Array
    angles_deg: Array
    turn_deg: float

    @property
    def errors_px(self) -> Array:
        """(Y, X) length of the difference; NaN where either has no answer."""
        return np.asarray(np.linalg.norm(self.difference_px, axis=2))


class Misfit(Frozen, eq=True):
    """Residuals of observations.

    Attributes:
        points, curves: observations that took part. outliers: those that did not.
        points_rms_px, curves_rms_px: root mean square lengths of their residuals; 0 where there are none.
        all_rms_px: the same for points and curves including all outliers; infinite where one cannot be shown.
        noise: of points and of curves, relative to the calibration's; NaN where either has none.
    """

    points: int = 0
    curves: int = 0
    outliers: int = 0
    points_rms_px: float = np.nan
    curves_rms_px: float = np.nan
    all_rms_px: float = np.nan
    noise: tuple[float, float] = (np.nan, np.nan)

    @property
    def count(self) -> int:
        """Number of observations of both kinds, including outliers."""
        return self.points + self.curves + self.outliers

    @property
    def many_out(self) -> bool:
        """Whether so many were rejected that the rest says little."""
        return self.outliers > 0.25 * self.count


class Agreement(Frozen, kw_only=True):
    """The answer for one station, camera or view; what was not evaluated has its default.

    Attributes:
        name: of the station, of the camera, or of the view's frame, station and target.
        holds: whether the calibration holds there; None where this was not tested, or is undecided.
        probability: of a difference at least as large if nothing is wrong. statistic: the difference as a squared
            distance in standard deviations. degrees: number of numbers, or of their directions, that are compared.
        words: the answer in one line. cause: what explains a difference, where a cause was found.
        change: from the calibration's camera to the one that explains the observations, or to the other calibration's.
            image: the same over the image.
        misfit: residuals of the observations. views: for a camera, the answers for each of its views.
        pose_free: whether the pose was fitted to the observations, and is therefore not tested.
        solution: the calibration that explains the observations.
    """

    name: str
    holds: bool | None = None
    probability: float = np.nan
    statistic: float = np.nan
    degrees: int = 0
    words: str = ""
    cause: str | None = None
    change: MapChange | None = None
    image: ImageDifference | None = None
    misfit: Misfit = field(default_factory=Misfit)
    views: tuple[Agreement, ...] = ()
    pose_free: bool = False
    solution: Calibration | None = None


class Agreements(Frozen, Mapping[str, Agreement]):
    """The answers by name, for stations or for cameras.

    Attributes:
        false_alarms: probability that any of so many `checks` of a calibration that holds reports that it does not;
            None where unknown.
    """

    answers: Mapping[str, Agreement]
    false_alarms: float | None = None
    checks: int = 1

    @property
    def holds(self) -> bool | None:
        """Whether all of them hold; None where one is undecided, and none is known not to hold."""
        every = [one.holds for one in self.answers.values()]
        return None if None in every and False not in every else all(every)

    @property
    def exit_code(self) -> int:
        """1 where one does not hold, else 0."""
        return int(self.holds is False)

    def __repr__(self) -> str:
        holds = "" if self.holds is None else f", holds: {self.holds}"
        return text_of((f"Agreements of {len(self)}{holds}", [(name, one.words) for name, one in self.items()]))

    def __getitem__(self, name: str) -> Agreement:
        return self.answers[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.answers)

    def __len__(self) -> int:
        return len(self.answers)


# ---- what is compared -----------------------------------------------------------------------------------------------


def require_posterior(calibration: Calibration) -> None:
    """Raise InputError where the calibration has no posterior."""
    if calibration.posterior is None:
        raise InputError("the calibration does not say how well it is known: calibrate again")


def matched(calibration: Calibration, observations: Observations) -> Observations:
    """Return the observations with the targets of both, as the calibration draws them.

    Raises:
        InputError: a camera that the calibration does not have, a station of another camera, or observations outside
            their image.
        SolutionError: images of another size, or a target of other dimensions.
    """
    observations = calibration.as_taken(observations)
    for name, size in observations.cameras.items():
        if name not in calibration.cameras:
            known = ", ".join(map(repr, calibration.cameras))
            raise InputError(f"camera {name!r} is not in the calibration, which has {known}: name the camera as there")
        known_size = calibration.cameras[name].image_size
        if known_size != tuple(size):
            raise SolutionError(
                f"wrong camera: {name!r} was calibrated with images of {known_size[0]} x {known_size[1]} px, the "
                f"observations are of {size[0]} x {size[1]} px: calibrate it anew"
            )
    for name, target in observations.targets.items():
        if name in calibration.targets and calibration.targets[name] != target:
            raise SolutionError(
                f"wrong field: target {name!r} has other dimensions in the observations than in the calibration: "
                "correct them, or give it another name"
            )
    for name, camera in observations.stations.items():
        station = calibration.estimate.stations.get(name)
        if station is not None and station.camera != camera:
            raise InputError(f"station {name!r} is one of camera {station.camera!r}, not of {camera!r}: name another")
    observations.require_inside()
    return replace(observations, targets={**calibration.targets, **observations.targets})


def require_stations(calibration: Calibration, observations: Observations) -> None:
    """Raise InputError where the calibration does not have a station that was observed."""
    for name in observations.stations:
        if name not in calibration.estimate.stations:
            names = ", ".join(map(repr, calibration.estimate.stations))
            raise InputError(f"station {name!r} is not in the calibration, which has {names}: name it as there")


# ---- what differs ---------------------------------------------------------------------------------------------------


def field_grids(targets: Mapping[str, Target]) -> list[FieldGrid]:
    """Return the grids of the maps over the field, at HEIGHTS_M; none without a field."""
    if all(target.movable for target in targets.values()):
        return []
    return [FieldGrid(height_m, *field_grid(targets)) for height_m in HEIGHTS_M]


def change_of(
    before: Estimate,
    station: str,
    after: Camera,
    grids: Sequence[FieldGrid],
    known: Callable[[FieldGrid], Array] | None = None,
) -> MapChange:
    """Return how a station differs from an estimate of it.

    Args:
        known: returns (Y, X) mm, the standard deviation that is expected over a grid.
    """
    camera = before.camera_at(station)
    shift_m, turn = movement(after.cam_from_world, camera.cam_from_world)
    pixels = [visible_pixels(before, station, grid.places, grid.height_m) for grid in grids]
    maps = tuple(
        _difference(grid, seen, after, known(grid) if known else np.full(grid.shape, np.nan))
        for grid, seen in zip(grids, pixels, strict=True)
    )
    shifts = np.empty(0)
    for grid, seen in zip(grids[:1], pixels[:1], strict=True):
        places = np.column_stack([grid.places, np.full(len(seen), grid.height_m)])
        shifts = np.linalg.norm(seen - after.project(places), axis=1)
    turned_deg, phi_px = float(np.degrees(turn)), (camera.phi, after.phi)
    return MapChange(1e3 * shift_m, turned_deg, phi_px, rms(shifts), maps)


def _difference(grid: FieldGrid, pixels: Array, after: Camera, expected_mm: Array) -> FieldDifference:
    off = 1e3 * (after.locate(pixels, grid.height_m) - grid.places)
    lost = (np.isfinite(pixels[:, 0]) & ~np.isfinite(off[:, 0])).reshape(grid.shape)
    return FieldDifference(grid.height_m, grid.x_m, grid.y_m, off.reshape(*grid.shape, 2), expected_mm, lost)


def price_nats(let_go: int, count: int) -> float:
    """Return by how much the misfit must fall, in nats, for so many freed numbers of which nothing is known. For each
    it is half the logarithm of the number of observations (the Bayesian information criterion; Schwarz, Annals of
    Statistics 6, 1978), which holds for many, and at least what chance alone exceeds for one number at the rate of a
    false alarm.
    """
    return let_go * max(0.5 * math.log(count), _SEEN_NATS)


# ---- two statements about the same numbers --------------------------------------------------------------------------


class NormalDistribution(Frozen):
    """A normal distribution of K numbers, relative to an estimate.

    Attributes:
        information: about them. offsets: (K,) estimate minus mean. degrees_of_freedom: spare equations behind its
            noise.
    """

    information: Information
    offsets: Array
    degrees_of_freedom: float


class Contrast(Frozen):
    """The fall of the least squared distance to two statements when some numbers may differ between them.

    Attributes:
        statistic: that fall. shares: (D,) the first statement's share of the variance of each direction that both
            determine. degrees_of_freedom: spare equations behind the noise of both.
    """

    statistic: float
    shares: Array
    degrees_of_freedom: float

    @property
    def degrees(self) -> int:
        """Number of directions of these numbers that both statements determine."""
        return len(self.shares)

    @cached_property
    def probability(self) -> float:
        """Probability of a fall at least as large, if nothing differs and the first statement's error is one that is
        exceeded in one case of 20.
        """
        total = float(np.sum(self.shares))
        few = total**2 / max(float(np.sum(self.shares**2)), 1e-300)
        unlucky = self.shares * _chi2_95(few) / max(few, 1e-300)
        return quadratic_tail(self.statistic, 1.0 - self.shares, unlucky, self.degrees_of_freedom)


def _chi2_95(freedom: float) -> float:
    """Return the 95 % quantile of chi-squared by Wilson and Hilferty: to 4 % from 1 degree of freedom on."""
    spread = 2.0 / (9.0 * max(freedom, 1e-3))
    return freedom * (1.0 - spread + NORMAL_95_ONE_SIDED * math.sqrt(spread)) ** 3


def contrast(first: NormalDistribution, second: NormalDistribution, tested: Sequence[Key]) -> Contrast:
    """Return the contrast in the tested numbers, while all others are the same in both; both are about the same
    numbers.

    The first statement was made once, and many others are compared with it: its error is the same each time. So the
    probability is how often a true second statement would differ as much, given a first one whose own error is as large
    as it may be (design, section 10).
    """
    testable = 1e-6  # length that both statements together must leave of a direction, with unit columns
    determined = 1e-11  # singular value from which on a direction is determined, with unit columns
    roots = first.information.root, second.information.root
    known, at = len(roots[0]), first.information.columns(tested)
    rows = np.vstack(roots)
    sizes = np.linalg.norm(rows, axis=0)
    rows /= np.where(sizes > 0.0, sizes, 1.0)
    alike = _basis(rows, determined)
    apart = rows[:, at] * (np.arange(len(rows)) >= known)[:, None]
    for _ in range(2):  # the second time against rounding
        apart = apart - alike @ (alike.T @ apart)
    apart = _basis(apart, testable)
    off = np.concatenate([root @ one.offsets for root, one in zip(roots, (first, second), strict=True)])
    shares = np.clip(np.linalg.eigvalsh(apart[:known].T @ apart[:known]), 0.0, 1.0)
    share = float(np.mean(shares)) if len(shares) else 0.0
    inverse = share**2 / first.degrees_of_freedom + (1.0 - share) ** 2 / second.degrees_of_freedom
    return Contrast(float(np.sum((apart.T @ off) ** 2)), shares, 1.0 / inverse if inverse > 0.0 else math.inf)


def _basis(columns: Array, least: float) -> Array:
    """Return an orthonormal basis (N, D) of the directions of columns (N, Q) that are longer than `least`."""
    vectors, lengths, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(vectors[:, lengths > least])
