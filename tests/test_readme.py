"""What the README says works: its commands, its Python, the paths that its MATLAB reads."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import commands
import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", README, re.M | re.S)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the configs and the dataset `out`, as a reader has them after the first commands."""
    folder = tmp_path_factory.mktemp("readme")
    (folder / "configs").symlink_to(ROOT / "configs")
    for command in ("spadmnist generate configs/quick.yaml -o out", "spadmnist inspect out --plot out.png"):
        assert f"\n{command}\n" in README
        run(command, folder)
    assert (folder / "out.png").stat().st_size > 10_000
    return folder


def run(command: str, folder: Path) -> str:
    done = commands.run(*command.split()[1:], cwd=folder)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_every_verb_and_option_of_the_readme_is_there() -> None:
    lines = re.findall(r"^(spadmnist [a-z].*?)(?:\s+#.*)?$", "\n".join(blocks("")), re.M)
    assert len(lines) >= 5
    for command in lines:
        words = command.split()
        known = commands.run(words[1], "--help")
        assert known.returncode == 0, command
        for option in (w for w in words[2:] if w.startswith("-")):
            assert option in known.stdout, command
        for file in (w for w in words[2:] if w.endswith(".yaml")):
            assert (ROOT / file).is_file(), command


def test_the_python_of_the_readme_runs(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(place)
    names: dict[str, object] = {}
    ran = 0
    for block in blocks("python"):
        if "stage=" in block or ("torch" in block and importlib.util.find_spec("torch") is None):
            continue
        exec(compile(block, "README.md", "exec"), names)
        ran += 1
    assert ran >= 2
    part, shard = names["part"], names["shard"]
    assert len(part) == 400 and shard["counts"].shape == (400, 28, 28)  # type: ignore[arg-type,index]


@pytest.mark.skipif(importlib.util.find_spec("torch") is None, reason="PyTorch is not installed")
def test_the_loader_of_the_readme_loads(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import spadmnist

    monkeypatch.chdir(place)
    names: dict[str, object] = {"part": spadmnist.open("out")["2560 mlux", "train"]}
    exec(next(b for b in blocks("python") if "torch" in b), names)
    fluxes, labels = next(iter(names["loader"]))  # type: ignore[call-overload]
    assert fluxes.shape == (64, 1, 28, 28) and labels.shape == (64,)


def test_the_effect_of_the_readme_works(place: Path) -> None:
    """Spreading a share of the light evenly keeps the mean and lights the background."""
    import spadmnist

    (place / "haze.py").write_text(next(b for b in blocks("python") if "stage=" in b))
    text = (ROOT / "configs" / "quick.yaml").read_text().replace("  effects:", "  effects:\n    haze: {share: 30 %}", 1)
    (place / "my.yaml").write_text(text)
    run("spadmnist generate my.yaml --plugin haze.py --limit 40", place)
    assert "haze" in run("spadmnist effects --plugin haze.py", place)
    hazy, clear = (spadmnist.open(place / name)["2560 mlux", "train"] for name in ("my", "out"))
    dark = clear.images[0] == 0
    assert hazy.reconstruction["counts"][0][dark].mean() > 5 * clear.reconstruction["counts"][0][dark].mean()


def test_the_matlab_of_the_readme_reads_what_is_there(place: Path) -> None:
    import h5py

    run("spadmnist generate configs/quick.yaml -o out --format hdf5 --limit 20".replace("-o out", "-o hdf5"), place)
    (matlab,) = blocks("matlab")
    path = re.search(r"'out/(.*?)'", matlab)
    assert path is not None
    with h5py.File(place / "hdf5" / path[1]) as file:
        for name in re.findall(r"h5read\(file, '(.*?)'", matlab):
            assert file[name].shape[0] > 0
        for name, attribute in re.findall(r"h5readatt\(file, '(.*?)', '(.*?)'", matlab):
            assert file[name].attrs[attribute] == pytest.approx(1e-11)


def test_the_tree_of_the_readme_is_the_tree() -> None:
    drawn = README[README.index("## Where everything lives") :]
    for path in (ROOT / "spadmnist").glob("*.py"):
        if path.stem != "__init__":
            assert path.name in drawn, f"{path.name} is not in the README's tree"
