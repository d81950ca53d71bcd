"""A lens whose parts are not centred, where it does not solve for that."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.effects.columns import EffectColumns
from ceres_cal.effects.effect import Case, Effect, Evidence, Words
from ceres_cal.scene.lens import LENSES, Lens


class Decentring(Effect):
    """Brown's tangential displacement, where the lens does not solve for it."""

    kind = "decentring"
    absorbed = True

    def columns(self, case: Case) -> Iterator[EffectColumns]:
        columns, group = np.zeros((len(case.equations), 2)), case.camera.copy()
        for number, name in enumerate(case.cameras):
            own = case.camera == number
            parts = _tangential(case.estimate.cameras[name].lens)
            if parts and set(parts) <= case.free_coefficients(name):
                group[own] = -1
            else:
                columns[own] = _decentring_columns(case, name)[own]
        yield EffectColumns(self.kind, columns, group, case.cameras)

    def words(self, evidence: Evidence) -> Words:
        name, every = evidence.score.subject, np.ones(len(evidence.shift), dtype=bool)
        lens = evidence.case.estimate.cameras[name].lens
        own = _tangential(lens)
        kind, names = next((kind, lens.decentring) for kind, lens in LENSES.items() if lens.decentring)
        if own and not set(own) <= set(lens.names):
            advice = f"calibrate with --terms tangential, which frees {' and '.join(own)}"
        elif own:
            advice = f"let {' and '.join(own)} free"
        else:
            advice = f"calibrate with --lens {kind}, which has {' and '.join(names)}"
        return Words(
            f"camera {name!r}: its lens is not centred: a tangential displacement of up to "
            f"{evidence.most_px(every):.2f} px ({evidence.size})",
            advice,
        )


def _tangential(lens: Lens) -> tuple[str, ...]:
    """Names of Brown's decentring coefficients, which it has or may have."""
    own = tuple(name for name in ("p1", "p2") if name in lens.names)
    return own or lens.more_terms.get("tangential", ())


def _decentring_columns(case: Case, camera: str) -> Array:
    """(E, 2) px of Brown's tangential displacements, 1 px at half the image diagonal."""
    x, y = case.offsets(camera).T
    r2 = x * x + y * y
    first = np.column_stack([2.0 * x * y, r2 + 2.0 * y * y])
    second = np.column_stack([r2 + 2.0 * x * x, 2.0 * x * y])
    return np.column_stack([np.sum(case.equations.direction * field, axis=1) for field in (first, second)])


EFFECTS = (Decentring(),)
