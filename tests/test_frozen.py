"""Frozen answers: which changes of the engine pass, and what is said of the others."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import pytest
from test_challenge import loaded

frozen = loaded("frozen")


def entry(kind: str = "single", z: float = 12.0, right: int = 1, seconds: float = 60.0, **more: Any) -> dict[str, Any]:
    plain = {"verdict": "explained", "steps": ["crosstalk"], "misfit": {"after": 1.0}, "values": {}, "digest": "a"}
    return {**plain, "class": kind, "z": z, "right": right, "seconds": seconds, **more}


def null(verdict: str) -> dict[str, Any]:
    return {"verdict": verdict, "steps": [], "class": "null", "z": 0.0, "seconds": 9.0, "digest": verdict}


def test_a_class_may_lose_two_right_names_net_and_no_more() -> None:
    before = {f"case-{k} diagnose": entry() for k in range(8)}
    after = {key: entry(right=int(k >= 2)) for k, key in enumerate(before)}
    assert frozen.gates(before, after) == []
    after["case-2 diagnose"] = entry(right=0)
    assert frozen.gates(before, after) == ["Z 10-20: 3 right names lost, net"]
    before["case-9 diagnose"], after["case-9 diagnose"] = entry(right=0), entry(right=1)  # one is won
    assert frozen.gates(before, after) == []


def test_alarms_silence_and_time_are_gates() -> None:
    before = {f"null-{k} compare": null("adequate") for k in range(50)}
    after = {**before, "null-0 compare": null("fails")}
    assert frozen.gates(before, after) == []
    after["null-1 compare"] = null("fails")
    assert frozen.gates(before, after) == ["2 of 50 nulls alarm"]
    one = {"a diagnose": entry()}
    assert frozen.gates(one, {"a diagnose": entry(verdict="no answer")}) == ["a diagnose: no answer"]
    (slow,) = frozen.gates(one, {"a diagnose": entry(seconds=70.0)})
    assert slow.startswith("median time of diagnose 70 s, 60 s before")


def test_an_answer_is_the_same_wherever_its_files_lie(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    step = {"change": "add", "effect": "crosstalk", "parameter": None}
    answer = {"verdict": "explained", "misfit": {"after": 1.0}, "steps": [step | {"values": {"p": {"value": 0.1}}}]}
    assert frozen.short({**answer, "sensor": "here"}) == frozen.short({**answer, "sensor": "there"})
    assert frozen.short({**answer, "ladder": []})["digest"] != frozen.short(answer)["digest"]

    monkeypatch.setattr(frozen, "KEPT", tmp_path / "kept")
    (tmp_path / "answers").mkdir()
    (tmp_path / "plan.json").write_text(json.dumps({"set": "small", "questions": {"open-a": ["diagnose"]}}))
    told = tmp_path / "answers" / "open-a.diagnose.json"
    told.write_text(json.dumps({"answer": answer, "seconds": 5.0}))
    asked = argparse.Namespace(folder=str(tmp_path), against=None, same=True)
    assert frozen.changed(asked) == 2  # nothing is kept yet
    assert frozen.keep(asked) == 0 and frozen.changed(asked) == 0
    answer["steps"][0]["values"]["p"]["value"] = 0.2  # type: ignore[index]
    told.write_text(json.dumps({"answer": answer, "seconds": 5.0}))
    assert frozen.changed(asked) == 1
    out = capsys.readouterr().out
    assert "crosstalk p: [0.1, None, None] -> [0.2, None, None]" in out


def test_the_sets_hold_what_they_say() -> None:
    small = frozen.cases_of("small")
    assert len([q for _, q in small if q == ("compare",)]) == 20
    assert {case.name for case, q in small if q == ("diagnose",)} == set(frozen.SHORT)
    full = frozen.cases_of("full")
    nulls = [q for case, q in full if case.kind == "null"]
    assert len(nulls) == 200 and sum("diagnose" in q for q in nulls) == 40 and len(full) == 260
