"""What every test gets: the effects and methods of the package, and none that another test has loaded."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import hypothesis
import pytest
from labs import Lab, labs

from spadmnist import plugins

# the same examples in every run: what fails once fails again; the time of an example depends on the machine
hypothesis.settings.register_profile("same", derandomize=True, deadline=None)
hypothesis.settings.load_profile("same")


@pytest.fixture(autouse=True)
def no_plugins_of_other_tests() -> Iterator[None]:
    plugins.discover()
    before = [(registry, dict(registry.classes)) for registry in plugins._registries]
    loaded = dict(plugins._loaded)
    yield
    for registry, classes in before:
        registry.classes.clear()
        registry.classes.update(classes)
    plugins._loaded.clear()
    plugins._loaded.update(loaded)


@pytest.fixture
def lab(tmp_path: Path) -> Lab:
    return labs(tmp_path)
