"""Does a dataset still hold, byte for byte, what was made? And: make exactly the damaged files again."""

from __future__ import annotations

import itertools
import os
import re
import shutil
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from . import config, disk, document, factory, golden, manifest_file, shard_facts, shard_plan, store
from .disk import Files
from .errors import InputError, SpadError
from .experiment import Experiment
from .factory import Progress
from .identity import POSITIONS, held, identity
from .images import Images
from .manifest_file import CONFIG, MANIFEST, STATE
from .shard_plan import Shard
from .sources import ABSENT, OTHER, Local, Source, compare, is_as_listed
from .tiles import of_facts
from .workers import Executor, executor

_PIECE = 1 << 22


@dataclass(frozen=True)
class Damage:
    """Files that are not as the manifest says, relative to the dataset's folder.

    files: how many were read; bytes: of them, the manifest included. At an address no file is known to be extra, as
    a server does not say what it holds.
    """

    changed: tuple[str, ...]
    missing: tuple[str, ...]
    extra: tuple[str, ...]
    files: int
    bytes: int = 0

    def __bool__(self) -> bool:
        return bool(self.changed or self.missing or self.extra)


def verify(root: Path | Source, progress: Progress = Progress()) -> Damage:  # noqa: B008
    """Read every byte of a dataset: a folder, or the source that a zip or an address is (`dataset.at`).

    Raises InputError where it never was a dataset, or cannot be reached. What a damaged manifest says of other files is
    not to be trusted: then it alone is named (and a lost config).
    """
    manifest = _manifest(root) if isinstance(root, Path) else manifest_file.intact_manifest(root)
    if manifest is None:
        assert isinstance(root, Path)
        lost = tuple(name for name in (CONFIG, MANIFEST) if not os.path.lexists(root / name))
        return Damage((MANIFEST,) if MANIFEST not in lost else (), lost, (), 0)
    listed: dict[str, dict[str, Any]] = manifest["files"]
    source = Local(root) if isinstance(root, Path) else root
    told = source.names()
    found = set(listed) if told is None else told
    present = sorted(found & set(listed))
    changed, missing = [], sorted(set(listed) - found)
    progress.start("reading", sum(int(listed[name]["bytes"]) for name in present), 0)
    started, read = time.monotonic(), 0
    with ThreadPoolExecutor(max_workers=2) as pool:
        for name, size in zip(present, pool.map(lambda n: compare(source, n, listed[n]), present), strict=True):
            read += max(0, size)
            rate = read / 1e6 / (time.monotonic() - started)
            progress.advance(int(listed[name]["bytes"]), f"{rate:,.0f} MB/s")
            if size == ABSENT:
                missing.append(name)
            elif size == OTHER:
                changed.append(name)
    progress.stop()
    if not changed and not missing and not _adds_up(root, manifest):
        changed.append(MANIFEST)
    read += len(manifest_file.canonical(manifest))
    # what a run has left in the state is no file of the dataset
    extra = sorted(name for name in found - set(listed) - {MANIFEST} if not name.startswith(f"{STATE}/"))
    return Damage(tuple(changed), tuple(sorted(missing)), tuple(extra), len(present) + 1, read)


def refuse_begun(root: Path | Source) -> None:
    """Raise SpadError where methods are being added to a dataset that was finished: its files are of two datasets."""
    if not isinstance(root, Path) or not (root / STATE).is_dir():
        return
    manifest = _manifest(root)
    if manifest is not None:
        factory.refuse_begun(root, manifest)


def _adds_up(root: Path | Source, manifest: Mapping[str, Any]) -> bool:
    """Are the manifest's statistics those that its shards, which are as they were made, say of themselves?"""
    config, levels = manifest["config"], [level["text"] for level in manifest["levels"]]
    like, shards, files = shard_plan.Likeness.of(manifest), manifest_file.shards_in(manifest), manifest["files"]
    methods = config["reconstruct"]
    try:
        encoding = manifest_file.encoding_in(manifest, root)
        told = shard_facts.statistics_of(root, encoding, levels, methods, like, shards, files)
    except InputError:
        return False
    return told == manifest["statistics"]


def _manifest(root: Path) -> dict[str, Any] | None:
    """The manifest as it was sealed; None where a dataset has lost it. Raises InputError where there never was one."""
    try:
        manifest, intact = manifest_file.read_manifest(root)
        return manifest if intact else None
    except InputError:
        if (root / STATE / "repairing").exists():
            return None  # a repair of the manifest that was interrupted
        if not _was_dataset(root) or (root / STATE / "plan.json").exists():
            raise
        return None


def _was_dataset(root: Path) -> bool:
    data = (root / "data.zarr" / "images", root / "data" / "images")
    return any(folder.is_dir() for folder in data)


# --- repair -------------------------------------------------------------------------------------------------------


