"""Which lens the data ask for: the simplest of those that predict placements, or lines, as well as any other does.

Some of the observations are solved once, robustly, and from there with the longest lens of each kind. Shorter ones are
these with coefficients held at 0: what a solve without a group of equations would leave of it follows for every lens
from the normal equations of each group (`effects/groups.py`). Errors that go together within a group make a longer
lens predict the others no better: a criterion that counts observations would take them for a lens.
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
from ceres_cal.problem import Estimate, Options, moved
from ceres_cal.problem.priors import VAGUE
from ceres_cal.robust.as_built import AS_DRAWN, Construction
from ceres_cal.start.initialise import Start

_BROKEN = "solved for, it leaves more than the equations of a longer lens had it"
_EXPLAINED = "takes out observations that another lens explains"


class LensDecision(Frozen):
    """The lens that was chosen for a camera: options with it, where to start from, and what it was compared with.

    Attributes:
        among: the lenses it was chosen from; None where nothing could be compared. untold: by these observations.
    """

    options: Options
    start: Start
    choice: LensChoice
    among: Comparison | None = None
    untold: Observations | None = None

    def otherwise(self, failure: str, options: Options, start: Start) -> LensDecision | None:
        """Where all of the observations make no calibration with it, the best lens of another kind, or at last the
        paper's; None after that. Of too few to compare lenses by, the likeliest that was not tried.

        Args:
            options: with the paper's lens. start: with that, too.
        """
        if self.untold is not None:
            return _of_few(self.untold, self.options, self.start, self.choice.tried, failure)
        if self.among is None:
            return None
        return self.among.without_kind(failure) or self._papers(failure, options, start)

    def _papers(self, failure: str, options: Options, start: Start) -> LensDecision:
        """The paper's lens in its place, from the first start."""
        failed = [replace(one, failed=failure) if one.label == self.choice.chosen else one for one in self.choice.tried]
        tried = sorted(failed, key=lambda one: one.label != PAPER)
        return LensDecision(options, start, replace(self.choice, chosen=PAPER, tried=tuple(tried)))

    @property
    def built(self) -> Construction:
        """How targets seemed to be built when lenses were compared."""
        return AS_DRAWN if self.among is None else self.among.seen.built

    def others(self, posterior: Posterior, end: Estimate, options: Options) -> OtherLenses:
        """What other lenses would say, as far as they are probable, see `Comparison.others`."""
        if self.among is not None:
            return self.among.others(posterior, options)
        if self.untold is not None:
            from ceres_cal.calibration.lens_of_few import others_of_few

            return others_of_few(self.untold, self.choice.chosen, options, end)
        return OtherLenses(self.start.estimate, (), (), {})


