"""What a file says of itself is what it is taken for: its modality, how it counts, its ticks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from importfiles import DARK, back, hdf5, refusal, run

from spadmnist import measurement
from spadmnist.errors import SpadError
from spadmnist.importers import Said
from spadmnist.importers.captures import import_files

BITS = np.random.Generator(np.random.Philox(5)).integers(0, 2, (30, 2, 3)).astype(np.uint8)
TWO_BITS = np.random.Generator(np.random.Philox(6)).integers(0, 3, (30, 2, 3)).astype(np.uint8)
TIMES = {"frame_time": 1e-6, "frame_period": 1e-6}
NOTHING = Said()


def stated(folder: Path, kind: str, array: np.ndarray, **facts: Any) -> Path:
    """Frames with what they say of themselves, as attributes or as members."""
    path = folder / f"a.{kind}"
    if kind == "h5":
        return hdf5(path, {**TIMES, **facts}, frames=array)
    np.savez(path, frames=array, **TIMES, **facts)
    return path


both = pytest.mark.parametrize("kind", ["h5", "npz"])


# --- the modality -------------------------------------------------------------------------------------------------


@both
@pytest.mark.parametrize(
    ("array", "facts", "said", "says"),
    [
        (BITS, {"modality": "qis", "tick": 1e-9}, NOTHING, "its modality is qis and its tick 1e-09, which only tr and"),
        (BITS, {"modality": "str"}, NOTHING, "does not say the length of a tick; add --tick"),
        (BITS, {"modality": "str", "tick": 1e-9, "bits": 4}, NOTHING, "is str and its bits 4, which only counts have"),
        (BITS, {"modality": "counts"}, NOTHING, "does not say how many bits a count has; add --bits"),
        (BITS, {"modality": "counts", "counting": "counter"}, NOTHING, "how many bits a count has; add --bits"),
        (BITS * 255, {"counting": "counter"}, NOTHING, "how many bits a count has; add --bits"),
        (TWO_BITS, {"modality": "qis", "bits": 2}, NOTHING, "its modality is qis and its bits 2, which only counts"),
        (BITS, {"modality": "qis", "counting": "counter"}, NOTHING, "its counting counter, which only counts have"),
        (BITS, {"modality": "qis"}, Said(modality="counts", bits=2), "its modality is qis; leave out --modality"),
        (BITS, {"modality": "qis"}, Said(bits=2), "its modality is qis, which has no --bits; leave it out"),
        (BITS, {"tick": 1e-9}, NOTHING, "all its numbers are 0 and 1 (or 255); say with --modality"),
        (BITS, {"tick": 1e-9, "bits": 4}, NOTHING, "its bits, as of counts, and its tick, as of str; say with"),
        (BITS, {"modality": "counts", "bits": 8, "width": 20}, NOTHING, "but holds packed bits, which are qis"),
        (BITS, {"modality": "photons"}, NOTHING, "its modality is 'photons'; it is one of tr, str, qis or counts"),
        (BITS, {"modality": "tr"}, NOTHING, "its modality is tr, but holds frames; correct it"),
        (BITS, {"counting": "photons", "bits": 2}, NOTHING, "its counting is 'photons'; it is frames or counter"),
        (BITS, {"bits": 2, "counting": "counter", "counter": 0}, NOTHING, "is counter, and that it is frames; keep"),
        (BITS, {"bits": 2, "counting": "counter"}, Said(counting="frames"), "is counter; leave out --counting"),
    ],
)
def test_what_contradicts_or_is_missing(
    tmp_path: Path, kind: str, array: np.ndarray, facts: dict[str, Any], said: Said, says: str
) -> None:
    assert says in refusal(stated(tmp_path, kind, array, **facts), said)


@both
@pytest.mark.parametrize(
    ("array", "facts", "said", "modality"),
    [
        (BITS, {"modality": "qis", "bits": 1}, NOTHING, "qis"),
        (BITS, {"modality": "qis", "tick": 1e-9}, Said(modality="qis"), "qis"),
        (BITS, {"modality": "str", "tick": 1e-7}, NOTHING, "str"),
        (BITS, {"modality": "str"}, Said(tick=1e-7), "str"),
        (BITS, {"modality": "counts"}, Said(bits=2), "counts"),
        (TWO_BITS, {"modality": "counts", "bits": 2, "counting": "counter"}, NOTHING, "counts"),
        (BITS, {"tick": 1e-7}, Said(modality="str"), "str"),
        (TWO_BITS, {"tick": 1e-7}, NOTHING, "str"),
        (TWO_BITS, {"bits": 2}, NOTHING, "counts"),
    ],
)
def test_what_a_file_is_taken_for(
    tmp_path: Path, kind: str, array: np.ndarray, facts: dict[str, Any], said: Said, modality: str
) -> None:
    made = run(stated(tmp_path, kind, array, **facts), said)
    assert made.captures[0].modality == modality
    assert made.captures[0].conditions.counting == facts.get("counting", "frames")
    assert np.array_equal(measurement.open(made.folder)["a"].frames, array)


@both
@pytest.mark.parametrize("modality", ["tr", "qis"])
def test_a_file_of_detections_and_frames_says_which_are_meant(tmp_path: Path, kind: str, modality: str) -> None:
    time = {"time": np.array([5, 7], np.uint32), "pixel": np.array([0, 1], np.uint8)}
    facts = {"modality": modality, "exposure": 1e-3, **({"tick": 1e-9} if modality == "tr" else {})}
    if kind == "h5":
        path = hdf5(tmp_path / "a.h5", {**TIMES, **facts}, frames=BITS, **time)
    else:
        path = stated(tmp_path, "npz", BITS, **time, **facts)
    assert run(path, NOTHING).captures[0].modality == modality


PLAN = """format: spadmnist-measurement/1
layout: {rows: 2, columns: 3}
captures:
  - {id: a, modality: MODALITY, frames: 30, frame_time: 1 us, light: {kind: dark}}
