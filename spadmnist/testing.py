"""The contract that effects, statistics and reconstruction methods keep; for us and for anybody's own file.

    from spadmnist.testing import check_effect

    def test_mine():
        check_effect(MyEffect)

`check_effect` simulates a small sensor with and without the effect and raises AssertionError at the first thing that
is wrong. What an effect changes, at the values that the contract chooses, it says in `moves` by the names of
`signatures.BLOCKS`: the first of them must change, the others may, and whatever is not named must stay. Where nothing
is declared, the report alone says what moved.
"""

from __future__ import annotations

import math
import pickle
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from . import config, document, hooks, signatures, units
from .effects import STAGES, Conditions, Effect
from .errors import ConfigError, SpadError, did_you_mean
from .events import Events, Layout
from .inference.reduction import reduce_with
from .inference.replicates import simulated
from .plugins import Distribution, Parameter, source_file
from .readout import READOUTS, Recorded
from .reconstruct import Method, Settings, stored
from .recording import Capture, Light
from .sensor import Sensor
from .signatures import BLOCKS, Shots
from .statistics import Statistic
from .streams import BLOCK, Streams

__all__ = ["Report", "check_effect", "check_method", "check_statistic", "strong"]

MOVED = 6.0  # by so many standard errors the first block of `moves` must change at least
STAYED = 5.5  # and by no more a block that is not named

# The paper's sensor, small. A dead time and a dark count rate that few exposures suffice to see.
_BASE = """
seed: 1
scene: {images: {source: uniform}, wavelength: 555 nm, lux: [1 lux]}
recording: {exposure: 1 ms, frames: 1000, frame_time: 1 us}
reconstruct: []
sensor:
  chip_seed: 1
  layout: {rows: 8, columns: 8, pixel_area: 25 um^2}
  effects:
    detection: {pdp: 0.5}
    dark_counts: {rate: 5 kHz}
    afterpulsing: {probability: 0.5 %, lifetime: 25 ns}
    dead_time: {duration: 100 ns}
    tdc: {resolution: 100 ps}
"""
_CAPTURES = {"dark": (0.0, 8), "dim": (60e3, 8), "bright": (1.2e6, 2)}  # photons/s, exposures of one repetition
_REPETITIONS = 32
_RECORDINGS = 24  # of a capture, by which a statistic is checked
_SCATTER = 8.0  # by such a factor the variance of its cells may differ from their law's: a rule of thumb
_CHILDREN, _MOST_EVENTS = 4000, 400_000  # by so many a `hazard` is checked, of so many events at most
_STRIDE = 67  # has no factor in common with the number of pixels of three exposures
_UNSTATED = 0.01  # relative: a smaller change of the mean need not be stated
Lights = Mapping[str, tuple[float, int]]
# what share of white each of its pixels sees, where the effect is one of scenes
_SCENE = np.array([int(bit) for bit in f"{0xC3A5_1E78_5AD2_3C96:064b}"], np.float64)


@dataclass
class Report:
    """What `check_effect` found. Printed, it is a table.

    Attributes:
        name: of the effect.
        checks: the verdict on each check, by its name: "kept", or what is to be said besides.
        moved: by how many standard errors the effect moved each statistic, by the names of `signatures.BLOCKS`.
        warnings: sentences on what is no fault of the effect, but should be mended.
    """

    name: str
    checks: dict[str, str] = field(default_factory=dict)
    moved: dict[str, float] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        lines = [self.name, *(f"  {name}: {verdict}" for name, verdict in self.checks.items())]
        lines += [f"  warning: {sentence}" for sentence in self.warnings]
        return "\n".join([*lines, *(f"    {name:16} {z:8.1f}" for name, z in self.moved.items())])


def check_effect(effect: type[Effect] | str, **parameters: Any) -> Report:
    """Does an effect keep the contract?

    Args:
        effect: the class or its name.
        parameters: values in SI in place of those that the contract chooses; see `strong`.

    Returns:
        Report: what was found; a docstring without a `Source:` is a warning there.

    Raises:
        AssertionError: with one sentence, at the first check that the effect does not keep.
    """
    kind: type[Effect] = Effect.registry.find(effect) if isinstance(effect, str) else effect
    if not __debug__:
        raise AssertionError("Python runs without assertions (-O), which the contract is made of")
    trial = _Trial(kind, parameters)
    report = Report(kind.name)
    for check in _CHECKS:
        title = check.__name__.strip("_").replace("_", " ")
        try:
            report.checks[title] = check(trial) or "kept"
        except Exception as error:
            what = str(error) if isinstance(error, AssertionError | SpadError) else f"{type(error).__name__}: {error}"
            raise AssertionError(f"{source_file(kind)}: the effect {kind.name}, {title}: {what}") from error
    report.moved, report.warnings = trial.moved, trial.warnings
    return report


