"""Commands that are killed or whose disk is full, and complete data that are damaged: what must hold afterwards."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import io
import json
import os
import random
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from faults_injected import End, Fault, command, run

import spadmnist
from spadmnist import measurement
from spadmnist.errors import SpadError
from spadmnist.events import Events
from spadmnist.manifest_file import STATE
from spadmnist.readout import Frames
from spadmnist.recording import Recording

Tree = dict[str, bytes]  # path -> content; of a folder that is empty, or no file, what it is
Wrong = str  # what was lost, in a line; empty: nothing

METHODS = ("counts", "inter_photon", "str_flux", "qis_counts")
CONFIG = """\
seed: 3
scene:
  images: {{source: digits, train: 3, test: 2, rows: 8, columns: 8}}
  lux: [40 mlux, 2560 mlux]
recording: {{exposure: 1 ms, frames: 10, frame_time: 100 us, readouts: [tr, str, qis]}}
reconstruct: [{methods}]
sensor:
  name: tiny
  layout: {{rows: 8, columns: 8, pixel_area: 25 um^2}}
  effects:
    detection: {{pdp: 0.5}}
    dark_counts: {{rate: 100 Hz}}
    afterpulsing: {{probability: 0.5 %, lifetime: 25 ns}}
    dead_time: {{duration: 50 ns}}
    tdc: {{resolution: 10 ps}}
output: {{format: {format}}}
"""
SENSOR = """\
sensor:
  name: tiny
  rules: device
  layout: {rows: 6, columns: 6, pixel_area: 100 um^2}
  effects:
    detection: {pdp: 0.42}
    dark_counts: {rate: 100 Hz}
    dead_time: {duration: 50 ns}
    tdc: {resolution: 100 ps}
"""
_LIT = "light: {kind: flat, wavelength: 500 nm, irradiance: 100 nW/cm^2, relative_uncertainty: 0.02}"
_CLOCK = "frames: 30, frame_time: 10 us, frame_period: 10 us"
PLAN = f"""\
format: spadmnist-measurement/1
name: lab
layout: {{rows: 6, columns: 6}}
captures:
  - {{id: dark, modality: tr, light: {{kind: dark}}, exposure: 1 s}}
  - {{id: flat, modality: tr, {_LIT}, exposure: 1 ms}}
  - {{id: bits, modality: qis, {_LIT}, {_CLOCK}}}
  - {{id: sums, modality: counts, bits: 4, {_LIT}, {_CLOCK}}}
"""


# --- folders ------------------------------------------------------------------------------------------------------


def tree(root: Path) -> Tree:
    """Everything below a folder."""
    found: Tree = {}
    for folder, folders, files in os.walk(root):
        for name in [*files, *(one for one in folders if os.path.islink(os.path.join(folder, one)))]:
            path = Path(folder, name)
            whole = path.is_file() and not path.is_symlink()
            found[str(path.relative_to(root))] = path.read_bytes() if whole else b"no file"
        if not folders and not files and Path(folder) != root:
            found[f"{Path(folder).relative_to(root)}/"] = b"empty folder"
    return found


def differing_names(now: Tree, expected: Tree) -> list[str]:
    """What is not the same in two folders."""
    return sorted(name for name in now.keys() | expected.keys() if now.get(name) != expected.get(name))


def differing(now: Tree, expected: Tree) -> Wrong:
    """Which files differ, are missing or are too many."""
    names = differing_names(now, expected)
    if not names:
        return ""
    how = [("differs" if n in now and n in expected else "is missing" if n in expected else "is left") for n in names]
    return f"{len(names)} files: " + ", ".join(f"{n} {h}" for n, h in list(zip(names, how, strict=True))[:4])


def copied(start: Path, here: Path) -> None:
    """`here` becomes a copy of a folder."""
    shutil.rmtree(here, ignore_errors=True)
    shutil.copytree(start, here, symlinks=True)


def in_this_process(*arguments: object) -> None:
    """`spadmnist ARGUMENTS` once, here: what it imports and compiles is then there for all that divide from here."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()) as said:
        try:
            command(*arguments)()
        except SystemExit as stop:
            if stop.code not in (0, None):
                raise RuntimeError(f"spadmnist {' '.join(map(str, arguments))}: {said.getvalue()}") from None


# --- reading ------------------------------------------------------------------------------------------------------

_DIGESTED = (np.ndarray, Events, Frames, Recording, type(None))
REFUSED = "refused"  # instead of a digest: reading it raised SpadError


