"""Writes a measurement: `measurement.yaml`, and a file for each recording."""

from __future__ import annotations

import contextlib
import filecmp
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from .. import capture_files, disk, document, manifest_file, system, units
from ..errors import InputError, SpadError
from ..events import Layout
from ..positions import positions_text
from ..recording import Capture, Recording
from ..scene import Scene
from ..tiles import Tiles
from .entries import FILE, FORMAT
from .type import Measurement


def write(
    path: str | Path,
    name: str,
    layout: Layout,
    recordings: Iterable[Recording | Capture],
    captures: Sequence[Capture] = (),
) -> Path:
    """Write a measurement: `measurement.yaml` and a file for each recording; its folder.

    recordings: taken one after the other, so that they may be made as they are wanted; a `Capture` with a mean stands
    for itself. captures: those of `recordings`, where they are known beforehand: then the place is looked at before the
    first recording is asked for.

    Every file appears by one rename, `measurement.yaml` last. A file that is there and has the same bytes stays; a
    folder that holds anything else is refused. Raises SpadError where it cannot be written, and for a capture that
    could not be opened again. Where a recording is refused (InputError), or something else lies in the folder, the
    files of this call go again: with other words the same files may be right, and in a plan's folder they would stand
    for its data.
    """
    root = Path(path)
    for capture in captures:
        _check_counts(capture)
    disk.check_outside(root)
    if root.exists() and not root.is_dir():
        raise SpadError(f"{root} is a file; choose another place with -o")
    begun = not root.exists()
    with disk.writing(root, 0):
        root.mkdir(parents=True, exist_ok=True)
    with _alone(root):
        _check_place(root, captures, layout)
        disk.sweep(disk.temporary(root))
        done: list[Capture] = []
        made: list[Path] = []
        try:
            for one in recordings:
                done.append(one if isinstance(one, Capture) else one.capture)
                _check_counts(done[-1])
                if isinstance(one, Recording):
                    final = root / _files(done)[-1]
                    known = final.exists()
                    _commit_recording(root, final.name, one)
                    made += [] if known else [final]
            others = {} if layout.positions is None else {_POSITIONS: positions_text(layout.positions).encode()}
            others |= {file: shown.file() for shown, file in _scenes(done).items()}
            others |= {file: laid for laid, file in _tiles(done).items()}
            _check_place(root, done, layout)
            for file, data in {**others, FILE: _yaml(name, layout, done).encode()}.items():
                known = (root / file).exists()
                _commit(root, file, data)
                made += [] if known else [root / file]
        except (InputError, _Another):
            for final in made:
                final.unlink(missing_ok=True)
            _clear(root)
            if begun:
                with contextlib.suppress(OSError):
                    root.rmdir()
            raise
        _clear(root)
    return root


def fill(plan: Measurement, recordings: Iterable[Recording]) -> None:
    """Write captures of a plan: a file for each recording, which the plan's YAML then names; all else in it stays.

    Each file appears by one rename, then its name in the YAML: what is there stays whole, whenever the run ends. Raises
    SpadError where something cannot be written, and where the file of a capture is there with other data.
    """
    root, described = plan.folder, plan.file
    assert root is not None and described is not None
    disk.check_outside(root)
    ids, names = [capture.id for capture in plan.captures], _files_of_plan(plan)
    made: list[Path] = []
    with _alone(root):
        disk.sweep(disk.temporary(root))
        before = described.read_bytes()
        try:
            for one in recordings:
                index = ids.index(one.capture.id)
                _check_counts(one.capture)
                disk.inside(root, names[index])
                final = root / names[index]
                known = final.exists()
                _commit_recording(root, names[index], one, one.capture.id)
                made += [] if known else [final]
                if plan.file_name(one.capture.id) is None:
                    text = described.read_bytes().decode()
                    new = document.insert(text, ("captures", index), "id", "file", names[index], str(described))
                    disk.commit_file(described, new.encode(), disk.temporary(root))
        except InputError:
            # what is refused leaves the plan as it was
            if described.read_bytes() != before:
                disk.commit_file(described, before, disk.temporary(root))
            for final in made:
                final.unlink(missing_ok=True)
            raise
        finally:
            _clear(root)


