"""A new effect of one's own: a file that works at once, to be changed (`spadmnist effects --new NAME`)."""

from __future__ import annotations

import importlib.util
import keyword
import re
import sys
from dataclasses import dataclass
from pathlib import Path

import spadmnist

from .effects import STAGES, Effect
from .errors import InputError, did_you_mean
from .plugins import source_file

STAGE = "dark"  # where nobody says another
_LONGEST = 40  # letters of a name


@dataclass(frozen=True)
class _Example:
    """A small effect of a stage, with one parameter, which vanishes at 0; texts are Python."""

    summary: str
    parameter: str
    default: str
    unit: str
    about: str
    bounds: str
    search: str
    hooks: str
    per_pixel: bool = False
    kind: str = ""


_EXAMPLES = {
    "light": _Example(
        "Part of the light is lost on its way to the pixels, as by a dirty window.",
        *("loss", "0.1", "", "share of the light that is lost", "(0, 1)", "(0.01, 0.9)"),
        '''
    def apply(self, rate, conditions):
        # rate: photons/s that arrive at each pixel, an array (images, pixels); returned: the same behind the window
        return rate * (1 - self.loss)

    def expected_rate(self, rate, conditions):
        """r = (1 - loss) rate."""
        return rate * (1 - self.loss)
''',
        per_pixel=True,
    ),
    "detection": _Example(
        "A photon that would start an avalanche fails to, as where the bias voltage is too low.",
        *("loss", "0.1", "", "chance that a photon is missed", "(0, 1)", "(0.01, 0.9)"),
        '''
    def apply(self, rate, conditions):
        # rate: photons/s or detections/s, an array (images, pixels); returned: detections/s, the same shape
        return rate * (1 - self.loss)

    def expected_rate(self, rate, conditions):
        """r = (1 - loss) rate."""
        return rate * (1 - self.loss)
''',
        per_pixel=True,
    ),
    "dark": _Example(
        "The pixels fire a little more often than they should, light or no light, as with a light leak.",
        *("rate", "50.0", "Hz", "detections that come on top, in each pixel", "(0, None)", "(1.0, 1e5)"),
        '''
    def apply(self, rate, conditions):
        # rate: detections/s, an array (images, pixels); returned: the same with what comes on top
        return rate + self.rate

    def expected_rate(self, rate, conditions):
        """r = rate + added rate."""
        return rate + self.rate
''',
        per_pixel=True,
    ),
    "arrival": _Example(
        "The lamp grows brighter (or fainter) at an even pace during the exposure; the mean stays.",
        *("slope", "0.2", "", "relative change from the beginning to the end", "(-2, 2)", "(0.01, 1.0)"),
        """
    # expected_rate, the mean, need not be written here: it is that of factor over the exposure

    def maximum(self, conditions):
        # the largest factor there is: the sensor draws at this rate, and thins
        return 1 + abs(self.slope) / 2

    def factor(self, t, conditions):
        # t: s since the start of the exposure, an array (events,); returned: a factor on the light for each of them
        return 1 + self.slope * (t / conditions.exposure - 0.5)
""",
    ),
    "gate": _Example(
        "The pixel opens late: it is closed during the first part of each frame.",
        *("closed", "0.1", "", "share of a frame during which the pixel cannot fire", "(0, 1)", "(0.01, 0.9)"),
        '''
    def open(self, t, conditions):
        # t: s since the start of the exposure, an array (events,); returned: for each, can the pixel fire?
        return t % conditions.frame_period >= self.closed * conditions.frame_time

    def expected_rate(self, rate, conditions):
        """r = (1 - closed * frame time / frame period) rate."""
        return rate * (1 - self.closed * conditions.frame_time / conditions.frame_period)
''',
    ),
    "correlated": _Example(
        "An avalanche fires its own pixel once more, with some chance, a little later.",
        *("probability", "0.02", "", "chance that an avalanche causes another one", "(0, 1)", "(1e-4, 0.2)"),
        '''
    def spawn(self, events, rng):
        # events: every avalanche so far, events.times (s) row after row; rng: a numpy Generator of the effect's own
        parent = (rng.random(len(events)) < self.probability).nonzero()[0]
        # s from the end of the dead time, which the sensor adds; it also says which children really happen
        return Children(parent, rng.exponential(20e-9, len(parent)))

    def influence(self):
        # pitches up to which an event matters to other pixels: not at all
        return 0.0

    def expected_rate(self, rate, conditions):
        """r = (1 + probability) rate."""
        return rate * (1 + self.probability)
''',
    ),
    "dead_time": _Example(
        "A pixel cannot fire for a while after each detection, as its supply recovers.",
        *("duration", "100e-9", "s", "time during which the pixel is blind", "(0, None)", "(1e-9, 1e-6)"),
        '''
    def blind_time(self):
        # s after a detection: one value, or one per pixel; where several effects say one, the longest counts
        return self.duration

    def expected_rate(self, rate, conditions):
        """r = rate / (1 + rate * duration)."""
        return rate / (1 + rate * self.duration)
''',
        per_pixel=True,
        kind="edge",
    ),
    "timing": _Example(
        "A detection is seen a random time too early or too late.",
        *("sigma", "100e-12", "s", "standard deviation of the time that is seen", "(0, None)", "(1e-12, 1e-8)"),
        """
    def apply(self, events, rng):
        # events.times: s, an array (events,), those of a pixel in order; rng: a numpy Generator of the effect's own
        if self.sigma == 0:
            return events
        # moved: brings the new times into order again, and into the exposure
        return events.moved(events.times + rng.normal(0.0, self.sigma, len(events)))
""",
    ),
    "readout": _Example(
        "Each detection is lost with the same chance on its way out of the chip.",
        *("loss", "0.05", "", "chance that a detection is lost", "(0, 1)", "(0.01, 0.5)"),
        '''
    def apply(self, events, rng):
        # events: the detections of some images, row after row; rng: a numpy Generator of the effect's own
        return events.keep(rng.random(len(events)) >= self.loss)

    def influence(self):
        # pitches up to which an event matters to other pixels: not at all
        return 0.0

    def expected_rate(self, rate, conditions):
        """r = (1 - loss) rate."""
        return rate * (1 - self.loss)
''',
    ),
}

