"""A thin prism before the lens, where it does not solve for it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ceres_cal.effects.columns import EffectColumns
from ceres_cal.effects.effect import Case, Effect, Evidence, Words
from ceres_cal.scene.lens import LENSES


class Prism(Effect):
    """OpenCV's thin prism, where the lens does not solve for it: all is displaced one way, by r^2 and r^4."""

    kind = "prism"
    absorbed = True

    def columns(self, case: Case) -> Iterator[EffectColumns]:
        columns, group = np.zeros((len(case.equations), 4)), case.camera.copy()
        for number, name in enumerate(case.cameras):
            own, parts = case.camera == number, case.estimate.cameras[name].lens.more_terms.get("prism", ())
            if parts and set(parts) <= case.free_coefficients(name):
                group[own] = -1
                continue
            r2 = np.sum(case.offsets(name)[own] ** 2, axis=1)[:, None]
            columns[own] = np.hstack([case.equations.direction[own] * r2, case.equations.direction[own] * r2**2])
        yield EffectColumns(self.kind, columns, group, case.cameras)

    def words(self, evidence: Evidence) -> Words:
        name, every = evidence.score.subject, np.ones(len(evidence.shift), dtype=bool)
        kind = next(kind for kind, lens in LENSES.items() if "prism" in lens.more_terms)
        own = evidence.case.estimate.cameras[name].lens.kind == kind
        return Words(
            f"camera {name!r}: its picture is displaced one way towards its rim, as by a thin prism, by up to "
            f"{evidence.most_px(every):.2f} px ({evidence.size})",
            f"calibrate with {'' if own else f'--lens {kind} '}--terms prism",
        )


EFFECTS = (Prism(),)
