"""What the hidden-effect challenge hides: the laboratory, effects, set-up faults, and the list of cases.

Difficulty is an oracle's significance Z: that of somebody who knows which effect is there, its shape and its size, but
not the level of the light. Each effect says below how Z follows from the expected numbers of detections; the strength
of the effect is then solved for the Z of its tier. These are signal-to-noise arguments, good to about a third, not
refits of every data set: tiers are wide.
"""

from __future__ import annotations

import copy
import fnmatch
import hashlib
import math
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import ndtri_exp

sys.path.insert(0, str(Path(__file__).parent))
from challenge_generator import Capture, Traps, World, photon_rate

NANOWATT = 1e-5  # W/m^2 in one nW/cm^2
LIGHT_UNCERTAINTY = 0.015
TIERS = {
    "obvious": (25.0, 120.0),
    "clear": (11.0, 18.0),
    "moderate": (6.5, 9.5),
    "faint": (4.2, 5.8),
    "below": (1.0, 2.5),
}


# ---- the laboratory ---------------------------------------------------------------------------------------

FAMILIES: dict[str, dict[str, Any]] = {
    "tr": {
        "side": 16,
        "area": 25.0,
        "fill": 1.0,
        "pdp": {500e-9: 0.42, 700e-9: 0.16},
        "dark": 120.0,
        # name, wavelength, detections/s while alive, exposure
        "captures": [
            ("dark", 0, 0, 2.5),
            ("flat-2k", 500e-9, 2e3, 0.4),
            ("flat-20k", 500e-9, 2e4, 0.05),
            ("flat-250k", 500e-9, 2.5e5, 4e-3),
            ("flat-1M5", 500e-9, 1.5e6, 7e-4),
            ("flat-700nm", 700e-9, 1.2e4, 0.06),
        ],
        # at other levels, and about half as long: what was found is judged by these, which no analysis gets
        "unseen": [("dark", 0, 0, 1.2), ("flat-60k", 500e-9, 6e4, 0.024), ("flat-700k", 500e-9, 7e5, 7e-4)],
    },
    "qis": {
        "side": 32,
        "area": 276.923,
        "fill": 0.13,
        "pdp": {500e-9: 0.444, 700e-9: 0.207},
        "dark": 20.0,
        # ..., frames
        "captures": [
            ("dark", 0, 0, 10_000),
            ("flat-low", 500e-9, 5e3, 8000),
            ("flat-mid", 500e-9, 5e4, 5000),
            ("flat-high", 500e-9, 2e5, 2500),
            ("flat-700nm", 700e-9, 2e4, 5000),
        ],
        "unseen": [("dark", 0, 0, 5000), ("flat-lower", 500e-9, 1.5e4, 3000), ("flat-higher", 500e-9, 1e5, 1500)],
    },
    "str": {
        "side": 16,
        "area": 25.0,
        "fill": 1.0,
        "pdp": {500e-9: 0.42, 700e-9: 0.16},
        "dark": 120.0,
        "captures": [
            ("dark", 0, 0, 5000),
            ("flat-low", 500e-9, 2e4, 5000),
            ("flat-mid", 500e-9, 1e5, 3000),
            ("flat-high", 500e-9, 3e5, 1500),
            ("flat-700nm", 700e-9, 3e4, 3000),
        ],
        "unseen": [("dark", 0, 0, 2500), ("flat-lower", 500e-9, 5e4, 2000), ("flat-higher", 500e-9, 2e5, 1000)],
    },
}
FRAME = 10e-6
AFTERPULSES, LIFETIME, DEAD_TIME, TICK = 0.006, 30e-9, 45e-9, 100e-12


