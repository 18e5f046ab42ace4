"""A dataset's images in files of other programs: read back by these, they are the numbers of the dataset."""

from __future__ import annotations

import hashlib
import io
import json
import re
import shutil
import sys
import tarfile
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result
from PIL import Image

import spadmnist
from spadmnist import config, document, factory, image_exporters
from spadmnist.cli import cli
from spadmnist.dataset import Part
from spadmnist.errors import SpadError
from spadmnist.image_exporters import Choice, export

CONFIG = """\
seed: 3
scene: {images: {source: digits, train: 9, test: 4, rows: 9, columns: 8}, lux: [5 mlux, 2560 mlux]}
recording:
  exposure: 1020 us
  frames: 102
  frame_time: 10 us
  readouts: [tr, str, qis, counts]
  bits: 2
sensor: {layout: {rows: 9, columns: 8, pixel_area: 25 um^2}, effects: {detection: {pdp: 0.5}, tdc: {resolution: 10 ps}}}
"""


def made(text: str, folder: Path) -> Path:
    experiment = config.build(document.parse(text, "a.yaml"), folder)
    factory.generate(experiment, experiment.load_images(), folder / "out", 1)
    return folder / "out"


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made(CONFIG, tmp_path_factory.mktemp("dataset"))


def run(*words: object) -> Result:
    return CliRunner().invoke(cli, [str(word) for word in words])


def check_row(row: dict[str, Any], part: Part, i: int) -> None:
    """A row as all formats have it: the columns of an image as arrays."""
    events, frames = part.tr[i], part.frames[i]
    assert int(row["number"]) == i and int(row["label"]) == part.labels[i]  # type: ignore[index]
    counts = np.asarray(row["counts"]).ravel()
    assert np.array_equal(counts, events.counts)
    steps = np.split(np.asarray(row["ticks"]), np.cumsum(counts)[:-1])
    assert np.array_equal(np.concatenate([np.cumsum(one, dtype=np.uint64) for one in steps]), events.ticks)
    assert np.array_equal(np.asarray(row["bits"], np.uint8).reshape(frames.bits.shape), frames.bits)
    assert frames.first is not None and np.array_equal(row["first_ticks"], frames.first.ticks)
    assert np.array_equal(np.asarray(row["count_frames"]).ravel(), part.counts[i].ravel())
    for name, field in part.reconstruction.items():
        assert np.array_equal(np.asarray(row[f"flux_{name}"], np.float32).reshape(part.shape), field[i])


def parts(out: Path) -> list[tuple[str, str, float, Part]]:
    held = spadmnist.open(out)
    return [(a, s, x, held[a, s]) for a, x in zip(held.levels, held.lux, strict=True) for s in held.splits]


def place(level: str, split: str) -> str:
    return f"{level.replace(' ', '_')}/{split}/00000"


# --- NumPy, tar --------------------------------------------------------------------------------------------------


def npz_rows(path: Path) -> list[dict[str, Any]]:
    with np.load(path) as held:
        n = len(held["number"])
        columns = {k: held[k] for k in held.files if held[k].ndim and not k.endswith("_starts")}
        starts = {k.removesuffix("_starts"): held[k] for k in held.files if k.endswith("_starts")}
    return [
        {k: v[starts[k][i] : starts[k][i + 1]] if k in starts else v[i] for k, v in columns.items()} for i in range(n)
    ]


def test_npz(out: Path, tmp_path: Path) -> None:
    export(out, tmp_path / "rows", "npz", Choice())
    for level, split, lux, part in parts(out):
        rows = npz_rows(tmp_path / "rows" / f"{place(level, split)}.npz")
        assert len(rows) == len(part)
        for i, row in enumerate(rows):
            check_row(row, part, i)
            assert row["lux"] == lux and np.array_equal(row["image"], part.images[i])
    with np.load(tmp_path / "rows" / "5_mlux" / "train" / "00000.npz") as held:
        assert held["tick"] == 1e-11 and held["frames"] == 102 and held["exposure"] == 1020e-6


def test_many_files_are_named_by_level_and_split(out: Path, tmp_path: Path) -> None:
    """A program that wants each of them asks for JSON."""
    done = run("export", out, "-o", tmp_path / "png", "--format", "png")
    lines, number = done.stdout.splitlines(), sum(path.is_file() for path in (tmp_path / "png").rglob("*"))
    assert number > 20 and len(lines) == 4 and "PIL.Image.open(FILE)" in done.stderr
    assert sum(int(line.split(": ")[1].split()[0]) for line in lines) == number
    assert all((tmp_path / "png" / line.split(": ")[0]).is_dir() for line in lines)
    again = run("export", out, "-o", tmp_path / "again", "--format", "png", "--json")
    assert len(json.loads(again.stdout)["files"]) == number


