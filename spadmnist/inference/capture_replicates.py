"""The replicates of one capture, or the error that says why a model cannot be simulated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..errors import SpadError, why


class CannotSimulate(SpadError):
    """A model cannot be simulated. The message is the reason.

    In a list of results it takes the place of the result of its model.
    """

    @classmethod
    def because(cls, error: BaseException) -> CannotSimulate:
        """The error that says why a model cannot be simulated, of any error that was raised.

        It has no traceback, which would hold all that was simulated with it.
        """
        return cls(str(error) if isinstance(error, cls) else why(error))


@dataclass
class CaptureReplicates:
    """The replicates of one capture under a model.

    Attributes:
        numbers: (replicates,) the numbers that seed each of them.
        totals: (replicates,) detections of the whole array that inform the light level (`ReducedCapture.total`).
        values: (replicates, cells) by statistic.
        laws: (law, scale of the cells) by statistic, as in `Summary`.
    """

    numbers: np.ndarray
    totals: np.ndarray
    values: dict[str, np.ndarray]
    laws: dict[str, tuple[str, np.ndarray | None]]

    def first(self, number: int) -> CaptureReplicates:
        """The first `number` replicates, or all of them where there are fewer."""
        values = {name: x[:number] for name, x in self.values.items()}
        return CaptureReplicates(
            numbers=self.numbers[:number], totals=self.totals[:number], values=values, laws=self.laws
        )


def joined(parts: Sequence[CaptureReplicates]) -> CaptureReplicates:
    """Replicates of one capture together: of the statistics that all of them have."""
    names = [name for name in parts[0].values if all(name in part.values for part in parts)]
    return CaptureReplicates(
        numbers=np.concatenate([p.numbers for p in parts]),
        totals=np.concatenate([p.totals for p in parts]),
        values={name: np.concatenate([p.values[name] for p in parts]) for name in names},
        laws={name: parts[0].laws[name] for name in names},
    )
