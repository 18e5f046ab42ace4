"""Where the images come from: MNIST, IDX files, folders, arrays, digits drawn here, uniform light, charts.

Each source is one class, chosen in a config by `scene.images: {source: NAME, ...}`; `load` gives the splits.
Whatever a file contains, the outcome is the images or an InputError that names the file and what to do:
nothing is executed or unpickled, and nothing is read beyond what the file itself can hold.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import sys
import tempfile
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import IO, Annotated, Any, Literal

import numpy as np
import platformdirs
from pydantic import Field, PlainValidator, WithJsonSchema, model_validator

from . import disk, image_files, large, tiles
from .digits import draw_digit
from .errors import InputError, SpadError
from .events import MOST_PIXELS
from .image_files import another, idx_bytes, idx_sha256, read_idx, read_image, read_member, read_npy, reason
from .photos import Making
from .section import LATER, Section
from .tiles import Tiles

# SHA-256 of the unpacked files: packed copies differ from mirror to mirror
MNIST_SHA256 = {
    "train-images-idx3-ubyte": "ba891046e6505d7aadcbbe25680a0738ad16aec93bde7f9b65e87a2fc25776db",
    "train-labels-idx1-ubyte": "65a50cbbf4e906d70832878ad85ccda5333a97f0f4c3dd2ef09a8a9eef7101c5",
    "t10k-images-idx3-ubyte": "0fa7898d509279e482958e8ce81c8e77db3f2f8254e26661ceb7762c4d494ce7",
    "t10k-labels-idx1-ubyte": "ff7bcfd416de33731a308c3f266cc351222c34898ecbeaf847f06e48f7ec33f2",
}
MNIST_MIRRORS = (
    "https://ossci-datasets.s3.amazonaws.com/mnist/",
    "https://storage.googleapis.com/cvdf-datasets/mnist/",
)
_MNIST_MAX_BYTES = 64 * 2**20  # no mirror may send more than this for one file
_GZIP_TAIL = 8  # bytes at the end of a gzip file: CRC-32 and size of its content (RFC 1952)

_SUFFIXES = (
    *(".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp"),
    *(".pgm", ".ppm", ".pnm", ".pbm", ".gif", ".webp"),
)


@dataclass(frozen=True, eq=False)
class Images:
    """The images of one split; the arrays are read-only.

    pixels       (n, rows, columns), or (n, channels, rows, columns) in colour; uint8, uint16 or float32, all
                 from 0 to `white`; C-contiguous, except that repetitions of one image share its memory
    labels       (n,) uint8, or None where the source has none
    white        the grey level that the sensor's reference lux stands for
    names        the file of each image, relative to the folder, where the source is a folder
    label_names  the class folder that each label stands for, where the source is a folder with classes
    ignored      how many files of the folder were left out because they are not images
    unused       how many pictures lie in each folder that is neither train nor test; "": in no folder
    transparent  how many pictures of the folder had transparent parts, which are black
    tiles        where the tiles lie and which images they are, where the images are charts
    """

    pixels: np.ndarray
    labels: np.ndarray | None
    white: float
    names: tuple[str, ...] | None = None
    label_names: tuple[str, ...] | None = None
    ignored: int = 0
    tiles: Tiles | None = None
    transparent: int = 0
    unused: Mapping[str, int] = field(default_factory=dict)
    _means: dict[int, float] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        if self.pixels.ndim not in (3, 4) or self.pixels.dtype not in (np.uint8, np.uint16, np.float32):
            raise ValueError(f"pixels must not be {self.pixels.dtype} of shape {self.pixels.shape}")
        if self.labels is not None and (self.labels.dtype != np.uint8 or self.labels.shape != self.pixels.shape[:1]):
            raise ValueError(f"labels must not be {self.labels.dtype} of shape {self.labels.shape}")
        for name in ("pixels", "labels"):
            array = getattr(self, name)
            if array is not None:
                view = array.view()
                view.flags.writeable = False
                object.__setattr__(self, name, view)

    def __len__(self) -> int:
        return len(self.pixels)

    @property
    def size(self) -> tuple[int, int]:
        """(rows, columns) of every image."""
        rows, columns = self.pixels.shape[-2:]
        return rows, columns

    @cached_property
    def sha256(self) -> str:
        """The identity of the images: a digest of dtype, shape, pixels and labels.

        Repetitions that share their memory are hashed once, whatever their number.
        """
        pixels = self.pixels[:1] if self.pixels.strides[0] == 0 else self.pixels
        digest = hashlib.sha256(f"{pixels.dtype.name} {self.pixels.shape}".encode())
        for _, some in large.blocks(pixels):
            digest.update(np.ascontiguousarray(some).data)
        if self.labels is not None:
            digest.update(b"labels")
            digest.update(np.ascontiguousarray(self.labels).data)
        return digest.hexdigest()

    @property
    def in_memory(self) -> bool:
        """Do all images lie in memory? Not large ones, which lie in a file, nor repetitions of one."""
        return self.pixels.nbytes <= large.IN_MEMORY and self.pixels.strides[0] != 0

    def mean(self, n: int) -> float:
        """The mean grey level of the first `n` images, or of all."""
        if n not in self._means:  # there may be as many as fill a disk, and each shard asks for it
            self._means[n] = large.mean(self.pixels[: 1 if self.pixels.strides[0] == 0 else n])
        return self._means[n]

    def some(self, start: int, stop: int) -> np.ndarray:
        """The pixels of the images from `start` to `stop`, apart from the others where those lie in a file."""
        part = self.pixels[start:stop]
        if self.pixels.nbytes <= large.IN_MEMORY or self.pixels.strides[0] == 0:
            return part
        part = part.copy()
        large.release(self.pixels)
        return part

    def head(self, n: int | None) -> Images:
        """The first `n` images (all where `n` is None), in memory of their own so that the rest can go."""
        if n is None or n >= len(self):
            return self
        pixels = self.pixels[:n]
        if pixels.strides[0] != 0:
            pixels = large.copied(pixels)
        labels = None if self.labels is None else self.labels[:n].copy()
        names = None if self.names is None else self.names[:n]
        return replace(self, pixels=pixels, labels=labels, names=names)

    def repeated(self, times: int) -> Images:
        """Every image, with its label and name, `times` times, one after the other; of one image no memory is used."""
        if times == 1:
            return self
        if len(self) == 1:
            pixels = np.broadcast_to(self.pixels, (times, *self.pixels.shape[1:]))
        else:
            pixels = large.repeated(self.pixels, times)
        labels = None if self.labels is None else np.repeat(self.labels, times)
        names = None if self.names is None else tuple(name for name in self.names for _ in range(times))
        return replace(self, pixels=pixels, labels=labels, names=names)

    def describe(self) -> str:
        """One line for people: `400 images of 28 x 28, uint8, 10 classes`."""
        shape = " x ".join(str(n) for n in self.pixels.shape[1:])
        parts = [f"{len(self)} images of {shape}", self.pixels.dtype.name]
        if self.labels is not None:
            parts.append(f"{len(np.unique(self.labels))} classes")
        if self.ignored:
            parts.append(f"{self.ignored} files that are not images left out")
        if self.unused:
            number = sum(self.unused.values())
            parts.append(f"{number} image{'s' * (number > 1)} in neither train nor test left out")
        return ", ".join(parts)


_NAMED = 12  # classes that are said one by one


def notes(splits: Mapping[str, Images]) -> list[str]:
    """What of a folder of pictures its files do not show, a sentence each: labels, and what was left out or blackened.

    Nothing of other sources.
    """
    said = []
    classes = next((part.label_names for part in splits.values() if part.label_names), None)
    if classes:
        named = ", ".join(f"{i} {name}" for i, name in enumerate(classes[:_NAMED]))
        more = len(classes) - _NAMED
        said.append(f"the labels are the class folders: {named}{f' and {more} more' if more > 0 else ''}")
        bare = [split for split, part in splits.items() if part.labels is None]
        said += [f"the {split} images lie in no class folders, and have no labels" for split in bare]
    for part in splits.values():
        said += [_left_out(place, count) for place, count in part.unused.items()]
    if ignored := sum(part.ignored for part in splits.values()):
        held = "1 file of the folder is no image and is" if ignored == 1 else f"{ignored:,} files are no images and are"
        said.append(f"{held} left out")
    if transparent := sum(part.transparent for part in splits.values()):
        shown = "1 picture has" if transparent == 1 else f"{transparent:,} pictures have"
        said.append(f"{shown} transparent parts, which are black")
    return said


def _left_out(place: str, count: int) -> str:
    """A note on pictures that are in no split."""
    held = "1 picture is" if count == 1 else f"{count:,} pictures are"
    if not place:
        return f"{held} in the folder itself, and neither in train/ nor in test/: left out"
    return f"{held} in {place}/, which is neither train nor test, and left out"


def check_size(images: dict[str, Images], shape: tuple[int, int], place: str) -> None:
    """Raise InputError unless all images have the (rows, columns) `shape` of the sensor's layout.

    `place` says where the images were named, for the message.
    """
    for split, part in images.items():
        if part.size == tuple(shape):
            continue
        rows, columns = part.size
        problem = (
            f"{place}: the {split} images are {rows} x {columns} pixels (rows x columns), "
            f"but the sensor's layout is {shape[0]} x {shape[1]}; "
        )
        if part.pixels.shape[1:3] == tuple(shape):
            problem += "colour channels come before the rows: store np.moveaxis(images, -1, 1)"
        else:
            problem += "set sensor.layout to the size of the images, or give images of the sensor's size"
            if part.names is not None:
                problem += f" (of a folder: resize: [{shape[0]}, {shape[1]}] in scene.images)"
        raise InputError(problem)


class _Source(Section):
    """What every source shares. `load` is for callers; each source writes `_read` and `describe`."""

    source: str
    repetitions: Annotated[int, LATER] = Field(
        default=1, ge=1, le=1_000_000, description="how often each image comes, one after the other"
    )

    def load(
        self,
        shape: tuple[int, int],
        images_dir: Path | None = None,
        base: Path = Path("."),
        limit: int | None = None,
    ) -> dict[str, Images]:
        """The splits, "train" first, then "test" where there is one; a single split is "train".

        shape       (rows, columns) of the sensor's layout; only `uniform` makes its images by it
        images_dir  the folder given on the command line, where image files are looked for, or a folder of pictures
        base        the folder of the config file, to which relative paths in it refer
        limit       only the first images of each split

        Raises InputError with the file and what to do.
        """
        if limit is not None and limit < 1:
            raise InputError(f"a limit of {limit} images leaves nothing; give 1 or more")
        try:
            if images_dir is not None and not images_dir.is_dir():
                raise InputError(f"{images_dir}: there is no such folder; correct --images-dir")
            if images_dir is not None and self.drawn() is not None:
                raise InputError(
                    f"--images-dir {images_dir}: {self.describe()} are made here, and no folder is read; leave it out"
                )
            least = None if limit is None else -(-limit // self.repetitions)
            splits = self._read(shape, images_dir, base, least)
            self._check_room(splits)
            splits = {split: part.repeated(self.repetitions).head(limit) for split, part in splits.items()}
        except OSError as error:
            place = error.filename or self.describe()
            raise InputError(
                f"{place}: cannot be opened ({error.strerror or reason(error)}); check the path and its permissions"
            ) from error
        except MemoryError as error:
            raise InputError(
                f"{self.describe()}: the images do not fit into memory; give fewer or smaller ones"
            ) from error
        kinds = [f"{part.pixels.shape[1:]} {part.pixels.dtype}" for part in splits.values()]
        if len(set(kinds)) > 1:
            raise InputError(
                f"{self.describe()}: the train images are {kinds[0]}, the test images {kinds[1]}; "
                "convert one so that both splits are of one size and kind"
            )
        return splits

    def _check_room(self, splits: dict[str, Images]) -> None:
        """Raise InputError where the repetitions of several images take more than is allowed."""
        several = sum(part.pixels.nbytes for part in splits.values() if len(part) > 1)
        if self.repetitions > 1 and several * self.repetitions > image_files.MAX_BYTES:
            raise InputError(
                f"scene.images: {self.repetitions} repetitions of {self.describe()} take more than the "
                f"{image_files.MAX_BYTES} bytes allowed; ask for fewer, or for fewer images (--limit)"
            )

    def _read(
        self, shape: tuple[int, int], images_dir: Path | None, base: Path, limit: int | None
    ) -> dict[str, Images]:
        """The splits, each image once; of each split the first `limit` images will do."""
        raise NotImplementedError

    def drawn(self) -> int | None:
        """How many images there will be, where they are drawn; None where they are read."""
        return None

    def describe(self) -> str:
        """The source in a few words, without reading anything."""
        raise NotImplementedError


def _data_dir() -> Path | None:
    """The folder that SPADMNIST_DATA names, if it is set."""
    value = os.environ.get("SPADMNIST_DATA")
    if not value:
        return None
    if not Path(value).is_dir():
        raise InputError(f"SPADMNIST_DATA={value}: there is no such folder; correct the variable or unset it")
    return Path(value)


def _find(path: str, images_dir: Path | None, folders: Sequence[Path | None]) -> Path:
    """The file `path` of a config: in `images_dir` where that is given, else in the first of the folders that has it.

    An absolute path stands for itself; where `images_dir` is given the file of its name is looked for there.
    """
    if images_dir is not None:
        places = [images_dir / (Path(path).name if Path(path).is_absolute() else path)]
    else:
        places = list(dict.fromkeys(folder / path for folder in folders if folder is not None))
    return _first("file", places, Path.is_file)


def _first(what: str, places: Sequence[Path], exists: Callable[[Path], bool]) -> Path:
    """The first of the places that is there."""
    for place in places:
        if exists(place):
            return place
    tried = " and no ".join(str(place) for place in places)
    raise InputError(
        f"scene.images: there is no {what} {tried}; "
        "a relative path refers to --images-dir or, without it, to the folder of the config: give --images-dir DIR, or "
        "write another path"
    )


def _find_folder(path: str, images_dir: Path | None, base: Path) -> Path:
    """The folder `path` of a config; where `images_dir` is given the one in it of that relative path, or itself."""
    if images_dir is None:
        return _first("folder", [base / path], Path.is_dir)
    inner = images_dir if Path(path).is_absolute() else images_dir / path
    return inner if inner.is_dir() else images_dir


# --- IDX files -------------------------------------------------------------------------------------------


def _labelled(images: np.ndarray, labels: np.ndarray | None, white: float, files: tuple[object, object]) -> Images:
    """Images and labels of the two `files` together, if their numbers agree."""
    if labels is not None and len(labels) != len(images):
        raise InputError(
            f"{files[1]}: it has {len(labels)} labels, but {files[0]} has {len(images)} images; "
            "name two files that belong together"
        )
    return Images(images, labels, white)


class Idx(_Source):
    """IDX files as MNIST and its relatives use them, packed by gzip or not.

    Relative paths refer to --images-dir; without it to SPADMNIST_DATA, then to the folder of the config. With
    --images-dir the files of absolute paths are looked for there by their names.
    """

    source: Literal["idx"] = "idx"
    train_images: str = Field(min_length=1, description="IDX file of images (n, rows, columns), bytes")
    train_labels: str | None = Field(default=None, min_length=1, description="IDX file of labels (n,), bytes")
    test_images: str | None = Field(default=None, min_length=1, description="as train_images, for the test split")
    test_labels: str | None = Field(default=None, min_length=1, description="as train_labels, for the test split")
    transpose: bool = Field(default=False, description="swap rows and columns, as EMNIST's files need")

    def describe(self) -> str:
        return f"IDX files {self.train_images}" + (f" and {self.test_images}" if self.test_images else "")

    def _read(
        self, shape: tuple[int, int], images_dir: Path | None, base: Path, limit: int | None
    ) -> dict[str, Images]:
        if self.test_labels and not self.test_images:
            raise InputError(f"scene.images.test_labels: {self.test_labels} labels nothing; give test_images too")
        folders = [] if images_dir is not None else [_data_dir(), base]
        splits = {}
        for split, images_name, labels_name in (
            ("train", self.train_images, self.train_labels),
            ("test", self.test_images, self.test_labels),
        ):
            if images_name is None:
                continue
            images_file = _find(images_name, images_dir, folders)
            labels_file = _find(labels_name, images_dir, folders) if labels_name else None
            images = read_idx(images_file, 3)
            labels = read_idx(labels_file, 1) if labels_file else None
            part = _labelled(images, labels, 255.0, (images_file, labels_file)).head(limit)
            if self.transpose:
                part = replace(part, pixels=large.converted(part.pixels.swapaxes(1, 2), np.uint8))
            splits[split] = part
        return splits


# --- MNIST -----------------------------------------------------------------------------------------------


class Mnist(_Source):
    """MNIST, 60,000 training and 10,000 test images of 28 x 28, byte for byte.

    Looked for in --images-dir or, without it, in SPADMNIST_DATA and in the user's cache, and downloaded into
    the cache once. A packed file is unpacked into the cache once. Every file's SHA-256 is checked each time.
    """

    source: Literal["mnist"] = "mnist"

    def describe(self) -> str:
        return "MNIST"

    def _read(
        self, shape: tuple[int, int], images_dir: Path | None, base: Path, limit: int | None
    ) -> dict[str, Images]:
        folder = images_dir if images_dir is not None else _data_dir()
        found = {name: _find_mnist(name, folder) if folder else None for name in MNIST_SHA256}
        missing = [name for name, path in found.items() if path is None]
        if images_dir is not None and missing:
            raise InputError(
                f"{images_dir}: MNIST's {', '.join(missing)} (or with .gz) are missing; put the files there, "
                "or leave --images-dir out to have them downloaded"
            )
        arrays = [_mnist(path, name) if path else _cached_mnist(name) for name, path in found.items()]
        train_images, train_labels, test_images, test_labels = arrays
        return {
            "train": Images(train_images, train_labels, 255.0).head(limit),
            "test": Images(test_images, test_labels, 255.0).head(limit),
        }


def _find_mnist(name: str, folder: Path) -> Path | None:
    """MNIST's file under one of its usual names: packed or not, `.idx3` for `-idx3`, torchvision's folder."""
    for place in (folder, folder / "MNIST" / "raw"):
        for stem in (name, name.replace("-idx", ".idx")):
            for path in (place / stem, place / f"{stem}.gz"):
                if path.is_file():
                    return path
    return None


def _mnist(path: Path, name: str) -> np.ndarray:
    """MNIST's file; what is packed is taken unpacked from the user's cache, where it is put the first time.

    The checksum at the end of a packed file names what is in it: another file of the same name is unpacked, and
    refused. A damaged copy in the cache is made again; without a cache every run unpacks.
    """
    kept = None
    if path.suffix == ".gz":
        with path.open("rb") as file:
            file.seek(max(0, path.stat().st_size - _GZIP_TAIL))
            kept = cache_folder() / "unpacked" / f"{name}-{file.read(4).hex()}"
        with contextlib.suppress(InputError, OSError):
            return _checked_mnist(kept, name)
    array = _checked_mnist(path, name)
    if kept is not None:
        with contextlib.suppress(OSError, SpadError):
            kept.parent.parent.mkdir(parents=True, exist_ok=True)
            kept.parent.mkdir(mode=0o700, exist_ok=True)
            disk.commit_file(kept, idx_bytes(array), kept.parent)
    return array


def _checked_mnist(path: Path, name: str) -> np.ndarray:
    array = read_idx(path, 3 if "images" in name else 1)
    digest = idx_sha256(array)
    if digest != MNIST_SHA256[name]:
        raise InputError(
            f"{path}: this is not MNIST's {name}: its unpacked SHA-256 is {digest}, MNIST's is "
            f"{MNIST_SHA256[name]}; fetch it again, or use {{source: idx, ...}} if other images are meant"
        )
    return array


def cache_folder() -> Path:
    """Where the program keeps what it can make or fetch again: `$SPADMNIST_CACHE`, or the system's place for it."""
    return Path(os.environ.get("SPADMNIST_CACHE") or platformdirs.user_cache_dir("spadmnist"))


