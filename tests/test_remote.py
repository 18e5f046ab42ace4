"""Datasets that lie elsewhere: the values of the folder, few requests, and a sentence for whatever is wrong there."""

from __future__ import annotations

import json
import os
import pickle
import re
import shutil
import stat
import struct
import sys
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from commands import run
from rangeserver import Site, serving
from test_factory import assert_sentence, make, write_config

import spadmnist
from spadmnist import dataset, remote, verify, zipped
from spadmnist.errors import SpadError
from spadmnist.remote import Blocks, Remote
from spadmnist.report import places_of

pytest.importorskip("obstore")
LEVEL = "2560 mlux"


@pytest.fixture(scope="module")
def homes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """For each format a folder with a dataset `out`. They stay as they are."""
    found = {}
    for format in ("zarr", "hdf5"):
        home = found[format] = tmp_path_factory.mktemp(f"remote-{format}")
        make(write_config(home / "small.yaml", format, (LEVEL,), ("counts", "qis_counts"), 70, 6), home / "out")
    return found


@pytest.fixture(params=["zarr", "hdf5"])
def home(request: pytest.FixtureRequest, homes: dict[str, Path]) -> Path:
    return homes[request.param]


@pytest.fixture
def out(homes: dict[str, Path], tmp_path: Path) -> Path:
    """A copy, to be damaged."""
    return Path(shutil.copytree(homes["zarr"] / "out", tmp_path / "site" / "out"))


@pytest.fixture
def site(out: Path) -> Iterator[Site]:
    with serving(out.parent) as found:
        yield found


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("SPADMNIST_CACHE", str(tmp_path / "cache"))
    for name in [name for name in os.environ if name.startswith("AWS_") or name.lower().endswith("_proxy")]:
        monkeypatch.delenv(name)
    return tmp_path / "cache" / "remote"


def seal_of(root: Path) -> str:
    return str(json.loads((root / "manifest.json").read_text())["sha256"])


def zip_of(root: Path, place: Path, method: int, below: str = "out/") -> Path:
    with zipfile.ZipFile(place, "w", method) as file:
        for path in sorted(path for path in root.rglob("*") if path.is_file()):
            file.write(path, below + path.relative_to(root).as_posix())
    return place


def assert_equal(found: spadmnist.Part, wanted: spadmnist.Part) -> None:
    """Every kind of data of a part, bit for bit."""
    assert found.tr[:].times.tobytes() == wanted.tr[:].times.tobytes()
    assert np.array_equal(found.tr[3:40].offsets, wanted.tr[3:40].offsets)
    for name in ("str", "qis", "images"):
        assert np.array_equal(getattr(found, name)[:], getattr(wanted, name)[:])
    for name in wanted.reconstruction:
        assert np.array_equal(found.reconstruction[name].normalised[:], wanted.reconstruction[name].normalised[:])
    assert found.labels is not None and wanted.labels is not None and np.array_equal(found.labels, wanted.labels)


def fails(*words: str) -> pytest.RaisesExc[SpadError]:
    """One sentence in which the words stand."""
    return pytest.RaisesExc(SpadError, match=".*".join(map(re.escape, words)), check=lambda e: "\n" not in str(e))


# --- values -------------------------------------------------------------------------------------------------------


def test_an_address_gives_the_values_of_the_folder(home: Path) -> None:
    with serving(home) as site:
        opened = spadmnist.open(f"{site.url}/out")
        assert_equal(opened[LEVEL, "train"], spadmnist.open(home / "out")[LEVEL, "train"])
        assert_equal(pickle.loads(pickle.dumps(opened[LEVEL, "test"])), spadmnist.open(home / "out")[LEVEL, "test"])


