"""The chapter behind the verdict: what the residuals say, cause by cause."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ceres_cal.base.words import DASH, chance, counted, fixed, grouped, mm, powered, sentence, short
from ceres_cal.diagnostics import Finding, Noise
from ceres_cal.diagnostics.held_out import Choice, HeldOut
from ceres_cal.report.grounds import is_against
from ceres_cal.report.material import Material
from ceres_cal.report.page import Card, Chapter, Piece, Table, Text

_MOST_CARDS = 8

CHOSEN_BY = "the simplest within 1.75 standard errors of the least error; radial 2,3 wins ties"


def findings(material: Material) -> Chapter:
    """Findings, the largest first, the noise that is left, and the held-out errors where they were computed."""
    diagnosis = material.diagnosis
    rate = f"{100.0 * diagnosis.false_alarm_rate:g} %"
    tested = (
        f"{counted(diagnosis.tests, 'alternative')} of the model were tested; of sound data {rate} raise any finding."
    )
    pieces: list[Piece] = []
    if diagnosis.new_data:
        pieces.append(
            Text(
                "These are new data: residuals are those of the calibration as it stands, the findings are what would "
                "be left if it were refitted to them."
            )
        )
    if diagnosis.findings:
        pieces.append(Text(f"What is wrong with the calibration first, then the rest, each by size. {tested}"))
        ordered = sorted(diagnosis.findings, key=lambda one: not is_against(one))
        pieces += [_card(one) for one in ordered[:_MOST_CARDS]]
        pieces += _others(ordered[_MOST_CARDS:])
    else:
        pieces.append(Text(f"Nothing was found: what is left over looks like noise. {tested}"))
    pieces.append(_noise(diagnosis.noise))
    if material.choice is not None:
        pieces += _held_out(material.choice)
    return Chapter("findings", "What the residuals say", tuple(pieces))


def _others(others: Sequence[Finding]) -> Iterator[Piece]:
    if others:
        rows = tuple(
            (sentence(one.sentence), short(one.effect_px), short(one.effect_mm), powered(chance(one.log10_p)))
            for one in others
        )
        head = ("", "px", "mm", "false alarm")
        yield Table(head, rows, f"{counted(len(others), 'smaller finding')}", stacked=True)


def _card(finding: Finding) -> Card:
    facts = [f"{short(finding.effect_px)} px"]
    if np.isfinite(finding.effect_mm):
        facts.append(mm(finding.effect_mm))
    facts.append(counted(finding.observations, "observation"))
    facts.append(f"false alarm: {powered(chance(finding.log10_p))}")
    facts += [f"{one.name} {one.value:+.3g} ± {short(one.sd)} {one.unit}".strip() for one in finding.amounts]
    return Card(
        "no" if is_against(finding) else "care", sentence(finding.sentence), sentence(finding.advice), tuple(facts)
    )


def _noise(noise: tuple[Noise, ...]) -> Table:
    return Table(
        ("noise of", "observations", "sd, px", "of the stated", "neighbours' correlation"),
        tuple(
            (
                one.kind,
                grouped(one.observations),
                fixed(one.sigma_px, 3),
                f"{one.scale:.2f} times" if np.isfinite(one.stated_px) else "none stated",
                fixed(one.correlation, 2, "+"),
            )
            for one in noise
        ),
        stacked=True,
    )


def _held_out(choice: Choice) -> tuple[Table, Text]:
    rule = f"{sentence(chosen_lens(choice))}: {CHOSEN_BY}."
    thinned = f" On {100.0 * choice.thinned:.0f} % of the observations." if choice.thinned < 1.0 else ""
    rows = tuple(_candidate(choice, number, one) for number, one in enumerate(choice.candidates))
    head = ("lens", "held-out px", "mm", "fit px", "")
    return Table(head, rows, "Frames held out: how well others predict them", stacked=True), Text(rule + thinned)


def _candidate(choice: Choice, number: int, one: HeldOut) -> tuple[str, ...]:
    if one.failed:
        return one.label, DASH, DASH, DASH, one.failed
    marks = choice_marks(choice, number)
    return one.label, fixed(one.rms_px, 4), fixed(one.rms_mm, 3), fixed(one.fit_rms_px, 4), marks


def chosen_lens(choice: Choice) -> str:
    """Which lens to take."""
    chosen = choice.candidates[choice.chosen].label
    return "the calibration's lens is the one to take" if choice.chosen == choice.current else f"take {chosen}"


def choice_marks(choice: Choice, number: int) -> str:
    """What one of the candidates is: the current one, that of the least error, the chosen one."""
    marks = (("now", choice.current), ("least error", choice.best), ("chosen", choice.chosen))
    return ", ".join(word for word, index in marks if index == number)