"""


@both
@pytest.mark.parametrize(
    ("planned", "facts", "says"),
    [
        ("qis", {"modality": "counts", "bits": 1}, "modality is qis, but {} says counts"),
        ("str", {"modality": "qis", "tick": 1e-9}, "modality is str, but {} says qis"),
        ("counts, bits: 4", {"modality": "qis"}, "modality is counts, but {} says qis"),
        ("counts, bits: 4, counting: counter", {"bits": 4, "counting": "frames"}, "counting is counter, but {} says"),
    ],
)
def test_a_plan_that_says_otherwise_is_named(
    tmp_path: Path, kind: str, planned: str, facts: dict[str, Any], says: str
) -> None:
    lab = tmp_path / "lab"
    lab.mkdir()
    (lab / "measurement.yaml").write_text(PLAN.replace("MODALITY", planned))
    path = stated(tmp_path, kind, BITS, **facts)
    with pytest.raises(SpadError) as caught:
        import_files([path], lab, NOTHING)
    assert str(caught.value).startswith(f"{lab / 'measurement.yaml'}:4: captures[0]: {says.format(path)}")
    assert "--modality" not in str(caught.value)


# --- attributes ---------------------------------------------------------------------------------------------------


def test_what_a_file_says_twice_is_said_once(tmp_path: Path) -> None:
    """Importing and opening look at the same places; what they say alike is no contradiction."""
    facts = {"tick": 1e-9, "exposure": 1e-3}
    path = hdf5(tmp_path / "a.h5", facts, time=np.array([5, 7], np.uint32), pixel=np.array([0, 1], np.uint8))
    lab = PLAN.replace("MODALITY", "tr").replace("frames: 30, frame_time: 1 us", "file: a.h5, exposure: 1 ms")
    (tmp_path / "measurement.yaml").write_text(lab)
    for tick in (1e-9, 1e-10):
        with h5py.File(path, "a") as file:
            file["time"].attrs["tick"] = tick
        if tick == 1e-9:
            assert measurement.open(tmp_path).recording("a").tick == 1e-9
            assert back(import_files([path], tmp_path / "one", NOTHING, DARK)).tick == 1e-9
    says = "says its tick twice, 1e-09 (the file) and 1e-10 (time); keep one of them"
    assert says in refusal(path, NOTHING)
    with pytest.raises(SpadError) as caught:
        measurement.open(tmp_path)
    assert says in str(caught.value)


def test_a_modality_on_the_frames_is_heard_where_a_measurement_is_opened(tmp_path: Path) -> None:
    path = hdf5(tmp_path / "a.h5", {}, frames=BITS)
    with h5py.File(path, "a") as file:
        file["frames"].attrs["modality"] = "counts"
    text = PLAN.replace("MODALITY", "qis, file: a.h5")
    (tmp_path / "measurement.yaml").write_text(text)
    with pytest.raises(SpadError, match="says that it is 'counts', but the capture a is 'qis'"):
        measurement.open(tmp_path)


@pytest.mark.parametrize(
    ("tick", "says"),
    [
        (h5py.Empty("f8"), "the attribute tick is not one number or one text; write it as that"),
        ("1 ns", "says that its tick is '1 ns', which is not possible; it is a number of seconds from 1e-18 to 1e+18"),
        (1e30, "it is a number of seconds from 1e-18 to 1e+18, 1e-9 for example"),
    ],
)
def test_an_attribute_that_is_no_number(tmp_path: Path, tick: Any, says: str) -> None:
    path = hdf5(tmp_path / "a.h5", {"tick": tick}, time=np.array([5], np.uint32), pixel=np.array([0], np.uint8))
    assert says in refusal(path)


# --- archives -----------------------------------------------------------------------------------------------------


def test_members_that_say_nothing_are_named(tmp_path: Path) -> None:
    made = run(stated(tmp_path, "npz", BITS, temperature=21.0, tiick=1e-9), NOTHING)
    assert any("holds temperature, tiick as well, which was not read" in note for note in made.notes)
    assert not run(stated(tmp_path, "npz", BITS, modality="qis"), NOTHING).notes


@pytest.mark.parametrize("value", [3, np.array(["qis", "qis"]), "q" * 5000, np.array([{}], object)])
def test_a_member_that_is_no_word(tmp_path: Path, value: Any) -> None:
    says = "its modality is no word; store one of tr, str, qis, counts"
    assert says in refusal(stated(tmp_path, "npz", BITS, modality=value), NOTHING)


# --- groups -------------------------------------------------------------------------------------------------------


def grouped(path: Path) -> Path:
    with h5py.File(path, "w") as file:
        file["run/2/time"], file["run/2/pixel"] = np.array([5, 7, 9], np.uint32), np.array([0, 1, 1], np.uint8)
        file["run/2"].attrs["tick"] = 1e-9
    return path


def test_a_group_of_time_stamps(tmp_path: Path) -> None:
    made = run(grouped(tmp_path / "a.h5"), Said(dataset="/run/2", exposure=1e-3))
    assert list(back(made).totals) == [1, 2] and back(made).tick == 1e-9


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("run/2/time", "of time stamps name the group that holds time and pixel"),
        ("run/2/frames", "has no data set run/2/frames; there is pixel, time"),
        ("run", "has no data set run/frames; there is 2 (--dataset names one of frames, or a group of time and pixel)"),
        ("no/such", "has no data set no/such; there is nothing"),
    ],
)
def test_a_data_set_that_is_not_there(tmp_path: Path, name: str, says: str) -> None:
    assert says in refusal(grouped(tmp_path / "a.h5"), Said(dataset=name))


def test_frames_that_last_too_long(tmp_path: Path) -> None:
    says = "30 frames with a period of 1e+18 s last more than 1e+18 s; correct --frame-period"
    assert says in refusal(stated(tmp_path, "h5", BITS), Said(frame_period=1e18))


# --- one recording, one capture -----------------------------------------------------------------------------------


def test_a_file_is_one_capture(tmp_path: Path) -> None:
    path = stated(tmp_path, "h5", BITS)
    (tmp_path / "link.h5").symlink_to("a.h5")
    (tmp_path / "hard.h5").hardlink_to(path)
    for other in (path, tmp_path / "." / "a.h5", tmp_path / "x" / ".." / "a.h5", tmp_path / "link.h5"):
        (tmp_path / "x").mkdir(exist_ok=True)
        assert f"{other}: is the same file as {path}, and a recording is one capture; name it once" in refusal(
            [path, other], NOTHING
        )
    for other in ("./a.h5", "link.h5", "hard.h5"):
        entry = PLAN[PLAN.index("  - ") :]
        text = PLAN.replace("MODALITY", "qis, file: a.h5")
        (tmp_path / "measurement.yaml").write_text(
            text + entry.replace("id: a", "id: b").replace("MODALITY", f"qis, file: {other}")
        )
        with pytest.raises(SpadError) as caught:
            measurement.open(tmp_path)
        says = f"measurement.yaml:5: captures[1].file: {other} is the same file as a.h5, that of captures[0]; give each"
        assert says in str(caught.value)
