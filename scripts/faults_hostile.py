"""Files of every kind that the program reads, with changed bytes, numbers and words, and the verbs that read them."""

from __future__ import annotations

import gzip
import io
import json
import random
import re
import shutil
import struct
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from faults_injected import command, run
from faults_scenes import CONFIG, METHODS, PLAN, SENSOR, copied, in_this_process
from PIL import Image

from spadmnist.import_options import options
from spadmnist.importers import Said

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
import importfiles

MEMORY = 2 << 30  # bytes that a command may take, whatever it reads
SECONDS = 10.0
_QUICK = 2.0, 1e8  # s, bytes that a dry run may foresee, so that the dataset is made, too
_LARGE = (0, 1, 0x7F, 0x80, 0xFF, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**62, 2**63 - 1, 2**63, 2**64 - 1)
_WORDS = (
    "0", "-1", "1e999", "-1e-300", "nan", ".inf", "9" * 30, "0x10", "1_000", "null", "true", "[]", "{}", "''", "~",
    "*a", "&a x", "!!python/none", "!!binary aa", "2020-01-01", "../../x", "/dev/zero", "\\u202e", "\\x00", "[" * 300,
    "{a: " * 300, "a" * 5000, "1 mlux", "1 ns", "-5 s", "100 %", "1e9 s", "nan s", "'1\\n2'", '"\\e[31m"', "é", "🙂",
)  # fmt: skip


# --- changes ------------------------------------------------------------------------------------------------------


def changed(data: bytes, rng: random.Random, text: bool) -> bytes:
    """One to three changes; text: of words and lines, mostly."""
    out = bytearray(data)
    for _ in range(rng.randint(1, 3)):
        if out:
            rng.choice(_OF_TEXT if text and rng.random() < 0.8 else _OF_BYTES)(out, rng)
    return bytes(out)


def _near(data: bytearray, rng: random.Random) -> int:
    """A place, half of the time where headers are."""
    return rng.randrange(min(len(data), 600) if rng.random() < 0.5 else len(data))


def _bits(data: bytearray, rng: random.Random) -> None:
    for _ in range(rng.randint(1, 4)):
        data[_near(data, rng)] ^= 1 << rng.randrange(8)


def _bytes(data: bytearray, rng: random.Random) -> None:
    at = _near(data, rng)
    data[at : at + rng.randint(1, 8)] = rng.randbytes(rng.randint(1, 8))


def _number(data: bytearray, rng: random.Random) -> None:
    """A whole number or a float that lies there becomes an extreme one, in either order of bytes."""
    order, kind = rng.choice("<>"), rng.choice("HIQd")
    value = rng.choice((float("nan"), float("inf"), -1e308, 5e-324)) if kind == "d" else rng.choice(_LARGE)
    size = struct.calcsize(kind)
    packed = struct.pack(order + kind, value if kind == "d" else int(value) % 2 ** (8 * size))
    at = _near(data, rng) // size * size
    data[at : at + size] = packed


def _cut(data: bytearray, rng: random.Random) -> None:
    del data[rng.randrange(len(data)) :]


def _out(data: bytearray, rng: random.Random) -> None:
    at = _near(data, rng)
    del data[at : at + rng.randint(1, 40)]


def _twice(data: bytearray, rng: random.Random) -> None:
    at = _near(data, rng)
    data[at:at] = data[at : at + rng.randint(1, 60)]


def _same(data: bytearray, rng: random.Random) -> None:
    at, size = _near(data, rng), rng.randint(2, 64)
    data[at : at + size] = bytes([rng.choice((0, 0x20, 0x7F, 0xFF))]) * size


def _word(data: bytearray, rng: random.Random) -> None:
    """A word or a number becomes another one."""
    found = list(re.finditer(rb"[^\s,:{}\[\]\"]+", bytes(data)))
    if found:
        one = rng.choice(found)
        data[one.start() : one.end()] = rng.choice((*_WORDS, *_numbers_near(one.group()))).encode()


def _numbers_near(word: bytes) -> list[str]:
    """Of a number: larger and smaller ones, which is where limits are."""
    try:
        value = float(word)
    except ValueError:
        return []
    return [f"{value * factor:g}" for factor in (-1, 1e-12, 1e-3, 10, 1e3, 1e6, 1e12)]


def _line(data: bytearray, rng: random.Random) -> None:
    """A line goes, comes twice, or changes places with another one."""
    lines = data.split(b"\n")
    a, b = rng.randrange(len(lines)), rng.randrange(len(lines))
    how = rng.randrange(3)
    if how == 0:
        del lines[a]
    elif how == 1:
        lines.insert(b, lines[a])
    else:
        lines[a], lines[b] = lines[b], lines[a]
    data[:] = b"\n".join(lines)