def test_one_npz(out: Path, tmp_path: Path) -> None:
    """A file holds one level and split; the same images are the same bytes."""
    for name in ("a.npz", "b.npz"):
        done = run("export", out, "-o", tmp_path / name, "--format", "npz", "--lux", "2560 mlux", "--split", "test")
        assert done.exit_code == 0 and done.stdout.strip() == str(tmp_path / name), done.output
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    part = spadmnist.open(out)["2560 mlux", "test"]
    for i, row in enumerate(npz_rows(tmp_path / "a.npz")):
        check_row(row, part, i)
    with pytest.raises(SpadError, match=r"one file holds one level and split, and these are 4"):
        export(out, tmp_path / "c.npz", "npz", Choice())
    with pytest.raises(SpadError, match="is there already"):
        export(out, tmp_path / "a.npz", "npz", Choice(["5 mlux"], ["test"]))


def test_webdataset(out: Path, tmp_path: Path) -> None:
    export(out, tmp_path / "rows", "webdataset", Choice())
    for level, split, lux, part in parts(out):
        with tarfile.open(tmp_path / "rows" / f"{place(level, split)}.tar") as archive:
            files = {m.name: archive.extractfile(m).read() for m in archive.getmembers()}  # type: ignore[union-attr]
        for i in range(len(part)):
            key = f"{i:08d}"
            with np.load(io.BytesIO(files[f"{key}.npz"])) as held:
                row = {name: held[name] for name in held.files}
            said = json.loads(files[f"{key}.json"])
            check_row({**row, "number": said["number"], "label": int(files[f"{key}.cls"])}, part, i)
            assert said["lux"] == lux and said["level"] == level and said["split"] == split
            assert np.array_equal(np.asarray(Image.open(io.BytesIO(files[f"{key}.png"]))), part.images[i])


def test_webdataset_is_read_by_its_library(out: Path, tmp_path: Path) -> None:
    library = pytest.importorskip("webdataset")
    export(out, tmp_path / "rows", "webdataset", Choice())
    file = tmp_path / "rows" / "5_mlux" / "train" / "00000.tar"
    found = list(library.WebDataset(str(file), shardshuffle=False).decode())
    part = spadmnist.open(out)["5 mlux", "train"]
    assert [sample["cls"] for sample in found] == part.labels.tolist()  # type: ignore[union-attr]
    check_row({**found[2]["npz"], "number": found[2]["json"]["number"], "label": found[2]["cls"]}, part, 2)


# --- PNG ---------------------------------------------------------------------------------------------------------


def test_png(out: Path, tmp_path: Path) -> None:
    export(out, tmp_path / "rows", "png", Choice(["2560 mlux"], ["train"], 5, ["counts", "qis_linear"]))
    folder = tmp_path / "rows" / "2560_mlux" / "train"
    scale = json.loads((folder / "scale.json").read_text())
    part = spadmnist.open(out)["2560 mlux", "train"]
    assert sorted(scale) == ["counts", "qis_linear"] and scale["counts"]["unit"] == "1/s"
    for name in scale:
        top = float(part.reconstruction[name][:5].max())
        assert scale[name]["white"] == top
        for i in range(5):
            image = np.asarray(Image.open(folder / name / str(part.labels[i]) / f"{i:05d}.png"))  # type: ignore[index]
            assert image.dtype == np.uint16
            assert np.abs(image / 65535 * top - part.reconstruction[name][i]).max() <= top / 65535
    assert len(list(folder.rglob("*.png"))) == 10


# --- Parquet -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def parquet(out: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("pyarrow")
    folder = tmp_path_factory.mktemp("parquet") / "rows"
    export(out, folder, "parquet", Choice())
    return folder


def with_bits(row: dict[str, Any]) -> dict[str, Any]:
    return {**row, "bits": np.frombuffer(row["bits"], np.uint8)}


