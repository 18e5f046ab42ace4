"""Dead time that reaches into the next frame."""

from __future__ import annotations

from . import Effect, parameter


class FrameCarryOver(Effect, stage="dead_time"):
    """A pixel enters the next frame with a share of its remaining dead time.

    The effect acts in binary frames (STR, QIS and their sums) under both rules. A counter is not begun anew by a frame:
    all of its dead time reaches into the next one. A pixel with dead time tau_d that fired at t is live
    again at start + share * (t + tau_d - start), where start is the start of the next frame. Under `rules: paper`
    frames have no other dead time. TR streams have no frames.
    Source: no published number; a dead time is 0.1-1 % of a frame, and the frame's reset may or may not end it.
    """

    by_pixel = True
    moves = ("frames_lag", "first")

    share = parameter(
        1.0,
        "",
        "share of the remaining dead time with which a pixel enters the next frame",
        bounds=(0, 1),
        off=0.0,
        search=(0.05, 1),
    )

    def carried(self) -> float:
        """From 0 (the frame begins with a live pixel) to 1 (the dead time knows no frames)."""
        return float(self.share)
