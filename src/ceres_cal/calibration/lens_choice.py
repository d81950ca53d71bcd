"""Choose the lens: the simplest of those that predict held-out placements or lines as well as any other does.

Some observations are solved for once, robustly, and from there with the longest lens of each kind. Shorter lenses are
the longest with coefficients held at 0: the residuals of a group in a solve without it follow for every lens from the
normal equations of each group (`effects/groups.py`). Errors that are correlated within a group do not make a longer
lens predict other groups better; a criterion that counts observations would attribute them to the lens.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np

from ceres_cal.base import (
    NORMAL_95,
    CalibrationError,
    DegenerateError,
    Frozen,
    Mask,
    attempt,
    median,
    or_none,
    replace,
)
from ceres_cal.base.transforms import Poses
from ceres_cal.calibration import LensChoice, TriedLens
from ceres_cal.calibration.lens_comparison import (
    compared_kinds,
    explained_by_another,
    last_resort,
    may_lack_a_formula,
    one_power_more,
)
from ceres_cal.calibration.lens_forms import (
    AS_GOOD,
    AS_GOOD_BESIDE_LENGTHS,
    CLEARLY,
    PAPER,
    decide,
    papers,
    pseudo_bma,
    standard_errors,
)
from ceres_cal.calibration.lens_seen import Candidate, InlierRows, Kind
from ceres_cal.observations import Observations, Prior
from ceres_cal.posterior.other_lenses import OpenDirection, OtherLenses
from ceres_cal.posterior.posterior import LEAST_PROBABILITY, Posterior
from ceres_cal.problem import Estimate, Information, Options, moved
from ceres_cal.problem.priors import VAGUE
from ceres_cal.robust.as_built import AS_DRAWN, Construction
from ceres_cal.start.initialise import Start

_BROKEN = "the solve leaves larger residuals than its linear model predicted"
_EXPLAINED = "takes out observations that another lens explains"


class LensDecision(Frozen):
    """The lens that was chosen for a camera: options with it, the initial estimate, and what it was compared with.

    Attributes:
        among: the comparison it was chosen from; None where lenses could not be compared. untold: the observations
            where lenses could not be compared, else None.
    """

    options: Options
    start: Start
    choice: LensChoice
    among: Comparison | None = None
    untold: Observations | None = None

    def otherwise(self, failure: str, options: Options, start: Start) -> LensDecision | None:
        """Return the next lens where all of the observations cannot be calibrated with this one: the best of another
        kind, at last the paper's, then None. Where lenses could not be compared, return the likeliest one not yet
        tried.

        Args:
            options: with the paper's lens. start: with the paper's lens, too.
        """
        if self.untold is not None:
            return _of_few(self.untold, self.options, self.start, self.choice.tried, failure)
        if self.among is None:
            return None
        return self.among.without_kind(failure) or self._papers(failure, options, start)

    def _papers(self, failure: str, options: Options, start: Start) -> LensDecision:
        """Return the paper's lens instead, with the first start."""
        failed = [replace(one, failed=failure) if one.label == self.choice.chosen else one for one in self.choice.tried]
        tried = sorted(failed, key=lambda one: one.label != PAPER)
        return LensDecision(options, start, replace(self.choice, chosen=PAPER, tried=tuple(tried)))

    @property
    def built(self) -> Construction:
        """Targets as built, as estimated when lenses were compared."""
        return AS_DRAWN if self.among is None else self.among.seen.built

    def others(self, posterior: Posterior, end: Estimate, options: Options) -> OtherLenses:
        """Return the estimates with other lenses, weighted by their probabilities; see `Comparison.others`."""
        if self.among is not None:
            return self.among.others(posterior, options)
        if self.untold is not None:
            from ceres_cal.calibration.lens_of_few import others_of_few

            return others_of_few(self.untold, self.choice.chosen, options, end)
        return OtherLenses(self.start.estimate, (), (), {})