_OF_BYTES = (_bits, _bytes, _number, _cut, _out, _twice, _same)
_OF_TEXT = (_word, _word, _word, _line, _cut, _bytes)


# --- what reads them ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Hostile:
    """Changed files of one kind: one of `files`, in a copy of the folder `start`, is changed and given to `verbs`."""

    what: str
    start: Path
    files: tuple[str, ...]
    verbs: Callable[[str], Sequence[Sequence[object]]]
    tries: int = 200
    text: bool = False
    sealed: bool = False  # a manifest, whose own digest is made anew

    @property
    def name(self) -> str:
        return f"hostile {self.what}"

    def attempt(self, number: int, rng: random.Random, here: Path) -> str:
        copied(self.start, here)
        file = self.files[number % len(self.files)]
        path = here / file
        data = path.read_bytes()
        if path.suffix == ".gz" and rng.random() < 0.7:
            data = gzip.compress(changed(gzip.decompress(data), rng, self.text))
        else:
            data = changed(data, rng, self.text)
        path.write_bytes(_sealed(data) if self.sealed and rng.random() < 0.7 else data)
        for arguments in self.verbs(file):
            end = run(command(*arguments), here, seconds=SECONDS, memory=MEMORY)
            what = f"{file}, {arguments[0]}: "
            if wrong := end.wrong(*((0, 1, 2) if arguments[0] == "verify" else (0, 2))):
                return what + wrong
            if "not enough memory" in end.err:
                return f"{what}takes more than {MEMORY >> 30} GiB: {end.err.strip()}"
            if "--dry-run" in arguments and (end.status != 0 or not _quick(end.out)):
                return ""
        return ""


def _sealed(data: bytes) -> bytes:
    from spadmnist import manifest_file

    try:
        manifest = json.loads(data)
        return manifest_file.seal({name: value for name, value in manifest.items() if name != "sha256"})
    except (ValueError, AttributeError, TypeError, RecursionError):
        return data


def _quick(said: str) -> bool:
    """Is what a dry run foresees soon made?"""
    try:
        foreseen = json.loads(said)
        return bool(foreseen["total"]["seconds"] < _QUICK[0] and foreseen["total"]["bytes"] < _QUICK[1])
    except (ValueError, KeyError, TypeError):
        return False


def import_words(said: Said) -> list[str]:
    """The options of the command line that say the same as arguments of the library."""
    words = []
    for name in said.given:
        option, value = options()[name], getattr(said, name)
        words.append(f"--{name.replace('_', '-')}")
        if option.unit is not None:
            words.append(f"{value!r} {option.unit}".strip())
        elif not option.flag:
            words.append(",".join(value) if isinstance(value, tuple) else str(value))
    return words


def classes(base: Path) -> list[Hostile]:
    """A class for every kind of file."""
    home = base / "hostile"
    config = CONFIG.format(format="zarr", methods=", ".join(METHODS))
    return [
        *_described(home / "described", config),
        *_imported(home / "imported"),
        *_pictured(home / "pictured", config),
        *_datasets(home / "datasets", base),
    ]


def _described(home: Path, config: str) -> list[Hostile]:
    """YAML, and the files that it names."""
    home.mkdir(parents=True)
    for name, text in (("config.yaml", config), ("sensor.yaml", SENSOR), ("plan.yaml", PLAN)):
        (home / name).write_text(text)
    places = "\n".join(["x,y", *(f"{10 * (n % 6)},{10 * (n // 6)}" for n in range(36))])
    (home / "places.csv").write_text(places)
    np.save(home / "pdp.npy", np.full((6, 6), 0.4))
    layout, pdp = "layout: {rows: 6, columns: 6, pixel_area: 100 um^2}", "pdp: 0.42"
    placed = SENSOR.replace(layout, "layout: {positions: places.csv, pixel_area: 100 um^2}")
    (home / "placed.yaml").write_text(placed)
    (home / "mapped.yaml").write_text(SENSOR.replace(pdp, "pdp: {file: pdp.npy}"))
    plan = PLAN.replace("{rows: 6, columns: 6}", "{positions: places.csv}")
    (home / "placed-plan.yaml").write_text(plan)
    in_this_process("simulate", home / "sensor.yaml", home / "plan.yaml", "-o", home / "lab")
    shutil.copytree(home / "lab", home / "other")

    def made(file: str) -> Sequence[Sequence[object]]:
        one = ("generate", file, "-o", "out", "-j", "1")
        return [(*one, "--dry-run", "--json"), one]

    def simulated(sensor: str, plan: str = "plan.yaml") -> Sequence[Sequence[object]]:
        return [("simulate", sensor, plan, "-o", "out")]

    def inspected(file: str) -> Sequence[Sequence[object]]:
        where = Path(file).parent
        return [("inspect", where, "--json"), ("reconstruct", where, "--method", "counts", "-o", "flux")]

    def positions(file: str) -> Sequence[Sequence[object]]:
        return simulated("placed.yaml", "placed-plan.yaml")

    captures = tuple(f"lab/{name}.h5" for name in ("dark", "flat", "bits", "sums"))
    return [
        Hostile("config", home, ("config.yaml",), made, 400, text=True),
        Hostile("sensor", home, ("sensor.yaml",), simulated, 300, text=True),
        Hostile("plan", home, ("plan.yaml",), lambda file: simulated("sensor.yaml"), 200, text=True),
        Hostile("measurement", home, ("lab/measurement.yaml",), inspected, 200, text=True),
        Hostile("capture", home, captures, inspected, 240),
        Hostile("positions", home, ("places.csv",), positions, 100, text=True),
        Hostile("map", home, ("pdp.npy",), lambda file: simulated("mapped.yaml"), 100),
    ]


