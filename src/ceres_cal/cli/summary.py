"""What `ceres-cal calibrate` says of its result, to people and to scripts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np

from ceres_cal.base.transforms import Pose, euler_from_rotation
from ceres_cal.calibration import Calibration, calibration_to_json
from ceres_cal.cli.command import plural, written
from ceres_cal.cli.trust import Trust, with_sd
from ceres_cal.model.parameters import Options, anchored_stations
from ceres_cal.observations import Observations
from ceres_cal.scene.camera import Camera

_MOST_FEATURES = 6
_MANY_OUTLIERS, _LARGE_SCALE = 0.3, 4.0  # from where on a warning is due
_PHI_FROM = {
    "fixed": "held",
    "views": "started from the views",
    "prior": "started from its prior",
    "guess": "started from a guess",
    "posterior": "under what was known of it",
}


def tilt_deg(cam_from_world: Pose) -> float:
    """Angle between the camera's axis and straight down."""
    x, y, z = cam_from_world.rotation[2]
    return float(np.degrees(np.arctan2(np.hypot(x, y), -z)))


def calibration_data(
    calibration: Calibration,
    observations: Observations,
    inputs: Sequence[str],
    output: Path | None,
    report: Path | None = None,
) -> dict[str, Any]:
    """Everything, for --json."""
    return {
        "calibration": calibration_to_json(calibration),
        "inputs": list(inputs),
        "output": None if output is None else str(output),
        "report": None if report is None else str(report),
        "counts": _counts(observations),
        "rms_px": calibration.rms_px,
        "tilt_deg": {name: tilt_deg(camera.cam_from_world) for name, camera in calibration.stations.items()},
        "uncertainty": Trust(calibration, observations).data(),
        "outliers": dict(_outliers(calibration).most_common()),
        "warnings": list(_warnings(calibration, observations)),
    }


def calibration_text(
    calibration: Calibration,
    observations: Observations,
    inputs: Sequence[str],
    output: Path | None,
    report: Path | None = None,
) -> str:
    """A short table for people."""
    anchored, trust = anchored_stations(observations), Trust(calibration, observations)
    sections = [
        section("read", [", ".join(map(str, inputs)), *_counted(observations)]),
        section("fit", _fit(calibration)),
    ]
    for name, camera in calibration.cameras.items():
        lines = _intrinsics(name, camera, calibration.options, calibration.phi_from.get(name, ""), trust)
        sections.append(section("camera", [f"{name}, {camera.image_size[0]} x {camera.image_size[1]} px", *lines]))
    for name, camera in calibration.stations.items():
        sections.append(
            section(
                "station", [f"{name}{_of_camera(calibration, name)}", *_pose(name, camera, name in anchored, trust)]
            )
        )
    if len(calibration.estimate.structure.names):
        sections.append(section("as built", _structure(calibration)))
    sections += [section(title, lines) for title, lines in trust.sections()]
    sections.append(section("outliers", _outlier_lines(calibration)))
    sections.append(section("stopped", _stop(calibration)))
    sections.extend(section("warning", wrap(text, 100)) for text in _warnings(calibration, observations))
    if files := written(output, report):
        sections.append(section("written", files))
    return "\n".join(sections)


def section(title: str, lines: Iterable[str]) -> str:
    """A title beside its lines."""
    return "\n".join(f"{'' if number else title:10}{line}" for number, line in enumerate(lines))


def _counts(observations: Observations) -> dict[str, int]:
    return {
        "views": len(observations.views),
        "cameras": len(observations.cameras),
        "stations": len(observations.stations),
        "placements": len(observations.placements),
        "points": len(observations.points),
        "curves": len(observations.curves),
    }


def _counted(observations: Observations) -> list[str]:
    count = _counts(observations)
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
    structure = calibration.estimate.structure
    order = np.argsort(-np.abs(structure.values))[:_MOST_FEATURES]
    lines = [f"{1e3 * structure.values[i]:8.2f} mm  {structure.names[i]}" for i in order]
    rest = len(structure.names) - len(lines)
    return [*lines, f"and {plural(rest, 'smaller correction')}"] if rest else lines


