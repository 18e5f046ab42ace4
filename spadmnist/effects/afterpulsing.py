"""Afterpulsing."""

from __future__ import annotations

from . import parameter
from ._traps import Traps


class Afterpulsing(Traps):
    """An avalanche fills a trap, and its release fires the same pixel again: at most once, an exponential time later.

    The time counts from the end of the dead time. By the paper's rules every event may have an afterpulse, also one
    that the dead time hides; by a device's, recorded ones alone, afterpulses among them.
    Source: Suonsivu et al., Alg. 1 lines 14-18; probability below 1 % (Table 1), lifetimes from a few to thousands
    of ns.
    """

    cause = "afterpulse"
    moves = ("intervals", "edge", "fano", "frames_lag", "level", "dark_level", "first")

    probability = parameter(
        0.005,
        "",
        "chance that an avalanche has an afterpulse",
        symbol="P_ap",
        bounds=(0, 1),
        off=0.0,
        search=(1e-4, 0.2),
        per_pixel=True,
    )
    lifetime = parameter(
        25e-9,
        "s",
        "de-trapping lifetime: mean time to the release, after the dead time",
        symbol="tau_bar",
        bounds=(0, None),
        open_bounds=True,
        search=(5e-9, 500e-9),
    )
