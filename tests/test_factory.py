"""The factory: the same bytes however a dataset comes about, and nothing lost whoever is killed whenever."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import pickle
import platform
import random
import re
import shutil
import signal
import subprocess
import textwrap
import time
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from commands import COMMAND, run, run_anew
from test_guard import LOSSY_BUS

import spadmnist
from spadmnist import config, factory, golden, plugins, reconstruct, shard_plan
from spadmnist.errors import SpadError
from spadmnist.factory import Progress
from spadmnist.store import Encoding
from spadmnist.workers import Serial

METHODS = ("counts", "passive_free_running", "inter_photon", "str_flux", "qis_counts", "qis_linear")
LEVELS = ("5 mlux", "40 mlux", "160 mlux", "640 mlux", "2560 mlux")

TEXT = """\
seed: 3
scene:
  images: {{source: digits, train: {train}, test: {test}, rows: 8, columns: 8}}
  lux: [{lux}]
recording: {{exposure: 1 ms, frames: {frames}, frame_time: {frame_time}, readouts: [tr, str, qis]}}
reconstruct: [{methods}]
sensor:
  name: small
  layout: {{rows: 8, columns: 8, pixel_area: 25 um^2}}
  effects:
    detection: {{pdp: 0.5}}
    dark_counts: {{rate: 100 Hz}}
    afterpulsing: {{probability: 0.5 %, lifetime: 25 ns}}
    dead_time: {{duration: 50 ns}}
    tdc: {{resolution: 10 ps}}
{more}output: {{format: {format}}}
"""


def write_config(
    path: Path,
    format: str = "zarr",
    levels: tuple[str, ...] = LEVELS[::2],
    methods: tuple[str, ...] = METHODS,
    train: int = 40,
    test: int = 12,
    frames: int = 100,
    more: str = "",
) -> Path:
    """A config of some shards that take milliseconds each."""
    path.parent.mkdir(parents=True, exist_ok=True)
    text = TEXT.format(
        train=train,
        test=test,
        lux=", ".join(levels),
        methods=", ".join(methods),
        frames=frames,
        frame_time=f"{1000 / frames!r} us",
        more=more,
        format=format,
    )
    path.write_text(text)
    return path


def make(
    file: Path,
    root: Path,
    jobs: int = 1,
    progress: Progress = Progress(),  # noqa: B008
    encoding: Encoding | None = None,
    **changes: Any,
) -> factory.Outcome:
    """`spadmnist generate`, in this process; encoding: another than that of new datasets."""
    experiment = config.read(file, **changes)
    experiment = replace(experiment, encoding=encoding or experiment.encoding)
    return factory.generate(experiment, experiment.load_images(), root, jobs, progress)


def tree(root: Path) -> dict[str, bytes | str]:
    """Everything below a folder: files by content, links by target, and the empty folders."""
    found: dict[str, bytes | str] = {}
    for folder, folders, files in os.walk(root):
        for name in [*files, *folders]:
            path = Path(folder, name)
            if path.is_symlink():
                found[str(path.relative_to(root))] = f"link to {os.readlink(path)}"
            elif name in files:
                found[str(path.relative_to(root))] = path.read_bytes()
        if not folders and not files and Path(folder) != root:
            found[str(Path(folder).relative_to(root))] = "empty folder"
    return found


def assert_same(root: Path, expected: dict[str, bytes | str]) -> None:
    there = tree(root)
    wrong = sorted(n for n in there.keys() | expected.keys() if there.get(n) != expected.get(n))
    assert not wrong, f"{len(wrong)} files differ: {wrong[:5]}"


def assert_sentence(result: subprocess.CompletedProcess[str], *words: str) -> None:
    """Exit status 2, and on standard error one line a problem."""
    assert result.returncode == 2, result.stderr
    assert "Traceback" not in result.stderr and "fault of the program" not in result.stderr, result.stderr
    for word in words:
        assert word in result.stderr, result.stderr


@pytest.fixture(scope="session", params=["zarr", pytest.param("hdf5", marks=pytest.mark.slow)])
def format(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="session")
def made(format: str, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """(config, dataset): the reference, made by one worker in this process."""
    home = tmp_path_factory.mktemp(f"made-{format}")
    file = write_config(home / "small.yaml", format)
    make(file, home / "out")
    return file, home / "out"


@pytest.fixture(scope="session")
def many(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """As `made`, with twelve shards, some of which take a tenth of a second."""
    home = tmp_path_factory.mktemp("many")
    file = write_config(home / "many.yaml", levels=LEVELS, train=800, test=200)
    make(file, home / "out")
    return file, home / "out"


# --- the same bytes -----------------------------------------------------------------------------------------------


def test_two_workers_make_the_same_bytes(made: tuple[Path, Path], tmp_path: Path) -> None:
    make(made[0], tmp_path / "out", jobs=2)
    assert_same(tmp_path / "out", tree(made[1]))


def test_shards_in_any_order_make_the_same_bytes(
    made: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_all = Serial.run

    def shuffled(self: Serial, function: Any, make: Any, keys: Any, done: Any) -> None:
        run_all(self, function, make, random.Random(5).sample(list(keys), len(keys)), done)

    monkeypatch.setattr(Serial, "run", shuffled)
    make(made[0], tmp_path / "out")
    assert_same(tmp_path / "out", tree(made[1]))


def test_the_surroundings_do_not_show(made: tuple[Path, Path], tmp_path: Path) -> None:
    """Another folder, config path, time zone, language, umask, hash seed, and process."""
    (tmp_path / "elsewhere").mkdir()
    copy = tmp_path / "copy of small.yaml"
    shutil.copy(made[0], copy)
    surroundings = {"TZ": "Asia/Kathmandu", "LC_ALL": "C", "LANG": "C", "PYTHONHASHSEED": "12345"}
    result = run_anew(
        "generate",
        os.path.relpath(copy, tmp_path / "elsewhere"),
        "--output",
        "../out",
        "--jobs",
        2,
        cwd=tmp_path / "elsewhere",
        env={**os.environ, **surroundings},
        umask=0o077,
    )
    assert result.returncode == 0, result.stderr
    assert_same(tmp_path / "out", tree(made[1]))
    assert list((tmp_path / "elsewhere").iterdir()) == []


def test_nothing_of_the_run_stays(made: tuple[Path, Path]) -> None:
    """No state, lock, temporary file, path, host, user or time."""
    _, root = made
    names = tree(root)
    assert {name.split("/")[0] for name in names} == {"config.yaml", "manifest.json", "data"}
    private = [str(root.parent), str(Path.cwd()), str(Path.home())]
    private += [word for word in (platform.node(),) if len(word) > 3]
    for name, content in names.items():
        assert isinstance(content, bytes), name
        for word in private:
            assert word.encode() not in content, f"{name} holds {word}"
        if name.endswith(".zip"):
            with zipfile.ZipFile(root / name) as zipped:
                assert {info.date_time for info in zipped.infolist()} == {(1980, 1, 1, 0, 0, 0)}, name
        if name.endswith((".json", ".yaml")):
            assert not re.search(rb"20[0-9][0-9]-[01][0-9]-[0-3][0-9]", content), name
            assert str(time.localtime().tm_year).encode() not in re.sub(rb"[0-9a-f]{64}|: [0-9]+", b"", content)


def same(a: Any, b: Any) -> bool:
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    if isinstance(a, spadmnist.Events):
        return all(same(getattr(a, n), getattr(b, n)) for n in ("times", "ticks", "offsets", "tick", "pixels"))
    return type(a) is type(b) and a == b


def assert_same_images(a: spadmnist.Part, b: spadmnist.Part, i: Any, j: Any = None) -> None:
    """Every field of images `i` of one part is that of images `j` of the other."""
    j = i if j is None else j
    for field in ("tr", "qis", "str", "images"):
        assert same(getattr(a, field)[i], getattr(b, field)[j]), field
    for method in a.reconstruction:
        assert same(a.reconstruction[method][i], b.reconstruction[method][j]), method
    if a.labels is not None or b.labels is not None:
        assert same(a.labels[i], b.labels[j])  # type: ignore[index]


def test_an_image_alone_is_the_one_that_is_stored(made: tuple[Path, Path]) -> None:
    """Dataset and config, every field of every image; and the ranges."""
    stored, simulated = spadmnist.open(made[1]), spadmnist.open(made[0])
    assert stored.levels == simulated.levels and stored.lux == simulated.lux
    assert stored.splits == simulated.splits == ("train", "test")
    for level in stored.levels:
        for split in stored.splits:
            a, b = stored[level, split], simulated[level, split]
            assert len(a) == len(b) == {"train": 40, "test": 12}[split]
            for i in range(len(a)):
                assert_same_images(a, b, i)
            for piece in (slice(None), slice(3, 3), slice(-5, -2), slice(30, 99), slice(9, 4)):
                assert_same_images(a, b, piece)
            for method in METHODS:
                one, other = a.reconstruction[method], b.reconstruction[method]
                assert same(one.normalisation, other.normalisation)
                assert same(one.normalised[2:5], other.normalised[2:5])
                assert (one.normalisation is None) == method.startswith("qis")


@pytest.mark.parametrize("frames", [3, 8, 100])
def test_cuts_and_numbers_of_frames(frames: int, format: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A dataset in many shards reads as one, whatever the number of frames."""
    monkeypatch.setattr(shard_plan, "_IMAGES_PER_SHARD", 11)
    file = write_config(tmp_path / "c.yaml", format, ("2560 mlux",), frames=frames)
    outcome = make(file, tmp_path / "out")
    assert outcome.made == 2 + 4 + 2
    a = spadmnist.open(tmp_path / "out")["2560 mlux", "train"]
    b = spadmnist.open(file)["2560 mlux", "train"]
    for piece in (*range(40), slice(None), slice(5, 23), slice(11, 22), slice(-1, None)):
        assert_same_images(a, b, piece)


