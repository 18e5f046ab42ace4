"""Build the sdist and the wheel, install the wheel in an empty environment, and run the first commands there.

    python scripts/package.py [-o FOLDER]

The wheel is built from the sdist. pip fetches the build tool and the dependencies. FOLDER then holds both archives.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

COMMANDS = (
    ("--version",),
    ("init", "configs", "--examples"),
    ("generate", "configs/quick.yaml", "-o", "out"),
    ("verify", "out"),
    ("inspect", "out", "--plot", "out.png"),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "dist", help="folder of the two archives")
    output = parser.parse_args().output.resolve()
    with tempfile.TemporaryDirectory() as folder:
        builder, empty = environment(Path(folder) / "builder"), environment(Path(folder) / "empty")
        run(builder / "python", "-m", "pip", "install", "--quiet", "build")
        run(builder / "python", "-m", "build", "--outdir", output, ROOT)  # the wheel is built from the sdist
        wheel = newest(output, "*.whl")
        run(empty / "python", "-m", "pip", "install", "--quiet", wheel)
        place = Path(folder) / "place"
        place.mkdir()
        for words in COMMANDS:
            run(empty / "spadmnist", *words, place=place)
        assert (place / "out.png").stat().st_size > 0
    print(f"{newest(output, '*.tar.gz')} and {wheel}: built, installed, and the first commands ran")


def environment(folder: Path) -> Path:
    """The programs of a new, empty environment."""
    venv.create(folder, with_pip=True)
    return folder / "bin"


def run(*words: str | Path, place: Path = ROOT) -> None:
    """Run a command. It ends the script where the command fails."""
    print("$", *words, flush=True)
    done = subprocess.run([str(word) for word in words], cwd=place, check=False)
    if done.returncode:
        sys.exit(f"exit status {done.returncode}: {' '.join(map(str, words))}")


def newest(folder: Path, pattern: str) -> Path:
    return max(folder.glob(pattern), key=lambda path: path.stat().st_mtime)


if __name__ == "__main__":
    main()
