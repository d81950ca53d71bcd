"""Results of the residuals: sections of a diagnosis, and the chapter of a report after its verdict."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from ceres_cal.base.words import chance, counted, fixed, grouped, mm, plural, powered, sentence, short, two_digits
from ceres_cal.calibration import LensChoice
from ceres_cal.calibration.lens_forms import label_of
from ceres_cal.diagnostics import Diagnosis, Finding, Noise, ResidualTable
from ceres_cal.diagnostics.summaries import Summary
from ceres_cal.problem.parameters import Options
from ceres_cal.report.document import Card, Chapter, Piece, Section, Table, Text, wrapped
from ceres_cal.report.grounds import is_against
from ceres_cal.report.numbers import lens_choice

_MOST_CARDS, _MOST_ROWS = 8, 8
_MODEL_ERROR = (
    "the model is wrong by more than its noise: no covariance or standard deviation of this calibration includes that "
    "error"
)
_NEW_DATA = (
    "residuals are those of the calibration as it is; findings are what would remain after a refit to these data"
)


def diagnosis_sections(
    diagnosis: Diagnosis, choices: Mapping[str, LensChoice] | None, options: Options
) -> Iterator[Section]:
    """Yield the verdict, the findings by size, then tables: everything except the table of single observations."""
    summaries = diagnosis.summaries
    own = ("model_error", "conflicts", "new_data", "tests", "false_alarm_rate", "findings")
    said = _verdict(diagnosis)
    yield Section("verdict", said, {"verdict": said, **{name: getattr(diagnosis, name) for name in own}})
    yield from (Section("conflict", wrapped(conflict.words)) for conflict in diagnosis.conflicts)
    for number, finding in enumerate(diagnosis.findings, start=1):
        yield Section(f"finding {number}", _card(finding).lines())
    yield _noise(diagnosis.noise)
    yield _held_out(choices, options) if choices is not None else Section(data={"held_out": None})
    yield _outliers(diagnosis.table)
    for title, name in (("frames", "frames"), ("features", "features"), ("radius", "radii"), ("regions", "regions")):
        one = getattr(summaries, name)
        yield Section(title, _summary(one, by_size=name != "radii"), {"summaries": {name: one}})
    yield Section("leverage", _leverage(diagnosis.table), {"radius_trend": summaries.trends})


def chapter(diagnosis: Diagnosis, choices: Mapping[str, LensChoice] | None, options: Options) -> Chapter:
    """Make the chapter with findings, the largest first, the remaining noise, and the held-out errors if they were
    computed.
    """
    rate = f"{100.0 * diagnosis.false_alarm_rate:g} %"
    alternatives = counted(diagnosis.tests, "alternative")
    tested = f"{alternatives} of the model were tested. Correct data give a finding in {rate} of cases."
    pieces: list[Piece] = [Text(f"These are new data: {_NEW_DATA}.")] if diagnosis.new_data else []
    if diagnosis.findings:
        pieces.append(Text(f"Faults of the calibration come first, then the others, each by size. {tested}"))
        ordered = sorted(diagnosis.findings, key=lambda one: not is_against(one))
        pieces += [_card(one) for one in ordered[:_MOST_CARDS]]
        pieces += _others(ordered[_MOST_CARDS:])
    else:
        pieces.append(Text(f"Nothing was found: the residuals look like noise. {tested}"))
    pieces += _noise(diagnosis.noise).pieces
    pieces += () if choices is None else _held_out(choices, options).pieces
    return Chapter("findings", "What the residuals say", tuple(pieces))


def _verdict(diagnosis: Diagnosis) -> list[str]:
    rate = f"{diagnosis.tests} tests; sound data raise a finding in {100.0 * diagnosis.false_alarm_rate:g} % of cases"
    lines = [f"new data: {_NEW_DATA}"] if diagnosis.new_data else []
    if diagnosis.conflicts:
        lines.append(
            "the observations contradict what was stated beforehand: the standard deviations include the difference, "
            "and findings may follow from it"
        )
    if not diagnosis.findings:
        sound = "nothing else" if diagnosis.conflicts else "sound"
        return [*lines, f"{sound}: the residuals look like noise ({rate})"]
    lines.append(f"{plural(len(diagnosis.findings), 'finding')}, the largest first ({rate})")
    return [*lines, _MODEL_ERROR] if diagnosis.model_error else lines


# ---- findings -------------------------------------------------------------------------------------------------------


def _card(finding: Finding) -> Card:
    facts = [f"{short(finding.effect_px)} px"]
    if np.isfinite(finding.effect_mm):
        facts.append(mm(finding.effect_mm))
    facts.append(counted(finding.observations, "observation"))
    facts.append(f"false alarm: {powered(chance(finding.log10_p))}")
    facts += [
        f"{one.name} {two_digits(one.value, 3, '+')} ± {short(one.sd)} {one.unit}".strip() for one in finding.amounts
    ]
    return Card(
        "no" if is_against(finding) else "care", sentence(finding.sentence), sentence(finding.advice), tuple(facts)
    )


def _others(others: Sequence[Finding]) -> Iterator[Piece]:
    if others:
        rows = tuple(
            (sentence(one.sentence), short(one.effect_px), short(one.effect_mm), powered(chance(one.log10_p)))
            for one in others
        )
        head = ("", "px", "mm", "false alarm")
        yield Table(head, rows, f"{counted(len(others), 'smaller finding')}", stacked=True)


# ---- noise, outliers, lenses held out -------------------------------------------------------------------------------


def _noise(every: Sequence[Noise]) -> Section:
    rows = tuple(
        (
            one.kind,
            grouped(one.observations),
            fixed(one.sigma_px, 4),
            f"{one.scale:.3f} times" if np.isfinite(one.stated_px) else "none stated",
            fixed(one.correlation, 2, "+"),
        )
        for one in every
    )
    head = ("", "observations", "sd, px", "of the stated", "neighbours' correlation")
    table = Table(head, rows, "Noise", stacked=True)
    return Section("noise", table.lines(), {"noise": every}, (table,))


def _outliers(table: ResidualTable) -> Section:
    names = np.array(table.features)[table.feature[table.outlier]]
    rejected = Counter(names.tolist())
    out = f"{sum(rejected.values())} of {len(table)} taken out" if rejected else f"none of {len(table)}"
    lines = [out, *(f"{count:5}  {name}" for name, count in rejected.most_common(_MOST_ROWS))]
    rest = len(rejected) - _MOST_ROWS
    lines += [f"and on {plural(rest, 'other feature')}"] if rest > 0 else []
    return Section("outliers", lines, {"rejected": rejected})


def _held_out(choices: Mapping[str, LensChoice], options: Options) -> Section:
    """Section on which lens of each camera predicts held-out parts best, and whether the calibration has that lens."""
    lines, data, pieces = list[str](), {}, list[Piece]()
    for name, choice in choices.items():
        current, camera = label_of(options.of_camera(name)), f"camera {name!r}: " if len(choices) > 1 else ""
        take = "the calibration's lens is the one to take" if choice.chosen == current else f"take {choice.chosen}"
        lines += [*wrapped(camera + choice.words), take]
        data[name] = {**vars(choice), "current": current}
        pieces += [*lens_choice(camera, choice).pieces, Text(f"{sentence(take)}.")]
    return Section("held out", lines, {"held_out": data}, tuple(pieces))


# ---- tables ---------------------------------------------------------------------------------------------------------


def summary_table(head: str, summary: Summary, rows: Sequence[int], names: Sequence[str] = ()) -> Table:
    """Table of some groups of observations, given by number; `names` replaces the summary's own names."""
    measured = {"points_rms_px": 3, "curves_rms_px": 3, "rms_mm": 2, "rms_sigma": 3}  # decimals; counts have none
    shown = ("points", "points_rms_px", "curves", "curves_rms_px", "rms_mm", "rms_sigma", "rejected")

    def column(name: str) -> list[str]:
        values = getattr(summary, name)[list(rows)].tolist()
        return [fixed(value, measured[name]) if name in measured else grouped(value) for value in values]

    columns = map(column, shown)
    cells = zip(names or [summary.names[i] for i in rows], *columns, strict=True)
    return Table((head, "points", "rms px", "curves", "rms px", "mm", "sigma", "out"), tuple(cells))


def _summary(summary: Summary, *, by_size: bool) -> list[str]:
    """Rows of one summary: all of them, or those with the largest residuals relative to the noise."""
    order: Sequence[int] = range(len(summary.names))
    if by_size:
        order = np.argsort(-np.nan_to_num(summary.rms_sigma), kind="stable")[:_MOST_ROWS].tolist()
    rest = len(summary.names) - len(order)
    more = [f"and {rest} more with smaller residuals"] if rest else []
    return [*summary_table("", summary, order).lines(), *more]


def _leverage(table: ResidualTable) -> Iterator[str]:
    """Yield the observations with the largest influence on the result."""
    leverage = np.where(table.inlier, np.nan_to_num(table.leverage), 0.0)
    for i in np.argsort(-leverage, kind="stable")[:3]:
        view, feature = table.views[table.view[i]], table.features[table.feature[i]]
        yield f"{leverage[i]:.2f}  {table.id_of(int(i))}, frame {view['frame']!r}, {feature}"