def check_method(method: type[Method] | str) -> None:
    """Does a reconstruction method keep the contract?

    Its code does not fail, and changes nothing that it is given. Its image is finite, 0 where nothing was recorded, and
    that of each exposure whatever others stand beside it: each value is a function of its own pixel's values alone.

    Args:
        method: the class or its name.

    Raises:
        AssertionError: with one sentence, where it does not.
    """
    kind: type[Method] = Method.registry.find(method) if isinstance(method, str) else method
    if not __debug__:
        raise AssertionError("Python runs without assertions (-O), which the contract is made of")
    sensor = _sensor(None, "paper", lacking=("dark",))
    conditions = _conditions(1.0, exposure=1e-4, frames=100, bits=1)
    told = (sensor.nominal_pdp(conditions.wavelength), conditions.exposure, sensor.nominal_dead_time, sensor.tick)
    settings = Settings(*told, conditions.frames, conditions.frame_time)
    for light in (0.0, 1e5, 1e9):
        what = f"{source_file(kind)}: the method {kind.name}: at {light:g} photons/s"
        recorded = _expose(sensor, np.full((3, sensor.layout.pixels), light), conditions)
        try:
            _images_of(kind, recorded, settings, light, what)
        except SpadError as error:
            raise AssertionError(f"at {light:g} photons/s: {error}") from error


def _images_of(kind: type[Method], recorded: Recorded, settings: Settings, light: float, what: str) -> None:
    """Raises AssertionError where a method's images of three exposures are not as they must be."""
    image, _ = kind().image(recorded, settings)
    shape = (3 * recorded.pixels,)
    assert image.shape == shape, f"{what} its image has the shape {image.shape}"
    assert np.all(np.isfinite(image)), f"{what} its image is not finite"
    assert light or not image.any(), f"{what} its image is {image[image != 0][0]:g}, not 0"
    parts = [kind().image(recorded.images(i, i + 1), settings)[0] for i in range(3)]
    assert np.array_equal(np.concatenate(parts), image), f"{what} an image changes with those beside it"
    columns = [getattr(recorded, name) for name in kind.columns]
    apart = np.arange(*shape) * _STRIDE % shape[0]  # neighbours are none any more
    for order in (np.arange(*shape), apart):
        found = stored(kind(), settings, *(column[order] for column in columns))
        for pixel in np.flatnonzero(~np.isclose(found, image[order], rtol=1e-5, atol=0.0))[:1]:
            named = zip(kind.columns, columns, strict=True)
            place = " and ".join(f"{name} is {column[order[pixel]]:g}" for name, column in named)
            raise AssertionError(
                f"{what} a pixel in which {place} has {image[order[pixel]]:g} in its image, but {found[pixel]:g} where "
                "estimate is given the same pixels in other company; each value must be a function of its own pixel's "
                "values alone"
            )


def check_statistic(statistic: type[Statistic] | str) -> None:
    """Does a statistic keep the contract?

    It reduces recordings of a small sensor, dark and lit, of each of its modalities. It finds the same twice, with no
    random numbers and without a change of the recording; it has the same cells in each recording of a capture; and they
    scatter about as their law says.

    Args:
        statistic: the class or its name.

    Raises:
        AssertionError: with one sentence, where it does not.
    """
    kind: type[Statistic] = Statistic.registry.find(statistic) if isinstance(statistic, str) else statistic
    if not __debug__:
        raise AssertionError("Python runs without assertions (-O), which the contract is made of")
    place = f"{source_file(kind)}: the statistic {kind.name}"
    assert (kind.__doc__ or "").strip().split("\n")[0].endswith("."), (
        f"{place}: the docstring must begin with one sentence on one line"
    )
    said = 0
    for modality in kind.modalities:
        for name, photons in {"dark": 0.0, "dim": 6e4, "bright": 1.2e6}.items():
            try:
                said += _reduced(kind, modality, name, photons)
            except SpadError as error:
                raise AssertionError(str(error)) from error
            except AssertionError as error:
                raise AssertionError(f"{place}, {modality}, {name} light: {error}") from error
    assert said, f"{place}: it has nothing to say of any recording; reduce returned None for all of them"


