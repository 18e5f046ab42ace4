"""Codes of the converter: against a literal version, their laws, and unequal codes."""

from __future__ import annotations

from functools import partial

import null_laws
import numpy as np
import pytest
from simple_sensor import grid, many, one_of_each, reduced, sigmas, stamped, tr

from spadmnist.events import Events
from spadmnist.inference.null_distribution import learn
from spadmnist.inference.replicates import no_size
from spadmnist.recording import Recording
from spadmnist.statistics import Summary
from spadmnist.statistics.codes import CodePeriods, Codes


def ticks_of(recording: Recording) -> np.ndarray:
    if recording.events is not None:
        return np.asarray(recording.events.ticks).astype(np.int64)
    stamps = np.asarray(recording.frames[:]).astype(np.int64)  # type: ignore[index]
    return stamps[stamps < recording.none]


@pytest.mark.parametrize("kind", ["tr", "str"])
def test_a_small_recording(kind: str) -> None:
    recording = one_of_each()["tr"] if kind == "tr" else stamped(3, (403, 6, 11), 0.2, tick=1e-9)
    ticks = ticks_of(recording)
    assert len(ticks) == recording.totals.sum() > 1000
    summary = reduced(Codes, recording)
    wanted = [np.bincount(ticks % period, minlength=period) for period in (256, 140, 100)]
    assert summary.values.tolist() == np.concatenate(wanted).tolist()
    assert summary.where(5) == "code 5 of 256 (low bits 00000101)" and summary.where(256 + 139) == "code 139 of 140"
    assert summary.size(0, 12.0, 10.0) == ("20 % too often", 2 / len(ticks))

    periods = [p for p in range(2, 1001) if 672_000 % p == 0 and 16 * p <= round({"tr": 3e7, "str": 1e4}[kind])]
    summary = reduced(CodePeriods, recording)
    assert summary.axis is not None and summary.axis.tolist() == periods
    for k in (0, 3, 20, 50):
        period = periods[k]
        counts, mean = np.bincount(ticks % period, minlength=period), len(ticks) / period
        chi, part = ((counts - mean) ** 2 / mean).sum() / (period - 1), 2 / (9 * (period - 1))
        if len(ticks) ** 2 / (2 * period) >= 500:
            score = (np.cbrt(chi) - 1 + part) / np.sqrt(part)
            np.testing.assert_allclose(summary.values[k], score, rtol=1e-6, atol=1e-9)
    assert summary.where(0).startswith("codes in a period of 2 ticks (")


def test_nothing_to_say() -> None:
    """Without a converter, and in frames too short for a period; and nothing at all of no detections."""
    kinds = one_of_each()
    for statistic in (Codes, CodePeriods):
        assert statistic().reduce(kinds["tr without ticks"]) is None
        assert statistic().reduce(stamped(1, (50, 2, 2), 0.3, tick=1e-6)) is None
    assert reduced(Codes, tr(1, grid(2, 2), 0.0, 1e-3)).values.sum() == 0
    # a frame of 1000 ticks holds the period of 50 sixteen times, and none of those that are shown
    assert Codes().reduce(kinds["str"]) is None
    axis = reduced(CodePeriods, kinds["str"]).axis
    assert axis is not None and axis.max() == 60


@pytest.mark.parametrize("detections", [0.0, 0.1, 50.0, 80.0, 400.0])
def test_periods_that_tell_nothing_make_no_others_look_far_out(detections: float) -> None:
    """Of 80 detections five periods tell something: their scatter is theirs, and not that of 76 cells."""
    recordings = (tr(k, grid(2, 2), detections / 4 / 1e-3, 1e-3) for k in range(400))
    values = np.stack([reduced(CodePeriods, one).values for one in recordings])
    null = learn([Summary(v, "normal", str, no_size, np.ones(v.size)) for v in values[:96]], np.full(96, detections))
    live = values[:96].any(axis=0)
    assert live.any() == (detections > 1)
    spread = float(np.sqrt(np.mean(values[:96, live] ** 2))) if live.any() else 1.0
    assert null.factor == pytest.approx(max(spread, 0.5), rel=0.1)
    p = np.array([null.judge(v, detections).p_value for v in values[96:]])
    assert np.sum(p < 1e-3) <= 6  # 0.3 are expected of 304; more than 6 have a probability of 1e-6