class Comparison(Frozen):
    """The lenses that were compared, and the one that was chosen.

    Attributes:
        seen: the inliers that took part; `share`: of all observations. as_good: a lens that predicts worse by at most
            so many standard errors counts as good.
        start: initial estimate of the camera. there: estimate with the chosen lens at its minimum.
        passed: the lens that was chosen first, where all of the observations cannot be calibrated with it.
    """

    seen: InlierRows
    share: float
    as_good: float
    start: Start
    tried: tuple[Candidate, ...]
    best: Candidate
    chosen: Candidate
    there: Estimate
    passed: Candidate | None = None

    @property
    def worse_than_passed(self) -> float:
        """Standard errors by which the chosen lens predicts worse than `passed`; 0 where it is as good."""
        if self.passed is None or self.passed.squares is None or self.chosen.squares is None:
            return 0.0
        worse = standard_errors(self.chosen.squares, self.passed.squares)
        return worse if worse > self.as_good else 0.0

    @property
    def is_far_better(self) -> bool:
        """Whether the chosen lens has no formula and leaves far smaller residuals than any lens with one."""
        far_less = 0.25  # of their squares: real lenses without a formula 0.4 or more, wrong valleys 0.14
        of_formulas = min((one.of.least for one in self.tried if not one.form.blank.roughness), default=0.0)
        return bool(self.chosen.form.blank.roughness) and self.chosen.of.least < far_less * of_formulas

    def others(self, posterior: Posterior, options: Options) -> OtherLenses:
        """Return estimates with other lenses, weighted by probability; none beside a chosen lens without a formula.

        Args:
            posterior: with the chosen lens. options: they may hold numbers that were free when lenses were compared.
        """
        least_share = 0.25  # of the observations: where fewer took part, other lenses count as if so many had
        found = OtherLenses(self.there, (), (), self.chosen.of.reach_px)
        if self.chosen.form.blank.roughness:
            return found
        likely, longer = self._likely(LEAST_PROBABILITY)
        asked = [
            one for one in likely if one is not self.chosen and (one in longer or likely[one] >= LEAST_PROBABILITY)
        ]
        each = list[tuple[Candidate, float, Sequence[OpenDirection]]]()
        if not asked:
            return found
        slopes = {kind: kind.slopes(found) for kind in {one.of for one in (self.chosen, *asked)}}
        own = self.chosen.spread(posterior.stated, slopes[self.chosen.of])
        for one in asked:
            spread, weight = one.spread(posterior.stated, slopes[one.of]), likely[one]
            as_long = max(weight, likely[self.chosen]) if one in longer else weight  # no data say that it is shorter
            is_open = () if spread is None or own is None else spread.beyond(own, as_long)
            weight = as_long if is_open else weight
            if weight >= LEAST_PROBABILITY and not one.fault:
                each.append((one, weight, is_open))
        if not each:
            return found
        seen = self.seen.holding(options)

        def solved(one: Candidate, *, as_promised: bool = False) -> tuple[Estimate, float]:
            if one.is_near and seen is self.seen:
                return one.estimate, 0.5 * one.least
            found = seen.solved_near(one, as_promised=as_promised)
            return found.estimate, found.cost

        own_end = attempt(partial(solved, self.chosen))  # reads: "other lenses could not be compared, ..."
        if isinstance(own_end, CalibrationError):
            return replace(found, failed=str(own_end))
        found, left = replace(found, near=own_end[0]), 1.0
        for one, weight, is_open in each:
            # quiet: a lens that fails or ends in another minimum has no estimate; the rest share its weight
            end = attempt(partial(solved, one, as_promised=True))
            if isinstance(end, CalibrationError):
                left -= weight
                continue
            widened = median(posterior.factors)
            ends = self._ends(seen, one, end, is_open, widened)
            weights = (weight / len(ends),) * len(ends)
            assert one.of.normals is not None  # it predicts
            every = one.of.normals.information(one.of.to_nothing(one.form), posterior.stated)
            known = (Information(every.keys, every.matrix / widened**2),) * len(ends)
            others, known = (*found.others, *ends), (*found.known, *known)
            found = replace(found, others=others, weights=(*found.weights, *weights), known=known)
        # More observations than took part leave smaller differences by chance, so the weights are reduced by their
        # share.
        share = max(self.share, least_share) / max(left, LEAST_PROBABILITY)
        return replace(found, weights=tuple(share * one for one in found.weights))

    def _likely(self, least: float) -> tuple[dict[Candidate, float], list[Candidate]]:
        """Return the possible lenses with their probabilities, and those that extend the chosen one. A lens with one
        power more than any that was tried gets the chosen one's probability, without reducing that of others.
        """
        told = self._possible(least)
        likely = dict(zip(told, _probabilities(told), strict=True))
        every = (*told, *one_power_more(self.seen, self.chosen))
        longer = [one for one in every if one.extends(self.chosen, self.as_good)]
        return dict.fromkeys(longer, likely[self.chosen]) | likely, longer

    def _possible(self, least: float) -> list[Candidate]:
        """Return the lenses except those that are at least this probable and that another lens refutes: a lens that
        must not be chosen is no alternative to the chosen one.
        """
        likely = _probabilities(self.tried)
        asked = [p >= least and one is not self.chosen for one, p in zip(self.tried, likely, strict=True)]
        return [one for i, one in enumerate(self.tried) if not (asked[i] and _is_refuted(self.tried, i))]

    @staticmethod
    def _ends(
        seen: InlierRows, one: Candidate, at: tuple[Estimate, float], is_open: Sequence[OpenDirection], widened: float
    ) -> Sequence[Estimate]:
        """Return estimates with another lens, to either side along each direction that it leaves open; its own estimate
        where it leaves none. The steps are such that all ends scatter as the lens does, but twice the cost rises by no
        more than it does at 95 %. In a bent valley, normal equations from elsewhere led to ends at which it had risen
        by 195.

        Args:
            at: the lens's minimum and its cost. widened: factor on standard deviations from the scatter of the data.
        """
        most, far, (near, least) = (NORMAL_95 * widened) ** 2, widened * len(is_open) ** 0.5, at

        def end(open_: OpenDirection, side: float, tries: int = 4) -> Estimate:
            there = moved(near, open_.keys, side * open_.step)
            found = seen.solved_near(one, as_promised=True, there=there, held=open_.along)
            rise = 2.0 * (found.cost - least)
            return found.estimate if rise <= most or not tries else end(open_, side * (most / rise) ** 0.5, tries - 1)

        def all_of() -> Sequence[Estimate]:
            if one.is_near:
                return [moved(near, open_.keys, side * open_.step) for open_ in is_open for side in (-far, far)]
            return [end(open_, side) for open_ in is_open for side in (-far, far)]

        # quiet: where a step ends in another minimum, only the estimate in the middle counts
        ends = attempt(all_of) if is_open else [near]
        return [near] if isinstance(ends, CalibrationError) else ends

    @property
    def outcome(self) -> LensDecision:
        """The options with the chosen lens, and the initial estimate for the solve."""
        return LensDecision(
            self.chosen.form.of(self.seen.options), _moved_to(self.there, self.start), _choice(self), self
        )

    def instead(
        self, taken_out: tuple[Mask, Mask], scales: tuple[float, float], *, is_alone: bool
    ) -> LensDecision | None:
        """Return the lens to take in place of the chosen one, where others explain observations that it rejects; None
        where none does. Where only a part of very many observations was compared, the rest is not examined. A lens
        without a formula, which predicts clearly better, is kept.

        Args:
            taken_out: (N,), (M,) the observations that it rejects. scales: noise scales of that solve.
            is_alone: whether no other camera influenced what is rejected.
        """
        if self.share < 1.0 or self.chosen.form.blank.roughness:
            return None
        if not explained_by_another(self.seen, self.tried, self.chosen, taken_out, scales, is_alone=is_alone):
            return None
        found = self._excluding(lambda one: one is self.chosen, _EXPLAINED)
        return None if found is None else found.outcome

    def without_kind(self, failure: str) -> LensDecision | None:
        """The best lens of the other kinds, with how much worse it predicts; None where none can be used."""
        found = self._excluding(lambda one: one.of is self.chosen.of, failure)
        return None if found is None else replace(found, passed=self.passed or self.chosen).outcome

    @or_none  # quiet: the lens stays, or its own failure is reported
    def _excluding(self, is_out: Callable[[Candidate], bool], why: str) -> Comparison | None:
        """The comparison without some lenses, which are marked as failed for a reason; None without any other."""
        known = {one.form.label for one in self.tried}
        every = [*self.tried, *(one for one in _shorter(self.tried, None) if one.form.label not in known)]
        others = [replace(one, squares=None, failed=one.failed or why) if is_out(one) else one for one in every]
        return _compared(self.seen, self.share, self.as_good, self.start, others)


