"""Workers: other Python processes, and what they are told by their environment."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from joblib import Parallel


def processors() -> int:
    """How many processors this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:
        return os.cpu_count() or 1


@contextlib.contextmanager
def workers(jobs: int, **options: Any) -> Iterator[Parallel]:
    """joblib's `Parallel` with these options, whose workers run no file of the current folder.

    They look for compiled kernels where this process does.
    """
    from joblib import Parallel

    from . import compiled

    # what libraries warn programmers of is nothing for users; the tracker that cleans up behind workers does so, too
    debugging = os.environ.get("SPADMNIST_DEBUG")
    silence = "ignore:resource_tracker:UserWarning" if debugging else "ignore"
    quiet = {"PYTHONWARNINGS": os.environ.get("PYTHONWARNINGS", silence)}
    with safe_path(), _environment({**quiet, **compiled.for_workers()}):  # noqa: SIM117
        with Parallel(n_jobs=jobs, **options) as parallel:
            yield parallel


@contextlib.contextmanager
def safe_path() -> Iterator[None]:
    """Keep the current folder off the path of every Python process that is started in here.

    `python -m` and `python -c` would put it there, before all libraries, and an empty entry of PYTHONPATH means it. An
    entry that names a folder is asked for, and stays.
    """
    entries = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    with _environment({"PYTHONSAFEPATH": "1", "PYTHONPATH": os.pathsep.join(filter(None, entries))}):
        yield


@contextlib.contextmanager
def _environment(values: Mapping[str, str]) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
