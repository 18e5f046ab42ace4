"""A dataset's images for other programs: a row an image, with its label, its light, its streams and its fluxes.

One class writes one kind of file (`ImageTarget`), and is found by being defined. OUT is a folder with a folder for each
level and split, and in it a file for each shard of the dataset, as in the store.
"""

from __future__ import annotations

import hashlib
import io
import itertools
import json
import tarfile
import zipfile
from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, ClassVar

import numpy as np

from . import dataset, disk, document, manifest_file, packing, units
from .dataset import Part
from .errors import InputError, SpadError
from .events import Events
from .experiment import Level, level_of
from .factory import Progress
from .foreign import quoted
from .plugins import discover
from .reconstruct import find


@dataclass(frozen=True)
class Choice:
    """What of a dataset is written; where nothing is named, all of it. limit: images of each level and split."""

    levels: Sequence[str] = ()
    splits: Sequence[str] = ()
    limit: int | None = None
    methods: Sequence[str] = ()
    readouts: Sequence[str] = ()

    @property
    def named(self) -> bool:
        """Does it say what only images have?"""
        return bool(self.levels or self.splits or self.limit or self.methods)


@dataclass(frozen=True, eq=False)
class Column:
    """One kind of data of some images: (images, ...), or with `starts` (images + 1,) the entries of each in a row."""

    name: str
    values: np.ndarray
    about: str
    unit: str = "1"
    starts: np.ndarray | None = None

    def of(self, image: int) -> np.ndarray:
        """Of one image."""
        if self.starts is None:
            return np.asarray(self.values[image])
        return self.values[int(self.starts[image]) : int(self.starts[image + 1])]


@dataclass(frozen=True)
class Block:
    """Images `start` to `stop` of a level and split, a shard of the store or the beginning of one."""

    level: Level
    split: str
    number: int
    start: int
    stop: int
    part: Part
    methods: Sequence[str]
    readouts: Sequence[str]

    @property
    def path(self) -> str:
        """As the shard's in the store."""
        return f"{self.level.folder}/{self.split}/{self.number:05d}"

    def columns(self) -> list[Column]:
        """What there is of these images, in the order in which it is written."""
        part, these = self.part, slice(self.start, self.stop)
        found = [
            Column("number", np.arange(self.start, self.stop, dtype=np.uint32), "number of the image in its split")
        ]
        if part.labels is not None:
            found.append(Column("label", part.labels[these], "label"))
        unit = "lux" if self.level.kind == "lux" else "W/m^2"
        white = np.full(self.stop - self.start, self.level.value)
        found.append(Column(self.level.kind, white, "light on a white pixel", unit))
        found.append(Column("image", part.images[these], "original image"))
        found += self._streams(these)
        for name in self.methods:
            flux = part.reconstruction[name][these]
            found.append(Column(f"flux_{name}", flux, f"flux image by the method {name}", find(name).unit))
        return found

    def _streams(self, these: slice) -> Iterator[Column]:
        part, n = self.part, self.stop - self.start
        if "tr" in self.readouts:
            events = part.tr[these]
            kind = np.uint16 if not len(events.counts) or events.counts.max() < 1 << 16 else np.uint32
            counts = events.counts.astype(kind).reshape(n, *part.shape)
            yield Column("counts", counts, "TR: detections of each pixel")
            starts = events.offsets[:: events.pixels]
            if events.ticks is None or events.tick is None:
                yield Column("times", events.times, "TR: stamps since the start of the exposure", "s", starts)
            else:
                steps = packing.row_differences(events.ticks, events.offsets)
                about = "TR: of each pixel, as many as `counts` says, its first stamp and then the steps to the next"
                yield Column("ticks", steps, about, units.show(events.tick, "s", 12), starts)
            yield from self._causes(events, "TR: of each stamp", "")
        if {"str", "qis"} & set(self.readouts):
            frames = part.frames[these]
            bits = frames.bits.reshape(n, *part.shape, -1)
            yield Column("bits", bits, "QIS: of each pixel a bit a frame, high bit first: is there a detection?")
            if "str" in self.readouts and frames.first is not None:
                first, about = frames.first, "STR: for each bit that is set, in order, the stamp since its frame began"
                starts = first.offsets[:: first.pixels]
                if first.ticks is None or first.tick is None:
                    yield Column("first_times", first.times, about, "s", starts)
                else:
                    yield Column("first_ticks", first.ticks, about, units.show(first.tick, "s", 12), starts)
            yield from self._causes(frames.detections, "QIS, STR: for each bit that is set", "first_")
        if "counts" in self.readouts:
            yield Column("count_frames", part.counts[these], "count frames")

    def _causes(self, events: Events, each: str, prefix: str) -> Iterator[Column]:
        """What made each detection, where that was asked for; parents count from the start of their image."""
        if events.cause is None or events.parent is None:
            return
        starts = events.image_offsets
        names = ", ".join(f"{i} {name}" for i, name in enumerate(self.part.causes))
        yield Column(f"{prefix}cause", events.cause, f"{each}, what made it: {names}", "1", starts)
        before = np.repeat(starts[:-1], np.diff(starts))
        parent = np.where(events.parent >= 0, events.parent - before, events.parent).astype(np.int32)
        about = f"{each}, the number of the one in its image that caused it; -1: none, -2: one that was not recorded"
        yield Column(f"{prefix}parent", parent, about, "1", starts)


