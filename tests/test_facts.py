"""What shards say of themselves for the manifest: noted by who makes them, so that nobody reads them all at the end."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from spadmnist import config, factory, shard_facts, shard_plan, verify
from spadmnist.shard_facts import Facts


def test_each_shards_facts_are_taken_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As it is made; a run that is taken up reads none that was noted, and one whose note is damaged."""
    experiment = config.read(config.shipped("quick.yaml"), lux=("2560 mlux",), limit=64)
    images = experiment.load_images()
    monkeypatch.setattr(shard_plan, "_IMAGES_PER_SHARD", 32)
    read: list[str] = []
    real = shard_facts.facts_of

    def facts_of(reader: Any, *rest: Any) -> Facts:
        read.append(reader.path)
        return real(reader, *rest)

    monkeypatch.setattr(shard_facts, "facts_of", facts_of)
    at_once = factory.generate(experiment, images, tmp_path / "once", 1)
    assert len(read) == len(set(read)) == 4

    factory.generate(experiment, images, tmp_path / "twice", 1, part=factory.Part(1, 2))
    notes = sorted((tmp_path / "twice" / ".spadmnist" / "shards" / "2560_mlux").rglob("*.json"))
    assert len(notes) == 2
    note = json.loads(notes[0].read_text())
    note["facts"]["statistics"] = {"tr": {"detections": "many"}}
    notes[0].write_text(json.dumps(note))
    read.clear()
    taken_up = factory.generate(experiment, images, tmp_path / "twice", 1)
    assert len(read) == 2 + 1, "two that were missing, and the one of the damaged note"
    assert taken_up.manifest == at_once.manifest
    assert not verify.verify(tmp_path / "twice"), "which adds them up anew"


@pytest.mark.parametrize(
    "found", [None, 3, {}, {"statistics": {}}, {"statistics": {"tr": {"x": "1"}}, "saturated": {}, "kinds": {}}]
)
def test_a_damaged_note_has_no_facts(found: object) -> None:
    assert Facts.noted(found) is None
    assert Facts.noted({"statistics": {"tr": {"x": 1}}, "saturated": {}, "kinds": {"tr": 2}}) is not None