@pytest.mark.parametrize("causes", [False, True])
def test_a_part_of_the_levels_and_images_holds_the_same_values(
    causes: bool, made: tuple[Path, Path], tmp_path: Path
) -> None:
    make(made[0], tmp_path / "out", lux=("2560 mlux",), limit=7, causes=causes)
    few, all_ = spadmnist.open(tmp_path / "out"), spadmnist.open(made[1])
    assert few.levels == ("2560 mlux",)
    for split in ("train", "test"):
        assert len(few["2560 mlux", split]) == 7
        assert_same_images(few["2560 mlux", split], all_["2560 mlux", split], slice(0, 7))
    alone = spadmnist.open(tmp_path / "out" / "config.yaml")
    assert_same_images(few["2560 mlux", "test"], alone["2560 mlux", "test"], slice(0, 7))


def test_a_part_can_be_sent_to_another_process(made: tuple[Path, Path]) -> None:
    """As loaders of training data do."""
    for path in made:
        part = spadmnist.open(path)["2560 mlux", "test"]
        assert_same_images(pickle.loads(pickle.dumps(part)), part, slice(None))


def test_an_index_is_a_whole_number(made: tuple[Path, Path]) -> None:
    part = spadmnist.open(made[1])["2560 mlux", "test"]
    assert_same_images(part, part, np.int64(3), 3)
    for wrong in (1.5, "1", None, 12, -13):
        with pytest.raises((IndexError, TypeError)):
            part.images[wrong]  # type: ignore[index]


