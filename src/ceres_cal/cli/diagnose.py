"""`ceres-cal diagnose`: what the residuals of a calibration show."""

from __future__ import annotations

from pathlib import Path

from ceres_cal import diagnostics, report
from ceres_cal.base.errors import InputError
from ceres_cal.cli import arguments, files
from ceres_cal.cli.command import argument, command, switch
from ceres_cal.report.document import Document


@command(
    "diagnose",
    "what the residuals say: faults by name, noise, outliers",
    "calibration.json field.json board.json",
    "calibration.json field.json board.json --held-out --report report.html",
)
def _run(
    args: arguments.ReportArguments,
    calibration: Path = arguments.calibration_argument(),
    observations: tuple[str, ...] = argument("OBS", "the observations it was made from, in the same order"),
    output: Path | None = arguments.output_option("the residual of every observation (.csv, .json or .npz)", None),
    new_data: bool = switch("the observations are others than those it was made from"),
    held_out: bool = switch("also report which lens predicts held-out parts best, as `calibrate` does"),
    strict: bool = switch("exit with 1 for any finding, even if it is harmless"),
    false_alarms: float = arguments.false_alarms_option("probability of a finding if nothing is wrong"),
) -> Document:
    files.require_outputs(args, [calibration, *observations])
    files.require_output(output, [], "the table is", ".csv", ".json", ".npz")
    if held_out and new_data:
        raise InputError("--held-out calibrates the observations anew: leave out --new-data")
    from ceres_cal.calibration.calibrating import lenses_by_held_out

    solved, seen = files.read_calibration(calibration), files.read_observations(observations)
    photographs = files.report_photographs(args, seen)
    diagnosis = diagnostics.diagnose(solved, seen, new_data=new_data, false_alarm_rate=false_alarms)
    choices = lenses_by_held_out(seen, solved.options) if held_out else None
    page, unmade = files.report_page(args, solved, seen, photographs, diagnosis, choices)

    # Wrong labels that were taken out do no harm, and noise is estimated.
    against = [finding for finding in diagnosis.findings if strict or report.is_against(finding)]
    answer = tuple(report.diagnosis_sections(diagnosis, choices, solved.options))
    unwritten, written = files.write_results(args, diagnosis.table.save, page)
    doubtful = against or diagnosis.conflicts or unmade.data or unwritten.data
    return Document((*answer, unmade, unwritten, written), 1 if doubtful else 0)