class Lab:
    """One measurement: what the data sheet says, what is there, what the lab noted down and what it really did."""

    def __init__(self, family: str, seed: int, quick: bool = False) -> None:
        kind = FAMILIES[family]
        self.family = family
        self.rng = np.random.default_rng(seed)
        side, area = kind["side"], kind["area"] * 1e-12
        self.effects: dict[str, dict[str, Any]] = {
            "detection": {"pdp": {f"{w * 1e9:.0f} nm": q for w, q in kind["pdp"].items()}},
            "dark_counts": {"rate": f"{kind['dark']:g} Hz"},
        }
        self.layout = {
            "rows": side,
            "columns": side,
            "pixel_area": f"{kind['area']:g} um^2",
            "fill_factor": kind["fill"],
        }
        self.world = World(side, side, area * kind["fill"], dict(kind["pdp"]), dark_rate=kind["dark"])
        if family != "qis":
            self.effects["dead_time"] = {"duration": f"{DEAD_TIME * 1e9:g} ns"}
            self.effects["tdc"] = {"resolution": f"{TICK * 1e12:g} ps"}
            if self.rng.random() < 0.5:  # else there is none, and the data sheet says so
                self.afterpulses(AFTERPULSES)
            self.world.dead_time, self.world.tick = DEAD_TIME, TICK
        self.stated: list[Capture] = []
        for name, wavelength, rate, length in kind["captures"]:
            level = rate * self.rng.uniform(0.8, 1.25) if rate else 0.0
            self.stated.append(self.planned(name, wavelength, level, length / 2 if quick else length))
        self.unseen = [self.planned(*capture) for capture in kind["unseen"]]
        # the power meter: one factor for all captures, as wrong as it says that it is
        scale = self.rng.standard_normal()
        while abs(scale) > 2.5:
            scale = self.rng.standard_normal()
        self.scale = 1 + LIGHT_UNCERTAINTY * scale
        self.real = self.lit_really(self.stated)

    def planned(self, name: str, wavelength: float, level: float, length: float) -> Capture:
        """A capture as the lab notes it down. level: detections/s that the lamp causes."""
        capture = Capture(name, self.family, wavelength=wavelength or 500e-9)
        if level:
            wanted = level / self.world.pdp[wavelength] / photon_rate(1.0, wavelength, self.world.active_area)
            capture.irradiance = float(f"{wanted / NANOWATT:.6g}") * NANOWATT
        if self.family == "tr":
            capture.exposure = length
        else:
            capture.frames, capture.frame_time, capture.frame_period = int(length), FRAME, FRAME
        return capture

    def lit_really(self, stated: list[Capture]) -> list[Capture]:
        real = copy.deepcopy(stated)
        for capture in real:
            capture.irradiance *= self.scale
        return real

    def afterpulses(self, real: float) -> None:
        """The data sheet has afterpulsing; how much there really is."""
        self.effects["afterpulsing"] = {"probability": AFTERPULSES, "lifetime": f"{LIFETIME * 1e9:g} ns"}
        self.world.traps = [Traps(real, LIFETIME, LIFETIME, single=True)]

    @property
    def pixels(self) -> int:
        return self.world.pixels

    @property
    def lit(self) -> list[Capture]:
        return [capture for capture in self.stated if not capture.dark]

    def named(self, name: str) -> Capture:
        return next(capture for capture in self.real if capture.name == name)

    # what the data sheet's sensor is expected to do, per pixel

    def light(self, capture: Capture) -> float:
        q = self.world.pdp[capture.wavelength]
        return photon_rate(capture.irradiance, capture.wavelength, self.world.active_area) * q

    def rate(self, capture: Capture) -> float:
        """Detections/s while the pixel is alive."""
        return self.light(capture) + FAMILIES[self.family]["dark"]

    def share(self, capture: Capture) -> float:
        """Of these, what the lamp causes."""
        return self.light(capture) / self.rate(capture)

    def detections(self, capture: Capture) -> float:
        if self.family == "tr":
            rate = self.rate(capture)
            return capture.exposure * rate / (1 + rate * DEAD_TIME)
        return -capture.frames * math.expm1(-self.rate(capture) * capture.frame_time)

    def weight(self, capture: Capture) -> float:
        """1 / (relative variance of a rate measured in one pixel); detections, where each has its time."""
        if self.family == "qis":
            x = self.rate(capture) * capture.frame_time
            return capture.frames * x**2 / math.expm1(x)
        return self.detections(capture)


@dataclass
class Hidden:
    """What an effect has put into a laboratory."""

    z: float
    argument: str  # for z
    truth: list[dict[str, Any]]
    settings: dict[str, Any]
    parameters: dict[str, float] = field(default_factory=dict)  # `effect.parameter`: value, by the catalogue's own law
    near: dict[str, float] = field(default_factory=dict)  # the same, where the law is another one
    setup: dict[str, Any] | None = None  # the captures and the quantities of which one is to be named


def added(effect: str) -> list[dict[str, Any]]:
    return [{"change": "add", "effect": effect, "parameter": None}]


def changed(change: str, effect: str, parameter: str) -> list[dict[str, Any]]:
    return [{"change": change, "effect": effect, "parameter": parameter}]


UNKNOWN: list[dict[str, Any]] = [{"change": "unknown", "effect": None, "parameter": None}]


# ---- an oracle's significance -----------------------------------------------------------------------------


def gain(background: Any, extra: Any) -> Any:
    """Expected log likelihood ratio of a Poisson number with `extra` against one with the background alone."""
    total = background + extra
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(total > 0, total * np.log(total / background), 0.0) - extra


LAGS = np.geomspace(1e-11, 1e-2, 1500)  # s


def followers(lab: Lab, extra: Any, base: Any = 0.0) -> float:
    """Z of an excess hazard `extra` (1/s, at LAGS) that follows each detection, on the rate and `base`."""
    total = 0.0
    for capture in lab.stated:
        rate = lab.rate(capture)
        per_detection = np.trapezoid(gain(rate + base, extra) * np.exp(-rate * LAGS), LAGS)
        total += 2 * lab.pixels * lab.detections(capture) * per_detection
    return math.sqrt(total)


def band(mean: float, shortest: float, longest: float) -> np.ndarray:
    """Hazard (1/s, at LAGS) of releases from traps with lifetimes between two limits."""
    lifetimes = np.geomspace(shortest, longest, 25)
    return mean * np.mean([np.exp(-LAGS / tau) / tau for tau in lifetimes], axis=0)


def later_frames(lab: Lab, mean: float, lifetimes: Iterable[float]) -> float:
    """Z of releases in later frames: frame k after a detection fires more often than others."""
    taus = np.array(list(lifetimes))
    total = 0.0
    for capture in lab.stated:
        x = lab.rate(capture) * capture.frame_time
        fires, k = -math.expm1(-x), np.arange(60)[:, None]
        ratio = capture.frame_time / taus
        share = ((1 - np.exp(-ratio)) ** 2 / ratio * np.exp(-k * ratio)).mean(axis=1)
        total += 2 * lab.pixels * lab.detections(capture) * float(gain(fires, mean * share * (1 - fires)).sum())
    return math.sqrt(total)