def _intrinsics(name: str, camera: Camera, options: Options, phi_from: str, trust: Trust) -> list[str]:
    def held(*names: str) -> str:
        return " (held)" if all(name in options.fixed for name in names) else ""

    def known(quantity: str, value: float, unit: str = "px") -> str:
        return with_sd(value, unit, trust.verdict("camera", name, quantity))

    cx, cy = camera.principal_point
    centre = held("cx", "cy") if options.free_principal_point else " (held)"
    rows = [("phi", f"{known('phi', camera.phi)} ({_PHI_FROM.get(phi_from, phi_from)})")]
    if options.free_aspect or camera.aspect != 1.0:
        rows.append(("aspect", f"{camera.aspect:.7f}{_plus_minus(trust, name, 'aspect')}{held('aspect')}"))
    rows.append(("principal point", f"{known('cx', cx)}, {known('cy', cy)}{centre}"))
    for coefficient, value in camera.lens.coefficients.items():
        rows.append((coefficient, f"{value!r}{_plus_minus(trust, name, coefficient)}{held(coefficient)}"))
    lines = [f"{title:16}{value}" for title, value in rows]
    return [*lines, camera.lens.note] if camera.lens.note else lines


def _of_camera(calibration: Calibration, station: str) -> str:
    camera = calibration.estimate.stations[station].camera
    return "" if camera == station else f", camera {camera}"


def _plus_minus(trust: Trust, camera: str, quantity: str) -> str:
    verdict = trust.verdict("camera", camera, quantity)
    return "" if verdict is None else f" ± {verdict.sd:.2g}" if np.isfinite(verdict.sd) else ", unknown"


def _pose(name: str, camera: Camera, anchored: bool, trust: Trust) -> list[str]:
    if anchored:
        return ["held as the world: boards alone do not tell where it stands"]
    x, y, z = camera.position
    alpha, beta, gamma = np.degrees(euler_from_rotation(camera.cam_from_world.rotation))
    position = [
        f"{q} {with_sd(value, 'm', trust.verdict('station', name, q))}"
        for q, value in (("x", x), ("y", y), ("height", z))
    ]
    turns = [trust.verdict("station", name, f"turn_{axis}") for axis in "xyz"]
    told = [f"{np.degrees(turn.sd):.2g}" if np.isfinite(turn.sd) else "unknown" for turn in turns if turn is not None]
    return [
        f"{'position':16}{', '.join(position)}",
        f"{'angles':16}alpha {alpha:.4f}, beta {beta:.4f}, gamma {gamma:.4f} deg (the paper's)",
        f"{'tilt':16}{tilt_deg(camera.cam_from_world):.3f} deg from straight down",
        *([f"{'turns':16}± {', '.join(told)} deg about the camera's x, y and z"] if told else []),
    ]


def _outliers(calibration: Calibration) -> Counter[str]:
    return Counter(f"{entry.kind} {entry.feature}" for entry in calibration.rejected)


def _outlier_lines(calibration: Calibration) -> list[str]:
    fit, total, features = calibration.fit, len(calibration.rejected), _outliers(calibration)
    everything = fit.points + fit.curves + total
    if not total:
        return [f"none of {everything}"]
    lines = [f"{total} of {everything} taken out ({calibration.options.reject_sigma:g} sigma and more)"]
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
    if len(calibration.rejected) > _MANY_OUTLIERS * (len(observations.points) + len(observations.curves)):
        yield "so many observations were taken out: check labels, target dimensions and the choice of lens"
    scale = max(calibration.fit.point_scale, calibration.fit.curve_scale)
    if scale > _LARGE_SCALE:
        yield (
            f"the residuals are {scale:.0f} times the stated sigmas: the lens may not suit the camera, or labels and "
            "target dimensions may be wrong"
        )
