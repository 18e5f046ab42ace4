"""Slow afterpulsing."""

from __future__ import annotations

from . import parameter
from ._traps import Traps


class SlowAfterpulsing(Traps):
    """A second population of traps with a longer lifetime.

    An avalanche fills a slow trap with `probability`, independently of the fast ones, and its release fires the same
    pixel again. Slow traps outlive frames; fast ones rarely do. Under `rules: paper` every event may have such a
    release. Under `rules: device` only recorded detections do, afterpulses among them.
    Source: the spread of release times over decades, which several lifetimes fit: Horoshko et al., arXiv 1409.6752; no
    published number for this population alone. Taken as realistic: 0.01-5 %, 500 ns to 100 us.
    """

    cause = "slow_afterpulse"
    moves = ("fano", "intervals", "autocorrelation", "frames_lag", "level", "dark_level")

    probability = parameter(
        0.002,
        "",
        "probability that an avalanche has a slow afterpulse",
        symbol="P_slow",
        bounds=(0, 1),
        off=0.0,
        search=(1e-4, 0.2),
    )
    lifetime = parameter(
        5e-6,
        "s",
        "de-trapping lifetime: mean delay of the release after the dead time",
        symbol="tau_slow",
        bounds=(0, None),
        open_bounds=True,
        search=(500e-9, 100e-6),
    )
