"""The bookkeeping of many shards, which `scripts/scale.py tasks` measures: it does not grow with their square."""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from spadmnist import factory, shard_plan

sys.path.append(str(Path(__file__).parents[1] / "scripts"))
import scale


@pytest.mark.parametrize("number", [100, 400])
def test_what_is_looked_at_once_is_not_looked_at_for_each_shard(
    number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: Counter[str] = Counter()

    def counted(of: Any, name: str) -> None:
        real = getattr(of, name)

        def call(*asked: Any) -> Any:
            calls[name] += 1
            return real(*asked)

        monkeypatch.setattr(of, name, call)

    counted(shard_plan, "expected_per_image")
    counted(factory, "_noted")
    found = dict(scale.tasks(number, tmp_path / "out"))
    assert found["shards that were kept"] == number - scale.LEFT
    assert calls["expected_per_image"] < 20, "once for each level and split, and not for each shard"
    assert calls["_noted"] <= 3 * (number + 1), "once by each run, and once where it is sealed"