def _moved_to(there: Estimate, start: Start) -> Start:
    """Return the start with the numbers that were solved for."""
    placements = Poses.of(start.estimate.placements)
    placements = placements.updated(list(there.placements), Poses.of(there.placements).stack)
    others = tuple(replace(other, cameras=there.cameras) for other in start.others)  # they had a plainer lens so far
    return replace(start, estimate=replace(there, placements=placements), is_near=True, others=others)


def choose_lens(
    observations: Observations, options: Options, start: Start, built: Construction = AS_DRAWN, *, by_most: bool = False
) -> LensDecision:
    """Choose the lens that the observations of a camera ask for; the paper's where there are too few to compare.

    Args:
        options: their lens is ignored. start: initial estimate of the camera, with any lens.
        built: targets as built; AS_DRAWN lets the comparison estimate them, too.
        by_most: whether most of the observations take part, because a lens chosen by few left correlated residuals.
    """
    as_good = AS_GOOD_BESIDE_LENGTHS if options.dimensions else AS_GOOD
    by_themselves = replace(options, priors=(*options.priors, *_about_guesses(observations, options, start)))

    def compared() -> LensDecision:
        seen, kinds, share = compared_kinds(observations, by_themselves, start.estimate, built, by_most=by_most)
        return _among(seen, share, as_good, start, kinds, by_most=by_most).outcome

    chosen = attempt(compared)  # reads: "..." beside the paper's lens, why no other was compared
    if isinstance(chosen, CalibrationError):
        of_few = _of_few(observations, by_themselves, start, (TriedLens(PAPER, 2, failed=str(chosen)),))
        assert of_few is not None  # nothing was tried yet
        return of_few
    return chosen