def of_map(noncentrality: float, freedom: int) -> float:
    """Z of a pattern whose shape is not known: chi-squared of many pixels, never better than a known pattern's."""
    return min(math.sqrt(noncentrality), noncentrality / math.sqrt(2 * freedom))


def light_map(lab: Lab, relative: np.ndarray) -> float:
    """Sum over captures and pixels of (relative change / its error)^2, the common level left free."""
    deviation = relative / relative.mean() - 1
    return sum(lab.weight(c) * lab.share(c) ** 2 for c in lab.lit) * float((deviation**2).sum())


def all_lit(lab: Lab, power: float) -> float:
    """Sum over lit captures of detections * share^2 * power: a known swing of the light with this mean square."""
    return sum(lab.pixels * lab.weight(c) * lab.share(c) ** 2 for c in lab.lit) * power


def random_level(length: float, relative: float, hold: float, weight: float) -> float:
    """Square of the Z of a level that jumps at random, its correlation falling as exp(-t / hold).

    relative: variance of the level over its mean's square; weight: detections in so long a time. Nobody knows when it
    jumps: by the likelihood of the powers of its spectrum (Whittle), but for what the mean alone would tell.
    """
    k = np.arange(1, max(50, math.ceil(5 * length / hold)))
    power = relative * weight * 2 * hold / length / (1 + (2 * np.pi * k * hold / length) ** 2)
    return 2 * float((power - np.log1p(power)).sum())


def edge(lab: Lab, width: float) -> float:
    """Z of detections within `width` of the end of the dead time that one model has and the other has not.

    2 per detection; less where the converter's ticks, which blur an interval by about two, are wider.
    """
    found = sum(lab.pixels * lab.detections(c) * lab.rate(c) * width for c in lab.stated)
    return math.sqrt(2 * found * width / (width + 2 * TICK))


# ---- what can be hidden -----------------------------------------------------------------------------------


@dataclass
class Effect:
    hide: Callable[[Lab, float], Hidden]
    families: tuple[str, ...]
    low: float
    high: float
    solved: bool  # is the strength solved for a tier's Z? else it is what it is


EFFECTS: dict[str, Effect] = {}
OUTSIDE: dict[str, Effect] = {}
SETUP: dict[str, Effect] = {}


def hides(
    registry: dict[str, Effect], families: str, low: float = 1.0, high: float = 1.0
) -> Callable[[Callable[[Lab, float], Hidden]], Callable[[Lab, float], Hidden]]:
    def register(hide: Callable[[Lab, float], Hidden]) -> Callable[[Lab, float], Hidden]:
        name = hide.__name__.strip("_").replace("_", "-")
        registry[name] = Effect(hide, tuple(families.split()), low, high, high > low)
        return hide

    return register


@hides(EFFECTS, "tr", 1e-6, 0.2)
def afterpulsing(lab: Lab, x: float) -> Hidden:
    """The data sheet knows none; traps of a band of lifetimes, a Poisson number of releases."""
    middle = float(np.exp(lab.rng.uniform(math.log(20e-9), math.log(120e-9))))
    lab.effects.pop("afterpulsing", None)
    short, long = middle / 1.8, middle * 1.8
    lab.world.traps = [Traps(x, short, long)]
    mean_lifetime = (long - short) / math.log(long / short)
    near = {"afterpulsing.probability": x, "afterpulsing.lifetime": mean_lifetime}
    z = followers(lab, band(x, short, long))
    return Hidden(
        z,
        "intervals: excess hazard of the trap band",
        added("afterpulsing"),
        {"mean": x, "band": [short, long]},
        near=near,
    )


@hides(EFFECTS, "tr", 1e-6, 0.2)
def afterpulsing_set(lab: Lab, x: float) -> Hidden:
    """More afterpulses than the data sheet says, its lifetime right."""
    lab.afterpulses(AFTERPULSES + x)
    z = followers(lab, band(x, LIFETIME, LIFETIME), band(AFTERPULSES, LIFETIME, LIFETIME))
    truth = changed("set", "afterpulsing", "probability")
    value = AFTERPULSES + x
    return Hidden(
        z,
        "intervals: hazard beyond the data sheet's",
        truth,
        {"probability": value},
        {"afterpulsing.probability": value},
    )


@hides(EFFECTS, "tr qis str", 1e-6, 0.5)
def slow_afterpulsing(lab: Lab, x: float) -> Hidden:
    middle = float(np.exp(lab.rng.uniform(math.log(1.5e-6), math.log(12e-6))))
    if lab.family != "tr":
        middle *= 3
    short, long = middle / 1.8, middle * 1.8
    lab.world.traps = [*lab.world.traps, Traps(x, short, long)]
    if lab.family == "tr":
        z, argument = followers(lab, band(x, short, long)), "intervals: excess hazard of the trap band"
    else:
        z, argument = later_frames(lab, x, np.geomspace(short, long, 9)), "frames after a detection fire more often"
    near = {"slow_afterpulsing.probability": x, "slow_afterpulsing.lifetime": (long - short) / math.log(long / short)}
    return Hidden(z, argument, added("slow_afterpulsing"), {"mean": x, "band": [short, long]}, near=near)