@pytest.mark.parametrize("library", ["pyarrow", "polars", "duckdb"])
def test_parquet(out: Path, parquet: Path, library: str) -> None:
    reader = pytest.importorskip(library)
    for level, split, lux, part in parts(out):
        path = str(parquet / f"{place(level, split)}.parquet")
        if library == "pyarrow":
            import pyarrow.parquet

            rows = pyarrow.parquet.read_table(path).to_pylist()
        elif library == "polars":
            rows = reader.read_parquet(path).rows(named=True)
        else:
            found = reader.sql(f"select * from '{path}'")
            rows = [dict(zip(found.columns, row, strict=True)) for row in found.fetchall()]
        assert len(rows) == len(part)
        for i, row in enumerate(rows):
            check_row(with_bits(row), part, i)
            assert row["lux"] == lux
            assert np.array_equal(np.asarray(Image.open(io.BytesIO(row["image"]["bytes"]))), part.images[i])


def test_the_card_takes_a_row_apart(out: Path, parquet: Path) -> None:
    """Its Python does what it says, and its head names the files as a hub's loader wants them."""
    import pyarrow.parquet

    card = (parquet / "README.md").read_text()
    (code,) = re.findall(r"```python\n(.*?)```", card, re.S)
    names: dict[str, Any] = {}
    exec(compile(code, "README.md", "exec"), names)
    part = spadmnist.open(out)["2560 mlux", "train"]
    row = pyarrow.parquet.read_table(parquet / "2560_mlux" / "train" / "00000.parquet").to_pylist()[1]
    events = part.tr[1]
    assert [x.tolist() for x in names["stamps"](row)] == [events.ticks[a:b].tolist() for a, b in _rows(events)]
    assert np.array_equal(names["frames"](row), part.qis[1])
    assert np.array_equal(names["flux"](row, "str_flux"), part.reconstruction["str_flux"][1])
    head = document.parse(card.split("---\n")[1], "README.md").value
    files = {one["path"] for level in head["configs"] for one in level["data_files"]}
    assert [level["config_name"] for level in head["configs"]] == ["5_mlux", "2560_mlux"]
    assert files == {f"{level}/{split}/*.parquet" for level in ("5_mlux", "2560_mlux") for split in ("train", "test")}


def _rows(events: Any) -> list[tuple[int, int]]:
    return list(zip(events.offsets[:-1].tolist(), events.offsets[1:].tolist(), strict=True))


def test_croissant(out: Path, parquet: Path) -> None:
    """The digest of each file, and the dataset's seal."""
    said = json.loads((parquet / "croissant.json").read_text())
    assert said["identifier"] == json.loads((out / "manifest.json").read_text())["sha256"]
    listed = {one["contentUrl"]: one["sha256"] for one in said["distribution"]}
    found = {path.relative_to(parquet).as_posix(): path for path in parquet.rglob("*.parquet")}
    assert listed == {name: hashlib.sha256(path.read_bytes()).hexdigest() for name, path in found.items()}
    assert len(listed) == 4 and len(said["recordSet"]) == 4


def test_croissant_is_valid(out: Path, parquet: Path) -> None:
    library = pytest.importorskip("mlcroissant")
    held = library.Dataset(str(parquet / "croissant.json"))
    assert not held.metadata.ctx.issues.errors
    row = next(iter(held.records("rows/5_mlux/train/00000.parquet")))
    part = spadmnist.open(out)["5 mlux", "train"]
    check_row(with_bits({key.rpartition("/")[2]: value for key, value in row.items()}), part, 0)


