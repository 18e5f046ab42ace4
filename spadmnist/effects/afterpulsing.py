"""Afterpulsing."""

from __future__ import annotations

from . import parameter
from ._traps import Traps


class Afterpulsing(Traps):
    """An avalanche fills a trap, whose release fires the same pixel again.

    An avalanche has at most one afterpulse. The delay is exponential and counts from the end of the dead time. Under
    `rules: paper` every event may have an afterpulse, one that the dead time hides as well. Under `rules: device` only
    recorded detections do, afterpulses among them.
    Source: Suonsivu et al., Alg. 1 lines 14-18; probability below 1 % (Table 1), lifetimes from a few to thousands of
    ns.
    """

    cause = "afterpulse"
    moves = ("intervals", "edge", "fano", "frames_lag", "level", "dark_level", "first")

    probability = parameter(
        0.005,
        "",
        "probability that an avalanche has an afterpulse",
        symbol="P_ap",
        bounds=(0, 1),
        off=0.0,
        search=(1e-4, 0.2),
        per_pixel=True,
    )
    lifetime = parameter(
        25e-9,
        "s",
        "de-trapping lifetime: mean delay of the release after the dead time",
        symbol="tau_bar",
        bounds=(0, None),
        open_bounds=True,
        search=(5e-9, 500e-9),
    )
