"""What several families ask of a recording: has it data, how many slots do detections fill, where are the stamps."""

from __future__ import annotations

import numpy as np

from ..recording import Recording


def has_data(recording: Recording) -> bool:
    """False where a capture is known by its mean alone."""
    return recording.events is not None or recording.n_frames > 0


def slots_of_frame(recording: Recording) -> float:
    """How many detections a pixel can have in a frame at most, each independent of the others; inf for counters."""
    if recording.modality in ("qis", "str"):
        return 1.0
    if recording.modality == "counts" and recording.conditions.counting == "frames":
        return float(recording.conditions.largest_count)
    return np.inf


def stamps(recording: Recording) -> tuple[np.ndarray, float]:
    """(stamps of all events, their unit in s): whole ticks where there is a converter."""
    assert recording.events is not None
    return recording.events.stamps