@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
@pytest.mark.parametrize("below", ["", "a folder/"])
def test_a_zip_gives_the_values_of_the_folder(home: Path, tmp_path: Path, method: int, below: str) -> None:
    place = zip_of(home / "out", tmp_path / "out.zip", method, below)
    part = spadmnist.open(place)[LEVEL, "train"]
    assert_equal(pickle.loads(pickle.dumps(part)), spadmnist.open(home / "out")[LEVEL, "train"])
    found = verify.verify(dataset.at(place))
    assert not found and found.bytes == sum(path.stat().st_size for path in (home / "out").rglob("*") if path.is_file())


def test_another_image_of_a_shard_takes_no_more_than_one_request(
    homes: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Blocks of 1 kB stand for files of many blocks: an image lies in blocks that were not read before."""
    monkeypatch.setattr(remote, "BLOCK", 1 << 10)
    home = homes["zarr"]
    wanted = spadmnist.open(home / "out")[LEVEL, "train"].reconstruction["counts"]
    with serving(home) as site:
        source = dataset.at(f"{site.url}/out")
        assert isinstance(source, Remote)
        images = dataset.stored(source)[LEVEL, "train"].reconstruction["counts"]
        assert np.array_equal(images[0], wanted[0])
        asked, sent = len(site.asked), site.sent
        assert np.array_equal(images[40], wanted[40])  # 32 images are a chunk, so of the second one
        assert len(site.asked) == asked + 1 and 0 < site.sent - sent <= 4 << 10
        assert np.array_equal(images[41], wanted[41]) and len(site.asked) == asked + 1
        assert (source.requests, source.bytes) == (len(site.asked), site.sent)
        size = sum(path.stat().st_size for path in (home / "out").rglob("*") if path.is_file())
        assert site.sent < size / 2


def test_a_second_opening_reads_from_the_cache(home: Path, cache: Path) -> None:
    with serving(home) as site:
        first = spadmnist.open(f"{site.url}/out")[LEVEL, "train"].tr[:]
        asked = len(site.asked)
        again = spadmnist.open(f"{site.url}/out")[LEVEL, "train"].tr[:]
        assert len(site.asked) == asked + 1  # the manifest, by which the seal is known
        assert first.times.tobytes() == again.times.tobytes()
    assert stat.S_IMODE(cache.stat().st_mode) == 0o700
    assert [folder.name for folder in cache.iterdir()] == [seal_of(home / "out")]
    assert all(not stat.S_IMODE(file.stat().st_mode) & 0o077 for file in cache.rglob("*"))


def test_a_damaged_block_is_asked_for_again(homes: dict[str, Path], cache: Path) -> None:
    wanted = spadmnist.open(homes["zarr"] / "out")[LEVEL, "train"].tr[:]
    with serving(homes["zarr"]) as site:
        spadmnist.open(f"{site.url}/out")[LEVEL, "train"].tr[:]
        for file in (file for file in cache.rglob("*") if file.is_file()):
            data = bytearray(file.read_bytes())
            data[len(data) // 2] ^= 1
            file.write_bytes(data)
        found = spadmnist.open(f"{site.url}/out")[LEVEL, "train"].tr[:]
    assert found.times.tobytes() == wanted.times.tobytes()


def test_blocks_of_another_server_are_not_taken(site: Site, out: Path, tmp_path: Path) -> None:
    """A server with the manifest of an honest one, and other bytes, must not leave them for its readers."""
    other = Path(shutil.copytree(out, tmp_path / "other" / "out"))
    wanted = spadmnist.open(out)[LEVEL, "train"].images[:]
    for file in (other / "data" / "images").rglob("*.zip"):
        file.write_bytes(bytes(file.stat().st_size))
    with serving(other.parent) as bad, pytest.raises(SpadError):
        _ = spadmnist.open(f"{bad.url}/out")[LEVEL, "train"].images[:]
    assert np.array_equal(spadmnist.open(f"{site.url}/out")[LEVEL, "train"].images[:], wanted)


def test_the_cache_stays_within_its_bound(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(remote, "_BETWEEN_TRIMS", 4000)
    blocks = Blocks(tmp_path / "kept", 20_000)
    for number in range(100):
        blocks.put(f"seal/{number}", bytes([number]) * 1000)
        os.utime(tmp_path / "kept" / "seal" / str(number), ns=(number, number))
    kept = list((tmp_path / "kept").rglob("*"))
    assert len(kept) > 10 and sum(path.stat().st_size for path in kept if path.is_file()) <= 21_000
    assert blocks.get("seal/99") == bytes([99]) * 1000 and blocks.get("seal/0") is None


@pytest.mark.parametrize("obstacle", ["file", "link", "open to others"])
def test_without_a_cache_reading_goes_on(site: Site, out: Path, cache: Path, obstacle: str, tmp_path: Path) -> None:
    cache.parent.mkdir()
    if obstacle == "file":
        cache.write_text("")
    elif obstacle == "link":
        (tmp_path / "elsewhere").mkdir(mode=0o700)
        cache.symlink_to(tmp_path / "elsewhere")
    else:
        cache.mkdir()
        cache.chmod(0o777)
    found = spadmnist.open(f"{site.url}/out")[LEVEL, "train"]
    assert np.array_equal(found.qis[5], spadmnist.open(out)[LEVEL, "train"].qis[5])
    assert not list(tmp_path.glob("elsewhere/*")) and (obstacle == "file" or not list(cache.iterdir()))


def test_a_folder_of_this_machine_needs_no_obstore(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "obstore", None)
    assert len(spadmnist.open(out)[LEVEL, "train"].tr[0])
    with fails("http://localhost/out", "pip install 'spadmnist[remote]'"):
        spadmnist.open("http://localhost/out")


def test_arrays_of_dask_and_xarray_hold_the_same(site: Site, out: Path) -> None:
    pytest.importorskip("dask.array")
    pytest.importorskip("xarray")
    wanted = spadmnist.open(out)[LEVEL, "train"]
    opened = spadmnist.open(f"{site.url}/out")
    held = opened.to_xarray(LEVEL, "train")
    asked = len(site.asked)
    assert held["qis"][69].shape == (100, 8, 8) and len(site.asked) == asked  # nothing is read before it is computed
    assert float(held["lux"]) == 2.56 and held["label"].dims == ("image",)
    assert np.array_equal(held["label"].values, wanted.labels) and held["counts"].attrs["normalisation"] > 0
    for name in ("original", "qis", "str", "counts", "qis_counts"):
        field = {"original": wanted.images, "qis": wanted.qis, "str": wanted.str, **wanted.reconstruction}[name]
        assert np.array_equal(held[name].values, field[:]), name
    assert np.array_equal(opened[LEVEL, "train"].to_dask("counts")[33].compute(), wanted.reconstruction["counts"][33])
    with fails("'tr' cannot be one array", "images, qis, str"):
        wanted.to_dask("tr")


# --- verify -------------------------------------------------------------------------------------------------------


def test_verify_of_an_address_reads_every_byte(site: Site, out: Path) -> None:
    done = run("verify", f"{site.url}/out", "--json")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    size = sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
    assert found["intact"] and found["bytes"] == size and site.sent >= size
    path = sorted(out.rglob("*.zip"))[0]
    flipped = bytearray(path.read_bytes())
    flipped[0] ^= 1
    path.write_bytes(flipped)
    lost = out / "config.yaml"
    lost.unlink()
    damage = verify.verify(dataset.at(f"{site.url}/out"))
    assert damage.changed == (path.relative_to(out).as_posix(),) and damage.missing == ("config.yaml",)


def test_an_address_is_not_repaired(site: Site) -> None:
    done = run("verify", f"{site.url}/out", "--repair")
    assert_sentence(done, "--repair", "is no folder of this machine")
    assert not site.asked


# --- what is wrong there ------------------------------------------------------------------------------------------


def cut(site: Site, out: Path) -> None:
    for path in out.rglob("*.zip"):
        os.truncate(path, path.stat().st_size // 2)


def grown(site: Site, out: Path) -> None:
    for path in out.rglob("*.zip"):
        path.write_bytes(path.read_bytes() + b"more")


def changed(site: Site, out: Path) -> None:
    for path in out.rglob("*.zip"):
        path.write_bytes(bytes(path.stat().st_size))


def gone(site: Site, out: Path) -> None:
    shutil.rmtree(out / "data")


def without_ranges(site: Site, out: Path) -> None:
    site.ranges = False


def redirected(site: Site, out: Path) -> None:
    site.odd = lambda path: (302, {"Location": "file:///etc/passwd"}, b"") if "data" in path else None


def refusing(site: Site, out: Path) -> None:
    site.odd = lambda path: (403, {}, b"") if "data" in path else None


def broken(site: Site, out: Path) -> None:
    site.odd = lambda path: (500, {}, b"") if "data" in path else None


WRONG: list[tuple[Callable[[Site, Path], None], str]] = [
    (cut, "bytes, and it had"),
    (grown, "bytes, and it had"),
    (changed, "damaged"),
    (gone, "missing"),
    (without_ranges, "does not send parts of files (HTTP ranges); bring the dataset with spadmnist.fetch("),
    (redirected, "not http(s), which is not followed"),
    (refusing, "refuses access"),
    (broken, "status 500"),
]


@pytest.mark.parametrize(("wrong", "words"), WRONG, ids=[wrong.__name__ for wrong, _ in WRONG])
def test_what_is_wrong_on_a_server_is_one_sentence(
    site: Site, out: Path, wrong: Callable[[Site, Path], None], words: str
) -> None:
    wrong(site, out)
    with fails(site.url, words):
        _ = spadmnist.open(f"{site.url}/out")[LEVEL, "train"].images[0]


@pytest.mark.slow
def test_no_manifest_and_no_host_end_with_status_2(site: Site) -> None:
    for address, words in (
        (f"{site.url}/nothing", "there is no manifest.json"),
        ("http://nothing.invalid/out", "nothing.invalid cannot be reached"),
        ("ftp://example.org/out", "ftp:// is not read"),
        (f"{site.url}/out?key=1", "without ?"),
    ):
        assert_sentence(run("verify", address), words)


def test_a_password_in_an_address_is_not_shown() -> None:
    with fails("user name") as found:
        spadmnist.open("https://me:secret@example.org/out")
    assert "secret" not in str(found.value)


def test_a_bucket_without_credentials_is_one_sentence(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", site.url)
    site.odd = lambda path: (403, {}, b"")
    with fails("s3://bucket/out/manifest.json", "set AWS_ACCESS_KEY_ID"):
        spadmnist.open("s3://bucket/out")


def test_a_bucket_that_is_open_to_all_is_read(site: Site, out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The endpoint of S3 with the bucket in the path is a server of files, as far as reading goes."""
    monkeypatch.setenv("AWS_ENDPOINT_URL", site.url)
    (site.folder / "bucket").symlink_to(site.folder)
    found = spadmnist.open("s3://bucket/out")[LEVEL, "train"]
    assert_equal(found, spadmnist.open(out)[LEVEL, "train"])


def test_after_a_fork_one_sentence_and_no_waiting(site: Site) -> None:
    part = spadmnist.open(f"{site.url}/out")[LEVEL, "train"]
    reader, writer = os.pipe()
    child = os.fork()
    if not child:
        try:
            _ = part.images[0]
        except BaseException as error:
            os.write(writer, str(error).encode())
        os._exit(0)
    os.waitpid(child, 0)
    assert b"multiprocessing_context='spawn'" in os.read(reader, 1000)


# --- zips ---------------------------------------------------------------------------------------------------------


def test_a_zip_that_is_no_dataset_is_one_sentence(tmp_path: Path) -> None:
    place = tmp_path / "a.zip"
    with zipfile.ZipFile(place, "w") as file:
        file.writestr("readme.txt", "nothing")
    for content, words in (
        (place.read_bytes(), "it has no manifest.json"),
        (b"PK\x03\x04no", "cannot be read as a zip"),
    ):
        place.write_bytes(content)
        assert_sentence(run("verify", place), "a.zip", words)


def test_a_member_that_inflates_without_end_is_not_inflated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def inflated(*_: object) -> bytes:
        raise AssertionError("it was inflated")

    place = tmp_path / "bomb.zip"
    with zipfile.ZipFile(place, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("out/manifest.json", b" " * (16 << 20))
    monkeypatch.setattr(zipped.Zip, "_inflate", inflated)
    with fails("bomb.zip", "manifest.json inflates", "at most 200 times"):
        spadmnist.open(place)


def lies_about_its_size(data: bytearray, entry: int) -> None:
    data[entry + 24 : entry + 28] = struct.pack("<I", struct.unpack("<I", data[entry + 24 : entry + 28])[0] - 1)


def lies_about_its_place(data: bytearray, entry: int) -> None:
    data[entry + 42 : entry + 46] = struct.pack("<I", 7)


def is_encrypted(data: bytearray, entry: int) -> None:
    data[entry + 8] |= 1


def is_compressed_otherwise(data: bytearray, entry: int) -> None:
    data[entry + 10 : entry + 12] = struct.pack("<H", zipfile.ZIP_LZMA)


@pytest.mark.parametrize(
    "damage",
    [lies_about_its_size, lies_about_its_place, is_encrypted, is_compressed_otherwise],
    ids=lambda d: d.__name__,
)
@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_a_member_that_is_not_as_it_is_listed_is_refused(
    out: Path, tmp_path: Path, damage: Callable[[bytearray, int], None], method: int
) -> None:
    """The list of a zip, at its end, is damaged where it speaks of the manifest."""
    place = zip_of(out, tmp_path / "out.zip", method)
    data = bytearray(place.read_bytes())
    damage(data, data.rindex(b"out/manifest.json") - 46)
    place.write_bytes(data)
    with fails("out.zip", ""):
        spadmnist.open(place)


def test_verify_names_a_member_that_was_changed(out: Path, tmp_path: Path) -> None:
    (out / "config.yaml").write_text("seed: 2\n")
    (out / "more").write_text("")
    damage = verify.verify(dataset.at(zip_of(out, tmp_path / "out.zip", zipfile.ZIP_DEFLATED)))
    assert (damage.changed, damage.missing, damage.extra) == (("config.yaml",), (), ("more",))


# --- fetch --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ranges", [True, False])
@pytest.mark.parametrize("kind", ["folder", "zip"])
def test_fetch_brings_what_was_sealed(site: Site, out: Path, tmp_path: Path, kind: str, ranges: bool) -> None:
    zip_of(out, site.folder / "out.zip", zipfile.ZIP_DEFLATED)
    site.ranges = ranges
    place = spadmnist.fetch(f"{site.url}/{'out' if kind == 'folder' else 'out.zip'}", seal_of(out), tmp_path / "got")
    assert place == tmp_path / "got" and not verify.verify(place)
    assert {p.relative_to(place) for p in place.rglob("*")} == {p.relative_to(out) for p in out.rglob("*")}
    asked = len(site.asked)
    assert spadmnist.fetch(f"{site.url}/out", seal_of(out), place) == place and len(site.asked) == asked
    assert not list(tmp_path.glob(".got*"))


@pytest.mark.parametrize("kind", ["out", "out.zip"])
def test_another_seal_leaves_nothing(site: Site, out: Path, tmp_path: Path, kind: str) -> None:
    zip_of(out, site.folder / "out.zip", zipfile.ZIP_STORED)
    with fails(site.url, "its seal is", seal_of(out), "0" * 64):
        spadmnist.fetch(f"{site.url}/{kind}", "0" * 64, tmp_path / "got")
    assert not list(tmp_path.glob("*got*"))
    with fails("is no seal"):
        spadmnist.fetch(f"{site.url}/{kind}", "0" * 63, tmp_path / "got")


def test_fetch_goes_on_where_it_stopped(site: Site, out: Path, tmp_path: Path) -> None:
    """The last file is refused, then given: what had come does not come again."""
    last = max(path.relative_to(out).as_posix() for path in out.rglob("*") if path.suffix == ".zip")
    site.odd = lambda path: (403, {}, b"") if path.endswith(last) else None
    with fails("refuses access"):
        spadmnist.fetch(f"{site.url}/out", seal_of(out), tmp_path / "got")
    assert not (tmp_path / "got").exists() and not (tmp_path / ".got.part" / "manifest.json").exists()
    files, site.odd = len(site.asked), lambda path: None
    assert not verify.verify(spadmnist.fetch(f"{site.url}/out", seal_of(out), tmp_path / "got"))
    assert {path for path, _ in site.asked[files:]} == {"out/manifest.json", f"out/{last}"}


def test_a_zip_goes_on_where_it_stopped(site: Site, out: Path, tmp_path: Path) -> None:
    data = zip_of(out, site.folder / "out.zip", zipfile.ZIP_STORED).read_bytes()
    begun = tmp_path / ".got.part" / ".coming" / "dataset.zip.part"
    begun.parent.mkdir(parents=True)
    begun.write_bytes(data[:5000])
    spadmnist.fetch(f"{site.url}/out.zip", seal_of(out), tmp_path / "got")
    assert site.asked == [("out.zip", "bytes=5000-")] and not verify.verify(tmp_path / "got")


@pytest.mark.parametrize(
    ("wrong", "words"), [(changed, "is not the file that was sealed"), (cut, ""), (gone, "missing")]
)
def test_what_is_not_as_it_was_sealed_does_not_come(
    site: Site, out: Path, tmp_path: Path, wrong: Callable[[Site, Path], None], words: str
) -> None:
    wrong(site, out)
    with fails(site.url, words):
        spadmnist.fetch(f"{site.url}/out", seal_of(out), tmp_path / "got")
    assert not (tmp_path / "got").exists() and not (tmp_path / ".got.part" / "manifest.json").exists()


def test_fetch_leaves_what_is_there_alone(site: Site, out: Path, tmp_path: Path) -> None:
    (tmp_path / "got").mkdir()
    (tmp_path / "got" / "mine").write_text("mine")
    with fails("is there already, and is not this dataset"):
        spadmnist.fetch(f"{site.url}/out", seal_of(out), tmp_path / "got")
    assert (tmp_path / "got" / "mine").read_text() == "mine" and not site.asked


@pytest.mark.slow
def test_inspect_shows_what_a_zip_and_an_address_hold(site: Site, out: Path, tmp_path: Path) -> None:
    made = shutil.make_archive(str(tmp_path / "packed"), "zip", out)
    here = run("inspect", str(out))
    assert here.returncode == 0 and here.stdout
    for place in (made, f"{site.url}/out"):
        found = run("inspect", place, "--plot", str(tmp_path / "sheet.png"))
        assert found.returncode == 0 and found.stdout.startswith(here.stdout), found.stderr
        assert (tmp_path / "sheet.png").stat().st_size > 0


def test_positions_of_pixels_are_read_from_a_zip(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "places.csv").write_text("x,y\n0,0\n23.0,-11.5\n")
    (tmp_path / "out" / "manifest.json").write_text("{}")
    packed = dataset.at(shutil.make_archive(str(tmp_path / "packed"), "zip", tmp_path / "out"))
    manifest = {"config": {"sensor": {"layout": {"positions": "places.csv"}}}}
    assert np.array_equal(places_of(manifest, packed), [[0, 0], [23e-6, -11.5e-6]])
    manifest["config"]["sensor"]["layout"].clear()
    assert places_of(manifest, packed) is None
