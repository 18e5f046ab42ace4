"""Do the cells of many recordings of one sensor have the law that their statistic claims?"""

from __future__ import annotations

import math

import laws
import numpy as np
from scipy import special

from spadmnist.statistics import _scores as scores


def poisson(values: np.ndarray, least: float = 0.5) -> np.ndarray:
    """Counts (recordings, cells) scatter as Poisson's law says, or less; (recordings, cells) normal scores.

    least: standard deviation of the scores; less than 1 where cells hold a good share of all detections. Cells whose
    mean is known too badly from so many recordings are left out.
    """
    values = values[:, values.sum(axis=0) > 20]
    mean = values.mean(axis=0)
    share = np.random.default_rng(1).random(values.shape)
    # the mean is that of these recordings
    z = scores.poisson_score(values, np.broadcast_to(mean, values.shape), share) * np.sqrt(
        len(values) / (len(values) - 1)
    )
    assert least < z.std() < 1 + laws.z_bound() / np.sqrt(2 * z.size)
    assert np.abs(z).max() < laws.z_bound(laws.FALSE_ALARM / z.size)
    return np.asarray(z)


def normal(values: np.ndarray, mean: float = 0.0, spread: float | None = 1.0) -> None:
    """Scores (recordings, cells) are normal, of this mean and spread; None: of those that each cell shows."""
    n = len(values)
    if spread is None:
        values = (values - values.mean(axis=0)) / values.std(axis=0, ddof=1)
    else:
        for cell in range(values.shape[1]):
            laws.mean_is(values[:, cell], mean, error=1e-9, what=f"cell {cell}")
        if values.size >= 1000:
            laws.variance_is(values, spread**2)
        else:
            bound = laws.z_bound() / math.sqrt(2 * values.size)
            assert abs(math.log(values.std(ddof=1) / spread)) < bound, f"{n} recordings: spread"
    assert np.abs(values).max() < laws.z_bound(laws.FALSE_ALARM / values.size)
    laws.distribution_is(values[:, :: max(1, values.shape[1] // 4)].ravel(), special.ndtr, what=f"{n} recordings")
