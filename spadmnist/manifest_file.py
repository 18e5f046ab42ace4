"""The manifest of a dataset: sealed, written and read."""

from __future__ import annotations

import hashlib
import json
import os
import stat
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from . import disk, kinds, store
from . import manifest as manifests
from .disk import Files
from .errors import InputError
from .foreign import from_json, quoted, short
from .identity import FORMAT, held
from .shard_plan import Shard
from .sources import Source
from .store import Encoding

_LARGEST_MANIFEST = 1 << 30  # bytes
_LONGEST_SENTENCE = 600  # characters of one mistake in a manifest, which may quote endless names
MANIFEST = kinds.MANIFEST
CONFIG = "config.yaml"
STATE = ".spadmnist"


def canonical(value: Any) -> bytes:
    """JSON with sorted keys: the same bytes for the same value."""
    return (json.dumps(value, sort_keys=True, indent=1, ensure_ascii=True, allow_nan=False) + "\n").encode()


def seal(manifest: Mapping[str, Any]) -> bytes:
    """The manifest as bytes, with the digest of what the dataset is under `sha256`.

    Under `provenance` stands by what it was finished. It does not belong to what the dataset is, and has a digest of
    its own, `provenance_sha256`.
    """
    apart = ("sha256", "provenance", "provenance_sha256")
    body = {key: value for key, value in manifest.items() if key not in apart}
    sealed = {**body, "sha256": _digest(body)}
    if "provenance" in manifest:
        made_by = manifest["provenance"]
        sealed |= {"provenance": made_by, "provenance_sha256": _digest(made_by)}
    return canonical(sealed)


def _digest(value: Any) -> str:
    return hashlib.sha256(canonical(value)).hexdigest()


def read_manifest(root: Path | Source) -> tuple[dict[str, Any], bool]:
    """(manifest, is every byte of it as it was sealed?). Raises InputError where there is none to read."""
    path, mended = root / MANIFEST, ""
    if isinstance(root, Source):
        raw = _manifest_of(root)
    else:
        raw, mended = _manifest_in(root), f"; spadmnist verify {quoted(root)} --repair makes it again"
    try:
        manifest = from_json(raw)
        intact = isinstance(manifest, dict) and seal(manifest) == raw
    except ValueError as error:
        raise InputError(f"{path}: is damaged ({error}){mended}") from None
    if not isinstance(manifest, dict) or not str(manifest.get("format", "")).startswith("spadmnist-dataset/"):
        raise InputError(f"{path}: is not the manifest of a spadmnist dataset")
    if manifest["format"] != FORMAT:
        raise InputError(f"{path}: has format {manifest['format']}; this program reads {FORMAT}")
    if intact and (wrong := manifests.problems(manifest, str(path))):
        said = "; ".join(short(sentence, _LONGEST_SENTENCE) for sentence in wrong[:4])
        more = f" (and {len(wrong) - 4} more)" if len(wrong) > 4 else ""
        raise InputError(f"{said}{more}{mended}")
    if intact and isinstance(root, Source):
        root.hold(manifest["files"], manifest["sha256"])
    return manifest, intact


def _manifest_in(root: Path) -> bytes:
    path = root / MANIFEST
    if root.exists() and not root.is_dir():
        kind = kinds.at(root)
        what = f"{root} is {kind}, and no folder" if kind else f"{root} is no folder"
        more = f"; {kinds.of_data(root)}" if kinds.is_data(root) else ""
        raise InputError(f"{what}; a dataset is a folder (spadmnist generate makes one from a config){more}")
    try:
        return disk.read_file(path, _LARGEST_MANIFEST)
    except FileNotFoundError:
        if (root / STATE).is_dir():
            raise InputError(
                f"{root} is not finished: type the command that makes it again, and it goes on where it stopped"
            ) from None
        if not root.exists():
            raise InputError(f"{root}: there is no such folder") from None
        if kinds.at(root) == kinds.MEASUREMENT_KIND:
            raise InputError(
                f"{root} is a measurement and not a dataset: it has no {MANIFEST} to verify or to read; "
                f"spadmnist inspect {quoted(root)} looks at it"
            ) from None
        raise InputError(
            f"{root} is not a dataset: it has no {MANIFEST}, nor {kinds.MEASUREMENT}, which a measurement has; name a "
            "folder that has one of them"
        ) from None
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); spadmnist verify {quoted(root)} says more"
        ) from None


def _manifest_of(source: Source) -> bytes:
    try:
        return source.document(MANIFEST, _LARGEST_MANIFEST)
    except FileNotFoundError:
        raise InputError(
            f"{source}: there is no {MANIFEST}; give the address of a dataset's folder, in which it lies"
        ) from None


def intact_manifest(root: Path | Source) -> dict[str, Any]:
    """The manifest as it was sealed. Raises InputError where it is not."""
    manifest, intact = read_manifest(root)
    if not intact:
        mended = "" if isinstance(root, Source) else f"; spadmnist verify {quoted(root)} --repair makes it again"
        raise InputError(f"{root / MANIFEST}: was changed{mended}")
    return manifest


def check_there(root: Path, files: Files) -> None:
    """Raise InputError where a listed file is not there, is no file or has another size. No data are read."""
    mended = f"spadmnist verify {quoted(root)} names every such file, and with --repair it makes them again"
    for name, facts in files.items():
        try:
            found = os.lstat(root / name)
        except (FileNotFoundError, NotADirectoryError):
            raise InputError(f"{root / name}: this file is missing; {mended}") from None
        if not stat.S_ISREG(found.st_mode):
            raise InputError(f"{root / name}: this is not a file; {mended}")
        if found.st_size != facts["bytes"]:
            raise InputError(
                f"{root / name}: this file has {found.st_size} bytes, and it had {facts['bytes']}; {mended}"
            )


def encoding_in(manifest: Mapping[str, Any], root: Path | Source) -> Encoding:
    """How the shards of a dataset are written. Raises InputError where this program does not know it."""
    try:
        return store.encoding(manifest["config"]["output"]["format"], held(manifest)["encoding"])
    except InputError as error:
        raise InputError(f"{root / MANIFEST}: {error}") from None


def shards_in(manifest: Mapping[str, Any]) -> list[Shard]:
    """The shards that a manifest lists."""
    return [Shard(**x) for x in manifest["shards"]]
