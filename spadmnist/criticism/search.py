"""Search: which change of a model brings the data nearest?

A first look at every candidate with a few simulated recordings, a second at the best of them on all captures, maps
beside them; then the numbers of those few are settled (`fit`).
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy import stats

from .. import plugins
from ..effects import Effect
from ..errors import UNABLE, SpadError, why
from ..sensor import Sensor
from ..statistics import Statistic
from . import checks, fit, mapping
from .candidates import Change, Key, chancy, templates, with_values
from .chance import LEAST_P, PIXELS, nearest_face, of_map
from .fit import RATES, Bench, Moved, Sensors, State, likelier, square, stacked
from .lines import Line, lines
from .refining import STRONG, optimism, state_of
from .swings import NEAR, TIMES, turned
from .tried import EACH, Tried, further, is_edge, is_pattern, is_same, lines_of, of_scene, shape_of, stronger, weaker

_LOOKING, _AGAIN, _MAPPING = "the first look", "the second look", "making a map"  # where a candidate may fail
_SCAN = 2  # recordings of each capture for a first look
_SECOND = 6  # candidates that are looked at again
_NEARLY = 0.8  # of the largest gain
_BOLDER = 3.0  # times as strong as where a faint trace was seen, for what it looks like
_FAR_OFF = 0.4  # of the logarithm of a strength
_REFINED = 3  # of these, that are settled
_PROMISING = 25.0  # in chi square, of what is worth a state of its own
_LEAST_CHANCE, _CHANCE_BESIDE = 1e-3, 0.05  # of a map that is tried, and beside what chance makes of pixels
_SILENT = 6.0  # standard deviations of a trace that is none
_LOUD = 300.0  # the same of one that says little of a smaller one
_STEPS = 3  # times that a weaker or a stronger edge is looked for
_INSTANT = 0.03  # of a frame: times below it are alike without stamps
_SWINGS = (1.0, 4.0)  # times the usual strength at which what swings is tried: in a spectrum it grows as the square
_SIGMAS = (0.003, 0.006, 0.012, 0.024, 0.05, 0.1)  # of a logarithm, of pixels that differ unseen
_TOLD = 50.0  # inverse square of what is known of a pixel by its counts: more is seen in maps
_ALIKE, _BLURRED = 8.0, 0.3  # in chi square, between candidates of which neither is better; what few recordings blur
_MOSTLY = 0.5  # of the squares of a trace
_LIKE = 0.4  # of a cosine between traces: others do not look alike
_MOVED = 0.3  # standard deviations, by which a cell is moved
_STANDS_OUT, _NO_DOUBT = 1e-3, 1e-4  # p-values of a pattern in a map, and of one beside which the map's is no matter
_MAYBE = 100.0  # times as likely by chance as the map: a pattern still
_LEAST_SIGMA, _LEAST_SPREAD = 2e-3, 0.05  # of a map that is tried: its width, and that beside its noise


class Search:
    """The search for what is missing, step by step. accepted: what the model has by now; phases: of these."""

    def __init__(self, bench: Bench, say: Callable[[str], None]):
        self.bench, self.say = bench, say
        self.accepted: list[Change] = []
        self.phases: dict[tuple[str, Key], float] = {}
        self._lines: tuple[State, list[Line]] | None = None

        self.untried: list[dict[str, Any]] = []  # candidates that cannot be simulated: which, where, why
        self._out: set[str] = set()  # those of them that are none any more
        for name in Effect.registry:
            plugged = plugins.is_from_file(Effect.registry.find(name)) and bench.start.effect(name) is None
            if plugged and all(change.effect != name for change in bench.changes(bench.start)):
                nowhere = "none of its parameters says where to look for it; give one off= and search="
                self.not_tried("add", name, None, "choosing candidates", nowhere)

    def not_tried(self, kind: str, effect: str, parameter: str | None, where: str, why: str) -> None:
        """Keep of a candidate that it cannot be simulated, where, and why; said once of an effect."""
        entry = {"change": kind, "effect": effect, "parameter": parameter, "where": where, "why": why}
        if all(entry["effect"] != other["effect"] for other in self.untried):
            self.say(f"not tried: {effect} ({why})")
        which = ("change", "effect", "parameter", "where")
        if all(any(entry[k] != other[k] for k in which) for other in self.untried):
            self.untried.append(entry)

    def exclude(self, change: Change, where: str, why: str) -> None:
        """A candidate is none any more: beside this model, or at the values that suit it, it cannot be simulated."""
        self._out.add(change.name)
        self.not_tried(change.kind, change.effect, change.parameter, where, why)

    def _beside(self, sensor: Sensor) -> list[Change]:
        return [change for change in self.bench.changes(sensor) if change.name not in self._out]

    @contextlib.contextmanager
    def if_possible(self, change: Change, where: str, wholly: bool = True) -> Iterator[None]:
        """A candidate that cannot be simulated is none, and that is kept. wholly: whatever its values."""
        try:
            yield
        except UNABLE as error:
            if wholly:
                self.exclude(change, where, why(error))
            else:
                self.not_tried(change.kind, change.effect, change.parameter, where, why(error))

    # --- looking -------------------------------------------------------------------------------------------------

    def line_search(self, state: State, moved: Moved, signed: bool) -> tuple[float, float]:
        """(gain in chi square, times the strength at which it is largest)."""
        best = 0.0, 1.0
        tries = [*TIMES, *([-t for t in TIMES] if signed else [])]
        for _ in range(2):
            for times in tries:
                gain = self.bench.gain(state, moved, times)
                if gain > best[0]:
                    best = gain, times
            if best[0] < _PROMISING:
                break
            tries = [best[1] * x for x in NEAR if x != 1]
        return best

    def lines(self, state: State) -> list[Line]:
        """What stands out of the data's spectra, the clearest first."""
        if self._lines is None or self._lines[0] is not state:
            self._lines = state, lines(self.bench, state)
        return self._lines[1]

    def begun(self, state: State, change: Change) -> list[dict[Key, Any]]:
        """The values at which a candidate is tried first."""
        tries = self._told_apart(change, templates(change))
        narrow = lines_of(change)
        if len(narrow) != 1:
            return tries
        dial = narrow[0]
        inside = [line.frequency for line in self.lines(state) if dial.low <= line.frequency <= dial.high]
        usual = float(Effect.registry.find(change.effect).parameters[dial.parameter].default)
        strengths = [{**tries[0], **{d.key: d.scaled(tries[0][d.key], x) for d in change.strengths}} for x in _SWINGS]
        return [{**tried, dial.key: f} for f in inside or [usual] for tried in strengths]

    def _told_apart(self, change: Change, tries: Sequence[Mapping[Key, Any]]) -> list[dict[Key, Any]]:
        """Of templates that differ in times far below a frame, one: without stamps nothing tells them apart."""
        captures = [seen.capture for seen in self.bench.seen.values()]
        frames = [c.conditions.frame_time if c.modality == "qis" else 0.0 for c in captures]
        least = _INSTANT * min(frames, default=0.0)
        times = [d.key for d in change.shapes if d.unit == "s"]
        kept = {tuple(max(t[k], least) if k in times else x for k, x in t.items()): dict(t) for t in tries}
        return list(kept.values())

    def looked_at(
        self, state: State, change: Change, tries: Sequence[Mapping[Key, Any]], only: Sequence[str] = ()
    ) -> list[Tried]:
        """A candidate at each of these values, at the strength that suits it. only: of some captures."""
        return self._looked_at(state, [(change, dict(tried)) for tried in tries], only)

    def _looked_at(
        self, state: State, tries: Sequence[tuple[Change, dict[Key, Any]]], only: Sequence[str] = ()
    ) -> list[Tried]:
        out = []
        still: list[Tried] = []
        for change, tried in tries:
            if change.phases:
                continue
            with self.if_possible(change, _LOOKING, wholly=False):
                chips = change.kind == "add" and chancy(with_values(state.sensors.one, tried))
                sensors = state.sensors.changed(tried, chips=chips)
                still.append(Tried(change, tried, Moved({}, {}, {}), 0.0, 1.0, sensors, chips=chips))
        for one in self._simulated(state, still, _SCAN, only):
            one.seen = set(only or state.made)
            one.gain, one.times = self.line_search(state, one.moved, one.signed)
            out.append(one)
        for change, tried in tries:
            if not change.phases:
                continue
            swing: Any = None
            with self.if_possible(change, _LOOKING, wholly=False):
                swing = turned(self.bench, state, change.phases, tried, fit.FEW)
            if swing is None or isinstance(swing, str):
                if swing is not None:
                    self.not_tried(change.kind, change.effect, change.parameter, _LOOKING, swing)
                continue
            gain, times, found = swing.suited(self.bench, state)
            phases = {(id, key): p for id, p in found.items() for key in change.phases}
            gain -= 2 * len(phases)
            one = Tried(change, tried, swing.at(found), gain, times, phases=phases, seen=set(state.made))
            for dial in lines_of(change):
                f = float(tried[dial.key])
                line = next((line for line in self.lines(state) if line.frequency == f), None)
                error = line.error if line else dial.high
                one.intervals[dial.key] = max(f - 1.96 * error, dial.low), min(f + 1.96 * error, dial.high)
                one.chance = line.p if line else None
            out.append(one)
        return out

    def _simulated(self, state: State, tried: Sequence[Tried], few: int, only: Sequence[str] = ()) -> list[Tried]:
        """Candidates with what they do, but for those that cannot be simulated.

        What may be of either sign is simulated with both: some of it grows in proportion, some with the square.
        """
        down: dict[int, Sensors] = {}
        for i, one in enumerate(tried):
            with self.if_possible(one.change, _LOOKING, wholly=False):
                if opposite := _opposite(state, one):
                    down[i] = opposite
        models = [one.sensors for one in tried if one.sensors is not None]
        made = self.bench.moved(state, [*models, *down.values()], few, only, kept="sure")
        downs = dict(zip(down, made[len(tried) :], strict=True))
        out = []
        for i, (one, up) in enumerate(zip(tried, made, strict=False)):
            other = downs.get(i)
            if isinstance(up, str) or isinstance(other, str):
                said = up if isinstance(up, str) else str(other)
                self.not_tried(one.change.kind, one.change.effect, one.change.parameter, _LOOKING, said)
                continue
            one.moved = up if other is None else self.bench.both(state, up, other, few)
            out.append(one)
        return out

    def scan(self, state: State, everywhere: bool = False, known: Sequence[Tried] = ()) -> list[Tried]:
        """Every candidate at its templates, the best first. everywhere: in all captures, not the telling ones alone.

        known: what they did to an earlier model. That is taken for what they do to this one, but where the data
        resemble it; captures that it was not looked at in are added.
        """
        tries: list[tuple[Change, dict[Key, Any]]] = []
        for change in self._beside(state.sensors.one):
            if change.phases and not self.lines(state):
                continue  # nothing swings; and with a phase for each capture it would explain any totals
            if change.strengths or change.fixed:
                tries += [(change, tried) for tried in self.begun(state, change)]
        if not everywhere and self.only_rates(state):
            out = self._by_totals(state, tries)
        else:
            some = [] if everywhere else self.telling(state)
            old = self._completed(state, self._still(state, tries, [t for t in known if t.seen]), some or state.made)
            tries = [t for t in tries if not any(is_same(one, *t) for one in old)]
            out = old + self._raised(state, self._looked_at(state, tries, some), some)
            out += self._lowered(state, out, some)
            out += self._further(state, out, some)
        return sorted(out, key=lambda t: -t.gain)

    def _by_totals(self, state: State, tries: Sequence[tuple[Change, dict[Key, Any]]]) -> list[Tried]:
        """Candidates by what the closed forms say of the totals: nothing else is wrong, nothing need be simulated."""
        out = []
        for change, tried in tries:
            with self.if_possible(change, _LOOKING, wholly=False):
                one = Tried(change, tried, self.bench.told(state, state.sensors.changed(tried)), 0.0, 1.0)
                one.gain, one.times = self.line_search(state, one.moved, one.signed)
                out.append(self._by_exact_totals(state, one) if one.gain > _PROMISING else one)
        return out

    def _by_exact_totals(self, state: State, one: Tried) -> Tried:
        """A candidate at the strength whose totals are nearest: only small ones change them in proportion.

        A gate of half the frame halves them, one of nothing leaves nothing.
        """
        best = replace(one, gain=0.0, times=1.0)
        for factors in ([*TIMES, *([-t for t in TIMES] if one.signed else [])], NEAR):
            start = best
            for factor in factors:
                values = replace(start, times=factor).scaled()
                with contextlib.suppress(SpadError):
                    moved = self.bench.told(state, state.sensors.changed(values))
                    gain = self.bench.gain(state, moved)
                    if gain > best.gain:
                        best = replace(start, values=values, moved=moved, gain=gain)
        return best

    def _raised(self, state: State, tried: list[Tried], some: Sequence[str]) -> list[Tried]:
        """These, and stronger ones for those that leave no trace: these may do so."""
        faint = [t for t in tried if not t.moved.nothing and self.bench.size(state, t.moved) < _SILENT]
        silent = [(t.change, up) for t in faint if (up := stronger(t))]
        found = self._looked_at(state, silent, some) if silent else []
        raised = {(one.change.name, shape_of(one)) for one in found}
        # but what the data resemble as faint as it is stays
        again = [t for t in faint if t.gain < EACH and (t.change.name, shape_of(t)) in raised]
        return [t for t in tried if not any(t is one for one in again)] + found

    def _lowered(self, state: State, tried: Sequence[Tried], some: Sequence[str]) -> list[Tried]:
        """Weaker ones for those that drown all else: where it does not grow in proportion, they tell nothing of it."""
        loud = self._onward(state, tried, some, weaker, lambda t: self.bench.size(state, t.moved) > _LOUD)
        return [t for t in loud if self.bench.size(state, t.moved) > _SILENT]

    def _further(self, state: State, tried: Sequence[Tried], some: Sequence[str]) -> list[Tried]:
        """Stronger ones for edges of which the data want more: much of a blur is not so many times a little."""
        return self._onward(state, tried, some, further, lambda t: t.gain > _PROMISING and t.times > 1)

    def _onward(
        self,
        state: State,
        tried: Sequence[Tried],
        some: Sequence[str],
        step: Callable[[Tried], dict[Key, Any] | None],
        wanted: Callable[[Tried], bool],
    ) -> list[Tried]:
        """What lies a step on from those that are wanted, and from these again while they are."""
        out: list[Tried] = []
        here = [t for t in tried if wanted(t)]
        for _ in range(_STEPS):
            on = [(t.change, to) for t in here if (to := step(t)) and not _among(tried, t.change, to)]
            found = self._looked_at(state, on, some) if on else []
            out += found
            here = [t for t in found if wanted(t)]
        return out

    def _still(
        self, state: State, tries: Sequence[tuple[Change, dict[Key, Any]]], known: Sequence[Tried]
    ) -> list[Tried]:
        """Those of `known` that may be tried still and that the data do not resemble, at the strength that suits."""
        out, promising = [], set()
        for one in known:
            if one.change.phases or not any(is_same(one, *t) for t in tries):
                continue
            now = replace(one)
            now.gain, now.times = self.line_search(state, one.moved, one.signed)
            out.append(now)
            if now.gain >= _PROMISING / 4:
                promising.add((now.change.name, shape_of(now)))
        return [t for t in out if (t.change.name, shape_of(t)) not in promising]

    def _completed(self, state: State, known: Sequence[Tried], wanted: Collection[str]) -> list[Tried]:
        """Candidates with what they do in captures in which they have not been looked at, too."""
        out = [one for one in known if set(wanted) <= one.seen]
        groups: dict[frozenset[str], list[Tried]] = {}
        for one in known:
            if set(wanted) <= one.seen:
                continue
            with contextlib.suppress(SpadError):  # what does not fit this model any more is looked at anew
                sensors = state.sensors.changed(one.values, chips=one.chips)
                groups.setdefault(frozenset(set(wanted) - one.seen), []).append(replace(one, sensors=sensors))
        for missing, some in groups.items():
            earlier = {id(one): one.moved for one in some}
            for one in self._simulated(state, some, _SCAN, sorted(missing)):
                one.moved = earlier[id(one)].beside(one.moved, missing)
                one.seen = one.seen | missing
                one.gain, one.times = self.line_search(state, one.moved, one.signed)
                out.append(one)
        return out

    def only_rates(self, state: State) -> bool:
        """Is nothing wrong but the totals? A line in the spectra may be what moves those of short captures."""
        failed = checks.failing(checks.blocks(self.bench, state, state.residuals))
        return bool(failed) and all(b.cell[0] == "" for b in failed) and not self.lines(state)

    def telling(self, state: State) -> list[str]:
        """Up to three captures that show best what is wrong: a dark one, and those with the least likely checks."""
        worst = dict.fromkeys(state.made, 0.0)
        for block in checks.blocks(self.bench, state, state.residuals):
            if block.cell[0] in worst:  # what one check in a hundred is by chance says little, but more than nothing
                surprise = -math.log10(max(block.p, LEAST_P))
                worst[block.cell[0]] += max(surprise - 2.0, 0.0) + 0.01 * surprise
        ids = sorted(worst, key=lambda id: -worst[id])
        dark = [id for id in ids if self.bench.seen[id].capture.light.dark][:1]
        return list(dict.fromkeys([*ids[: 3 - len(dark)], *dark]))

    def again(self, state: State, values: dict[Key, Any], tried: list[Tried], faint: bool = False) -> list[Tried]:
        """The best candidates at the strength that suits them, on all captures; maps beside them.

        faint: is no check failing? Then the squares of all cells are more noise than effect, and what counts as a gain
        is the square of how much the data resemble the trace.
        """
        best: list[Tried] = []
        if faint:
            tried = sorted((self._marked(state, t) for t in tried), key=lambda t: -t.gain)
        for one in tried:
            if one.gain > 9 and all(b.change.name != one.change.name for b in best):
                # of what does nearly as well, what was simulated nearest to where it does so
                alike = [t for t in tried if t.change.name == one.change.name and t.gain > _NEARLY * one.gain]
                best.append(min(alike, key=lambda t: abs(math.log(abs(t.times)))))
            if len(best) == _SECOND:
                break
        out: list[Tried] = []
        kept = [one for one in best if one.phases]  # which all captures have shown, at any strength
        for one in best:
            if one.phases:
                continue
            # a faint trace drowns in what is left of chance: a stronger one tells what it looks like, but of an edge
            size = self.bench.size(state, one.moved)
            edge = any(map(is_edge, one.change.strengths))
            least = 0.0 if edge else min(STRONG / max(size, 1e-9), _BOLDER if faint else 1.0)
            one.times = math.copysign(max(abs(one.times), least), one.times)
            # how far an edge has to go nothing in proportion tells: where it was seen it is nearer than where it is not
            as_it_was = [replace(one, times=1.0)] if edge and abs(math.log(abs(one.times))) > _FAR_OFF else []
            for start in [one, *as_it_was]:
                with self.if_possible(one.change, _AGAIN):
                    given = start.scaled()
                    sensors = state.sensors.changed(given, one.phases, one.chips)
                    out.append(replace(start, values=given, gain=size, sensors=sensors))
        # pixels that chance has made odd are a map, too, even where the map alone would be no news
        least = _CHANCE_BESIDE if any(one.chips for one in best) else _LEAST_CHANCE
        for one in self._simulated(state, [*out, *self.maps(state, values, least)], fit.FEW):
            if one.maps is None:
                before, x, size = one.gain, abs(one.times), self.bench.size(state, one.moved)
                if min(size, before) > 5 and not 0.7 < x < 1.4 and one.change.kind == "add" and not one.moved.even:
                    # in proportion or with the square: more cannot be said, for chance hides what is faint
                    one.power = 2.0 if math.log(size / before) / math.log(x) > 1.5 else 1.0
                one.gain, one.times = self.line_search(state, one.moved, one.signed)
                if one.chips and one.gain > _PROMISING:
                    beside: float | None = None
                    with self.if_possible(one.change, _AGAIN):
                        beside = self.beside(state, one)
                    if beside is None:
                        continue
                    one.fell, one.gain = one.gain, beside
            else:
                one.gain = square(state.residuals) - square(self.bench.residuals(state, one.moved))
                # small differences of many pixels are lost among what chance leaves, but for edges, which stand out
                if one.chance is not None and not one.change.blinds:
                    one.gain = max(one.gain, _mark_of(one.chance) ** 2)
            kept.append(self._marked(state, one) if faint else one)
        found: dict[int | str, Tried] = {}
        for one in sorted(kept, key=lambda t: -t.gain):
            found.setdefault(id(one) if one.maps else one.change.name, one)
        return list(found.values())

    def _marked(self, state: State, one: Tried) -> Tried:
        """The same, its gain being the square of how much the data resemble its trace."""
        if one.chance is not None:
            return replace(one, gain=_mark_of(one.chance) ** 2)
        mark, found, times = nearest_face(self.bench, state, one)
        suits = times * found.data / found.size if mark > 0 else one.times
        return replace(one, gain=mark**2, times=one.times if one.gain > 0 and one.times * suits > 0 else suits)

    def maps(self, state: State, values: dict[Key, Any], least: float = _LEAST_CHANCE) -> list[Tried]:
        """Every map whose values differ beyond their noise, and all that are needed side by side.

        least: the largest p-value of one that is tried.
        """
        if self.only_rates(state):
            return []
        levels = mapping.levels_of(self.bench, state)
        held = [c for c in self.accepted if c.carrier]
        wanted = self.mappable(state)
        groups = [[c] for c in wanted]
        pixels = [c for c in wanted if c.per == "pixel" and mapping.by_counts(c)]
        if len(pixels) > 1 and all(c.per == "pixel" for c in held):
            with contextlib.suppress(*UNABLE):  # each is tried by itself, too
                together = mapping.needed(self.bench, values, held, pixels, levels)
                if len(together) > 1:
                    groups.insert(0, together)
        out = []
        for group in groups:
            made: tuple[Any, ...] = ()
            with self.if_possible(group[0], _MAPPING):
                made = mapping.sensors_with(self.bench, values, [*held, *group], levels)
            if not made:
                continue
            sensors, found, mapped = made
            map_ = found[group[0].carrier]  # type: ignore[index]
            spread = float(np.mean((map_.estimate / np.maximum(map_.error, 1e-9)) ** 2))
            if max(map_.sigma, float(np.std(map_.estimate))) < _LEAST_SIGMA or spread < _LEAST_SPREAD:
                continue
            sensors = sensors.changed({}, self.phases)
            chance = min(of_map(self.bench, state, c, values, levels) for c in group)
            if chance > least:
                continue
            nothing = Moved({}, {}, {})
            out.append(
                Tried(group[0], mapped, nothing, 0.0, 1.0, sensors, maps=found, more=tuple(group[1:]), chance=chance)
            )
        return out

    def mappable(self, state: State) -> list[Change]:
        """Every map that may be tried: not of a number that an earlier step settles, alike in all pixels."""
        settled = {dial.key for change in self.accepted for dial in change.dials}
        return [c for c in self._beside(state.sensors.one) if c.carrier and c.carrier not in settled]

    def structured(self, state: State, tried: list[Tried]) -> list[Tried]:
        """Patterns before maps, but only those that stand out of the map's own scatter.

        Chance may put a few odd pixels into a row, if seldom: none, where it makes the whole map much more seldom.
        """
        maps = [
            t
            for t in tried
            if t.maps and t.change.per == "pixel" and mapping.bench_light_only(state.sensors.one, t.change)
        ]
        patterns = [t for t in tried if is_pattern(t)]
        if not maps or not patterns:
            return tried
        assert maps[0].maps is not None
        free = maps[0].maps[maps[0].change.carrier]  # type: ignore[index]
        scenes = {t.change.name: self._of_scene(state, t, maps[0].change, free) for t in patterns if of_scene(t)}
        chance = 1.0 if maps[0].chance is None else maps[0].chance
        doubtful = min(_STANDS_OUT, max(_MAYBE * chance, _NO_DOUBT))
        layout = state.sensors.one.layout
        place = layout.centred.T
        radius = (place**2).sum(axis=0)
        designs = {}
        for one in patterns:
            if one.change.per == "row":
                designs[one.change.name] = _indicators(mapping.groups_of(state.sensors.one, "row"))
            elif one.change.per == "column":
                designs[one.change.name] = _indicators(mapping.groups_of(state.sensors.one, "column"))
            elif not of_scene(one):
                designs[one.change.name] = np.stack([*place, radius], axis=1)
        found = mapping.patterned(free, designs)
        chances = {name: p for name, (p, _) in found.items()} | scenes
        real = [t for t in patterns if chances[t.change.name] < doubtful]
        dropped = [t for t in patterns if t not in real]
        rest = [t for t in tried if t not in dropped]
        if real and (rest[0] in maps or rest[0] in real or (scenes and _of_pixels(rest[0]))):
            fixed = [t for t in real if not of_scene(t)]
            firsts = [min(fixed, key=lambda t: found[t.change.name][1])] if fixed else []
            first = max([*firsts, *(t for t in real if of_scene(t))], key=lambda t: t.gain)
            rest.remove(first)
            rest.insert(0, first)
        return rest

    def _of_scene(self, state: State, one: Tried, change: Change, free: mapping.Map) -> float:
        """p-value of a change of the scene, by what it leaves of the pixels' numbers. change, free: the map beside it.

        What it does to a pixel hangs on the scene about it, so that no shape over the array stands for it, and there is
        much where no light falls, of which a map of the light knows nothing.
        """
        ids = [id for id, name in state.residuals if name == PIXELS and self.bench.of_scene(id)]
        after = self.bench.residuals(state, one.moved, one.times)
        told = mapping.information(self.bench, state.values, change, mapping.levels_of(self.bench, state))
        z, left = (np.stack([x[id, PIXELS] for id in ids]) for x in (state.residuals, after))
        return mapping.explained(z, left, np.stack([told[id] for id in ids]), free.sigma, len(one.change.dials))

    def scattered(self, state: State, values: dict[Key, Any], like: Tried, faint: bool = False) -> list[Tried]:
        """Maps that no pixel tells by its counts, but that may do to all else what a candidate does.

        Pixels that differ at random: every recording has others. Those that bring the data as near as `like` does.
        faint: see `again`.
        """
        levels = mapping.levels_of(self.bench, state)
        out = []
        for change in self._beside(state.sensors.one):
            if change.per != "pixel" or change.carrier is None or change.effect == like.change.effect:
                continue
            told: Any = None
            with self.if_possible(change, _MAPPING):
                told = sum(mapping.information(self.bench, values, change, levels).values())
            if told is None:
                continue
            # what intervals tell of each pixel, jitter may have scattered as well
            if float(np.median(told)) > _TOLD and not change.blinds:
                continue
            best: Tried | None = None
            about, sigmas = 0.0, np.array(_SIGMAS)
            (wide,) = self.bench.moved(state, [_scattered(state.sensors, change, _SIGMAS[-2])])
            if isinstance(wide, str) or self._likeness(state, wide, like.moved) < _LIKE:
                continue
            for _ in range(3):  # ever closer to the width that suits
                models = [_scattered(state.sensors, change, float(sigma)) for sigma in sigmas]
                for sigma, sensors, moved in zip(sigmas, models, self.bench.moved(state, models), strict=True):
                    if isinstance(moved, str):
                        continue
                    residuals = self.bench.residuals(state, moved)
                    gain = square(state.residuals) - square(residuals)
                    one = Tried(change, {}, moved, gain, 1.0, sensors, residuals=residuals)
                    one = self._marked(state, one) if faint else one
                    if best is None or one.gain > best.gain:
                        best, about = one, float(sigma)
                if best is None or best.gain < like.gain / 2:
                    break
                sigmas = about * np.exp(math.log(sigmas[1] / sigmas[0]) * np.array([-0.6, -0.3, 0.3, 0.6]))
            if best is not None and best.gain > like.gain - alike(like.gain):
                out.append(best)
        return out

    def _likeness(self, state: State, one: Moved, other: Moved) -> float:
        """Cosine between two traces, in the statistics in which the other has one: it may do more besides."""
        traces = [self.bench.template(state, moved) for moved in (one, other)]
        keys = [cell for cell in state.residuals if traces[1][cell].any()]
        a, b = (stacked(trace, keys) for trace in traces)
        return float(a @ b) / max(math.sqrt(float(a @ a) * float(b @ b)), 1e-12)

    # --- settling ------------------------------------------------------------------------------------------------

    def worth(self, second: Sequence[Tried]) -> list[Tried]:
        """Those that may turn out best when they are settled.

        Where chance may have made pixels odd, a map of them, too, though its small differences are hardly seen here;
        and where a map is tried, what chance would make of pixels, though no number of its suits each of them.
        """
        best = max(t.gain for t in second)
        first = second[0]
        out = [first, *(t for t in second[1:] if t.gain > 0.4 * best)][:_REFINED]
        chips, maps = (any(x) for x in zip(*((t.chips, _of_pixels(t)) for t in out), strict=True))
        beside = [t for t in second if (chips and _of_pixels(t)) or (maps and t.chips and t.fell > _PROMISING)]
        return out + [t for t in beside if all(t is not one for one in out)]

    def weigh(self, state: State, refined: Sequence[Tried]) -> None:
        """Those that may be best get states of their own: differences of a few recordings blur an edge.

        Compared by the cells that either of them moves, lest chance in all others decide; by squares, and so without
        those whose own scatter is wider.
        """
        known = [t for t in refined if t.maps is None and t.residuals is not None and not t.scatters]
        most = max((t.gain for t in known), default=0.0)
        near = [t for t in known if most - t.gain < alike(most)]
        if len(near) < 2:
            return
        costs: dict[int, float] = {}
        states: list[tuple[Tried, State]] = []
        for one in near:
            with contextlib.suppress(SpadError):  # what cannot be simulated everywhere stays what it is
                states.append((one, state_of(self.bench, one)))
        if len(states) < 2:
            return
        for cell, z in state.residuals.items():
            if any(len(there.residuals.get(cell, ())) != len(z) for _, there in states):
                continue
            moved = np.any([np.abs(one.residuals[cell] - z) > _MOVED for one, _ in states if one.residuals], axis=0)
            for one, there in states:
                left = there.residuals[cell][moved]
                costs[id(one)] = costs.get(id(one), optimism(one)) + float(left @ left)
        best = min((one for one, _ in states), key=lambda one: costs[id(one)])
        for one, _ in states:
            one.gain = best.gain - (costs[id(one)] - costs[id(best)])

    def preferred(self, refined: Sequence[Tried], merit: Callable[[Tried], Any]) -> Tried:
        """The best of some settled candidates, a pattern of several being the first.

        Whether chance or a map says which pixels are odd is no matter of the squares, for a map has a number for each
        pixel: what leaves fewer checks failing is better, and a map is where both leave as many, for what chance has
        decided once and for all is a map.
        """
        best = refined[0] if is_pattern(refined[0]) else max(refined, key=merit)
        rivals = [t for t in refined if t.chips or _of_pixels(t)]
        if best not in rivals or len({t.chips for t in rivals}) < 2:
            return best
        left = {}
        for one in rivals:
            state = state_of(self.bench, one)
            left[id(one)] = len(checks.failing(checks.blocks(self.bench, state, state.residuals)))
        return min(rivals, key=lambda t: (left[id(t)], t.chips, -t.gain))

    def least_likely(
        self, state: State, refined: Sequence[Tried], judged: Callable[[Tried], tuple[float, float]]
    ) -> tuple[Tried, float, float]:
        """(the one of some faint candidates that chance makes least, its significance, its p-value).

        judged: candidate -> (significance, p-value). A pattern of several is the first here, too; and where chance has
        made pixels odd and it is their numbers that tell so, a map of them tells the same, and is not rarer.
        """
        best = refined[0] if is_pattern(refined[0]) else min(refined, key=lambda t: judged(t)[1])
        maps = [t for t in refined if _of_pixels(t)]
        told = best
        if best.chips and maps and self._of_numbers(state, best.moved) > _MOSTLY:
            best = min(maps, key=lambda t: judged(t)[1])
        return best, *judged(told)

    def _of_numbers(self, state: State, moved: Moved) -> float:
        """The share of a trace, by its squares, in what counts detections and sets none beside another."""
        squares = {cell: float(t @ t) for cell, t in self.bench.template(state, moved).items() if cell != RATES}
        counts = sum(x for (_, name), x in squares.items() if Statistic.registry.find(name).among == "")
        return counts / max(sum(squares.values()), 1e-300)

    def beside(self, state: State, one: Tried) -> float:
        """By how much a candidate makes the data likelier where it has a trace, judged by its own scatter."""
        there = self.bench.state({}, state.sensors.changed(one.scaled(), None, True))
        return likelier(state, there, self.bench.template(state, one.moved.at(one.times)))


