"""PicoQuant's time tags, record by record: against a literal loop, against ptufile, and against right values."""

from __future__ import annotations

import struct
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from importfiles import (
    DARK,
    EVERY_T2,
    HYDRAHARP_1_T2,
    HYDRAHARP_T2,
    MULTIHARP_T2,
    PICOHARP_T2,
    SECOND,
    TIMEHARP_P_T2,
    back,
    ptu,
    refusal,
    run,
    t2,
)

from spadmnist import measurement
from spadmnist.errors import SpadError
from spadmnist.importers import Said
from spadmnist.importers import ptu as reader
from spadmnist.importers.captures import Imported, import_files
from spadmnist.importers.ptu import LAYOUTS, SYNC, Decoded, Layout, decoded

pytest.importorskip("ptufile")

CASES = Path(__file__).parents[2] / "shared" / "cases"
NAMES = {
    PICOHARP_T2: "PicoHarp 300",
    HYDRAHARP_1_T2: "HydraHarp 1",
    HYDRAHARP_T2: "HydraHarp 2",
    0x00010205: "TimeHarp 260 N",
    TIMEHARP_P_T2: "TimeHarp 260 P",
    MULTIHARP_T2: "MultiHarp",
}
each_instrument = pytest.mark.parametrize("kind", EVERY_T2, ids=NAMES.get)
_SILENCE = 1 << 32  # ticks, beyond which 32 bits lose a time


def test_every_instrument_is_here() -> None:
    assert set(LAYOUTS) == set(EVERY_T2) == set(NAMES)


# --- the records --------------------------------------------------------------------------------------------------


def literally(records: list[int], kind: int) -> Decoded:
    """One record after the other, as the maker's demonstration programs read them, in integers without an end."""
    channels, times, overflow, markers, unknown = [], [], 0, 0, 0
    for record in records:
        if kind == PICOHARP_T2:
            channel, time = record >> 28, record & 0x0FFFFFFF
            if channel != 15:
                channels.append(channel)
                times.append(overflow + time)
            elif time & 0xF == 0:
                overflow += 210698240
            else:
                markers += 1
            continue
        special, channel, time = record >> 31, record >> 25 & 0x3F, record & 0x1FFFFFF
        if not special:
            channels.append(channel)
            times.append(overflow + time)
        elif channel == 0x3F:
            if kind == HYDRAHARP_1_T2:
                overflow += 33552000
            else:
                overflow += 33554432 * (time if time else 1)
        elif channel == 0:
            channels.append(SYNC)
            times.append(overflow + time)
        elif channel <= 15:
            markers += 1
        else:
            unknown += 1
    return Decoded(np.array(channels, np.uint8), np.array(times, np.uint64), markers, unknown)