def test_another_seed_draws_other_values(made: tuple[Path, Path], tmp_path: Path) -> None:
    make(made[0], tmp_path / "out", seed=4, limit=12)
    other, first = spadmnist.open(tmp_path / "out"), spadmnist.open(made[1])
    a, b = other["2560 mlux", "test"], first["2560 mlux", "test"]
    assert same(a.images[:], b.images[:]) and not same(a.tr[:], b.tr[:])


# --- the same command again ---------------------------------------------------------------------------------------


def test_a_finished_dataset_is_left_alone(made: tuple[Path, Path]) -> None:
    file, root = made
    before = {p: (p.stat().st_mtime_ns, p.stat().st_ino) for p in root.rglob("*")}
    outcome = make(file, root)
    assert (outcome.made, outcome.kept) == (0, 0)
    assert before == {p: (p.stat().st_mtime_ns, p.stat().st_ino) for p in root.rglob("*")}


class Stop(BaseException):
    """Interrupts a run."""


def interrupted(file: Path, root: Path, after: int) -> None:
    """Make a dataset, and stop after some shards."""
    count = iter(range(after))

    def advance(work: float, note: str) -> None:
        if next(count, None) is None:
            raise Stop

    with pytest.raises(Stop):
        make(file, root, progress=Progress(advance=advance))


def test_a_run_goes_on_where_it_stopped(made: tuple[Path, Path], tmp_path: Path) -> None:
    interrupted(made[0], tmp_path / "out", 3)
    with pytest.raises(SpadError, match="is not finished"):
        spadmnist.open(tmp_path / "out")
    outcome = make(made[0], tmp_path / "out")
    assert (outcome.made, outcome.kept) == (4, 4)
    assert_same(tmp_path / "out", tree(made[1]))


