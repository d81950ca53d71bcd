"""`ceres-cal score`: how well a calibration predicts new boards or fields, poses alone at their best."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from ceres_cal.cli.arguments import Loss, calibration_argument
from ceres_cal.cli.command import Arguments, argument, command, option, switch
from ceres_cal.cli.files import read_calibration, read_observations, require_different
from ceres_cal.report.document import Document, Section

if TYPE_CHECKING:
    from ceres_cal.calibration import Calibration
    from ceres_cal.moves.agreement import Agreement, Agreements


class ScoreArguments(Arguments):
    """A calibration, new observations, and how they are weighed."""

    calibration: Path = calibration_argument()
    observations: tuple[str, ...] = argument("OBS", "files of new observations (.json or .npz), taken together")
    hold_stations: bool = switch(
        "stations stand where the calibration has them, boards alone are posed: tests the poses of a rig, too"
    )
    loss: Loss | None = option("default: the calibration's")
    reject_sigma: float | None = option(
        "observations farther off do not take part; default: the calibration's. inf keeps all, and with --loss "
        "trivial the rms is the one that other programs state",
        "SIGMA",
    )


@command(
    "score",
    "how well a calibration predicts new boards or fields: intrinsics held",
    "calibration.json new.json",
    "rig.json boards.json --hold-stations --loss trivial --reject-sigma inf",
)
def _run(args: ScoreArguments) -> Document:
    require_different(args.observations)
    from ceres_cal.base.frozen import replace
    from ceres_cal.moves.scores import score

    calibration = read_calibration(args.calibration)
    asked = {name: value for name in ("loss", "reject_sigma") if (value := getattr(args, name)) is not None}
    options = replace(calibration.options, **asked)
    observations = read_observations(args.observations)
    return _document(score(calibration, observations, options=options, hold_stations=args.hold_stations), calibration)


def _document(answer: Agreements, before: Calibration) -> Document:
    most_views = 3  # shown
    cameras = list(answer.values())
    views = sorted((view for one in cameras for view in one.views), key=lambda view: -view.misfit.all_rms_px)
    posed = cameras[0].solution
    assert posed is not None
    ratios = dict(zip(("points", "curves"), cameras[0].misfit.noise, strict=True))
    known = [f"noise of {kind} {ratio:.2f} times the calibration's" for kind, ratio in ratios.items() if ratio == ratio]
    numbers = {
        "fit": posed.fit,
        "rms_px": posed.fit.rms_px,
        "calibration_rms_px": before.fit.rms_px,
        "noise_ratios": ratios,
    }
    worst = [f"{one.name}: {_left(one)}" for one in views[:most_views]]
    parts = {"cameras": list(map(_data, cameras)), "views": list(map(_data, views))}
    return Document(
        (
            Section("score", ["intrinsics held, poses alone solved for", *known], numbers),
            *(Section("camera", [f"{one.name}: {_left(one)}"]) for one in cameras),
            Section("worst", worst, parts),
        )
    )


def _data(one: Agreement) -> dict[str, Any]:
    return {"name": one.name, **{name: value for name, value in vars(one.misfit).items() if name != "noise"}}


def _left(one: Agreement) -> str:
    left = one.misfit
    kinds = [
        f"rms {rms:.4f} px over {count} {kind}"
        for kind, count, rms in (
            ("points", left.points, left.points_rms_px),
            ("curve observations", left.curves, left.curves_rms_px),
        )
        if count
    ]
    out = f"; {left.outliers} taken out, {left.all_rms_px:.4f} px with them" if left.outliers else ""
    return ", ".join(kinds or ["nothing took part"]) + out