def _reduced(kind: type[Statistic], modality: str, name: str, photons: float) -> int:
    """How many recordings of a capture have a summary. Raises AssertionError where one of them is wrong."""
    sensor = _sensor(None, "device")
    conditions = _conditions(photons, bits=4 if modality == "counts" else 0)
    capture = Capture(name, modality, Light(555e-9, 1.0, "lux") if photons else Light(), conditions)
    numbers = np.arange(_RECORDINGS, dtype=np.uint64)
    found = []
    for recording in simulated(sensor, capture, np.full(_RECORDINGS, photons), numbers, seed=1):
        one, other = (reduce_with(kind(), again) for again in (recording, pickle.loads(pickle.dumps(recording))))
        assert (one is None) == (other is None), "it has a summary of a recording at one time, and none at another"
        if one is None or other is None:
            continue
        assert np.shape(one.values) == np.shape(other.values) and np.allclose(
            one.values, other.values, equal_nan=True
        ), "it finds other values in the same recording at another time; it may draw no random numbers"
        found.append(one)
        cells = found[0].values.size
        assert one.values.size == cells, (
            f"it has {cells} cells in one recording and {one.values.size} in another of the same capture; their number "
            "may depend on the conditions and the layout alone"
        )
    if found:
        _as_its_law(found[0].law, np.array([one.values for one in found], np.float64))
    return len(found)


def _as_its_law(law: str, values: np.ndarray) -> None:
    """Raises AssertionError where the cells of (recordings, cells) scatter otherwise by far."""
    if len(values) < _RECORDINGS:
        return
    mean, variance = values.mean(axis=0), values.var(axis=0, ddof=1)
    seen = mean > 5 if law == "poisson" else mean > 0
    if law == "exact":
        assert not np.ptp(values, axis=0).any(), "its law is exact, but its cells differ from recording to recording"
    elif law in ("poisson", "exponential") and seen.any():
        ratio = float(np.mean(variance[seen] / (mean[seen] if law == "poisson" else mean[seen] ** 2)))
        assert 1 / _SCATTER < ratio < _SCATTER, (
            f"by the law {law} the variance of a cell is its mean{' squared' * (law == 'exponential')}, but here it is "
            f"{ratio:.2g} times that; normal is the law of values whose spread is not known"
        )


def captured() -> list[str]:
    """The names of the effects that the contract's sensor has of its own."""
    return [effect.name for effect in _base().sensor.effects]


def captures(
    effect: type[Effect] | None, lights: Lights, repetitions: int = 32, absent: bool = False, **given: Any
) -> dict[str, Shots]:
    """Captures of the contract's sensor, with an effect as strong as the contract has it, or without; for pictures.

    Args:
        effect: the class; None, with `absent`: any that is not one of `captured` and not one of scenes.
        lights: (photons/s, exposures of one repetition) by the name of the capture.
        repetitions: of each capture.
        absent: without the effect, the same light.
        given: values in SI in place of those that the contract chooses; see `strong`.

    Returns:
        The `signatures.Shots` of each capture, by its name. The dead time in them is that of the sensor without the
        effect.
    """
    plain = _sensor(None, "device", without=effect.name if effect else "")
    sensor = plain if absent or effect is None else _Trial(effect, given).sensor("device")
    split = "without" if sensor is plain else "with"
    return _shots(sensor, split, repetitions, plain.nominal_dead_time, effect is not None and effect.of_scene, lights)


# --- an effect and its sensor -------------------------------------------------------------------------------------


def strong(declared: Parameter) -> Any:
    """A value of a parameter at which an effect is strong, out of its `search`, or else the default.

    What can switch the effect off is taken far from there, anything else from the middle of its range; a parameter
    that may vary over the array is a distribution, about off where the range lies on both sides of it.

    Args:
        declared: the parameter, `MyEffect.parameters["rate"]`.

    Returns:
        A number in SI, or a `Distribution`.

    Raises:
        AssertionError: where it has neither `search` nor a default.
    """
    if declared.search is None:
        assert declared.default is not None, f"no value is known for {declared.name}: give one, or declare `search`"
        return declared.default
    (low, high), off = declared.search, declared.off
    if declared.per and off is not None and low < off < high:
        return Distribution("normal", (float(off), (high - low) / 8))
    if off is None:
        value = math.sqrt(low * high) if low > 0 else (low + high) / 2
        # whole where everything that is said of it is: a number of things
        value = float(round(value)) if all(said % 1 == 0 for said in (declared.default or 0.5, low, high)) else value
    elif low > off >= 0:
        value = low**0.25 * high**0.75
    else:
        value = off + ((high if high - off >= off - low else low) - off) / 2
    return Distribution("lognormal", (value, 0.3)) if declared.per and value > 0 else value


