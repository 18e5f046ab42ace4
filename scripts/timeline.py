"""Where the time of `spadmnist generate` goes: a timeline of its workers, and the processor's seconds by stage.

    python scripts/timeline.py [CONFIG] [--lux LEVEL] [--limit N] [--jobs N] [--threads] -o build/profile

The command line itself is run in this process. Its functions are wrapped here and, with every task, in the workers:
the package knows nothing of it. Written are `timeline.png` and `timeline.md`, and the table is printed.

The stages of a task: *simulate* (with flux images and their statistics), *encode* (differences, compression and
checksums of chunks), *hash* (SHA-256 of the files), *write* (write, synchronise, rename), *medians* (of flux images),
*other*. Times of a stage are its own, without the stages within it. Processor seconds are of a thread or a process,
and hardly depend on what else runs on the machine; wall times do. *The floor* is the time of numpy for as many
exponentials as the run draws.

--threads: the tasks in threads of this process instead of processes.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import os
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
STAGES = {
    "simulate": "#3b6fb6",
    "encode": "#e08a2c",
    "hash": "#b5403f",
    "write": "#5b9a4b",
    "medians": "#8a6bb1",
    "other": "#b9b9b9",
}
PHASES = ("#d9d9d9", "#a6bddb", "#fdd49e", "#c7e9c0", "#dadaeb")  # of the parent, in turn


def process_began() -> float:
    """When this process began, on the clock of `time.monotonic`; where that is not told, now."""
    try:
        ticks = int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19])
        return ticks / os.sysconf("SC_CLK_TCK") + time.monotonic() - time.clock_gettime(time.CLOCK_BOOTTIME)
    except (OSError, AttributeError, ValueError):
        return time.monotonic()


# --- spans --------------------------------------------------------------------------------------------------------


@dataclass
class Span:
    """A time in a function. own, processor: s within it, without the spans within it."""

    name: str
    start: float
    end: float = 0.0
    own: float = 0.0
    processor: float = 0.0


class Spans(threading.local):
    """Those of a thread, in the order of their ends."""

    def __init__(self) -> None:
        self.ended: list[Span] = []
        self._open: list[list[float]] = []  # wall and processor of the spans within each open one

    @contextlib.contextmanager
    def span(self, name: str) -> Iterator[None]:
        self._open.append([0.0, 0.0])
        made, processor = Span(name, time.monotonic()), time.thread_time()
        try:
            yield
        finally:
            processor, made.end = time.thread_time() - processor, time.monotonic()
            inner = self._open.pop()
            made.own, made.processor = made.end - made.start - inner[0], processor - inner[1]
            if self._open:
                self._open[-1][0] += made.end - made.start
                self._open[-1][1] += processor
            self.ended.append(made)

    def taken(self) -> list[Span]:
        ended, self.ended = self.ended, []
        return ended


SPANS = Spans()


def wrap(owner: Any, function: str, name: str) -> None:
    """Have a span around each call of a function of a module or class."""
    real = getattr(owner, function)

    @functools.wraps(real)
    def spanned(*args: Any, **options: Any) -> Any:
        with SPANS.span(name):
            return real(*args, **options)

    setattr(owner, function, spanned)


# --- in a worker --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Report:
    """What is known of a task. worker: (process, thread); began: of the process, startup: s of its processor before."""

    worker: tuple[int, int]
    began: float
    startup: float
    processor: float  # s of the whole process up to the end of this task
    spans: list[Span]


def traced(function: Callable[[Any], Any], task: Any) -> tuple[Any, Report]:
    """A task and its report."""
    startup = instrument()
    SPANS.taken()
    with SPANS.span("other"):
        result = function(task)
    who = os.getpid(), threading.get_ident()
    return result, Report(who, process_began(), startup, time.process_time(), SPANS.taken())


@functools.cache
def instrument() -> float:
    """Wrap the stages of a task, once in a process; s of its processor so far."""
    before = time.process_time()
    from spadmnist import disk, factory, shard_columns
    from spadmnist.experiment import Experiment
    from spadmnist.store import Encoding

    wrap(Experiment, "simulate_block", "simulate")
    wrap(shard_columns, "reconstruction_columns", "simulate")
    wrap(shard_columns, "statistics", "simulate")
    wrap(shard_columns, "stream_columns", "encode")
    wrap(Encoding, "put", "write")
    wrap(factory, "median_of_nonzero", "medians")
    disk.hashlib = _Hashes  # type: ignore[assignment, attr-defined]
    for encoding in {type(one) for one in Encoding.every.values()}:
        _wrap_pieces(encoding)
    return before


def _wrap_pieces(encoding: Any) -> None:
    real = encoding._files

    def files(self: Any, *asked: Any) -> dict[str, Iterable[bytes]]:
        with SPANS.span("encode"):
            made = real(self, *asked)
        return {name: _pieces(pieces) for name, pieces in made.items()}

    encoding._files = files


def _pieces(pieces: Iterable[bytes]) -> Iterator[bytes]:
    left = iter(pieces)
    while True:
        with SPANS.span("encode"):
            piece = next(left, None)
        if piece is None:
            return
        yield piece


class _Hashes:
    """`hashlib` as `disk` uses it."""

    class sha256:
        def __init__(self) -> None:
            import hashlib

            self._digest = hashlib.sha256()

        def update(self, data: bytes) -> None:
            with SPANS.span("hash"):
                self._digest.update(data)

        def hexdigest(self) -> str:
            return self._digest.hexdigest()


# --- here ---------------------------------------------------------------------------------------------------------


@dataclass
class Run:
    """What was seen of a run. began, ended: of the program; reports: of its tasks; spans, processor: of the parent."""

    began: float
    jobs: int
    images: int = 0
    ended: float = 0.0
    reports: list[Report] = field(default_factory=list)
    spans: list[Span] = field(default_factory=list)
    processor: float = 0.0

    @property
    def processors(self) -> float:
        """s of the processor of all processes."""
        last = {report.worker[0]: report.processor for report in self.reports}
        last[os.getpid()] = self.processor
        return sum(last.values())


def executor_in_threads(threads: int) -> Any:
    """An executor whose tasks are done in threads of this process."""
    from spadmnist.heap import keep_freed_memory
    from spadmnist.workers import Executor

    class Threads(Executor):
        apart = False
        threads = 1

        def __init__(self) -> None:
            self.threads = threads
            self._pool = ThreadPoolExecutor(threads, initializer=keep_freed_memory)

        def _submit(self, function: Callable[[Any], Any], task: Any) -> Future[Any]:
            return self._pool.submit(function, task)

        def _is_death(self, error: BaseException) -> bool:
            return False

        def close(self) -> None:
            self._pool.shutdown()

    return Threads()


def traced_executor(inner: Any, run: Run) -> Any:
    """The executor, whose tasks are reported."""

    class Traced(type(inner)):  # type: ignore[misc]
        def __init__(self) -> None:
            self.__dict__.update(inner.__dict__)

        def __enter__(self) -> Any:
            watch_parent(run)  # the verb has imported its libraries
            return super().__enter__()

        def start(self, module: str) -> None:
            with SPANS.span("start the workers"):
                super().start(module)

        def run(
            self, function: Callable[[Any], Any], make: Any, keys: Sequence[Any], done: Callable[[Any, Any], None]
        ) -> None:
            def reported(key: Any, answer: tuple[Any, Report]) -> None:
                run.reports.append(answer[1])
                done(key, answer[0])

            super().run(functools.partial(traced, function), make, keys, reported)

    return Traced()


def measure(arguments: Sequence[str], jobs: int, threads: bool, began: float) -> Run:
    """Run `spadmnist generate` with these arguments, and watch it. Raises SpadError as it does."""
    run = Run(began, jobs)
    with SPANS.span("start the program"):
        from spadmnist.cli import _options, cli
        from spadmnist.workers import executor, safe_path

    inner = executor_in_threads(jobs) if threads else executor(jobs)
    _options.executor = lambda asked: traced_executor(inner, run)  # type: ignore[assignment]
    paths = [str(HERE), *filter(None, [os.environ.get("PYTHONPATH")])]
    os.environ["PYTHONPATH"] = os.pathsep.join(paths)  # where workers find this module
    with safe_path(), SPANS.span("rest of the verb"):
        cli.main(["generate", *arguments], prog_name="spadmnist", standalone_mode=False)
    run.ended, run.processor = time.monotonic(), time.process_time()
    run.spans = SPANS.taken()
    inner.close()
    return run


def watch_parent(run: Run) -> None:
    """Wrap what the verb does in this process."""
    with SPANS.span("import the libraries"):
        from spadmnist import config, factory, shard_facts
        from spadmnist.experiment import Experiment
    wrap(config, "read", "read the config")
    wrap(Experiment, "load_images", "load the images")
    wrap(factory, "identity", "digest of the images")
    wrap(factory, "check_bytes", "golden shard")
    wrap(factory, "_warm", "load the kernels")
    wrap(factory, "make_shards", "make shards")
    wrap(factory, "finish", "finish")
    wrap(shard_facts, "statistics_of", "read the shards' statistics")
    real = factory.generate

    def generate(experiment: Any, splits: Mapping[str, Any], *rest: Any) -> Any:
        run.images = len(experiment.levels) * sum(experiment.wanted(images) for images in splits.values())
        with SPANS.span("plan"):
            return real(experiment, splits, *rest)

    factory.generate = generate


def floor(experiment: Any, images: Mapping[str, Any]) -> float:
    """s of the processor that numpy needs for as many exponentials as the run draws at all levels, the best of five."""
    import numpy as np

    total = 0.0
    rng = np.random.Generator(np.random.SFC64(1))
    for level in experiment.levels:
        for part in images.values():
            n, draws = experiment.wanted(part), 0.0
            some = np.unique(np.linspace(0, n - 1, 400).astype(int))
            photons = experiment.photons(level, np.ascontiguousarray(part.pixels[some]), part.white)
            rates, _ = experiment.sensor.rates(photons, experiment.conditions)
            draws = float(rates.sum()) * experiment.conditions.exposure / len(some)
            buffer, best = np.empty(max(1, int(draws))), np.inf
            for _ in range(5):
                before = time.thread_time()
                for _ in range(100):
                    rng.standard_exponential(out=buffer)
                best = min(best, time.thread_time() - before)
            total += best / 100 * n
    return total


def by_stage(run: Run) -> dict[str, tuple[float, float]]:
    """(wall, processor) s by stage of the tasks, all workers together."""
    found = dict.fromkeys(STAGES, (0.0, 0.0))
    for span in (span for report in run.reports for span in report.spans):
        wall, processor = found[span.name]
        found[span.name] = wall + span.own, processor + span.processor
    return found


def in_tasks(run: Run) -> list[tuple[float, float]]:
    """When each task began and ended."""
    return [(s.start, s.end) for report in run.reports for s in report.spans[-1:]]


def table(run: Run, least: float) -> str:
    """The figures as Markdown. least: `floor`."""
    wall, stages, tasks = run.ended - run.began, by_stage(run), in_tasks(run)
    starts = {report.worker[0]: report.startup for report in run.reports if report.worker[0] != os.getpid()}
    parent: dict[str, tuple[float, float]] = {}
    for span in run.spans:
        if span.name in STAGES:  # of tasks that were done in this process
            continue
        before = parent.get(span.name, (0.0, 0.0))
        parent[span.name] = before[0] + span.own, before[1] + span.processor
    first, last = min(t[0] for t in tasks) - run.began, max(t[1] for t in tasks) - run.began
    busy = sum(end - start for start, end in tasks)
    between = sum({r.worker[0]: r.processor for r in run.reports if r.worker[0] in starts}.values())
    inside = sum(s.processor for r in run.reports if r.worker[0] in starts for s in r.spans)
    rows = [("stage", "processor s", "wall s", "of the floor"), ("---",) * 4]

    def row(name: str, processor: float, seconds: float | None = None) -> None:
        took = "" if seconds is None else f"{seconds:.2f}"
        rows.append((name, f"{processor:.2f}", took, f"{processor / least:.2f}x"))

    for name, (seconds, processor) in stages.items():
        row(f"tasks: {name}", processor, seconds)
    row("workers: start", sum(starts.values()))
    row("workers: between the tasks, and threads that synchronise", max(0.0, between - inside - sum(starts.values())))
    for name, (seconds, processor) in parent.items():
        row(f"parent: {name}", processor, seconds)
    row("**all**", run.processors, wall)
    row("numpy's exponentials", least)
    lines = ["| " + " | ".join(cells) + " |" for cells in rows]
    lines += [
        "",
        f"- {run.images:,} images in {wall:.2f} s with {run.jobs} workers: {run.images / wall:,.0f} images/s",
        f"- the first task began after {first:.2f} s, the last one ended {wall - last:.2f} s before the end",
        f"- share of {run.jobs} x {wall:.2f} s without a task: {1 - busy / (run.jobs * wall):.0%}; "
        f"from the first task to the last: {1 - busy / (run.jobs * (last - first)):.0%}",
        f"- idle share of {run.jobs} cores (processor seconds of this run alone): "
        f"{1 - run.processors / (run.jobs * wall):.0%}",
    ]
    return "\n".join(lines) + "\n"


def draw(run: Run, path: Path) -> None:
    """The timeline: a row for the parent and one for each worker."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot
    from matplotlib.patches import Patch

    workers = sorted({report.worker for report in run.reports}, key=lambda who: str(who))
    figure, axes = pyplot.subplots(figsize=(12, 1.6 + 0.55 * (len(workers) + 1)), layout="constrained")
    shown = [span for span in run.spans if span.name not in STAGES]
    names = list(dict.fromkeys(span.name for span in sorted(shown, key=lambda one: one.start)))
    for span in sorted(shown, key=lambda one: one.start - one.end):  # the longest below
        colour = PHASES[names.index(span.name) % len(PHASES)]
        axes.broken_barh([(span.start - run.began, span.end - span.start)], (-0.4, 0.8), color=colour)
        if span.own > 0.04 * (run.ended - run.began) and span.name not in ("rest of the verb", "plan"):
            axes.text((span.start + span.end) / 2 - run.began, 0, span.name, ha="center", va="center", fontsize=6)
    for place, worker in enumerate(workers, 1):
        mine = [report for report in run.reports if report.worker == worker]
        if worker[0] != os.getpid():
            start = mine[0].began - run.began
            began = min(span.start for report in mine for span in report.spans) - run.began
            axes.broken_barh(
                [(start, began - start)], (place - 0.4, 0.8), facecolor="none", edgecolor="0.6", hatch="//"
            )
        for stage in reversed(STAGES):  # "other" is the task itself, and lies below
            bars = [(s.start - run.began, s.end - s.start) for r in mine for s in r.spans if s.name == stage]
            axes.broken_barh(bars, (place - 0.4, 0.8), color=STAGES[stage], zorder=1 if stage == "other" else 2)
            if stage == "write":
                continue
    axes.set_yticks(range(len(workers) + 1), ["parent", *(f"worker {n}" for n in range(1, len(workers) + 1))])
    axes.invert_yaxis()
    axes.set_xlim(0, run.ended - run.began)
    axes.set_xlabel("s since the program began")
    keys = [Patch(color=colour, label=stage) for stage, colour in STAGES.items()]
    keys += [Patch(facecolor="none", edgecolor="0.6", hatch="//", label="a worker starts")]
    axes.legend(handles=keys, ncols=7, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False, fontsize=8)
    figure.savefig(path, dpi=130)
    pyplot.close(figure)