_FILE = '''\
"""{title}: an effect of your own. Change it; the comments say what each part means."""

from spadmnist import {imports}


class {cls}(Effect, stage="{stage}"):
    """{summary}

    Source: say here where the effect and its numbers are from, and what range is realistic.
    """

    {parameter} = parameter(
        {default},  # what holds where a config says nothing; numbers here are in SI units
        "{unit}",  # {unit_says}
        "{about}",
        bounds={bounds},  # what is possible
        off=0.0,  # where the effect vanishes
        search={search},  # where it is looked for in a measurement
{kind}{per_pixel}    )
{hooks}'''


def text(name: str, stage: str = STAGE) -> str:
    """The file of a new effect. Raises InputError with a sentence for a name or a stage that cannot be."""
    if stage not in STAGES:
        raise InputError(f"{stage!r} is not a stage.{did_you_mean(stage, STAGES)} The stages are {', '.join(STAGES)}")
    example = _EXAMPLES[stage]
    cls = _class_of(name)
    used = {"Effect", "parameter", *re.findall(r"\b[A-Z]\w*(?=\()", example.hooks)}
    imports = sorted(used & set(spadmnist.__all__))
    if cls in imports:
        raise InputError(f"{name}: a class {cls} is what the file itself builds on; choose another name")
    varies = "        per_pixel=True,  # a config may give a map or a distribution over the pixels\n"
    return _FILE.format(
        title=name.replace("_", " ").capitalize(),
        imports=", ".join(imports),
        cls=cls,
        stage=stage,
        unit_says="its unit" if example.unit else 'its unit: "" is a number without one',
        kind=f'        kind="{example.kind}",  # something begins or ends at this time at once\n'
        if example.kind
        else "",
        per_pixel=varies if example.per_pixel else "",
        **{field: getattr(example, field) for field in _TEXTS},
    )


_TEXTS = ("summary", "parameter", "default", "unit", "about", "bounds", "search", "hooks")


def _class_of(name: str) -> str:
    """The name of the class, which must lead back to the effect's."""
    if not re.fullmatch(r"[a-z][a-z0-9]*(_[a-z0-9]+)*", name, re.ASCII) or len(name) > _LONGEST:
        raise InputError(
            f"{name!r} cannot be an effect's name: it is written in small letters with _ between words, such as "
            f"light_leak (at most {_LONGEST} letters)"
        )
    cls = "".join(word.capitalize() for word in name.split("_"))
    if re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", cls).lower() != name:
        raise InputError(
            f"{name!r} cannot be an effect's name: each word begins with a letter, and one of a single letter stands "
            "at the end only; write for example light_leak"
        )
    if keyword.iskeyword(name):
        raise InputError(f"{name!r} cannot be an effect's name: it is a word of Python's own; choose another name")
    if name in Effect.registry:
        place = source_file(Effect.registry.find(name))
        raise InputError(f"{name} is an effect already, in {place}; choose another name")
    if name in sys.stdlib_module_names or importlib.util.find_spec(name) is not None:
        raise InputError(f"{name}.py would hide the Python module {name}; choose another name")
    return cls


def create(name: str, stage: str, folder: Path) -> Path:
    """Write `folder/NAME.py`; nothing is overwritten. Raises InputError with a sentence where that cannot be."""
    path = folder / f"{name}.py"
    if re.fullmatch(r"\w+", name) and (path.exists() or path.is_symlink()):
        raise InputError(f"{path.name} is there already; choose another name, or remove it")
    content = text(name, stage)
    try:
        with open(path, "x", encoding="utf-8") as file:
            file.write(content)
    except OSError as error:
        raise InputError(f"{path.name}: cannot be written here ({error.strerror or error})") from None
    return path
