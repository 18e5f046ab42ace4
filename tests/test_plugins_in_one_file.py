"""One new file is all that an effect or a method needs: it is listed, simulated, stored, and nothing else changes."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import laws
import numpy as np
import pytest

import spadmnist
from spadmnist import config, factory, plugins
from spadmnist.effects import Effect
from spadmnist.errors import EffectError
from spadmnist.reconstruct import Method

ROOT = Path(__file__).parents[1]
CONFIG = """\
seed: 5
scene: {images: {source: uniform, repetitions: 40}, wavelength: 555 nm, lux: [500 mlux]}
recording: {exposure: 1 ms, frames: 10, frame_time: 100 us, readouts: [tr, qis]}
reconstruct: [counts]
sensor:
  layout: {rows: 16, columns: 16, pixel_area: 25 um^2}
  effects:
    detection: {pdp: 0.5}
    tdc: {resolution: 100 ps}
"""

# the effect of each stage: its text, how it stands in a config, and the factor by which the mean rate must change
EFFECTS = {
    "half_light": (
        '''class HalfLight(Effect, stage="light"):
    """Part of the light is lost on the way."""

    share = parameter(0.5, "", "share that passes", bounds=(0, 1), off=1.0, search=(0.1, 1))

    def apply(self, rate, conditions):
        return rate * self.share

    expected_rate = apply
''',
        "{share: 40 %}",
        0.4,
    ),
    "shutter": (
        '''class Shutter(Effect, stage="gate"):
    """The pixel is live during the first part of every millisecond."""

    share = parameter(1.0, "", "live share", bounds=(0, 1), off=1.0)

    def open(self, t, conditions):
        return t < self.share * conditions.exposure

    def expected_rate(self, rate, conditions):
        return rate * self.share
''',
        "{share: 0.3}",
        0.3,
    ),
    "lamp_ramp": (
        '''class LampRamp(Effect, stage="arrival"):
    """The lamp goes up from nothing."""

    def maximum(self, conditions):
        return 1.0

    def factor(self, t, conditions):
        return t / conditions.exposure

    def expected_rate(self, rate, conditions):
        return rate / 2
''',
        "",
        0.5,
    ),
    "lossy_bus": (
        '''class LossyBus(Effect, stage="readout"):
    """Every event is lost with the same chance on its way out."""

    loss = parameter(0.1, "", "chance that an event is lost", bounds=(0, 1), off=0.0)

    def apply(self, events, rng):
        return events.keep(rng.random(len(events)) >= self.loss)

    def expected_rate(self, rate, conditions):
        return rate * (1 - self.loss)
''',
        "{loss: 25 %}",
        0.75,
    ),
}
CONVERTER = '''import numpy as np

from spadmnist import Effect, Events, parameter


class FloorConverter(Effect, stage="timing"):
    """Stamps are whole nanoseconds, rounded down."""

    resolution = parameter(1e-9, "s", "length of a tick", bounds=(0, None), open_bounds=True)

    def apply(self, events, rng):
        ticks = np.floor(events.times / self.resolution).astype(np.uint64)
        return Events(None, events.offsets, events.pixels, ticks, self.resolution)
'''
METHOD = '''import numpy as np

from spadmnist.reconstruct import Method


class RootCounts(Method):
    """Square root of the detections: its spread does not depend on the light."""

    columns = ("counts",)
    unit = "1"

    def estimate(self, settings, counts):
        return np.sqrt(counts)
'''


def text_of(name: str) -> str:
    return "from spadmnist import Effect, parameter\n\n\n" + EFFECTS[name][0]


def command(*arguments: object, cwd: Path) -> str:
    """What the command line says on standard output, in a process of its own."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("SPADMNIST", "PYTEST"))}
    done = subprocess.run(
        [sys.executable, "-B", "-m", "spadmnist.cli", *map(str, arguments)],
        cwd=cwd,
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def listing(folder: Path) -> dict[str, int]:
    skipped = {"__pycache__", ".git", ".venv", ".hypothesis", ".pytest_cache", ".mypy_cache", ".ruff_cache", "demo"}
    return {
        str(p): p.stat().st_mtime_ns
        for p in sorted(folder.rglob("*"))
        if p.is_file() and not skipped & set(p.relative_to(folder).parts)
    }


def simulated(folder: Path, effects: dict[str, str]) -> Any:
    """Detections per image, simulated in this process from a config with these effects besides the base's."""
    path = folder / f"{'_'.join(effects) or 'plain'}.yaml"
    path.write_text(CONFIG + "".join(f"    {name}: {values}\n" for name, values in effects.items()))
    part = spadmnist.open(path)["500 mlux", "train"]
    return np.array([len(part.tr[i]) for i in range(len(part))]), part


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A temporary folder; what is loaded in this process is forgotten afterwards."""
    plugins.discover()
    for registry in (Effect.registry, Method.registry):
        monkeypatch.setattr(registry, "classes", dict(registry.classes))
    monkeypatch.setattr(plugins, "_loaded", dict(plugins._loaded))
    return tmp_path


def test_a_file_that_is_not_there_or_no_text_is_no_plugin(folder: Path) -> None:
    (folder / "picture.py").write_bytes(b"\x89PNG\xff")
    (folder / "folder.py").mkdir()
    for name, why in (
        ("mine.py", "no such file.*effects --new NAME"),
        ("picture.py", "no text in UTF-8"),
        ("folder.py", r"cannot be read \(Is a directory\)"),
    ):
        with pytest.raises(EffectError, match=f"{name}: .*{why}") as said:
            plugins.load_file(folder / name)
        assert "Errno" not in str(said.value)


def test_a_file_that_defines_nothing_is_no_plugin(folder: Path) -> None:
    (folder / "mine.py").write_text("x = 1\n")
    for _ in range(2):
        with pytest.raises(EffectError, match="defines no effect, statistic or method"):
            plugins.load_file(folder / "mine.py")


@pytest.mark.parametrize("name", EFFECTS)
def test_the_mean_rate_changes_as_the_effect_says(name: str, folder: Path) -> None:
    """40 images of 256 pixels, about 262,000 detections without the effect; false-alarm rate 1e-6."""
    _, values, factor = EFFECTS[name]
    (folder / "mine.py").write_text(text_of(name))
    plugins.load_file(folder / "mine.py")
    plain, _ = simulated(folder, {})
    counts, part = simulated(folder, {name: values})
    base = config.read(folder / "plain.yaml")
    rate = 0.5 * base.white(base.levels[0])
    expected = rate * 1e-3 * 256 * 40
    laws.poisson_mean(int(plain.sum()), expected, what="detections without the effect")
    laws.poisson_mean(int(counts.sum()), factor * expected, what=f"detections with {name}")
    assert counts.sum() < 0.9 * plain.sum()  # it could not have been the other one
    experiment = config.read(folder / f"{name}.yaml")
    photons = np.full((1, 256), experiment.white(experiment.levels[0]))
    _, told = experiment.sensor.expected(photons, experiment.conditions)
    assert told.sum() * 40 == pytest.approx(factor * expected, rel=1e-12)
    again, _ = simulated(folder, {name: values})
    assert np.array_equal(again, counts)  # one seed, the same draws
    assert np.array_equal(part.tr[7:9].counts, np.concatenate([part.tr[7].counts, part.tr[8].counts]))


@pytest.mark.slow
def test_a_new_effect_from_listing_to_dataset(folder: Path) -> None:
    name = "lossy_bus"
    file = folder / "mine.py"
    file.write_text(text_of(name))
    (folder / "c.yaml").write_text(CONFIG + f"    {name}: {EFFECTS[name][1]}\n")
    before = listing(ROOT)
    assert name in command("effects", "--plugin", file, cwd=folder)
    assert name not in command("effects", cwd=folder)
    page = command("effects", name, "--plugin", file, cwd=folder)
    for part in (
        "stage: readout",
        str(file),
        "Every event is lost",
        "chance that an event is lost",
        f"{name}: {{loss: 0.1}}",
    ):
        assert part in page
    command("generate", "c.yaml", "-o", "out", "--jobs", 2, "--plugin", "mine.py", cwd=folder)
    manifest = json.loads((folder / "out" / "manifest.json").read_text())
    assert manifest["config"]["sensor"]["effects"][name] == {"loss": "25 %"}
    assert text_of(name) in _texts(manifest["plugins"])
    assert str(folder) not in (folder / "out" / "manifest.json").read_text()
    assert "all " in command("verify", "out", "--plugin", file, cwd=folder)
    stored = spadmnist.open(folder / "out")["500 mlux", "train"]
    plugins.load_file(file)
    counts, _ = simulated(folder, {name: EFFECTS[name][1]})
    assert np.array_equal([len(stored.tr[i]) for i in range(40)], counts)  # bit for bit the same, in other processes
    assert listing(ROOT) == before
    assert sorted(p.name for p in folder.iterdir()) == ["c.yaml", f"{name}.yaml", "mine.py", "out"]


@pytest.mark.slow
def test_a_new_method_from_listing_to_dataset(folder: Path) -> None:
    file = folder / "mine.py"
    file.write_text(METHOD)
    (folder / "c.yaml").write_text(CONFIG.replace("[counts]", "[counts, root_counts]"))
    (folder / "plain.yaml").write_text(CONFIG)
    before = listing(ROOT)
    assert "root_counts" in command("methods", "--plugin", file, cwd=folder)
    page = command("methods", "root_counts", "--plugin", file, cwd=folder)
    assert "Square root of the detections" in page and "reconstruct: [root_counts]" in page and str(file) in page
    command("generate", "c.yaml", "-o", "out", "--jobs", 1, "--plugin", file, cwd=folder)
    manifest = json.loads((folder / "out" / "manifest.json").read_text())
    assert METHOD in _texts(manifest["plugins"])
    assert manifest["config"]["reconstruct"] == ["counts", "root_counts"]
    part = spadmnist.open(folder / "out")["500 mlux", "train"]
    for i in (0, 39):
        expected = np.sqrt(part.tr[i].counts.reshape(16, 16)).astype(np.float32)
        assert np.array_equal(part.reconstruction["root_counts"][i], expected)
    # added later, it is the same dataset
    command("generate", "plain.yaml", "-o", "later", "--jobs", 1, cwd=folder)
    command("reconstruct", "later", "--method", "root_counts", "--plugin", file, cwd=folder)
    one, other = (
        {str(p.relative_to(folder / d)): p.read_bytes() for p in (folder / d).rglob("*") if p.is_file()}
        for d in ("out", "later")
    )
    assert set(one) == set(other) and [n for n in one if one[n] != other[n]] == []
    assert listing(ROOT) == before
    # the number stands in the manifest: reading it takes no plug-in, as reading the images does not
    assert part.reconstruction["root_counts"].normalisation == pytest.approx(
        np.median(np.sqrt(np.concatenate([part.tr[i].counts for i in range(40)]))), rel=1e-6
    )


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('("counts",)', '("countz",)', r"mine.py:6: .*RootCounts: 'countz' is not a column.*span.*Did you mean counts"),
        ('    columns = ("counts",)\n', "", r"mine.py:6: .*RootCounts: it has no columns.*counts, span, ones, waited"),
        ("np.sqrt(counts)", "counts.sqrt()", r"mine.py:13: the method root_counts failed: AttributeError: .*'sqrt'"),
        (
            "np.sqrt(counts)",
            "np.sqrt(counts)[:-1]",
            r"mine.py: the method root_counts: estimate must return one number",
        ),
        ("np.sqrt(counts)", "np.sqrt(counts) + np.inf", r"mine.py: the method root_counts: its image is not finite"),
        ("np.sqrt(counts)", "-np.sqrt(counts)", r"mine.py: the method root_counts: the median .* is -\d"),
    ],
)
def test_the_mistakes_of_a_method_are_sentences(old: str, new: str, says: str, folder: Path) -> None:
    """In the command as in Python: with the file, the method and what to do, and not as a fault of the program."""
    (folder / "mine.py").write_text(METHOD.replace(old, new))
    (folder / "c.yaml").write_text(CONFIG.replace("[counts]", "[counts, root_counts]"))
    arguments = ["generate", "c.yaml", "-o", "out", "--jobs", "1", "--plugin", "mine.py"]
    program = [sys.executable, "-B", "-m", "spadmnist.cli", *arguments]
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("SPADMNIST", "PYTEST"))}
    done = subprocess.run(program, cwd=folder, env=environment, capture_output=True, text=True, timeout=120)
    said = " ".join(done.stderr.split())
    assert done.returncode == 2 and re.search(says, said) and "fault of the program" not in said, done.stderr


def test_the_plug_in_is_asked_for_where_it_is_missing(folder: Path) -> None:
    """The config of a dataset that was made with a plug-in says what is missing, not that a name is wrong."""
    (folder / "mine.py").write_text(text_of("half_light"))
    (folder / "c.yaml").write_text(CONFIG + "    half_light: {share: 0.5}\n")
    command("generate", "c.yaml", "-o", "out", "--jobs", 1, "--plugin", "mine.py", cwd=folder)
    assert len(spadmnist.open(folder / "out")["500 mlux", "train"].tr[0]) > 0  # reading the data needs no plug-in
    with pytest.raises(spadmnist.SpadError, match="half_light is not an effect"):
        spadmnist.open(folder / "c.yaml")


def test_a_converter_of_another_kind(folder: Path) -> None:
    """Ticks do not come from one effect alone: a dataset whose stamps a user's converter makes can be read."""
    (folder / "mine.py").write_text(CONVERTER)
    (folder / "c.yaml").write_text(
        CONFIG.replace("tdc: {resolution: 100 ps}", "floor_converter:").replace("[tr, qis]", "[tr, str, qis]")
    )
    command("generate", "c.yaml", "-o", "out", "--jobs", 1, "--plugin", "mine.py", cwd=folder)
    plugins.load_file(folder / "mine.py")
    stored, live = (spadmnist.open(folder / name)["500 mlux", "train"] for name in ("out", "c.yaml"))
    for part in (stored, live):
        assert part.tr[3].tick == 1e-9 and np.array_equal(part.tr[3].times, part.tr[3].ticks * 1e-9)
        assert ((part.str[3] < 100e-6) == part.qis[3]).all()
    assert np.array_equal(stored.tr[3].ticks, live.tr[3].ticks)
    assert config.read(folder / "c.yaml").settings.tick == 1e-9


def test_two_files_of_one_name_both_travel(folder: Path) -> None:
    for where, name in (("a", "half_light"), ("b", "lossy_bus")):
        (folder / where).mkdir()
        (folder / where / "mine.py").write_text(text_of(name))
        plugins.load_file(folder / where / "mine.py")
    (folder / "c.yaml").write_text(CONFIG + "    half_light: {share: 0.5}\n    lossy_bus:\n")
    experiment = config.read(folder / "c.yaml")
    held = _texts(factory.identity(experiment, experiment.load_images())["plugins"])
    assert text_of("half_light") in held and text_of("lossy_bus") in held


def _texts(plugins: Any) -> list[str]:
    """All texts in a manifest's entry on plug-ins."""
    if isinstance(plugins, str):
        return [plugins]
    inner = plugins.values() if isinstance(plugins, dict) else plugins
    return [text for item in inner for text in _texts(item)]


BOTH = (
    text_of("lossy_bus")
    + '''

from spadmnist.statistics import Recording, Statistic, Summary


class EvenTicks(Statistic):
    """How many stamps are even numbers: a converter whose lowest bit is stuck shows here."""

    modalities = ("tr",)

    def reduce(self, recording: Recording) -> Summary | None:
        events = recording.events
        if events is None or events.ticks is None:
            return None
        even = float((events.ticks % 2 == 0).sum())
        return Summary(
            values=__import__("numpy").array([even]),
            law="poisson",
            where=lambda cell: "all pixels",
            size=lambda cell, measured, expected: (f"{measured:.0f} stamps", measured / max(expected, 1) - 1),
        )
'''
)


@pytest.mark.slow
def test_a_new_effect_and_a_new_statistic_in_one_file(folder: Path) -> None:
    """Both are listed; the effect works in configs and models, the statistic is among the checks of a comparison."""
    file = folder / "mine.py"
    file.write_text(BOTH)
    (folder / "c.yaml").write_text(CONFIG + "    lossy_bus: {loss: 25 %}\n")
    before = listing(ROOT)
    assert "even_ticks" in command("statistics", "--plugin", file, cwd=folder)
    assert "even_ticks" not in command("statistics", cwd=folder)
    assert "lowest bit is stuck" in command("statistics", "even_ticks", "--plugin", file, cwd=folder)
    assert "lossy_bus" in command("effects", "--plugin", file, cwd=folder)
    command("generate", "c.yaml", "-o", "out", "--jobs", 1, "--limit", 8, "--plugin", file, cwd=folder)
    assert BOTH in _texts(json.loads((folder / "out" / "manifest.json").read_text())["plugins"])
    simulate = ("simulate", "c.yaml", "out", "-o", "twin", "--plugin", file)
    command(*simulate, cwd=folder)
    answer = folder / "answer.json"
    command("compare", "c.yaml", "twin", "--jobs", 2, "--json", answer, "--plugin", file, cwd=folder)
    checks = json.loads(answer.read_text())["checks"]
    mine = [c for c in checks if c["statistic"] == "even_ticks"]
    assert len(mine) == 8 and all(c["passes"] for c in mine)
    assert listing(ROOT) == before