def _files_of_plan(plan: Measurement) -> list[str]:
    """The file's name of each capture: as the plan says, else made of its id; no two the same."""
    said = [plan.file_name(capture.id) for capture in plan.captures]
    taken = {name.lower() for name in said if name is not None}
    names = []
    for name, made in zip(said, _files(plan.captures), strict=True):
        stem, n = made.removesuffix(".h5"), 1
        while name is None and made.lower() in taken:
            n += 1
            made = f"{stem}-{n}.h5"
        names.append(made if name is None else name)
        taken.add(names[-1].lower())
    return names


def _clear(root: Path) -> None:
    """Remove the folders of temporary files, where they are empty."""
    for folder in (disk.temporary(root), disk.temporary(root).parent):
        with contextlib.suppress(OSError):
            folder.rmdir()


_POSITIONS = "positions.csv"


def _files(captures: Sequence[Capture]) -> list[str]:
    """A file's name for each capture, made from its id; no two the same, whatever the file system thinks of case."""
    return _named([capture.id for capture in captures], ".h5")


def _named(wanted: Sequence[str], suffix: str) -> list[str]:
    names: list[str] = []
    taken: set[str] = set()
    for one in wanted:
        stem = re.sub(r"[^A-Za-z0-9.+-]+", "_", one).strip("_.") or "capture"
        name, n = f"{stem}{suffix}", 1
        while name.lower() in taken:
            n += 1
            name = f"{stem}-{n}{suffix}"
        taken.add(name.lower())
        names.append(name)
    return names


def _scenes(captures: Sequence[Capture]) -> dict[Scene, str]:
    """The scenes that captures are of, each once, and the names of their files."""
    shown = dict.fromkeys(capture.light.scene for capture in captures if capture.light.scene is not None)
    return dict(zip(shown, _named([one.name.removesuffix(".npy") for one in shown], ".npy"), strict=True))


def _tiles(captures: Sequence[Capture]) -> dict[bytes, str]:
    """The tiles of the charts that captures are of, as their files hold them, each once, and the names of the files."""
    shown = [capture.light.scene for capture in captures if capture.light.scene is not None]
    laid = {_laid(one.tiles): one.name.removesuffix(".npy") for one in shown if one.tiles is not None}
    return dict(zip(laid, _named(list(laid.values()), ".json"), strict=True))


def _laid(tiles: Tiles) -> bytes:
    return manifest_file.canonical(tiles.facts())


@contextlib.contextmanager
def _alone(root: Path) -> Iterator[None]:
    """Hold the folder for writing; the system lets go of it where the process is killed."""
    try:
        with disk.writing(root, 0):
            lock = system.Lock(Path(os.path.realpath(root)))
    except system.Busy:
        raise SpadError(f"{root}: another run is writing there; wait for it, or choose another folder") from None
    with lock:
        yield


def _check_place(root: Path, captures: Sequence[Capture], layout: Layout) -> None:
    """Refuse a folder that holds anything but parts of this measurement. captures: all of them; none: not known yet."""
    own = disk.temporary(root).parent
    there = set(os.listdir(root)) - {FILE, own.name}
    if own.is_dir():  # a dataset that was begun keeps more there
        there |= {f"{own.name}/{name}" for name in os.listdir(own)} - {f"{own.name}/{disk.temporary(root).name}"}
    if layout.positions is not None:
        there.discard(_POSITIONS)
    known = {*_files(captures), *_scenes(captures).values(), *_tiles(captures).values()}
    parts = (".h5", ".npy", ".json")
    strange = sorted(name for name in there if (name not in known if captures else not name.endswith(parts)))
    if strange:
        raise SpadError(f"{root} is not empty (there is {strange[0]}); choose another folder with -o, or remove it")


