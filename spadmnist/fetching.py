"""Bring a published dataset to this machine: it is known by its seal, whoever hands it out."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from . import dataset, disk, manifest_file, remote, sources, verify
from .errors import InputError, SpadError
from .manifest_file import MANIFEST
from .remote import Remote
from .sources import Local, Source

_AT_ONCE = 8  # files of a dataset that are asked for: most are small, and each takes a journey
_BETWEEN_LINES = 1.0  # s, of progress
_COMING = ".coming"  # files that are not whole yet, and a zip


def fetch(url: str | Path, sha256: str, to: str | Path, progress: Callable[[str], None] | None = None) -> Path:
    """Bring a dataset to a new folder, and compare every byte with its seal. Returns the folder.

    url: address of its folder, or of a zip of it (also a folder or a zip of this machine); sha256: its seal, which
    stands in its `manifest.json` under `sha256`; to: the folder, which appears when all is there. The same call again
    goes on with what had come; where the dataset is there already, it is read and compared. progress: called with a
    line about what is being done. Raises SpadError where the seal is another, where a file is not as it was sealed and
    where `to` holds something else.
    """
    to, say = Path(to), progress or (lambda line: None)
    if not re.fullmatch(r"[0-9a-f]{64}", sha256):
        raise SpadError(f"sha256: {sha256!r} is no seal; give the 64 digits under `sha256` in the dataset's {MANIFEST}")
    if os.path.lexists(to):
        return _there_already(to, sha256)
    with disk.whole_folder(to, 0, resumed=True) as part:
        coming = part / _COMING
        coming.mkdir(exist_ok=True)
        source = _source(str(url), coming, say)
        try:
            manifest = manifest_file.intact_manifest(source)
        except InputError:
            shutil.rmtree(coming)
            raise
        if manifest["sha256"] != sha256:
            shutil.rmtree(part)
            raise SpadError(
                f"{url}: its seal is {manifest['sha256']}, and {sha256} was asked for; it is another dataset, and "
                "nothing of it was kept"
            )
        try:
            _bring(source, part, manifest["files"], say)
        except InputError:
            shutil.rmtree(coming)  # a zip, too: another may lie there by then
            raise
        shutil.rmtree(coming)
        _remove_others(part, manifest["files"])
        (part / MANIFEST).write_bytes(manifest_file.seal(manifest))
    return to


def _there_already(to: Path, sha256: str) -> Path:
    other = SpadError(f"{to}: is there already, and is not this dataset as it was sealed; remove it, or name another")
    try:
        if manifest_file.intact_manifest(to)["sha256"] != sha256 or verify.verify(to):
            raise other
    except InputError:
        raise other from None
    return to


def _source(url: str, coming: Path, say: Callable[[str], None]) -> Source:
    """Where the dataset is read from; a zip that lies elsewhere is brought first."""
    found = dataset.at(url) if not url.lower().endswith(".zip") or not remote.is_url(url) else _zip(url, coming, say)
    if isinstance(found, Remote):
        found.ranges = False
    return Local(found) if isinstance(found, Path) else found


def _zip(url: str, coming: Path, say: Callable[[str], None]) -> Path | Source:
    """A zip, brought from where it lies. What had come of it before stays, where the server can go on."""
    above, _, name = url.rpartition("/")
    server, place, begun = Remote(above), coming / "dataset.zip", 0
    part = coming / "dataset.zip.part"
    try:
        if not place.exists():
            say(f"bringing {url}")
            begun = part.stat().st_size if part.exists() else 0
            with open(part, "ab") as file:
                for piece in server.whole(name, begun):
                    file.write(piece)
            os.replace(part, place)
    except FileNotFoundError:
        raise InputError(f"{url}: there is no such file; check the address") from None
    except InputError:
        if not begun:
            raise
        part.unlink()  # one that was changed, or a server without ranges: from the beginning
        return _zip(url, coming, say)
    try:
        return dataset.at(place)
    except InputError as error:
        place.unlink()
        raise InputError(str(error).replace(str(place), url)) from None


def _bring(source: Source, part: Path, files: Mapping[str, Mapping[str, Any]], say: Callable[[str], None]) -> None:
    """Copy the files, each of which is there when it is the one that was sealed."""
    total, done, said = sum(int(facts["bytes"]) for facts in files.values()), 0, time.monotonic()
    started = said
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        numbered = enumerate(sorted(files))
        jobs = [pool.submit(_bring_one, source, part, name, files[name], str(number)) for number, name in numbered]
        try:
            for job in jobs:
                done += job.result()
                now = time.monotonic()
                if now - said >= _BETWEEN_LINES:
                    said, left = now, (now - started) * (total - done) / max(done, 1)
                    say(f"{done / 1e6:,.1f} of {total / 1e6:,.1f} MB, {left:,.0f} s left")
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _bring_one(source: Source, part: Path, name: str, facts: Mapping[str, Any], number: str) -> int:
    place, coming = disk.inside(part, name), part / _COMING / number
    if not sources.is_as_listed(part, name, facts):
        digest, size = hashlib.sha256(), 0
        try:
            with open(coming, "wb") as file:
                for piece in _pieces(source, name):
                    digest.update(piece)
                    size += file.write(piece)
                    if size > facts["bytes"]:
                        break
            if size != facts["bytes"] or digest.hexdigest() != facts["sha256"]:
                raise InputError(
                    f"{source / name}: is not the file that was sealed ({size:,} bytes, {facts['bytes']:,} belong "
                    "there); tell who publishes it; what else has come is kept for the next try"
                )
            os.replace(coming, place)
        finally:
            coming.unlink(missing_ok=True)
    return int(facts["bytes"])


def _pieces(source: Source, name: str) -> Iterator[bytes]:
    try:
        yield from source.whole(name)
    except FileNotFoundError:
        raise InputError(f"{source / name}: this file of the dataset is missing there; tell who publishes it") from None


def _remove_others(part: Path, files: Mapping[str, Any]) -> None:
    """What an earlier try of another dataset has left."""
    for folder, folders, names in os.walk(part, topdown=False):
        for name in names:
            path = Path(folder, name)
            if path.relative_to(part).as_posix() not in files:
                path.unlink()
        for name in folders:
            path = Path(folder, name)
            if path.is_symlink():
                path.unlink()
            elif not os.listdir(path):
                path.rmdir()
