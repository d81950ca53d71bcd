"""What `ceres-cal calibrate` says of its result, to people and to scripts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from ceres_cal.base.transforms import euler_from_rotation
from ceres_cal.base.words import at_precision, bounds_text, plural, two_digits
from ceres_cal.calibration import Calibration
from ceres_cal.cli.arguments import Reporting
from ceres_cal.cli.outputs import section, wrapped, written, written_data
from ceres_cal.model.parameters import Options, anchored_stations
from ceres_cal.observations import Observations
from ceres_cal.report.grounds import disputed, is_against, judge_quality
from ceres_cal.report.quality import Quality
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.heights import at_height
from ceres_cal.solve import words_of
from ceres_cal.uncertainty import FieldMap, Verdict
from ceres_cal.uncertainty.rig import RigPair

_MOST_FEATURES, _MOST_DIRECTIONS, _MOST_FINDINGS = 6, 4, 3
_MANY_OUTLIERS, _LARGE_SCALE = 0.3, 4.0  # from where on a warning is due
_PHI_FROM = {
    "fixed": "held",
    "views": "started from the views",
    "prior": "started from its prior",
    "guess": "started from a guess",
    "posterior": "under what was known of it",
}


def calibration_data(quality: Quality, inputs: Sequence[str], args: Reporting) -> dict[str, Any]:
    """Everything, for --json."""
    calibration, observations, judged = quality.calibration, quality.observations, judge_quality(quality)
    findings = () if quality.diagnosis is None else quality.diagnosis.findings
    return {
        "verdict": {
            "level": judged.level,
            "headline": judged.headline,
            "reasons": [{"level": level, "text": text} for level, text in judged.reasons],
            "findings": [asdict(finding) for finding in findings],
        },
        "calibration": calibration.to_file(),
        "inputs": list(inputs),
        **written_data(args),
        "counts": observations.counts,
        "rms_px": calibration.rms_px,
        "tilt_deg": {name: camera.tilt_deg for name, camera in calibration.stations.items()},
        "uncertainty": _uncertainty_data(quality),
        "outliers": dict(_outliers(calibration).most_common()),
        "warnings": list(_warnings(calibration, observations)),
    }


def calibration_text(quality: Quality, inputs: Sequence[str], args: Reporting) -> str:
    """A short table for people; the verdict comes last."""
    calibration, observations = quality.calibration, quality.observations
    anchored = anchored_stations(observations)
    sections = [
        section("read", [", ".join(map(str, inputs)), *_counted(observations)]),
        section("fit", _fit(calibration)),
    ]
    if calibration.lens_choice is not None:
        sections.append(section("lens", wrapped(calibration.lens_choice.words)))
    for name, camera in calibration.cameras.items():
        lines = _intrinsics(name, camera, calibration.options, calibration.phi_from.get(name, ""), quality)
        sections.append(section("camera", [f"{name}, {camera.image_size[0]} x {camera.image_size[1]} px", *lines]))
    for name, camera in calibration.stations.items():
        pose = _pose(name, camera, name in anchored, quality)
        owner = calibration.estimate.stations[name].camera
        sections.append(section("station", [name if owner == name else f"{name}, camera {owner}", *pose]))
    if lengths := _dimensions(quality):
        sections.append(section("lengths", lengths))
    if calibration.estimate.structure.own:
        sections.append(section("as built", _structure(calibration)))
    sections += [section(title, lines) for title, lines in _uncertainty_lines(quality)]
    sections.append(section("outliers", _outlier_lines(calibration)))
    sections.append(section("stopped", _stop(calibration)))
    sections.extend(section("warning", wrapped(text)) for text in _warnings(calibration, observations))
    sections.append(section("verdict", list(_verdict(quality))))
    return "\n".join([*sections, *written(args)])


def _verdict(quality: Quality) -> Iterator[str]:
    """The headline of the report, and what stands behind it and was not said yet."""
    judged, findings = judge_quality(quality), () if quality.diagnosis is None else quality.diagnosis.findings
    yield from wrapped(judged.headline)
    cause = disputed(quality)
    for finding in [one for one in findings if is_against(one) and not cause][:_MOST_FINDINGS]:
        yield from wrapped(f"{finding.kind}: {finding.sentence}")
    if findings:
        whence = " may follow from that" if cause else ": `ceres-cal diagnose` says what to do"
        yield f"{plural(len(findings), 'finding')}{whence}"


def _counted(observations: Observations) -> list[str]:
    count = observations.counts
    owners = [plural(count[f"{word}s"], word) for word in ("view", "camera", "station", "placement")]
    return [
        ", ".join(owners),
        f"{plural(count['points'], 'point observation')}, {plural(count['curves'], 'curve observation')}",
    ]


def _fit(calibration: Calibration) -> list[str]:
    fit, lines = calibration.fit, []
    for kind, used, rms, scale in (
        ("points", fit.points, fit.points_rms_px, fit.point_scale),
        ("curves", fit.curves, fit.curves_rms_px, fit.curve_scale),
    ):
        if used:
            noise = f"noise {scale:.3f} times the stated sigmas"
            lines.append(f"{kind}  rms {rms:.4f} px over {used}, {noise}")
    return lines


def _structure(calibration: Calibration) -> list[str]:
    structure, estimated = calibration.estimate.structure, {one.target for one in calibration.as_built}
    stated = [i for i, name in enumerate(structure.names[: structure.own]) if name.partition("/")[0] not in estimated]
    order = sorted(stated, key=lambda i: -abs(structure.values[i]))[:_MOST_FEATURES]
    lines = [line for words in words_of(calibration.as_built) for line in wrapped(words)]
    lines += [f"{1e3 * structure.values[i]:8.2f} mm  {structure.names[i]}" for i in order]
    rest = len(stated) - len(order)
    return [*lines, f"and {plural(rest, 'smaller correction')}"] if rest else lines


def _dimensions(quality: Quality) -> list[str]:
    lengths = quality.calibration.estimate.structure.dimensions
    known = {f"{key[1]}/{key[2]}": verdict for key, verdict in quality.verdicts.items() if key[0] == "dimension"}
    return [f"{name:36}{with_sd(length, 'm', known.get(name))} (solved for)" for name, length in lengths.items()]


def _intrinsics(name: str, camera: Camera, options: Options, phi_from: str, quality: Quality) -> list[str]:
    def held(*names: str) -> str:
        return " (held)" if all(name in options.held for name in names) else ""

    def known(quantity: str, value: float, unit: str = "px") -> str:
        return with_sd(value, unit, quality.verdicts.get(("camera", name, quantity)))

    cx, cy = camera.principal_point
    centre = held("cx", "cy") if options.free_principal_point else " (held)"
    rows = [("phi", f"{known('phi', camera.phi)} ({_PHI_FROM.get(phi_from, phi_from)})")]
    if options.free_aspect or camera.aspect != 1.0:
        rows.append(("aspect", f"{_coefficient(quality, name, 'aspect', camera.aspect)}{held('aspect')}"))
    if options.free_skew or camera.skew != 0.0:
        rows.append(("skew", f"{_coefficient(quality, name, 'skew', camera.skew)}{held('skew')}"))
    rows.append(("principal point", f"{known('cx', cx)}, {known('cy', cy)}{centre}"))
    for coefficient, value in camera.lens.listed.items():
        rows.append((coefficient, f"{_coefficient(quality, name, coefficient, value)}{held(coefficient)}"))
    lines = [f"{title:16}{value}" for title, value in rows]
    return [*lines, camera.lens.note] if camera.lens.note else lines


def _coefficient(quality: Quality, camera: str, quantity: str, value: float) -> str:
    verdict = quality.verdicts.get(("camera", camera, quantity))
    if verdict is None:
        return f"{value:.8g}"
    shown = at_precision(value, verdict.sd)
    return f"{shown} ± {verdict.sd:.2g}" if np.isfinite(verdict.sd) else f"{shown}, unknown"


def _pose(name: str, camera: Camera, anchored: bool, quality: Quality) -> list[str]:
    if anchored:
        return ["held as the world: boards alone do not tell where it stands"]
    x, y, z = camera.position
    alpha, beta, gamma = np.degrees(euler_from_rotation(camera.cam_from_world.rotation))
    position = [
        f"{q} {with_sd(value, 'm', quality.verdicts.get(('station', name, q)))}"
        for q, value in (("x", x), ("y", y), ("height", z))
    ]
    turns = [quality.verdicts.get(("station", name, f"turn_{axis}")) for axis in "xyz"]
    sds = [f"{np.degrees(turn.sd):.2g}" if np.isfinite(turn.sd) else "unknown" for turn in turns if turn is not None]
    return [
        f"{'position':16}{', '.join(position)}",
        f"{'angles':16}alpha {alpha:.3f}, beta {beta:.3f}, gamma {gamma:.3f} deg (the paper's)",
        f"{'tilt':16}{camera.tilt_deg:.3f} deg from straight down",
        *([f"{'turns':16}± {', '.join(sds)} deg about the camera's x, y and z"] if sds else []),
    ]


def _outliers(calibration: Calibration) -> Counter[str]:
    wholes = (entry.reason.partition(":")[0] for entry in calibration.outliers if entry.is_of_whole)
    single = (f"{entry.kind} {entry.feature}" for entry in calibration.outliers if not entry.is_of_whole)
    return Counter(wholes) + Counter(single)


def _outlier_lines(calibration: Calibration) -> list[str]:
    fit, total, features = calibration.fit, len(calibration.outliers), _outliers(calibration)
    everything = fit.points + fit.curves + total
    if not total:
        return [f"none of {everything}"]
    lines = [
        f"{total} of {everything} taken out ({calibration.options.reject_sigma:g} sigma and more, or a whole line)"
    ]
    lines += [f"{count:5}  {name}" for name, count in features.most_common(_MOST_FEATURES)]
    rest = len(features) - _MOST_FEATURES
    if rest > 0:
        others = total - sum(count for _, count in features.most_common(_MOST_FEATURES))
        lines.append(f"{others:5}  on {plural(rest, 'other feature')}")
    return lines


def _stop(calibration: Calibration) -> list[str]:
    if not calibration.rounds:
        return [calibration.termination]
    iterations = max(len(calibration.history) - 1, 0)
    how = "converged" if calibration.converged else "did not converge"
    return [
        f"{how} after {plural(calibration.rounds, 'solve')}, the last of {plural(iterations, 'iteration')}",
        calibration.termination,
    ]


def _warnings(calibration: Calibration, observations: Observations) -> Iterator[str]:
    yield from calibration.warnings
    if not calibration.rounds:  # nothing was solved
        return
    if not calibration.converged:
        yield "the solve did not come to rest: raise --max-iterations"
    out = len(calibration.outliers)
    if out > _MANY_OUTLIERS * (calibration.fit.points + calibration.fit.curves + out):
        yield "so many observations were taken out: check labels, target dimensions and the choice of lens"
    scale = max(calibration.fit.point_scale, calibration.fit.curve_scale)
    if scale > _LARGE_SCALE:
        yield (
            f"the residuals are {scale:.0f} times the stated sigmas: the lens may not suit the camera, or labels and "
            "target dimensions may be wrong"
        )


# ---- how well it is known -------------------------------------------------------------------------------------------


def with_sd(value: float, unit: str, verdict: Verdict | None) -> str:
    """A number and how well it is known: "869.0 ± 1.4 px", "4.022 m ± 6.6 mm", "745 px, unknown: below 1209 px".

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
    return f"{at_precision(value, verdict.sd)} ± {two_digits(verdict.sd)} {unit}{word}"


