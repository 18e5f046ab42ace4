"""Trials of a scan under an earlier model: which of their signatures hold under this one, and in which captures."""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import SpadError
from .candidates import Candidate
from .coordinates import Key
from .evaluation import Evaluation
from .levels import PROMISING
from .signature import size_of
from .trial import Trial, is_same, shape_of

if TYPE_CHECKING:
    from .scan import Scan

# factor on the size of a signature: by more, another model has another scatter, and the signature is simulated anew;
# the same factor on another parameter of its effect. A rule of thumb
_CHANGED = 1.15


def still_valid(
    scan: Scan,
    evaluation: Evaluation,
    tries: Sequence[tuple[Candidate, Mapping[Key, Any]]],
    known: Sequence[Trial],
    anew: bool,
) -> list[Trial]:
    """The known trials that are still candidates, at their best strength.

    A trial that the data resemble is left out, to be simulated anew, if its signature has changed; any trial is if
    other parameters of its own effect have moved.

    Args:
        tries: the candidates and values of this model.
        anew: every trial that the data resemble is left out, and of the others those whose signature has changed.
    """
    out, promising = [], set()
    for one in known:
        if one.candidate.phases or not any(is_same(one, *t) for t in tries):
            continue
        now = replace(one, sharp=False)
        now.fall, now.times = scan.line_search(evaluation, one.signature, one.signed)
        out.append(now)
        resembled, known_size = now.fall >= PROMISING / 4, now.size > 0
        changed = (resembled or (anew and known_size)) and has_changed(scan, evaluation, now)
        if (resembled and anew) or changed or has_moved(evaluation, one):
            promising.add((now.candidate.name, shape_of(now)))
    return [t for t in out if (t.candidate.name, shape_of(t)) not in promising]


def has_changed(scan: Scan, evaluation: Evaluation, known: Trial) -> bool:
    """Whether the size of a known signature, in standard deviations, is another one under this model.

    It shows that the cells have another scatter. It does not show another shift; the second look simulates that.
    """
    if any(known.candidate.effect == candidate.effect for candidate in scan.accepted):
        return True
    now = size_of(scan.replicates, evaluation, known.signature)
    return not known.size / _CHANGED < now < known.size * _CHANGED


def has_moved(evaluation: Evaluation, known: Trial) -> bool:
    """Whether other parameters of a trial's own effect have moved since its signature was simulated.

    The shift may be another one then, and in other cells: more crosstalk at another delay.
    """
    name = known.candidate.effect
    then = None if known.sensors is None else known.sensors.one.effect(name)
    now = evaluation.sensors.one.effect(name)
    if then is None or now is None:
        return False
    others = [p for p in now.parameters if (name, p) not in known.values]
    return any(values_differ(getattr(then, p), getattr(now, p)) for p in others)


def values_differ(a: Any, b: Any) -> bool:
    """Whether two values of a parameter differ by more than the factor `_CHANGED`."""
    if a is b or a is None or b is None:
        return a is not b
    try:
        x, y = np.asarray(a, float), np.asarray(b, float)
    except (TypeError, ValueError):
        return repr(a) != repr(b)
    return x.shape != y.shape or bool(np.any(np.abs(x - y) > (_CHANGED - 1) * np.maximum(np.abs(x), np.abs(y))))


def completed(scan: Scan, evaluation: Evaluation, known: Sequence[Trial], wanted: Collection[str]) -> list[Trial]:
    """The trials with their signatures completed in captures in which they were not simulated."""
    out = [one for one in known if set(wanted) <= one.seen]
    groups: dict[frozenset[str], list[Trial]] = {}
    for one in known:
        if set(wanted) <= one.seen:
            continue
        with contextlib.suppress(SpadError):  # what cannot be set in this model any more is tried anew
            sensors = evaluation.sensors.changed(one.values, chips=one.chips)
            groups.setdefault(frozenset(set(wanted) - one.seen), []).append(replace(one, sensors=sensors))
    for missing, some in groups.items():
        earlier = {id(one): one.signature for one in some}
        for one in scan.simulated(evaluation, some, only=sorted(missing)):
            one.signature = earlier[id(one)].completed(one.signature, missing)
            one.seen = one.seen | missing
            one.size = size_of(scan.replicates, evaluation, one.signature)
            one.fall, one.times = scan.line_search(evaluation, one.signature, one.signed)
            out.append(one)
    return out