def _pooch() -> Any:
    """The library, without the warning of its progress bar where a notebook lacks ipywidgets: no bar is asked for."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import pooch
    return pooch


def _cached_mnist(name: str) -> np.ndarray:
    """MNIST's file from the user's cache; downloaded if it is not there, or there but damaged."""

    path = cache_folder() / "mnist" / f"{name}.gz"
    if path.is_file():
        with contextlib.suppress(InputError):
            return _mnist(path, name)
    return _download_mnist(name, path)


def _download_mnist(name: str, path: Path) -> np.ndarray:
    """Fetch the file from the first mirror that sends the right one; only a verified one comes to `path`."""
    pooch = _pooch()
    path.parent.mkdir(parents=True, exist_ok=True)
    show = sys.stderr is not None and sys.stderr.isatty()
    download = pooch.HTTPDownloader(progressbar=show, chunk_size=2**16, timeout=(10, 60))
    failures = []
    for mirror in MNIST_MIRRORS:
        handle, part_name = tempfile.mkstemp(prefix=f"{name}.", suffix=".part", dir=path.parent)
        part = Path(part_name)
        try:
            with os.fdopen(handle, "wb") as file:
                download(mirror + path.name, _AtMost(file, _MNIST_MAX_BYTES), None)
            array = _checked_mnist(part, name)
            os.replace(part, path)
            return array
        except InputError:
            failures.append(f"{mirror}: it sends another file")
        # the errors of requests are OSErrors, and long where they come from the network
        except (OSError, ValueError) as error:
            failures.append(f"{mirror}: {reason(error)}")
        finally:
            part.unlink(missing_ok=True)
    raise InputError(
        f"MNIST's {path.name} could not be downloaded from any mirror ({'; '.join(failures)}); go online, "
        "or fetch MNIST's four files elsewhere and name their folder by --images-dir or SPADMNIST_DATA"
    )


class _AtMost:
    """A file to write to that refuses to grow beyond `most` bytes, so that no mirror can fill the disk."""

    def __init__(self, file: IO[bytes], most: int):
        self._file = file
        self._left = most

    def write(self, data: bytes) -> int:
        self._left -= len(data)
        if self._left < 0:
            raise OSError("it sends far more than the file has")
        return self._file.write(data)

    def flush(self) -> None:
        self._file.flush()


# --- folders of images -----------------------------------------------------------------------------------


_SIDE = {"type": "integer", "minimum": 1}
_SIZE = {"anyOf": [_SIDE, {"type": "array", "items": _SIDE, "minItems": 2, "maxItems": 2}, {"type": "null"}]}


def _size(raw: object) -> list[int] | None:
    """[rows, columns]; one number stands for both."""
    size: Any = [raw, raw] if isinstance(raw, int) else raw
    if raw is None:
        return None
    whole = isinstance(size, list) and len(size) == 2 and all(type(n) is int and n >= 1 for n in size)
    if whole and size[0] * size[1] <= MOST_PIXELS:
        return size
    raise ValueError(
        f"{raw!r:.60} is not a size; write one number of pixels for rows and columns, resize: 28, or both, "
        f"resize: [rows, columns], each at least 1, together at most {MOST_PIXELS:,}"
    )


class Folder(_Source):
    """A folder of images, grey or colour, all of one size and one kind, or brought to that.

    With `train` and `test` folders in it these are the splits and all else is left out. Inside a split the
    first folder is the class; labels count the classes of both splits in alphabetical order. The order of the
    images is that of their paths. Hidden files and files that are not images by their suffix are left out.
    Pixel values are taken for light as they are stored, unless `gamma: srgb` takes them back to light: the value
    128 then gets 22 % of white's photons, not 50 %. Transparent parts are black. EXIF orientation is ignored without
    `exif`, colour profiles always. Pictures with palettes (GIF, some PNG) are grey where none of the folder has a
    colour. A relative path refers to the folder of the config. --images-dir stands for the path: it is the folder, or
    the one that a relative path refers to.
    """

    source: Literal["folder"] = "folder"
    path: str = Field(min_length=1, description="the folder")
    white: float | None = Field(default=None, gt=0, description="the grey level of white; 255, or 65535 for 16 bits")
    resize: Annotated[Any, PlainValidator(_size), WithJsonSchema(_SIZE), LATER] = Field(
        default=None, description="the size that pictures are brought to: N, or [rows, columns]; light is averaged"
    )
    fit: Annotated[Literal["crop", "pad", "stretch"], LATER] = Field(
        default="crop", description="for resize, where the sides differ: cut what is over, pad with black, or stretch"
    )
    grey: Annotated[bool, LATER] = Field(default=False, description="make grey of colour: its luminance (Rec. 709)")
    gamma: Annotated[Literal["linear", "srgb"], LATER] = Field(
        default="linear",
        description="what pixel values are: linear, photons in proportion to them, or srgb, as of nearly all pictures: "
        "the value 128 then gets 22 % of white's photons, not 50 %",
    )
    exif: Annotated[bool, LATER] = Field(default=False, description="turn photographs as their EXIF orientation says")

    @model_validator(mode="after")
    def _fits_a_size(self) -> Folder:
        if self.resize is None and "fit" in self.model_fields_set:
            raise ValueError("fit says how pictures come to a size, and there is none; add resize, or take fit out")
        return self

    @property
    def making(self) -> Making:
        """How a picture becomes an image."""
        size = None if self.resize is None else (self.resize[0], self.resize[1])
        return Making(size, self.fit, self.grey, self.gamma)

    def describe(self) -> str:
        return f"folder {self.path}"

    def _read(
        self, shape: tuple[int, int], images_dir: Path | None, base: Path, limit: int | None
    ) -> dict[str, Images]:
        root = _find_folder(self.path, images_dir, base)
        names, ignored = pictures_in(root)
        prefixes = {split: f"{split}/" for split in ("train", "test") if (root / split).is_dir()}
        if list(prefixes) == ["test"]:
            raise InputError(
                f"{root}: it has a folder test but no folder train; add train, or set path to {root / 'test'}"
            )
        prefixes = prefixes or {"train": ""}
        files = {split: [name for name in names if name.startswith(p)] for split, p in prefixes.items()}
        taken = {name for part in files.values() for name in part}
        folders = (PurePosixPath(name).parts[:-1] for name in names if name not in taken)
        unused = dict(Counter(parts[0] if parts else "" for parts in folders))
        classes = {split: _classes(root, prefixes[split], part) for split, part in files.items()}
        label_names = sorted({name for part in classes.values() if part for name in part})
        if len(label_names) > 256:
            raise InputError(
                f"{root}: it has {len(label_names)} class folders, at most 256 are allowed; merge some, "
                "or put all images into one folder to go without labels"
            )
        number = {name: i for i, name in enumerate(label_names)}
        for split, part in files.items():
            if not part:
                allowed = ", ".join(_SUFFIXES)
                raise InputError(f"{root / prefixes[split]}: there is no image in it; put some there ({allowed})")
        found = _read_splits(root, {split: part[:limit] for split, part in files.items()}, self)
        splits = {}
        for split, part in files.items():
            of_part, (pixels, transparent) = classes[split], found[split]
            splits[split] = Images(
                pixels,
                None if of_part is None else np.array([number[c] for c in of_part[:limit]], np.uint8),
                self.making.white(_white(self.white, pixels.dtype)),
                tuple(part[:limit]),
                None if of_part is None else tuple(label_names),
                ignored if split == "train" else 0,
                transparent=transparent,
                unused=unused if split == "train" else {},
            )
        return splits


def _white(given: float | None, dtype: np.dtype[Any]) -> float:
    """The grey level of white: as given, or the largest that an integer type holds, or 1 for floats."""
    if given is not None:
        return float(given)
    return float(np.iinfo(dtype).max) if dtype.kind == "u" else 1.0


def pictures_in(root: Path) -> tuple[list[str], int]:
    """The image files below `root`, as relative paths in their order, and the number of other files.

    Raises InputError for a link that leads back, and for a name that is no text; OSError as the system does.
    """

    def fail(error: OSError) -> None:
        raise error

    names, others, seen = [], 0, set()
    for folder, subfolders, files in os.walk(root, onerror=fail, followlinks=True):
        real = os.path.realpath(folder)
        if real in seen:
            raise InputError(f"{folder}: this folder is reached twice, by a link; remove the link")
        seen.add(real)
        subfolders[:] = [name for name in subfolders if not name.startswith(".")]
        for name in files:
            if name.startswith("."):
                continue
            path = Path(folder, name)
            if path.suffix.lower() not in _SUFFIXES:
                others += 1
                continue
            relative = path.relative_to(root).as_posix()
            if not _is_text(relative):
                raise InputError(f"{root}: the file name {relative!a} is not valid UTF-8; rename the file")
            names.append(relative)
    return sorted(names), others


def _is_text(name: str) -> bool:
    try:
        name.encode()
    except UnicodeEncodeError:
        return False
    return True


def _classes(root: Path, prefix: str, names: list[str]) -> list[str] | None:
    """The class of each file: its first folder after `prefix`. None where no file lies in one."""
    inner = [PurePosixPath(name.removeprefix(prefix)).parts for name in names]
    if all(len(parts) == 1 for parts in inner):
        return None
    for name, parts in zip(names, inner, strict=True):
        if len(parts) == 1:
            raise InputError(f"{root / name}: it lies beside class folders, in none of them; move it into one")
    return [parts[0] for parts in inner]


class _Unlike(InputError):
    """An image is of another size or kind than the first."""


_Read = tuple[np.ndarray, int]  # images, and how many of them had transparent parts


def _read_splits(root: Path, files: dict[str, list[str]], how: Folder) -> dict[str, _Read]:
    """The images of each split. Pictures whose palettes hold greys alone are grey where all others are, too.

    Beside pictures in colour they are colour: one of a folder of colour pictures may happen to have none.
    """

    def read(grey_palettes: bool) -> dict[str, _Read]:
        return {split: _read_folder(root, names, how, grey_palettes) for split, names in files.items()}

    try:
        splits = read(True)
        if len({pixels.ndim for pixels, _ in splits.values()}) == 1:
            return splits
        unlike = None
    except _Unlike as error:
        unlike = error
    try:
        return read(False)
    except _Unlike:
        if unlike is None:
            return splits
        raise unlike from None


def _read_folder(root: Path, names: list[str], how: Folder, grey_palettes: bool) -> _Read:
    """All images, (n, rows, columns) or (n, 3, rows, columns), after checking that they are alike."""
    first, clear = _read_picture(root / names[0], how, grey_palettes)
    if first.nbytes * len(names) > image_files.MAX_BYTES:
        raise InputError(
            f"{root}: {len(names)} images like {names[0]} take more than the {image_files.MAX_BYTES} bytes allowed; "
            "give fewer (--limit) or smaller ones"
        )
    pixels = large.empty((len(names), *first.shape), first.dtype)
    transparent, fresh = 0, 0  # fresh: bytes that lie in memory
    for i, name in enumerate(names):
        image, clear = _read_picture(root / name, how, grey_palettes) if i else (first, clear)
        if (image.shape, image.dtype) != (first.shape, first.dtype):
            raise _Unlike(
                f"{root / name}: it is {_kind(image)}, but {names[0]} is {_kind(first)}; "
                "all images must be of one size and kind: set resize, or grey, or convert or remove those that differ"
            )
        pixels[i] = image
        transparent += clear
        fresh = large.kept_low(pixels, fresh + image.nbytes)
    return pixels, transparent


def _read_picture(path: Path, how: Folder, grey_palettes: bool) -> tuple[np.ndarray, bool]:
    """The image that is made of a picture, and whether parts of that are transparent."""
    pixels, alpha = read_image(path, grey_palettes, how.exif)
    top = _white(how.white, pixels.dtype)
    if pixels.max() > top:
        raise InputError(
            f"{path}: it has the grey level {pixels.max()}, but white is {top:g}; raise white or correct the image"
        )
    return how.making.image(pixels, alpha, top), alpha is not None


def _kind(image: np.ndarray) -> str:
    rows, columns = image.shape[-2:]
    kind = "colour" if image.ndim == 3 else "grey"
    return f"{rows} x {columns} pixels (rows x columns), {8 * image.itemsize}-bit {kind}"


# --- arrays ----------------------------------------------------------------------------------------------

# (images, labels) of the train and the test split, as they are called in .npz files
_NPZ_NAMES = (
    (("train_images", "train_labels"), ("test_images", "test_labels")),
    (("x_train", "y_train"), ("x_test", "y_test")),
    (("images", "labels"),),
)


class Array(_Source):
    """A NumPy file: `.npy` with images, or `.npz` with images and labels.

    Images are (n, rows, columns) or (n, channels, rows, columns). The names in an `.npz` are train_images,
    train_labels, test_images, test_labels, or x_train, y_train, x_test, y_test, or images and labels.
    A relative path refers to --images-dir or, without it, to the folder of the config. With --images-dir the file of
    an absolute path is looked for there by its name.
    """

    source: Literal["array"] = "array"
    path: str = Field(min_length=1, description=".npy or .npz file")
    white: float | None = Field(
        default=None,
        gt=0,
        description="the grey level of white; 255 for uint8, 65535 for uint16, 1 for floats",
    )

    def describe(self) -> str:
        return f"array {self.path}"

    def _read(
        self, shape: tuple[int, int], images_dir: Path | None, base: Path, limit: int | None
    ) -> dict[str, Images]:
        path = _find(self.path, images_dir, [base])
        with disk.opened(path) as file:
            head = file.read(image_files.HEAD)
            file.seek(0)
            if head.startswith(b"\x93NUMPY"):
                images = read_npy(file, path.stat().st_size, str(path))
                return {"train": self._split(images, None, limit, (str(path), None))}
            if head[:2] == b"PK":
                return self._read_npz(file, path, limit)
        raise another(path, head, "a .npy or .npz file; store the array by np.save or np.savez")

    def _read_npz(self, file: IO[bytes], path: Path, limit: int | None) -> dict[str, Images]:
        try:
            archive = zipfile.ZipFile(file)
        except Exception as error:  # damaged directories make zipfile raise nearly anything
            raise InputError(f"{path}: the archive is damaged ({reason(error)}); copy or store it again") from error
        members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
        names = next((pairs for pairs in _NPZ_NAMES if pairs[0][0] in members), None)
        if names is None:
            allowed = " or ".join(pairs[0][0] for pairs in _NPZ_NAMES)
            held = ", ".join(sorted(members)[:10]) or "nothing"
            raise InputError(f"{path}: it holds {held}, but no {allowed}; rename the arrays")
        wanted = [members[name] for pair in names for name in pair if name in members]
        if sum(info.file_size for info in wanted) > image_files.MAX_BYTES:
            raise InputError(
                f"{path}: its arrays declare more than the {image_files.MAX_BYTES} bytes allowed; store fewer images"
            )
        splits, file_bytes = {}, path.stat().st_size
        for split, (images_name, labels_name) in zip(("train", "test"), names, strict=False):
            if images_name not in members:
                continue
            places = (f"{path}: {images_name}", f"{path}: {labels_name}")
            images = read_member(archive, members[images_name], file_bytes, places[0])
            labels = None
            if labels_name in members:
                labels = read_member(archive, members[labels_name], file_bytes, places[1])
            splits[split] = self._split(images, labels, limit, places)
        return splits

    def _split(
        self,
        images: np.ndarray,
        labels: np.ndarray | None,
        limit: int | None,
        places: tuple[str, str | None],
    ) -> Images:
        if labels is not None:
            labels = _to_labels(labels, str(places[1]))
        pixels, white = _to_images(images, self.white, places[0])
        return _labelled(pixels, labels, white, places).head(limit)


def _to_images(array: np.ndarray, white: float | None, place: str) -> tuple[np.ndarray, float]:
    """The array as uint8, uint16 or float32 images, every value checked, and the grey level of white."""
    if array.ndim not in (3, 4):
        raise InputError(
            f"{place}: its shape is {array.shape}; store images as (n, rows, columns) or (n, channels, rows, columns)"
        )
    if array.size == 0:
        raise InputError(f"{place}: its shape is {array.shape}, that is nothing; give at least one image")
    dtype: np.dtype[Any]
    if array.dtype.kind == "b":
        bits, dtype = array, np.dtype(np.uint8)
        array = large.empty(bits.shape, dtype)
        for start, part in large.blocks(bits):
            array[start : start + len(part)] = np.where(part, np.uint8(255), np.uint8(0))
            large.release(array)
    elif array.dtype.kind == "f":
        dtype = np.dtype(np.float32)
    elif array.dtype.kind == "u" and array.itemsize <= 2:
        dtype = np.dtype(np.uint8 if array.itemsize == 1 else np.uint16)
    elif white is None:
        # 0 to 255 as often as not, so guessing white would make such images nearly black
        raise InputError(f"{place}: it holds {array.dtype}, which leaves white open; set white (255 or 65535)")
    else:
        dtype = np.dtype(np.uint8 if white <= 255 else np.uint16)
    top = _white(white, dtype)
    allowed = min(top, 65535.0) if dtype.kind == "u" else top
    # a NaN makes both comparisons false
    least, most = large.range_of(array)
    if not (least >= 0 and most <= allowed):
        for i, image in enumerate(array):
            wrong = image[~((image >= 0) & (image <= allowed))]
            if wrong.size:
                raise InputError(
                    f"{place}: image {i} (counted from 0) has the value {wrong[0]}, allowed is 0 to "
                    f"{allowed:g}; correct it, or set white to the grey level of white"
                )
    return large.converted(array, dtype), top


def _to_labels(array: np.ndarray, place: str) -> np.ndarray:
    """Labels (n,) or (n, 1) of any integer type as (n,) uint8."""
    if array.ndim == 2 and array.shape[1] == 1:
        array = array[:, 0]
    if array.ndim != 1 or array.dtype.kind not in "biu":
        raise InputError(f"{place}: it is {array.dtype} {array.shape}; labels are one integer per image, (n,)")
    if array.size and not (array.min() >= 0 and array.max() <= 255):
        wrong = array[(array < 0) | (array > 255)][0]
        raise InputError(f"{place}: it has the label {wrong}; labels are 0 to 255: number the classes from 0")
    return array.astype(np.uint8)


# --- digits drawn here -----------------------------------------------------------------------------------


class Digits(_Source):
    """Handwritten-looking digits, white on black as in MNIST, drawn here: they need no download.

    Labels run 0, 1, ... 9, 0, ... Each image depends on the seed, the split and its index alone.
    """

    source: Literal["digits"] = "digits"
    train: int = Field(default=400, ge=1, le=1_000_000, description="number of training images")
    test: int = Field(default=100, ge=0, le=1_000_000, description="number of test images; 0: no test split")
    rows: int = Field(default=28, ge=8, le=4096, description="rows of pixels")
    columns: int = Field(default=28, ge=8, le=4096, description="columns of pixels")
    seed: int = Field(default=1, ge=0, lt=2**63, description="another seed, other handwriting")

    def drawn(self) -> int | None:
        return (self.train + self.test) * self.repetitions

    def describe(self) -> str:
        return f"{self.train} + {self.test} digits drawn from seed {self.seed}"

    def _read(
        self, shape: tuple[int, int], images_dir: Path | None, base: Path, limit: int | None
    ) -> dict[str, Images]:
        splits = {}
        for stream, (split, number) in enumerate((("train", self.train), ("test", self.test))):
            number = min(number, limit or number)
            if not number:
                continue
            if number * self.rows * self.columns > image_files.MAX_BYTES:
                raise InputError(
                    f"scene.images: {number} digits of {self.rows} x {self.columns} pixels take more than "
                    f"the {image_files.MAX_BYTES} bytes allowed; ask for fewer or smaller ones"
                )
            pixels, fresh = large.empty((number, self.rows, self.columns), np.uint8), 0
            for i in range(number):
                pixels[i] = draw_digit(i % 10, (self.seed, stream, i), self.rows, self.columns)
                fresh = large.kept_low(pixels, fresh + pixels[i].nbytes)
            splits[split] = Images(pixels, (np.arange(number) % 10).astype(np.uint8), 255.0)
        return splits


# --- uniform light ---------------------------------------------------------------------------------------


class Uniform(_Source):
    """Uniform images of the sensor's own size, repetitions of one: for flat and dark recordings."""

    source: Literal["uniform"] = "uniform"
    repetitions: int = Field(default=10, ge=1, le=1_000_000, description="number of images")
    grey: int = Field(default=255, ge=0, le=255, description="grey level; 255, white, is the scene's full light")

    def drawn(self) -> int | None:
        return self.repetitions

    def describe(self) -> str:
        return f"{self.repetitions} uniform images of grey {self.grey}"

    def _read(
        self, shape: tuple[int, int], images_dir: Path | None, base: Path, limit: int | None
    ) -> dict[str, Images]:
        return {"train": Images(np.full((1, *shape), self.grey, np.uint8), None, 255.0)}


