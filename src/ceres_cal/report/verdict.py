"""The first chapter: may this calibration be trusted, for what, to how many mm."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ceres_cal.base.words import counted, fixed, metres, mm, sentence, short
from ceres_cal.report.grounds import CARE_MM, GOOD_MM, grounds, level_of, misfit_mm, model_error_mm, worst
from ceres_cal.report.material import Material
from ceres_cal.report.numbers import bounds
from ceres_cal.report.page import BulletList, Chapter, Piece, Text, Tile, Tiles
from ceres_cal.scene.heights import HEIGHTS_M, at_height
from ceres_cal.uncertainty import FieldMap, Verdict

_MEANING = (
    "The headline holds for 95 % of the points located at the worst place that a camera sees; ± is a standard "
    "deviation. Both are the calibration's own share: the noise of the pixel that is asked about comes on top. Green: "
    f"up to {GOOD_MM:g} mm, a painted line's width; amber: up to {CARE_MM:g} mm."
)


@dataclass(frozen=True)
class Reach:
    """How well places at one height are told, over all stations.

    Attributes:
        height_m: of the places. radius_mm: 95 % of the points located at the worst place are nearer, infinite where it
            cannot be told, NaN where no image shows any. level: "good", "care" or "no".
    """

    height_m: float
    radius_mm: float
    level: str

    @property
    def where(self) -> str:
        return "on the floor" if self.height_m == 0.0 else f"at robot height ({mm(1e3 * self.height_m)})"


def reaches(material: Material) -> tuple[Reach, ...]:
    """One for each of HEIGHTS_M; none where no station sees the world."""
    if not material.maps:
        return ()
    radii = [_worst_radius(*(maps[number] for maps in material.maps.values())) for number in range(len(HEIGHTS_M))]
    return tuple(Reach(height, radius, level_of(radius)) for height, radius in zip(HEIGHTS_M, radii, strict=True))


def _worst_radius(*maps: FieldMap) -> float:
    """The largest of their 95 % radii, mm; NaN where they show nothing."""
    radii = np.concatenate([one.radius_95_mm.ravel() for one in maps])
    shown = radii[~np.isnan(radii)]
    return float(shown.max()) if len(shown) else np.nan


def verdict_chapter(material: Material) -> Chapter:
    """The chapter, its level the colour of the page's first box."""
    reasons = tuple(grounds(material))
    every = reaches(material)
    level, title = _headline(material, every, worst("good", *(mark for mark, _ in reasons if mark)))
    pieces: list[Piece] = [Tiles(tuple(_tiles(material))), BulletList(reasons)]
    if every:
        pieces.append(Text(_MEANING, "note"))
    return Chapter("verdict", title, tuple(pieces), level)


def _headline(material: Material, every: tuple[Reach, ...], reasons: str) -> tuple[str, str]:
    if material.uncertainty is None:
        return "no", "Not to be used: nothing was minimised, this is the paper's closed form alone."
    if not every:
        level = worst(reasons, *(_level_of_verdict(verdict) for verdict in _focal(material)))
        how = {"good": "can be trusted", "care": "are to be used with care", "no": "cannot be trusted"}[level]
        return level, f"The intrinsics {how}. No station sees a field: places in the world cannot be told."
    floor, above = every
    promised = " and ".join(f"to {mm(r.radius_mm)} {r.where}" for r in every if r.level != "no")
    if misfit_mm(material) > GOOD_MM:
        return "no", f"It does not hold: on these new data it is off by {mm(misfit_mm(material))} (rms)."
    if reasons == "no" or floor.level == "no":
        though = f", though its sigmas promise places {promised}" if promised else ""
        return "no", f"Do not trust this calibration{though}."
    if above.level == "no":
        how = f"are known to {mm(above.radius_mm)} only" if np.isfinite(above.radius_mm) else "cannot be told"
        but = _but(material) or "."
        return "care", f"Trust it on the floor alone, to {mm(floor.radius_mm)}: places {above.where} {how}{but}"
    level = worst(reasons, floor.level, above.level)
    if level == "good":
        return level, f"This calibration can be trusted: {promised}."
    return level, f"Use it with care: {promised}{_but(material) or '.'}"


def _but(material: Material) -> str:
    """The end of a headline whose numbers do not contain everything, "" where they do."""
    off, wrong = misfit_mm(material), model_error_mm(material)
    if off:
        return f", but on these new data it is off by {mm(off)} (rms)."
    return f", but the model is wrong by {mm(wrong)} (rms) beside that." if wrong else ""


# ---- large numbers --------------------------------------------------------------------------------------------------


def _tiles(material: Material) -> Iterator[Tile]:
    several = len(material.maps) > 1
    for station, maps in material.maps.items():
        for one in maps:
            yield _map_tile(sentence(at_height(one.height_m)) + (f", {station}" if several else ""), one)
    if not material.maps:
        for verdict in _focal(material):
            yield _focal_tile(verdict)
    fit, table = material.calibration.fit, material.diagnosis.table
    if material.diagnosis.new_data:
        distance = table.distance_px[table.inlier]
        rms = float(np.sqrt(np.mean(distance**2))) if len(distance) else np.nan
        yield Tile("Residuals of new data", short(rms), "px rms", f"over {counted(len(distance), 'observation')}")
    else:
        total = counted(fit.points + fit.curves, "observation")
        yield Tile("Residuals", short(fit.rms_px), "px rms", f"over {total}: how well data and model agree")
    out = int(np.count_nonzero(~table.inlier))
    share = 100.0 * out / max(len(table), 1)
    yield Tile("Taken out", short(share), "%", f"{counted(out, 'outlier')} of {counted(len(table), 'observation')}")


def _map_tile(label: str, one: FieldMap) -> Tile:
    radius = _worst_radius(one)
    if np.isnan(radius):
        return Tile(label, "unseen", "", "the image shows no place of the field", "no")
    level = level_of(radius)
    if np.isinf(one.mean_mm):
        return Tile(
            label, "unknown", "", "the observations do not tell it: add tilted boards or measure the height", level
        )
    note = f"of a located point, in the mean; at worst {mm(one.worst_mm)}, at {metres(one.worst_place_m)}"
    return Tile(label, f"± {short(one.mean_mm)}", "mm", note, level)


def _focal(material: Material) -> Iterator[Verdict]:
    """What is known of phi of each camera."""
    for name in material.observations.cameras:
        verdict = material.verdicts.get(("camera", name, "phi"))
        if verdict is not None:
            yield verdict


def _level_of_verdict(verdict: Verdict) -> str:
    return {"known": "good", "weak": "care", "unknown": "no"}[verdict.verdict]


def _focal_tile(verdict: Verdict) -> Tile:
    known = np.isfinite(verdict.relative)
    value = f"± {short(100.0 * verdict.relative)}" if known else "unknown"
    note = f"{fixed(verdict.value, 1)} px, 95 %: {bounds(verdict)}"
    return Tile(f"phi of {verdict.key.owner}", value, "%" if known else "", note, _level_of_verdict(verdict))
