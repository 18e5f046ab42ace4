"""What a file says unlike a plan, a user or itself: taken and said, or refused; never silently another value."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from importfiles import CLOCK, SECOND, back, hdf5, matlab, refusal, run, save

from spadmnist import measurement
from spadmnist.errors import SpadError
from spadmnist.importers import Said
from spadmnist.importers.captures import Imported, import_files
from spadmnist.importers.lights import light

PLAN = """\
format: spadmnist-measurement/1
layout: {rows: 1, columns: 2}
captures:
  - {id: dark, modality: tr, light: {kind: dark}, exposure: 2 ms}
  - {id: flat, modality: tr, light: {kind: flat, wavelength: 500 nm}, exposure: 2 ms}
  - {id: bright, modality: tr, light: {kind: flat, wavelength: 500 nm, irradiance: 1 nW/cm^2}, exposure: 2 ms}
"""


def plan(folder: Path, text: str = PLAN) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "measurement.yaml").write_text(text)
    return folder


def table(path: Path, *rows: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("pixel,time (ns)\n" + "".join(f"{row}\n" for row in rows))
    return path


def fill(lab: Path, *files: Path, ids: tuple[str, ...] = ()) -> Imported:
    return import_files(list(files), lab, Said(), ids=ids)


def files_of(lab: Path) -> dict[str, bytes]:
    return {str(path.relative_to(lab)): path.read_bytes() for path in lab.rglob("*") if path.is_file()}


# --- plans --------------------------------------------------------------------------------------------------------


def test_a_file_of_a_capture_that_is_there_is_no_other_capture(tmp_path: Path) -> None:
    lab, flat = plan(tmp_path / "lab"), table(tmp_path / "flat.csv", "0,1999999", "1,5")
    assert fill(lab, flat).missing == ("dark", "bright")
    before = files_of(lab)
    made = fill(lab, flat)  # again: nothing changes
    assert [one.id for one in made.captures] == ["flat"] and made.missing == ("dark", "bright")
    assert files_of(lab) == before
    dark = table(tmp_path / "dark.csv", "1,7")
    assert fill(lab, dark, flat).missing == ("bright",)  # again for what is missing
    with pytest.raises(SpadError, match="flat has other data already"):
        fill(lab, table(tmp_path / "new" / "flat.csv", "0,8"))
    with pytest.raises(SpadError, match=r"x\.csv, y\.csv: not named as a capture is, and 1 capture is missing"):
        fill(lab, table(tmp_path / "x.csv", "0,8"), table(tmp_path / "y.csv", "0,8"))


def test_an_exact_name_comes_first(tmp_path: Path) -> None:
    text = PLAN.replace("id: dark", "id: a b").replace("id: flat", "id: a_b")
    lab = plan(tmp_path / "lab", text)
    assert [one.id for one in fill(lab, table(tmp_path / "a b.csv", "0,1")).captures] == ["a b"]
    assert [one.id for one in fill(lab, table(tmp_path / "a_b.csv", "0,2")).captures] == ["a_b"]
    with pytest.raises(SpadError, match="may be the capture a b or a_b; say which it is with --capture"):
        fill(lab, table(tmp_path / "A_B.csv", "0,2"))
    with pytest.raises(SpadError, match="is the capture bright by its name, and so is another file"):
        fill(lab, table(tmp_path / "bright.csv", "0,1"), table(tmp_path / "x" / "bright.csv", "0,1"))


def test_a_refused_import_leaves_the_plan_as_it_was(tmp_path: Path) -> None:
    lab = plan(tmp_path / "lab")
    before = files_of(lab)
    flat = table(tmp_path / "flat.csv", "0,1999999")
    with pytest.raises(SpadError, match="outside the exposure"):
        fill(lab, flat, table(tmp_path / "dark.csv", "1,2000001"))
    assert files_of(lab) == before and sorted(path.name for path in lab.iterdir()) == ["measurement.yaml"]
    assert fill(lab, flat, table(tmp_path / "dark.csv", "1,7")).missing == ("bright",)


@pytest.mark.parametrize(
    ("facts", "id", "says"),
    [
        ({"lux": 5.0, "relative_uncertainty": 0.1}, "dark", "light is dark, but .* was recorded in light"),
        ({"lux": 5.0, "relative_uncertainty": 0.1}, "bright", "irradiance is 1 nW/cm.2, but .* gives lux: 5 lux"),
    ],
)
def test_a_light_unlike_the_plan(tmp_path: Path, facts: dict[str, float], id: str, says: str) -> None:
    np.savez(tmp_path / "a.npz", time=[5, 3], pixel=[0, 1], tick=1e-9, **facts)
    with pytest.raises(SpadError, match=says):
        fill(plan(tmp_path / "lab"), tmp_path / "a.npz", ids=(id,))


# --- lights -------------------------------------------------------------------------------------------------------


def stamps(path: Path, **facts: Any) -> Path:
    np.savez(path, time=[5, 3], pixel=[0, 1], **{"tick": 1e-9, "exposure": 1e-3, **facts})
    return path


def test_lux_without_a_wavelength_are_green(tmp_path: Path) -> None:
    made = run(stamps(tmp_path / "a.npz", lux=5.0, relative_uncertainty=0.02), Said(), [])
    lit = made.captures[0].light
    assert (lit.wavelength, lit.level, lit.kind_of_level, lit.relative_uncertainty) == (555e-9, 5.0, "lux", 0.02)
    assert "lux: 5 lux" in (made.folder / "measurement.yaml").read_text()


def test_a_level_without_an_uncertainty_is_good_to_5_percent(tmp_path: Path) -> None:
    made = run(stamps(tmp_path / "a.npz", wavelength=500e-9, irradiance=1e-3), Said(), [])
    assert made.captures[0].light.relative_uncertainty == 0.05
    assert any("as good to 5.0 %" in note for note in made.notes)


@pytest.mark.parametrize(
    ("facts", "says"),
    [
        ({"irradiance": 1e-3, "relative_uncertainty": 0.1}, "gives an irradiance and no wavelength; add --light"),
        ({"irradiance": 1e-3, "lux": 5.0, "wavelength": 5e-7}, "as lux and as irradiance; keep one"),
    ],
)
def test_what_is_no_light(tmp_path: Path, facts: dict[str, float], says: str) -> None:
    assert says in refusal(stamps(tmp_path / "a.npz", **facts), Said(), [])


@pytest.mark.parametrize("text", ["500 m free", "500 mm 5 lux", "1 nm free"])
def test_a_wavelength_that_is_none(text: str) -> None:
    with pytest.raises(SpadError, match="has a wavelength that is none of light, which is 10 nm to 100 um"):
        light(text)


def made_in(folder: Path, name: str) -> Path:
    """A folder of its own."""
    (folder / name).mkdir()
    return folder / name


# --- what the user says and the file says otherwise ---------------------------------------------------------------


def test_another_clock_than_the_file_says_is_said(tmp_path: Path) -> None:
    np.savez(tmp_path / "q.npz", frames=np.ones((3, 2, 2), np.uint8), frame_time=2e-5, frame_period=2e-5)
    made = run(tmp_path / "q.npz", CLOCK)
    assert any("says that its frame_time is 20 us; --frame-time is taken, 10 us" in note for note in made.notes)
    made = run(stamps(made_in(tmp_path, "b") / "a.npz"), SECOND)
    assert any("says that its exposure is 1 ms; --exposure is taken, 1 s" in note for note in made.notes)
    made = run(stamps(made_in(tmp_path, "c") / "a.npz", wavelength=5e-7, irradiance=1e-3), SECOND)
    assert any("says that its light is 500 nm, 100 nW/cm^2; --light is taken" in note for note in made.notes)
    same = stamps(made_in(tmp_path, "d") / "a.npz", exposure=1.0, relative_uncertainty=0)
    assert not [note for note in run(same, SECOND).notes if "taken" in note]


@pytest.mark.parametrize(
    ("facts", "said", "says"),
    [
        ({"counting": "Counter", "bits": 8}, Said(), "its counting is 'Counter'; it is frames or counter"),
        ({"counting": "x", "bits": 8}, Said(), "it is frames or counter"),
        ({"modality": "counts", "bits": 8}, Said(modality="qis"), "its modality is counts; leave out --modality"),
        ({"modality": "str", "tick": 1e-7}, Said(bits=8), "its modality is str, which has no --bits"),
        ({"modality": "tr"}, Said(), "its modality is tr, but holds frames"),
        ({"modality": "photons"}, Said(), "its modality is 'photons'; it is one of"),
    ],
)
def test_words_of_a_file(tmp_path: Path, facts: dict[str, Any], said: Said, says: str) -> None:
    clock = {"frame_time": 1e-5, "frame_period": 1e-5}
    path = hdf5(tmp_path / "a.h5", {**facts, **clock}, frames=np.ones((3, 2, 2), np.uint8))
    assert says in refusal(path, said)


def test_a_counter_is_one(tmp_path: Path) -> None:
    facts = {"counting": "counter", "bits": 8, "frame_time": 1e-5, "frame_period": 1e-5}
    path = hdf5(tmp_path / "a.h5", facts, frames=np.ones((3, 2, 2), np.uint8))
    assert run(path, Said()).captures[0].conditions.exposure == pytest.approx(30e-6)


def test_many_bits_make_many_frames(tmp_path: Path) -> None:
    """15,260 counts of 16 bits are sums of 10^9 binary frames; what is made can be opened."""
    path = save(tmp_path / "c.npy", np.ones((15260, 1, 2), np.uint16))
    made = run(path, Said(frame_time=1e-5, frame_period=1e-5, bits=16))
    assert back(made).conditions.frames == 15260 * 65535


# --- counters that began anew -------------------------------------------------------------------------------------


@pytest.mark.parametrize("bits", [16, 24, 32])
@pytest.mark.parametrize("grouped", [False, True])
def test_a_counter_that_began_anew_is_refused(tmp_path: Path, bits: int, grouped: bool) -> None:
    rng = np.random.default_rng(bits)
    time, pixel = np.sort(rng.integers(0, 5 << bits, 2000)), rng.integers(0, 3, 2000)
    if grouped:
        order = np.argsort(pixel, kind="stable")
        time, pixel = time[order], pixel[order]
    np.savez(tmp_path / "a.npz", time=time % (1 << bits), pixel=pixel, tick=1e-9)
    exposure = (5 << bits) * 1e-9
    assert f"of what {bits} bits count" in refusal(tmp_path / "a.npz", Said(exposure=exposure))
    np.savez(tmp_path / "whole.npz", time=time, pixel=pixel, tick=1e-9)
    assert back(run(tmp_path / "whole.npz", Said(exposure=exposure))).totals.sum() == 2000


@pytest.mark.slow
def test_times_in_any_order_are_no_counter(tmp_path: Path) -> None:
    """Shuffled, or pixel after pixel: they fill 2^16 ticks and are sorted, as ever."""
    rng = np.random.default_rng(5)
    time, pixel = rng.integers(0, 1 << 16, 3000), rng.integers(0, 3, 3000)
    order = np.lexsort((time, pixel))
    for name, some in (("shuffled", slice(None)), ("grouped", order)):
        path = made_in(tmp_path, name) / "a.npz"
        np.savez(path, time=time[some], pixel=pixel[some], tick=1e-9)
        assert back(run(path, Said(exposure=1e-3))).totals.sum() == 3000


# --- sentences ----------------------------------------------------------------------------------------------------


def test_frames_without_pixels(tmp_path: Path) -> None:
    for shape in ((3, 0, 8), (3, 2, 0)):
        assert "store frames that have pixels" in refusal(save(tmp_path / "z.npy", np.zeros(shape, np.uint8)), CLOCK)


def test_a_time_just_behind_the_exposure_is_told_from_it(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", time=[5, 2_000_000_000_001], pixel=[0, 0], tick=1e-12)
    assert "reach from 5 ps to 2.000000000001 s, outside the exposure of 2 s" in refusal(
        tmp_path / "a.npz", Said(exposure=2.0)
    )


def test_a_matlab_stack_needs_no_axes(tmp_path: Path) -> None:
    path = matlab(tmp_path / "a.mat", frames=np.ones((2, 8, 3)))
    assert not any("--axes HWM" in note for note in run(path, CLOCK).notes)


def test_positions_of_a_plan_are_called_the_plans(tmp_path: Path) -> None:
    lab = tmp_path / "lab"
    lab.mkdir()
    (lab / "p.csv").write_text("x,y\n0,0\n10,0\n20,0\n")
    (lab / "measurement.yaml").write_text(
        "format: spadmnist-measurement/1\nlayout: {positions: p.csv}\ncaptures:\n  - {id: a, modality: qis, frames: 3, "
        "frame_time: 1 us, light: {kind: dark}}\n"
    )
    with pytest.raises(SpadError, match=r"the plan: names 3 pixels, but .*a.npy has 2 x 2"):
        fill(lab, save(tmp_path / "a.npy", np.ones((3, 2, 2), np.uint8)))
    assert measurement.open(lab, planned=True).missing == ("a",)


def test_times_behind_an_empty_word(tmp_path: Path) -> None:
    """In a list of LinoSPAD2 all times come first: with another number of words to a list they do not."""
    words = np.zeros((4, 65, 8), "<u4")
    words[:, 3, :3] = 1 << 31 | np.arange(3)
    path, again = made_in(tmp_path, "a") / "a.dat", made_in(tmp_path, "b") / "a.dat"
    path.write_bytes(words.tobytes())
    again.write_bytes(words.tobytes())
    said = Said(firmware="2212b", timestamps=8, cycle=4e-3)
    assert back(run(path, said)).totals.sum() == 12
    assert "give another --timestamps or --firmware" in refusal(again, replace(said, timestamps=32))


@pytest.mark.parametrize("name", [" a ", "a\nb", "x" * 101, "‮a", ""])
def test_a_name_that_cannot_be_read_again_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(SpadError, match=r"--name: .* is not a name: a line of 1 to 100 characters"):
        run(table(tmp_path / "a.csv", "0,1"), SECOND, name=name)


def test_decimals_are_rounded_once(tmp_path: Path) -> None:
    """Beyond 4096 s a double of seconds does not tell the ps."""
    times = ["9000.000000000001", "9000.0000000000024", "4503.599627370497", "0.0000000000005001", "8e3"]
    path = tmp_path / "a.csv"
    path.write_text("time (s);pixel\n\n" + "".join(f"{time.replace('.', ',')};0\n" for time in times))
    events = back(run(path, Said(exposure=9001.0))).events
    assert events is not None and events.ticks is not None
    assert [int(t) for t in events.ticks] == [1, 4503599627370497, 8 * 10**15, 9 * 10**15 + 1, 9 * 10**15 + 2]
    path.write_text("pixel\ttime (ns)\tfine (ps)\n0\t9000000000000\t1\n")
    again = made_in(tmp_path, "b") / "a.csv"
    again.write_text(path.read_text())
    events = back(run(again, Said(exposure=9001.0))).events
    assert events is not None and events.ticks is not None and int(events.ticks[0]) == 9 * 10**15 + 1


def test_channels_of_a_file_that_says_how_many_there_are(tmp_path: Path) -> None:
    """Those that are chosen are the pixels, as 1 x n or as the user says; the others are left out, and said."""
    time, pixel = np.array([5, 3, 9, 2]), np.array([0, 1, 2, 2])
    for name, more, shape in (("a", {}, (1, 2)), ("b", {"rows": 2, "columns": 1}, (2, 1))):
        path = made_in(tmp_path, name) / "a.npz"
        np.savez(path, time=time, pixel=pixel, tick=1e-9, rows=1, columns=3)
        made = run(path, replace(SECOND, channels=("2", "0"), **more))
        assert made.took[0].shape == shape and made.took[0].of_pixels == (2, 1)
        assert made.took[0].left_out == ("1 detections of the channel 1 (--channels)",)


def test_raw_frames_that_begin_as_gzip(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    path.write_bytes(b"\x1f\x8b\x08" + bytes(13))
    made = run(path, replace(CLOCK, rows=2, columns=8))
    assert any("begins as a file that gzip packed" in note for note in made.notes)