@dataclass
class _Trial:
    """An effect with its values, and what is measured once for several checks."""

    kind: type[Effect]
    given: dict[str, Any]
    moved: dict[str, float] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    @cached_property
    def values(self) -> dict[str, Any]:
        rest = {name: strong(p) for name, p in self.kind.parameters.items() if name not in self.given}
        return rest | self.given

    def sensor(self, rules: str, layout: Layout | None = None, lacking: Collection[str] = ()) -> Sensor:
        return _sensor(self.kind(**self.values), rules, layout, lacking=lacking)

    @property
    def replaced(self) -> str:
        """Its name, where the contract's sensor has an effect of that name; else nothing."""
        return self.kind.name if any(e.name == self.kind.name for e in _base().sensor.effects) else ""


@lru_cache
def _base() -> Any:
    return config.build(document.parse(_BASE, "the contract's sensor"), Path())


def _sensor(
    effect: Effect | None, rules: str, layout: Layout | None = None, without: str = "", lacking: Collection[str] = ()
) -> Sensor:
    """The contract's sensor with an effect on top, or in place of its own one of that name.

    without: the name of another that is left out; lacking: stages at which it has none of its own.
    """
    base = _base().sensor
    out = without or getattr(effect, "name", "")
    effects = [e for e in base.effects if e.name != out and e.stage not in lacking]
    return Sensor(layout or base.layout, [*effects, *([effect] if effect else [])], rules, base.chip_seed).resolved()


@lru_cache
def _reference(without: str, scene: bool) -> dict[str, np.ndarray]:
    """The statistics of the contract's sensor without an effect."""
    sensor = _sensor(None, "device", without=without)
    return _statistics(sensor, "without", 2 * _REPETITIONS, sensor.nominal_dead_time, scene)


def _statistics(
    sensor: Sensor, split: str, repetitions: int, dead_time: float, scene: bool = False
) -> dict[str, np.ndarray]:
    return signatures.statistics(**_shots(sensor, split, repetitions, dead_time, scene))


def _shots(
    sensor: Sensor, split: str, repetitions: int, dead_time: float, scene: bool, lights: Lights | None = None
) -> dict[str, Shots]:
    """Each capture of a sensor by its name. scene: is the light that of a scene, and not the same on all pixels?"""
    shots = {}
    for name, (light, each) in (lights or _CAPTURES).items():
        photons, conditions = np.full((repetitions * each, sensor.layout.pixels), light), _conditions(light)
        photons *= _SCENE if scene else 1.0
        recorded = _expose(sensor, photons, conditions, split=f"{split}/{name}", readouts=("tr", "str", "qis"))
        shots[name] = Shots(recorded, sensor, conditions, each, dead_time)
    return shots


def _conditions(light: float, **changes: Any) -> Conditions:
    """How light of so many photons/s is recorded."""
    return replace(_base().conditions, wavelength=555e-9 if light else None, **changes)


def _expose(
    sensor: Sensor,
    photons: np.ndarray,
    conditions: Conditions,
    images: Any = None,
    split: str = "",
    readouts: Collection[str] = READOUTS,
    **how: Any,
) -> Recorded:
    numbers = np.asarray(range(len(photons)) if images is None else images, np.uint64)
    return sensor.expose(photons, conditions, Streams(1, "contract", split, numbers), readouts, **how)


def _lights(sensor: Sensor, images: int) -> Iterator[tuple[str, np.ndarray, Conditions]]:
    """(what it is, photons/s, how it is recorded): no light, little, much, and empty rows among full ones."""
    short = {"exposure": 1e-4, "frames": 10, "frame_time": 8e-6, "frame_period": 1e-5, "bits": 2}
    shape = (images, sensor.layout.pixels)
    yield "in the dark", np.zeros(shape), _conditions(0, **short)
    yield "in dim light", np.full(shape, 1e5), _conditions(1e5, **short)
    yield "in bright light", np.full(shape, 2e7), _conditions(2e7, **short | {"bits": 12, "counting": "counter"})
    rising = np.linspace(0.2, 1.8, images)[:, None]
    yield "with unlit pixels", np.where(np.arange(shape[1]) % 3 == 1, 3e6, 0.0) * rising, _conditions(3e6, **short)