@hides(EFFECTS, "tr qis str", 1e-7, 0.05)
def crosstalk(lab: Lab, x: float) -> Hidden:
    """A table of chances with the ratios of a 48-pixel array: diagonals 0.16, two pixels away 0.015 of a neighbour."""
    table = {}
    for dx in range(-2, 3):
        for dy in range(-2, 3):
            ratio = {1: 1.0, 2: 0.16, 4: 0.015}.get(dx * dx + dy * dy)
            if ratio:
                table[dx, dy] = x * ratio
    lab.world.crosstalk = table
    lab.world.crosstalk_delay = float(np.exp(lab.rng.uniform(math.log(0.2e-9), math.log(3e-9))))
    delay = lab.world.crosstalk_delay
    if lab.family == "tr":
        hazard = np.exp(-LAGS / delay) / delay
        z = math.sqrt(sum(followers(lab, chance * hazard) ** 2 for chance in table.values()))
        argument = "pairs of pixels: excess within the delay"
    else:
        total = 0.0
        for c in lab.stated:
            correlation = 2 * np.array(list(table.values())) * math.exp(-lab.rate(c) * c.frame_time)
            total += 0.5 * lab.pixels * c.frames * float((correlation**2).sum())
        z, argument = math.sqrt(total), "pairs of pixels: correlation 2 c exp(-lambda T_f) within a frame"
    return Hidden(
        z,
        argument,
        added("crosstalk"),
        {"side": x, "diagonal": 0.16 * x, "two away": 0.015 * x, "mean delay": delay},
        {"crosstalk.probability": x, "crosstalk.diagonal_ratio": 0.16},
        {"crosstalk.delay": delay},
    )


@hides(EFFECTS, "tr", 1e-12, 25e-9)
def dead_time_set(lab: Lab, x: float) -> Hidden:
    sign = 1 if lab.rng.random() < 0.5 else -1
    lab.world.dead_time = value = DEAD_TIME + sign * x
    z = edge(lab, x)
    return Hidden(
        z,
        "detections in the shifted edge",
        changed("set", "dead_time", "duration"),
        {"duration": value},
        {"dead_time.duration": value},
    )


@hides(EFFECTS, "tr", 1e-12, 12e-9)
def dead_time_spread(lab: Lab, x: float) -> Hidden:
    shift = x * lab.rng.standard_normal(lab.pixels).clip(-3, 3)
    lab.world.dead_time = DEAD_TIME + shift
    z = edge(lab, float(np.abs(shift).mean()))
    return Hidden(
        z, "detections in each pixel's shifted edge", changed("per_pixel", "dead_time", "duration"), {"sigma": x}
    )


@hides(EFFECTS, "tr")
def paralyzable(lab: Lab, x: float) -> Hidden:
    lab.world.paralyzable = True
    # from 1 - exp(-lambda tau_d) to none: a third of its square on the average
    pulls = [lab.pixels * lab.detections(c) * (lab.rate(c) * DEAD_TIME) ** 3 / 3 for c in lab.stated]
    return Hidden(
        math.sqrt(sum(pulls)),
        "deficit behind the edge that ends after one more dead time",
        changed("set", "dead_time", "paralyzable"),
        {"paralyzable": True},
    )


@hides(EFFECTS, "tr", 1e-12, 50e-9)
def slow_recovery(lab: Lab, x: float) -> Hidden:
    lab.world.recharge = x
    total = 0.0
    for c in lab.stated:
        lost = -lab.rate(c) * np.exp(-LAGS / x)
        total += 2 * lab.pixels * lab.detections(c) * np.trapezoid(gain(lab.rate(c), lost), LAGS)
    return Hidden(
        math.sqrt(total * x / (x + 2 * TICK)),
        "hazard lambda (1 - exp) behind the dead time",
        added("slow_recovery"),
        {"recharge": x},
        {"slow_recovery.time_constant": x},
    )


