"""How well a calibration is known, as `ceres-cal calibrate` says it to people and to scripts."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np

from ceres_cal.base.digits import two_digits
from ceres_cal.uncertainty import bounds_text

if TYPE_CHECKING:
    from ceres_cal.calibration import Calibration
    from ceres_cal.observations import Observations
    from ceres_cal.uncertainty import Disagreement, FieldMap, Uncertainty, Verdict

HEIGHTS_M = (0.0, 0.15)  # the floor, and the top of a robot
_MOST_DIRECTIONS = 4


class Trust:
    """What is known of a calibration, or None of everything where nothing was minimised."""

    def __init__(self, calibration: Calibration, observations: Observations) -> None:
        self._calibration, self._observations = calibration, observations
        self._known: Uncertainty | None = None if calibration.posterior is None else calibration.uncertainty
        self._verdicts: Mapping[tuple[str, str, str], Verdict] = (
            {verdict.key[:3]: verdict for verdict in self._known.verdicts} if self._known else {}
        )

    def verdict(self, kind: str, owner: str, quantity: str) -> Verdict | None:
        """Of one number; None of one that was held."""
        return self._verdicts.get((kind, owner, quantity))

    def data(self) -> dict[str, Any] | None:
        """Everything, for --json; what is infinite, and so unknown, becomes null there."""
        if self._known is None:
            return None
        return {
            "numbers": [{**asdict(v), "key": v.key._asdict()} for v in self._known.verdicts],
            "weak_directions": [
                {"words": d.words, "relative": d.relative, "shares": [[*key[:3], share] for key, share in d.shares]}
                for d in self._known.weak_directions
            ],
            "unknown_placements": {name: list(lost) for name, lost in self._known.unknown_placements.items()},
            "maps": {name: [_map_data(m) for m in self._maps(name)] for name in self._placed()},
            "seams": [
                {
                    "stations": list(pair),
                    "predicted": [_map_data(m) for m in maps],
                    "found_mm": found.rms_mm,
                    "expected_mm": found.expected_rms_mm,
                    "compared": len(found.what),
                }
                for pair, maps, found in self._seams()
            ],
        }

    def sections(self) -> Iterator[tuple[str, list[str]]]:
        """Title and lines of what people should know before they use it."""
        if self._known is None:
            return
        located = [f"{name}: {_on_floor_and_above(self._maps(name))}" for name in self._placed()]
        if located:
            yield "located", located
        seams = []
        for (first, second), maps, found in self._seams():
            text = f"{first} - {second}: {_on_floor_and_above(maps)}"
            seams.append(text)
            if len(found.what):
                told = f"found {two_digits(found.rms_mm)} mm where {two_digits(found.expected_rms_mm)} were expected"
                seams.append(f"{told} (rms of {len(found.what)} points and stretches that both observed)")
        if seams:
            yield "seam", seams
        weak = [direction.words for direction in self._known.weak_directions]
        if weak:
            more = [f"and {len(weak) - _MOST_DIRECTIONS} more (--json)"] if len(weak) > _MOST_DIRECTIONS else []
            yield "weak", weak[:_MOST_DIRECTIONS] + more
        lost = self._known.unknown_placements
        if lost:
            name, quantities = next(iter(lost.items()))
            rest = f", and of {len(lost) - 1} more placements" if len(lost) > 1 else ""
            yield "unknown", [f"{', '.join(quantities)} of placement {name!r}{rest}"]

    def _placed(self) -> list[str]:
        """Stations that have a place over a field."""
        if all(view.placement is not None for view in self._observations.views):
            return []
        return [name for name in self._calibration.stations if self.verdict("station", name, "height") is not None]

    def _maps(self, station: str) -> list[FieldMap]:
        assert self._known is not None
        return [self._known.map_sd_mm(station, height_m) for height_m in HEIGHTS_M]

    def _seams(self) -> Iterator[tuple[tuple[str, str], list[FieldMap], Disagreement]]:
        """Pairs of stations of different cameras that see some place both."""
        assert self._known is not None
        stations = self._calibration.estimate.stations
        for first, second in combinations(self._placed(), 2):
            if stations[first].camera == stations[second].camera:
                continue
            maps = [self._known.seam_sd_mm(first, second, height_m) for height_m in HEIGHTS_M]
            if not np.all(np.isnan(maps[0].sd_mm)):
                yield (first, second), maps, self._calibration.disagreement(self._observations, first, second)


def with_sd(value: float, unit: str, verdict: Verdict | None) -> str:
    """A number and how well it is known: "868.96 ± 1.4 px", "4.022 m ± 6.6 mm", "745 px, unknown: below 1209 px".

    Without a verdict it was held, or nothing was minimised.
    """
    if verdict is None:
        return f"{value:.{3 if unit == 'm' else 4}f} {unit}"
    if verdict.by_profile and verdict.verdict != "known":
        bounds = bounds_text(verdict.low, verdict.high, unit)
        return f"{value:.{3 if unit == 'm' else 0}f} {unit}, {verdict.verdict}: {bounds}"
    word = "" if verdict.verdict == "known" else f", {verdict.verdict}"
    if not np.isfinite(verdict.sd):
        return f"{value:.{3 if unit == 'm' else 0}f} {unit}{word}"
    if unit == "m":
        return f"{value:.3f} m ± {two_digits(1e3 * verdict.sd)} mm{word}"
    places = int(np.clip(2 - np.floor(np.log10(verdict.sd)), 0, 9))
    return f"{value:.{places}f} ± {two_digits(verdict.sd)} {unit}{word}"


def _millimetres(value: float) -> str:
    return f"± {two_digits(value)} mm" if np.isfinite(value) else "unknown"


def _on_floor_and_above(maps: Sequence[FieldMap]) -> str:
    parts = []
    for m in maps:
        where = "on the floor" if m.height_m == 0.0 else f"at {1e3 * m.height_m:.0f} mm"
        x, y = m.worst_place_m
        worst = f" (worst {two_digits(m.worst_mm)} at {x:.1f}, {y:.1f} m)" if np.isfinite(m.worst_mm) else ""
        parts.append(f"{_millimetres(m.mean_mm)} {where}{worst}")
    return ", ".join(parts)


def _map_data(m: FieldMap) -> dict[str, Any]:
    return {
        "height_m": m.height_m,
        "mean_sd_mm": m.mean_mm,
        "worst_sd_mm": m.worst_mm,
        "worst_place_m": list(m.worst_place_m),
        "x_m": m.x_m.tolist(),
        "y_m": m.y_m.tolist(),
        "sd_mm": m.sd_mm.tolist(),
        "radius_95_mm": m.radius_95_mm.tolist(),
    }