def _columns(part: Any) -> dict[str, np.ndarray]:
    """Every array of a recording, by name."""
    found: dict[str, np.ndarray] = {}
    for name in ("offsets", "times", "ticks") if isinstance(part, Events) else vars(part):
        value = getattr(part, name)
        if isinstance(value, np.ndarray):
            found[name] = value
        elif isinstance(value, Events) or hasattr(value, "__dataclass_fields__"):
            found |= {f"{name}.{below}": array for below, array in _columns(value).items()}
    return found


def _same(one: Recorded, other: Recorded, what: str) -> None:
    a, b = _columns(one), _columns(other)
    assert a.keys() == b.keys(), f"{what}: there is {', '.join(sorted(a.keys() ^ b.keys()))} in one alone"
    for name, x in a.items():
        y = b[name]
        assert (x.dtype, x.shape, x.tobytes()) == (y.dtype, y.shape, y.tobytes()), f"{what}: {name} differs"


# --- the checks: each returns what is to be said besides "kept" ---------------------------------------------------


def _declarations(trial: _Trial) -> None:
    kind = trial.kind
    text = (kind.__doc__ or "").strip()
    assert text.split("\n")[0].endswith("."), "the docstring must begin with one sentence on one line"
    if "Source:" not in text:
        where = f"{source_file(kind)}: the effect {kind.name}"
        trial.warnings.append(f"{where}: its docstring does not say where it is known from; add a line Source: ...")
    have = [all(callable(getattr(kind, hook, None)) for hook in way.split("+")) for way in STAGES[kind.stage]]
    assert any(have), f"it must define {' or '.join(STAGES[kind.stage])}"
    assert not isinstance(kind.moves, str), f"moves is {kind.moves!r}; write moves = ({kind.moves!r},)"
    unknown = sorted(set(kind.moves) - set(BLOCKS))
    assert not unknown, f"moves names {', '.join(unknown)}, but the statistics are {', '.join(BLOCKS)}"
    if kind.after is not None:
        near = did_you_mean(kind.after, Effect.registry)
        assert kind.after in set(Effect.registry), f"after names {kind.after!r}, which is not an effect.{near}"
        other = Effect.registry.find(kind.after).stage
        assert other == kind.stage, f"after names {kind.after}, which is of the stage {other}, and not of {kind.stage}"
    for name, p in kind.parameters.items():
        if p.informed_by:
            near = did_you_mean(p.informed_by, Statistic.registry)
            said = f"informed_by of {name} names {p.informed_by!r}"
            assert p.informed_by in set(Statistic.registry), f"{said}, which is not a statistic that is loaded.{near}"
            teller: type[Statistic] = Statistic.registry.find(p.informed_by)
            tells = teller.unit_likelihood is not Statistic.unit_likelihood
            assert tells, f"{said}, which defines no unit_likelihood"
    for name in trial.values:
        assert name in kind.parameters, f"it has no parameter {name}"
    for name, p in kind.parameters.items():
        assert p.about, f"{name} does not say what it is (about)"
        if p.unit == "bool" or p.choices:
            continue
        for where, one in (("default", p.default), ("off", p.off), *(("search", edge) for edge in p.search or ())):
            try:
                if one is not None:
                    p.check(float(one))
            except ValueError as error:
                raise AssertionError(f"{where} of {name}: {error}") from None
        assert p.search is None or p.search[0] < p.search[1], f"search of {name} ends before it begins: {p.search}"


def _is_looked_for(trial: _Trial) -> str | None:
    """Whether a diagnosis may add it: some parameter says where the effect vanishes, and where it is looked for."""
    declared = trial.kind.parameters.values()
    if any(p.off is not None and (p.search is not None or p.per in ("row", "column", "code")) for p in declared):
        return None
    return "no parameter has both `off` and `search`: diagnose never adds it, though a sensor may have it"


def _bounds(trial: _Trial) -> None:
    kind = trial.kind
    for name, p in kind.parameters.items():
        low, high = p.bounds
        outside: list[Any] = ["no_such_word"] if p.choices or p.unit == "bool" else []
        if low is not None:
            outside.append(low if p.open_bounds else low - max(1e-3, abs(low)))
        if high is not None:
            outside.append(high if p.open_bounds else high + max(1e-3, abs(high)))
        for value in outside:
            written = value if isinstance(value, str) else units.show(value, p.unit, 12)
            raw = document.parse(_BASE, "c.yaml")
            raw.value["sensor"]["effects"][kind.name] = {name: written}
            try:
                config.build(raw, Path())
            except ConfigError as error:
                said = any(f"{kind.name}.{name}" in problem for problem in error.problems)
                assert said, f"the error for {name} = {written} does not name {kind.name}.{name}: {error}"
            else:
                raise AssertionError(f"a config takes {name} = {written}, out of its bounds ({p.allowed()})")


