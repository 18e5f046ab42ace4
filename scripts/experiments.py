"""Put what experiments found into docs/experiments.md: the tables as they were written, and the pictures.

    spadmnist experiment accuracy -o accuracy      # most of an hour
    python scripts/experiments.py accuracy         # the folder of one run, or of several

What stands between `<!-- NAME: begin -->` and `<!-- NAME: end -->` is replaced; nothing there is typed by hand.
"""

from __future__ import annotations

import argparse
import re
import shutil
import sys
from pathlib import Path

PAGE = Path(__file__).parents[1] / "docs" / "experiments.md"


def put(run: Path, page: Path) -> list[str]:
    """Put the results of a run's folder into the page, and its pictures beside it; the names of the experiments."""
    done, text = [], page.read_text()
    for found in sorted(run.glob("*.md")):
        content, name = found.read_text(), found.stem
        marks = re.compile(rf"(?<=<!-- {re.escape(name)}: begin -->\n).*?(?=<!-- {re.escape(name)}: end -->)", re.S)
        if not marks.search(text):
            sys.exit(f"{page}: has no place for {name}; write <!-- {name}: begin --> and <!-- {name}: end --> into it")
        for picture in set(re.findall(r"\]\(([\w.-]+\.png)\)", content)):
            target = f"{name}.png" if picture == f"{name}.png" else f"{name}-{picture}"
            shutil.copyfile(run / picture, page.parent / target)
            content = content.replace(f"]({picture})", f"]({target})")
        text = marks.sub(lambda _, content=content: content, text)
        done.append(name)
    page.write_text(text)
    return done


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, metavar="OUT")
    parser.add_argument("--page", type=Path, default=PAGE)
    options = parser.parse_args()
    for run in options.runs:
        names = put(run, options.page)
        if not names:
            sys.exit(f"{run}: holds no results of an experiment; spadmnist experiment NAME -o {run} makes them")
        print(f"{options.page}: {', '.join(names)}")


if __name__ == "__main__":
    main()