def _uncertainty_lines(quality: Quality) -> Iterator[tuple[str, list[str]]]:
    if quality.uncertainty is None:
        return
    if quality.uncertainty.rig:
        yield "rig", [_rig_line(pair) for pair in quality.uncertainty.rig]
    if quality.maps:
        yield "located", [f"{name}: {_sd_at_heights(maps)}" for name, maps in quality.maps.items()]
    seams = []
    for seam in quality.each_seam():
        rms, expected, count = seam.measured.rms_mm, seam.measured.expected_rms_mm, len(seam.measured.what)
        seams.append(f"{' - '.join(seam.stations)}: {_sd_at_heights(seam.predicted)}")
        if count:
            measured = f"found {two_digits(rms)} mm where {two_digits(expected)} were expected"
            seams.append(f"{measured} (rms of {count} points and stretches that both observed)")
    if seams:
        yield "seam", seams
    if quality.uncertainty.widening:
        yield "widened", [quality.uncertainty.widening]
    weak = [direction.words for direction in quality.uncertainty.weak_directions]
    if weak:
        more = [f"and {len(weak) - _MOST_DIRECTIONS} more (--json)"] if len(weak) > _MOST_DIRECTIONS else []
        yield "weak", weak[:_MOST_DIRECTIONS] + more
    unknown = quality.uncertainty.unknown_placements
    if unknown:
        name, quantities = next(iter(unknown.items()))
        rest = f", and of {len(unknown) - 1} more placements" if len(unknown) > 1 else ""
        yield "unknown", [f"{', '.join(quantities)} of placement {name!r}{rest}"]