def _off_is_the_identity(trial: _Trial) -> str | None:
    off = {name: p.off for name, p in trial.kind.parameters.items() if p.off is not None}
    if not off:
        return "no value of its parameters switches it off"
    for rules in ("paper", "device"):
        absent, idle = _sensor(None, rules, without=trial.kind.name), _sensor(trial.kind(**trial.values | off), rules)
        images = max(3, idle.block)
        for light, photons, conditions in _lights(idle, images):
            one, other = (_expose(sensor, photons, conditions) for sensor in (absent, idle))
            _same(one, other, f"off ({light}, rules {rules}), it is not as if it were absent")
    return None


def _invariants(trial: _Trial) -> None:
    for rules in ("paper", "device"):
        sensor = trial.sensor(rules)
        images = max(3, sensor.block)
        for light, photons, conditions in _lights(sensor, images):
            _sound(_expose(sensor, photons, conditions), sensor, conditions, f"{light}, rules {rules}")


def _sound(recorded: Recorded, sensor: Sensor, conditions: Conditions, what: str) -> None:
    """Raises AssertionError where a recording is not what it must be."""
    assert recorded.tr is not None and recorded.frames is not None and recorded.frames.first is not None
    # a stamp may be rounded up beyond the end, by half a tick at most
    wrong = recorded.tr.problem(float(np.nextafter(conditions.exposure + sensor.tick / 2, 1)))
    assert wrong is None, f"TR {what}: {wrong}"
    first = recorded.frames.first
    # a row for each stamp: those of a pixel's frames are in no order
    wrong = Events(first.times, np.arange(len(first) + 1), first.pixels).problem(conditions.frame_time)
    assert wrong is None, f"STR {what}: {wrong}"
    bits = recorded.frames.unpacked().sum(axis=1, dtype=int).ravel()
    assert np.array_equal(bits, first.counts), f"{what}: {bits.sum()} bits are set, but there are {len(first)} stamps"
    assert recorded.counts is not None and np.array_equal(recorded.tr.counts, recorded.counts), (
        f"{what}: the counts are not those of the stream"
    )
    tally, shape = recorded.tally, (len(bits), conditions.count_frames)
    assert tally is not None and tally.shape == shape, f"{what}: the counts of frames are not an array of {shape}"
    assert tally.max(initial=0) <= conditions.largest_count, f"{what}: a frame counts {tally.max()} detections"


def _same_stream_same_result(trial: _Trial) -> None:
    for rules in ("paper", "device"):
        sensor = trial.sensor(rules)
        step = sensor.block
        images = np.arange(2 * BLOCK if step > 1 else 4)
        photons, conditions = list(_lights(sensor, len(images)))[-1][1:]
        together = _expose(sensor, photons, conditions, images)
        where = f"rules {rules}: the recording changes"
        _same(_expose(sensor, photons, conditions, images), together, f"{where} when it is made again")
        parts = _expose(sensor, photons, conditions, images, most=100.0)
        _same(parts, together, f"{where} when an image is simulated part by part (rng.before and rng.place tell where)")
        copy = pickle.loads(pickle.dumps(sensor))
        for start in reversed(range(0, len(images), step)):
            part = slice(start, start + step)
            alone = _expose(copy, photons[part], conditions, images[part])
            _same(alone, together.images(start, start + step), f"{where} with the images that are made together")
        known = _columns(_expose(sensor, photons, conditions, images, causes=True))
        for name, column in _columns(together).items():
            assert np.array_equal(known[name], column), f"{where} when causes are asked for: {name} differs"


def _edge_cases(trial: _Trial) -> None:
    area = _base().sensor.layout.pixel_area
    places = np.array([[0, 0], [25e-6, 0], [12e-6, 22e-6], [-13e-6, 22e-6], [90e-6, 7e-6]])
    layouts = (Layout(1, 1, area, 1.0), Layout(2, 3, area, 1.0), Layout(1, len(places), area, 1.0, places))
    for rules, layout in ((rules, layout) for rules in ("paper", "device") for layout in layouts):
        sensor = trial.sensor(rules, layout, lacking=("dark",))
        images = max(2, sensor.block)
        cases = list(_lights(sensor, images))
        one_event = np.zeros_like(cases[0][1])
        one_event[0, 0] = 2e4
        cases.append(("nearly dark", one_event, cases[1][2]))
        if sensor.block == 1:
            cases.append(("without an image", cases[1][1][:0], cases[1][2]))
        for light, photons, conditions in cases:
            what = f"{layout.rows} x {layout.columns} pixels, {light}, rules {rules}"
            _sound(_expose(sensor, photons, conditions), sensor, conditions, what)


