"""The parts of a config or of a sensor file are read: a mistake is noted with its place, and the rest is read on."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from .. import document, plugins, reconstruct, units
from ..document import Path_
from ..effects import Conditions, Effect, in_order
from ..errors import ConfigError, EffectError, InputError, SpadError, did_you_mean
from ..events import MOST_PIXELS, Layout
from ..experiment import Level
from ..positions import read_positions
from ..readout import no_detection, unsigned_for
from ..reconstruct import Method
from ..sensor import Sensor
from ..validated import Reader, brief
from ._sections import _EXAMPLES, _Layout, _Recording, _Scene, _Sensor


class _Reader(Reader):
    """Reads the parts of one file, a config or a sensor."""

    examples: ClassVar[Mapping[str, str]] = _EXAMPLES

    # --- scene and recording --------------------------------------------------------------------------------------

    def levels(self, scene: _Scene) -> tuple[Level, ...]:
        if (scene.lux is None) == (scene.irradiance is None):
            self.say(
                ("scene",),
                "give the light levels once, as lux: [5 mlux, ...] or as irradiance: [120 nW/cm^2, ...]",
            )
            return ()
        kind = "lux" if scene.lux is not None else "irradiance"
        levels: list[Level] = []
        seen: dict[float | str, int] = {}  # by value and by folder
        for i, value in enumerate(scene.lux or scene.irradiance or []):
            level = Level(value.text, kind, float(value))
            levels.append(level)
            known = levels[min(seen.setdefault(level.value, i), seen.setdefault(level.folder, i))]
            if known is not level:
                self.say(("scene", kind, i), f"{level.text} is the level {known.text} again; list it once")
        return tuple(levels)

    def conditions(self, recording: _Recording, scene: _Scene | None) -> Conditions | None:
        r = recording
        for i, name in enumerate(r.readouts):
            if name in r.readouts[:i]:
                self.say(("recording", "readouts", i), f"{name} is listed twice; keep one")
        framed = sorted({"str", "qis", "counts"} & set(r.readouts))
        if framed and (r.frames is None or r.frame_time is None):
            missing = " and ".join(k for k in ("frames", "frame_time") if getattr(r, k) is None)
            self.say(("recording",), f"{' and '.join(framed)} need{'s' * (len(framed) == 1)} {missing}")
            return None
        frames = r.frames or 1
        frame_time = float(r.frame_time or r.frame_period or r.exposure / frames)
        period = float(r.frame_period or frame_time)
        if frame_time > period * (1 + 1e-12):
            self.say(
                ("recording", "frame_time"),
                f"a frame of {units.show(frame_time, 's')} does not fit into the frame period of "
                f"{units.show(period, 's')}; shorten it or lengthen frame_period",
            )
        if abs(frames * period - r.exposure) > 1e-9 * r.exposure:
            self.say(
                ("recording", "exposure"),
                f"the exposure is frames x frame_period, here {frames} x {units.show(period, 's')} = "
                f"{units.show(frames * period, 's')}, but {r.exposure} is written; correct one of them",
            )
        wavelength = float(scene.wavelengths[0]) if scene else None
        bits, counting = self.counting(r, frames)
        return Conditions(float(r.exposure), frames, frame_time, period, wavelength, bits, counting)

    def counting(self, recording: _Recording, frames: int) -> tuple[int, str]:
        """(bits, what a count is) of the readout `counts`."""
        r = recording
        counting = r.counting or "frames"
        if "counts" not in r.readouts:
            for name in ("bits", "counting"):
                if getattr(r, name) is not None:
                    self.say(("recording", name), "belongs to the readout counts; add it to readouts, or take this out")
            return 0, counting
        if r.bits is None:
            self.say(("recording",), "counts needs bits; write for example bits: 8")
            return 0, counting
        each = 2**r.bits - 1
        if counting == "frames" and frames % each:
            below, above = frames // each * each, -(-frames // each) * each
            near = " or ".join(str(n) for n in (below, above) if n)
            self.say(
                ("recording", "frames"),
                f"{frames} binary frames do not fill whole count frames of {r.bits} bits, each the sum of {each} of "
                f"them; take {near}, or counting: counter",
            )
        return r.bits, counting

    def methods(self, names: list[str] | None, recording: _Recording) -> tuple[str, ...]:
        recorded = set(recording.readouts)
        if names is None:
            return tuple(m for m in Method.registry if set(reconstruct.find(m).readouts()) <= recorded)
        for i, name in enumerate(names):
            try:
                lacking = sorted(set(reconstruct.find(name).readouts()) - recorded)
            except KeyError as error:
                self.say(("reconstruct", i), error.args[0])
                continue
            if lacking:
                what = ", ".join(lacking)
                self.say(("reconstruct", i), f"{name} needs {what}, which recording.readouts lacks; add it there")
            if name in names[:i]:
                self.say(("reconstruct", i), f"{name} is listed twice; keep one")
        return tuple(names)

    # --- sensor ---------------------------------------------------------------------------------------------------

    def sensor(self, raw: Any, wavelengths: Sequence[float]) -> _Described | None:
        """The sensor, from the mapping itself or from the file that it names."""
        if not isinstance(raw, str):
            return self.described(raw, ("sensor",), wavelengths)
        try:
            found = document.read(self.base / raw)
        except ConfigError as error:
            self.problems.extend(error.problems)
            return None
        except InputError as error:
            self.say(("sensor",), str(error))
            return None
        inner = _Reader(found, (self.base / raw).resolve().parent, self.problems)
        if not (isinstance(found.value, Mapping) and "sensor" in found.value):
            return inner.described(found.value, (), wavelengths)
        for key in found.value:
            if key != "sensor":
                inner.problems.append(f"{found.place((key,))} is not an entry of a sensor file; it holds sensor: alone")
        return inner.described(found.value["sensor"], ("sensor",), wavelengths)

    def described(self, raw: Any, path: Path_, wavelengths: Sequence[float]) -> _Described | None:
        """The sensor at `path` with all maps and distributions resolved; None after its mistakes were noted.

        wavelengths: of the scene, m, where they are known: tables are looked up there.
        """
        if not isinstance(raw, Mapping):
            self.say(path, f"{brief(raw)} is neither a sensor file's name nor a sensor")
            return None
        model = self.valid(_Sensor, raw, path)
        whole = self.check_array(raw.get("layout"), (*path, "layout"))
        listed = raw.get("effects")
        effects = []
        for name, values in listed.items() if isinstance(listed, Mapping) else ():
            effect = self.effect(name, values, (*path, "effects", name))
            if effect is not None:
                effects.append(effect)
                self.check_tables(effect, wavelengths, (*path, "effects", name))
        layout = self.layout(model.layout, (*path, "layout")) if model is not None and whole else None
        if model is None or layout is None:
            return None
        sensor = Sensor(layout, in_order(effects), model.rules, model.chip_seed, model.name)
        resolved = self.resolved(sensor, path)
        return _Described(sensor, resolved, model, dict(listed or {}), self, path)

    def check_array(self, raw: Any, path: Path_) -> bool:
        """Does a layout say once where its pixels are: by rows and columns, or by positions?"""
        if not isinstance(raw, Mapping):
            return False
        lacking = [name for name in ("rows", "columns") if raw.get(name) is None]
        if raw.get("positions") is not None:
            if len(lacking) < 2:
                self.say(path, "positions stand instead of rows and columns; keep the one or the other")
            return len(lacking) == 2
        if len(lacking) == 2:
            example = f"{_EXAMPLES['rows']}, {_EXAMPLES['columns']}, or positions: FILE.csv (x, y in um)"
            self.say(path, f"rows is missing, and so is columns; write for example {example}")
        elif lacking:
            self.say(path, self.missing(lacking[0]))
        return not lacking

    def layout(self, model: _Layout, path: Path_) -> Layout | None:
        area, share = float(model.pixel_area), float(model.fill_factor)
        if model.positions is None:
            assert model.rows is not None and model.columns is not None
            if model.rows * model.columns > MOST_PIXELS:
                size = f"{model.rows} x {model.columns} pixels"
                self.say(path, f"{size} are more than the {MOST_PIXELS:,} that can be simulated; give fewer")
                return None
            return Layout(model.rows, model.columns, area, share)
        try:
            positions = read_positions(self.base / model.positions)
        except InputError as error:
            self.say((*path, "positions"), str(error))
            return None
        return Layout(1, len(positions), area, share, positions)

    def effect(self, name: Any, values: Any, path: Path_) -> Effect | None:
        try:
            kind = Effect.registry.find(str(name))
        except KeyError as error:
            self.problems.append(f"{self.source.place(path)} {error.args[0].removeprefix(f'{name} ')}")
            return None
        values = {} if values is None else values
        if not isinstance(values, Mapping):
            self.say(path, f"{brief(values)} is not a group of parameters such as {{rate: 100 Hz}}")
            return None
        read: dict[str, Any] = {}
        before = len(self.problems)
        for key, raw in values.items():
            declared = kind.parameters.get(key)
            if declared is None:
                self.problems.append(
                    f"{self.source.place((*path, key))} is not a parameter of {kind.name}."
                    f"{did_you_mean(str(key), kind.parameters)} It has {', '.join(kind.parameters) or 'none'}"
                )
                continue

            meant = did_you_mean(str(raw), declared.choices)

            def problem(below: Path_, sentence: str, key: Any = key, meant: str = meant) -> None:
                self.say((*path, key, *below), f"{sentence}.{meant}" if meant else sentence)

            read[key] = plugins.read_value(declared, raw, self.base, problem)
        for key, declared in kind.parameters.items():
            if declared.required and key not in read:
                self.say(path, f"{kind.name} needs {key} ({declared.about})")
        return kind(**read) if len(self.problems) == before else None

    def check_tables(self, effect: Effect, wavelengths: Sequence[float], path: Path_) -> None:
        for key, wavelength in itertools.product(effect.parameters, wavelengths):
            value = getattr(effect, key)
            if isinstance(value, plugins.ByWavelength):
                try:
                    value.at(wavelength)
                except InputError as error:
                    self.say((*path, key), str(error))

    def resolved(self, sensor: Sensor, path: Path_) -> Sensor | None:
        """Every map read and every distribution drawn."""
        before = len(self.problems)
        for effect in sensor.effects:
            for key in effect.parameters:
                try:
                    sensor.resolve(effect, key)
                except InputError as error:
                    self.say((*path, "effects", effect.name, key), str(error))
        if len(self.problems) > before:
            return None
        try:
            made = sensor.resolved()
            self.check_cascade(made, path)
        except SpadError as error:  # of an effect that looks at what it was given, as its chip is made
            named = error.plugin if isinstance(error, EffectError) else ""
            self.say((*path, "effects", *([named] if named else [])), str(error))
        return made if len(self.problems) == before else None

    def check_cascade(self, sensor: Sensor, path: Path_) -> None:
        """By a device's rules what an event causes has causes of its own: on average it must be less than one."""
        caused = sensor.caused()
        total = sum(caused.values())
        if sensor.rules == "device" and total >= 1:
            most = max(caused, key=lambda name: caused[name])
            self.say(
                (*path, "effects", most),
                f"{total:.3g} further events come of each one ({', '.join(caused)}), so that a cascade never ends; by "
                "the rules device they must be less than 1: lower the probability",
            )