def main(arguments: Sequence[str] | None = None) -> int:
    began = process_began()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("config", type=Path, nargs="?", default=HERE.parent / "configs" / "spad_mnist.yaml")
    parser.add_argument("--lux", default="2560 mlux", help="light level, or `all`")
    parser.add_argument("--limit", type=int, default=4000, help="images of each split")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--threads", action="store_true", help="threads of one process in place of processes")
    parser.add_argument("--images-dir", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=Path("build/profile"), help="folder of table and picture")
    asked = parser.parse_args(arguments)
    asked.output.mkdir(parents=True, exist_ok=True)
    root = asked.output / f"dataset-{os.getpid()}"  # removed at the end
    level = [] if asked.lux == "all" else ["--lux", asked.lux]
    where = [] if asked.images_dir is None else ["--images-dir", str(asked.images_dir)]
    what = [str(asked.config), "-o", str(root), "--limit", str(asked.limit), "--jobs", str(asked.jobs), *level, *where]
    try:
        run = measure(what, asked.jobs, asked.threads, began)
    finally:
        shutil.rmtree(root, ignore_errors=True)
    from spadmnist import config

    experiment = config.read(asked.config, lux=() if asked.lux == "all" else (asked.lux,), limit=asked.limit)
    text = table(run, floor(experiment, experiment.load_images(asked.images_dir)))
    draw(run, asked.output / "timeline.png")
    (asked.output / "timeline.md").write_text(text)
    print(text, end="")
    print(f"Look at {asked.output / 'timeline.png'}")
    return 0


if __name__ == "__main__":
    import timeline  # workers know it by this name

    sys.exit(timeline.main())