def repair(
    root: Path,
    damage: Damage,
    jobs: int | Executor,
    images_dir: Path | None = None,
    progress: Progress = Progress(),  # noqa: B008
) -> list[str]:
    """Make exactly the damaged files again; what does not belong there is moved beside the dataset.

    The images come from the dataset itself where they are intact, else from where the config says. Without a
    manifest everything is simulated again and compared. Returns what was done, a line each. jobs: how many workers of
    this machine, or an executor.
    """
    workers = executor(jobs)
    if not damage:
        factory.forget(root)
        return []
    manifest = _manifest(root)
    if manifest is None and not (root / CONFIG).is_file():
        raise SpadError(
            f"{root}: {MANIFEST} and {CONFIG} are both lost, so that nothing says what was here; "
            "generate the dataset anew from its config, in another folder"
        )
    did: list[str] = []
    experiment = _experiment(root, manifest, damage, did)
    splits = _images(root, manifest, experiment, damage, images_dir)
    wanted = identity(experiment, splits)
    if manifest is not None:
        lines = [key for key, value in held(manifest).items() if value != wanted[key]]
        if lines:
            raise SpadError(
                f"{root}: cannot be made again from what is here: {', '.join(lines)} differ from the manifest's; "
                "give the same images (--images-dir) and plug-ins (--plugin)"
            )
    shards = shard_plan.shards_of(experiment, splits)
    bad = {*damage.changed, *damage.missing} - {POSITIONS}
    if manifest is not None:
        labelled = all(images.labels is not None for images in splits.values())
        _check_asked(root, manifest, experiment, shards, labelled, bad, damage.extra)
    with factory.locked(root):
        if manifest is None:
            disk.commit_file(root / STATE / "repairing", b"", disk.temporary(root))
            again = shards
        else:
            hurt = shard_plan.files_by_shard({name: {} for name in bad}, experiment.encoding)
            again = [s for s in shards if experiment.encoding.location(s.path) in hurt]
        did += _set_aside(root, damage.extra)
        remade, lines = _remake(experiment, splits, root, again, manifest, workers, progress)
        did += lines
        if manifest is None:
            factory.begin(root, wanted)
            for shard in shards:
                factory.note(root, shard, remade[shard.path])
            for name in (*factory.small_files(experiment, shards, {})[0], MANIFEST):
                did += _clear_way(root, name)
            factory.finish(experiment, root, wanted, shards, workers, progress)
            did.append(f"made again: {MANIFEST}")
        else:
            for name, data in factory.small_files(experiment, shards, manifest["normalisation"])[0].items():
                if name in bad:
                    did += _clear_way(root, name)
                    disk.commit_file(root / name, data, disk.temporary(root))
                    did.append(f"made again: {name}")
            factory.clear_state(root)
    if manifest is None:  # only now is it known what belongs here
        did += _set_aside(root, verify(root, progress).extra)
    return did


def _check_asked(
    root: Path,
    manifest: Mapping[str, Any],
    experiment: Experiment,
    shards: Sequence[Shard],
    labelled: bool,
    bad: set[str],
    extra: Sequence[str],
) -> None:
    """Raise SpadError where the manifest does not list what its config asks for: then nothing is moved away."""
    small = {*factory.small_files(experiment, shards, manifest["normalisation"])[0], MANIFEST, POSITIONS}
    wrong = "" if manifest_file.shards_in(manifest) == shards else "its shards are not those that its config makes"
    for name in extra:
        if name in small or any(_is_asked(name, s, experiment, labelled) for s in shards):
            wrong = wrong or f"it does not list {name}, which its config asks for"
    for name in sorted(bad - small):
        if not any(_belongs(name, s, experiment.encoding) for s in shards):
            wrong = wrong or f"it lists {name}, which its config does not ask for"
    if MANIFEST in bad:
        wrong = wrong or "its statistics are not those of its shards"
    if wrong:
        raise SpadError(
            f"{root / MANIFEST}: {wrong}; remove {MANIFEST} and type the same command again, which makes it anew"
        )


def _is_asked(name: str, shard: Shard, experiment: Experiment, labelled: bool) -> bool:
    """Is it a file of an array that a config asks a shard to hold? Nothing else has such a place and such a name."""
    place = experiment.encoding.location(shard.path)
    if experiment.encoding.one_file:
        return name == place
    group, _, rest = name.removeprefix(f"{place}/").partition("/")
    if name == group or not name.startswith(f"{place}/") or not _ARRAY_FILE.search(name):
        return False
    if shard.level is None:
        return group in ("zarr.json", "pixels", *(["labels"] if labelled else ()))
    groups = {{"str": "frames", "qis": "frames"}.get(readout, readout) for readout in experiment.readouts}
    return group in {"zarr.json", *groups} or (group == "reconstruction" and rest.split("/")[0] in experiment.methods)


_ARRAY_FILE = re.compile(r"/(zarr\.json|c(\.0)+)$")