@dataclass(frozen=True)
class Chosen:
    """The blocks of a dataset that are written, and what its manifest says."""

    root: Path
    manifest: Mapping[str, Any]
    blocks: Sequence[Block]

    @property
    def facts(self) -> dict[str, float | int]:
        """How the images were recorded; s. tick: 0 without a converter."""
        settings = self.manifest["settings"]
        return {name: settings[name] for name in ("exposure", "frames", "frame_time", "tick", "pdp", "dead_time")}


def chosen(root: Path, choice: Choice) -> Chosen:
    """Raises SpadError for a level, split, method or readout that the dataset has not; InputError where it is none."""
    manifest = manifest_file.intact_manifest(root)
    stored = dataset.stored(root)
    every = [Level(x["text"], x["kind"], x["value"]) for x in manifest["levels"]]
    try:
        levels = [level_of(every, text) for text in choice.levels]
    except KeyError as error:
        raise SpadError(f"--lux: {error.args[0]}") from None
    discover()
    config = manifest["config"]
    methods = _of("--method", choice.methods, config["reconstruct"])
    readouts = _of("--readout", choice.readouts, config["recording"]["readouts"])
    splits = _of("--split", choice.splits, list(stored.splits))
    blocks = []
    for level in (one for one in every if one in (levels or every)):
        for split in splits:
            part = stored[level.text, split]
            ends = [min(cut, choice.limit or cut) for cut in part.cuts()]
            pairs = [(a, b) for a, b in itertools.pairwise(ends) if a < b]
            blocks += [Block(level, split, i, a, b, part, methods, readouts) for i, (a, b) in enumerate(pairs)]
    return Chosen(root, manifest, blocks)


def _of(option: str, wanted: Sequence[str], there: Sequence[str]) -> list[str]:
    for name in wanted:
        if name not in there:
            raise SpadError(f"{option} {name}: the dataset has none of it; there are {', '.join(there) or 'none'}")
    return [name for name in there if not wanted or name in wanted]


def check_source(path: Path) -> None:
    """Raise InputError where there is nothing at a path, or a zip or an unfinished dataset, which are not exported."""
    if not path.exists():
        raise InputError(f"{path}: there is nothing of that name; name the folder of a dataset or of a measurement")
    if path.is_file() and zipfile.is_zipfile(path):
        raise InputError(
            f"{path} is a zip, and export reads a folder: unpack it (python -m zipfile -e {quoted(path)} FOLDER), and "
            "name the dataset in it"
        )
    if (path / manifest_file.STATE).is_dir() and not (path / manifest_file.MANIFEST).exists():
        manifest_file.read_manifest(path)  # raises, and says how it is finished