def _of_few(
    observations: Observations, options: Options, start: Start, tried: tuple[TriedLens, ...], failure: str = ""
) -> LensDecision | None:
    """Return the paper's lens, or a lens of another kind that is far likelier, where lenses cannot be compared; None
    where none is left.

    Args:
        tried: its first entry says why lenses cannot be compared. failure: why that lens makes no calibration, else "".
    """
    from ceres_cal.calibration.lens_of_few import likeliest_of_few

    first, *others = tried
    out = [replace(first, failed=failure), *others] if failure else []
    likeliest = likeliest_of_few(observations, options, start.estimate, [one.label for one in out])
    if likeliest is None and out:
        return None
    label = PAPER if likeliest is None else likeliest[0].label
    choice = LensChoice(label, (replace(first, label=label), *out), 0, 0.0)
    if likeliest is None:
        return LensDecision(papers(options), start, choice, untold=observations)
    form, there = likeliest
    return LensDecision(form.of(options), _moved_to(there, start), choice, untold=observations)


def _about_guesses(observations: Observations, options: Options, start: Start) -> Iterator[Prior]:
    """Priors that phi is near the start's guess, where the observations leave phi open and nobody stated it: along that
    valley normal equations would lead from one lens to another through impossible cameras.
    """
    stated = {prior.name for prior in (*observations.priors, *options.priors) if prior.quantity == "phi"}
    for name, phi_from in start.phi_from.items():
        if phi_from == "guess" and name not in stated and "phi" not in options.held:
            phi = start.estimate.cameras[name].phi
            yield Prior("camera", name, "phi", (phi,), (VAGUE * phi,))


