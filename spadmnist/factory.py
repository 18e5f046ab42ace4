"""The factory: a dataset made shard by shard, by several workers, resumable at any moment.

Each shard is simulated, encoded and committed by one task; what is committed is complete. The state of an
unfinished run lies in `.spadmnist/` inside the dataset and is removed at the end: a finished dataset is a function
of what stands in `identity` alone. Shards that other versions or another machine made are gone on with where the same
bytes are made here.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import hashlib
import json
import os
import platform
import re
import secrets
import shutil
import socket
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from . import (
    config,
    disk,
    document,
    golden,
    leftovers,
    manifest_file,
    plugins,
    reconstruct,
    shard_columns,
    shard_facts,
    shard_plan,
    store,
    system,
)
from .compiled import compiling
from .disk import Files
from .errors import InputError, SpadError
from .experiment import Experiment
from .foreign import from_json, quoted
from .golden import versions
from .identity import FORMAT, STREAM, held, identity, plugin_sources, portable, refuse_other, written_as
from .images import Images
from .manifest_file import CONFIG, MANIFEST, STATE
from .reconstruct import median_of_nonzero
from .sensor import BYTES_PER_EVENT
from .shard_columns import OnReading
from .shard_facts import Facts
from .shard_plan import PLAN, Likeness, Shard
from .sources import is_as_listed
from .workers import Executor, Serial, executor

_LARGEST_NOTE = 1 << 30  # bytes; what is read of a plan or a record
# bytes; interpreter, libraries and kernels. Measured: 110 to 250 MB by the kernels that there are, and 100 MB more
# where a process compiles them
_LIBRARIES = 340 * 2**20
_FEW = 2000  # images at all levels: fewer may well be made by this process alone
# s of one core: less work is done by this process. Workers take 1 to 2 s of both cores to start: configs/quick.yaml, of
# 0.6 s by this estimate, took 3.6 s without them and 6.3 s with two
_ALONE = 1.0
# s for which a part waits for who holds the dataset alone: another part that leaves does so for milliseconds, far less
# than a run of the whole takes
_LEAVING = 3.0
_AGAIN = 0.02  # s between two tries
_PER_EVENT_CAUSED = 90  # with the causes (measured: 70 to 105)


@dataclass(frozen=True)
class Job:
    """What a worker needs to know to simulate: enough to build the experiment anew, wherever it is.

    maps: (name, content) of the files that the config names; encoding: of its shards.
    """

    config: str
    maps: tuple[tuple[str, bytes], ...]
    plugins: tuple[plugins.Carried, ...]
    encoding: store.Encoding


@dataclass(frozen=True)
class Task:
    """One shard to be made. pixels: the images of whole blocks around it, the first of which is number `first`."""

    job: Job
    root: str
    shard: Shard
    pixels: np.ndarray
    labels: np.ndarray | None
    white: float
    first: int
    run: Run | None = None


@dataclass(frozen=True)
class Run:
    """What a worker of another machine knows a run by: a file in the dataset's state, and what it holds."""

    path: str
    token: str

    def check(self) -> None:
        """Raise SpadError where a worker does not see the run's file, or the run has ended meanwhile."""
        try:
            there = disk.read_file(self.path, _LARGEST_NOTE).decode()
        except (OSError, ValueError):
            there = ""
        if there != self.token:
            raise SpadError(
                f"a worker on {socket.gethostname()} does not see this run in {Path(self.path).parents[1]}; mount that "
                "folder there under the same name, or say --no-shared, with which workers write nothing themselves"
            )


@dataclass(frozen=True)
class Part:
    """One of several parts of a dataset, for batch systems: every `of`-th shard, from shard `number` on (from 1)."""

    number: int
    of: int

    @classmethod
    def parse(cls, text: str) -> Part:
        """The part that `K/N` names. Raises InputError where there is none."""
        found = re.fullmatch(r"([1-9][0-9]{0,8})/([1-9][0-9]{0,8})", text)
        if not found or int(found[1]) > int(found[2]):
            raise InputError(f"--part {text}: is no part; write K/N with K from 1 to N, as 3/16")
        return cls(int(found[1]), int(found[2]))

    def __str__(self) -> str:
        return f"{self.number}/{self.of}"


@dataclass(frozen=True)
class Progress:
    """How far a run is: called with the work done since the last time (in units of `total`)."""

    start: Callable[[str, float, float], None] = lambda what, total, done: None
    advance: Callable[[float, str], None] = lambda work, note: None
    stop: Callable[[], None] = lambda: None
    notice: Callable[[str], None] = lambda text: None


# --- in a worker --------------------------------------------------------------------------------------------------


