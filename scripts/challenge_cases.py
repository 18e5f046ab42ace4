"""What the hidden-effect challenge hides: the laboratory, effects, set-up faults, and the list of cases.

Difficulty is Z of `challenge_oracle`: what the best test reaches that knows an effect's family and strength, but not
what chance made of it. Each effect says below how Z follows from the expected numbers of detections; the strength of
the effect is then solved for the Z of its tier. Tiers are wide, for Z is good to about a third.
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

sys.path.insert(0, str(Path(__file__).parent))
import challenge_oracle as oracle
from challenge_generator import Capture, Traps, World, photon_rate
from challenge_oracle import LAGS, band, followers, gain, if_any

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


@hides(EFFECTS, "tr", 1e-3, 3.0)
def lifetime_set(lab: Lab, x: float) -> Hidden:
    """The data sheet's afterpulses, released later or sooner than it says."""
    lab.afterpulses(AFTERPULSES)
    value = LIFETIME * math.exp(x if lab.rng.random() < 0.5 else -x)
    lab.world.traps = [Traps(AFTERPULSES, value, value, single=True)]
    stated = band(AFTERPULSES, LIFETIME, LIFETIME)
    z = followers(lab, band(AFTERPULSES, value, value) - stated, stated)
    truth = changed("set", "afterpulsing", "lifetime")
    return Hidden(
        z, "intervals: hazard unlike the data sheet's", truth, {"lifetime": value}, {"afterpulsing.lifetime": value}
    )


@hides(EFFECTS, "tr qis str", 1e-4, 20.0)
def dark_counts_set(lab: Lab, x: float) -> Hidden:
    """Another dark count rate than the data sheet's in every pixel: a warmer chip, or a cooler one."""
    stated = FAMILIES[lab.family]["dark"]
    ratio = math.exp(x if lab.rng.random() < 0.5 else -x)
    lab.world.dark_rate = lab.world.dark_rate * ratio
    expected = lab.pixels * lab.detections(lab.stated[0])
    z = math.sqrt(2 * float(gain(expected, expected * (ratio - 1))))
    value = {"dark_counts.rate": stated * ratio}
    return Hidden(z, "level of the dark capture", changed("set", "dark_counts", "rate"), {"ratio": ratio}, value)


STATED_CROSSTALK, CROSSTALK_DELAY = 0.002, 0.6e-9  # a side neighbour's chance and the mean delay of a data sheet


@hides(EFFECTS, "tr qis str", 1e-6, 0.05)
def crosstalk_set(lab: Lab, x: float) -> Hidden:
    """More crosstalk than the data sheet says; diagonal neighbours and the delay as it says."""
    stated, real = STATED_CROSSTALK, STATED_CROSSTALK + x
    sheet = {"probability": stated, "diagonal_ratio": 0.16}
    if lab.family != "qis":  # frames have no delays
        sheet["delay"] = f"{CROSSTALK_DELAY * 1e9:g} ns"
    lab.effects["crosstalk"] = sheet
    near = {(dx, dy): 1.0 if dx * dy == 0 else 0.16 for dx in (-1, 0, 1) for dy in (-1, 0, 1) if dx or dy}
    lab.world.crosstalk = {place: real * ratio for place, ratio in near.items()}
    # the law of the delay is the stated one, too: the number alone is wrong
    lab.world.crosstalk_delay, lab.world.crosstalk_order = CROSSTALK_DELAY, 1
    ratios = np.array(list(near.values()))
    if lab.family != "qis":
        hazard = np.exp(-LAGS / CROSSTALK_DELAY) / CROSSTALK_DELAY
        behind = followers if lab.family == "tr" else oracle.first_followers
        z = math.sqrt(sum(behind(lab, x * r * hazard, stated * r * hazard) ** 2 for r in ratios))
    else:
        z = oracle.within_frames(lab, x * ratios)
    truth = changed("set", "crosstalk", "probability")
    return Hidden(
        z, "pairs of pixels: beyond the data sheet's", truth, {"probability": real}, {"crosstalk.probability": real}
    )


