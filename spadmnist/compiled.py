"""Where compiled kernels are kept, so that a machine compiles them once.

Their folder lies in the first of these places where that is possible: `$NUMBA_CACHE_DIR`, the user's cache folder, a
folder for temporary files. What is in it is run, so it must be its owner's alone. Its name holds a digest of the
package's sources: numba looks for changes in a kernel's own file, and not in those of the kernels that it calls.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any, cast

from . import system


@contextlib.contextmanager
def _without(module: str) -> Iterator[None]:
    """Let an optional import of a module fail in here, unless it was imported before."""
    absent = module not in sys.modules
    if absent:
        sys.modules[module] = cast(Any, None)
    try:
        yield
    finally:
        if absent:
            del sys.modules[module]


# numba asks as it is imported whether there is a BLAS, which takes 0.3 s of every process, and which no kernel here
# calls. What calls it is compiled as before: numba then asks again.
with _without("scipy.linalg"):
    import numba
    import numba.np.arraymath
    from numba import types
    from numba.core import event
    from numba.extending import intrinsic
    from numba.misc.appdirs import user_cache_dir
if hasattr(numba.np.arraymath, "_HAVE_BLAS"):  # a name of numba's own, which another one may not have
    numba.np.arraymath._HAVE_BLAS = True

__all__ = ["compiling", "folder", "for_workers", "intrinsic", "kernel", "types"]

WORKERS = "SPADMNIST_KERNELS"  # tells workers the place that their parent has found; empty: none

_UNUSED = 30 * 86400.0  # seconds after which the folder of other sources, or of another numba, is removed
_PROBE = 4096  # bytes that a place must take
_SILENCE = 1.5  # seconds of compiling that need no word


@lru_cache(maxsize=1)
def digest_of_sources() -> str:
    """The SHA-256 of all Python files of the package, with their names."""
    package = Path(__file__).parent
    digest = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        text = path.read_bytes()
        digest.update(f"{path.relative_to(package)} {len(text)}\n".encode() + text)
    return digest.hexdigest()


@lru_cache(maxsize=1)
def folder() -> Path | None:
    """The folder of the compiled kernels, which is there and can be written, or None where there is no place for it."""
    version = hashlib.sha256(f"{digest_of_sources()} {numba.__version__}".encode()).hexdigest()
    told = os.environ.get(WORKERS)
    places = _places() if told is None else filter(None, [told])
    for place in map(Path, places):
        found = place / f"{_family()}{version[:16]}"
        if _usable(found):
            return found
    if told is None:
        logging.getLogger(__name__).warning(
            "Compiled code cannot be kept, and every run compiles anew, up to a minute: neither $NUMBA_CACHE_DIR nor "
            "the user's cache folder nor a temporary one takes a folder that is yours alone; name one that does."
        )
    return None


def for_workers() -> dict[str, str]:
    """The environment variable by which workers find the place that this process has found."""
    found = folder()
    return {WORKERS: "" if found is None else str(found.parent)}


def kernel(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """numba's `njit` with these options, which keeps what it compiles in `folder`."""

    def compiled(function: Callable[..., Any]) -> Any:
        place, settings = folder(), cast(Any, numba.config)
        before = settings.CACHE_DIR  # where a user's own functions go
        settings.CACHE_DIR = str(place or "")  # numba looks at it in here, once for each function
        try:
            return numba.njit(cache=place is not None, **options)(function)
        finally:
            settings.CACHE_DIR = before

    return compiled


@contextlib.contextmanager
def compiling(say: Callable[[], None]) -> Iterator[None]:
    """Call `say` once, where kernels that will be kept are compiled in here and that takes longer than a moment."""
    listener = _Compiling(say)
    event.register("numba:compile", listener)
    try:
        yield
    finally:
        event.unregister("numba:compile", listener)
        listener.timer.cancel()


class _Compiling(event.Listener):
    """Listens to numba, which reports what it compiles, and nothing where it loads what was compiled before."""

    def __init__(self, say: Callable[[], None]):
        self.depth, self.timer = 0, threading.Timer(_SILENCE, lambda: say() if self.depth else None)

    def on_start(self, event: event.Event) -> None:
        if event.data["dispatcher"]._cache.cache_path is not None:
            self.depth += 1
            if not self.timer.ident:
                self.timer.start()

    def on_end(self, event: event.Event) -> None:
        if event.data["dispatcher"]._cache.cache_path is not None:
            self.depth -= 1


def _family() -> str:
    return f"spadmnist-kernels-{system.user()}-"


def _places() -> Iterator[str | Path]:
    asked = os.environ.get("NUMBA_CACHE_DIR")
    if asked:
        yield Path(asked).absolute()
    own = Path(user_cache_dir("spadmnist"))
    if own.is_absolute() and own.parents[1].is_dir():  # a home that is not there is not made
        yield own
    # those of `tempfile`, without the current folder, where nobody would look for it
    yield from filter(os.path.isabs, (os.environ.get("TMPDIR", ""), "/tmp", "/var/tmp"))


def _usable(found: Path) -> bool:
    """Is the folder there, or can it be made, this user's and closed to others, and can it be written?"""
    try:
        found.parent.mkdir(parents=True, exist_ok=True)
        new = not os.path.lexists(found)
        with contextlib.suppress(FileExistsError):
            found.mkdir(mode=0o700)
        if not system.is_private(found.lstat()):
            return False
        with tempfile.TemporaryFile(dir=found) as probe:
            probe.write(bytes(_PROBE))
        os.utime(found)  # it is in use
        if new:
            _remove_unused(found.parent)
    except OSError:
        return False
    return True


def _remove_unused(place: Path) -> None:
    """Remove this user's folders of other sources that nobody has used for long. A link is left as it is."""
    for other in place.glob(f"{_family()}*"):
        with contextlib.suppress(OSError):
            facts = other.lstat()
            if system.is_own(facts) and facts.st_mtime < time.time() - _UNUSED:
                shutil.rmtree(other)
