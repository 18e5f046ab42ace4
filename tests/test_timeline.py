"""`make profile`: what it says of a run adds up, and nothing stays wrapped that the package did not wrap."""

from __future__ import annotations

import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parents[1] / "scripts"))
import timeline

SCRIPTS = Path(timeline.__file__).parent


def test_a_spans_own_time_is_without_those_within_it() -> None:
    spans = timeline.Spans()
    with spans.span("outer"):
        with spans.span("inner"):
            until = time.thread_time() + 0.02
            while time.thread_time() < until:
                pass
        with spans.span("asleep"):
            time.sleep(0.02)
    inner, asleep, outer = spans.taken()
    assert [inner.name, asleep.name, outer.name] == ["inner", "asleep", "outer"]
    assert inner.processor >= 0.02 and asleep.processor < 0.02 <= asleep.own
    whole = outer.end - outer.start
    assert abs(inner.own + asleep.own + outer.own - whole) < 1e-6
    assert outer.processor < 0.02, "the loop is the inner one's"
    assert spans.taken() == []


@pytest.mark.slow
def test_a_run_is_watched_from_its_start_to_its_end(tmp_path: Path) -> None:
    """In a process of its own, which is wrapped: with threads, the shortest way through all of it."""
    out = tmp_path / "profile"
    command = [sys.executable, str(SCRIPTS / "timeline.py"), str(SCRIPTS.parent / "configs" / "quick.yaml")]
    command += ["--lux", "2560 mlux", "--limit", "8", "--threads", "-o", str(out)]
    said = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert said.returncode == 0, said.stderr
    text = (out / "timeline.md").read_text()
    assert text in said.stdout
    assert (out / "timeline.png").read_bytes().startswith(b"\x89PNG")
    assert not list(out.glob("dataset-*"))
    rows = dict(re.findall(r"^\| ([^|]+?) \| ([0-9.]+) \|", text, re.MULTILINE))
    for stage in timeline.STAGES:
        assert f"tasks: {stage}" in rows
    assert float(rows["tasks: simulate"]) > 0 and float(rows["tasks: encode"]) > 0
    parts = sum(float(seconds) for name, seconds in rows.items() if name not in ("**all**", "numpy's exponentials"))
    assert 0.7 * float(rows["**all**"]) < parts < 1.1 * float(rows["**all**"]) + 0.1
    assert "- 16 images in " in text