@pytest.mark.parametrize(
    ("change", "difference"),
    [
        ({"seed": 9}, "seed"),
        ({"limit": 9}, "limit"),
        ({"lux": ("5 mlux",)}, "scene.lux"),
    ],
)
@pytest.mark.parametrize("finished", [True, False])
def test_another_config_is_refused(
    change: dict[str, Any], difference: str, finished: bool, made: tuple[Path, Path], tmp_path: Path
) -> None:
    root = tmp_path / "out"
    if finished:
        shutil.copytree(made[1], root)
    else:
        interrupted(made[0], root, 2)
    before = tree(root)
    with pytest.raises(SpadError, match=rf"holds another dataset: .*{difference}") as caught:
        make(made[0], root, **change)
    assert "\n" not in str(caught.value)
    assert_same(root, before)


def test_an_edited_config_is_refused_by_the_command(made: tuple[Path, Path], tmp_path: Path) -> None:
    edited = tmp_path / "small.yaml"
    edited.write_text(made[0].read_text().replace("rate: 100 Hz", "rate: 200 Hz"))
    before = tree(made[1])
    result = run("generate", edited, "-o", made[1])
    assert_sentence(result, "dark_counts.rate", "100 Hz", "200 Hz", "-o")
    assert len(result.stderr.splitlines()) == 1
    assert_same(made[1], before)


# --- under other versions -----------------------------------------------------------------------------------------