@hides(EFFECTS, "tr", 0.5, 3e4)
def blinking(lab: Lab, x: float) -> Hidden:
    """Several levels: each blinking pixel has two defects, the second half as strong and twice as quick."""
    chosen = lab.rng.choice(lab.pixels, lab.pixels // 12, replace=False)
    on, off = lab.rng.uniform(3, 10), lab.rng.uniform(3, 10)
    lab.world.defects = [(int(p), x * k, on * r, off * r) for p in chosen for k, r in ((1.0, 1.0), (0.5, 2.0))]
    total, up = 0.0, on / (on + off)
    for c in lab.stated:
        for k, r in ((1.0, 1.0), (0.5, 2.0)):
            rate = lab.rate(c) + 1.5 * x * up
            relative = (k * x / rate) ** 2 * up * (1 - up)
            total += len(chosen) * random_level(c.length, relative, 1 / (r * (on + off)), rate * c.length)
    settings = {"pixels": len(chosen), "rate": x, "on": on, "off": off}
    near = {"blinking_dark_counts.amplitude": x, "blinking_dark_counts.fraction": len(chosen) / lab.pixels}
    return Hidden(
        math.sqrt(total),
        "spectra of pixels whose level jumps at random",
        added("blinking_dark_counts"),
        settings,
        near=near,
    )


@hides(EFFECTS, "tr qis str", 1e-4, 0.3)
def pdp_spread(lab: Lab, x: float) -> Hidden:
    factor = 1 + x * lab.rng.standard_normal(lab.pixels).clip(-3, 3)
    lab.world.pdp_factor = factor / factor.mean()
    z = of_map(light_map(lab, factor), lab.pixels - 1)
    return Hidden(z, "chi-squared of the map", changed("per_pixel", "detection", "pdp"), {"sigma": x})


@hides(EFFECTS, "tr qis", 1e-3, 0.95)
def lazy_pixels(lab: Lab, x: float) -> Hidden:
    factor = np.ones(lab.pixels)
    chosen = lab.rng.choice(lab.pixels, max(3, lab.pixels // 40), replace=False)
    factor[chosen] = 1 - x * lab.rng.uniform(0.7, 1.0, chosen.size)
    lab.world.pdp_factor = factor
    z = of_map(light_map(lab, factor), lab.pixels - 1)
    return Hidden(
        z, "chi-squared of the map", changed("per_pixel", "detection", "pdp"), {"pixels": chosen.size, "loss": x}
    )


@hides(EFFECTS, "tr qis", 1e-3, 3.0)
def dark_spread(lab: Lab, x: float) -> Hidden:
    factor = np.exp(x * lab.rng.standard_normal(lab.pixels))
    factor /= factor.mean()  # another mean would be another finding
    lab.world.dark_rate = FAMILIES[lab.family]["dark"] * factor
    expected = lab.detections(lab.stated[0])
    z = of_map(2 * float(gain(expected, expected * (factor - 1)).sum()), lab.pixels - 1)
    return Hidden(z, "deviance of the dark map", changed("per_pixel", "dark_counts", "rate"), {"sigma of log": x})


@hides(EFFECTS, "tr qis", 1e-2, 1e4)
def hot_pixels(lab: Lab, x: float) -> Hidden:
    factor = np.ones(lab.pixels)
    chosen = lab.rng.choice(lab.pixels, max(3, lab.pixels // 50), replace=False)
    factor[chosen] = 1 + x * lab.rng.uniform(0.3, 1.7, chosen.size)
    lab.world.dark_rate = FAMILIES[lab.family]["dark"] * factor
    expected = lab.detections(lab.stated[0])
    z = of_map(2 * float(gain(expected, expected * (factor - 1)).sum()), lab.pixels - 1)
    return Hidden(
        z, "deviance of the dark map", changed("per_pixel", "dark_counts", "rate"), {"pixels": chosen.size, "times": x}
    )


@hides(EFFECTS, "tr qis str", 1e-4, 0.8)
def gradient(lab: Lab, x: float) -> Hidden:
    angle = 2 * math.pi * lab.rng.random()
    along_x, along_y = x * math.cos(angle), x * math.sin(angle)
    w = lab.world
    u = np.linspace(-0.5, 0.5, w.columns)[None, :]
    v = np.linspace(-0.5, 0.5, w.rows)[:, None]
    w.illumination = (1 + along_x * u + along_y * v).ravel()
    z = math.sqrt(light_map(lab, w.illumination))
    parameters = {"illumination_gradient.x": along_x, "illumination_gradient.y": along_y}
    return Hidden(
        z, "a known slope over the map", added("illumination_gradient"), {"x": along_x, "y": along_y}, parameters
    )


@hides(EFFECTS, "tr qis", 1e-4, 0.25)
def rows(lab: Lab, x: float) -> Hidden:
    w = lab.world
    gains = 1 + x * lab.rng.standard_normal(w.rows).clip(-3, 3)
    w.pdp_factor = np.repeat(gains / gains.mean(), w.columns)
    z = of_map(light_map(lab, w.pdp_factor), w.rows - 1)
    return Hidden(z, "chi-squared of the rows", added("row_pattern"), {"sigma": x})


@hides(EFFECTS, "tr qis", 1e-4, 0.25)
def columns(lab: Lab, x: float) -> Hidden:
    w = lab.world
    gains = 1 + x * lab.rng.standard_normal(w.columns).clip(-3, 3)
    w.pdp_factor = np.tile(gains / gains.mean(), w.rows)
    z = of_map(light_map(lab, w.pdp_factor), w.columns - 1)
    return Hidden(z, "chi-squared of the columns", added("column_pattern"), {"sigma": x})


@hides(EFFECTS, "tr qis", 0.1, 5e3)
def background(lab: Lab, x: float) -> Hidden:
    lab.world.stray_rate = x
    # the rates of the lit captures, one free level for all of them within what the power meter says
    weights = np.array([lab.pixels * lab.weight(c) for c in lab.lit])
    signal = np.array([x / lab.rate(c) for c in lab.lit])
    level = float((weights * signal).sum()) / float(weights.sum() + LIGHT_UNCERTAINTY**-2)
    left = float((weights * (signal - level) ** 2).sum()) + (level / LIGHT_UNCERTAINTY) ** 2
    return Hidden(
        math.sqrt(left),
        "levels of the lit captures, their common factor free",
        added("background_light"),
        {"rate": x},
        {"background_light.rate": x},
    )


@hides(EFFECTS, "tr qis str", 1e-4, 0.6)
def flicker(lab: Lab, x: float) -> Hidden:
    lab.world.lamp.swing = x
    lab.world.lamp.frequency = frequency = float(lab.rng.choice([100.0, 120.0, 200.0, 300.0]))
    seen = [lab.pixels * lab.weight(c) * lab.share(c) ** 2 for c in lab.lit if c.length * frequency > 1]
    z = math.sqrt(sum(seen) * x**2 / 2)
    settings = {"swing": x, "frequency": frequency, "second harmonic": 0.1 * x}
    return Hidden(
        z,
        "a known sine in captures of more than a period",
        added("flicker"),
        settings,
        {"flicker.frequency": frequency},
        {"flicker.amplitude": x},
    )


@hides(EFFECTS, "tr qis str", 1e-4, 0.6)
def drift(lab: Lab, x: float) -> Hidden:
    lab.world.lamp.warming = x * (1 if lab.rng.random() < 0.5 else -1)
    t = np.linspace(0, 1, 1001)
    rise = (1 - np.exp(-1.5 * t)) / (1 - math.exp(-1.5))
    z = math.sqrt(all_lit(lab, x**2 * float(rise.var())))
    return Hidden(
        z,
        "a known rise in every lit capture",
        added("source_drift"),
        {"warming": lab.world.lamp.warming},
        near={"source_drift.slope": lab.world.lamp.warming},
    )


@hides(EFFECTS, "tr qis str", 1e-6, 0.3)
def source_noise(lab: Lab, x: float) -> Hidden:
    """A lamp that jumps between levels: its correlation falls as exp(-t / hold), its coherence time is twice that."""
    lab.world.lamp.contrast = x
    lab.world.lamp.hold = hold = float(np.exp(lab.rng.uniform(math.log(40e-6), math.log(400e-6))))
    total = sum(random_level(c.length, x * lab.share(c) ** 2, hold, lab.pixels * lab.weight(c)) for c in lab.lit)
    settings = {"contrast": x, "hold": hold}
    return Hidden(
        math.sqrt(total),
        "spectrum of a level that jumps at random",
        added("source_noise"),
        settings,
        {"source_noise.contrast": math.sqrt(x)},  # the catalogue's is the standard deviation of the level
        {"source_noise.coherence_time": 2 * hold},
    )


@hides(EFFECTS, "tr", 5e-12, 3e-9)
def jitter(lab: Lab, x: float) -> Hidden:
    lab.world.jitter = x
    # the edge is a step of height lambda, smeared by two stamps' jitter: half of a mean |N| on its wrong side
    z = edge(lab, math.sqrt(2) * x / math.sqrt(2 * math.pi))
    return Hidden(z, "detections before the edge of the dead time", added("jitter"), {"sigma": x}, {"jitter.sigma": x})


@hides(EFFECTS, "tr str", 1e-4, 0.5)
def converter(lab: Lab, x: float) -> Hidden:
    widths = np.maximum(1 + x * lab.rng.standard_normal(140), 0.02)
    widths *= 140 / widths.sum()
    lab.world.code_widths = tuple(widths.tolist())
    total = sum(lab.pixels * lab.detections(c) for c in lab.stated) * float(((widths - 1) ** 2).mean())
    return Hidden(of_map(total, 139), "chi-squared of the codes", added("tdc_nonlinearity"), {"sigma": x, "codes": 140})


@hides(EFFECTS, "tr", 0.1e-9, 8e-9)
def bus(lab: Lab, x: float) -> Hidden:
    lab.world.bus_time, lab.world.bus_places = x, 4
    lost = 0.0
    for c in lab.stated:
        n = lab.pixels * lab.detections(c)
        load = min(n / c.length * x, 0.999)
        # M/M/1 with twice the places, about the M/D/1 of a service that always takes the same time
        lost += n * (1 - load) * load**8 / (1 - load**9)
    parameters = {"readout_loss.service_time": x, "readout_loss.queue": 4.0}
    settings = {"service": x, "places": 4}
    return Hidden(math.sqrt(2 * lost), "detections missing behind others", added("readout_loss"), settings, parameters)


@hides(EFFECTS, "qis str", 1e-7, 0.6)
def gate(lab: Lab, x: float) -> Hidden:
    lab.world.live = 1 - x
    weights = lab.pixels * sum(lab.weight(c) for c in lab.lit)
    total = x**2 / (LIGHT_UNCERTAINTY**2 + 1 / weights) + x**2 * lab.pixels * lab.weight(lab.stated[0])
    argument = "level of the lit captures against the power meter, and of the dark one"
    if lab.family == "str":
        for c in lab.stated:
            rate = lab.rate(c) * c.frame_time
            total += 2 * lab.pixels * c.frames * math.exp(-rate * (1 - x)) * -math.expm1(-rate * x)
        argument += "; stamps that are missing at the end of the frame"
    return Hidden(math.sqrt(total), argument, added("short_gate"), {"live": 1 - x}, {"short_gate.fraction": 1 - x})


# ---- what the catalogue does not know ---------------------------------------------------------------------


@hides(OUTSIDE, "tr", 1e-6, 0.2)
def echo(lab: Lab, x: float) -> Hidden:
    lab.world.echo, lab.world.echo_delay = x, float(lab.rng.uniform(120e-9, 400e-9))
    return Hidden(_echo_z(lab, x), "intervals: a line of 1 ns", UNKNOWN, {"chance": x, "delay": lab.world.echo_delay})


@hides(OUTSIDE, "tr", 1e-6, 0.2)
def echo_elsewhere(lab: Lab, x: float) -> Hidden:
    lab.world.echo, lab.world.echo_delay = x, float(lab.rng.uniform(20e-9, 300e-9))
    lab.world.echo_step = int(lab.rng.integers(5 * 16 + 4, 9 * 16))
    settings = {"chance": x, "delay": lab.world.echo_delay, "pixels further on": lab.world.echo_step}
    return Hidden(_echo_z(lab, x), "pairs of far pixels: a line of 1 ns", UNKNOWN, settings)


def _echo_z(lab: Lab, x: float) -> float:
    found = (2 * lab.pixels * lab.detections(c) * gain(lab.rate(c) * 1e-9, x) for c in lab.stated)
    return math.sqrt(float(sum(found)))


@hides(OUTSIDE, "tr qis", 1e-2, 1e5)
def bursts(lab: Lab, x: float) -> Hidden:
    lab.world.bursts, lab.world.burst_size = x, int(lab.rng.integers(8, 20))
    total = 0.0
    for c in lab.stated:
        window = 1e-9 if lab.family == "tr" else c.frame_time
        chance = -math.expm1(-lab.rate(c) * window)  # that such a pixel fires by itself
        total += 2 * x * c.length * lab.world.burst_size * -math.log(chance)
    settings = {"rate": x, "size": lab.world.burst_size}
    number = x * sum(c.length for c in lab.stated)
    return Hidden(_if_any(math.sqrt(total), number), "adjacent pixels at once, by chance or not", UNKNOWN, settings)


def _if_any(z: float, number: float) -> float:
    """The significance of rare things, each of which says much: there may be none, and then nobody sees anything."""
    return min(z, max(0.0, -float(ndtri_exp(-number))))


@hides(OUTSIDE, "tr", 1e-8, 50e-6)
def blanking(lab: Lab, x: float) -> Hidden:
    lab.world.blank_period, lab.world.blank_time = float(lab.rng.uniform(0.3e-3, 1.2e-3)), x
    missing = sum(lab.pixels * lab.detections(c) for c in lab.stated) * x / lab.world.blank_period
    settings = {"period": lab.world.blank_period, "time": x}
    return Hidden(math.sqrt(2 * missing), "detections missing in every period", UNKNOWN, settings)


@hides(OUTSIDE, "tr", 1e-3, 1.0)
def erlang_dead_time(lab: Lab, x: float) -> Hidden:
    """Each blind time is drawn anew; x: its relative standard deviation."""
    lab.world.dead_time_order = order = round(x**-2)
    # half of a mean |N| on the wrong side
    width = DEAD_TIME / math.sqrt(order) / math.sqrt(2 * math.pi)
    return Hidden(edge(lab, width), "detections on the wrong side of the edge", UNKNOWN, {"order": order})


@hides(OUTSIDE, "tr", 1e-5, 0.2)
def droop(lab: Lab, x: float) -> Hidden:
    """The PDP falls with the pixel's own recent rate."""
    lab.world.droop = x
    bright = max(lab.lit, key=lab.rate)
    loss = [x * lab.rate(c) / (1 + lab.rate(c) * DEAD_TIME) * lab.world.droop_memory for c in lab.lit]
    weights = np.array([lab.pixels * lab.weight(c) for c in lab.lit])
    level = float((weights * loss).sum() / weights.sum())
    z = math.sqrt(float((weights * (np.array(loss) - level) ** 2).sum()))
    settings = {"a detection": x, "memory": lab.world.droop_memory, "at": bright.name}
    return Hidden(z, "levels of the lit captures, their common factor free", UNKNOWN, settings)


@hides(OUTSIDE, "qis", 1e-5, 0.1)
def copied_frames(lab: Lab, x: float) -> Hidden:
    lab.world.copied_frames = x
    total = 0.0
    for c in lab.stated:
        fires = -math.expm1(-lab.rate(c) * c.frame_time)
        total += 2 * x * c.frames * lab.pixels * -math.log(fires**2 + (1 - fires) ** 2)
    copies = x * sum(c.frames for c in lab.stated)
    return Hidden(_if_any(math.sqrt(total), copies), "frames equal to the one before", UNKNOWN, {"share": x})


# ---- what is wrong in the laboratory ----------------------------------------------------------------------


@hides(SETUP, "tr qis", 3.0, 20.0)
def light(lab: Lab, x: float) -> Hidden:
    """All lit captures, by x times the power meter's uncertainty."""
    lab.scale = 1 + x * LIGHT_UNCERTAINTY * (1 if lab.rng.random() < 0.5 else -1)
    for stated, real in zip(lab.stated, lab.real, strict=True):
        real.irradiance = stated.irradiance * lab.scale
    setup = {"captures": [c.name for c in lab.lit], "quantities": ["light"], "factor": lab.scale}
    return Hidden(x, "beyond the power meter's uncertainty", [], {"factor": lab.scale}, setup=setup)


@hides(SETUP, "tr qis")
def wavelength(lab: Lab, x: float) -> Hidden:
    """The capture at 700 nm was made with the filter for 500 nm."""
    real = lab.named("flat-700nm")
    before = lab.light(real)
    real.wavelength = 500e-9
    ratio = lab.light(real) / before
    setup = {"captures": ["flat-700nm"], "quantities": ["wavelength", "light"], "factor": ratio}
    return Hidden(abs(ratio - 1) / LIGHT_UNCERTAINTY, "factor on one capture", [], {"really": 500e-9}, setup=setup)


@hides(SETUP, "tr qis", 0.003, 0.3)
def exposure(lab: Lab, x: float) -> Hidden:
    """One capture was shorter than noted down: TR stops early, frames are shorter."""
    name = {"tr": "flat-20k", "qis": "flat-mid"}[lab.family]
    real = lab.named(name)
    if lab.family == "tr":
        real.exposure *= 1 - x
    else:
        real.frame_time *= 1 - x
        real.frame_period = real.frame_time
    stated = next(c for c in lab.stated if c.name == name)
    z = x * math.sqrt(lab.pixels * lab.weight(stated))
    setup = {"captures": [name], "quantities": ["exposure", "light"], "factor": 1 - x}
    return Hidden(z, "level of one capture against the others", [], {"capture": name, "really": 1 - x}, setup=setup)


@hides(SETUP, "tr qis", 0.01, 5000.0)
def leak(lab: Lab, x: float) -> Hidden:
    """Light in the dark capture, x detections/s and pixel."""
    real = lab.named("dark")
    real.leak = x
    # more dark counts would show in the faintest flat as well
    faint = min(lab.lit, key=lab.rate)
    z = x / lab.rate(faint) * math.sqrt(lab.pixels * lab.weight(faint))
    z = min(z, x / FAMILIES[lab.family]["dark"] * math.sqrt(lab.pixels * lab.detections(lab.stated[0])))
    setup = {"captures": ["dark"], "quantities": ["dark"], "factor": 1 + x / FAMILIES[lab.family]["dark"]}
    return Hidden(z, "level of the dark capture against the faintest flat", [], {"leak": x}, setup=setup)


# ---- the list of cases ------------------------------------------------------------------------------------

DOUBLES = [
    ("tr", "afterpulsing", "crosstalk"),
    ("tr", "slow-recovery", "afterpulsing"),  # they cancel in the mean rate
    ("tr", "pdp-spread", "gradient"),
    ("tr", "flicker", "slow-afterpulsing"),
    ("tr", "hot-pixels", "dead-time-set"),
    ("tr", "converter", "source-noise"),
    ("qis", "lazy-pixels", "hot-pixels"),
    ("qis", "crosstalk", "flicker"),
    ("qis", "gate", "columns"),
    ("str", "slow-afterpulsing", "gradient"),
]
QUICK = [
    *("null-tr-1", "null-qis-1", "null-str-1", "tr-afterpulsing-clear", "tr-crosstalk-clear", "tr-pdp-spread-clear"),
    *("tr-flicker-moderate", "tr-dead-time-set-clear", "qis-hot-pixels-clear", "qis-slow-afterpulsing-clear"),
    *("str-gate-clear", "double-tr-afterpulsing-and-crosstalk", "outside-tr-echo-clear", "outside-tr-bursts-clear"),
    *("setup-tr-light-clear", "setup-qis-wavelength"),
]


@dataclass(frozen=True)
class Case:
    name: str
    kind: str  # null, single, double, outside, setup
    family: str
    effects: tuple[str, ...] = ()
    tier: str | None = None


def all_cases(nulls: int = 30) -> list[Case]:
    """Every case there is; `nulls` of them have nothing in them, half of these from the TR array."""
    cases: list[Case] = []
    for number in range(nulls):
        family = ("tr", "qis", "tr", "str")[number % 4]
        known = sum(case.family == family for case in cases)
        cases.append(Case(f"null-{family}-{known + 1}", "null", family))
    for name, effect in EFFECTS.items():
        for family in effect.families:
            tiers: list[str | None] = ["obvious", "clear", "moderate", "faint"] if effect.solved else [None]
            if effect.solved and family == "tr":
                tiers.append("below")
            cases += [Case("-".join(filter(None, (family, name, t))), "single", family, (name,), t) for t in tiers]
    for family, *both in DOUBLES:
        cases.append(Case(f"double-{family}-{'-and-'.join(both)}", "double", family, tuple(both), "clear"))
    for kind, registry in (("outside", OUTSIDE), ("setup", SETUP)):
        for name, effect in registry.items():
            for family in effect.families:
                wanted: list[str | None] = ["obvious", "clear"] if effect.solved else [None]
                if name == "light":
                    wanted = ["five-per-cent", "clear"]
                for t in wanted:
                    cases.append(Case("-".join(filter(None, (kind, family, name, t))), kind, family, (name,), t))
    return cases


def chosen(patterns: Iterable[str], quick: bool, nulls: int) -> list[Case]:
    wanted = list(patterns)
    cases = [case for case in all_cases(nulls) if not quick or case.name in QUICK]
    found = []
    for pattern in wanted:
        hits = [c for c in cases if pattern in ("all", c.kind) or fnmatch.fnmatch(c.name, pattern)]
        if not hits:
            raise SystemExit(f"challenge: no case is called {pattern!r}; `challenge.py list` tells them")
        found += hits
    return list(dict.fromkeys(found))


def own_seed(seed: int, name: str, what: str) -> int:
    """A case is the same whichever others are made with it."""
    return int.from_bytes(hashlib.sha256(f"{seed} {name} {what}".encode()).digest()[:8], "big")


def built(case: Case, seed: int, quick: bool = False) -> tuple[Lab, list[tuple[str, float, Hidden]]]:
    """The laboratory of a case, and what is hidden there: (name, strength, what)."""
    number = own_seed(seed, case.name, "laboratory")
    draw = np.random.default_rng(own_seed(seed, case.name, "strength"))
    registry = {**EFFECTS, **OUTSIDE, **SETUP}
    lab = Lab(case.family, number, quick)
    hidden = []
    for name in case.effects:
        effect, strength = registry[name], 1.0
        if effect.solved:
            low, high = (3.33, 3.34) if case.tier == "five-per-cent" else TIERS[case.tier or "clear"]
            target = float(np.exp(draw.uniform(math.log(low), math.log(high))))
            # always the same draws, scaled: Z grows with the strength
            a, b = math.log(effect.low), math.log(effect.high)
            for _ in range(40):
                middle = (a + b) / 2
                z = effect.hide(Lab(case.family, number, quick), math.exp(middle)).z
                a, b = (middle, b) if z < target else (a, middle)
            strength = math.exp(b)
        hidden.append((name, strength, effect.hide(lab, strength)))
    return lab, hidden
