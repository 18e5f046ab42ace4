"""Dead time that reaches into the next frame."""

from __future__ import annotations

from . import Effect, parameter


class FrameCarryOver(Effect, stage="dead_time"):
    """A pixel that fires near the end of a frame is still blind, for a share of what is left, when the next begins.

    It acts in frames (STR, QIS, counts), under both rules: a pixel with dead time tau_d that fired at t is live again
    at start + share * (t + tau_d - start), start being that of the next frame, if this is later than the start. In
    the paper's frames it is all that there is of a dead time; TR streams have no frames.
    Source: no published number; a dead time is 0.1-1 % of a frame, and the frame's reset may or may not end it.
    """

    moves = ("frames_lag", "first")

    share = parameter(
        1.0,
        "",
        "part of the remaining dead time with which a pixel enters the next frame",
        bounds=(0, 1),
        off=0.0,
        search=(0.05, 1),
    )

    def carried(self) -> float:
        """From 0 (the frame begins with a live pixel) to 1 (the dead time knows no frames)."""
        return float(self.share)