def is_of_images(path: Path, format: str, choice: Choice) -> bool:
    """Is it the images of a dataset that are asked for, rather than captures?

    A dataset of uniform light or of a chart is a measurement, too: as `npz` it gives captures, unless it is said which
    images are wanted.
    """
    if format not in ImageTarget.every or not (path / manifest_file.MANIFEST).is_file():
        return False
    if format != "npz" or choice.named:
        return True
    source = manifest_file.intact_manifest(path)["config"]["scene"]["images"]["source"]
    return source not in ("uniform", "chart")


def has_causes(path: Path) -> bool:
    """Does a dataset say of its detections what made them? False of what is no dataset."""
    return (path / manifest_file.MANIFEST).is_file() and bool(manifest_file.intact_manifest(path).get("causes"))


class ImageTarget:
    """Writes one kind of file. name: what `--format` calls it; suffix: of its files."""

    every: ClassVar[dict[str, type[ImageTarget]]] = {}
    name: ClassVar[str]
    suffix: ClassVar[str]
    opened_by: ClassVar[str]  # in Python
    of_fluxes: ClassVar[bool] = False  # alone: neither streams nor what made their detections

    def __init_subclass__(cls) -> None:
        ImageTarget.every[cls.name] = cls

    @classmethod
    def check(cls, found: Chosen) -> None:
        """Raise SpadError where this cannot be written, before anything is."""

    @classmethod
    def put(cls, found: Chosen, block: Block, file: IO[bytes]) -> None:
        """Write a block to a file."""
        raise NotImplementedError

    @classmethod
    def write(cls, found: Chosen, folder: Path, progress: Progress) -> None:
        """Write all blocks below a folder, and what goes with them."""
        for block in found.blocks:
            path = folder / f"{block.path}{cls.suffix}"
            path.parent.mkdir(parents=True, exist_ok=True)
            with open(path, "wb") as file:
                cls.put(found, block, file)
            progress.advance(block.stop - block.start, block.path)


def export(root: Path, out: Path, format: str, choice: Choice, progress: Progress | None = None) -> list[Path]:
    """Write images of a dataset to the folder `out`, or to one file where it ends in `.npz`; the paths of its files.

    The folder is there as a whole or not at all. Raises SpadError with a sentence.
    """
    target, one_file = ImageTarget.every[format], out.suffix.lower() == Npz.suffix and format == Npz.name
    if not one_file and out.suffix.lower() in {known.suffix for known in ImageTarget.every.values()}:
        raise SpadError(
            f"{out}: {format} is a folder with a file for each shard; name it, for example -o {out.with_suffix('')}"
        )
    found = chosen(root, choice)
    target.check(found)
    progress = progress or Progress()
    progress.start("exporting", sum(block.stop - block.start for block in found.blocks), 0.0)
    size = sum(facts["bytes"] for facts in found.manifest["files"].values())
    if one_file:
        paths = [_one_file(found, out, size)]
    else:
        with disk.whole_folder(out, size) as folder:
            target.write(found, folder, progress)
        paths = sorted(path for path in out.rglob("*") if path.is_file())
    progress.stop()
    return paths


def _one_file(found: Chosen, out: Path, size: int) -> Path:
    places = list(dict.fromkeys((block.level.text, block.split) for block in found.blocks))
    if len(places) > 1:
        named = f'--lux "{places[0][0]}" --split {places[0][1]}'
        raise SpadError(
            f"{out}: one file holds one level and split, and these are {len(places)}; choose them, for example "
            f"{named}, or name a folder with -o"
        )
    if out.exists() or out.is_symlink():
        raise SpadError(f"{out}: is there already, and is not written over; remove it, or name another with -o")
    with disk.whole(out, size) as file:
        Npz.put_columns(found, _joined([block.columns() for block in found.blocks]), file)
    return out