STEADY = {
    "tr": partial(tr, layout=grid(4, 6), rates=4e5, exposure=4e-3, dead_time=50e-9),
    "tr, dim": partial(tr, layout=grid(4, 6), rates=5e3, exposure=1e-2),
    "str": partial(stamped, shape=(200, 8, 8), share=0.2, tick=1e-9),
}


@pytest.mark.parametrize("kind", STEADY)
def test_laws_of_steady_light(kind: str) -> None:
    null_laws.poisson(many(Codes, STEADY[kind], 100), 0.95)
    values = many(CodePeriods, STEADY[kind], 150)
    told = values.std(axis=0) > 0
    assert told.sum() == len(told) or kind != "tr"
    if kind == "str":  # a frame is no multiple of all periods, and its light decays: not quite even
        null_laws.normal(values[:, told], spread=None)
    else:
        null_laws.normal(values[:, told & (reduced(CodePeriods, STEADY[kind](1)).axis > 12)])  # type: ignore[operator]


def unequal(seed: int, period: int = 140, rms: float = 0.06) -> Recording:
    """Codes whose widths differ, the same in all pixels."""
    recording = STEADY["tr"](seed)
    assert recording.events is not None and recording.events.ticks is not None
    rng = np.random.default_rng(7)
    edges = np.concatenate([[0.0], np.cumsum(1 + rms * rng.standard_normal(period))])
    edges *= period / edges[-1]
    ticks = recording.events.ticks.astype(np.int64)
    phase = ticks % period + np.random.default_rng(seed).random(len(ticks))
    moved = ticks // period * period + np.searchsorted(edges, phase, side="right") - 1
    events = Events(None, recording.events.offsets, 24, moved.astype(np.uint32), 1e-10)
    return Recording(recording.capture, recording.layout, events, None, 1e-10, recording.dead_time)


def test_unequal_codes_are_seen_in_their_period() -> None:
    """6 % in 38,000 detections: chi squared is 38,000 * 0.06^2 = 135 more, of 139 +- 17, a score of 6 to 7."""
    found = np.mean([sigmas(CodePeriods, unequal(seed), STEADY["tr"]) for seed in range(8)], axis=0)
    summary = reduced(CodePeriods, unequal(1))
    assert summary.axis is not None
    assert summary.axis[np.argmax(found)] == 140 and 4.5 < found.max() < 8
    # of another period it shows in those that are multiples, and nowhere else
    found = sigmas(CodePeriods, unequal(1, 100, 0.1), STEADY["tr"])
    multiples = summary.axis % 100 == 0
    assert found[summary.axis == 100][0] > 12 and found[multiples].min() > 4
    divisors = 100 % summary.axis == 0
    assert np.abs(found[(summary.axis == 256) | (summary.axis == 96)]).max() < 4.5 and found[divisors].max() > 12
    text, wide = reduced(CodePeriods, unequal(1, 100, 0.1)).size(int(np.flatnonzero(summary.axis == 100)[0]), 0.0, 0.0)
    assert 0.08 < wide < 0.13 and text == f"widths of the codes vary by {100 * wide:.3g} % (rms)"
    # a code that is missing is one cell
    missing = unequal(1, 140, 0.0)
    assert missing.events is not None and missing.events.ticks is not None
    ticks = np.where(missing.events.ticks % 140 == 17, missing.events.ticks + 1, missing.events.ticks).astype(np.uint32)
    events = Events(None, missing.events.offsets, 24, ticks, 1e-10)
    found = sigmas(Codes, Recording(missing.capture, missing.layout, events, None, 1e-10, 50e-9), STEADY["tr"])
    assert found[256 + 17] < -25 and found[256 + 18] > 10
    with pytest.raises(AssertionError):
        null_laws.normal(many(CodePeriods, partial(unequal, rms=0.1), 100))
