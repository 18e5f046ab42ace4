"""No option of `import` is ever ignored: it changes what is written, or is refused, or repeats what the file says."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from importfiles import CLOCK, DARK, SAMPLES, SECOND, Sample, bits, every_sample, hdf5, made_of, ptu, save, t2

from spadmnist import import_options, importers, recording
from spadmnist.errors import SpadError
from spadmnist.import_options import options, word
from spadmnist.importers import Said
from spadmnist.importers.captures import import_files
from spadmnist.recording import Light

LIT = [Light(500e-9, 2e-3, "irradiance", 0.05)]


def kinds() -> list[type[importers.Format]]:
    return [kind for kind in importers.formats() if kind.__module__.startswith("spadmnist.")]


# --- the table ----------------------------------------------------------------------------------------------------


def test_what_options_are_for_is_what_kinds_take() -> None:
    owned = {option.own for option in options().values() if option.own}
    taken = {own for kind in kinds() for own in kind.takes}
    assert owned == taken
    assert import_options.MODALITIES == recording.MODALITIES
    for name, option in options().items():
        assert set(option.modalities) <= set(recording.MODALITIES) and option.about, name
        shown = import_options.about(option)
        assert option.own[1:] in shown and option.about in shown, name
        # an option of only some kinds is of use to each of them
        for kind in kinds():
            if option.own in kind.takes:
                assert set(option.modalities) & set(kind.modalities), (name, kind)


def test_there_is_a_sample_of_every_kind_and_modality() -> None:
    assert {(s.kind, s.modality) for s in SAMPLES} == {(k.__name__, m) for k in kinds() for m in k.modalities}


@every_sample
def test_a_sample_is_what_it_says(tmp_path: Path, sample: Sample) -> None:
    file = made_of(sample, tmp_path)
    assert importers.recognise(file).__name__ == sample.kind
    made = import_files([file], tmp_path / "made", sample.said, DARK)
    assert made.captures[0].modality == sample.modality and made.took[0].detections > 0


# --- the property -------------------------------------------------------------------------------------------------


@functools.cache
def _files(folder: Path) -> dict[str, Path]:
    """Files that options name."""
    ends = np.linspace(0, 2500, 141)[1:] * np.ones((256, 1)) * 0.99
    head = "," + ",".join(map(str, range(140)))
    np.savetxt(folder / "tdc.csv", np.c_[np.arange(256), ends], delimiter=",", header=head, comments="")
    np.save(folder / "offsets.npy", np.full(256, 30.0))
    (folder / "places.csv").write_text("x,y\n" + "".join(f"{23 * i},0\n" for i in range(3)))
    return {name: folder / file for name, file in (
        ("tdc", "tdc.csv"), ("offsets", "offsets.npy"), ("positions", "places.csv")
    )}  # fmt: skip


# two values of each option that is no choice and no file; at most one of them may repeat what a file says
VALUES: dict[str, tuple[Any, ...]] = {
    "relative_uncertainty": (0.125, 0.25),
    "rows": (3, 7),
    "columns": (11, 40),
    "channels": (("1",), ("2", "0")),
    "exposure": (3.0, 4.0),
    "subtract_start": (True,),
    "tick": (1e-9, 3e-9),
    "frames": (20, 7),
    "frame_time": (5e-6, 7e-6),
    "frame_period": (11e-6, 13e-6),
    "bits": (5, 12),
    "packed": (True,),
    "dataset": ("frames", "another"),
    "timestamps": (2, 7),
    "cycle": (5e-3, 7e-3),
}


# what they say of a file may not fit its size or its numbers: then it may be these that the sentence is of
BY_CONSEQUENCE = ("modality", "packed", "frame_time", "firmware", "positions")


def values(name: str, folder: Path) -> tuple[Any, ...]:
    option = options()[name]
    return (_files(folder)[name],) if option.path else option.choices or VALUES[name]


def outcome(sample: Sample, file: Path, said: Said, lights: Any, out: Path) -> dict[str, bytes] | str:
    """What is written, by file, or the sentence of a refusal."""
    try:
        import_files([file], out, said, lights)
    except SpadError as error:
        assert "\n" not in str(error)
        return str(error)
    return {path.name: path.read_bytes() for path in sorted(out.iterdir())}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("options")


@functools.cache
def without(sample: Sample, folder: Path, lit: bool) -> dict[str, bytes] | str:
    file = made_of(sample, folder / sample.name)
    return outcome(sample, file, sample.said, LIT if lit else DARK, folder / sample.name / f"without{lit}")


def check(sample: Sample, name: str, folder: Path, lit: bool) -> None:
    before = without(sample, folder, lit)
    assert isinstance(before, dict), before
    file, silent = folder / sample.name / sample.name, []
    for n, value in enumerate(values(name, folder)):
        said = replace(sample.said, **{name: value})
        after = outcome(sample, file, said, LIT if lit else DARK, folder / sample.name / f"{name}{n}{lit}")
        if isinstance(after, str):
            named = word(name) in after or str(value) in after
            assert named or name in BY_CONSEQUENCE, f"{value}: a refusal that does not name it: {after}"
        elif after == before and getattr(sample.said, name) != value:
            silent.append(value)
    # what has no effect repeats what the file says: then any other value has one
    if name == "packed":
        assert not silent or sample.packed
    else:
        assert len(silent) <= (0 if len(values(name, folder)) == 1 else 1), silent
        if silent:
            assert name in ("rows", "columns", "frames", "modality", "axes", "tick", "bits", "counting", "bit_order",
                            "dataset"), silent  # fmt: skip


@every_sample
@pytest.mark.parametrize("name", options())
def test_no_option_is_ignored(sample: Sample, name: str, folder: Path) -> None:
    check(sample, name, folder, lit=name == "relative_uncertainty")


@every_sample
def test_an_uncertainty_belongs_to_a_light(tmp_path: Path, sample: Sample) -> None:
    said = replace(sample.said, relative_uncertainty=0.1)
    assert "--relative-uncertainty" in str(outcome(sample, made_of(sample, tmp_path), said, DARK, tmp_path / "m"))


# --- what repeats what a file says --------------------------------------------------------------------------------

REPEATS: dict[str, dict[str, Any]] = {
    "qis.npy": {"rows": 3, "columns": 11, "frames": 20, "modality": "qis", "axes": "MHW"},
    "counts.npy": {"rows": 3, "columns": 11, "frames": 20, "modality": "counts", "counting": "frames"},
    "counts.h5": {"bits": 4, "dataset": "frames"},
    "str.h5": {"tick": 1e-7, "modality": "str"},
    "tr.npz": {"tick": 1e-9, "modality": "tr"},
    "width.h5": {"columns": 11, "packed": True, "bit_order": "big", "modality": "qis"},
    "width.npz": {"columns": 11, "packed": True},
    "qis.bin": {"packed": True, "modality": "qis", "frames": 20},
    "qis.tif": {"rows": 3, "columns": 11, "frames": 20, "axes": "MHW"},
    "qis.mat": {"axes": "HWM"},
    "a.ptu": {"tick": 1e-12, "modality": "tr"},
    "a.csv": {"tick": 1e-12},
}


@pytest.mark.parametrize(("file", "name"), [(file, name) for file, said in REPEATS.items() for name in said])
def test_what_repeats_the_file_changes_nothing(folder: Path, tmp_path: Path, file: str, name: str) -> None:
    sample = next(s for s in SAMPLES if s.name == file)
    said = replace(sample.said, **{name: REPEATS[file][name]})
    assert outcome(sample, made_of(sample, tmp_path), said, DARK, tmp_path / "made") == without(sample, folder, False)


@pytest.mark.parametrize(
    ("file", "name", "value", "says"),
    [
        ("qis.npy", "rows", 4, "not 4 x 11 pixels"),
        ("qis.npy", "frames", 21, "holds 20 frames, not 21"),
        ("qis.npy", "modality", "tr", "holds frames, and no tr"),
        ("counts.npy", "frames", 21, "holds 20 frames of 15 binary frames each, not 21"),
        ("width.h5", "columns", 12, "its rows have 11 columns, not 12"),
        ("width.npz", "columns", 10, "its rows have 11 columns, not 10"),
        ("width.h5", "modality", "counts", "holds packed bits, which are qis, and no counts"),
        ("str.h5", "tick", 2e-7, "has ticks of 100 ns; leave out --tick"),
        ("tr.npz", "tick", 2e-9, "has ticks of 1 ns; leave out --tick"),
        ("a.ptu", "tick", 2e-12, "has ticks of 1 ps; leave out --tick"),
        ("a.hdf5", "tick", 2e-12, "has ticks of 10 ns; leave out --tick"),
        ("a.csv", "rows", 1, "lies beyond the 1 x 1 pixels"),
    ],
)
def test_what_contradicts_the_file_is_refused(tmp_path: Path, file: str, name: str, value: Any, says: str) -> None:
    sample = next(s for s in SAMPLES if s.name == file)
    text = outcome(sample, made_of(sample, tmp_path), replace(sample.said, **{name: value}), DARK, tmp_path / "made")
    assert says in str(text)


# --- several files ------------------------------------------------------------------------------------------------


def test_an_option_that_one_of_several_files_uses_is_fine(tmp_path: Path) -> None:
    pytest.importorskip("ptufile")
    (tmp_path / "a.csv").write_text("pixel,time (ns)\n0,5\n32,7\n")
    frames, tags = save(tmp_path / "b.npy", bits()), ptu(tmp_path / "c.ptu", [t2(0, 5), t2(1, 9)])
    said = replace(CLOCK, exposure=1.0, frames=20)
    made = import_files([tmp_path / "a.csv", frames, tags], tmp_path / "made", said, DARK)
    assert [c.modality for c in made.captures] == ["tr", "qis", "tr"]
    assert [took.shape for took in made.took] == [(3, 11)] * 3 and [t.detections for t in made.took][::2] == [2, 2]
    for extra, says in (
        ({"bits": 4}, "--bits does not apply to"),
        ({"firmware": "2208"}, "--firmware does not apply to"),
        ({"dataset": "frames"}, "--dataset does not apply to"),
        ({"bit_order": "big"}, "--bit-order does not apply to"),
        ({"counting": "counter"}, "--counting does not apply to"),
    ):
        with pytest.raises(SpadError) as caught:
            import_files([tmp_path / "a.csv", frames, tags], tmp_path / "no", replace(said, **extra), DARK)
        assert says in str(caught.value)


def test_an_option_that_none_of_several_files_uses_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("tifffile")
    files = [save(tmp_path / "a.npy", bits()), save(tmp_path / "b.tif", bits().astype(np.uint8))]
    for name, value in (("exposure", 1.0), ("tick", 1e-9), ("channels", ("0",)), ("subtract_start", True)):
        with pytest.raises(SpadError) as caught:
            import_files(files, tmp_path / "no", replace(CLOCK, **{name: value}), DARK)
        assert word(name) in str(caught.value)


def test_data_sets_of_one_of_two_files(tmp_path: Path) -> None:
    one, two = hdf5(tmp_path / "a.h5", deep=bits()), save(tmp_path / "b.npy", bits(7))
    made = import_files([one, two], tmp_path / "made", replace(CLOCK, dataset="deep"), DARK)
    assert [took.frames for took in made.took] == [20, 7]


# --- as the command line says them --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"exposure": "1"}, "--exposure: '1' has no unit"),
        ({"exposure": "0 s"}, "--exposure: 0 s is not possible"),
        ({"exposure": "-1 s"}, "--exposure: -1 s is not possible"),
        ({"exposure": "1e300 s"}, "--exposure: 1e300 s is not possible"),
        ({"tick": "1 parsec"}, "--tick: '1 parsec' is not a time"),
        ({"frame_time": "10"}, "--frame-time: '10' has no unit"),
        ({"relative_uncertainty": "1.5"}, "--relative-uncertainty: 1.5 is not possible; it must be from 0 to 1"),
        ({"relative_uncertainty": "1 s"}, "--relative-uncertainty: "),
        ({"channels": "0,,1"}, "--channels: '' is no channel"),
        ({"channels": "-1"}, "--channels: '-1' is no channel"),
        ({"channels": "1.5"}, "--channels: '1.5' is no channel"),
        ({"channels": "0,1,0"}, "--channels: 0 stands there twice"),
        ({"channels": "1,01"}, "--channels: 1 stands there twice"),
        ({"channels": "sync,SYNC"}, "--channels: sync stands there twice"),
    ],
)
def test_values_that_are_not_possible(given: dict[str, str], says: str) -> None:
    with pytest.raises(SpadError) as caught:
        Said.of(**given)
    assert says in str(caught.value) and "\n" not in str(caught.value)


def test_values_in_si() -> None:
    said = Said.of(exposure="100 ms", tick="25 ps", relative_uncertainty="1.5 %", channels=" 0, 07,Sync", rows=4)
    assert said == Said(exposure=0.1, tick=25e-12, relative_uncertainty=0.015, channels=("0", "7", "sync"), rows=4)
    assert said.given == ["relative_uncertainty", "rows", "channels", "exposure", "tick"]
    assert Said().given == [] and SECOND.given == ["exposure"]
