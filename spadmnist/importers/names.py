"""Names of captures and of their files."""

from __future__ import annotations

import re
from collections.abc import Sequence


def safe_name(text: str, taken: Sequence[str] = ()) -> str:
    """A name for a capture and its file, unlike those that are taken, whatever the file system thinks of case."""
    stem = name = re.sub(r"[^A-Za-z0-9.+-]+", "_", text).strip("_.")[:80] or "capture"
    n = 1
    while name.lower() in {one.lower() for one in taken}:
        n += 1
        name = f"{stem}-{n}"
    return name