def test_a_hubs_loader_reads_it(out: Path, parquet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    library = pytest.importorskip("datasets")
    held = library.load_dataset(str(parquet), "2560_mlux", cache_dir=str(tmp_path))
    part = spadmnist.open(out)["2560 mlux", "test"]
    assert len(held["train"]) == 9 and len(held["test"]) == 4
    check_row(with_bits(held["test"][3]), part, 3)
    assert np.array_equal(np.asarray(held["test"][3]["image"]), part.images[3])


def test_stamps_take_no_more_than_in_the_store(tmp_path: Path) -> None:
    """At 2560 mlux, of the sensor of the paper: at most 1.02 times the bytes; measured: 0.96."""
    pq = pytest.importorskip("pyarrow.parquet")
    text = (Path(__file__).parents[1] / "configs" / "quick.yaml").read_text()
    text = text.replace("[5 mlux, 20 mlux, 160 mlux, 2560 mlux]", "[2560 mlux]").replace(
        "train: 400, test: 100", "train: 60, test: 0"
    )
    out = made(
        text.replace("readouts: [tr, str, qis]", "readouts: [tr]")
        .replace("str_flux, qis_counts, qis_linear", "")
        .replace("inter_photon, ]", "inter_photon]"),
        tmp_path,
    )
    export(out, tmp_path / "rows", "parquet", Choice())
    group = pq.ParquetFile(tmp_path / "rows" / "2560_mlux" / "train" / "00000.parquet").metadata.row_group(0)
    columns = [group.column(i) for i in range(group.num_columns)]
    held = sum(c.total_compressed_size for c in columns if c.path_in_schema.split(".")[0] in ("ticks", "counts"))
    with zipfile.ZipFile(out / "data" / "2560_mlux" / "train" / "00000.zarr.zip") as shard:
        stored = sum(info.file_size for info in shard.infolist() if info.filename.startswith("tr/"))
    assert held <= 1.02 * stored and stored > 1_000_000


def test_without_the_library_one_line_says_what_to_install(
    out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    with pytest.raises(SpadError, match=r"pip install 'spadmnist\[parquet\]'"):
        export(out, tmp_path / "rows", "parquet", Choice())
    assert list(tmp_path.iterdir()) == []


# --- causes, and what some have not ---


@pytest.fixture(scope="module")
def caused(tmp_path_factory: pytest.TempPathFactory) -> Path:
    text = CONFIG.replace("tdc: {resolution: 10 ps}", "dark_counts: {rate: 2 kHz}, afterpulsing: {probability: 0.1}")
    folder = tmp_path_factory.mktemp("caused")
    experiment = config.build(document.parse(text, "a.yaml"), folder, causes=True)
    factory.generate(experiment, experiment.load_images(), folder / "out", 1)
    return folder / "out"


def of_image(parent: np.ndarray) -> list[int]:
    """As `Events` of one image has them."""
    return np.asarray(parent, np.int64).tolist()  # type: ignore[no-any-return]


@pytest.mark.parametrize("format", ["npz", "webdataset", "parquet"])
def test_causes_are_written(caused: Path, tmp_path: Path, format: str) -> None:
    """Of each stamp and of each bit: what made it, and which detection of its image caused it."""
    part = spadmnist.open(caused)["2560 mlux", "train"]
    export(caused, tmp_path / "rows", format, Choice())
    path = tmp_path / "rows" / "2560_mlux" / "train" / f"00000{image_exporters.ImageTarget.every[format].suffix}"
    rows: list[Any] = []
    if format == "npz":
        rows = npz_rows(path)
    elif format == "webdataset":
        with tarfile.open(path) as archive:
            for i in range(len(part)):
                with np.load(io.BytesIO(archive.extractfile(f"{i:08d}.npz").read())) as held:  # type: ignore[union-attr]
                    rows.append({name: held[name] for name in held.files})
    else:
        rows = pytest.importorskip("pyarrow.parquet").read_table(path).to_pylist()
    for i, row in enumerate(rows):
        events, frames = part.tr[i], part.frames[i]
        assert np.array_equal(row["cause"], events.cause) and of_image(row["parent"]) == of_image(events.parent)
        assert np.array_equal(row["first_cause"], frames.cause)
        assert of_image(row["first_parent"]) == of_image(frames.parent)
    assert any(max(row["parent"], default=-1) >= 0 for row in rows)
    names = {column.name: column.about for column in _block(caused).columns()}
    assert all(f"{i} {name}" in names["cause"] for i, name in enumerate(part.causes))


def _block(root: Path) -> image_exporters.Block:
    return image_exporters.chosen(root, Choice()).blocks[0]


def test_what_cannot_hold_causes_says_so(caused: Path, out: Path, tmp_path: Path) -> None:
    said = "do not hold what made each detection"
    for format, dataset, told in (("png", caused, True), ("npz", caused, False), ("png", out, False)):
        done = run("export", dataset, "-o", tmp_path / f"{format}-{dataset.parent.name}", "--format", format)
        assert done.exit_code == 0 and (said in done.stderr) == told, done.output


def test_the_card_says_what_there_is(caused: Path, tmp_path: Path) -> None:
    """Without a converter stamps are times; functions of what was not written are left out."""
    pq = pytest.importorskip("pyarrow.parquet")
    part, place = spadmnist.open(caused)["5 mlux", "train"], Path("5_mlux") / "train" / "00000.parquet"
    for name, choice, there in (
        ("all", Choice(), {"stamps", "frames", "flux"}),
        ("tr", Choice(readouts=["tr"]), {"stamps", "flux"}),
        ("qis", Choice(readouts=["qis"]), {"frames", "flux"}),
    ):
        export(caused, tmp_path / name, "parquet", choice)
        (code,) = re.findall(r"```python\n(.*?)```", (tmp_path / name / "README.md").read_text(), re.S)
        names: dict[str, Any] = {}
        exec(compile(code, "README.md", "exec"), names)
        assert names.keys() & {"stamps", "frames", "flux"} == there
        row, events = pq.read_table(tmp_path / name / place).to_pylist()[1], part.tr[1]
        if "stamps" in there:
            right = [events.times[a:b].tolist() for a, b in _rows(events)]
            assert [x.tolist() for x in names["stamps"](row)] == right
        if "frames" in there:
            assert np.array_equal(names["frames"](row), part.qis[1])


@pytest.mark.parametrize("labelled", ["train", "test"])
def test_labels_of_one_split(tmp_path: Path, labelled: str) -> None:
    """All files have the columns that croissant.json and a hub's loader expect; where there is no label it is null."""
    pq = pytest.importorskip("pyarrow.parquet")
    for split in ("train", "test"):
        for i in range(2):
            path = tmp_path / "photos" / split / (f"c{i}" if split == labelled else "") / f"{i}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(np.full((9, 8), 200, np.uint8)).save(path)
    text = CONFIG.replace("{source: digits, train: 9, test: 4, rows: 9, columns: 8}", "{source: folder, path: photos}")
    root = made(text, tmp_path)
    export(root, tmp_path / "rows", "parquet", Choice(["5 mlux"]))
    held = {split: pq.read_table(tmp_path / "rows" / "5_mlux" / split / "00000.parquet") for split in ("train", "test")}
    for split, table in held.items():
        assert table["label"].to_pylist() == ([0, 1] if split == labelled else [None, None])
    names = [[field.name for field in table.schema] for table in held.values()]
    assert held["train"].schema == held["test"].schema
    said = json.loads((tmp_path / "rows" / "croissant.json").read_text())
    for one in said["recordSet"]:
        assert {field["name"] for field in one["field"]} == set(names[0])


@pytest.mark.parametrize(("format", "name"), [("webdataset", "x.tar"), ("parquet", "x.PARQUET"), ("png", "x.npz")])
def test_a_folder_is_not_named_like_a_file(out: Path, tmp_path: Path, format: str, name: str) -> None:
    with pytest.raises(SpadError, match=rf"{name}: {format} is a folder with a file for each shard.*-o .*/x$"):
        export(out, tmp_path / name, format, Choice())
    assert list(tmp_path.iterdir()) == []


# --- what is chosen, and mistakes --------------------------------------------------------------------------------


def test_what_is_chosen(out: Path, tmp_path: Path) -> None:
    done = run(
        *("export", out, "-o", tmp_path / "rows", "--format", "npz", "--lux", "0.005 lux", "--limit", 2),
        *("--split", "train", "--method", "counts", "--readout", "qis"),
    )
    assert done.exit_code == 0, done.output
    assert done.stdout.splitlines() == [str(tmp_path / "rows" / "5_mlux" / "train" / "00000.npz")]
    with np.load(tmp_path / "rows" / "5_mlux" / "train" / "00000.npz") as held:
        columns = {name for name in held.files if held[name].ndim}
        assert columns == {"number", "label", "lux", "image", "bits", "flux_counts"} and len(held["number"]) == 2


def test_colour_and_no_labels(tmp_path: Path) -> None:
    """Colour leads with its channel, in the files, too; what has no labels and no converter has no such columns."""
    pytest.importorskip("pyarrow")
    np.save(tmp_path / "a.npy", np.random.Generator(np.random.Philox(1)).integers(0, 256, (3, 3, 9, 8), np.uint8))
    text = CONFIG.replace("{source: digits, train: 9, test: 4, rows: 9, columns: 8}", "{source: array, path: a.npy}")
    out = made(
        text.replace(", tdc: {resolution: 10 ps}", "").replace("str, qis, counts", "qis").replace("  bits: 2\n", ""),
        tmp_path,
    )
    part = spadmnist.open(out)["2560 mlux"]
    for format in image_exporters.ImageTarget.every:
        export(out, tmp_path / format, format, Choice())
    import pyarrow.parquet

    row = pyarrow.parquet.read_table(tmp_path / "parquet" / "2560_mlux" / "train" / "00000.parquet").to_pylist()[1]
    assert "label" not in row and np.array_equal(row["times"], part.tr[1].times)
    assert np.array_equal(
        np.reshape(row["flux_counts"], (3, 9, 8)).astype(np.float32), part.reconstruction["counts"][1]
    )
    assert np.array_equal(np.asarray(Image.open(io.BytesIO(row["image"]["bytes"]))), np.moveaxis(part.images[1], 0, -1))
    assert np.asarray(Image.open(tmp_path / "png/2560_mlux/train/counts/00001.png")).shape == (9, 8, 3)


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        (["--format", "npz", "--lux", "7 mlux"], ["--lux", "7 mlux", "5 mlux, 2560 mlux"]),
        (["--format", "png", "--split", "val"], ["--split val", "train, test"]),
        (["--format", "parquet", "--method", "count"], ["--method count", "counts"]),
        (["--format", "png", "--readout", "tr"], ["--readout", "flux images alone"]),
        (["--format", "webdataset", "--capture", "a"], ["--capture", "belongs to a measurement"]),
        (
            ["--format", "hdf5"],
            ["only one whose source is uniform or a chart", "take one of npz, webdataset, png, parquet"],
        ),
        (["--format", "hdf5", "--limit", "3"], ["--limit", "gives captures"]),
    ],
)
def test_mistakes(out: Path, tmp_path: Path, words: list[str], parts: list[str]) -> None:
    done = run("export", out, "-o", tmp_path / "rows", *words)
    assert isinstance(done.exception, SpadError)
    for part in parts:
        assert part in str(done.exception), done.exception
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("format", ["png", "npz", "hdf5"])
def test_what_is_no_finished_folder_is_said(out: Path, tmp_path: Path, format: str) -> None:
    shutil.copytree(out, tmp_path / "unfinished")
    (tmp_path / "unfinished" / "manifest.json").unlink()
    (tmp_path / "unfinished" / ".spadmnist").mkdir()
    shutil.make_archive(str(tmp_path / "out"), "zip", out.parent, out.name)
    for name, says in (
        ("nothing", "there is nothing of that name"),
        ("out.zip", "is a zip, and export reads a folder: unpack it"),
        ("unfinished", "is not finished: type the command that makes it again"),
    ):
        done = run("export", tmp_path / name, "-o", tmp_path / "rows", "--format", format)
        assert isinstance(done.exception, SpadError) and says in str(done.exception), done.exception