@hides(EFFECTS, "tr")
def resolution_set(lab: Lab, x: float) -> Hidden:
    """The converter's steps are coarser than the data sheet says and than the file's ticks."""
    del x
    coarse = int(lab.rng.integers(2, 5))
    lab.world.code_widths = (float(coarse), *[0.0] * (coarse - 1))
    n = sum(lab.pixels * lab.detections(c) for c in lab.stated)
    truth = changed("set", "tdc", "resolution")
    value = {"tdc.resolution": coarse * TICK}
    return Hidden(math.sqrt(2 * n * math.log(coarse)), "ticks that never come", truth, {"ticks": coarse}, value)


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
        z = oracle.later_frames(lab, x, np.geomspace(short, long, 9))
        argument = "frames after a detection fire more often"
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
    if lab.family != "qis":
        hazard = np.exp(-LAGS / delay) / delay
        behind = followers if lab.family == "tr" else oracle.first_followers
        z = math.sqrt(sum(behind(lab, chance * hazard) ** 2 for chance in table.values()))
        argument = "pairs of pixels: excess within the delay"
    else:
        z = oracle.within_frames(lab, np.array(list(table.values())))
        argument = "pairs of pixels: correlation 2 c exp(-lambda T_f) within a frame"
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
    z = oracle.edge(lab, x, TICK)
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
    lab.world.dead_time = lab.world.dead_time + shift
    telling = oracle.edge_detections(lab, np.abs(shift), TICK)
    # what comes too early tells by itself; what is missing, against what another pixel has too much
    twice = np.where(shift < 0, telling, np.log(np.cosh(telling)))
    z = math.sqrt(2 * float(twice.sum()))
    return Hidden(
        z,
        "detections in each pixel's shifted edge, its direction unknown",
        changed("per_pixel", "dead_time", "duration"),
        {"sigma": x},
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
    each, up = 0.0, on / (on + off)
    for c in lab.stated:
        for k, r in ((1.0, 1.0), (0.5, 2.0)):
            rate = lab.rate(c) + 1.5 * x * up
            relative = (k * x / rate) ** 2 * up * (1 - up)
            each += oracle.random_level(c.length, relative, 1 / (r * (on + off)), rate * c.length) / 2
    settings = {"pixels": len(chosen), "rate": x, "on": on, "off": off}
    near = {"blinking_dark_counts.amplitude": x, "blinking_dark_counts.fraction": len(chosen) / lab.pixels}
    return Hidden(
        oracle.some_of(each, len(chosen), lab.pixels),
        "spectra of pixels whose level jumps at random, which is unknown",
        added("blinking_dark_counts"),
        settings,
        near=near,
    )


@hides(EFFECTS, "tr qis str", 1e-4, 0.3)
def pdp_spread(lab: Lab, x: float) -> Hidden:
    factor = 1 + x * lab.rng.standard_normal(lab.pixels).clip(-3, 3)
    factor /= factor.mean()
    lab.world.pdp_factor = lab.world.pdp_factor * factor
    precision = oracle.light_errors(lab)
    z = oracle.normal_pattern(precision * (factor - 1), precision * x)
    return Hidden(z, "likelihood of a normal spread", changed("per_pixel", "detection", "pdp"), {"sigma": x})


LOSSES = np.linspace(0.7, 1.0, 9)  # of lazy pixels, in units of the greatest
EXCESSES = np.linspace(0.3, 1.7, 29)  # of hot pixels, in units of their mean


@hides(EFFECTS, "tr qis", 1e-3, 0.95)
def lazy_pixels(lab: Lab, x: float) -> Hidden:
    factor = np.ones(lab.pixels)
    chosen = lab.rng.choice(lab.pixels, max(3, lab.pixels // 40), replace=False)
    factor[chosen] = 1 - x * lab.rng.uniform(0.7, 1.0, chosen.size)
    lab.world.pdp_factor = lab.world.pdp_factor * factor
    precision, mean = oracle.light_errors(lab), factor.mean()
    values, chances = few(chosen.size, lab.pixels, 1 - x * LOSSES)
    z = oracle.drawn_pattern(precision * (factor / mean - 1), precision * (values / mean - 1), chances)
    return Hidden(
        z,
        "likelihood of a few pixels with a loss",
        changed("per_pixel", "detection", "pdp"),
        {"pixels": chosen.size, "loss": x},
    )


@hides(EFFECTS, "tr qis", 1e-3, 3.0)
def dark_spread(lab: Lab, x: float) -> Hidden:
    factor = np.exp(x * lab.rng.standard_normal(lab.pixels))
    lab.world.dark_rate = lab.world.dark_rate * factor / factor.mean()  # another mean would be another finding
    spread = np.exp(x * oracle.HERMITE - x**2 / 2)
    z = oracle.drawn_counts(lab.detections(lab.stated[0]), factor / factor.mean(), spread, oracle.WEIGHTS)
    return Hidden(
        z, "likelihood of a lognormal spread", changed("per_pixel", "dark_counts", "rate"), {"sigma of log": x}
    )


@hides(EFFECTS, "tr qis", 1e-2, 1e4)
def hot_pixels(lab: Lab, x: float) -> Hidden:
    factor = np.ones(lab.pixels)
    chosen = lab.rng.choice(lab.pixels, max(3, lab.pixels // 50), replace=False)
    factor[chosen] = 1 + x * lab.rng.uniform(0.3, 1.7, chosen.size)
    lab.world.dark_rate = lab.world.dark_rate * factor
    values, chances = few(chosen.size, lab.pixels, 1 + x * EXCESSES)
    z = oracle.drawn_counts(lab.detections(lab.stated[0]), factor, values, chances)
    return Hidden(
        z,
        "likelihood of a few pixels with an excess",
        changed("per_pixel", "dark_counts", "rate"),
        {"pixels": chosen.size, "times": x},
    )


def few(chosen: int, pixels: int, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(factors, their chances) where so many of the pixels have one of the values, the others 1."""
    share = chosen / pixels
    return np.append(values, 1.0), np.append(np.full(values.size, share / values.size), 1 - share)


@hides(EFFECTS, "tr qis str", 1e-4, 0.8)
def gradient(lab: Lab, x: float) -> Hidden:
    angle = 2 * math.pi * lab.rng.random()
    along_x, along_y = x * math.cos(angle), x * math.sin(angle)
    w = lab.world
    u = np.linspace(-0.5, 0.5, w.columns)[None, :]
    v = np.linspace(-0.5, 0.5, w.rows)[:, None]
    falls = (1 + along_x * u + along_y * v).ravel()
    w.illumination = w.illumination * falls
    z = math.sqrt(max(oracle.sine(math.sqrt(oracle.light_map(lab, falls))), 0.0))  # its angle is a phase
    parameters = {"illumination_gradient.x": along_x, "illumination_gradient.y": along_y}
    return Hidden(
        z,
        "a known slope over the map, in any direction",
        added("illumination_gradient"),
        {"x": along_x, "y": along_y},
        parameters,
    )


@hides(EFFECTS, "tr qis", 1e-4, 0.25)
def rows(lab: Lab, x: float) -> Hidden:
    w = lab.world
    gains = 1 + x * lab.rng.standard_normal(w.rows).clip(-3, 3)
    gains /= gains.mean()
    w.pdp_factor = w.pdp_factor * np.repeat(gains, w.columns)
    precision = oracle.light_errors(lab) * math.sqrt(w.columns)
    z = oracle.normal_pattern(precision * (gains - 1), precision * x)
    return Hidden(z, "likelihood of a normal spread of the rows", added("row_pattern"), {"sigma": x})


@hides(EFFECTS, "tr qis", 1e-4, 0.25)
def columns(lab: Lab, x: float) -> Hidden:
    w = lab.world
    gains = 1 + x * lab.rng.standard_normal(w.columns).clip(-3, 3)
    gains /= gains.mean()
    w.pdp_factor = w.pdp_factor * np.tile(gains, w.rows)
    precision = oracle.light_errors(lab) * math.sqrt(w.rows)
    z = oracle.normal_pattern(precision * (gains - 1), precision * x)
    return Hidden(z, "likelihood of a normal spread of the columns", added("column_pattern"), {"sigma": x})


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
    z = math.sqrt(sum(oracle.sine(x * math.sqrt(weight / 2)) for weight in seen))
    settings = {"swing": x, "frequency": frequency, "second harmonic": 0.1 * x}
    return Hidden(
        z,
        "a sine of known frequency in captures of more than a period",
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
    z = math.sqrt(max(oracle.either_sign(math.sqrt(oracle.all_lit(lab, x**2 * float(rise.var())))), 0.0))
    return Hidden(
        z,
        "a known rise or fall in every lit capture",
        added("source_drift"),
        {"warming": lab.world.lamp.warming},
        near={"source_drift.slope": lab.world.lamp.warming},
    )


@hides(EFFECTS, "tr qis str", 1e-6, 0.3)
def source_noise(lab: Lab, x: float) -> Hidden:
    """A lamp that jumps between levels: its correlation falls as exp(-t / hold), its coherence time is twice that."""
    lab.world.lamp.contrast = x
    lab.world.lamp.hold = hold = float(np.exp(lab.rng.uniform(math.log(40e-6), math.log(400e-6))))
    total = sum(oracle.random_level(c.length, x * lab.share(c) ** 2, hold, lab.pixels * lab.weight(c)) for c in lab.lit)
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
    z = oracle.edge(lab, math.sqrt(2) * x / math.sqrt(2 * math.pi), TICK)
    return Hidden(z, "detections before the edge of the dead time", added("jitter"), {"sigma": x}, {"jitter.sigma": x})


@hides(EFFECTS, "tr str", 1e-4, 0.5)
def converter(lab: Lab, x: float) -> Hidden:
    widths = np.maximum(1 + x * lab.rng.standard_normal(140), 0.02)
    widths *= 140 / widths.sum()
    lab.world.code_widths = tuple(widths.tolist())
    precision = math.sqrt(sum(lab.pixels * lab.detections(c) for c in lab.stated) / widths.size)
    z = oracle.normal_pattern(precision * (widths - 1), precision * x)
    settings = {"sigma": x, "codes": 140}
    return Hidden(z, "likelihood of a normal spread of the codes", added("tdc_nonlinearity"), settings)


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
    return Hidden(if_any(math.sqrt(total), number), "adjacent pixels at once, by chance or not", UNKNOWN, settings)


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
    return Hidden(oracle.edge(lab, width, TICK), "detections on the wrong side of the edge", UNKNOWN, {"order": order})


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
    return Hidden(if_any(math.sqrt(total), copies), "frames equal to the one before", UNKNOWN, {"share": x})


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
TRIPLES = [
    ("tr", "afterpulsing", "crosstalk", "hot-pixels"),
    ("tr", "gradient", "dead-time-set", "slow-afterpulsing"),
    ("tr", "converter", "pdp-spread", "flicker"),
    ("tr", "dark-counts-set", "crosstalk-set", "drift"),
    ("qis", "lazy-pixels", "crosstalk", "gate"),
    ("qis", "hot-pixels", "gradient", "slow-afterpulsing"),
    ("str", "converter", "gradient", "crosstalk"),
    ("str", "pdp-spread", "gate", "flicker"),
]
# A real camera lacks many things at once: five or six of these that its kind can have, in random company.
CAMERA = (
    *("gradient", "pdp-spread", "hot-pixels", "lazy-pixels", "crosstalk", "slow-afterpulsing", "dead-time-set"),
    *("converter", "flicker"),
)
CAMERAS = 8  # of each family
QUICK = [
    *("null-tr-1", "null-qis-1", "null-str-1", "tr-afterpulsing-clear", "tr-crosstalk-clear", "tr-pdp-spread-clear"),
    *("tr-flicker-moderate", "tr-dead-time-set-clear", "qis-hot-pixels-clear", "qis-slow-afterpulsing-clear"),
    *("str-gate-clear", "double-tr-afterpulsing-and-crosstalk", "outside-tr-echo-clear", "outside-tr-bursts-clear"),
    *("setup-tr-light-clear", "setup-qis-wavelength"),
]


@dataclass(frozen=True)
class Case:
    name: str
    kind: str  # null, single, double, triple, camera, outside, setup
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
    for kind, listed in (("double", DOUBLES), ("triple", TRIPLES)):
        for family, *names in listed:
            cases.append(Case(f"{kind}-{family}-{'-and-'.join(names)}", kind, family, tuple(names), "clear"))
    for family in FAMILIES:
        cases += [Case(f"camera-{family}-{number + 1}", "camera", family) for number in range(CAMERAS)]
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
    for name, tier in company(case, draw):
        effect, strength = registry[name], 1.0
        if effect.solved:
            low, high = (3.33, 3.34) if tier == "five-per-cent" else TIERS[tier or "clear"]
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


def company(case: Case, draw: np.random.Generator) -> list[tuple[str, str | None]]:
    """The effects of a case and the tier of each."""
    if case.kind != "camera":
        return [(name, case.tier) for name in case.effects]
    able = [name for name in CAMERA if case.family in EFFECTS[name].families]
    many = int(draw.integers(5, 7))
    return [(able[k], str(draw.choice(["obvious", "clear"]))) for k in sorted(draw.permutation(len(able))[:many])]
