"""The scan over candidates: a first look at each with a few replicates, a second look at the best on all captures."""

from __future__ import annotations

import contextlib
import functools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from .. import plugins
from ..effects import Effect
from ..errors import UNABLE, SpadError, why
from ..sensor import Sensor
from .candidates import Candidate, has_random_pixels, templates, with_values
from .capture_replicates import CannotSimulate
from .checks import block_checks, failing
from .coordinates import Key, is_edge
from .earlier_trials import completed, still_valid
from .evaluation import Evaluation, square
from .levels import COST_OF_A_PARAMETER, LEAST_P, PROMISING
from .map_trials import LEAST_P_OF_MAP, LEAST_P_WITH_ODD_PIXELS, map_trials_of
from .models import Model
from .phases import NEAR, TIMES, PeriodicSignatures
from .replicates import FEW, Replicates
from .score_test import best_direction, sigmas_of
from .signature import (
    Sampling,
    Signature,
    fall_of,
    odd_and_even,
    residuals_at,
    signature_of_totals,
    signatures,
    size_of,
)
from .spectral_lines import Line, spectral_lines
from .trial import (
    BOLDER,
    Trial,
    among,
    faint_of_other_shape,
    frequencies_of,
    further,
    is_pattern,
    is_same,
    of_other_shapes,
    shape_of,
    stronger,
    weaker,
)
from .trial_fits import STRONG

_LOOKING, _AGAIN = "the first look", "the second look"  # the stages at which a candidate may fail
# A value without another reason is a rule of thumb: no measurement that is kept chose it.
_SCAN = 2  # replicates of each capture for the first look: its noise against the time of all candidates
_SECOND = 6  # candidates in the second look, at most
# of the largest fall: with less of it a candidate has no second look. By a first look at some captures it may be too
# small by a factor of a few; a later step finds it again
_HOPELESS = 0.05
_NEARLY = 0.8  # of the largest fall of a candidate: of templates with as much, the one nearest to its best strength
# of a logarithm: an edge whose best strength is farther off is simulated where it was seen, too; one of Z 114 was lost
_FAR_OFF = 0.4
_LEAST_SIZE = 6.0  # standard deviations: a fainter signature is none, and is tried stronger
_SATURATED = 300.0  # standard deviations: a signature beyond it says little of a smaller one; an edge is tried weaker
_STEPS = 3  # how often a weaker or a stronger edge is tried, at most
_INSTANT = 0.03  # of a frame: shorter times are the same without stamps, and one template of them is tried
_PERIODIC_STRENGTHS = (1.0, 4.0)  # factors on the strength of a periodic candidate: its power grows as the square


