"""SoccerNet's calibration benchmark on a folder in its format: python scripts/run.py soccernet FOLDER [--help]

FOLDER holds frames.json, {frame: {line: [[x, y], ...]}} in fractions of a picture of 960 x 540 px, and pitch.json, the
pitch as a target and the name of each line in it. The annotated points are calibrated, not the pictures. Every line of
the pitch is drawn with the calibration. A line is right when all points annotated on it lie nearer to it than 5 (10,
20) px. The Jaccard index is the share of right lines among those that are annotated or drawn, with the labels as given
or rotated by 180 degrees, whichever is better. The final score is completeness times the index at 5 px. Exits with 1
where a figure is missed.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from runner import Row, finished, over, over_processes, parser, share_error

from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import CalibrationError
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.observations import Curves, Observations, Points, View
from ceres_cal.problem.parameters import Options
from ceres_cal.report.grounds import judge_quality
from ceres_cal.report.quality import quality_of
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.curves import curve_points
from ceres_cal.scene.targets import Target, target_from_spec

SIZE = (960, 540)
LIMITS_PX = (5.0, 10.0, 20.0)
COMPLETE, JACCARD, FINAL, WRONG = 0.975, 0.845, 0.82, 0.5
_PIECES = 200  # of a line that is drawn
_PINHOLE = Options(lens="brown", fixed=dict.fromkeys(("k1", "k2", "p1", "p2", "k3"), 0.0), free_principal_point=False)
_Lines = Mapping[str, Array]


@dataclass(frozen=True, eq=False)
class Pitch:
    """A folder's pitch, and the name in it of each annotated line."""

    target: Target
    names: Mapping[str, str]

    @classmethod
    def load(cls, path: Path) -> Pitch:
        data = json.loads(path.read_text(encoding="utf-8"))
        return cls(target_from_spec(data["target"], str(path)), data["names"])

    def observations(self, lines: _Lines) -> Observations:
        """The annotated points of one frame, px."""
        numbers = [self.target.curve_index[self.names[name]] for name in lines]
        feature = np.repeat(numbers, [len(points) for points in lines.values()]).astype(np.int32)
        pixels, count = np.concatenate(list(lines.values())), len(feature)
        curves = Curves(np.zeros(count, np.int32), feature, pixels, np.ones(count), np.zeros(count, np.int8))
        none = Points(np.empty(0, np.int32), np.empty(0, np.int32), np.empty((0, 2)), np.empty(0))
        views = (View("frame", "camera", "camera", "pitch", None),)
        return Observations({"pitch": self.target}, {"camera": SIZE}, views, none, curves)

    def places(self) -> dict[str, Array]:
        """(N, 3) m along every line."""
        return {name: curve_points(self.target.curves[own], 0, _PIECES) for name, own in self.names.items()}

    def turned(self) -> dict[str, str]:
        """The line that each line coincides with after a rotation of the pitch by 180 degrees."""
        places = self.places()
        middle = {name: where.mean(axis=0) for name, where in places.items()}
        turned = {name: where * (-1.0, -1.0, 1.0) for name, where in middle.items()}
        return {a: min(middle, key=lambda b: float(np.linalg.norm(middle[b] - turned[a]))) for a in middle}


# ---- the metric -----------------------------------------------------------------------------------------------------


def drawn(camera: Camera, places: Mapping[str, Array]) -> dict[str, Array]:
    """(N, 2) px of each line inside the picture, with one place beyond each end."""
    lines = {}
    for name, where in places.items():
        pixels = camera.project(where)
        inside = np.all((pixels >= 0.0) & (pixels < SIZE), axis=1)  # NaN is not
        if inside.any():
            first, last = np.flatnonzero(inside)[[0, -1]]
            some = pixels[max(first - 1, 0) : last + 2]
            lines[name] = some[np.isfinite(some).all(axis=1)]
    return lines


def jaccard(annotated: _Lines, lines: _Lines) -> Array:
    """(3,) the index at LIMITS_PX."""
    both = annotated.keys() & lines.keys()
    worst = np.array([max(_distance(point, lines[name]) for point in annotated[name]) for name in both])
    right = np.count_nonzero(worst[:, None] < LIMITS_PX, axis=0) if both else np.zeros(len(LIMITS_PX))
    return np.asarray(right / len(annotated.keys() | lines.keys()))