def _imported(home: Path) -> list[Hostile]:
    """Files of other programs, by suffix."""
    home.mkdir(parents=True)
    samples = {}
    for sample in importfiles.SAMPLES:
        importfiles.made_of(sample, home)
        samples[sample.name] = sample
    by_suffix: dict[str, list[str]] = {}
    for name in samples:
        by_suffix.setdefault(Path(name).suffix, []).append(name)

    def taken(file: str) -> Sequence[Sequence[object]]:
        words = import_words(samples[file].said)
        return [("import", file, "-o", "out", "--light", "dark", *words)]

    for name in samples:
        arguments = [home / word if word == name else word for word in taken(name)[0]]
        in_this_process(*[home / f"made-{name}" if word == "out" else word for word in arguments])
        shutil.rmtree(home / f"made-{name}")
    return [
        Hostile(f"import {suffix}", home, tuple(names), taken, 120, text=suffix == ".csv")
        for suffix, names in by_suffix.items()
    ]


def _pictured(home: Path, config: str) -> list[Hostile]:
    """Images of a config."""
    rng = np.random.Generator(np.random.Philox(1))
    pixels = rng.integers(0, 256, (4, 8, 8), np.uint8)
    digits = "{source: digits, train: 3, test: 2, rows: 8, columns: 8}"
    found = []

    def class_of(what: str, images: str, write: Callable[[Path], Mapping[str, bytes]], text: bool = False) -> None:
        folder = home / what
        folder.mkdir(parents=True)
        files = write(folder)
        for name, data in files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(data)
        (folder / "config.yaml").write_text(config.replace(digits, images))
        in_this_process("generate", folder / "config.yaml", "-o", home / f"made-{what}", "-j", "1")
        verbs = [("generate", "config.yaml", "-o", "out", "-j", "1")]
        found.append(Hostile(what, folder, tuple(files), lambda file: verbs, 100, text))

    def pictures(kind: str) -> Mapping[str, bytes]:
        files = {}
        for n, image in enumerate(pixels):
            buffer = io.BytesIO()
            Image.fromarray(image).save(buffer, kind)
            files[f"pictures/{n % 2}/{n}.{kind.lower()}"] = buffer.getvalue()
        return files

    for kind in ("PNG", "GIF", "TIFF", "BMP", "JPEG", "PPM"):
        class_of(f"pictures {kind}", "{source: folder, path: pictures}", lambda _, kind=kind: pictures(kind))

    one, other = io.BytesIO(), io.BytesIO()
    np.save(one, pixels)
    np.savez(other, train_images=pixels)
    for suffix, data in ((".npy", one.getvalue()), (".npz", other.getvalue())):
        name = f"images{suffix}"
        class_of(f"pictures {suffix}", f"{{source: array, path: {name}}}", lambda _, name=name, data=data: {name: data})
    data = struct.pack(">4B3I", 0, 0, 8, 3, *pixels.shape) + pixels.tobytes()
    files = {"train-idx": data, "test-idx.gz": gzip.compress(data)}
    class_of("pictures IDX", "{source: idx, train_images: train-idx, test_images: test-idx.gz}", lambda _: files)
    return found


def _datasets(home: Path, base: Path) -> list[Hostile]:
    """What a dataset says of itself; its data stay."""
    found = []
    for format in ("zarr", "hdf5"):
        folder = home / format
        folder.mkdir(parents=True)
        shutil.copytree(base / format / "all", folder / "out")

        def read(file: str) -> Sequence[Sequence[object]]:
            words = ("inspect", "out", "--json"), ("verify", "out"), ("reconstruct", "out", "-j", "1")
            return [*words, ("verify", "out", "--repair", "-j", "1")]

        found.append(Hostile(f"manifest {format}", folder, ("out/manifest.json",), read, 150, text=True, sealed=True))
    return found