def stream(kind: int, seed: int, most: int, strange: bool = True) -> list[int]:
    """Records in time order: bursts, silences of up to `most` overflows, markers, the sync input.

    strange: with special records of an unknown kind, too.
    """
    rng = np.random.Generator(np.random.Philox(seed))
    layout, records, time = LAYOUTS[kind], [], 0
    for _ in range(400):
        time += int(rng.integers(0, layout.wrap // 3))
        if time >= layout.wrap or rng.random() < 0.1:
            time = int(rng.integers(0, 1000))
            number = int(rng.integers(1, most + 1)) if rng.random() < 0.3 else 1
            if not layout.numbered:
                of = 15 << 28 if kind == PICOHARP_T2 else t2(63, int(rng.integers(0, 1 << 25)), True)
                records += [of] * number
            else:
                records.append(t2(63, 0 if number == 1 and rng.random() < 0.5 else number, True))
        chance = rng.random()
        if kind == PICOHARP_T2:
            marker = 15 << 28 | time & ~15 | int(rng.integers(1, 16))
            records.append(marker if chance < 0.1 else int(rng.integers(0, 5)) << 28 | time)
        elif chance < 0.1:
            records.append(t2(int(rng.integers(1, 16)), time, True))
        elif chance < 0.15 and strange:
            records.append(t2(int(rng.integers(16, 63)), time, True))
        elif chance < 0.3:
            records.append(t2(0, time, True))
        else:
            records.append(t2(int(rng.integers(0, 63)), time))
    return records


def decode(records: np.ndarray, layout: Layout) -> Decoded:
    """All blocks, one after the other."""
    none = Decoded(np.zeros(0, np.uint8), np.zeros(0, np.uint64), 0, 0)
    blocks = [none, *decoded(records, layout)]
    channel, ticks = (np.concatenate([getattr(b, name) for b in blocks]) for name in ("channel", "ticks"))
    return Decoded(channel, ticks, sum(b.markers for b in blocks), sum(b.unknown for b in blocks))


@each_instrument
@pytest.mark.parametrize("seed", range(8))
def test_records_are_decoded_one_by_one(kind: int, seed: int) -> None:
    """Silences reach 2^32 ticks and more, where a product of 32 bits falls back."""
    records = stream(kind, seed, most=4000 if LAYOUTS[kind].numbered else 300)
    found, right = decode(np.array(records, np.uint32), LAYOUTS[kind]), literally(records, kind)
    assert np.array_equal(found.channel, right.channel) and np.array_equal(found.ticks, right.ticks)
    assert (found.markers, found.unknown) == (right.markers, right.unknown)
    steps = np.diff(right.ticks.astype(np.int64))
    assert steps.max() > _SILENCE and steps.min() >= 0 and right.markers
    assert kind == PICOHARP_T2 or (right.unknown and (right.channel == SYNC).any())


def test_a_long_recording_is_decoded_by_blocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Across their borders as within, and without memory for more than a block."""
    rng = np.random.Generator(np.random.PCG64(5))
    for kind in LAYOUTS:
        records = rng.integers(0, 1 << 32, 300, np.uint32)
        if not LAYOUTS[kind].special:
            records[records >> 28 > 4] |= np.uint32(15 << 28)
        whole = decode(records, LAYOUTS[kind])
        with monkeypatch.context() as small:
            small.setattr(reader, "_BLOCK", 7)
            parts = decode(records, LAYOUTS[kind])
        assert np.array_equal(whole.channel, parts.channel) and np.array_equal(whole.ticks, parts.ticks)
        assert (whole.markers, whole.unknown) == (parts.markers, parts.unknown)
    count, block = 1 << 20, 1 << 14
    (rng.integers(0, 1 << 25, count, np.uint32)).astype("<u4").tofile(tmp_path / "records")
    monkeypatch.setattr(reader, "_BLOCK", block)
    tracemalloc.start()
    for _ in decoded(reader._Records(tmp_path / "records", 0, count), LAYOUTS[MULTIHARP_T2]):
        pass
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 250 * block


@pytest.mark.parametrize("kind", [kind for kind in EVERY_T2 if LAYOUTS[kind].numbered], ids=NAMES.get)
@pytest.mark.parametrize("number", [127, 128, 129, 255, 256, 1 << 15, 1 << 20, (1 << 25) - 1])
def test_a_long_silence_in_one_record(kind: int, number: int) -> None:
    found = decode(np.array([t2(0, 3), t2(63, number, True), t2(0, 4)], np.uint32), LAYOUTS[kind])
    assert [int(ticks) for ticks in found.ticks] == [3, number * (1 << 25) + 4]


@each_instrument
def test_nothing_and_only_overflows(kind: int) -> None:
    none = 15 << 28 if kind == PICOHARP_T2 else t2(63, 1, True)
    for records in ([], [none], [none] * 5):
        assert len(decode(np.array(records, np.uint32), LAYOUTS[kind]).ticks) == 0


@each_instrument
@pytest.mark.parametrize("seed", range(3))
def test_as_ptufile_reads_it(tmp_path: Path, kind: int, seed: int) -> None:
    """Where ptufile is right: it multiplies the number of overflows in 32 bits, which 127 of them still fit, and leaves
    the channel of special records of an unknown kind undefined.
    """
    import ptufile

    records = stream(kind, seed + 100, most=127, strange=False)
    file = ptu(tmp_path / "a.ptu", records, kind, TTResult_StopAfter=10**6)
    with ptufile.PtuFile(file) as opened:
        theirs = opened.decode_records()
    theirs = theirs[theirs["channel"] >= 0]
    ours = decode(np.array(records, np.uint32), LAYOUTS[kind])
    assert np.array_equal(ours.ticks, theirs["time"])
    assert np.array_equal(np.where(ours.channel == SYNC, 0, ours.channel), theirs["channel"])  # it has one 0 for both
    one = back(run(file, Said()))
    assert one.events is not None and one.events.ticks is not None
    assert np.array_equal(np.sort(one.events.ticks), np.sort(theirs["time"]))
    used = sorted(set(map(int, ours.channel)), key=lambda c: (c != SYNC, c))  # the sync input is the first pixel
    for pixel, channel in enumerate(used):
        own = slice(*one.events.offsets[pixel : pixel + 2])
        assert np.array_equal(one.events.ticks[own], np.sort(ours.ticks[ours.channel == channel])), channel


# --- pixels -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [kind for kind in EVERY_T2 if LAYOUTS[kind].special], ids=NAMES.get)
def test_the_sync_input_is_an_input(tmp_path: Path, kind: int) -> None:
    records = [t2(0, 5, True), t2(0, 6), t2(0, 7, True), t2(2, 8), t2(1, 9, True)]
    made = run(ptu(tmp_path / "a.ptu", records, kind), Said())
    assert made.took[0].of_pixels == (2, 1, 1)
    assert made.took[0].left_out == ("1 markers, which are no detections",)
    assert any("the sync input has 2 detections and is the first pixel" in note for note in made.notes)
    assert any("channels sync, 0, 2 are the pixels, in this order" in note for note in made.notes)
    for names, totals, left in (
        (("0", "2"), (1, 1), "2 detections of the channel sync (--channels)"),
        (("2", "sync"), (1, 2), "1 detections of the channel 0 (--channels)"),
        (("sync",), (2,), "2 detections of the channels 0, 2 (--channels)"),
    ):
        (tmp_path / "".join(names)).mkdir()
        file = ptu(tmp_path / "".join(names) / "a.ptu", records, kind)
        again = run(file, Said(channels=names))
        assert again.took[0].of_pixels == totals == tuple(back(again).totals)
        assert left in again.took[0].left_out and not any("pulses of a laser" in note for note in again.notes)
    (tmp_path / "alone").mkdir()
    alone = run(ptu(tmp_path / "alone" / "a.ptu", [t2(0, 5, True), t2(0, 7, True)], kind), Said())
    assert list(back(alone).totals) == [2] and not any("laser" in note for note in alone.notes)


def test_the_sync_input_has_no_number(tmp_path: Path) -> None:
    """On a grid, where a channel's number is that of its pixel, and by --channels, where it is called sync."""
    file = ptu(tmp_path / "a.ptu", [t2(0, 5, True), t2(1, 6)])
    assert "the channel sync has no number; say with --channels sync,1" in refusal(file, Said(rows=10, columns=10))
    assert "has no channel '64'" in refusal(file, Said(channels=("64", "1")))
    assert "has no channel 'synch'; --channels names some of sync, 1" in refusal(file, Said(channels=("synch",)))


def test_a_picoharp_has_five_channels(tmp_path: Path) -> None:
    assert decode(np.array([c << 28 | 7 for c in range(5)], np.uint32), LAYOUTS[PICOHARP_T2]).channel.tolist() == [
        *range(5)
    ]
    for channel in range(5, 15):
        text = refusal(ptu(tmp_path / "a.ptu", [1 << 28, channel << 28 | 9], PICOHARP_T2), Said())
        assert f"record 1 is of channel {channel}, which is none" in text


# --- order --------------------------------------------------------------------------------------------------------


@each_instrument
def test_a_missing_overflow_is_damage(tmp_path: Path, kind: int) -> None:
    """All later times would be wrong; a little disorder between inputs is none."""
    wrap = LAYOUTS[kind].wrap

    def record(channel: int, time: int) -> int:
        return channel << 28 | time if kind == PICOHARP_T2 else t2(channel, time)

    fine = [record(1, 5000), record(2, 4000), record(1, 6000), record(2, wrap // 2 + 6000), record(1, 6000)]
    made = run(ptu(tmp_path / "a.ptu", fine, kind), Said())
    assert back(made).totals.tolist() == [3, 2]
    assert not any("fall back" in note for note in made.notes)  # within a pixel they rise
    (tmp_path / "b").mkdir()
    text = refusal(ptu(tmp_path / "b" / "a.ptu", [record(0, wrap // 2 + 6001), record(0, 6000)], kind), Said())
    assert f"fall back from {wrap // 2 + 6001:,} to 6,000 ticks at detection 1" in text and "missing" in text


def test_disorder_within_a_pixel_is_sorted_and_said(tmp_path: Path) -> None:
    made = run(ptu(tmp_path / "a.ptu", [t2(0, 9000), t2(0, 8000), t2(0, 9500)]), Said())
    one = back(made)
    assert one.events is not None and one.events.ticks is not None and one.events.ticks.tolist() == [8000, 9000, 9500]
    assert any("fall back 1 times within a pixel, by up to 1 ns; they were sorted" in note for note in made.notes)


# --- headers ------------------------------------------------------------------------------------------------------

T2_RECORDS = [t2(0, 5), t2(1, 7)]


@pytest.mark.parametrize("kind", [*EVERY_T2])
@pytest.mark.parametrize("mode", [2, 3])
def test_t3_is_refused(tmp_path: Path, kind: int, mode: int) -> None:
    """By its mode, and by the type of its records."""
    of_t3 = kind if mode == 3 else kind + 0x100
    assert "was recorded in T3 mode" in refusal(ptu(tmp_path / "a.ptu", [0, 0], of_t3, mode), Said())


@pytest.mark.parametrize("kind", [0, 0x00010208, 0x00010201, 0x01010203, 0x02010204, -1, 1.0, None])
def test_records_of_an_unknown_type_are_refused(tmp_path: Path, kind: Any) -> None:
    file = ptu(tmp_path / "a.ptu", T2_RECORDS, TTResultFormat_TTTRRecType=kind)
    text = refusal(file, Said())
    assert "which is no T2; record in T2 mode" in text or "is damaged" in text


@pytest.mark.parametrize("tick", [0, 0.0, -0.0, 5e-324, 1e-300, -1e-12, float("inf"), float("-inf"), float("nan")])
def test_a_tick_that_is_not_possible(tmp_path: Path, tick: float) -> None:
    text = refusal(ptu(tmp_path / "a.ptu", T2_RECORDS, MeasDesc_GlobalResolution=tick), Said())
    assert "says that its tick is" in text and "which is not possible" in text
    assert "leave out --tick" not in refusal(tmp_path / "a.ptu", SECOND)


def test_a_header_without_a_tick(tmp_path: Path) -> None:
    text = refusal(ptu(tmp_path / "a.ptu", T2_RECORDS, MeasDesc_GlobalResolution=None), Said())
    assert "MeasDesc_GlobalResolution" in text or "is damaged" in text


@pytest.mark.parametrize(
    ("tags", "exposure", "source"),
    [
        ({}, 2.0, "TTResult_StopAfter"),
        ({"MeasDesc_AcquisitionTime": 5000}, 2.0, "TTResult_StopAfter"),
        ({"TTResult_StopAfter": 0, "MeasDesc_AcquisitionTime": 5000}, 5.0, "MeasDesc_AcquisitionTime"),
        ({"TTResult_StopAfter": None, "MeasDesc_AcquisitionTime": 5000}, 5.0, "MeasDesc_AcquisitionTime"),
        ({"TTResult_StopAfter": -3, "MeasDesc_AcquisitionTime": 5000}, 5.0, "MeasDesc_AcquisitionTime"),
        ({"TTResult_StopAfter": 0}, None, ""),
        ({"TTResult_StopAfter": 0, "MeasDesc_AcquisitionTime": 0}, None, ""),
        ({"TTResult_StopAfter": None}, None, ""),
    ],
)
def test_how_long_it_ran(tmp_path: Path, tags: dict[str, Any], exposure: float | None, source: str) -> None:
    file = ptu(tmp_path / "a.ptu", T2_RECORDS, **tags)
    if exposure is None:
        assert '--exposure "100 ms"' in refusal(file, Said())
        exposure, source = 1.0, "--exposure"
    made = run(file, Said() if source.startswith(("TT", "Meas")) else SECOND)
    assert made.captures[0].conditions.exposure == exposure and made.took[0].sources["exposure"] == source


def test_a_time_behind_the_exposure(tmp_path: Path) -> None:
    file = ptu(tmp_path / "a.ptu", [t2(63, 100, True), t2(0, 0)], TTResult_StopAfter=3)
    assert "outside the exposure of 3 ms; if its clock does not start at 0" in refusal(file, Said())
    assert list(back(run(file, Said(exposure=4e-3))).totals) == [1]


@pytest.mark.parametrize(
    ("declared", "read", "says"), [(0, 4, "never finished"), (3, 3, "4 records follow"), (4, 4, "")]
)
def test_so_many_records_as_the_header_says(tmp_path: Path, declared: int, read: int, says: str) -> None:
    file = ptu(tmp_path / "a.ptu", [t2(0, 5 * i) for i in range(1, 5)], declared=declared)
    made = run(file, Said())
    assert list(back(made).totals) == [read]
    # four detections within 20 ps of 2 s: what follows them is a silence, which is told, too
    others = [note for note in made.notes if "nothing was recorded in the last" not in note]
    assert len(others) == len(made.notes) - 1 and (any(says in note for note in others) if says else not others)


def test_more_records_than_there_are(tmp_path: Path) -> None:
    for declared in (5, 10**12, 2**62):
        assert f"declares {declared:,} records, 2 follow" in refusal(
            ptu(tmp_path / "a.ptu", T2_RECORDS, declared=declared), Said()
        )


def test_what_is_left_of_a_file_cut_short(tmp_path: Path) -> None:
    """The number to write into the header is said, and with it the rest is read."""
    text = refusal(ptu(tmp_path / "a.ptu", T2_RECORDS, declared=5), Said())
    assert "it was cut short" in text and "write 2 into TTResult_NumberOfRecords of its header" in text
    assert back(run(ptu(tmp_path / "a.ptu", T2_RECORDS, declared=2), Said())).totals.sum() > 0


def test_overflows_beyond_64_bits(tmp_path: Path) -> None:
    records = [t2(63, (1 << 25) - 1, True)] * (1 << 14) + [t2(0, 1)]
    assert "goes round 549,755,797,504 times" in refusal(ptu(tmp_path / "a.ptu", records), Said())


# --- files with right values --------------------------------------------------------------------------------------


def of_a_case(name: str) -> Path:
    if not CASES.is_dir():
        pytest.skip("needs the small files of the cases")
    return CASES / name


def taken(tmp_path: Path, file: Path, said: Said | None = None) -> Imported:
    return import_files([file], tmp_path / "made", said or Said(), DARK)


@pytest.mark.parametrize(("name", "tick"), [("hydraharp", 1), ("multiharp", 5), ("timeharp260p", 25)])
def test_the_case_of_long_silences(tmp_path: Path, name: str, tick: int) -> None:
    folder = of_a_case("ptu-long-silence")
    one = back(taken(tmp_path, folder / f"{name}.ptu"))
    assert one.events is not None and one.events.ticks is not None
    right = np.load(folder / "right_times_ps.npy")
    assert len(right) == len(one.events) == 1000
    assert np.abs(one.events.ticks.astype(np.int64) * tick - right).max() < tick
    assert one.events.times[-1] == pytest.approx(9.998102, abs=1e-6)
    steps = np.diff(one.events.times)
    assert np.median(steps) == pytest.approx(6.5405e-3, abs=1e-7) and steps.max() == pytest.approx(80.874e-3, abs=1e-6)


def test_the_case_of_ten_hours(tmp_path: Path) -> None:
    file = of_a_case("ptu-10-hours") / "night.ptu"
    one = back(taken(tmp_path, file))
    assert one.events is not None and len(one.events) == 39 and one.conditions.exposure == 36000
    assert one.events.times[0] == pytest.approx(900, abs=1e-3)
    np.testing.assert_allclose(np.diff(one.events.times), 900, atol=1e-3)
    assert "outside the exposure of 3600 s" in not_taken(tmp_path, file, Said(exposure=3600.0))


def not_taken(tmp_path: Path, file: Path, said: Said) -> str:
    with pytest.raises(SpadError) as caught:
        import_files([file], tmp_path / "refused", said, DARK)
    assert not (tmp_path / "refused" / "measurement.yaml").exists()
    return str(caught.value)


@pytest.mark.parametrize("name", ["interrupted.ptu", "short.hdf5"])
def test_the_case_of_a_recording_that_broke_off(tmp_path: Path, name: str) -> None:
    file = of_a_case("ptu-interrupted") / name
    made = taken(tmp_path, file)
    assert any("nothing was recorded in the last 401 ms of 1 s" in note for note in made.notes)
    again = measurement.open(taken(tmp_path / "again", file, Said(exposure=598.984e-3 + 1e-6)).folder)
    one = again.recording(again.captures[0].id)
    assert one.totals.sum() / one.conditions.exposure == pytest.approx(20034, abs=1)


@pytest.mark.parametrize(("name", "totals"), [("hbt", [80, 120]), ("single", [80])])
def test_the_case_of_the_sync_input(tmp_path: Path, name: str, totals: list[int]) -> None:
    assert list(back(taken(tmp_path, of_a_case("ptu-sync-is-a-detector") / f"{name}.ptu")).totals) == totals


@pytest.mark.parametrize("name", ["zero", "nan", "tiny", "negative", "infinite"])
def test_the_case_of_ticks(tmp_path: Path, name: str) -> None:
    text = not_taken(tmp_path, of_a_case("ptu-tick-0") / f"{name}.ptu", Said())
    assert "says that its tick is" in text and "which is not possible" in text


def change_bytes(path: Path, at: bytes, offset: int, value: bytes) -> None:
    data = bytearray(path.read_bytes())
    start = data.index(at.ljust(32, b"\0")) + offset
    data[start : start + len(value)] = value
    path.write_bytes(data)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda p: change_bytes(p, b"TTResult_NumberOfRecords", 40, struct.pack("<q", -5)), ""),
        (lambda p: change_bytes(p, b"Header_End", 0, b"Header_Eng"), "is damaged"),
        (lambda p: change_bytes(p, b"MeasDesc_GlobalResolution", 36, struct.pack("<I", 0x4001FFFF)), "is damaged"),
    ],
)
def test_damaged_headers(tmp_path: Path, change: Callable[[Path], None], says: str) -> None:
    file = ptu(tmp_path / "a.ptu", T2_RECORDS)
    change(file)
    if says:
        assert says in refusal(file, Said())
    else:
        assert any("never finished" in note for note in run(file, replace(Said())).notes)
