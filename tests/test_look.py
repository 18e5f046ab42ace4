"""A first look at a capture: what was recorded, in numbers, and whether it seems to have been interrupted."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import laws
import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from spadmnist import look, measurement
from spadmnist.cli import cli
from spadmnist.effects import Conditions
from spadmnist.events import Events, Layout
from spadmnist.recording import Capture, Light, Recording

CASES = Path(__file__).parents[2] / "shared" / "cases"


def case(name: str) -> Path:
    if not (CASES / name).is_dir():
        pytest.skip(f"the shared case {name} is not here")
    return CASES / name


def said(*arguments: object) -> str:
    result = CliRunner().invoke(cli, list(map(str, arguments)), catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return str(result.stdout)


def stamped(stamps: list[Any] | np.ndarray, end: int, tick: float | None = 1e-9) -> Recording:
    """Two pixels that share the stamps; without a tick they are s."""
    whole = np.sort(np.asarray(stamps))
    rows = [whole[0::2], whole[1::2]]
    offsets = np.array([0, len(rows[0]), len(whole)])
    exposure = end * (tick or 1.0)
    capture = Capture("a", "tr", Light(), Conditions(exposure, 1, exposure, exposure, None))
    flat = np.concatenate(rows)
    events = Events(flat, offsets, 2) if tick is None else Events(None, offsets, 2, flat.astype(np.uint32), tick)
    return Recording(capture, Layout(1, 2, 25e-12, 1.0), events, None, tick)


class Watched:
    """Frames that remember which of them were read."""

    def __init__(self, frames: np.ndarray):
        self.frames, self.read = frames, np.zeros(len(frames), int)
        self.shape = frames.shape

    def __getitem__(self, part: slice) -> np.ndarray:
        self.read[part] += 1
        return self.frames[part]


def framed(some: np.ndarray, modality: str = "qis") -> Recording:
    """Two pixels; in the frames where `some` holds the second one has a detection."""
    n = len(some)
    counting = {"bits": 4, "counting": "frames"} if modality == "counts" else {}
    frames = 15 * n if modality == "counts" else n
    clock = Conditions(frames * 10e-6, frames, 10e-6, 10e-6, None, **counting)  # type: ignore[arg-type]
    tick, kind, none, seen = {
        "qis": (None, np.uint8, 0, 64),
        "counts": (None, np.uint8, 0, 15),
        "str": (1e-7, np.uint32, 100, 0),
    }[modality]
    values = np.full((n, 1, 1 if modality == "qis" else 2), none, kind)
    values[some, 0, -1] = seen
    capture = Capture("a", modality, Light(), clock)
    return Recording(capture, Layout(1, 2, 25e-12, 1.0), None, Watched(values), tick)


# --- how often it is wrong ----------------------------------------------------------------------------------------


def test_the_chance_of_a_silence_is_a_p_value() -> None:
    """Of moments anywhere in the exposure it is uniform: a bound of 1e-6 is passed by chance once in a million."""
    rng = np.random.default_rng(1)
    found = []
    for _ in range(4000):
        n = int(rng.integers(1, 60))
        found.append(look._chance(n, float(rng.random(n).max()), 1.0))
    laws.distribution_is(found, lambda p: p, what="chance of the silence at the end")


@pytest.mark.parametrize("slots", [7, 40, 1000])
def test_ticks_and_frames_make_no_more_alarms(slots: int) -> None:
    """A moment that is known to a tick or a frame only: the alarms at each level are no more than its share."""
    rng = np.random.default_rng(slots)
    trials = 20_000
    detections, frames = np.empty(trials), np.empty(trials)
    for i in range(trials):
        at = rng.integers(0, slots, int(rng.integers(1, 40)))
        detections[i] = look._chance(len(at), float(at.max()) + 1, slots)
        frames[i] = look._chance(len(set(at)), float(at.max()) + 1, slots)
    for chances in (detections, frames):
        for level in (0.1, 1e-2, 1e-3):
            assert (chances < level).sum() <= stats.binom.isf(laws.FALSE_ALARM / 3, trials, level)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(st.integers(0, 400), st.sampled_from([3, 50, 10_000, 2**31]), st.integers(0, 2**32))
def test_what_runs_to_its_end_is_not_called_interrupted(count: int, end: int, seed: int) -> None:
    """Steady light: 800 recordings, each wrongly told with a probability below 1e-6."""
    at = np.random.default_rng(seed).random(count)
    assert look.silences(stamped((at * end).astype(np.int64), end)) == []
    assert look.silences(stamped(at, 1, tick=None)) == []
    frames = np.zeros(min(end, 10_000), bool)
    frames[(at * len(frames)).astype(int)] = True
    assert look.silences(framed(frames)) == []
    assert look.silences(framed(frames, "str")) == []


# --- what is told -------------------------------------------------------------------------------------------------


def test_a_recording_that_broke_off_is_told() -> None:
    at = np.random.default_rng(3).random(200) * 0.6e9
    at[:2] = 1.0, 598_983_999.4
    note = 'the last 401 ms of 1 s; if the recording broke off at 599 ms, import it again with --exposure "599 ms"'
    for recorded in (
        stamped(np.minimum(at, at[1]).astype(np.int64), 10**9),
        stamped(np.minimum(at, at[1]) * 1e-9, 1, tick=None),
    ):
        assert look.silences(recorded) == [f"nothing was recorded in {note}"]


def test_where_it_broke_off_is_never_before_the_last_detection() -> None:
    """The exposure that is named holds every detection, however short the silence is beside it."""
    at = np.arange(998_984) * 1000
    (told,) = look.silences(stamped(at, 10**9))
    assert '--exposure "998.99 ms"' in told and "the last 1.02 ms of 1 s" in told


@pytest.mark.parametrize("modality", ["qis", "str", "counts"])
def test_frames_that_broke_off_are_told(modality: str) -> None:
    some = np.random.default_rng(4).random(1000) < 0.3
    some[587], some[588:] = True, False
    recorded = framed(some, modality)
    lasting = "61.8 ms" if modality == "counts" else "4.12 ms"
    assert look.silences(recorded) == [
        f"nothing was recorded in the last 412 of 1,000 frames ({lasting}); if the recording broke off there, import "
        "its first 588 frames alone"
    ]


def test_a_recording_that_began_late_is_noted() -> None:
    at = 0.4e9 + np.random.default_rng(3).random(200) * 0.6e9
    at[:2] = 400_400_000, 999_999_999
    at = np.maximum(at, at[0])
    note = "if its clock did not start at 0, import it again with --subtract-start and the --exposure since then"
    for recorded in (stamped(at.astype(np.int64), 10**9), stamped(at * 1e-9, 1, tick=None)):
        assert look.silences(recorded) == [f"nothing was recorded in the first 400 ms of 1 s; {note}"]


@pytest.mark.parametrize("modality", ["qis", "str", "counts"])
def test_frames_that_began_late_are_noted(modality: str) -> None:
    some = np.random.default_rng(4).random(1000) < 0.3
    some[:412], some[412] = False, True
    lasting = "61.8 ms" if modality == "counts" else "4.12 ms"
    assert look.silences(framed(some, modality)) == [
        f"nothing was recorded in the first 412 of 1,000 frames ({lasting}); if the recording began late, import its "
        "last 588 frames alone"
    ]


@pytest.mark.parametrize("of", ["stamps", "frames"])
def test_both_ends_can_be_silent(of: str) -> None:
    at = np.arange(4000, 6000, 3)
    some = np.zeros(10_000, bool)
    some[at] = True
    first, last = look.silences(stamped(at, 10_000) if of == "stamps" else framed(some))
    assert "in the first 4" in first and "in the last 4" in last


def test_bursts_leave_a_silence_at_an_end() -> None:
    """As long as three of those between them: that is no interruption."""
    bursts = np.concatenate([np.arange(start, start + 50) for start in (0, 1000, 2000)])
    quiet = 950  # between two bursts: from 50 to 1000
    assert look.silences(stamped(bursts, 2050 + 3 * quiet)) == []
    assert look.silences(stamped(bursts, 2051 + 3 * quiet)) != []
    some = np.zeros(2051 + 3 * quiet, bool)
    some[bursts] = True
    assert look.silences(framed(some[:-1])) == []
    assert look.silences(framed(some)) != []
    # the same, mirrored
    end = 2051 + 3 * quiet
    late = end - 1 - bursts
    assert len(look.silences(stamped(late, end))) == 1
    assert look.silences(stamped(late - 1, end - 1)) == []
    assert len(look.silences(framed(some[::-1]))) == 1
    assert look.silences(framed(some[:-1][::-1])) == []


@pytest.mark.parametrize("stamps", [[], [5], [5, 5], [0, 1]])
def test_too_few_detections_tell_nothing(stamps: list[int]) -> None:
    """One detection leaves no silence to compare with; two are told where they lie in the first thousandth."""
    assert len(look.silences(stamped(stamps, 10**6))) == (len(stamps) == 2)
    some = np.zeros(1000, bool)
    some[stamps] = True
    assert look.silences(framed(some)) == []


def test_the_bound_is_one_in_a_million() -> None:
    """Three detections in the first three of n ticks or frames: (3 / 300)^3 is 1e-6."""
    for n in (299, 301):
        some = np.zeros(n, bool)
        some[:3] = True
        for recorded in (stamped([0, 1, 2], n), framed(some)):
            assert (look.silences(recorded) != []) == (n > 300)


def test_frames_are_read_from_both_ends_and_no_further_than_needed() -> None:
    some = np.ones(1000, bool)
    recorded = framed(some)
    assert look.silences(recorded) == []
    assert isinstance(recorded.frames, Watched) and recorded.frames.read.sum() == 2 * 64
    some[-100:] = False
    some[::2] = False
    recorded = framed(some)
    assert look.silences(recorded) != []
    assert isinstance(recorded.frames, Watched) and recorded.frames.read.max() <= 4
    # so few detections that many empty frames are nothing unusual: what is counted already is not counted again
    some = np.zeros(1000, bool)
    some[[3, 500]] = True
    recorded = framed(some)
    assert recorded.totals.sum() == 2 and isinstance(recorded.frames, Watched)
    recorded.frames.read[:] = 0
    assert look.silences(recorded) == []
    assert recorded.frames.read.max() <= 2


def test_inspect_tells_it(tmp_path: Path) -> None:
    at = np.random.default_rng(5).integers(0, 500_000, 100)
    at[0] = 499_999
    recorded = stamped(at, 10**6)
    root = measurement.write(tmp_path / "lab", "lab", recorded.layout, [recorded])
    (row,) = json.loads(said("inspect", root, "--json"))["captures"]
    assert row["notes"] == look.silences(recorded)
    assert "a: nothing was recorded in the last 500 us of 1 ms" in said("inspect", root)


def test_a_real_one(tmp_path: Path) -> None:
    """A recording of constant light that broke off, and is imported as whole: the right rate is 20034 Hz."""
    file = case("ptu-interrupted") / "short.hdf5"
    said("import", file, "-o", tmp_path / "lab", "--light", "free")
    (row,) = json.loads(said("inspect", tmp_path / "lab", "--json"))["captures"]
    (note,) = row["notes"]
    assert "in the last 401 ms of 1 s" in note
    exposure = note.partition("--exposure ")[2].strip('"')
    said("import", file, "-o", tmp_path / "again", "--light", "free", "--exposure", exposure)
    (row,) = json.loads(said("inspect", tmp_path / "again", "--json"))["captures"]
    assert row["notes"] == [] and row["rate_mean"] == pytest.approx(20034, rel=1e-4)


# --- counts -------------------------------------------------------------------------------------------------------


def test_counts_say_of_how_many_frames_they_are_sums(tmp_path: Path) -> None:
    file = case("inspect-counts") / "c.npy"
    clock = ("--frame-time", "10 us", "--frame-period", "10 us", "--light", "free", "--bits", "8")
    said("import", file, "-o", tmp_path / "lab", *clock)
    (row,) = json.loads(said("inspect", tmp_path / "lab", "--json"))["captures"]
    assert (row["frames"], row["binary_frames"], row["frame_time"]) == (20, 255, 1e-5)
    assert row["exposure"] == row["live"] == pytest.approx(0.051)
    assert row["rate_mean"] == pytest.approx(row["mean"] / 0.051)
    assert "20 x 255 x 10 us = 51 ms" in said("inspect", tmp_path / "lab")


@pytest.mark.parametrize(
    ("modality", "counting", "summed", "recorded"),
    [
        ("counts", "frames", 15, "6 x 15 x 10 us = 900 us"),
        ("counts", "counter", 1, "6 x 10 us"),
        ("qis", "frames", 1, "6 x 10 us"),
    ],
)
def test_the_frames_of_a_capture(tmp_path: Path, modality: str, counting: str, summed: int, recorded: str) -> None:
    bits = {"bits": 4, "counting": counting} if modality == "counts" else {}
    clock = Conditions(summed * 6 * 12e-6, summed * 6, 10e-6, 12e-6, None, **bits)  # type: ignore[arg-type]
    frames = np.full((6, 1, 1 if modality == "qis" else 2), 192 if modality == "qis" else 3, np.uint8)
    one = Recording(Capture("a", modality, Light(), clock), Layout(1, 2, 25e-12, 1.0), None, frames)
    root = measurement.write(tmp_path / "lab", "lab", one.layout, [one])
    (row,) = json.loads(said("inspect", root, "--json"))["captures"]
    assert (row["frames"], row["binary_frames"], row["frame_time"]) == (6, summed, 1e-5)
    assert row["live"] == pytest.approx(6 * summed * 1e-5) and row["exposure"] == pytest.approx(6 * summed * 12e-6)
    assert row["rate_mean"] == pytest.approx(row["mean"] / row["live"])
    assert f" {recorded} " in said("inspect", root)
