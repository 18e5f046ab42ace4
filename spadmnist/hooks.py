"""Calls of the hooks of effects: what a hook returns is checked, and an error names the effect and its file.

A hook of a user's effect cannot change what it is given, which others use as well: it gets arrays that cannot be
written. What it returns can be written again, as kernels are compiled for such arrays.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from .effects import Conditions, Effect
from .errors import EffectError, InputError, SpadError
from .events import Children, Events, SealedEvents, read_only
from .plugins import blame, is_built_in, source_file
from .streams import Streams


def call(effect: Effect, hook: str, *arguments: Any) -> Any:
    """What a hook returns. Raises EffectError where its code fails."""
    method: Callable[..., Any] = getattr(effect, hook)
    own = is_built_in(type(effect))
    try:
        return method(*arguments) if own else _opened(method(*map(_sealed, arguments)))
    except (SpadError, InputError):
        raise
    except Exception as error:
        raise blame(type(effect), error) from error


def _sealed(argument: Any) -> Any:
    """What a hook is given, so that it cannot change it."""
    if isinstance(argument, np.ndarray):
        return read_only(argument)
    return SealedEvents(argument) if isinstance(argument, Events) else argument


def _opened(found: Any) -> Any:
    """What a hook returns, so that it can be written."""
    if isinstance(found, SealedEvents):
        return found.whole
    if isinstance(found, Events):
        for name in ("_times", "offsets", "ticks", "row_pixel", "cause", "parent", "_image_offsets"):
            setattr(found, name, _opened(getattr(found, name)))
    return found.copy() if isinstance(found, np.ndarray) and not found.flags.writeable else found


def wrong(effect: Effect, what: str) -> EffectError:
    """The error that a hook returns what it must not."""
    return EffectError(f"{source_file(type(effect))}: the effect {effect.name}: {what}")


def draws(effect: Effect) -> bool:
    """Whether a hook of an effect takes random numbers."""
    return effect.stage in ("correlated", "timing", "readout") or hasattr(effect, "modulate")


def rng(effect: Effect, streams: Streams, events: Events, suffix: str = "") -> Any:
    """The random numbers of an effect: counted, where it says how many each event takes."""
    name = effect.name + suffix
    return streams.draws(name, len(events)) if effect.counted else streams.generator(name)


def rate(effect: Effect, before: np.ndarray, conditions: Conditions) -> np.ndarray:
    """The rates after an effect of the light, the detection or the dark, 1/s, in the shape of those before."""
    after = _rates(effect, "apply", before, conditions)
    if after.size and not 0 <= after.min() <= after.max() < np.inf:
        raise wrong(effect, "apply returns a rate that is negative or not finite")
    return after


def expected(effect: Effect, before: np.ndarray, conditions: Conditions) -> np.ndarray:
    """The mean rates behind an effect by its closed form, 1/s, in the shape of those before it."""
    after = _rates(effect, "expected_rate", before, conditions)
    # a difference of rates may be a rounding error below 0
    if not is_built_in(type(effect)) and not np.all((after >= np.minimum(before, 0.0)) & (after < np.inf)):
        raise wrong(effect, "expected_rate returns a rate that is negative or not finite")
    return after


def _rates(effect: Effect, hook: str, before: np.ndarray, conditions: Conditions) -> np.ndarray:
    after = call(effect, hook, before, conditions)
    if not isinstance(after, np.ndarray) or after.shape != before.shape or after.dtype != np.float64:
        what = f"{after.dtype} of shape {after.shape}" if isinstance(after, np.ndarray) else type(after).__name__
        raise wrong(effect, f"{hook} must return float64 rates of shape {before.shape}, not {what}")
    return after


def added(effect: Effect, shape: tuple[int, ...], conditions: Conditions) -> np.ndarray:
    """The rate that an effect adds of its own, 1/s, broadcast to a shape (images, pixels)."""
    more = np.asarray(call(effect, "added", conditions), np.float64)
    good = more.shape in ((), shape[1:]) and bool(np.all((more >= 0) & (more < np.inf)))
    if not good:
        raise wrong(effect, f"added must return 1/s, one value or {shape[1]}, not negative")
    return np.broadcast_to(more, shape)


def maximum(effect: Effect, conditions: Conditions) -> float:
    """The largest factor by which an arrival effect multiplies its part of the rate."""
    top = call(effect, "maximum", conditions)
    if not isinstance(top, int | float | np.integer | np.floating) or not 0 <= top < np.inf:
        raise wrong(effect, f"maximum must return one finite number, not negative; it returns {top!r}")
    return float(top)


def factor(effect: Effect, events: Events, conditions: Conditions, streams: Streams) -> np.ndarray:
    """(events,) what an arrival effect multiplies its part of the rate by."""
    if hasattr(effect, "modulate"):
        found = np.asarray(call(effect, "modulate", events, conditions, rng(effect, streams, events)))
    else:
        found = np.asarray(call(effect, "factor", events.times, conditions))
    hook = "modulate" if hasattr(effect, "modulate") else "factor"
    shape = events.times.shape
    if found.shape not in ((), shape) or found.dtype.kind not in "fiub":
        raise wrong(effect, f"{hook} must return one number per time, {shape}, not {found.shape}")
    top = 1.0 if effect.acts_on == "own" else maximum(effect, conditions)
    if found.size and not (found.min() >= 0 and found.max() <= top * (1 + 1e-9)):
        raise wrong(effect, f"{hook} must lie between 0 and the maximum it states, {top:g}")
    return np.ascontiguousarray(np.broadcast_to(found, shape), np.float64)


def is_open(effect: Effect, times: np.ndarray, conditions: Conditions) -> np.ndarray:
    """(events,) bool: whether a gate lets a pixel fire at these times."""
    mask = np.asarray(call(effect, "open", times, conditions))
    if mask.dtype != bool or mask.shape != times.shape:
        raise wrong(effect, f"open must return one bool per time, {times.shape}, not {mask.dtype} {mask.shape}")
    return mask


def spawned(
    effect: Effect, events: Events, dead_times: np.ndarray, streams: Streams, suffix: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(times, rows, parents) of an effect's children; in the parent's own pixel the dead time comes first.

    Args:
        dead_times: (pixels,) s.
        suffix: of the name of its random numbers.
    """
    children = call(effect, "spawn", events, rng(effect, streams, events, suffix))
    if not isinstance(children, Children):
        raise wrong(effect, f"spawn must return Children, not {type(children).__name__}")
    parent, delay = np.asarray(children.parent), np.asarray(children.delay, np.float64)
    if parent.dtype == bool:
        raise wrong(effect, "the parents of children are a mask; give their indices: parent = np.flatnonzero(mask)")
    good = parent.ndim == 1 and parent.shape == delay.shape and (parent.dtype.kind in "iu" or not len(parent))
    if not good or (len(parent) and (parent.min() < 0 or parent.max() >= len(events) or not np.all(delay >= 0))):
        raise wrong(effect, f"children need a parent among the {len(events)} events and a delay that is not negative")
    parent = parent.astype(np.int64)
    home = np.searchsorted(events.offsets, parent, side="right") - 1
    rows = home
    if children.row is not None:
        rows = np.asarray(children.row)
        if (
            rows.shape != home.shape
            or rows.dtype.kind not in "iu"
            or np.any(rows // events.pixels != home // events.pixels)
        ):
            raise wrong(effect, "the row of a child must be a whole number, and a pixel of its parent's own image")
        rows = rows.astype(np.int64)
    its_own = dead_times[home % events.pixels]
    times = events.times[parent] + (np.where(rows == home, its_own, 0.0) + delay)
    return times, rows, parent


def blind_time(effect: Effect, pixels: int) -> np.ndarray:
    """The time for which a pixel is blind after a detection, s: one value, or (pixels,)."""
    blind = np.asarray(call(effect, "blind_time"))
    if blind.shape not in ((), (pixels,)) or blind.dtype.kind not in "fiu" or not np.all(blind >= 0):
        raise wrong(effect, f"blind_time must return seconds, one value or {pixels}, not negative")
    return blind


def carried(effect: Effect) -> float:
    """The share of the remaining blind time with which a pixel enters the next frame."""
    share = call(effect, "carried")
    if not isinstance(share, int | float | np.integer | np.floating) or not 0 <= share <= 1:
        raise wrong(effect, f"carried must return a share from 0 to 1, not {share!r}")
    return float(share)


def recovered(effect: Effect, chance: np.ndarray) -> np.ndarray:
    """The time after the blind time at which an effect's sensitivity reaches `chance`, s."""
    if hasattr(effect, "recovered"):
        out = np.asarray(call(effect, "recovered", chance), np.float64)
        if out.shape != chance.shape or not np.all(out >= 0):
            raise wrong(effect, f"recovered must return seconds, {chance.shape}, not negative")
        return out
    # by bisection on a scale that reaches from a femtosecond to an hour
    low, high = np.zeros(chance.shape), np.full(chance.shape, 3600.0)
    for step in range(120):
        middle = np.sqrt(np.maximum(low, 1e-15) * high) if step < 60 else (low + high) / 2
        value = np.asarray(call(effect, "sensitivity", middle))
        if value.shape != chance.shape or not np.all((value >= 0) & (value <= 1)):
            raise wrong(effect, f"sensitivity must return numbers from 0 to 1, {chance.shape}")
        reached = value >= chance
        high = np.where(reached, middle, high)
        low = np.where(reached, low, middle)
    return high


def awake_after(effect: Effect) -> float:
    """The time after the blind time from which on every event fires, whatever it draws, s."""
    return float(recovered(effect, np.array([1 - 2.0**-53]))[0])  # the largest number that is drawn


def influence(effect: Effect) -> float:
    """How far an effect's events matter, pitches."""
    reach = call(effect, "influence")
    if not isinstance(reach, int | float | np.integer | np.floating) or not reach >= 0:
        raise wrong(effect, f"influence must return pitches, not negative, or inf; it returns {reach!r}")
    return float(reach)


def limit(effect: Effect, counts: np.ndarray) -> np.ndarray:
    """The counts that a readout effect leaves, in the shape and type of those before."""
    after = call(effect, "limit", counts)
    if not isinstance(after, np.ndarray) or (after.shape, after.dtype) != (counts.shape, counts.dtype):
        what = f"{after.dtype} of shape {after.shape}" if isinstance(after, np.ndarray) else type(after).__name__
        raise wrong(effect, f"limit must return counts of shape {counts.shape} and type {counts.dtype}, not {what}")
    return after


def applied(effect: Effect, events: Events, streams: Streams, suffix: str = "") -> Events:
    """The events after an effect of the timing or the readout."""
    return checked(effect, call(effect, "apply", events, rng(effect, streams, events, suffix)), events)


def checked(effect: Effect, after: Any, events: Events) -> Events:
    """What a hook has made of events; it is looked at where the hook's draws are not counted, as in plug-ins."""
    if effect.stage == "timing" and isinstance(after, Events) and len(after) != len(events):
        made = f"apply must not add or remove stamps, but it makes {len(after)} of {len(events)}"
        raise wrong(effect, f"{made}; an effect of the stage readout may lose some")
    if not effect.counted:
        end = events.end
        if end is not None and len(events):  # a clock that rounds to the nearest tick may have reached the end
            end = max(end, float(np.nextafter(events.times.max(), np.inf)))
        what = after.problem(end) if isinstance(after, Events) else f"it is a {type(after).__name__}, not Events"
        if not what and len(after.offsets) != len(events.offsets):
            what = f"it has {len(after.offsets) - 1} rows, not {len(events.offsets) - 1}"
        if not what and effect.stage == "timing" and not np.array_equal(after.offsets, events.offsets):
            what = "its rows have other numbers of stamps; apply must leave each stamp in its row"
        if not what and events.cause is not None and (after.cause is None or len(after.cause) != len(after)):
            what = "the causes of the events are gone; use events.keep, events.moved or events.stamped"
        if what:
            raise wrong(effect, f"what apply returns cannot be used: {what}")
    return after
