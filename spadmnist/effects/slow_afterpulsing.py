"""Slow afterpulsing."""

from __future__ import annotations

from . import parameter
from ._traps import Traps


class SlowAfterpulsing(Traps):
    """A second population of traps, which hold for microseconds: the law of afterpulsing with a longer lifetime.

    An avalanche fills one of these with `probability`, whatever it does to others, and the release fires the same
    pixel again. It is what shows in frames, which the faster ones seldom outlive. By the paper's rules every event
    may have such a child; by a device's, recorded ones alone, afterpulses among them.
    Source: the spread of release times over decades, which several lifetimes fit: Horoshko et al., arXiv 1409.6752;
    no published number for this population alone. Taken as realistic: 0.01-5 %, 500 ns to 100 us.
    """

    cause = "slow_afterpulse"
    moves = ("fano", "intervals", "autocorrelation", "frames_lag", "level", "dark_level")

    probability = parameter(
        0.002,
        "",
        "chance that an avalanche has a slow afterpulse",
        symbol="P_slow",
        bounds=(0, 1),
        off=0.0,
        search=(1e-4, 0.2),
    )
    lifetime = parameter(
        5e-6,
        "s",
        "de-trapping lifetime: mean time to the release, after the dead time",
        symbol="tau_slow",
        bounds=(0, None),
        open_bounds=True,
        search=(500e-9, 100e-6),
    )