def digests(path: Path) -> dict[str, str]:
    """A digest of every field of a dataset or a measurement, or that reading it is refused."""
    found: dict[str, str] = {}

    def take(name: str, get: Callable[[], Any]) -> Any:
        try:
            value = get()
        except SpadError:
            found[name] = REFUSED
            return None
        if not isinstance(value, _DIGESTED):
            return value
        found[name] = hashlib.sha256(b"".join(_pieces(value))).hexdigest()
        return value

    def measured() -> None:
        opened = take("", lambda: measurement.open(path))
        for capture in opened.captures if opened else ():
            one = take(f"{capture.id}.", lambda id=capture.id: measurement.open(path).recording(id))
            if one is not None and one.frames is not None:
                take(f"{capture.id}.frames", lambda one=one: np.asarray(one.frames[:]))

    try:
        if measurement.is_measurement(path):
            measured()
            return found
    except SpadError:
        return {"": REFUSED}
    opened = take("", lambda: spadmnist.open(path))
    for level in opened.levels if opened else ():
        for split in opened.splits:
            where = f"{level} {split} "
            part = take(where, lambda level=level, split=split: opened[level, split])
            if part is None:
                continue
            take(f"{where}labels", lambda part=part: part.labels)
            for name in ("images", *part.readouts):
                take(f"{where}{name}", lambda part=part, name=name: getattr(part, name)[:])
            for method, made in part.reconstruction.items():
                take(f"{where}{method}", lambda made=made: made[:])
                take(f"{where}{method} normalised", lambda made=made: made.normalised[:])
    return found


def _pieces(value: Any) -> list[bytes]:
    if isinstance(value, np.ndarray):
        return [str((value.dtype, value.shape)).encode(), np.ascontiguousarray(value).tobytes()]
    if isinstance(value, Events):
        return [piece for one in (value.times, value.offsets, value.ticks, value.tick) for piece in _pieces(one)]
    if dataclasses.is_dataclass(value):
        return [piece for one in dataclasses.fields(value) for piece in _pieces(getattr(value, one.name))]
    if isinstance(value, float | int | str | bool | None):
        return [repr(value).encode()]
    return []  # a source of frames, which is read by itself


def misread(path: Path, *known: dict[str, str]) -> Wrong:
    """Which fields are read as something else than one of what is known, or not refused in a sentence."""
    end = run(lambda: print(json.dumps(digests(path))), path.parent)
    if wrong := end.wrong(0):
        return f"reading: {wrong}"
    now = json.loads(end.out)
    names = [n for n, one in now.items() if one != REFUSED and one not in [each.get(n) for each in known]]
    return f"read wrongly: {', '.join(names[:4])}" if names else ""


# --- killed and full ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Scene:
    """A command and the folder that it is run in. out: what it makes there.

    refusable: may what is left of a run be refused in a sentence (and made anew when it is gone), or must the same
    command go on?
    """

    name: str
    arguments: tuple[str, ...]
    start: Path
    out: str = "out"
    refusable: bool = False

    def run(self, here: Path, fault: Fault | None = None) -> End:
        """The command, in `here`."""
        return run(command(*self.arguments), here, fault)

    @functools.cached_property
    def before(self) -> tuple[Tree, dict[str, str]]:
        """The folder and what is read in it, before."""
        return tree(self.start), digests(self.start / self.out)

    @functools.cached_property
    def undisturbed(self) -> tuple[int, Tree, dict[str, str]]:
        """(steps, the folder, what is read in it) of a run in which nothing goes wrong."""
        here = self.start.with_name(f"{self.start.name}-undisturbed")
        found = []
        for _ in range(2):
            copied(self.start, here)
            home = os.getcwd()
            os.chdir(here)
            in_this_process(*self.arguments)
            os.chdir(home)
            copied(self.start, here)
            end = self.run(here)
            if wrong := end.wrong(0):
                raise RuntimeError(f"{self.name}: {wrong}")
            found.append((end.steps, tree(here), digests(here / self.out)))
        if wrong := differing(found[0][1], found[1][1]):
            raise RuntimeError(f"{self.name}: two undisturbed runs: {wrong}")
        return found[1]

    def looked_at(self, here: Path) -> Wrong:
        """After a disturbed run: is every file of the result whole, before or after, and read as what it is?"""
        (old, known), (_, new, later) = self.before, self.undisturbed
        now = tree(here)
        if torn := [n for n in sorted(new) if n in now and now[n] not in (new[n], old.get(n))]:
            return f"not whole: {', '.join(torn[:4])}"
        return misread(here / self.out, known, later)

    def gone_on(self, here: Path) -> Wrong:
        """Does the same command end with the bytes of an undisturbed run, and nothing else?"""
        end = self.run(here)
        if self.refusable and end.status == 2 and not end.wrong(2):
            if all(n.split("/")[1:2] == [STATE] for n in differing_names(tree(here), self.undisturbed[1])):
                return ""  # it had come to its end, and says so
            for path in here.glob(f"{self.out}*"):
                shutil.rmtree(path) if path.is_dir() else path.unlink()
            end = self.run(here)
        return end.wrong(0) or differing(tree(here), self.undisturbed[1])