def _distance(point: Array, polyline: Array) -> float:
    start, along = polyline[:-1], np.diff(polyline, axis=0)
    if not len(along):
        return float(np.linalg.norm(polyline[0] - point))
    t = np.sum((point - start) * along, axis=1) / np.maximum(np.sum(along**2, axis=1), 1e-12)
    return float(np.min(np.linalg.norm(start + np.clip(t, 0.0, 1.0)[:, None] * along - point, axis=1)))


# ---- frames ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Answer:
    """The result for a frame: the index at LIMITS_PX, or the message of a refusal."""

    frame: str
    jaccard: tuple[float, ...] = ()
    refused: str = ""
    trusted: bool = False


def answer(frame: str, annotated: dict[str, Any], pitch: Pitch, options: Options) -> Answer:
    """Calibrate one frame."""
    lines = {name: np.array(points) * SIZE for name, points in annotated.items()}
    observations = pitch.observations(lines)
    try:
        calibration = calibrate(observations, options)
    except CalibrationError as error:
        return Answer(frame, refused=str(error))
    except Exception as error:  # counted with the refusals, by its name
        return Answer(frame, refused=f"unexpected {type(error).__name__}: {error}")
    shown = drawn(calibration.station(), pitch.places())
    labels = pitch.turned()
    either = jaccard(lines, shown), jaccard({labels[name]: points for name, points in lines.items()}, shown)
    index = max(tuple(one.tolist()) for one in either)
    return Answer(frame, index, trusted=index[2] < WRONG and _is_trusted(calibration, observations))


def _is_trusted(calibration: Calibration, observations: Observations) -> bool:
    return judge_quality(quality_of(calibration, observations)).level == "good"


def rows(answers: Sequence[Answer]) -> Iterator[Row]:
    """The benchmark's figures."""
    index = np.array([one.jaccard for one in answers if one.jaccard]).reshape(-1, len(LIMITS_PX))
    complete, count = len(index) / len(answers), len(answers)
    yield Row("soccernet", "completeness", complete, share_error(complete, count), least=COMPLETE)
    for limit, values, least in zip(LIMITS_PX, index.T, (JACCARD, -np.inf, -np.inf), strict=True):
        error = float(np.std(values) / np.sqrt(max(len(values), 1)))
        yield Row("soccernet", f"JaC@{limit:.0f} of those answered", float(np.mean(values)), error, least=least)
    yield Row("soccernet", "final score", complete * float(np.mean(index[:, 0])), least=FINAL)
    wrong = sum(one.trusted for one in answers)
    yield Row("soccernet", f"trusted, with JaC@20 under {WRONG}", wrong, most=0)


def main(arguments: Sequence[str] | None = None) -> int:
    options = parser(__doc__, (1 << 30, "frames at most"))
    options.add_argument("folder", type=Path, help="holds frames.json and pitch.json")
    options.add_argument("--lens", default="", help="any that is calibrated with (default a pinhole)")
    options.add_argument("--list", action="store_true", help="list each frame that is refused or under 0.5 at 20 px")
    given = options.parse_args(arguments)
    pitch = Pitch.load(given.folder / "pitch.json")
    frames = json.loads((given.folder / "frames.json").read_text(encoding="utf-8"))
    some = list(frames.items())[: given.runs]
    lens = Options(lens=given.lens) if given.lens else _PINHOLE
    count = len(some)
    with over_processes(given.jobs):
        answers = list(over(answer, *zip(*some, strict=True), [pitch] * count, [lens] * count))
    _tell(answers, listed=given.list)
    figures = list(rows(answers))
    if given.json != "-":
        print(*figures, sep="\n")
    return finished(figures, given)


def _tell(answers: Iterable[Answer], *, listed: bool) -> None:
    if listed:
        for one in answers:
            if one.refused or one.jaccard[2] < WRONG:
                print(f"{one.frame}  {one.refused or f'JaC@20 {one.jaccard[2]:.2f}'}")
        return
    messages = Counter(one.refused[:100] for one in answers if one.refused)
    for message, times in messages.most_common():
        print(f"{times:5}  {message}")