class Scan:
    """The scan for what the model lacks, step by step.

    Attributes:
        accepted: the candidates of the steps so far.
        phases: of the periodic ones, by (capture, parameter), rad.
    """

    def __init__(self, replicates: Replicates, say: Callable[[str], None]):
        self.replicates, self.say = replicates, say
        self.accepted: list[Candidate] = []
        self.phases: dict[tuple[str, Key], float] = {}
        self._lines: tuple[Evaluation, list[Line]] | None = None
        self._periodic = PeriodicSignatures()

        self.untried: list[dict[str, Any]] = []  # candidates that cannot be simulated: which, where, why
        self._reported: set[str] = set()  # effects that were said to be among them
        # (name, effects of the steps but maps) of those that are excluded: a later step may add what one of them needs
        self._out: set[tuple[str, frozenset[str]]] = set()
        for name in Effect.registry:
            plugged = plugins.is_from_file(Effect.registry.find(name)) and replicates.start.effect(name) is None
            if plugged and all(candidate.effect != name for candidate in replicates.candidates(replicates.start)):
                nowhere = "none of its parameters says where to look for it; give one off= and search="
                self.not_tried("add", name, None, "choosing candidates", nowhere)

    def not_tried(self, kind: str, effect: str, parameter: str | None, where: str, why: str) -> None:
        """Record that a candidate cannot be simulated, where, and why; it is reported once for each effect."""
        entry = {"change": kind, "effect": effect, "parameter": parameter, "where": where, "why": why}
        if effect not in self._reported:
            self._reported.add(effect)
            self.say(f"not tried: {effect} ({why})")
        which = ("change", "effect", "parameter", "where")
        if all(any(entry[k] != other[k] for k in which) for other in self.untried):
            self.untried.append(entry)

    def exclude(self, candidate: Candidate, where: str, why: str) -> None:
        """Exclude a candidate from this model: it cannot be simulated with it, or at its best values."""
        self._out.add((candidate.name, self._added))
        self.not_tried(candidate.kind, candidate.effect, candidate.parameter, where, why)

    def is_excluded(self, candidate: Candidate) -> bool:
        """Whether a candidate is excluded from this model; a model with other effects may have what it needs."""
        return (candidate.name, self._added) in self._out

    @property
    def _added(self) -> frozenset[str]:
        return frozenset(candidate.effect for candidate in self.accepted if not candidate.carrier)

    def candidates(self, sensor: Sensor) -> list[Candidate]:
        """The candidates of a sensor without those that are excluded."""
        return [candidate for candidate in self.replicates.candidates(sensor) if not self.is_excluded(candidate)]

    @contextlib.contextmanager
    def if_possible(self, candidate: Candidate, where: str, wholly: bool = True) -> Iterator[None]:
        """A context in which a candidate that cannot be simulated is recorded.

        Args:
            wholly: the candidate is excluded, whatever its values.
        """
        try:
            yield
        except UNABLE as error:
            if wholly:
                self.exclude(candidate, where, why(error))
            else:
                self.not_tried(candidate.kind, candidate.effect, candidate.parameter, where, why(error))
            return
        if wholly and not self.is_excluded(candidate):  # what an earlier model could not do, this one can
            done = candidate.kind, candidate.effect, candidate.parameter, where
            self.untried = [e for e in self.untried if (e["change"], e["effect"], e["parameter"], e["where"]) != done]

    # --- looking -------------------------------------------------------------------------------------------------

    def line_search(self, evaluation: Evaluation, signature: Signature, signed: bool) -> tuple[float, float]:
        """(fall of the squares in chi square, factor on the strength at which it is largest).

        Args:
            signed: the strength may have either sign.
        """
        best = 0.0, 1.0
        tries = [*TIMES, *([-t for t in TIMES] if signed else [])]
        for _ in range(2):
            for times in tries:
                fall = fall_of(self.replicates, evaluation, signature, times)
                if fall > best[0]:
                    best = fall, times
            if best[0] < PROMISING:
                break
            tries = [best[1] * x for x in NEAR if x != 1]
        return best

    def lines(self, evaluation: Evaluation) -> list[Line]:
        """The spectral lines of the data under a model, by p-value."""
        if self._lines is None or self._lines[0] is not evaluation:
            self._lines = evaluation, spectral_lines(self.replicates, evaluation)
        return self._lines[1]

    def begun(self, evaluation: Evaluation, candidate: Candidate) -> list[dict[Key, Any]]:
        """The values at which a candidate is tried first, SI; a periodic one at the frequencies of the lines."""
        tries = self._distinguishable(candidate, templates(candidate))
        narrow = frequencies_of(candidate)
        if len(narrow) != 1:
            return tries
        coordinate = narrow[0]
        inside = [
            line.frequency for line in self.lines(evaluation) if coordinate.low <= line.frequency <= coordinate.high
        ]
        default = float(Effect.registry.find(candidate.effect).parameters[coordinate.parameter].default)
        strengths = [
            {**tries[0], **{d.key: d.scaled(tries[0][d.key], x) for d in candidate.strengths}}
            for x in _PERIODIC_STRENGTHS
        ]
        return [{**tried, coordinate.key: f} for f in inside or [default] for tried in strengths]

    def _distinguishable(self, candidate: Candidate, tries: Sequence[Mapping[Key, Any]]) -> list[dict[Key, Any]]:
        """The templates, one of each set that differs only in times far below a frame: the same without stamps."""
        captures = [seen.capture for seen in self.replicates.seen.values()]
        frames = [c.conditions.frame_time if c.modality == "qis" else 0.0 for c in captures]
        least = _INSTANT * min(frames, default=0.0)
        times = [d.key for d in candidate.shapes if d.kind in ("time", "edge")]
        kept = {tuple(max(t[k], least) if k in times else x for k, x in t.items()): dict(t) for t in tries}
        return list(kept.values())

    def looked_at(
        self,
        evaluation: Evaluation,
        candidate: Candidate,
        tries: Sequence[Mapping[Key, Any]],
        only: Sequence[str] = (),
        few: int = _SCAN,
    ) -> list[Trial]:
        """The trials of a candidate at some values, each with its best strength.

        Args:
            only: the captures that are simulated; all where it is empty.
            few: replicates of each.
        """
        return self._looked_at(evaluation, [(candidate, dict(tried)) for tried in tries], only, few)

    def _looked_at(
        self,
        evaluation: Evaluation,
        tries: Sequence[tuple[Candidate, dict[Key, Any]]],
        only: Sequence[str] = (),
        few: int = _SCAN,
    ) -> list[Trial]:
        out = []
        still: list[Trial] = []
        for candidate, tried in tries:
            if candidate.phases:
                continue
            with self.if_possible(candidate, _LOOKING, wholly=False):
                chips = candidate.kind == "add" and has_random_pixels(with_values(evaluation.sensors.one, tried))
                sensors = evaluation.sensors.changed(tried, chips=chips)
                still.append(
                    Trial(
                        candidate=candidate,
                        values=tried,
                        signature=Signature({}, {}, {}),
                        fall=0.0,
                        times=1.0,
                        sensors=sensors,
                        chips=chips,
                    )
                )
        for one in self.simulated(evaluation, still, few, only, remember=True):
            one.seen = set(only or evaluation.made)
            one.size = size_of(self.replicates, evaluation, one.signature)
            one.fall, one.times = self.line_search(evaluation, one.signature, one.signed)
            out.append(one)
        for candidate, tried in tries:
            if not candidate.phases:
                continue
            swing: Any = None
            line = self.line_at(evaluation, candidate, tried)
            with self.if_possible(candidate, _LOOKING, wholly=False):
                of_it = _SCAN if only else FEW  # a look at some captures chooses what is fitted, which simulates anew
                swing = self._periodic.signature(self.replicates, evaluation, candidate, tried, line, of_it)
            if swing is None:
                continue
            fall, times, found = swing.best_fit(self.replicates, evaluation)
            phases = {(id, key): p for id, p in found.items() for key in candidate.phases}
            fall -= 2 * len(phases)
            one = Trial(
                candidate=candidate,
                values=tried,
                signature=swing.at(found),
                fall=fall,
                times=times,
                phases=phases,
                seen=set(evaluation.made),
            )
            for coordinate in frequencies_of(candidate):
                f = float(tried[coordinate.key])
                error = line.error if line else coordinate.high
                one.intervals[coordinate.key] = (
                    max(f - 1.96 * error, coordinate.low),
                    min(f + 1.96 * error, coordinate.high),
                )
                one.p_value = line.p if line else None
            out.append(one)
        return out

    def line_at(self, evaluation: Evaluation, candidate: Candidate, tried: Mapping[Key, Any]) -> Line | None:
        """The line of the data at the frequency of a periodic candidate; None where it is at no line."""
        at = [float(tried[coordinate.key]) for coordinate in frequencies_of(candidate)]
        return next((line for line in self.lines(evaluation) if line.frequency in at), None)

    def simulated(
        self,
        evaluation: Evaluation,
        tried: Sequence[Trial],
        few: int = _SCAN,
        only: Sequence[str] = (),
        remember: bool = False,
    ) -> list[Trial]:
        """The trials with their signatures; those that cannot be simulated are left out and recorded.

        A strength that may have either sign is simulated with both, for the linear and the quadratic part.
        """
        down: dict[int, Model] = {}
        for i, one in enumerate(tried):
            with self.if_possible(one.candidate, _LOOKING, wholly=False):
                if opposite := _opposite(evaluation, one):
                    down[i] = opposite
        models = [one.sensors for one in tried if one.sensors is not None]
        sampling = Sampling(few=few, only=only, remember=remember, kept="sure")
        made = signatures(self.replicates, evaluation, [*models, *down.values()], sampling)
        downs = dict(zip(down, made[len(tried) :], strict=True))
        out = []
        for i, (one, up) in enumerate(zip(tried, made, strict=False)):
            other = downs.get(i)
            if isinstance(up, CannotSimulate) or isinstance(other, CannotSimulate):
                said = str(up if isinstance(up, CannotSimulate) else other)
                self.not_tried(one.candidate.kind, one.candidate.effect, one.candidate.parameter, _LOOKING, said)
                continue
            one.signature = up if other is None else odd_and_even(self.replicates, evaluation, up, other, few)
            out.append(one)
        return out

    def scan(self, evaluation: Evaluation, everywhere: bool = False, known: Sequence[Trial] = ()) -> list[Trial]:
        """The trials of every candidate at its templates, by the fall of the squares.

        Args:
            everywhere: in all captures, not only in the most informative ones.
            known: trials under an earlier model. Their signatures are used again where the data do not resemble them,
                or where the scatter of their cells has not changed; with `everywhere`, where both hold. Captures in
                which they were not simulated are added.
        """
        tries: list[tuple[Candidate, dict[Key, Any]]] = []
        for candidate in self.candidates(evaluation.sensors.one):
            if candidate.phases and not self.lines(evaluation):
                continue  # without a line nothing is periodic; and a phase for each capture would explain any totals
            if candidate.strengths or candidate.fixed:
                tries += [(candidate, tried) for tried in self.begun(evaluation, candidate)]
        if not everywhere and self.only_rates(evaluation):
            out = self.trials_by_totals(evaluation, tries)
        else:
            # each is looked at again: what an earlier model could not simulate, this one may
            self.untried = [entry for entry in self.untried if entry["where"] != _LOOKING]
            some = [] if everywhere else self.most_informative(evaluation)
            still = still_valid(self, evaluation, tries, [t for t in known if t.seen], everywhere)
            old = completed(self, evaluation, still, some or evaluation.made)
            tries = [t for t in tries if not any(is_same(one, *t) for one in old)]
            out = old + self._raised(evaluation, self._looked_at(evaluation, tries, some), some)
            out += self._lowered(evaluation, out, some)
            out += self.stronger_trials(evaluation, out, some)
        return sorted(out, key=lambda t: -t.fall)

    def trials_by_totals(
        self, evaluation: Evaluation, tries: Sequence[tuple[Candidate, dict[Key, Any]]]
    ) -> list[Trial]:
        """The trials by the closed forms of the totals, where nothing but totals fails; nothing is simulated."""
        out = []
        for candidate, tried in tries:
            with self.if_possible(candidate, _LOOKING, wholly=False):
                one = Trial(
                    candidate=candidate,
                    values=tried,
                    signature=signature_of_totals(self.replicates, evaluation, evaluation.sensors.changed(tried)),
                    fall=0.0,
                    times=1.0,
                )
                one.fall, one.times = self.line_search(evaluation, one.signature, one.signed)
                out.append(self._by_exact_totals(evaluation, one) if one.fall > PROMISING else one)
        return out

    def _by_exact_totals(self, evaluation: Evaluation, one: Trial) -> Trial:
        """The trial at the strength whose totals fit best.

        The totals are not proportional to a large strength. A gate of half the frame halves them, one of nothing
        leaves nothing.
        """
        best = replace(one, fall=0.0, times=1.0)
        for factors in ([*TIMES, *([-t for t in TIMES] if one.signed else [])], NEAR):
            start = best
            for factor in factors:
                values = replace(start, times=factor).scaled()
                with contextlib.suppress(SpadError):
                    signature = signature_of_totals(self.replicates, evaluation, evaluation.sensors.changed(values))
                    fall = fall_of(self.replicates, evaluation, signature)
                    if fall > best.fall:
                        best = replace(start, values=values, signature=signature, fall=fall)
        return best

    def _raised(self, evaluation: Evaluation, tried: list[Trial], some: Sequence[str]) -> list[Trial]:
        """The trials, with stronger ones for those without a signature.

        A listed value begins a tenth from where it is, not in the middle of its range: it may be raised twice.
        """

        def faint_of(trials: Sequence[Trial]) -> list[Trial]:
            size = functools.partial(size_of, self.replicates, evaluation)
            return [t for t in trials if not t.signature.nothing and size(t.signature) < _LEAST_SIZE]

        still, known = faint_of(tried), len(self.untried)
        found: list[Trial] = []
        replaced: list[Trial] = []
        while still:
            ups = [(t.candidate, up) for t in still if (up := stronger(t)) and not among(found, t.candidate, up)]
            new = self._looked_at(evaluation, ups, some) if ups else []
            raised = {(one.candidate.name, shape_of(one)) for one in new}
            # a faint one that the data resemble stays
            replaced += [t for t in still if t.fall < COST_OF_A_PARAMETER and (t.candidate.name, shape_of(t)) in raised]
            still = [] if found else [t for t in faint_of(new) if t.candidate.kind == "set"]
            found += new
        # a listed value was tried, if not as far off
        self.untried[known:] = [entry for entry in self.untried[known:] if entry["change"] == "add"]
        return [t for t in [*tried, *found] if not any(t is one for one in replaced)]

    def _lowered(self, evaluation: Evaluation, tried: Sequence[Trial], some: Sequence[str]) -> list[Trial]:
        """Weaker trials for those whose large signature says little of a smaller one."""
        weaker_trials = self._onward(
            evaluation, tried, some, weaker, lambda t: size_of(self.replicates, evaluation, t.signature) > _SATURATED
        )
        return [t for t in weaker_trials if size_of(self.replicates, evaluation, t.signature) > _LEAST_SIZE]

    def stronger_trials(self, evaluation: Evaluation, tried: Sequence[Trial], some: Sequence[str]) -> list[Trial]:
        """Stronger trials for edges whose squares fall further at a larger strength: a blur is not proportional."""
        return self._onward(evaluation, tried, some, further, lambda t: t.fall > PROMISING and t.times > 1)

    def _onward(
        self,
        evaluation: Evaluation,
        tried: Sequence[Trial],
        some: Sequence[str],
        step: Callable[[Trial], dict[Key, Any] | None],
        wanted: Callable[[Trial], bool],
    ) -> list[Trial]:
        """The trials one step on from those that are wanted, and from the new ones while they are."""
        out: list[Trial] = []
        here = [t for t in tried if wanted(t)]
        for _ in range(_STEPS):
            on = [(t.candidate, to) for t in here if (to := step(t)) and not among(tried, t.candidate, to)]
            found = self._looked_at(evaluation, on, some) if on else []
            out += found
            here = [t for t in found if wanted(t)]
        return out

    def only_rates(self, evaluation: Evaluation) -> bool:
        """Whether only totals fail; with a line in the spectra, it may be what moves those of short captures."""
        failed = failing(block_checks(self.replicates, evaluation, evaluation.residuals))
        return bool(failed) and all(b.cell[0] == "" for b in failed) and not self.lines(evaluation)

    def most_informative(self, evaluation: Evaluation) -> list[str]:
        """Up to three captures that are most informative: a dark one, and those with the smallest p-values."""
        worst = dict.fromkeys(evaluation.made, 0.0)
        for block in block_checks(self.replicates, evaluation, evaluation.residuals):
            if block.shown[0] in worst:  # a p-value above 1 % says little, but more than nothing
                surprise = -math.log10(max(block.p, LEAST_P))
                worst[block.shown[0]] += max(surprise - 2.0, 0.0) + 0.01 * surprise
        ids = sorted(worst, key=lambda id: -worst[id])
        dark = [id for id in ids if self.replicates.seen[id].capture.light.dark][:1]
        return list(dict.fromkeys([*ids[: 3 - len(dark)], *dark]))

    def again(
        self, evaluation: Evaluation, values: dict[Key, Any], tried: list[Trial], faint: bool = False
    ) -> list[Trial]:
        """The best trials at their best strength, on all captures, with the trials of maps.

        Args:
            values: the values of the model, SI.
            tried: the trials of the scan.
            faint: no check fails. Then the squares of all cells are more noise than effect, and their fall is taken
                as the square of the score.
        """
        best: list[Trial] = []
        further: list[Trial] = []
        if faint:
            tried = sorted((self._with_score(evaluation, t) for t in tried), key=lambda t: -t.fall)
        most = 0.0 if faint else max((t.fall for t in tried if not t.chips), default=0.0)
        for one in tried:
            known = any(other.candidate.name == one.candidate.name for other in best)
            least = 0.0 if is_pattern(one) else _HOPELESS * most  # a map would take up a pattern
            if one.fall > max(9.0, least) and not known:
                # of those with nearly the largest fall, the one simulated nearest to its best strength
                same = [t for t in tried if t.candidate.name == one.candidate.name]
                alike = [t for t in same if t.fall > _NEARLY * one.fall]
                best.append(min(alike, key=lambda t: abs(math.log(abs(t.times)))))
                further += faint_of_other_shape(best[-1], same)
            if len(best) == _SECOND:
                break
        best = [replace(one, others=of_other_shapes(one, tried)) if one.chips else one for one in best + further]
        out: list[Trial] = []
        sizes: dict[int, float] = {}  # of the signature as it was simulated first, by the trial's id
        kept = [one for one in best if one.phases]  # all captures have shown these, at any strength
        for one in best:
            if one.phases:
                continue
            # noise hides the shape of a faint signature: it is simulated stronger, unless it is an edge
            size = size_of(self.replicates, evaluation, one.signature)
            edge = any(map(is_edge, one.candidate.strengths))
            least = 0.0 if edge else min(STRONG / max(size, 1e-9), BOLDER if faint else 1.0)
            one.times = math.copysign(max(abs(one.times), least), one.times)
            # an edge does not move in proportion: where it was simulated may be nearer to the best than where
            # proportion leads
            as_it_was = [replace(one, times=1.0)] if edge and abs(math.log(abs(one.times))) > _FAR_OFF else []
            for start in [one, *as_it_was]:
                with self.if_possible(one.candidate, _AGAIN):
                    given = start.scaled()
                    sensors = evaluation.sensors.changed(given, one.phases, one.chips)
                    out.append(replace(start, values=given, sensors=sensors, sharp=False))
                    sizes[id(out[-1])] = size
        # random odd pixels are a map as well, even where the map by itself would not be significant
        least = LEAST_P_WITH_ODD_PIXELS if any(one.chips for one in best) else LEAST_P_OF_MAP
        for one in self.simulated(evaluation, [*out, *map_trials_of(self, evaluation, values, least)], FEW):
            if one.maps is None:
                before, x, size = sizes[id(one)], abs(one.times), size_of(self.replicates, evaluation, one.signature)
                if (
                    min(size, before) > 5
                    and not 0.7 < x < 1.4
                    and one.candidate.kind == "add"
                    and not one.signature.even
                ):
                    # linear or quadratic: noise hides any other power of a faint signature
                    one.power = 2.0 if math.log(size / before) / math.log(x) > 1.5 else 1.0
                one.fall, one.times = self.line_search(evaluation, one.signature, one.signed)
            else:
                one.fall = square(evaluation.residuals) - square(
                    residuals_at(self.replicates, evaluation, one.signature)
                )
                # the squares hardly show small differences of many pixels; those of edges they do
                if one.p_value is not None and not one.candidate.blinds:
                    one.fall = max(one.fall, sigmas_of(one.p_value) ** 2)
            kept.append(self._with_score(evaluation, one) if faint else one)
        found: dict[int | str, Trial] = {}
        for one in sorted(kept, key=lambda t: -t.fall):
            found.setdefault(id(one) if one.maps else one.candidate.name, one)
        return list(found.values())

    def _with_score(self, evaluation: Evaluation, one: Trial) -> Trial:
        """The trial with the square of its score as the fall."""
        if one.p_value is not None:
            return replace(one, fall=sigmas_of(one.p_value) ** 2)
        significance, found, times = best_direction(self.replicates, evaluation, one)
        suits = times * found.data / found.size if significance > 0 else one.times
        return replace(one, fall=significance**2, times=one.times if one.fall > 0 and one.times * suits > 0 else suits)


def _opposite(evaluation: Evaluation, one: Trial) -> Model | None:
    """The model with the opposite strength; None where there is none."""
    if one.maps is not None or one.candidate.kind != "add":
        return None
    turned = {
        d.key: d.scaled(float(one.values[d.key]), -1.0)
        for d in one.candidate.strengths
        if d.low < 0 and d.key in one.values
    }
    if all(one.values[key] == x for key, x in turned.items()):
        return None
    return evaluation.sensors.changed({**one.values, **turned}, one.phases, one.chips)