def made_elsewhere(root: Path, plant: bool) -> None:
    """Let all shards of an unfinished run be those of another machine, which may have made other bytes."""
    for record in (root / ".spadmnist" / "shards").rglob("*.json"):
        noted = json.loads(record.read_text())
        assert noted["made_by"] == golden.made_by()
        noted["made_by"] |= {"numpy": "1.0", "processor": "an abacus"}
        record.write_text(json.dumps(noted))
        if plant and "images" not in record.parts:
            path = root / next(iter(noted["files"]))
            content = bytearray(path.read_bytes())
            content[len(content) // 2] ^= 1
            path.write_bytes(content)
            noted["files"] |= {next(iter(noted["files"])): put(path)}
            record.write_text(json.dumps(noted))


def put(path: Path) -> dict[str, Any]:
    """What is noted of a file."""
    return {"bytes": path.stat().st_size, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}


@pytest.mark.parametrize("shards", [1, 3])
def test_other_versions_that_make_the_same_bytes_go_on(shards: int, made: tuple[Path, Path], tmp_path: Path) -> None:
    """One of the shards that are there is made again, one with light in it where there is one."""
    said: list[str] = []
    interrupted(made[0], tmp_path / "out", shards)
    made_elsewhere(tmp_path / "out", plant=False)
    outcome = make(made[0], tmp_path / "out", progress=Progress(notice=said.append))
    assert outcome.kept == shards + 1 and [text for text in said if "one shard is made again" in text]
    assert_same(tmp_path / "out", tree(made[1]))


def test_other_versions_that_make_other_bytes_stop(made: tuple[Path, Path], tmp_path: Path) -> None:
    interrupted(made[0], tmp_path / "out", 3)
    made_elsewhere(tmp_path / "out", plant=True)
    before = tree(tmp_path / "out")
    there = f"numpy {golden.versions()['numpy']}"
    assert_sentence(
        run("generate", made[0], "-o", tmp_path / "out"),
        "other bytes",
        there,
        golden.processor(),
        "numpy 1.0",
        "abacus",
    )
    assert_same(tmp_path / "out", before)


def test_a_users_effect_is_made_again_too(tmp_path: Path) -> None:
    """It has no golden shard, and draws for whole blocks of images."""
    (tmp_path / "lossy_bus.py").write_text(LOSSY_BUS)
    plugins.load_file(tmp_path / "lossy_bus.py")
    file = write_config(tmp_path / "c.yaml", levels=LEVELS[::4], train=40, test=4, more="    lossy_bus: {loss: 20 %}\n")
    for name, plant in (("same", False), ("other", True)):
        interrupted(file, tmp_path / name, 2)
        made_elsewhere(tmp_path / name, plant)
    assert make(file, tmp_path / "same").kept == 3
    with pytest.raises(SpadError, match=r"this machine makes other bytes .*there .*numpy 1\.0"):
        make(file, tmp_path / "other")


def test_a_new_run_under_other_versions_makes_a_golden_shard_first(
    made: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = golden.known()
    monkeypatch.setattr(golden, "known", lambda: {**known, "versions": {"numpy": "1.0"}})
    make(made[0], tmp_path / "out", limit=4)
    planted = dict.fromkeys(known["digests"], "0" * 64)
    monkeypatch.setattr(golden, "known", lambda: {"digests": planted, "versions": {"numpy": "1.0"}})
    with pytest.raises(SpadError, match=r"the golden shard of stream 1, encoding [12]: .*there numpy 1\.0"):
        make(made[0], tmp_path / "none")
    assert not (tmp_path / "none").exists()


def test_methods_are_added_to_a_sealed_dataset_where_the_same_bytes_are_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A sealed dataset does not say its processor: its golden shard decides, and where none is known one of its own."""
    file = write_config(tmp_path / "c.yaml", levels=LEVELS[:1], methods=METHODS[:2], train=40, test=4)
    root, known = tmp_path / "out", golden.known()
    make(file, root)
    before, said = tree(root), []
    planted = {**known, "digests": dict.fromkeys(known["digests"], "0" * 64)}
    with monkeypatch.context() as other:
        other.setattr(golden, "known", lambda: planted)
        with pytest.raises(SpadError, match=r"this machine makes other bytes than are there"):
            factory.add_reconstructions(root, METHODS[2:3], 1)
    assert_same(root, before)
    with monkeypatch.context() as other:
        estimate = reconstruct.Counts.estimate
        other.setattr(golden, "check", lambda experiment: False)  # nothing is known of this config
        other.setattr(reconstruct.Counts, "estimate", lambda *asked: estimate(*asked) * (1 + 2e-7))
        with pytest.raises(SpadError, match=r"00000\.zarr\.zip: this machine makes other bytes than are there"):
            factory.add_reconstructions(root, METHODS[2:3], 1)
    assert_same(root, before)
    factory.add_reconstructions(root, METHODS[2:3], 1, Progress(notice=said.append))
    assert said == [], "nothing is known to differ, and nothing did"
    assert tree(root) != before


# --- killed from outside ------------------------------------------------------------------------------------------


def assert_whole_shards(root: Path, expected: dict[str, bytes | str]) -> None:
    """Every shard that is in its place is complete."""
    for name, content in tree(root).items():
        if name.startswith("data/") and content != "empty folder":
            assert content == expected.get(name), f"{name} is not complete"


@contextlib.contextmanager
def running(*arguments: object, **options: Any) -> Iterator[psutil.Popen]:
    """`spadmnist ARGUMENTS` in a process group of its own, which is killed at the end."""
    process = psutil.Popen(
        [COMMAND, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # what a shell starts in the background ignores Ctrl-C, and so would all that it starts
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        **options,
    )
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        process.stdout.close()
        process.stderr.close()


def wait_for(condition: Callable[[], bool], seconds: float) -> bool:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.003)
    return condition()


def records(root: Path) -> int:
    """How many shards an unfinished run has noted."""
    try:
        return len(list((root / ".spadmnist" / "shards").rglob("*.json")))
    except FileNotFoundError:  # the run is just removing them: it has finished
        return 1 << 30


def descendants(process: psutil.Process) -> list[psutil.Process]:
    try:
        return process.children(recursive=True)
    except psutil.NoSuchProcess:
        return []


def alive(processes: list[psutil.Process]) -> list[str]:
    left = []
    for process in processes:
        with contextlib.suppress(psutil.NoSuchProcess):
            if process.is_running() and process.status() != psutil.STATUS_ZOMBIE:
                left.append(" ".join(process.cmdline())[:200])
    return left


def workers(process: psutil.Process) -> list[psutil.Process]:
    found = []
    for child in descendants(process):
        with contextlib.suppress(psutil.NoSuchProcess):
            if "popen_loky" in " ".join(child.cmdline()) and "tracker" not in " ".join(child.cmdline()):
                found.append(child)
    return found


def strike(process: psutil.Popen, whom: str, number: int = signal.SIGKILL) -> list[psutil.Process]:
    """Kill the driver, the whole tree or one worker; the descendants there were."""
    family = descendants(process)
    if whom == "worker":
        for victim in workers(process)[:1]:
            with contextlib.suppress(psutil.NoSuchProcess):
                victim.send_signal(number)
    elif whom == "tree":
        os.killpg(process.pid, number)
    else:
        os.kill(process.pid, number)
    return family


def kill_and_resume(file: Path, root: Path, expected: dict[str, bytes | str], kills: int, rng: random.Random) -> None:
    """Kill the same command again and again, from its first to its last moments; then let it end, and compare."""
    done = 0
    while done < kills:
        with running("generate", file, "-o", root, "--jobs", 2) as process:
            aim = records(root) + rng.choice([0, 1, 1, 2, 3])
            reached = wait_for(
                lambda root=root, aim=aim, process=process: records(root) >= aim or process.poll() is not None, 60
            )
            assert reached
            time.sleep(rng.random() * 0.15)
            if process.poll() is None:
                done += 1
                whom = ("driver", "tree", "worker")[done % 3]
                family = strike(process, whom)
                if whom != "worker":
                    process.wait(10)
                    assert wait_for(lambda family=family: not alive(family), 4), alive(family)
                    if (root / "data").exists():
                        assert_whole_shards(root, expected)
            if process.wait(60) == 0 and not (root / ".spadmnist").exists():
                assert_same(root, expected)
                shutil.rmtree(root)
    result = run("generate", file, "-o", root, "--jobs", 2)
    assert result.returncode == 0, result.stderr
    assert_same(root, expected)


@pytest.mark.slow
def test_killed_and_resumed(many: tuple[Path, Path], tmp_path: Path) -> None:
    """Driver, worker and the whole tree, twice each; a kill at every step of one process is that of `make faults`."""
    kill_and_resume(many[0], tmp_path / "out", tree(many[1]), 6, random.Random(2))


@pytest.mark.slow
def test_a_killed_worker_is_replaced(many: tuple[Path, Path], tmp_path: Path) -> None:
    with running("generate", many[0], "-o", tmp_path / "out", "--jobs", 2) as process:
        assert wait_for(lambda: records(tmp_path / "out") >= 3, 60)
        strike(process, "worker")
        assert process.wait(60) == 0, process.stderr.read()
    assert_same(tmp_path / "out", tree(many[1]))


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
@pytest.mark.parametrize("whom", [pytest.param("driver", marks=pytest.mark.slow), "tree"])
def test_interrupted_by_a_signal(number: int, status: int, whom: str, many: tuple[Path, Path], tmp_path: Path) -> None:
    """Ctrl-C goes to the whole group, a batch system's signal to the driver."""
    root = tmp_path / "out"
    if whom == "tree" and number == signal.SIGTERM:
        pytest.skip("workers end as well; the driver's way out is that of the other cases")
    with running("generate", many[0], "-o", root, "--jobs", 2) as process:
        assert wait_for(lambda: records(root) >= 2, 60)
        family = strike(process, whom, number)
        assert process.wait(15) == status
        said = process.stderr.read()
        assert wait_for(lambda: not alive(family), 4), alive(family)
    assert "Traceback" not in said, said
    if number == signal.SIGINT:
        assert "the same command" in said
    assert not (root / "manifest.json").exists()
    assert_whole_shards(root, tree(many[1]))
    outcome = make(many[0], root)
    assert outcome.kept >= 2
    assert_same(root, tree(many[1]))


POISON = '''
"""An effect that kills the worker which simulates the second level's training images."""
import os, signal
from spadmnist import Effect

DRIVER = os.environ.setdefault("TEST_DRIVER", str(os.getpid()))


class Poison(Effect, stage="light"):
    """Kills."""

    def apply(self, rate, conditions):
        if os.getpid() != int(DRIVER) and len(rate) == 40 and 10e3 < rate.max() < 20e3:
            os.kill(os.getpid(), signal.SIGKILL)
        return rate
'''


@pytest.mark.slow
def test_a_task_that_kills_its_worker_is_named_and_the_others_finish(tmp_path: Path) -> None:
    (tmp_path / "poison.py").write_text(POISON)
    file = write_config(tmp_path / "c.yaml", more="    poison: {}\n")
    result = run("generate", file, "-o", tmp_path / "out", "--jobs", 2, "--plugin", tmp_path / "poison.py")
    assert_sentence(result, "160_mlux/train/00000", "worker")
    missing = {
        f"{level}/{split}"
        for level in ("images", "5_mlux", "160_mlux", "2560_mlux")
        for split in ("train", "test")
        if not any((tmp_path / "out" / "data" / level / split).glob("00000*"))
    }
    assert missing == {"160_mlux/train"}, "the others were not finished"


SLOW = '''
"""An effect that takes its time."""
import time
from spadmnist import Effect


class Slow(Effect, stage="light"):
    """Waits."""

    def apply(self, rate, conditions):
        if len(rate) > 1:  # not while the run is planned
            time.sleep(1)
        return rate
'''


@pytest.mark.slow
def test_two_writers(tmp_path: Path) -> None:
    (tmp_path / "slow.py").write_text(SLOW)
    file = write_config(tmp_path / "c.yaml", more="    slow: {}\n")
    root = tmp_path / "out"
    command = ("generate", file, "-o", root, "--jobs", 1, "--plugin", tmp_path / "slow.py")
    free = write_config(tmp_path / "other.yaml")
    with running(*command) as first:
        assert wait_for(lambda: records(root) >= 1, 60)
        started = time.monotonic()
        second = run(*command)
        took = time.monotonic() - started
        other = run("generate", free, "-o", root)
        assert first.poll() is None, "the first ended too early for this test"
    assert_sentence(second, "another run")
    assert took < 4, "2 s on a machine that has nothing else to do"
    assert_sentence(other, "another dataset")


@pytest.mark.parametrize("left", ["all", "records"])
def test_what_a_kill_left_beside_a_finished_dataset_does_no_harm(left: str, tmp_path: Path) -> None:
    """Killed between the manifest and the removal of the state, or in the middle of that removal."""
    few = write_config(tmp_path / "few.yaml", methods=METHODS[:2])
    make(few, tmp_path / "out")
    rmtree, state = shutil.rmtree, tmp_path / "out" / ".spadmnist"

    def stopped(path: Any, *arguments: Any, **options: Any) -> None:
        if Path(path) == state:
            if left == "records":
                (state / "plan.json").unlink(missing_ok=True)
            raise Stop
        rmtree(path, *arguments, **options)

    rmtree(tmp_path / "out")
    with pytest.MonkeyPatch.context() as patch, pytest.raises(Stop):
        patch.setattr(shutil, "rmtree", stopped)
        make(few, tmp_path / "out")
    assert (tmp_path / "out" / "manifest.json").exists()
    factory.add_reconstructions(tmp_path / "out", METHODS[2:], 1)
    make(write_config(tmp_path / "all.yaml"), tmp_path / "expected")
    assert_same(tmp_path / "out", tree(tmp_path / "expected"))


def test_a_lock_file_that_nobody_holds_does_no_harm(made: tuple[Path, Path], tmp_path: Path) -> None:
    (tmp_path / "out" / ".spadmnist").mkdir(parents=True)
    (tmp_path / "out" / ".spadmnist" / "lock").touch()
    make(made[0], tmp_path / "out")
    assert_same(tmp_path / "out", tree(made[1]))


def test_a_run_that_waited_for_the_end_of_another_one_does_nothing(
    made: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It looked before the other one had finished, and takes the lock after."""
    root = tmp_path / "out"
    look = factory._there

    def meanwhile(place: Path) -> Any:
        found = look(place)
        monkeypatch.setattr(factory, "_there", look)
        make(made[0], root)
        return found

    monkeypatch.setattr(factory, "_there", meanwhile)
    outcome = make(made[0], root)
    assert_same(root, tree(made[1]))
    assert outcome.made == 0


# --- bad places ---------------------------------------------------------------------------------------------------


def test_what_was_refused_leaves_no_trace(made: tuple[Path, Path], tmp_path: Path) -> None:
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "thesis.tex").write_text("mine")
    (tmp_path / "file").write_text("mine")
    for root in (tmp_path / "foreign", tmp_path / "file"):
        with pytest.raises(SpadError):
            make(made[0], root)
    assert tree(tmp_path) == {"foreign/thesis.tex": b"mine", "file": b"mine"}


def test_a_damaged_plan_is_said(made: tuple[Path, Path], tmp_path: Path) -> None:
    interrupted(made[0], tmp_path / "out", 2)
    (tmp_path / "out" / ".spadmnist" / "plan.json").write_text("{")
    with pytest.raises(SpadError, match="damaged"):
        make(made[0], tmp_path / "out")


def test_a_small_dataset_needs_no_workers(tmp_path: Path) -> None:
    """And a large one is known to be large, before its images are and after."""
    small = config.read(write_config(tmp_path / "small.yaml"))
    large = config.read(write_config(tmp_path / "large.yaml", levels=("100 lux",), train=900_000))
    assert factory.few_images(small) and factory.is_small(small, small.load_images())
    assert not factory.few_images(large) and factory.few_images(replace(large, limit=10))
    few = replace(large, limit=1000)
    assert not factory.is_small(few, few.load_images())


def test_a_shard_whose_record_could_not_be_written_is_no_strange_file(
    made: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A disk can be full after the first shard, whole, and before its record."""

    def full(*_: object) -> None:
        raise SpadError("the disk is full")

    with monkeypatch.context() as patch, pytest.raises(SpadError, match="full"):
        patch.setattr(factory, "note", full)
        make(made[0], tmp_path / "out")
    assert (tmp_path / "out" / "data").exists()
    make(made[0], tmp_path / "out")
    assert_same(tmp_path / "out", tree(made[1]))


def test_a_damaged_record_is_made_again(made: tuple[Path, Path], tmp_path: Path) -> None:
    """A loss of power can leave one that is empty."""
    interrupted(made[0], tmp_path / "out", 3)
    for path in (tmp_path / "out" / ".spadmnist" / "shards").rglob("*.json"):
        path.write_bytes(b"")
    make(made[0], tmp_path / "out")
    assert_same(tmp_path / "out", tree(made[1]))


@pytest.mark.parametrize("said", ["{}", '{"files": {}, "made_by": {}}', '{"files": {"config.yaml": 1}, "made_by": {}}'])
def test_a_record_that_does_not_name_its_shard_is_made_again(
    said: str, made: tuple[Path, Path], tmp_path: Path
) -> None:
    """The manifest would be sealed without it."""
    interrupted(made[0], tmp_path / "out", 3)
    for path in (tmp_path / "out" / ".spadmnist" / "shards").rglob("*.json"):
        path.write_text(said)
    assert make(made[0], tmp_path / "out").kept == 0
    assert_same(tmp_path / "out", tree(made[1]))


def test_a_shard_that_was_changed_before_the_end_is_made_again(made: tuple[Path, Path], tmp_path: Path) -> None:
    """Wherever the byte lies: what is sealed is what was made."""
    interrupted(made[0], tmp_path / "out", 5)
    shards = sorted(path for path in (tmp_path / "out" / "data").rglob("0*") if path.is_file())
    for shard, at in zip(shards, (0.1, 0.3, 0.5, 0.7, 0.9), strict=False):
        content = bytearray(shard.read_bytes())
        content[int(len(content) * at)] ^= 1
        shard.write_bytes(content)
    outcome = make(made[0], tmp_path / "out")
    assert outcome.kept == max(0, len(shards) - 5)
    assert_same(tmp_path / "out", tree(made[1]))


def test_a_finished_dataset_that_lacks_a_file_is_not_called_complete(made: tuple[Path, Path], tmp_path: Path) -> None:
    shutil.copytree(made[1], tmp_path / "out")
    shard = next(path for path in (tmp_path / "out" / "data" / "5_mlux").rglob("0*") if path.is_file())
    content = shard.read_bytes()
    for change, says in (
        (shard.unlink, "is missing"),
        (lambda: shard.write_bytes(content + b"x"), "bytes, and it had"),
        (shard.write_bytes, ""),
    ):
        change(*[content] if not says else [])  # type: ignore[operator]
        if says:
            with pytest.raises(SpadError, match=rf"{shard.name}: this file .*{says}.*spadmnist verify .* --repair"):
                make(made[0], tmp_path / "out")
    assert make(made[0], tmp_path / "out").made == 0
    manifest = tmp_path / "out" / "manifest.json"
    manifest.write_text(manifest.read_text().replace('"detections": ', '"detections": 1', 1))
    with pytest.raises(SpadError, match=r"manifest\.json: was changed; spadmnist verify .* --repair"):
        make(made[0], tmp_path / "out")


def test_an_effect_with_blocks_of_images(format: str, tmp_path: Path) -> None:
    """A third party's generator draws for whole blocks: cutting, resuming and reading alone change nothing."""
    plugin = tmp_path / "shaken.py"
    plugin.write_text(
        textwrap.dedent(
            '''
            """An effect that draws."""
            from spadmnist import Effect


            class Shaken(Effect, stage="timing"):
                """Lets the clock run at a speed of its own."""

                def apply(self, events, rng):
                    return type(events)(events.times * rng.uniform(0.5, 1), events.offsets, events.pixels)
            '''
        )
    )
    plugins.load_file(plugin)
    file = write_config(tmp_path / "c.yaml", format, ("160 mlux",), train=70, test=5, more="    shaken: {}\n")
    make(file, tmp_path / "out")
    interrupted(file, tmp_path / "resumed", 2)
    make(file, tmp_path / "resumed", jobs=2)
    assert_same(tmp_path / "resumed", tree(tmp_path / "out"))
    make(file, tmp_path / "few", limit=40)
    a, b = spadmnist.open(tmp_path / "out"), spadmnist.open(file)
    few = spadmnist.open(tmp_path / "few")["160 mlux", "train"]
    for i in (0, 31, 33, 69, slice(None), slice(20, 50)):
        assert_same_images(a["160 mlux", "train"], b["160 mlux", "train"], i)
    assert_same_images(few, a["160 mlux", "train"], slice(0, 40))
    assert json.dumps(plugin.read_text()) in (tmp_path / "out" / "manifest.json").read_text()