def _mark_of(chance: float) -> float:
    """Standard deviations of a p-value."""
    return float(stats.norm.isf(max(chance, LEAST_P) / 2))


def _of_pixels(one: Tried) -> bool:
    """Is it a map of pixels?"""
    return one.maps is not None and one.change.per == "pixel"


def gain_beside(one: Tried, other: Tried) -> float:
    """The gain of a candidate as it is to be compared with another's: where chance makes the pixels of that one odd, a
    map has no number for each for nothing.
    """
    if not (other.chips and one.maps and one.chance is not None):
        return one.gain
    price = sum(one.maps[c.carrier].price for c in one.changes if c.carrier in one.maps)  # not of those held before
    return min(one.gain, max(one.gain - price, _mark_of(one.chance) ** 2))


def alike(gain: float) -> float:
    """By how much less than the best another candidate may gain that is as good."""
    return _ALIKE + _BLURRED * math.sqrt(max(gain, 0.0))


def _scattered(sensors: Sensors, change: Change, sigma: float) -> Sensors:
    """These sensors with pixels that differ at random by `sigma`, of a logarithm, in each recording."""
    effect, parameter = change.carrier  # type: ignore[misc]

    def of(capture: str, number: int) -> Sensor:
        sensor = sensors.of(capture, number)
        rng = np.random.Generator(np.random.Philox(key=[number, 11]))
        usual = np.asarray(getattr(sensor.effect(effect), parameter), np.float64)
        draws = np.exp(sigma * rng.standard_normal(sensor.layout.pixels))
        return with_values(sensor, {(effect, parameter): usual * draws})

    return Sensors(of, sensors.one, alike=False, typical=sensors.usual)


def _among(tried: Sequence[Tried], change: Change, values: Mapping[Key, Any]) -> bool:
    """Has a change been tried at these values?"""
    return any(t.change.name == change.name and t.values == values for t in tried)


def _opposite(state: State, one: Tried) -> Sensors | None:
    """The model with a strength of the other sign; None where there is none."""
    if one.maps is not None or one.change.kind != "add":
        return None
    turned = {
        d.key: d.scaled(float(one.values[d.key]), -1.0)
        for d in one.change.strengths
        if d.low < 0 and d.key in one.values
    }
    if all(one.values[key] == x for key, x in turned.items()):
        return None
    return state.sensors.changed({**one.values, **turned}, one.phases, one.chips)


def _indicators(groups: np.ndarray) -> np.ndarray:
    one = np.eye(int(groups.max()) + 1)[groups]
    return np.asarray(one[:, 1:])