def _never_falling(trial: _Trial) -> str | None:
    """A pixel's sensitivity rises, or stays, with the time since its blind time; a number drawn for an event says when
    it is high enough."""
    if not hasattr(trial.kind, "sensitivity"):
        return "it has no sensitivity"
    effect = trial.sensor("device").effect(trial.kind.name)
    assert effect is not None
    times = np.append(0.0, np.geomspace(1e-12, 10.0, 4000))
    found = np.asarray(hooks.call(effect, "sensitivity", times))
    assert found.shape == times.shape, f"sensitivity returns the shape {found.shape} for times {times.shape}"
    assert np.all((found >= 0) & (found <= 1)), "sensitivity returns numbers that are not between 0 and 1"
    falls = np.diff(found) < -1e-9
    at = int(np.argmax(falls))
    assert not falls.any(), (
        f"sensitivity falls from {found[at]:.4g} to {found[at + 1]:.4g} between {units.show(times[at], 's')} and "
        f"{units.show(times[at + 1], 's')}; it must never fall"
    )
    return None


def _hazard(trial: _Trial) -> str | None:
    """What `spawn` does is what `hazard` says, within 5 standard errors and 2 %: some are first orders."""
    if trial.kind.stage != "correlated" or trial.kind.hazard is Effect.hazard:
        return "it has none"
    sensor = trial.sensor("device")
    effect = sensor.effect(trial.kind.name)
    assert effect is not None
    pixels = sensor.layout.pixels
    said = hooks.call(effect, "hazard", pixels)
    if said is None:
        return "it has none at these values"
    chance = np.broadcast_to(-np.expm1(-np.asarray(said[0], np.float64)), pixels)
    assert np.all((chance >= 0) & (chance < 1)), "hazard returns -ln(1 - p) of a p that is not between 0 and 1"
    each = int(np.clip(_CHILDREN / max(float(chance.mean()) * pixels * BLOCK, 1e-9), 1, _MOST_EVENTS / pixels / BLOCK))
    rows = pixels * BLOCK
    times = np.tile(np.arange(each) * 1e-3, rows)
    events = Events(times, np.arange(rows + 1) * each, pixels, end=each * 1e-3)
    streams = Streams(1, "contract", "hazard", np.arange(BLOCK, dtype=np.uint64))
    late, row, parent = hooks.spawned(effect, events, np.zeros(pixels), streams, "")
    assert np.array_equal(row, events.rows[parent]), "it has a hazard, but some of its children are in other pixels"
    assert len(np.unique(parent)) == len(parent), "it has a hazard, but an event has several children"
    wanted = float(chance.sum()) * BLOCK * each
    error = 5 * math.sqrt(max(wanted, 1.0)) + 0.02 * wanted
    assert abs(len(parent) - wanted) <= error, (
        f"of {len(events)} events {len(parent)} have a child, but by hazard it is {wanted:.6g}; hazard returns "
        "-ln(1 - p) and the mean time"
    )
    if len(parent):
        mean, told = float(np.mean(late - events.times[parent])), float(said[1])
        assert abs(mean - told) <= (5 / math.sqrt(len(parent)) + 0.02) * told, (
            f"children come {units.show(mean, 's')} after their parents in the mean, but hazard says "
            f"{units.show(told, 's')}"
        )
    return None


def _influence(trial: _Trial) -> str | None:
    """No event fires a pixel that lies farther away than the effect says. What a readout shares does not show here."""
    if trial.kind.stage != "correlated":
        return "its events fire no others"
    sensor = trial.sensor("device")
    effect = sensor.effect(trial.kind.name)
    assert effect is not None
    _, photons, conditions = list(_lights(sensor, max(3, sensor.block)))[2]
    events = _expose(sensor, photons, conditions, readouts=("tr",), causes=True).tr
    assert events is not None and events.cause is not None and events.parent is not None
    fired = np.flatnonzero((events.cause == sensor.causes.index(effect.cause)) & (events.parent >= 0))
    places = sensor.layout.places[events.pixel]
    far = float(np.hypot(*(places[fired] - places[events.parent[fired]]).T).max(initial=0.0))
    said = effect.influence()
    assert far <= said * (1 + 1e-3), f"an event fires a pixel {far:.3g} pitches away, but influence() is {said:g}"
    return None