# --- charts ----------------------------------------------------------------------------------------------


class Chart(_Source):
    """Many images of another source as tiles on one image of the sensor's size, as on a printed chart.

    Each split of the source is a chart of its own: of `count` of its images, drawn by lot, each at most once. Tiles
    lie row by row in the middle of the chart, which is black between them. `Part.tiles` cuts them out of an image.
    """

    source: Literal["chart"] = "chart"
    of: Annotated[Mnist | Idx | Folder | Array | Digits | Uniform, Field(discriminator="source")] = Field(
        default=Mnist(), description="the source of the tiles, as scene.images would name it"
    )
    count: int = Field(default=256, ge=1, le=1_000_000, description="number of tiles on a chart")
    columns: int | None = Field(default=None, ge=1, le=100_000, description="tiles in a row; as many as rows")
    pitch: int | None = Field(default=None, ge=1, le=100_000, description="pixels from tile to tile; the tile's size")
    seed: int = Field(default=1, ge=0, lt=2**63, description="another seed, other images of the source")

    def describe(self) -> str:
        return f"chart of {self.count} tiles from {self.of.describe()}"

    def _read(
        self, shape: tuple[int, int], images_dir: Path | None, base: Path, limit: int | None
    ) -> dict[str, Images]:
        found = self.of.load(shape, images_dir, base)
        return {split: self._lay(stream, split, found[split], shape) for stream, split in enumerate(found)}

    def _lay(self, stream: int, split: str, of: Images, shape: tuple[int, int]) -> Images:
        if self.count > len(of):
            raise InputError(
                f"scene.images.count: {self.count} tiles cannot be drawn from the {len(of)} {split} images of "
                f"{self.of.describe()}; ask for at most {len(of)}"
            )
        if self.pitch is not None and self.pitch < max(of.size):
            raise InputError(
                f"scene.images.pitch: tiles of {of.size[0]} x {of.size[1]} pixels would overlap at a pitch of "
                f"{self.pitch}; give at least {max(of.size)}"
            )
        corners = tiles.grid(self.count, self.columns, self.pitch, of.size)
        whole = corners.max(axis=0) + of.size
        if (whole > shape).any():
            raise InputError(
                f"scene.images: the chart of {self.count} tiles of {of.size[0]} x {of.size[1]} pixels is "
                f"{whole[0]} x {whole[1]} pixels (rows x columns), larger than the sensor's {shape[0]} x {shape[1]}; "
                "lower count or pitch, change columns, or take a larger sensor.layout"
            )
        corners += (np.array(shape) - whole) // 2
        numbers = tiles.drawn(len(of), self.count, (self.seed, stream))
        chart = tiles.lay(of.pixels[numbers], corners, shape)
        labels = None if of.labels is None else of.labels[numbers]
        return Images(chart[None], None, of.white, tiles=Tiles(shape, of.size, corners, numbers, labels))


ImageSource = Annotated[
    Mnist | Idx | Folder | Array | Digits | Uniform | Chart,
    Field(discriminator="source"),
]