def _rig_line(pair: RigPair) -> str:
    """Baseline and angle of two stations, each with its standard deviation."""
    baseline, turn = (
        1e3 * np.array([pair.baseline_m, pair.baseline_sd_m]),
        np.degrees([pair.angle_rad, pair.angle_sd_rad]),
    )
    apart, turned = (
        f"{at_precision(value, sd)} ± {two_digits(sd) if np.isfinite(sd) else 'unknown'}"
        for value, sd in (baseline, turn)
    )
    return f"{' - '.join(pair.stations)}: baseline {apart} mm, angle {turned} deg"


def _sd_at_heights(maps: Sequence[FieldMap]) -> str:
    parts = []
    for m in maps:
        x, y = m.worst_place_m
        mean = f"± {two_digits(m.mean_mm)} mm" if np.isfinite(m.mean_mm) else "unknown"
        worst = f" (worst {two_digits(m.worst_mm)} at {x:.1f}, {y:.1f} m)" if np.isfinite(m.worst_mm) else ""
        parts.append(f"{mean} {at_height(m.height_m)}{worst}")
    return ", ".join(parts)


def _uncertainty_data(quality: Quality) -> dict[str, Any] | None:
    uncertainty = quality.uncertainty
    if uncertainty is None:
        return None
    return {
        "numbers": [{**asdict(v), "key": v.key._asdict()} for v in uncertainty.verdicts],
        "widening": uncertainty.widening,
        "rig": [asdict(pair) for pair in uncertainty.rig],
        "dependence": uncertainty.posterior.dependence,
        "weak_directions": [
            {"words": d.words, "relative": d.relative, "shares": [[*key[:3], share] for key, share in d.shares]}
            for d in uncertainty.weak_directions
        ],
        "unknown_placements": uncertainty.unknown_placements,
        "maps": {name: [_map_data(m) for m in maps] for name, maps in quality.maps.items()},
        "seams": [
            {
                "stations": seam.stations,
                "predicted": [_map_data(m) for m in seam.predicted],
                "found_mm": seam.measured.rms_mm,
                "expected_mm": seam.measured.expected_rms_mm,
                "compared": len(seam.measured.what),
            }
            for seam in quality.each_seam()
        ],
    }


def _map_data(m: FieldMap) -> dict[str, Any]:
    return {
        "height_m": m.height_m,
        "mean_sd_mm": m.mean_mm,
        "worst_sd_mm": m.worst_mm,
        "worst_place_m": m.worst_place_m,
        "x_m": m.x_m,
        "y_m": m.y_m,
        "sd_mm": m.sd_mm,
        "radius_95_mm": m.radius_95_mm,
    }
