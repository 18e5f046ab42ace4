"""The loop of docs/start/loop.md, as a reader goes through it: fails, unexplained, an own effect, explained."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def run(folder: Path, line: str, status: int = 0) -> str:
    """A command of the page, in a folder."""
    words = line.split("#")[0].split()
    assert words[0] == "spadmnist"
    done = subprocess.run(
        [sys.executable, "-m", "spadmnist.cli", *words[1:]], cwd=folder, capture_output=True, text=True, timeout=600
    )
    assert done.returncode == status, done.stderr[-2000:]
    return done.stdout


@pytest.mark.slow
@pytest.mark.long  # an own effect: test_plugins_in_one_file; what no effect describes: test_strangers
def test_the_loop_of_the_docs(tmp_path):
    text = (ROOT / "docs" / "start" / "loop.md").read_text()
    blocks = re.findall(r"```(\w*)\n(.*?)```", text, re.S)
    commands = [line for kind, body in blocks if kind == "bash" for line in body.strip().splitlines()]
    (effect,) = [body for kind, body in blocks if kind == "python"]
    assert commands[0] == "cd configs/tutorial" and len(commands) == 6
    folder = tmp_path / "tutorial"
    shutil.copytree(ROOT / "configs" / "tutorial", folder)
    simulate, compare, diagnose, again, check = commands[1:]

    run(folder, simulate)
    assert "fine_intervals" in run(folder, compare, status=1) and (folder / "report" / "index.html").exists()
    run(folder, diagnose + " --json first.json")
    first = json.loads((folder / "first.json").read_text())
    assert first["verdict"] == "unexplained" and not first["steps"]
    assert any(u["statistic"] == "fine_intervals" and "200 to 201 ns" in u["where"] for u in first["unexplained"])
    assert any(u["capture"] == "dark" for u in first["unexplained"])

    run(folder, "spadmnist effects --new echo")
    (folder / "echo.py").write_text(effect)
    run(folder, again + " --json second.json")
    second = json.loads((folder / "second.json").read_text())
    assert second["verdict"] == "explained" and [s["effect"] for s in second["steps"]] == ["echo"]
    values = second["steps"][0]["values"]
    assert values["share"]["low"] < 0.008 < values["share"]["high"]
    assert values["delay"]["low"] < 150e-9 < values["delay"]["high"]
    # a mean over all statistics, most of which an echo does not move
    assert second["misfit"]["before"] > 2.5 and second["misfit"]["after"] < max(1.2, second["misfit_null_95"])
    placebo = next(row for row in second["ladder"] if row["placebo"])
    assert placebo["misfit"] > 0.8 * second["misfit"]["before"]  # adding just anything does not help
    assert "The model is adequate" in run(folder, check)
    # the fit that is asked for agrees with the diagnosis
    run(folder, "spadmnist fit sensor.yaml lab --plugin echo.py --add echo -o fitted --json fit.json")
    asked = json.loads((folder / "fit.json").read_text())
    assert asked["verdict"] == "explained"
    values = asked["steps"][0]["values"]
    assert values["share"]["low"] < 0.008 < values["share"]["high"] < 0.0095
    assert values["delay"]["low"] < 150e-9 < values["delay"]["high"] < 155e-9
    assert "from bench" in (folder / "next" / "sensor.yaml").read_text()