@dataclass
class _Described:
    """A sensor (resolved: where that went well) and what its file says: the model, the effects as written, and where
    to report mistakes.
    """

    sensor: Sensor
    resolved: Sensor | None
    model: _Sensor
    written: dict[str, Any]
    reader: _Reader
    path: Path_

    def check_clock(self, conditions: Conditions, readouts: list[Any], wavelengths: Sequence[float]) -> None:
        """What can only be said of sensor and recording together."""
        # a table that does not reach the wavelength has been told already
        with contextlib.suppress(InputError):
            if self.resolved and min(map(self.resolved.nominal_pdp, wavelengths)) <= 0:
                pdp = (*self.path, "effects", "detection", "pdp")
                self.reader.say(pdp, "is 0, so that no flux can be estimated; it must be more than 0")
        try:
            tick = (self.resolved or self.sensor).tick
        except SpadError:
            if self.resolved:
                raise
            return  # what keeps the sensor from being resolved has been told
        if tick <= 0:
            return
        converter = self.sensor.at("timing")[-1]
        resolution = (*self.path, "effects", converter.name, next(iter(converter.parameters), ""))
        try:
            unsigned_for(conditions.exposure / tick, "TR stamps")
        except SpadError as error:
            self.reader.say(resolution, str(error))
        if "str" in readouts and no_detection(conditions.frame_time, tick) < 2:
            self.reader.say(
                resolution,
                f"{units.show(tick, 's')} is not finer than the frame time of "
                f"{units.show(conditions.frame_time, 's')}, so that STR could say nothing; take a finer one",
            )