def _shorter(tried: Sequence[Candidate], best: Candidate | None) -> list[Candidate]:
    """Return the shorter lenses of each kind that were not tried, where these may be as good as the best."""
    return [one for longest in tried if longest.may_win(best) for one in longest.of.candidates(first=False)]


def _among(
    seen: InlierRows, share: float, as_good: float, start: Start, kinds: Sequence[Kind], *, by_most: bool
) -> Comparison:
    """Compare the paper's lens, where it can be used, and the longest of each kind first. Shorter lenses are compared
    only where the paper's lens is not as good as the best of these.
    """
    tried = [one for kind in kinds for one in kind.candidates(first=True)]
    found: Comparison | CalibrationError | None = None
    if any(one.form.label == PAPER and one.squares is not None for one in tried):
        # quiet: all of these fold; shorter lenses, which follow, need not
        found = attempt(lambda: _compared(seen, share, as_good, start, tried), DegenerateError)
    if not isinstance(found, Comparison):
        found = _compared(seen, share, as_good, start, [*tried, *_shorter(tried, None)])
    elif found.chosen.form.label != PAPER:
        found = _compared(seen, share, as_good, start, [*found.tried, *_shorter(found.tried, found.best)])
    is_asked = may_lack_a_formula(seen, found.chosen, by_most=by_most)
    more = tuple(last_resort(seen, found.chosen, is_asked=is_asked))
    found = replace(found, tried=(*found.tried, *more))
    # Most observations take part where a lens left the same residuals in all views. Otherwise a lens without a formula,
    # which few programs know, must predict clearly better.
    least = AS_GOOD if by_most else CLEARLY
    clearly = next((one for one in more if is_asked and one.beats(found.chosen, least)), None)
    return found if clearly is None else replace(found, chosen=clearly, there=clearly.estimate)


def _compared(seen: InlierRows, share: float, as_good: float, start: Start, tried: Sequence[Candidate]) -> Comparison:
    """Compare some lenses. A lens fails that folds inside the image or leaves more than normal equations predicted.

    Raises:
        DegenerateError: every lens fails.
    """
    labels, sizes = [one.form.label for one in tried], [one.form.size for one in tried]
    while True:
        is_refuted = partial(_is_refuted, tried)
        best, chosen = decide(labels, sizes, [one.squares for one in tried], as_good, is_refuted)
        faults = {number: fault for number in (best, chosen) if (fault := tried[number].fault)}
        there = None if faults else seen.reached(tried[chosen])
        if there is not None:
            return Comparison(seen, share, as_good, start, tuple(tried), tried[best], tried[chosen], there)
        faults = faults or {chosen: _BROKEN}
        tried = [replace(one, squares=None, failed=faults[n]) if n in faults else one for n, one in enumerate(tried)]


def _is_refuted(tried: Sequence[Candidate], number: int) -> bool:
    return any(other.refutes(tried[number]) for other in tried)


def _probabilities(among: Sequence[Candidate]) -> list[float]:
    """Return the probability of each lens that it predicts best; 0 for lenses that failed."""
    known = {i: one.densities for i, one in enumerate(among) if one.squares is not None}
    likely = dict(zip(known, pseudo_bma(list(known.values())).tolist(), strict=True))
    return [likely.get(i, 0.0) for i in range(len(among))]


def _choice(among: Comparison) -> LensChoice:
    chosen, likely = among.chosen, _probabilities(among.tried)

    def as_told(one: Candidate) -> TriedLens:
        label, count = one.form.label, len(one.form.names)
        if one.squares is None or chosen.squares is None:
            return TriedLens(label, count, failed=one.failed)
        worse = among.worse_than_passed if one is chosen else standard_errors(one.squares, chosen.squares)
        return TriedLens(label, count, one.rms_px, worse, probability=likely[among.tried.index(one)])

    order = sorted(among.tried, key=lambda one: (one is not chosen, one.rms_px if one.squares is not None else np.inf))
    groups = 0 if chosen.squares is None else len(chosen.squares)
    return LensChoice(chosen.form.label, tuple(map(as_told, order)), groups, among.share)