@dataclass(frozen=True)
class Killed:
    """Killed at step k; every second time the run that goes on is killed, too."""

    scene: Scene
    kind: str = "killed"

    @property
    def name(self) -> str:
        return f"{self.kind} {self.scene.name}"

    @property
    def tries(self) -> int:
        return 2 * self.scene.undisturbed[0]

    def attempt(self, number: int, rng: random.Random, here: Path) -> Wrong:
        copied(self.scene.start, here)
        at, again = divmod(number, 2)
        faults = [Fault(self.kind, at + 1)]
        if again:
            faults.append(Fault(self.kind, rng.randint(1, self.scene.undisturbed[0])))
        for n, fault in enumerate(faults):
            end = self.scene.run(here, fault)
            if n == 0 and not end.killed:
                return f"step {at + 1} did not come: {end.wrong(0)}"
            if wrong := (not end.killed and end.wrong(0, 2)) or self.scene.looked_at(here):
                return wrong
        return self.scene.gone_on(here)


@dataclass(frozen=True)
class Full:
    """From step k on the disk is full; then it is not any more."""

    scene: Scene
    kind: str = "full"

    @property
    def name(self) -> str:
        return f"{self.kind} {self.scene.name}"

    @property
    def tries(self) -> int:
        return self.scene.undisturbed[0]

    def attempt(self, number: int, rng: random.Random, here: Path) -> Wrong:
        copied(self.scene.start, here)
        end = self.scene.run(here, Fault(self.kind, number + 1))
        return end.wrong(0, 2) or self.scene.looked_at(here) or self.scene.gone_on(here)


# --- damaged ------------------------------------------------------------------------------------------------------


def flipped(path: Path, others: list[Path], rng: random.Random) -> None:
    """One bit."""
    data = bytearray(path.read_bytes())
    data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    path.write_bytes(data)


def cut(path: Path, others: list[Path], rng: random.Random) -> None:
    """Anywhere."""
    os.truncate(path, rng.randrange(path.stat().st_size))


def emptied(path: Path, others: list[Path], rng: random.Random) -> None:
    """It is there, with nothing in it."""
    os.truncate(path, 0)


def removed(path: Path, others: list[Path], rng: random.Random) -> None:
    """It is not there."""
    path.unlink()


def replaced(path: Path, others: list[Path], rng: random.Random) -> None:
    """By another file of the same data; of the same name, where there is one."""
    here = path.read_bytes()
    others = [other for other in others if other.read_bytes() != here]
    alike = [other for other in others if other.name == path.name]
    path.write_bytes(rng.choice(alike or others).read_bytes())


def folder(path: Path, others: list[Path], rng: random.Random) -> None:
    """A folder of its name is there, and is perhaps not empty."""
    path.unlink()
    path.mkdir()
    if rng.random() < 0.5:
        (path / "inside").write_bytes(b"something")


DAMAGES = (flipped, cut, emptied, removed, replaced, folder)


@dataclass(frozen=True)
class Damaged:
    """Each file of complete data is damaged in each way; a dataset is verified and repaired, too."""

    what: str
    whole: Path  # the dataset or measurement
    rounds: int = 1
    dataset: bool = True

    @property
    def name(self) -> str:
        return f"damaged {self.what}"

    @functools.cached_property
    def content(self) -> tuple[Tree, dict[str, str]]:
        """Its files, and what is read of them."""
        return tree(self.whole), digests(self.whole)

    @functools.cached_property
    def victims(self) -> list[str]:
        # nothing tells a measurement's own description from another one: it is the user's to change
        return sorted(n for n in self.content[0] if self.dataset or n != "measurement.yaml")

    @property
    def tries(self) -> int:
        return self.rounds * len(self.victims) * len(DAMAGES)

    def attempt(self, number: int, rng: random.Random, here: Path) -> Wrong:
        content, known = self.content
        rest, kind = divmod(number, len(DAMAGES))
        victim, damage = self.victims[rest % len(self.victims)], DAMAGES[kind]
        root = here / "out"
        shutil.rmtree(here, ignore_errors=True)
        copied(self.whole, root)
        damage(root / victim, [root / other for other in self.victims if other != victim], rng)
        wrong = misread(root, known) or (self._repaired(root, content, victim) if self.dataset else "")
        return wrong and f"{victim} {damage.__name__}: {wrong}"

    def _repaired(self, root: Path, content: Tree, victim: str) -> Wrong:
        end = run(command("verify", root, "--json"), root.parent)
        if wrong := end.wrong(1):
            return f"verify: {wrong}"
        found = json.loads(end.out)
        if victim not in [*found["changed"], *found["missing"]]:
            return f"verify does not name it: {end.out}"
        end = run(command("verify", root, "--repair", "-j", "1"), root.parent)
        return end.wrong(0) or differing(tree(root), content)
