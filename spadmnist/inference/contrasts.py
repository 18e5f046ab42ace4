"""Contrasts: patterns of all cells of a statistic that are tested by themselves, as a drift over the blocks of time.

A deviation that is spread over all cells is lost in the sum of their squares. Its score along the pattern is one
number.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats


@dataclass(frozen=True)
class Contrast:
    """The clearest contrast of residuals.

    Attributes:
        index: of its pattern; p: p-value, corrected for the number of contrasts.
        pattern: (cells,) of unit length, with the sign of its score.
        worst: the cell that contributes most to the score.
    """

    index: int
    p: float
    pattern: np.ndarray
    worst: int


@dataclass(frozen=True)
class Contrasts:
    """The contrasts of a statistic under the model.

    Attributes:
        patterns: (patterns, cells), orthonormal.
        scatter: (patterns,) standard deviation of their scores in the replicates, at least that of independent cells.
        freedom: degrees of freedom by which the scatter is known.
        squares: (replicates,) mean squared residual of each replicate without its scores.
    """

    patterns: np.ndarray
    scatter: np.ndarray
    freedom: int
    squares: np.ndarray

    @classmethod
    def learnt(cls, patterns: np.ndarray, z: np.ndarray, freedom: int) -> Contrasts:
        """The contrasts by the residuals of the model's replicates, z: (replicates, cells)."""
        patterns = np.asarray(patterns, np.float64)
        scatter = np.sqrt(np.mean((z @ patterns.T) ** 2, axis=0))
        squares = np.mean((z - (z @ patterns.T) @ patterns) ** 2, axis=1)
        return cls(patterns=patterns, scatter=np.maximum(scatter, 1.0), freedom=max(freedom, 1), squares=squares)

    def without(self, z: np.ndarray) -> np.ndarray:
        """Residuals (cells,) without what the patterns describe."""
        return np.asarray(z - (z @ self.patterns.T) @ self.patterns)

    def scores(self, z: np.ndarray) -> np.ndarray:
        """Scores of residuals (..., cells) along the patterns, in standard deviations, (..., patterns)."""
        return np.asarray(z @ self.patterns.T / self.scatter)

    def clearest(self, z: np.ndarray) -> Contrast:
        """The contrast of residuals (cells,) with the smallest p-value, by Student's t law."""
        scores = self.scores(z)
        p, k = p_of_scores(scores, self.freedom)
        pattern = self.patterns[k] * np.sign(scores[k])
        return Contrast(index=k, p=p, pattern=pattern, worst=int(np.argmax(pattern * z)))


def p_of_scores(scores: np.ndarray, freedom: int) -> tuple[float, int]:
    """(p-value of the largest of scores (patterns,), corrected for their number, its index)."""
    k = int(np.argmax(np.abs(scores)))
    return min(1.0, len(scores) * 2 * float(stats.t.sf(abs(scores[k]), freedom))), k
