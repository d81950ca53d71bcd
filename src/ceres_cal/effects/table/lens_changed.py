"""A lens that changed from some frame on: knocked or zoomed, or the pictures of another camera."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from ceres_cal.base.arrays import numbers_of
from ceres_cal.base.tails import log_f_tail
from ceres_cal.effects.columns import EffectColumns, EffectSums, grouped
from ceres_cal.effects.effect import Case, Effect, Evidence, Words, amounts
from ceres_cal.effects.score_tests import score_all
from ceres_cal.problem.parameters import OF_PIXELS

_NUMBERS = ("phi", "cx", "cy")
_PLACES = [OF_PIXELS.index(name) for name in _NUMBERS]


class LensChanged(Effect):
    """phi and the principal point of a camera are others in the frames after one, by boards that are held up."""

    kind = "lens changed"

    def columns(self, case: Case) -> Iterator[EffectColumns]:
        frames = [(view.camera, view.frame) for view in case.observations.views]
        known = list(dict.fromkeys(frames))
        frame = numbers_of(frames, known)[case.equations.view]
        # Over a field a knock turns the camera, too, and a turn looks like another principal point.
        private = np.array([key.placement in case.problem.private for key in case.equations.sights.keys], dtype=bool)
        held_up = private[case.equations.sight]
        for number, name in enumerate(case.cameras):
            present, group = grouped(frame, held_up & (case.camera == number))
            names = tuple(known[one][1] for one in present)
            columns = case.equations.intrinsics[:, _PLACES]
            if len(names) > 1:
                yield from _where_likely(
                    case, EffectColumns(self.kind, columns, group, (name,) * len(names), names, onwards=True)
                )

    def words(self, evidence: Evidence) -> Words:
        score = evidence.score
        parts = zip(_NUMBERS, score.amount, score.sd, strict=True)
        change = ", ".join(f"{name} {by:+.1f} ± {sd:.1f} px" for name, by, sd in parts)
        return Words(
            f"camera {score.subject!r} has another lens after frame {score.frame!r}: {change} ({evidence.size})",
            "give the frames after it a camera of their own: it was knocked or zoomed, or they are another camera's",
            amounts(_NUMBERS, score.amount, score.sd, "px"),
        )


def _where_likely(case: Case, every: EffectColumns) -> Iterator[EffectColumns]:
    """The likeliest frame of all, where the change is beyond what single frames say of the lens otherwise.

    Errors that go together within a frame, as over a board that is not as drawn, shift the lens of each frame by more
    than the noise does. So the change is judged by the scatter of frames about it, Fisher's F, and not by the noise.
    """
    rate = 0.001  # of a false alarm over all frames: of nine real sets of boards none has one
    changes = score_all(case.model, [EffectSums.of(case.model, every)])
    if not changes:
        return
    best = max(changes, key=lambda change: change.statistic)
    beside = case.model.with_columns(best.columns)
    single = score_all(beside, [EffectSums.of(beside, replace(every, onwards=False))])
    freedom = float(sum(one.rank for one in single)) - 2.0 * best.rank
    if freedom < 1.0:
        return
    scatter = max(sum(one.statistic for one in single) / freedom, 1.0)
    log_p = log_f_tail(np.array([best.statistic / (scatter * best.rank)]), np.array([best.rank]), np.array([freedom]))
    if log_p[0] < np.log(rate / len(changes)):
        after = np.where(every.group < 0, -1, (every.group > best.number).astype(np.int64))
        names = (every.frames[best.number], every.frames[-1])
        yield replace(every, group=after, subjects=every.subjects[:2], frames=names)


EFFECTS = (LensChanged(),)