def _joined(blocks: list[list[Column]]) -> list[Column]:
    made = []
    for parts in zip(*blocks, strict=True):
        values, starts = np.concatenate([one.values for one in parts]), None
        if parts[0].starts is not None:
            each = np.concatenate([np.diff(one.starts) for one in parts if one.starts is not None])
            starts = np.concatenate([[0], np.cumsum(each)])
        made.append(Column(parts[0].name, values, parts[0].about, parts[0].unit, starts))
    return made


class Npz(ImageTarget):
    """NumPy archive: an array a column; of one with `NAME_starts`, image i has the entries starts[i] to starts[i + 1].

    Beside them stand how the images were recorded, in s.
    """

    name = "npz"
    suffix = ".npz"
    opened_by = "numpy.load(FILE)"

    @classmethod
    def put(cls, found: Chosen, block: Block, file: IO[bytes]) -> None:
        """All of a block."""
        cls.put_columns(found, block.columns(), file)

    @classmethod
    def put_columns(cls, found: Chosen, columns: Sequence[Column], file: IO[bytes]) -> None:
        """Packed, and without a date, so that the same images give the same bytes."""
        with zipfile.ZipFile(file, "w") as archive:
            for column in columns:
                _member(archive, column.name, column.values)
                if column.starts is not None:
                    _member(archive, f"{column.name}_starts", np.asarray(column.starts, np.int64))
            for name, value in found.facts.items():
                _member(archive, name, np.asarray(value))


def _member(archive: zipfile.ZipFile, name: str, array: np.ndarray) -> None:
    info = zipfile.ZipInfo(f"{name}.npy")
    info.compress_type = zipfile.ZIP_DEFLATED
    with archive.open(info, "w", force_zip64=True) as member:
        np.lib.format.write_array(member, np.asarray(array, order="C"), allow_pickle=False)


def _png(image: np.ndarray) -> bytes | None:
    """An original as PNG; None for one that PNG cannot hold as it is."""
    from PIL import Image

    if image.dtype == np.float32 or (image.ndim == 3 and (len(image) != 3 or image.dtype != np.uint8)):
        return None
    file = io.BytesIO()
    Image.fromarray(_channels_last(image)).save(file, "PNG")
    return file.getvalue()