def _expected_rate(trial: _Trial) -> str | None:
    """Seen without a dead time or traps of other effects, whose closed forms know nothing of this one.

    Within 5 standard errors and 2 % of the change that the effect makes: some laws are first orders or bounds.
    """
    written = trial.kind.expected_rate is not Effect.expected_rate
    if trial.kind.stage in ("light", "detection", "dark"):
        return _as_applied(trial) if written else "it has none of its own, and needs none: it is apply"
    stated = written or trial.kind.has_mean
    lacking = ("correlated", "dead_time")
    sensor, plain = trial.sensor("device", lacking=lacking), _sensor(None, "device", None, trial.kind.name, lacking)
    for name, (light, _) in _CAPTURES.items():
        photons, conditions = np.full((BLOCK, sensor.layout.pixels), light), _conditions(light)
        counts = _expose(sensor, photons, conditions, split=name, readouts=("tr",)).counts
        assert counts is not None
        seen = counts.reshape(photons.shape).mean(axis=1)
        error = seen.std(ddof=1) / math.sqrt(len(seen))
        told, without = (one.expected(photons[:1], conditions)[1].mean() for one in (sensor, plain))
        if not stated:
            change = seen.mean() / told - 1
            if abs(change) > max(5 * error / told, _UNSTATED):
                return f"it has none, and changes the mean by {change:+.1%}: write it, or fits are less exact"
            continue
        assert abs(seen.mean() - told) <= 5 * error + 0.02 * abs(told - without), (
            f"in the {name} capture a pixel has {seen.mean():.6g} detections (standard error {error:.2g}), but "
            f"expected_rate makes it {told:.6g} (without the effect: {without:.6g}); allowed are 5 standard errors "
            "and 2 % of the change"
        )
    return None if stated else "it has none of its own"


def _as_applied(trial: _Trial) -> str | None:
    """The closed form of an effect on rates is what it does to them, in every pixel."""
    effect = trial.sensor("device").effect(trial.kind.name)
    assert effect is not None
    pixels = _base().sensor.layout.pixels
    for name, (light, _) in _CAPTURES.items():
        before = light * np.linspace(0.5, 1.5, pixels)[None]
        conditions = _conditions(light)
        after, told = (hook(effect, before, conditions) for hook in (hooks.rate, hooks.expected))
        pixel = int(np.argmax(np.abs(told - after)))
        assert np.allclose(told, after, rtol=1e-6), (
            f"in the {name} capture apply makes {after[0, pixel]:.6g}/s of {before[0, pixel]:.6g}/s in pixel {pixel}, "
            f"but expected_rate {told[0, pixel]:.6g}/s; leave it out, or write expected_rate = apply"
        )
    return None


def _moves(trial: _Trial) -> str | None:
    dead_time = _sensor(None, "device", without=trial.kind.name).nominal_dead_time
    scene = trial.kind.of_scene
    one = _statistics(trial.sensor("device"), "with", _REPETITIONS, dead_time, scene)
    other = _reference(trial.replaced, scene)
    trial.moved = {name: signatures.significance(one[name], other[name]) for name in BLOCKS}
    found = ", ".join(f"{name} {z:.1f}" for name, z in trial.moved.items() if abs(z) > STAYED) or "nothing"
    moves = trial.kind.moves
    if not moves:
        return f"no `moves` is declared; it moved {found}"
    z = trial.moved[moves[0]]
    assert abs(z) > MOVED, (
        f"{moves[0]} ({BLOCKS[moves[0]]}) must change, but moved by {z:.1f} standard errors; it moved {found}"
    )
    for name, z in trial.moved.items():
        still = name in moves or abs(z) < STAYED
        assert still, f"{name} ({BLOCKS[name]}) must stay, but moved by {z:.1f} standard errors; it moved {found}"
    return None


_CHECKS: tuple[Callable[[_Trial], str | None], ...] = (
    _declarations,
    _is_looked_for,
    _bounds,
    _off_is_the_identity,
    _invariants,
    _same_stream_same_result,
    _edge_cases,
    _never_falling,
    _hazard,
    _influence,
    _expected_rate,
    _moves,
)