def test_what_is_there_is_left_alone(out: Path, tmp_path: Path) -> None:
    (tmp_path / "rows").mkdir()
    (tmp_path / "rows" / "mine").write_text("mine")
    with pytest.raises(SpadError, match=r"rows: is there already, and is not written over"):
        export(out, tmp_path / "rows", "npz", Choice())
    assert [path.name for path in tmp_path.rglob("*")] == ["rows", "mine"]
    with pytest.raises(SpadError, match="lies inside the dataset"):
        export(out, out / "rows", "npz", Choice())


def test_half_an_export_is_none(out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run that fails leaves nothing, and one that was killed nothing that the next does not clear."""
    (tmp_path / ".rows.part" / "old").mkdir(parents=True)
    with monkeypatch.context() as patch:
        patch.setattr(image_exporters.WebDataset, "put", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            export(out, tmp_path / "rows", "webdataset", Choice())
    assert list(tmp_path.iterdir()) == []
    (tmp_path / ".rows.part" / "old").mkdir(parents=True)
    export(out, tmp_path / "rows", "webdataset", Choice())
    assert sorted(path.name for path in (tmp_path / "rows").iterdir()) == ["2560_mlux", "5_mlux"]


def test_uniform_light_is_captures_unless_images_are_chosen(tmp_path: Path) -> None:
    text = CONFIG.replace(
        "{source: digits, train: 9, test: 4, rows: 9, columns: 8}", "{source: uniform, repetitions: 2}"
    )
    out = made(text, tmp_path)
    assert run("export", out, "-o", tmp_path / "captures", "--format", "npz").exit_code == 0
    assert len(list((tmp_path / "captures").glob("*.npz"))) == 4
    assert run("export", out, "-o", tmp_path / "images", "--format", "npz", "--limit", 1).exit_code == 0
    assert len(list((tmp_path / "images").glob("*/train/00000.npz"))) == 2