def _check_counts(capture: Capture) -> None:
    """Raise InputError where a part of the exposure would be in no count: a count sums 2^bits - 1 binary frames."""
    c = capture.conditions
    if capture.modality == "counts" and c.counting == "frames" and c.frames % c.largest_count:
        raise InputError(
            f"{capture.id}: {c.frames} binary frames do not fill count frames of {c.bits} bits, each the sum of "
            f"{c.largest_count}; take {c.count_frames * c.largest_count or c.largest_count}"
        )


def _commit(root: Path, name: str, data: bytes) -> None:
    final = root / name
    if final.exists():
        if not final.is_file() or final.stat().st_size != len(data) or final.read_bytes() != data:
            raise _Another(final)
        return
    disk.commit_file(final, data, disk.temporary(root))


def _commit_recording(root: Path, name: str, one: Recording, planned: str | None = None) -> None:
    """Like `_commit`, written piece by piece. planned: the capture of a plan that it is."""
    final = root / name
    with disk.writing(final, capture_files.size(one)), disk.workspace(disk.temporary(root)) as work:
        new = work / final.name
        with new.open("x+b") as file:
            capture_files.write(one, file, {capture_files.OWNER: one.capture.id})
            file.flush()
            os.fsync(file.fileno())
        if not final.exists():
            disk.install(new, final, work / "aside")
        elif not final.is_file() or not filecmp.cmp(new, final, shallow=False):
            if planned is not None:
                raise InputError(
                    f"{final}: the capture {planned} has other data already; remove this file to import them anew, or "
                    "say with --capture which capture the new file is"
                )
            raise _Another(final)


class _Another(SpadError):
    """A file that is there is of something else."""

    def __init__(self, final: Path):
        or_remove = "" if final.name == FILE else f", or remove {final.parent}"  # it may be a plan, or describe data
        super().__init__(
            f"{final}: belongs to another measurement, or was made from another sensor or seed; choose another folder "
            f"with -o{or_remove}"
        )


def _yaml(name: str, layout: Layout, captures: Sequence[Capture]) -> str:
    array: dict[str, Any] = {"rows": layout.rows, "columns": layout.columns}
    if layout.positions is not None:
        array = {"positions": _POSITIONS}
    lines = document.dump({"format": FORMAT, "name": name, "layout": array}) + "captures:\n"
    scenes, laid = _scenes(captures), _tiles(captures)
    for capture, file in zip(captures, _files(captures), strict=True):
        entry = document.dump(_entry(capture, file, scenes, laid)).splitlines()
        lines += "".join(f"{'    ' if i else '  - '}{line}\n" for i, line in enumerate(entry))
    return lines


def _entry(capture: Capture, file: str, scenes: Mapping[Scene, str], laid: Mapping[bytes, str]) -> dict[str, Any]:
    lit, c = capture.light, capture.conditions
    shown: dict[str, Any] = {"kind": "dark" if lit.dark else "flat"}
    if lit.scene is not None:
        shown = {"kind": "image", "file": scenes[lit.scene]}
        if lit.scene.tiles is not None:
            shown["tiles"] = laid[_laid(lit.scene.tiles)]
    if lit.wavelength is not None:
        shown["wavelength"] = units.exact(lit.wavelength, "m")
        if lit.level is not None:
            shown[lit.kind_of_level] = units.exact(lit.level, "lux" if lit.kind_of_level == "lux" else "W/m^2")
    for key in ("relative_uncertainty", "own_uncertainty"):
        if getattr(lit, key):
            shown[key] = getattr(lit, key)
    entry: dict[str, Any] = {"id": capture.id}
    entry |= {"file": file} if capture.mean is None else {"mean": float(capture.mean)}
    entry |= {"modality": capture.modality, "light": shown}
    if capture.modality == "tr":
        return entry | {"exposure": units.exact(c.exposure, "s")}
    entry |= {"frames": c.frames}
    entry |= {"frame_time": units.exact(c.frame_time, "s"), "frame_period": units.exact(c.frame_period, "s")}
    if capture.modality == "counts" and capture.mean is not None:
        entry |= {"bits": c.bits, "counting": c.counting}
    return entry
