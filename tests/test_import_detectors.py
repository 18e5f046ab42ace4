"""Which pixel a detection is of: no detector is lost, merged with another, or made up."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from importfiles import DARK, SECOND, back, bits, hdf5, ptu, refusal, run, save, t2

from spadmnist import measurement
from spadmnist.errors import SpadError
from spadmnist.importers import Said
from spadmnist.importers.captures import Imported, import_files

CASES = Path(__file__).parents[2] / "shared" / "cases"


@dataclass
class Photons:
    """A Photon-HDF5 file of some spots, each (times in ticks, detectors or None)."""

    spots: Sequence[tuple[Any, Any]]
    num_pixels: int | None = None
    specs: Sequence[dict[str, Any]] = ()
    ids: Sequence[int] | None = None
    single: bool = True  # one spot stands in photon_data, without a number
    more: dict[str, Any] = field(default_factory=dict)
    kinds: Sequence[Any] = (np.int64,)

    def write(self, path: Path) -> Path:
        path.parent.mkdir(parents=True, exist_ok=True)
        with h5py.File(path, "w") as file:
            for spot, (times, detectors) in enumerate(self.spots):
                group = "photon_data" if self.single and len(self.spots) == 1 else f"photon_data{spot}"
                kind = self.kinds[spot % len(self.kinds)]
                file[f"{group}/timestamps"] = np.asarray(times, kind)
                file[f"{group}/timestamps_specs/timestamps_unit"] = 1e-8
                if detectors is not None:
                    file[f"{group}/detectors"] = np.asarray(detectors, np.uint8)
                for name, numbers in (self.specs[spot] if self.specs else {}).items():
                    file[f"{group}/measurement_specs/detectors_specs/{name}"] = np.asarray(numbers)
            if self.num_pixels is not None:
                file["setup/num_pixels"] = self.num_pixels
            if self.ids is not None:
                file["setup/detectors/id"] = np.asarray(self.ids)
            for name, value in self.more.items():
                file[name] = value
            file["acquisition_duration"] = 0.5
        return path


def totals(made: Imported, id: str | None = None) -> list[int]:
    return list(map(int, back(made, id).totals))


# --- Photon-HDF5: what is read ------------------------------------------------------------------------------------

READ: dict[str, tuple[Photons, list[int], str]] = {
    "two detectors": (Photons([([1, 2, 3], [0, 1, 1])]), [1, 2], ""),
    "their number is said": (Photons([([1, 2, 3], [0, 1, 1])], num_pixels=2), [1, 2], ""),
    "a silent one, by the number": (Photons([([1, 2, 3], [0, 2, 2])], num_pixels=4), [1, 0, 2, 0], ""),
    "a silent one, by the specs": (
        Photons([([1, 2], [7, 9])], 3, [{"spectral_ch1": [9], "spectral_ch2": [8, 7]}]),
        [1, 0, 1],
        "",
    ),
    "a silent one, by the ids": (Photons([([1, 2], [7, 9])], num_pixels=3, ids=[9, 8, 7]), [1, 0, 1], ""),
    "silence": (Photons([([], [])], num_pixels=2), [0, 0], ""),
    "scalars in the specs": (
        Photons([([1, 2, 3], [0, 1, 65])], 2, [{"polarization_ch1": 0, "polarization_ch2": 1}]),
        [1, 1],
        "1 entries with the number 65, no detector's (markers)",
    ),
    "markers, by the specs": (
        Photons([([1, 2, 3, 4], [0, 65, 1, 65])], 2, [{"spectral_ch1": [0], "spectral_ch2": [1]}], ids=[0, 1, 65]),
        [1, 1],
        "2 entries with the number 65, no detector's (markers)",
    ),
    "markers of two kinds, by the ids": (
        Photons([([1, 2, 3, 4], [0, 65, 1, 64])], num_pixels=2, ids=[0, 1]),
        [1, 1],
        "2 entries with the number 64, 65, no detector's (markers)",
    ),
    "spots without detectors": (Photons([([1, 5], None), ([2], None), ([], None)]), [2, 1, 0], ""),
    "spots without detectors, their number": (Photons([([1, 5], None), ([2], None)], num_pixels=2), [2, 1], ""),
    "spots, numbers over the file": (
        Photons([([1, 5, 6], [0, 1, 1]), ([2], [2]), ([3, 4], [5, 4])], num_pixels=6),
        [1, 2, 1, 0, 1, 1],
        "",
    ),
    "spots, without the number of pixels": (Photons([([1, 5], [0, 1]), ([2], [2])]), [1, 1, 1], ""),
    "spots that number anew": (Photons([([1, 5, 6], [0, 1, 1]), ([2], [0]), ([3, 4], [0, 1])], num_pixels=5),
                               [1, 2, 1, 1, 1], "its spots number their detectors anew"),
    "spots of other types": (
        Photons([([1, 2**60], [0, 1]), ([2], [2])], num_pixels=3, kinds=(np.int64, np.uint64)), [1, 1, 1], ""),
    "one spot with a number": (Photons([([1, 5], [0, 1])], num_pixels=2, single=False), [1, 1], ""),
}  # fmt: skip


@pytest.mark.parametrize("name", READ)
def test_photon_hdf5_is_read(tmp_path: Path, name: str) -> None:
    file, right, says = READ[name]
    said = Said(exposure=2e10) if "other types" in name else Said()
    made = run(file.write(tmp_path / "a.hdf5"), said)
    assert totals(made) == right
    heard = [*made.notes, *made.took[0].left_out]
    assert any(says in one for one in heard) if says else not made.took[0].left_out
    one = back(made)
    assert one.events is not None and one.events.ticks is not None
    stamps = [int(t) for times, _ in file.spots for t in times]
    assert set(map(int, one.events.ticks)) <= set(stamps) and len(one.events) == sum(right)


@pytest.mark.parametrize("name", [name for name in READ if "markers" not in name and name != "scalars in the specs"])
def test_no_detection_of_photon_hdf5_is_lost(tmp_path: Path, name: str) -> None:
    file, right, _ = READ[name]
    assert sum(right) == sum(len(times) for times, _ in file.spots)


# --- Photon-HDF5: what is refused ---------------------------------------------------------------------------------

_OTHER_TICKS = {
    "photon_data1/timestamps": [1],
    "photon_data1/timestamps_specs/timestamps_unit": 2e-8,
    "photon_data1/detectors": [1],
}
REFUSED: dict[str, tuple[Photons, str]] = {
    "a number of pixels beyond all": (
        Photons([([1, 2], [0, 1])], num_pixels=10**15),
        "setup/num_pixels says 1e+15; it is a whole number from 1 to 16,777,216",
    ),
    "a number of pixels that is none": (
        Photons([([1, 2], [0, 1])], more={"setup/num_pixels": np.nan}),
        "setup/num_pixels says nan; it is a whole number",
    ),
    "a number of pixels without end": (
        Photons([([1, 2], [0, 1])], more={"setup/num_pixels": np.inf}),
        "setup/num_pixels says inf; it is a whole number",
    ),
    "more pixels than a row may have": (
        Photons([([1, 2], [0, 1])], num_pixels=1 << 24),
        "1 x 16777216 pixels are more than the 16,777,216, and 100,000 in a row",
    ),
    "an identity below 0": (
        Photons([([1, 2], [0, 1])], ids=[0, 1, -5]),
        "setup/detectors/id names a detector -5; their numbers are 0 to 16777215: correct the file",
    ),
    "an identity beyond all": (
        Photons([([1, 2], [0, 1])], ids=[0, 1, 1 << 40]),
        f"setup/detectors/id names a detector {1 << 40}; their numbers are 0 to 16777215",
    ),
    "fewer pixels than detectors": (
        Photons([([1, 2, 3], [0, 1, 65])], num_pixels=2),
        "setup/num_pixels says 2 pixels, but detections are of 3 detectors (0, 1, 65); name those that are pixels with",
    ),
    "more pixels than can be told": (
        Photons([([1, 2], [7, 9])], num_pixels=3),
        "only 2 detectors have a number; name all that are pixels with --channels 7,9,...",
    ),
    "one spot of several pixels": (
        Photons([([1, 2], None)], num_pixels=2),
        "it does not say which of the 2 pixels (setup/num_pixels) each detection is of",
    ),
    "spots of several pixels": (
        Photons([([1], None), ([2], None)], num_pixels=4),
        "its 2 spots do not say which of the 4 pixels",
    ),
    "only some spots name detectors": (
        Photons([([1], [0]), ([2], None)], num_pixels=2),
        "only some of its spots name the detector",
    ),
    "the same detector in two spots": (
        Photons([([1, 2], [0, 1]), ([3], [1])], num_pixels=2),
        "the detector 1 is of several spots, but numbers are unique over the file",
    ),
    "the same detector, and no number of pixels": (
        Photons([([1, 2], [0, 1]), ([3], [1])]),
        "the detector 1 is of several spots",
    ),
    "as many detectors as times": (Photons([([1, 2], [0])]), "photon_data has 2 timestamps and 1 detectors"),
    "falling times": (
        Photons([([5, 9, 4, 10], [0, 0, 0, 0])]),
        "photon_data/timestamps falls back from 9 to 4 at entry 2",
    ),
    "negative times": (Photons([([-5, 9], [0, 0])]), "reach from -50 ns to 90 ns"),
    "nanotimes": (
        Photons([([1, 2], [0, 1])], more={"photon_data/nanotimes": [3, 4]}),
        "has nanotimes beside its times: was recorded in T3 mode",
    ),
    "nanotimes of the second spot": (
        Photons([([1], [0]), ([2], [1])], more={"photon_data1/nanotimes": [3]}),
        "has nanotimes beside its times",
    ),
    "ticks of two lengths": (Photons([([1], [0])], more=_OTHER_TICKS, single=False), "ticks of several lengths"),
    "photons in two places": (
        Photons([([1], [0])], more={"photon_data0/timestamps": [1]}),
        "has both photon_data and photon_data0",
    ),
    "specs that are no numbers": (Photons([([1], [0])], 1, [{"spectral_ch1": [0.5]}]), "is no list of detectors"),
    "no times": (Photons([], more={"photon_data/detectors": [1]}), "timestamps_unit is not one number"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_photon_hdf5_is_refused(tmp_path: Path, name: str) -> None:
    file, says = REFUSED[name]
    assert says in refusal(file.write(tmp_path / "a.hdf5"), Said())


@pytest.mark.parametrize("unit", [0.0, -1e-8, np.nan, np.inf, 1e-300])
def test_a_unit_that_is_not_possible(tmp_path: Path, unit: float) -> None:
    file = Photons([([1], [0])]).write(tmp_path / "a.hdf5")
    with h5py.File(file, "r+") as opened:
        opened["photon_data/timestamps_specs/timestamps_unit"][()] = unit
    assert "says that its tick is" in refusal(file, Said())


def test_channels_name_what_the_file_leaves_open(tmp_path: Path) -> None:
    """As the refusals advise."""
    made = run(
        Photons([([1, 2, 3, 4], [0, 1, 65, 1])], num_pixels=2).write(tmp_path / "a.hdf5"), Said(channels=("0", "1"))
    )
    assert totals(made) == [1, 2] and made.took[0].left_out == ("1 detections of the channel 65 (--channels)",)
    silent = Photons([([1, 2], [7, 9])], num_pixels=3).write(tmp_path / "b" / "a.hdf5")
    made = run(silent, Said(channels=("7", "8", "9")))
    assert totals(made) == [1, 0, 1] and any("the channel 8 has no detection in any file" in n for n in made.notes)
    markers = Photons([([1, 2, 3], [0, 65, 1])], 2, ids=[0, 1]).write(tmp_path / "c" / "a.hdf5")
    assert totals(run(markers, Said(channels=("65", "0", "1")))) == [1, 1, 1]  # who names it wants it


def test_the_cases_of_photon_hdf5(tmp_path: Path) -> None:
    if not CASES.is_dir():
        pytest.skip("needs the small files of the cases")
    for name, right in (
        ("photon-hdf5-markers/markers.hdf5", [133, 167]),
        ("photon-hdf5-two-detectors-a-spot/spots.hdf5", [152, 302, 470, 48, 98, 130]),
    ):
        made = import_files([CASES / name], tmp_path / name, Said(), DARK)
        assert totals(made) == right
        if "markers" in name:
            assert made.took[0].left_out == ("100 entries with the number 65, no detector's (markers)",)


# --- channels -----------------------------------------------------------------------------------------------------


def table(path: Path, channels: Sequence[int]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("channel,time (ns)\n" + "".join(f"{c},{10 + i}\n" for i, c in enumerate(channels)))
    return path


USED = [5, 2, 9, 5, 5, 2]


@pytest.mark.parametrize(
    ("names", "right", "left"),
    [
        (("2", "5", "9"), [2, 3, 1], None),
        (("9", "5", "2"), [1, 3, 2], None),
        (("5",), [3], "3 detections of the channels 2, 9 (--channels)"),
        (("5", "9"), [3, 1], "2 detections of the channel 2 (--channels)"),
        (("9", "0", "5", "100"), [1, 0, 3, 0], "2 detections of the channel 2 (--channels)"),
    ],
)
def test_channels_in_their_order(tmp_path: Path, names: tuple[str, ...], right: list[int], left: str | None) -> None:
    made = run(table(tmp_path / "a.csv", USED), replace(SECOND, channels=names))
    assert totals(made) == right and made.took[0].left_out == (() if left is None else (left,))
    assert made.took[0].of_pixels == tuple(right)
    one = back(made)
    assert one.events is not None and one.events.ticks is not None
    for pixel, name in enumerate(names):
        stamps = [1000 * (10 + i) for i, c in enumerate(USED) if c == int(name)]
        assert [int(t) for t in one.events.ticks[slice(*one.events.offsets[pixel : pixel + 2])]] == stamps
    silent = [name for name in names if int(name) not in USED]
    says = f"the channels {', '.join(silent)} have no detection in any file"
    assert any(says in note for note in made.notes) == bool(silent)


@pytest.mark.parametrize(
    ("names", "says"),
    [
        (("1",), "has no detection of 1; --channels names some of those in use: 2, 5, 9"),
        (("1", "3"), "has no detection of 1, 3; --channels names some of those in use: 2, 5, 9"),
        (("sync", "5"), "has no channel 'sync'; --channels names some of 2, 5, 9"),
        (("5", "99999999"), "has no channel '99999999'"),
    ],
)
def test_channels_that_are_none(tmp_path: Path, names: tuple[str, ...], says: str) -> None:
    assert says in refusal(table(tmp_path / "a.csv", USED), replace(SECOND, channels=names))


def test_without_channels_those_in_use_are_the_pixels(tmp_path: Path) -> None:
    made = run(table(tmp_path / "a.csv", USED), SECOND)
    assert totals(made) == [2, 3, 1] and any(
        "the channels 2, 5, 9 are the pixels, in this order" in n for n in made.notes
    )
    made = run(table(tmp_path / "b" / "a.csv", [0, 1, 1]), replace(SECOND, exposure=40e-9))
    assert totals(made) == [1, 2] and not made.notes


def test_channels_on_a_grid(tmp_path: Path) -> None:
    said = replace(SECOND, rows=2, columns=2, channels=("9", "2", "7", "5"))
    made = run(table(tmp_path / "a.csv", USED), said)
    assert totals(made) == [1, 2, 0, 3] and back(made).layout.shape == (2, 2)
    for channels in (("9", "2", "5"), ("9", "2", "5", "7", "1")):
        text = refusal(table(tmp_path / "b" / "a.csv", USED), replace(said, channels=channels))
        assert f"--channels: {len(channels)} channels are no 2 x 2 pixels" in text
    # without --channels the number of a channel is that of its pixel
    made = run(table(tmp_path / "c" / "a.csv", USED), replace(said, channels=None, rows=5))
    assert np.flatnonzero(back(made).totals).tolist() == [2, 5, 9] and totals(made)[5] == 3
    text = refusal(table(tmp_path / "d" / "a.csv", USED), replace(said, channels=None, rows=4))
    assert "the channel 9 lies beyond the 4 x 2 pixels; say with --channels 2,5,9 which channels" in text


def test_channels_at_places(tmp_path: Path) -> None:
    (tmp_path / "p.csv").write_text("x,y\n0,0\n23,0\n11.5,20\n")
    said = replace(SECOND, positions=tmp_path / "p.csv")
    made = run(table(tmp_path / "a.csv", USED), replace(said, channels=("5", "9", "2")))
    assert totals(made) == [3, 1, 2]
    assert "2 channels are no 1 x 3 pixels" in refusal(
        table(tmp_path / "b" / "a.csv", USED), replace(said, channels=("5", "9"))
    )
    assert "the channel 5 lies beyond the 1 x 3 pixels" in refusal(table(tmp_path / "c" / "a.csv", USED), said)


def test_channels_of_several_files(tmp_path: Path) -> None:
    """The pixels are those of all files; what is silent in one is the same pixel there."""
    files = [table(tmp_path / "a.csv", [5, 5]), table(tmp_path / "b.csv", [2, 9]), table(tmp_path / "c.csv", [9])]
    made = run(files, SECOND)
    assert [totals(made, id) for id in "abc"] == [[0, 2, 0], [1, 0, 1], [0, 0, 1]]
    folder = tmp_path / "chosen"
    made = import_files(files, folder, replace(SECOND, channels=("9", "5", "6")), DARK)
    assert [totals(made, id) for id in "abc"] == [[0, 2, 0], [1, 0, 0], [1, 0, 0]]
    assert [took.left_out for took in made.took] == [(), ("1 detections of the channel 2 (--channels)",), ()]
    silent = [note for note in made.notes if "has no detection in any file" in note]
    assert len(silent) == 1 and "the channel 6 has" in silent[0]  # once, not of every file


def test_a_channel_with_a_name_is_no_number_of_another_file(tmp_path: Path) -> None:
    """The sync input has a number in the program alone: it is not the detector that another file calls so."""
    pytest.importorskip("ptufile")
    tags = ptu(tmp_path / "a.ptu", [t2(0, 5, True), t2(0, 9)])
    for name, channels in (("b.csv", [64, 0]), ("c.csv", [0, 64])):
        other = table(tmp_path / name, channels)
        for files in ([tags, other], [other, tags]):
            text = refusal(files, replace(SECOND, exposure=1.0))
            assert "some files call the channel 64 sync, others do not" in text
    made = import_files([tags, table(tmp_path / "d.csv", [0, 1])], tmp_path / "fine", SECOND, DARK)
    assert [totals(made, id) for id in "ad"] == [[1, 1, 0], [0, 1, 1]]


def test_tags_beside_frames(tmp_path: Path) -> None:
    """Frames fix the grid; a channel is then the pixel of its number, or what --channels says."""
    files = [save(tmp_path / "a.npy", bits()), table(tmp_path / "b.csv", [32, 0])]
    said = replace(SECOND, frame_time=1e-5, frame_period=1e-5)
    made = import_files(files, tmp_path / "made", said, DARK)
    one = measurement.open(made.folder).recording("b")
    assert one.layout.shape == (3, 11) and np.flatnonzero(one.totals).tolist() == [0, 32]
    with pytest.raises(SpadError, match="the channel 33 lies beyond the 3 x 11 pixels"):
        import_files([files[0], table(tmp_path / "c.csv", [33])], tmp_path / "no", said, DARK)


# --- numbers that can be no channel -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("pixel", "says"),
    [
        (np.array([0, -1]), "has a channel -1; channels are 0 to 16777215"),
        (np.array([0, -128], np.int8), "has a channel -128"),
        (np.array([0, 1 << 24]), "has a channel 16777216"),
        (np.array([0, 2**63], np.uint64), "has a channel 9223372036854775808"),
        (np.array([0.0, 1.5]), "pixel[1] is 1.5, which is no whole number"),
        (np.array([0.0, np.nan]), "pixel[1] is nan, which is no whole number"),
        (np.array([0.0, np.inf]), "pixel[1] is inf, which is no whole number"),
        (np.array([0, 2**24 + 2], np.float32), "which float32 does not tell from the next whole number"),
        (np.array([0, 1, 2]), "has 2 times and 3 pixels"),
        (np.array([[0, 1], [1, 0]]), "pixel"),
    ],
)
@pytest.mark.parametrize("name", ["a.npz", "a.h5"])
def test_what_is_no_channel(tmp_path: Path, pixel: np.ndarray, says: str, name: str) -> None:
    time = np.array([5, 6])
    if name == "a.npz":
        np.savez(tmp_path / name, time=time, pixel=pixel, tick=1e-9)
    else:
        hdf5(tmp_path / name, {"tick": 1e-9}, time=time, pixel=pixel)
    for said in (SECOND, replace(SECOND, rows=2, columns=2), replace(SECOND, channels=("0", "1"))):
        assert says in refusal(tmp_path / name, said)