class Comparison(Frozen):
    """The lenses that were compared, and the one that was chosen.

    Attributes:
        seen: the observations that took part, and `share` of all. as_good: how many standard errors worse is as good.
        start: of everything. there: where the chosen one is at its best.
        passed: the one that was chosen first, where all of the observations make no calibration with it.
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
        """By how many standard errors it predicts worse than the one that was passed over; 0 where that is as good."""
        if self.passed is None or self.passed.squares is None or self.chosen.squares is None:
            return 0.0
        worse = standard_errors(self.chosen.squares, self.passed.squares)
        return worse if worse > self.as_good else 0.0

    @property
    def is_far_better(self) -> bool:
        """Whether the chosen lens has no formula, and leaves far less than any that has one."""
        far_less = 0.25  # of their squares: of real lenses without a formula 0.4 and more, beside a wrong valley 0.14
        of_formulas = min((one.of.least for one in self.tried if not one.form.blank.roughness), default=0.0)
        return bool(self.chosen.form.blank.roughness) and self.chosen.of.least < far_less * of_formulas

    def others(self, posterior: Posterior, options: Options) -> OtherLenses:
        """What other lenses would say, as far as they are probable; nothing beside one without a formula.

        Args:
            posterior: by the chosen one. options: they hold what was free when lenses were compared.
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
            # quiet: what cannot be solved for, or ends in another minimum, says nothing, and the rest share its weight
            end = attempt(partial(solved, one, as_promised=True))
            if isinstance(end, CalibrationError):
                left -= weight
                continue
            ends = self._ends(seen, one, end, is_open, median(posterior.factors))
            weights = (weight / len(ends),) * len(ends)
            found = replace(found, others=(*found.others, *ends), weights=(*found.weights, *weights))
        # What they say by chance is less by as much as there are more observations than took part.
        share = max(self.share, least_share) / max(left, LEAST_PROBABILITY)
        return replace(found, weights=tuple(share * one for one in found.weights))

    def _likely(self, least: float) -> tuple[dict[Candidate, float], list[Candidate]]:
        """The lenses that are possible with their probabilities, and which of them are the chosen one and more. One
        power more than any that was tried has the chosen one's probability, and takes no share from others.
        """
        told = self._possible(least)
        likely = dict(zip(told, _probabilities(told), strict=True))
        every = (*told, *one_power_more(self.seen, self.chosen))
        longer = [one for one in every if one.extends(self.chosen, self.as_good)]
        return dict.fromkeys(longer, likely[self.chosen]) | likely, longer

    def _possible(self, least: float) -> list[Candidate]:
        """The lenses without those that another of them refutes, where they are as probable as that:
        what no choice may take is no alternative to what was chosen.
        """
        likely = _probabilities(self.tried)
        asked = [p >= least and one is not self.chosen for one, p in zip(self.tried, likely, strict=True)]
        return [one for i, one in enumerate(self.tried) if not (asked[i] and _is_refuted(self.tried, i))]

    @staticmethod
    def _ends(
        seen: InlierRows, one: Candidate, at: tuple[Estimate, float], is_open: Sequence[OpenDirection], widened: float
    ) -> Sequence[Estimate]:
        """Another lens so far to either side of what it leaves open that all of these scatter as it does, but no
        farther than where twice its cost has risen as it does at 95 %; where it leaves nothing open itself.

        In a bent valley normal equations of elsewhere led to ends at which that had risen by 195.

        Args:
            at: where it is at its best, and its cost. widened: factor on standard deviations, as the data scatter.
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

        # quiet: where it ends in another minimum, its middle counts alone
        ends = attempt(all_of) if is_open else [near]
        return [near] if isinstance(ends, CalibrationError) else ends

    @property
    def outcome(self) -> LensDecision:
        """The options with the lens that was chosen, and where to start from."""
        return LensDecision(
            self.chosen.form.of(self.seen.options), _moved_to(self.there, self.start), _choice(self), self
        )

    def instead(
        self, taken_out: tuple[Mask, Mask], scales: tuple[float, float], *, is_alone: bool
    ) -> LensDecision | None:
        """The lens in place of the chosen one, where others explain what it takes out of the observations; None where
        none does. Of very many observations some were compared, and the rest is not looked at. What predicts clearly
        better, a lens without a formula, stays.

        Args:
            taken_out: (N,), (M,) the observations that it takes out. scales: of the noise beside it.
            is_alone: whether no other camera had a say in what is taken out.
        """
        if self.share < 1.0 or self.chosen.form.blank.roughness:
            return None
        if not explained_by_another(self.seen, self.tried, self.chosen, taken_out, scales, is_alone=is_alone):
            return None
        found = self._excluding(lambda one: one is self.chosen, _EXPLAINED)
        return None if found is None else found.outcome

    def without_kind(self, failure: str) -> LensDecision | None:
        """The best of the other kinds, how much worse it predicts said with it; None where none gives an answer."""
        found = self._excluding(lambda one: one.of is self.chosen.of, failure)
        return None if found is None else replace(found, passed=self.passed or self.chosen).outcome

    @or_none  # quiet: the lens stays, or its own failure is told
    def _excluding(self, is_out: Callable[[Candidate], bool], why: str) -> Comparison | None:
        """Without some lenses, of which it is said why; None where no other one gives an answer."""
        known = {one.form.label for one in self.tried}
        every = [*self.tried, *(one for one in _shorter(self.tried, None) if one.form.label not in known)]
        others = [replace(one, squares=None, failed=one.failed or why) if is_out(one) else one for one in every]
        return _compared(self.seen, self.share, self.as_good, self.start, others)


def _moved_to(there: Estimate, start: Start) -> Start:
    """The start with what was solved for of it."""
    placements = Poses.of(start.estimate.placements)
    placements = placements.updated(list(there.placements), Poses.of(there.placements).stack)
    others = tuple(replace(other, cameras=there.cameras) for other in start.others)  # with a plainer lens so far
    return replace(start, estimate=replace(there, placements=placements), is_near=True, others=others)


def choose_lens(
    observations: Observations, options: Options, start: Start, built: Construction = AS_DRAWN, *, by_most: bool = False
) -> LensDecision:
    """The lens that the observations of a camera ask for; the paper's where there is too little to tell by.

    Args:
        options: their lens is not looked at. start: of that camera, with whatever lens.
        built: how targets were found to be built; where nothing is given that is found, too.
        by_most: whether most of the observations are asked, not some of them, which left what goes together.
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
    """The paper's lens, or one of another kind that is far likelier, where lenses cannot be compared; None where none
    is left.

    Args:
        tried: of which the first says why they cannot. failure: why the first makes no calibration, if it does not.
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
    """That phi is about what the start guessed, where the observations left it open and nobody stated it: along that
    valley normal equations would lead from one lens to another through cameras that are none.
    """
    stated = {prior.name for prior in (*observations.priors, *options.priors) if prior.quantity == "phi"}
    for name, phi_from in start.phi_from.items():
        if phi_from == "guess" and name not in stated and "phi" not in options.held:
            phi = start.estimate.cameras[name].phi
            yield Prior("camera", name, "phi", (phi,), (VAGUE * phi,))


def _shorter(tried: Sequence[Candidate], best: Candidate | None) -> list[Candidate]:
    """The lenses of each kind that were not tried, where they may be as good as the best."""
    return [one for longest in tried if longest.may_win(best) for one in longest.of.candidates(first=False)]


def _among(
    seen: InlierRows, share: float, as_good: float, start: Start, kinds: Sequence[Kind], *, by_most: bool
) -> Comparison:
    """The paper's lens, where it gives an answer, and the longest of each kind come first: only where it is not as good
    as the best of them are the shorter ones looked at.
    """
    tried = [one for kind in kinds for one in kind.candidates(first=True)]
    found: Comparison | CalibrationError | None = None
    if any(one.form.label == PAPER and one.squares is not None for one in tried):
        # quiet: all of these fold; the shorter ones that follow need not
        found = attempt(lambda: _compared(seen, share, as_good, start, tried), DegenerateError)
    if not isinstance(found, Comparison):
        found = _compared(seen, share, as_good, start, [*tried, *_shorter(tried, None)])
    elif found.chosen.form.label != PAPER:
        found = _compared(seen, share, as_good, start, [*found.tried, *_shorter(found.tried, found.best)])
    is_asked = may_lack_a_formula(seen, found.chosen, by_most=by_most)
    more = tuple(last_resort(seen, found.chosen, is_asked=is_asked))
    found = replace(found, tried=(*found.tried, *more))
    # Most are asked where a lens left the same in all views. Else one that few programs know must be worth it.
    least = AS_GOOD if by_most else CLEARLY
    clearly = next((one for one in more if is_asked and one.beats(found.chosen, least)), None)
    return found if clearly is None else replace(found, chosen=clearly, there=clearly.estimate)


def _compared(seen: InlierRows, share: float, as_good: float, start: Start, tried: Sequence[Candidate]) -> Comparison:
    """Some lenses: one that folds where it must not gives no answer, nor does one that leaves more than was promised.

    Raises:
        DegenerateError: none gives one.
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
    """That each of some lenses is the one of them that predicts best; 0 where it gives no answer."""
    known = {i: one.squares for i, one in enumerate(among) if one.squares is not None}
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