def _channels_last(image: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(np.moveaxis(image, 0, -1) if image.ndim == 3 else image)


class WebDataset(ImageTarget):
    """Tar files for the library webdataset: of each image `.png` (the original), `.cls`, `.json`, and `.npz`, the rest.

    An original that PNG cannot hold stands in the `.npz`, too.
    """

    name = "webdataset"
    suffix = ".tar"
    opened_by = "webdataset.WebDataset(FILE)"

    @classmethod
    def put(cls, found: Chosen, block: Block, file: IO[bytes]) -> None:
        """Without dates and owners, so that the same images give the same bytes."""
        columns = {column.name: column for column in block.columns()}
        with tarfile.open(fileobj=file, mode="w") as archive:
            for i, number in enumerate(range(block.start, block.stop)):
                said = {"number": number, "split": block.split, "level": block.level.text}
                said |= {block.level.kind: block.level.value, **found.facts}
                members = {"json": json.dumps(said).encode()}
                if "label" in columns:
                    members["cls"] = str(int(columns["label"].values[i])).encode()
                original = _png(columns["image"].values[i])
                rest = {n: c for n, c in columns.items() if n not in ("number", "label", block.level.kind)}
                if original is not None:
                    members["png"] = original
                    del rest["image"]
                if rest:
                    packed = io.BytesIO()
                    with zipfile.ZipFile(packed, "w") as inner:
                        for name, column in rest.items():
                            _member(inner, name, column.of(i))
                    members["npz"] = packed.getvalue()
                for suffix, data in members.items():
                    info = tarfile.TarInfo(f"{number:08d}.{suffix}")
                    info.size = len(data)
                    archive.addfile(info, io.BytesIO(data))


class Png(ImageTarget):
    """Flux images as PNG, `<level>/<split>/<method>/<label>/<number>.png`: 16 bits where they are grey, else 8.

    White is the largest value of the method at that level and split; `scale.json` beside says how much that is.
    """

    name = "png"
    suffix = ".png"
    opened_by = "PIL.Image.open(FILE)"
    of_fluxes = True

    @classmethod
    def check(cls, found: Chosen) -> None:
        """There must be flux images."""
        if not found.blocks[0].methods:
            raise SpadError(
                f"{found.root}: has no flux images, which png holds; make them: spadmnist reconstruct {found.root}"
            )
        if len(found.manifest["images"]["shape"]) == 3 and found.manifest["images"]["shape"][0] != 3:
            raise SpadError(f"{found.root}: has not 1 or 3 channels, as png needs; take npz")

    @classmethod
    def write(cls, found: Chosen, folder: Path, progress: Progress) -> None:
        """First what white is, then the images."""
        from PIL import Image

        tops: dict[str, dict[str, float]] = {}
        for block in found.blocks:
            known = tops.setdefault(f"{block.level.folder}/{block.split}", {})
            for name in block.methods:
                top = float(block.part.reconstruction[name][block.start : block.stop].max(initial=0))
                known[name] = max(known.get(name, 0.0), top)
        for place, known in tops.items():
            (folder / place).mkdir(parents=True)
            scale = {name: {"white": top, "unit": find(name).unit} for name, top in known.items()}
            (folder / place / "scale.json").write_text(json.dumps(scale, indent=1) + "\n")
        for block in found.blocks:
            place = f"{block.level.folder}/{block.split}"
            for name in block.methods:
                fluxes = block.part.reconstruction[name][block.start : block.stop]
                for number, flux in zip(range(block.start, block.stop), fluxes, strict=True):
                    label = "" if block.part.labels is None else f"{block.part.labels[number]}/"
                    path = folder / f"{place}/{name}/{label}{number:05d}.png"
                    path.parent.mkdir(parents=True, exist_ok=True)
                    kind = np.uint16 if flux.ndim == 2 else np.uint8
                    white = np.iinfo(kind).max / (tops[place][name] or 1.0)
                    grey = np.rint(flux.astype(np.float64) * white).astype(kind)
                    Image.fromarray(_channels_last(grey)).save(path)
            progress.advance(block.stop - block.start, block.path)


class Parquet(ImageTarget):
    """Parquet with a card (README.md) and croissant.json: what a hub's loader reads as it is.

    Stamps are written as steps, byte by byte (BYTE_STREAM_SPLIT) under Zstandard: fewer bytes than in the store.
    """

    name = "parquet"
    suffix = ".parquet"
    opened_by = "polars.read_parquet(FILE)"

    @classmethod
    def check(cls, found: Chosen) -> None:
        """The library must be there."""
        try:
            import pyarrow.parquet  # noqa: F401
        except ImportError:
            raise SpadError(
                "--format parquet: needs pyarrow, which is not installed; install it: pip install 'spadmnist[parquet]'"
            ) from None

    @classmethod
    def put(cls, found: Chosen, block: Block, file: IO[bytes]) -> None:
        """One row group: a block is as large as memory should hold."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        columns = block.columns()
        arrays, fields, split = [], [], {}
        for column in columns:
            array = _arrow(column)
            about = {"about": column.about, "unit": column.unit, "shape": json.dumps(column.values.shape[1:])}
            arrays.append(array)
            fields.append(pa.field(column.name, array.type, metadata=about))
            if column.starts is not None:
                split[f"{column.name}.list.element"] = "BYTE_STREAM_SPLIT"
        if block.part.labels is None and _labelled(found).part.labels is not None:
            # all splits have the same columns, as a hub's loader wants them: behind the number
            arrays.insert(1, pa.nulls(block.stop - block.start, pa.uint8()))
            fields.insert(1, pa.field("label", pa.uint8(), metadata={"about": "label: none in this split"}))
        few = [f"{c.name}.list.element" if c.values.ndim > 1 else c.name for c in columns if c.starts is None]
        # how a hub is told that bytes are a picture
        known = {"spadmnist": json.dumps(found.facts)}
        if _is_picture(columns):
            known["huggingface"] = json.dumps({"info": {"features": {"image": {"_type": "Image"}}}})
        table = pa.Table.from_arrays(arrays, schema=pa.schema(fields, metadata=known))
        pq.write_table(
            table, file, compression="zstd", use_dictionary=few, column_encoding=split, row_group_size=len(table)
        )

    @classmethod
    def write(cls, found: Chosen, folder: Path, progress: Progress) -> None:
        """The files, then what describes them."""
        super().write(found, folder, progress)
        names = [f"{block.path}{cls.suffix}" for block in found.blocks]
        columns = _labelled(found).columns()
        (folder / "README.md").write_text(_card(found, columns))
        described = _croissant(found, columns, {name: folder / name for name in names})
        (folder / "croissant.json").write_text(json.dumps(described, indent=1) + "\n")


def _labelled(found: Chosen) -> Block:
    """A block with all columns that there are: labels may be those of one split alone."""
    return next((block for block in found.blocks if block.part.labels is not None), found.blocks[0])


def _is_picture(columns: Sequence[Column]) -> bool:
    (image,) = (column for column in columns if column.name == "image")
    return _png(image.values[0]) is not None


def _arrow(column: Column) -> Any:
    """(images,) of Arrow: numbers, lists of them, bytes of bits, or pictures."""
    import pyarrow as pa

    values = np.ascontiguousarray(column.values)
    if column.starts is not None:
        # a shard has fewer than 2^31 events, as one image has
        return pa.ListArray.from_arrays(pa.array(np.asarray(column.starts, np.int32)), pa.array(values))
    if column.name == "image" and (_png(values[0]) is not None):
        pictures = [{"bytes": _png(image), "path": None} for image in values]
        return pa.array(pictures, pa.struct([("bytes", pa.binary()), ("path", pa.string())]))
    if column.name == "bits":
        return pa.array([one.tobytes() for one in values], pa.binary())
    if values.ndim == 1:
        return pa.array(values)
    return pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), int(np.prod(values.shape[1:])))


# --- what describes Parquet files ---------------------------------------------------------------------------------


def _title(found: Chosen) -> str:
    return str(found.manifest["config"]["sensor"].get("name") or "") or found.root.resolve().name


def _about(found: Chosen) -> str:
    count = len({(block.level.text, block.split) for block in found.blocks})
    return (
        f"Images as a single-photon (SPAD) sensor, {_title(found)}, would have recorded them, simulated by spadmnist: "
        f"an image a row, {count} parts by light level and split."
    )


def _card(found: Chosen, columns: Sequence[Column]) -> str:
    """README.md: what a hub reads at its head, and what the columns are, with the way back to stamps and frames."""
    levels = list(dict.fromkeys(block.level.folder for block in found.blocks))
    splits = list(dict.fromkeys(block.split for block in found.blocks))
    head = ["---", "configs:"]
    for level in levels:
        head += [f"- config_name: {level}", "  data_files:"]
        for split in splits:
            head += [f"  - split: {split}", f"    path: {level}/{split}/*.parquet"]
    shape = " x ".join(map(str, found.manifest["images"]["shape"]))
    table = [f"| `{c.name}` | {c.unit} | {c.about} |" for c in columns]
    lines = [
        *head,
        "---",
        f"# {_title(found)}",
        "",
        _about(found),
        f"Seal of the dataset (SHA-256): `{found.manifest['sha256']}`.",
        f"Images are {shape} pixels; the values of an image stand row by row.",
        "",
        "| column | unit | what |",
        "| --- | --- | --- |",
        *table,
        "",
        *_taken_apart(found, {column.name for column in columns}),
        "The config, with nothing left open:",
        "",
        "```yaml",
        document.dump(dict(found.manifest["config"])).rstrip("\n"),
        "```",
    ]
    return "\n".join(lines) + "\n"


_TICKS = """\
def stamps(row):  # TR: of each pixel its stamps, in ticks
    each = np.split(np.asarray(row["ticks"]), np.cumsum(row["counts"])[:-1])
    return [np.cumsum(steps, dtype=np.uint64) for steps in each]
"""
_TIMES = """\
def stamps(row):  # TR: of each pixel its stamps, in s
    return np.split(np.asarray(row["times"]), np.cumsum(row["counts"])[:-1])
"""
_BITS = """\
def frames(row):  # QIS: (frames, *shape), 0 or 1
    packed = np.frombuffer(row["bits"], np.uint8).reshape(*facts["shape"], -1)
    return np.moveaxis(np.unpackbits(packed, axis=-1, count=facts["frames"]), -1, 0)
"""
_FLUX = """\
def flux(row, method):
    return np.asarray(row[f"flux_{method}"], np.float32).reshape(facts["shape"])
"""


def _taken_apart(found: Chosen, columns: Set[str]) -> list[str]:
    """Lines of Python that make stamps, frames and fluxes of the columns that there are."""
    facts = {"shape": list(found.manifest["images"]["shape"]), **found.facts}
    parts = [code for name, code in (("ticks", _TICKS), ("times", _TIMES), ("bits", _BITS)) if name in columns]
    parts += [_FLUX] if any(name.startswith("flux_") for name in columns) else []
    code = "\n\n".join([f"import numpy as np\n\nfacts = {facts!r}  # s\n", *parts])
    return ["A row, taken apart:", "", "```python", code.rstrip("\n"), "```", ""]


# what Croissant's words stand for, as its 1.0 prescribes it
_CONTEXT = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "sc": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "dct": "http://purl.org/dc/terms/",
    **{
        name: f"cr:{name}"
        for name in (
            *("citeAs", "column", "extract", "field", "fileObject", "fileProperty", "fileSet", "format", "includes"),
            *("isLiveDataset", "jsonPath", "key", "md5", "parentField", "path", "recordSet", "references", "regex"),
            *("repeated", "replace", "separator", "source", "subField", "transform"),
        )
    },
    "conformsTo": "dct:conformsTo",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
}


def _croissant(found: Chosen, columns: Sequence[Column], files: Mapping[str, Path]) -> dict[str, Any]:
    """croissant.json: each file with its SHA-256, and the columns of each level and split."""
    distribution = [
        {
            "@type": "cr:FileObject",
            "@id": name,
            "name": name,
            "contentUrl": name,
            "contentSize": f"{path.stat().st_size} B",
            "encodingFormat": "application/x-parquet",
            "sha256": _sha256(path),
        }
        for name, path in files.items()
    ]
    records = [
        {
            "@type": "cr:RecordSet",
            "@id": f"rows/{name}",
            "name": f"rows of {name}",
            "field": [
                {
                    "@type": "cr:Field",
                    "@id": f"rows/{name}/{column.name}",
                    "name": column.name,
                    "description": f"{column.about} ({column.unit})",
                    "dataType": _data_type(column),
                    **({"repeated": True} if _is_list(column) else {}),
                    "source": {"fileObject": {"@id": name}, "extract": {"column": column.name}, **_within(column)},
                }
                for column in columns
            ],
        }
        for name in files
    ]
    return {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": _title(found),
        "description": _about(found),
        "identifier": found.manifest["sha256"],
        "version": "1.0.0",
        "distribution": distribution,
        "recordSet": records,
    }


def _within(column: Column) -> dict[str, Any]:
    """A picture is bytes beside a name."""
    return {"transform": {"jsonPath": "bytes"}} if _data_type(column) == "sc:ImageObject" else {}


def _is_list(column: Column) -> bool:
    return column.name not in ("image", "bits") and (column.starts is not None or column.values.ndim > 1)


def _data_type(column: Column) -> str:
    if column.name == "image" and _png(column.values[0]) is not None:
        return "sc:ImageObject"
    if column.name == "bits":
        return "sc:Text"
    return "sc:Float" if column.values.dtype.kind == "f" else "sc:Integer"


def _sha256(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
