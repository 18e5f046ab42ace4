"""The user's own code, on which the simulations depend as well as on the sources of this program."""

from __future__ import annotations

import functools
import os
import sys
from collections.abc import Collection, Iterator
from pathlib import Path

from .. import imported, plugins


def digested(own: Collection[type]) -> list[bytes] | None:
    """The user's own modules and plug-in files, as bytes, in a fixed order; none where there is no such code.

    These are all modules that were imported from outside the standard library and the installed packages, and all
    modules of an installed package that has such a class: a class may call what stands in another file.

    Args:
        own: the user's classes that stand in no plug-in file.
    Returns:
        None where no file holds what a class does: that of a notebook; one that a function made, which depends on what
        the function was given; one whose file, or another one of the user's, has changed since it was imported.
    """
    loaded = plugins.loaded_files()
    if not own and not loaded:
        return []
    if any(cls.__module__ == "__main__" or "<locals>" in cls.__qualname__ for cls in own):
        return None
    out = [text.encode() for _, text in sorted(loaded.items())]
    for name, file in _modules({cls.__module__.partition(".")[0] for cls in own}):
        try:
            facts = os.stat(file)
            if facts.st_mtime > plugins.IMPORTED:
                return None
            out += [name.encode(), _content(file, facts.st_mtime_ns)]
        except OSError:
            return None
    return out


def _modules(packages: Collection[str]) -> Iterator[tuple[str, str]]:
    """(name, file) of each of the user's modules, and of each module of some packages."""
    for name, module in sorted(sys.modules.items()):
        # what is no module may stand there, and a lazy one is not to be loaded for this
        file, package = getattr(module, "__dict__", {}).get("__file__"), name.partition(".")[0]
        if not isinstance(file, str) or name == "__main__" or package == plugins.__package__:
            continue
        if package in packages or not (file.startswith(imported.installed()) or plugins.is_module_of_file(name)):
            yield name, file


@functools.lru_cache(maxsize=1024)
def _content(file: str, changed: int) -> bytes:
    """The content of a file; it is read again where its time of change, in ns, is another one."""
    return Path(file).read_bytes()