@functools.lru_cache(maxsize=2)
def _experiment(job: Job) -> Experiment:
    plugins.load_carried(job.plugins)
    folder = leftovers.temporary("maps")
    try:
        for name, data in job.maps:
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
        experiment = config.build(document.parse(job.config, "config"), folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return replace(experiment, encoding=job.encoding)


def make_shard(task: Task) -> Files:
    """Simulate, encode and commit one shard, then note its files' digests, and its facts, in the state folder."""
    experiment = _experiment(task.job)
    if task.run:
        task.run.check()
    columns, attributes = shard_content(experiment, task)
    if task.run:
        task.run.check()  # once more: nobody waits for a worker that was given up
    root, shard, encoding = Path(task.root), task.shard, experiment.encoding
    files = encoding.write(root, shard.path, columns, attributes)
    told = None
    if shard.level is not None:
        told = shard_facts.facts_of(encoding.reader(root, shard.path), experiment.methods, files)
    note(root, shard, files, told)
    return files


def encode_shard(task: Task) -> dict[str, bytes]:
    """Simulate and encode one shard; its files, for `Encoding.put`."""
    experiment = _experiment(task.job)
    columns, attributes = shard_content(experiment, task)
    return _joined(experiment.encoding.encoded(task.shard.path, columns, attributes))


def _joined(files: Mapping[str, Iterable[bytes]]) -> dict[str, bytes]:
    return {name: b"".join(pieces) for name, pieces in files.items()}


def golden_of(job: Job) -> tuple[str, str]:
    """(digest of a config's golden shard, by what it was made), for `Executor.greet`."""
    return golden.digest(_experiment(job)), golden.words(golden.made_by())


def shard_content(experiment: Experiment, task: Task) -> tuple[dict[str, store.Column], dict[str, Any]]:
    """(columns, attributes) of a shard."""
    shard = task.shard
    attributes: dict[str, Any] = shard.attributes
    skip, end = shard.start - task.first, shard.stop - task.first
    if shard.level is None:
        images = Images(task.pixels, task.labels, task.white)
        return _described(experiment, shard, shard_columns.image_columns(images, skip, end), None), attributes
    level = experiment.level(shard.level)
    recorded = experiment.simulate_block(level, shard.split, task.pixels, task.white, task.first)
    if (skip, end) != (0, len(task.pixels)):
        recorded = recorded.images(skip, end)
    shape = task.pixels.shape[1:]
    labels = None if task.labels is None else task.labels[skip:end]
    columns = _described(experiment, shard, shard_columns.recorded_columns(experiment, recorded, shape), labels)
    return columns, {**attributes, "statistics": json.dumps(shard_columns.statistics(experiment, recorded))}


def _described(
    experiment: Experiment, shard: Shard, columns: dict[str, store.Column], labels: np.ndarray | None
) -> dict[str, store.Column]:
    """The columns of a shard with their coordinates, where the encoding has any."""
    if not experiment.encoding.coordinates:
        return columns
    return columns | shard_columns.coordinate_columns(columns, range(shard.start, shard.stop), labels)


def _record_path(root: Path, shard: Shard) -> Path:
    return root / f"{STATE}/shards/{shard.path}.json"


def note(root: Path, shard: Shard, files: Files, facts: Facts | None = None) -> None:
    """Remember the digests of a shard's files until the manifest lists them, by what they were made, and its facts.

    A loss of power may take the note with it; the shard is then made again.
    """
    record = {"files": files, "made_by": golden.made_by(), **({} if facts is None else {"facts": asdict(facts)})}
    disk.commit_file(_record_path(root, shard), json.dumps(record).encode(), disk.temporary(root), sync=False)


# --- the state of a run -------------------------------------------------------------------------------------------


@contextlib.contextmanager
def locked(root: Path, part: Part | None = None) -> Iterator[None]:
    """Hold the dataset for writing: alone, or one part of it among others. A part that is just ending is waited for.

    The system frees the locks of a process that is killed. Raises SpadError where another run holds them.
    """
    if part and not system.SHARED_LOCKS:
        raise SpadError(f"--part {part}: this system has no lock that several parts can hold; leave it out")
    busy = f"{root}: another run is writing there; wait for it, or choose another folder with -o"
    with contextlib.ExitStack() as held:
        whole = held.enter_context(_lock(root, "lock", busy, part is not None, _LEAVING if part else 0.0))
        if part:
            busy = f"{root}: another run is making part {part} of it; wait for that one"
            held.enter_context(_lock(root, f"part-{part.number}-of-{part.of}", busy))
        try:
            yield
        finally:
            if not part or whole.make_sole():  # of several parts the last one
                _leave(root)
    with contextlib.suppress(OSError):  # what is held cannot be removed everywhere
        os.rmdir(root / STATE)
        os.rmdir(root)


def _lock(root: Path, name: str, busy: str, shared: bool = False, wait: float = 0.0) -> system.Lock:
    """A lock in the state of a dataset, which is made.

    wait: s in which it is tried again. Raises SpadError(busy) where another process holds it still.
    """
    state, ends = root / STATE, time.monotonic() + wait
    while True:
        with _writable(root):
            state.mkdir(parents=True, exist_ok=True)
            try:
                return system.Lock(state / name, shared)
            except system.Busy:
                if time.monotonic() >= ends:
                    raise SpadError(busy) from None
            except FileNotFoundError:  # the run that ended meanwhile has removed the folder
                continue
        time.sleep(_AGAIN)


def _leave(root: Path) -> None:
    """Remove the state where nothing hangs on it: beside a finished dataset, or before a first shard."""
    state = root / STATE
    with contextlib.suppress(OSError):
        if (root / MANIFEST).exists():
            if not (state / "plan.json").exists() and not (state / "repairing").exists():
                shutil.rmtree(state)
        elif not any((state / "shards").rglob("*.json")):
            shards = (root / "data.zarr", root / "data")
            for folder in shards:
                _remove_empty(folder)
            if not any(folder.exists() for folder in shards):  # a shard whose note could not be written needs the plan
                shutil.rmtree(state)
                os.rmdir(root)


def clear_state(root: Path) -> None:
    """Forget a run that has come to its end. A kill in the middle of this is made good by the next run."""
    for name in ("plan.json", "repairing"):
        (root / STATE / name).unlink(missing_ok=True)
    shutil.rmtree(root / STATE, ignore_errors=True)


def clear_records(root: Path) -> None:
    """Forget what was made, and by which plan."""
    shutil.rmtree(root / STATE / "shards", ignore_errors=True)
    (root / STATE / "plan.json").unlink(missing_ok=True)


def tidy(root: Path, manifest: Mapping[str, Any]) -> None:
    """Remove what a run that was killed at its very end has left in the folder of a finished dataset.

    Raises SpadError where methods are being added to it: what is left is then needed to go on.
    """
    if (root / STATE).is_dir():
        with locked(root):
            refuse_begun(root, manifest)
            clear_state(root)


def forget(root: Path) -> None:
    """Remove what any run has left in the folder of a dataset that is as its manifest says."""
    if (root / STATE).is_dir():
        with locked(root):
            clear_state(root)


def refuse_begun(root: Path, manifest: Mapping[str, Any]) -> None:
    """Raise SpadError where methods are being added to a finished dataset, or that was interrupted."""
    if begun := _begun(root, manifest):
        raise SpadError(f"{root}: reconstructions are being added to it; {_go_on(root, manifest, begun)}")


def _begun(root: Path, manifest: Mapping[str, Any]) -> dict[str, Any]:
    """The plan of a run that turns a finished dataset into another one; {} where there is none."""
    plan = _plan(root) if (root / PLAN).exists() else {}
    return {} if held(plan) == held(manifest) else plan


def _go_on(root: Path, manifest: Mapping[str, Any], begun: Mapping[str, Any]) -> str:
    """What to do where a run that adds methods was interrupted. begun: its plan."""
    methods = [str(m) for m in begun["config"].get("reconstruct", ()) if m not in manifest["config"]["reconstruct"]]
    chosen = "".join(f" --method {quoted(method)}" for method in methods)
    return (
        f"`spadmnist reconstruct {quoted(root)}{chosen}` goes on where that was interrupted, and `spadmnist verify "
        f"{quoted(root)} --repair` takes it back: type one of them first"
    )


def _remove_empty(folder: Path) -> None:
    """Remove a folder that holds nothing but empty folders."""
    for inside, folders, files in os.walk(folder, topdown=False):
        if not files and not [f for f in folders if os.path.exists(os.path.join(inside, f))]:
            os.rmdir(inside)


@contextlib.contextmanager
def _writable(place: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        reason = {errno.ENOSPC: "the disk is full", errno.EROFS: "it is read-only"}.get(
            error.errno or 0, error.strerror
        )
        raise SpadError(f"{place}: cannot be written ({reason}); choose another place with -o") from None


# --- generate -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Outcome:
    """What a run did. manifest: empty where it was a part, which finishes nothing."""

    root: Path
    made: int
    kept: int
    seconds: float
    manifest: dict[str, Any]


def generate(
    experiment: Experiment,
    splits: Mapping[str, Images],
    root: Path,
    jobs: int | Executor,
    progress: Progress = Progress(),
    part: Part | None = None,
) -> Outcome:
    """Make the dataset in `root`, or go on with it. Raises SpadError where it cannot be done.

    jobs: how many workers of this machine, or an executor. part: make these shards alone, and finish nothing.
    """
    started = time.monotonic()
    check_volume(experiment, splits)
    shards = shard_plan.shards_of(experiment, splits)
    workers = executor(jobs)
    if workers.local:
        check_memory(experiment, splits, shards, workers.threads)
    kept, finished = _there(root)
    experiment = written_as(experiment, kept) if kept else experiment
    wanted = identity(experiment, splits)
    _refuse_another(root, wanted, kept, finished)
    if finished:
        tidy(root, kept)
        manifest_file.check_there(root, kept["files"])
        return Outcome(root, 0, 0, time.monotonic() - started, kept)
    with locked(root, part):
        kept, finished = _there(root)  # another run has begun or finished it meanwhile
        _refuse_another(root, wanted, kept, finished)
        if finished:
            return Outcome(root, 0, 0, time.monotonic() - started, kept)
        begin(root, wanted, part)
        greet(workers, experiment)
        like = _likeness(experiment, wanted)
        made = {s: noted for s in shards if (noted := _made(root, s, experiment.encoding, like)) is not None}
        mine = shards[part.number - 1 :: part.of] if part else shards
        for shard in _changed(root, {s: made[s] for s in mine if s in made}, progress):
            del made[shard]
        _check_space(root, experiment, splits, sum(noted.bytes for noted in made.values()))

        def again(shard: Shard) -> dict[str, bytes]:
            return encode_shard(task_of(experiment, job_of(experiment), root, shard, splits[shard.split]))

        check_bytes(root, experiment, {s: noted.made_by for s, noted in made.items()}, again, progress)
        missing = [s for s in mine if s not in made]
        del made  # of many shards it is much
        _make(experiment, splits, root, mine, missing, workers, progress)
        manifest = {} if part else finish(experiment, root, wanted, shards, workers, progress)
    return Outcome(root, len(missing), len(mine) - len(missing), time.monotonic() - started, manifest)


def standing(experiment: Experiment, splits: Mapping[str, Images], root: Path) -> str:
    """What `generate` would find in a folder, in a sentence; "" where nothing is there yet. Nothing is changed."""
    try:
        kept, finished = _there(root)
        experiment = written_as(experiment, kept) if kept else experiment
        wanted = identity(experiment, splits)
        _refuse_another(root, wanted, kept, finished)
        if finished:
            refuse_begun(root, kept)
            manifest_file.check_there(root, kept["files"])
    except SpadError as error:
        return f"generate would stop: {error}."
    if finished:
        return f"{root} is complete already: generate would do nothing."
    return f"{root} was begun already: generate would go on with it, and make what is missing." if kept else ""


def _refuse_another(root: Path, wanted: Mapping[str, Any], kept: Mapping[str, Any], finished: bool) -> None:
    """Raise SpadError where a folder holds another dataset, and where it is not about to become the wanted one.

    kept, finished: see `_there`.
    """
    if not (finished and held(_begun(root, kept)) == wanted):
        refuse_other(root, wanted, kept or wanted)


def check_bytes(
    root: Path,
    experiment: Experiment,
    made: Mapping[Shard, Mapping[str, str] | None],
    again: Callable[[Shard], dict[str, bytes]],
    progress: Progress,
) -> None:
    """Raise SpadError where this machine makes other bytes than what is there, or than its libraries once made.

    made: the shards that are there and by what each was made, as far as that is known. Where one may have been made by
    something else than is here, the config's golden shard must be the known one; where none is known, the first shard
    of each such maker is made again and compared. again: makes the files of a shard, by their names for `Encoding.put`.
    """
    here = golden.made_by()
    others: dict[str, tuple[Shard, Mapping[str, str] | None]] = {}
    for shard in sorted(made, key=lambda one: one.level is None):  # the originals, in which nothing is drawn, last
        maker = made[shard]
        if maker is None or not here.items() <= maker.items():  # a finished dataset does not say its processor
            others.setdefault(json.dumps(maker, sort_keys=True), (shard, maker))
    if not others and golden.known()["versions"].items() <= versions().items():
        return
    _warm(experiment, progress)
    if golden.check(experiment):
        return
    for shard, maker in others.values():
        if maker is None or any(here.get(name) != value for name, value in maker.items()):
            progress.notice("Other versions or another machine may have made what is there: one shard is made again.")
        place = experiment.encoding.location(shard.path)
        for name, data in again(shard).items():
            path = root / (place + name.removeprefix("shard"))
            there = b""
            with contextlib.suppress(OSError):  # there is no such file, or a larger one
                there = disk.read_file(path, len(data))
            if there != data:
                raise golden.other_bytes(path, maker)


def check_volume(experiment: Experiment, splits: Mapping[str, Images]) -> None:
    """Raise InputError where one image would hold more than can be simulated or stored."""
    images = next(iter(splits.values()))
    channels = images.pixels[0].size // experiment.sensor.layout.pixels
    experiment.check_volume(images.mean(1000) / images.white, channels)


def check_memory(experiment: Experiment, splits: Mapping[str, Images], shards: Sequence[Shard], jobs: int) -> int:
    """Bytes that a worker takes. Raises InputError where so many workers at a time do not fit into this machine."""
    needed, there = memory_per_worker(experiment, splits, shards), system.memory()
    if min(jobs, len(shards)) * needed > there:
        fit = there // needed
        do = f"give --jobs {fit}" if fit else "lower the frames, the exposure, the light or the number of pixels"
        raise InputError(
            f"{experiment.name}: each of {min(jobs, len(shards))} workers takes about {needed / 1e9:.2g} GB of memory, "
            f"and there are {there / 1e9:.2g} GB: {do}"
        )
    return needed


def most_workers(experiment: Experiment, splits: Mapping[str, Images], processors: int) -> int:
    """How many workers there may be: one for each processor, as far as memory goes, and one at least."""
    needed = memory_per_worker(experiment, splits, shard_plan.shards_of(experiment, splits))
    return max(1, min(processors, system.memory() // needed))


def few_images(experiment: Experiment) -> bool:
    """Whether so few images are known to come that workers are not started before it is clear that they are needed."""
    limit = None if experiment.limit is None else 2 * experiment.limit  # of two splits
    known = [n for n in (limit, experiment.source.drawn()) if n is not None]
    return bool(known) and min(known) * len(experiment.levels) <= _FEW


def is_small(experiment: Experiment, splits: Mapping[str, Images]) -> bool:
    """Whether all images are made sooner than workers start."""
    levels = [level.text for level in experiment.levels]
    cost = sum(
        experiment.wanted(images) * _work(experiment, splits, level, split)
        for split, images in splits.items()
        for level in levels
    )
    return cost < _ALONE


def memory_per_worker(experiment: Experiment, splits: Mapping[str, Images], shards: Sequence[Shard]) -> int:
    """Bytes: interpreter and libraries, images, what is simulated at once, the streams and encoded bytes of a shard.

    The images are those that lie in memory, in one process alone: it is counted to each, for it may be the only one.
    """
    held = sum(part.pixels.nbytes for part in splits.values() if part.in_memory)
    most: dict[tuple[str, str], int] = {}
    for shard in shards:
        if shard.level is not None:
            key = shard.level, shard.split
            most[key] = max(most.get(key, 0), shard.stop - shard.start)
    # packed bits are held once; stamps and images two to three times, before and after they are put in order
    framed = bool({"str", "qis"} & set(experiment.readouts))
    streams = bits = scratch = 0.0
    each = _PER_EVENT_CAUSED if experiment.causes else BYTES_PER_EVENT
    for (level, split), n in most.items():
        events, size = shard_plan.expected_per_image(experiment, experiment.level(level), splits[split])
        scratch = max(scratch, each * experiment.sensor.at_once(events, experiment.readouts))
        packed = splits[split].pixels[0].size * -(-experiment.conditions.frames // 8) * framed
        streams, bits = max(streams, n * (size - packed)), max(bits, n * packed)
    return int(_LIBRARIES + held + scratch + 3 * streams + 1.2 * bits)


def _there(root: Path) -> tuple[dict[str, Any], bool]:
    """(the manifest or the plan of what is there, is it finished?); without a plan, nothing is there yet.

    Refuses a folder that holds something else, before anything is written.
    """
    disk.check_outside(root)
    with _writable(root):
        if not root.exists():
            return {}, False
        if not root.is_dir():
            raise SpadError(f"{root} is a file; choose another place with -o")
        if (root / MANIFEST).exists():
            return manifest_file.intact_manifest(root), True
        content = set(os.listdir(root))
        plan = root / STATE / "plan.json"
        if not plan.exists():
            if content - {STATE}:
                raise SpadError(
                    f"{root} is not empty and holds no dataset (there is {sorted(content)[0]}); "
                    "choose another folder with -o"
                )
            return {}, False
    return _plan(root), False


def _plan(root: Path) -> dict[str, Any]:
    """What an unfinished run makes. Raises SpadError where that cannot be read."""
    path = root / STATE / "plan.json"
    try:
        found = from_json(disk.read_file(path, _LARGEST_NOTE))
    except (OSError, ValueError):
        found = None
    if not isinstance(found, dict) or not isinstance(found.get("config"), dict):
        again = "remove it" if os.path.lexists(root / MANIFEST) else f"remove {root}"
        raise SpadError(f"{path}: is damaged; {again} and begin again")
    return found


def begin(root: Path, wanted: dict[str, Any], part: Part | None = None) -> None:
    """Note what is being made, so that the same command can go on with it and no other can.

    Raises SpadError where another part has begun to make something else.
    """
    with _writable(root):
        if part is None:
            disk.sweep(disk.temporary(root))
        with system.Lock(root / STATE / "begin", wait=True):  # parts begin one after the other
            if not (root / STATE / "plan.json").exists():
                # records without a plan are those of a run that has finished
                shutil.rmtree(root / STATE / "shards", ignore_errors=True)
            elif part:
                refuse_other(root, wanted, _plan(root))
            disk.commit_file(root / STATE / "plan.json", manifest_file.canonical(wanted), disk.temporary(root))


def _check_space(root: Path, experiment: Experiment, splits: Mapping[str, Images], present: int) -> None:
    """Refuse early where the disk cannot hold what is still to come (a rough, low estimate: half the raw size).

    present: bytes that are there already.
    """
    raw = 0.0
    for images in splits.values():
        for level in experiment.levels:
            _, size = shard_plan.expected_per_image(experiment, level, images)
            raw += size * experiment.wanted(images)
    free = shutil.disk_usage(root).free
    needed = raw / 4 - present
    if free < needed:
        raise SpadError(
            f"{root}: about {disk.amount(needed)} are still to be written, but only {disk.amount(free)} are free; "
            "free some space, or choose another place with -o"
        )


def _likeness(experiment: Experiment, wanted: Mapping[str, Any]) -> Likeness:
    """What the shards of an experiment have in common. wanted: its identity."""
    return Likeness(tuple(wanted["images"]["shape"]), experiment.conditions.frames, experiment.settings.tick)


def _made(root: Path, shard: Shard, encoding: store.Encoding, like: Likeness) -> Note | None:
    """What was noted of a shard that is there as it was made, else None.

    Its attributes and the sizes of its files say so; its data are not read (see `_changed`).
    """
    noted = _noted(root, shard, encoding)
    if noted.files is None or not encoding.exists(root, shard.path):
        return None
    reader = shard.reader(root, encoding, like)
    base = f"{root}{os.sep}"
    try:
        for name, facts in noted.files.items():
            if os.lstat(base + name).st_size != facts["bytes"]:
                return None
        return noted if reader.attributes else None
    except (InputError, OSError, KeyError, TypeError):
        return None


def _changed(root: Path, made: Mapping[Shard, Note], progress: Progress) -> list[Shard]:
    """The shards whose files are not those that were noted. Every byte is read: the manifest will vouch for it."""

    def changed(shard: Shard) -> bool:
        return not all(is_as_listed(root, name, facts) for name, facts in (made[shard].files or {}).items())

    found = []
    if made:
        progress.start("reading", sum(noted.bytes for noted in made.values()), 0)
        with ThreadPoolExecutor(max_workers=2) as pool:
            found = [shard for shard, other in zip(made, pool.map(changed, made), strict=True) if other]
        progress.stop()
    return found


@dataclass(frozen=True)
class Note:
    """What is noted of a shard: its files, by what they were made, and its facts; None where that is not known."""

    files: Files | None
    made_by: dict[str, str] | None
    facts: Facts | None = None

    @property
    def bytes(self) -> int:
        """Of all its files."""
        return sum(facts["bytes"] for facts in (self.files or {}).values())


def _noted(root: Path, shard: Shard, encoding: store.Encoding) -> Note:
    """What was noted of a shard, as far as that can be read and is of this shard."""
    try:
        found = from_json(disk.read_file(_record_path(root, shard), _LARGEST_NOTE))
    except (OSError, ValueError):
        return Note(None, None)
    if not isinstance(found, dict):
        return Note(None, None)
    if not {"files", "made_by"} <= set(found):  # spadmnist 0.1.0 noted the files alone
        found = {"files": found, "made_by": None}
    files, made_by = found["files"], found["made_by"]
    if not encoding.are_files_of(shard.path, files):
        return Note(None, None)
    return Note(files, made_by if isinstance(made_by, dict) else None, Facts.noted(found.get("facts")))


def _make(
    experiment: Experiment,
    splits: Mapping[str, Images],
    root: Path,
    shards: Sequence[Shard],
    missing: Sequence[Shard],
    workers: Executor,
    progress: Progress,
) -> None:
    each = {key: _work(experiment, splits, *key) for key in {(s.level, s.split) for s in shards}}
    work = {s.path: (s.stop - s.start) * each[s.level, s.split] for s in shards}
    total = sum(work.values())
    progress.start("simulating", total, total - sum(work[s.path] for s in missing))
    by_path = {s.path: s for s in missing}
    started, images = time.monotonic(), 0

    def done(path: str, _: Files) -> None:
        nonlocal images
        shard = by_path[path]
        images += shard.stop - shard.start if shard.level is not None else 0
        rate = images / (time.monotonic() - started)
        progress.advance(work[path], f"{shard.level or 'images'} {shard.split}, {rate:,.0f} images/s")

    if missing:
        _warm(experiment, progress)
        make_shards(experiment, splits, root, missing, workers, done)
    progress.stop()


def make_shards(
    experiment: Experiment,
    splits: Mapping[str, Images],
    root: Path,
    shards: Sequence[Shard],
    workers: Executor,
    done: Callable[[str, Files], None],
) -> None:
    """Make shards in `root`, which is a dataset or lies in its state; `done` is called with the path of each, and the
    digests of its files."""
    by_path, job = {s.path: s for s in shards}, job_of(experiment)

    def tasks(paths: Sequence[str]) -> Iterator[Task]:
        return (task_of(experiment, job, root, by_path[p], splits[by_path[p].split], run) for p in paths)

    def keep(path: str, files: dict[str, bytes]) -> None:
        size = sum(map(len, files.values()))
        made = experiment.encoding.put(root, path, {name: [data] for name, data in files.items()}, size)
        note(root, by_path[path], made)
        done(path, made)

    with running(root, workers) as run:
        if workers.shared:
            workers.run(make_shard, tasks, list(by_path), done)
        else:
            workers.run(encode_shard, tasks, list(by_path), keep)


def _work(experiment: Experiment, splits: Mapping[str, Images], level: str | None, split: str) -> float:
    """Rough cost of an image, in seconds of one core: what the progress bar's time left rests on."""
    if level is None:
        return 2e-6
    images = splits[split]
    events, size = shard_plan.expected_per_image(experiment, experiment.level(level), images)
    return 8e-9 * events + 5e-9 * size + 3e-8 * images.pixels[0].size


def job_of(experiment: Experiment) -> Job:
    """The experiment, for workers."""
    resolved, maps = portable(experiment)
    return Job(document.dump(resolved), tuple(maps.items()), plugins.carried(), experiment.encoding)


def task_of(experiment: Experiment, job: Job, root: Path, shard: Shard, images: Images, run: Run | None = None) -> Task:
    """The task that makes a shard: whole blocks of images where an effect needs them."""
    block = experiment.sensor.block if shard.level is not None else 1
    first = shard.start // block * block
    last = min(-(-shard.stop // block) * block, len(images))
    labelled = images.labels is not None and (shard.level is None or experiment.encoding.coordinates)
    labels = images.labels[first:last] if labelled and images.labels is not None else None
    return Task(job, os.path.abspath(root), shard, images.some(first, last), labels, images.white, first, run)


def greet(workers: Executor, experiment: Experiment) -> None:
    """Have each worker of another machine show first that it makes the bytes that are made here."""
    if golden.has_golden(experiment):
        workers.greet(golden_of, job_of(experiment))
    else:
        workers.greet(golden.answer, None)


@contextlib.contextmanager
def running(root: Path, workers: Executor) -> Iterator[Run | None]:
    """The mark in a dataset's state by which workers of other machines know this run; None where none need it."""
    if workers.local or not workers.shared:
        yield None
        return
    token = secrets.token_hex(16)
    run = Run(os.path.abspath(root / STATE / f"run-{token}"), token)
    disk.commit_file(run.path, token.encode(), disk.temporary(root))
    try:
        yield run
    finally:
        Path(run.path).unlink(missing_ok=True)  # a worker that was given up writes nothing any more


def _warm(experiment: Experiment, progress: Progress) -> None:
    """Compile the kernels once, here, so that the workers find them in the cache."""
    if experiment.sensor.block > 1:
        return  # a user's effect is run for the images that are wanted, and for no others
    with compiling(lambda: progress.notice("Compiling the simulation for this machine, once: about 20 s.")):
        channels = (len(experiment.wavelengths),) if experiment.wavelengths else ()
        shape = (*channels, *experiment.sensor.layout.shape)
        made = experiment.simulate_block(experiment.levels[0], "warm", np.zeros((1, *shape), np.uint8), 255, 0)
        shard_columns.recorded_columns(experiment, made, shape)
        shard_columns.statistics(experiment, made)


# --- reconstruct --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Addition:
    """Methods to add to a shard."""

    job: Job
    root: str
    shard: Shard
    methods: tuple[str, ...]
    like: Likeness
    files: dict[str, Files]
    run: Run | None = None


def add_methods(addition: Addition) -> tuple[str, Files]:
    """Reconstruct the images of one shard from its raw streams and add them to it."""
    experiment = _experiment(addition.job)
    if addition.run:
        addition.run.check()
    root, shard = Path(addition.root), addition.shard
    encoding = experiment.encoding
    reader = shard.reader(root, encoding, addition.like, addition.files)
    _check_own(reader, experiment, addition)
    recorded, shape = shard_columns.read_shard(reader, experiment)
    columns = shard_columns.reconstruction_columns(experiment, recorded, shape, addition.methods)
    labels = next((reader.read(name) for name in reader.names if name.endswith("/label")), None)
    files = encoding.append(root, shard.path, _described(experiment, shard, columns, labels))
    return shard.path, files


def _check_own(reader: store.ShardReader, experiment: Experiment, addition: Addition) -> None:
    """Raise InputError where a shard is not the one that the manifest lists.

    It may be that one with the methods, which a run added that was killed before it could note so.
    """
    root, encoding, path = Path(addition.root), experiment.encoding, addition.shard.path
    listed = addition.files[encoding.location(path)]
    for name, facts in listed.items():
        if is_as_listed(root, name, facts):
            continue
        if encoding.one_file:
            older = [method for method in experiment.methods if method not in addition.methods]
            kept = [n for n in reader.names if not n.startswith("reconstruction/") or _is_older(n, older, addition)]
            columns = {n: reader.column(n) for n in kept}
            before = hashlib.sha256()
            for pieces in encoding.encoded(path, columns, reader.attributes).values():
                for piece in pieces:
                    before.update(piece)
            if before.hexdigest() == facts["sha256"]:
                continue
        raise InputError(
            f"{root / name}: this is not the file that was made, and nothing was added to it; "
            f"`spadmnist verify {quoted(root)} --repair` makes it again"
        )


def _is_older(name: str, older: Sequence[str], addition: Addition) -> bool:
    """Was an array of the group of reconstructions there before some were added? Without an older one none was."""
    return bool(older) and name.removeprefix("reconstruction/") not in addition.methods


def _as_read(root: Path, shard: Shard, experiment: Experiment, like: Likeness) -> dict[str, bytes]:
    """The files of a shard, made again from its own streams; see `check_bytes`."""
    reader = shard.reader(root, experiment.encoding, like)
    columns = {name: reader.column(name) for name in reader.names}
    if shard.level is not None:
        recorded, shape = shard_columns.read_shard(reader, experiment)
        stored = () if experiment.on_reading else experiment.methods
        methods = [method for method in stored if reader.has(f"reconstruction/{method}")]
        columns |= shard_columns.reconstruction_columns(experiment, recorded, shape, methods)
    return _joined(experiment.encoding.encoded(shard.path, columns, reader.attributes))


def add_reconstructions(
    root: Path,
    names: Sequence[str],
    jobs: int | Executor,
    progress: Progress = Progress(),
) -> tuple[list[str], dict[str, Any]]:
    """Flux images from the raw streams of a finished dataset, as if its config had asked for them.

    Returns (methods that were added, manifest). An interrupted run is taken up by the same call. jobs: see `generate`.
    """
    workers, manifest = executor(jobs), manifest_file.intact_manifest(root)
    encoding = manifest_file.encoding_in(manifest, root)
    before = config.build(document.parse(config_text(manifest["config"]), str(root / CONFIG)), root)
    before = replace(before, encoding=encoding)
    if before.on_reading:
        raise InputError(
            f"{root}: its flux images are made when they are read (output.reconstructions: on_reading), and none is "
            "added; make the dataset anew with all methods under reconstruct, or without that entry"
        )
    chosen = list(names) or [
        m for m in reconstruct.Method.registry if set(reconstruct.find(m).readouts()) <= set(before.readouts)
    ]
    for name in chosen:
        lacking = set(reconstruct.find(name).readouts()) - set(before.readouts)
        if lacking:
            raise InputError(f"{root}: {name} needs {', '.join(sorted(lacking))}, which was not recorded")
    new = tuple(dict.fromkeys(m for m in chosen if m not in before.methods))
    if not new:
        tidy(root, manifest)
        return [], manifest
    after = before.with_methods((*before.methods, *new))
    refuse_other(root, {**held(manifest), "stream": STREAM}, manifest)
    wanted = {**held(manifest), "config": portable(after)[0], "plugins": plugin_sources(after)}
    shards = manifest_file.shards_in(manifest)
    with locked(root):
        plan = root / STATE / "plan.json"
        if plan.exists():
            there = _plan(root)
            if held(there) == held(manifest):
                clear_records(root)  # of the run that made what is here, and was killed at its very end
            else:
                refuse_other(root, wanted, there, _go_on(root, manifest, there))
        begun = plan.exists()  # records without a plan are those of a run that has finished
        by_path = {s.path: s for s in shards if not begun or _noted(root, s, encoding).files is None}
        files = shard_plan.files_by_shard(manifest["files"], encoding)
        _check_ready(root, shards, by_path, files, encoding, begun, progress)
        job, like = job_of(after), Likeness.of(manifest)
        greet(workers, after)
        makers = {s: golden.maker(manifest) if s.path in by_path else _noted(root, s, encoding).made_by for s in shards}
        check_bytes(root, after, makers, lambda shard: _as_read(root, shard, after, like), progress)
        begin(root, wanted)

        def files_of(shard: Shard) -> dict[str, Files]:
            place = encoding.location(shard.path)
            return {place: files.get(place, {})}

        def done(path: str, result: tuple[str, Files]) -> None:
            known = files.get(encoding.location(path), {})
            note(root, by_path[path], known | result[1])
            progress.advance(1, path)

        for path in [p for p, s in by_path.items() if s.level is None]:
            note(root, by_path[path], files.get(encoding.location(path), {}))
            del by_path[path]
        progress.start("reconstructing", len(shards), len(shards) - len(by_path))
        if by_path:
            place = os.path.abspath(root)
            with running(root, workers) as run:

                def additions(paths: Sequence[str]) -> Iterator[Addition]:
                    return (Addition(job, place, by_path[p], new, like, files_of(by_path[p]), run) for p in paths)

                workers.run(add_methods, additions, list(by_path), done)
        progress.stop()
        return list(new), finish(after, root, wanted, shards, workers, progress)


def _check_ready(
    root: Path,
    shards: Sequence[Shard],
    by_path: Mapping[str, Shard],
    files: Mapping[str, Files],
    encoding: store.Encoding,
    begun: bool,
    progress: Progress,
) -> None:
    """Raise InputError where a shard is missing, or one that was noted is not as it was made.

    by_path: those that are not noted. files: what the manifest lists of each shard. begun: is it an interrupted run?
    """
    noted: dict[Shard, Note] = {}
    for shard in shards:
        listed = files.get(encoding.location(shard.path), {})
        if shard.path not in by_path:
            note_of = _noted(root, shard, encoding)
            listed = note_of.files or {}
            if shard.level is not None:
                noted[shard] = note_of
        elif begun and encoding.one_file and encoding.exists(root, shard.path):
            continue  # it may have been changed, and the run been killed before that was noted; see `_check_own`
        manifest_file.check_there(root, listed)
    for shard in _changed(root, noted, progress):
        raise InputError(
            f"{root / encoding.location(shard.path)}: was changed after reconstructions were added to it; "
            f"`spadmnist verify {quoted(root)} --repair` makes it again, without them"
        )


# --- finishing ----------------------------------------------------------------------------------------------------


def _normalise(arguments: tuple[Path, Job, Likeness, list[Shard], str]) -> float | None:
    root, job, like, shards, method = arguments
    experiment = _experiment(job)
    readers = [(shard.reader(root, experiment.encoding, like), shard.stop - shard.start) for shard in shards]
    if not experiment.on_reading:
        return median_of_nonzero(lambda: (reader.read(f"reconstruction/{method}") for reader, _ in readers))
    made = OnReading.of(experiment, like)
    return median_of_nonzero(lambda: (made.fluxes(reader, method, 0, n) for reader, n in readers))


def finish(
    experiment: Experiment,
    root: Path,
    wanted: dict[str, Any],
    shards: Sequence[Shard],
    workers: Executor,
    progress: Progress,
) -> dict[str, Any]:
    """Normalisation, groups, config and manifest; then the state is removed."""
    split = shards[0].split
    like = _likeness(experiment, wanted)
    training: dict[str, list[Shard]] = {level.text: [] for level in experiment.levels}
    for shard in shards:
        if shard.level is not None and shard.split == split:
            training[shard.level].append(shard)
    keys = [
        (level.text, method)
        for level in experiment.levels
        for method in experiment.methods
        if reconstruct.find(method).normalised
    ]
    normalisation: dict[str, dict[str, float | None]] = {level.text: {} for level in experiment.levels}
    progress.start("normalising", len(keys), 0)

    def tasks(which: Sequence[tuple[str, str]]) -> Iterator[Any]:
        place, job = Path(os.path.abspath(root)), job_of(experiment)
        return ((place, job, like, training[level], method) for level, method in which)

    def done(key: tuple[str, str], value: float | None) -> None:
        normalisation[key[0]][key[1]] = value
        progress.advance(1, key[0])

    if keys:
        (workers if workers.shared else Serial()).run(_normalise, tasks, keys, done)
    progress.stop()
    for text, method in keys:
        reconstruct.divisor(reconstruct.find(method), normalisation[text].get(method))

    temporary = disk.temporary(root)
    files: Files = {}
    facts: dict[str, Facts] = {}
    for shard in shards:
        noted = _noted(root, shard, experiment.encoding)
        if noted.files is None:
            raise SpadError(
                f"{_record_path(root, shard)}: what was noted of a shard is missing or damaged; type the same command "
                "again, which makes that shard anew"
            )
        files |= noted.files
        if noted.facts is not None:
            facts[shard.path] = noted.facts
    small, groups = small_files(experiment, shards, normalisation)
    files |= experiment.encoding.write_groups(root, groups)
    for name, data in small.items():
        if name not in files:
            files[name] = disk.commit_file(root / name, data, temporary)
    settings = asdict(experiment.settings)
    manifest = {
        **wanted,
        "seed": experiment.seed,
        "levels": [{"text": x.text, "kind": x.kind, "value": x.value} for x in experiment.levels],
        "settings": settings,
        "shards": [asdict(shard) for shard in shards],
        "normalisation": normalisation,
        **({"causes": list(experiment.sensor.causes)} if experiment.causes else {}),
        "statistics": shard_facts.statistics_of(
            root,
            experiment.encoding,
            [x.text for x in experiment.levels],
            experiment.methods,
            like,
            shards,
            files,
            facts,
        ),
        "files": files,
    }
    sealed = manifest_file.seal({**manifest, "provenance": {**versions(), "python": platform.python_version()}})
    disk.commit_file(root / MANIFEST, sealed, temporary)
    clear_state(root)
    return json.loads(sealed)


def small_files(
    experiment: Experiment,
    shards: Sequence[Shard],
    normalisation: Mapping[str, Mapping[str, float | None]],
) -> tuple[dict[str, bytes], dict[str, dict[str, Any]]]:
    """(every file besides shards and manifest, by name; the Zarr groups' attributes, by path)."""
    resolved, files = portable(experiment)
    files[CONFIG] = config_text(resolved).encode()
    groups: dict[str, dict[str, Any]] = {"": {"format": FORMAT}}
    for shard in shards:
        groups.setdefault(shard.folder, _level_attributes(experiment, shard, normalisation))
        groups.setdefault(f"{shard.folder}/{shard.split}", {"split": shard.split})
    return files | experiment.encoding.groups(groups), groups


def config_text(resolved: dict[str, Any]) -> str:
    """The config file of a finished dataset."""
    return (
        "# The config of this dataset with nothing left open. spadmnist.open reads this file, too.\n"
        + document.dump(resolved)
    )


def _level_attributes(
    experiment: Experiment, shard: Shard, normalisation: Mapping[str, Mapping[str, float | None]]
) -> dict[str, Any]:
    if shard.level is None:
        return {"content": "original images and labels"}
    level = experiment.level(shard.level)
    unit = "lux" if level.kind == "lux" else "W/m^2"
    medians = {f"normalisation_{k}": v for k, v in sorted(normalisation.get(shard.level, {}).items()) if v is not None}
    return {"level": level.text, "value": level.value, "unit": unit, **medians}