def _experiment(root: Path, manifest: dict[str, Any] | None, damage: Damage, did: list[str]) -> Experiment:
    """From the manifest where it is intact, else from the config file. did: where lines on what was done go."""
    if manifest is None:
        experiment = config.read(root / CONFIG)
        # the shards that are there say how they are written
        likely = max(store.encodings(experiment.format), key=lambda one: (one.count(root), one.number))
        return replace(experiment, encoding=likely)
    text = factory.config_text(manifest["config"])
    lost = [name for name in manifest["maps"] if name in {*damage.changed, *damage.missing}]
    beyond = [name for name in lost if name != POSITIONS]
    if beyond:
        raise SpadError(f"{root / beyond[0]}: the sensor's map is lost, and it cannot be made again; put it back")
    if lost:  # of the positions the manifest keeps the text, which the sensor is read from
        with factory.locked(root):
            did += _clear_way(root, POSITIONS)
            disk.commit_file(root / POSITIONS, manifest["maps"][POSITIONS]["text"].encode(), disk.temporary(root))
            did.append(f"made again: {POSITIONS}")
    made = config.build(document.parse(text, str(root / CONFIG)), root)
    return replace(made, encoding=manifest_file.encoding_in(manifest, root))


def _images(
    root: Path,
    manifest: dict[str, Any] | None,
    experiment: Experiment,
    damage: Damage,
    images_dir: Path | None,
) -> Mapping[str, Images]:
    """The dataset's own copies where all of them are intact and whole blocks, else the config's source.

    Repetitions of one image are known by the image alone: they come from the source, too.
    """
    bad = {*damage.changed, *damage.missing}
    if manifest is not None and images_dir is None and experiment.sensor.block == 1:
        own = [s for s in manifest_file.shards_in(manifest) if s.level is None]
        if not any(_belongs(name, s, experiment.encoding) for s in own for name in bad):
            splits: dict[str, Images] = {}
            like = shard_plan.Likeness.of(manifest)
            files = shard_plan.files_by_shard(manifest["files"], experiment.encoding)
            for split in dict.fromkeys(s.split for s in own):
                mine = [s for s in own if s.split == split]
                readers = [s.reader(root, experiment.encoding, like, files) for s in mine]
                pixels = np.concatenate([r.read("pixels") for r in readers])
                labelled = readers[0].has("labels")
                labels = np.concatenate([r.read("labels") for r in readers]) if labelled else None
                laid = manifest["images"]["splits"][split].get("tiles")
                tiles = None if laid is None else of_facts(laid, pixels.shape[-2:])
                splits[split] = Images(pixels, labels, manifest["images"]["white"], tiles=tiles)
            if all(splits[s].sha256 == facts["sha256"] for s, facts in manifest["images"]["splits"].items()):
                return splits
    return experiment.load_images(images_dir)


def _belongs(name: str, shard: Shard, encoding: store.Encoding) -> bool:
    place = encoding.location(shard.path)
    return name == place or name.startswith(place + "/")


def _remake(
    experiment: Experiment,
    splits: Mapping[str, Images],
    root: Path,
    shards: Sequence[Shard],
    manifest: dict[str, Any] | None,
    workers: Executor,
    progress: Progress,
) -> tuple[dict[str, Files], list[str]]:
    """Simulate shards into a folder apart, and put in place the files that differ from what is there.

    Returns (the files of each shard, what was done).
    """
    apart = root / STATE / "again"
    remade: dict[str, Files] = {}
    did: list[str] = []

    def done(path: str, files: Files) -> None:
        progress.advance(1, path)
        for name, facts in files.items():
            if manifest is not None and manifest["files"].get(name) != facts:
                raise golden.other_bytes(root / name, golden.maker(manifest))
            did.extend(_clear_way(root, name))
            if not is_as_listed(root, name, facts):
                os.replace(apart / name, root / name)
                did.append(f"made again: {name}")
        remade[path] = files

    progress.start("making again", len(shards), 0)
    if shards:
        if manifest is None:
            golden.check(experiment)  # else the manifest tells whether the same bytes are made
        factory.greet(workers, experiment)
        factory.make_shards(experiment, splits, apart, shards, workers, done)
    progress.stop()
    return remade, did


def _clear_way(root: Path, name: str) -> list[str]:
    """Move aside what keeps a file from its place (a link, a file instead of a folder, ...), and make its folder."""
    parts = name.split("/")
    did = []
    for folder in ("/".join(parts[:i]) for i in range(1, len(parts))):
        if os.path.lexists(root / folder) and (os.path.islink(root / folder) or not os.path.isdir(root / folder)):
            did += _set_aside(root, [folder])
    if os.path.lexists(root / name) and (os.path.islink(root / name) or not os.path.isfile(root / name)):
        did += _set_aside(root, [name])
    (root / name).parent.mkdir(parents=True, exist_ok=True)
    return did


def _set_aside(root: Path, extra: Sequence[str]) -> list[str]:
    """Move what does not belong to the dataset beside it: it may be somebody's only copy."""
    aside = root.resolve().parent / f"{root.resolve().name}.extra"
    did = []
    for name in extra:
        if not os.path.lexists(root / name):
            continue  # it went with the folder that it lay in
        target = aside / name
        for number in itertools.count(1):
            if not os.path.lexists(target):
                break
            target = aside / f"{name}.{number}"
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.move(root / name, target)
        did.append(f"moved to {target}: {name}")
        folder = (root / name).parent
        while folder != root and not any(folder.iterdir()):
            folder.rmdir()
            folder = folder.parent
    return did


__all__ = ["Damage", "refuse_begun", "repair", "verify"]
