"""Tests of the totals: each capture against all others, and the light of all lit captures against the stated one.

The logs of the light levels, relative to the stated ones, have the covariance C: each capture's own error, and the
light that they share. The score along a vector v is w x / sqrt(v w) with w = inv(C) v. Along one capture it is the
deviation from what all others and the stated level predict; the order of the captures is of no account.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import stats

from ..recording import Capture
from .evaluation import Evaluation
from .light_levels import estimated_errors, totals_space
from .replicates import Replicates


class Level(NamedTuple):
    """The light level of a lit capture, relative to the stated one, by its total.

    Attributes:
        log: the logarithm of the factor; error: its standard error, by the scatter of the replicates; freedom: the
            degrees of freedom of that.
        elasticity: d log(total) / d log(level).
    """

    capture: Capture
    log: float
    error: float
    elasticity: float
    freedom: float = math.inf


@dataclass(frozen=True)
class TotalsTest:
    """A test of the totals.

    Attributes:
        capture: the index of the capture that is judged by the others; None for the light of all lit captures.
        z: its score, standard deviations; p: two-sided, by Student's t law where the errors are estimates.
    """

    capture: int | None
    z: float
    p: float


def along(
    root: np.ndarray, z: np.ndarray, vectors: np.ndarray, estimated: np.ndarray, freedom: np.ndarray
) -> list[tuple[float, float]]:
    """(score, p-value) of the totals along each vector.

    The degrees of freedom are those of Welch (Biometrika 34 (1947) 28) and Satterthwaite.

    Args:
        root: inverse root of the covariance of the logs of the levels, (captures, captures).
        z: their whitened residuals, (captures,).
        vectors: (tests, captures).
        estimated: the part of each error that is an estimate, (captures,); freedom: its degrees of freedom.
    """
    out = []
    for vector in vectors:
        white = root @ vector
        weights, variance = root.T @ white, float(white @ white)
        score = float(white @ z) / math.sqrt(max(variance, 1e-300))
        fourth = float(np.sum((weights * estimated) ** 4 / freedom))
        known = variance**2 > 1e9 * fourth  # the t law is the normal one there
        p = stats.norm.sf(abs(score)) if known else stats.t.sf(abs(score), variance**2 / fourth)
        out.append((score, 2 * float(p)))
    return out


def directions(uncertain: Sequence[float], lit: Sequence[bool]) -> tuple[np.ndarray, list[int | None]]:
    """(vectors (tests, captures), the capture of each): every capture by itself, and the light where any is lit.

    Args:
        uncertain: relative uncertainty of the shared light in each capture; the light moves them in that proportion.
            Where all are 0, it moves all lit ones alike.
    """
    shared = np.where(lit, uncertain, 0.0)
    if not shared.any():
        shared = np.array(lit, float)
    many = len(shared)
    vectors, of = [*np.eye(many)], [*range(many)]
    if shared.any():
        return np.array([*vectors, shared / shared.max()]), [*of, None]
    return np.array(vectors).reshape(many, many), list(of)


def tests_of_totals(replicates: Replicates, evaluation: Evaluation, z: np.ndarray) -> list[TotalsTest]:
    """The tests of the totals of an evaluation: of each capture, and of the light.

    Args:
        z: (captures,) whitened residuals of the totals, in the order of `totals_space`.
    """
    ids, _, root, uncertain = totals_space(replicates, evaluation)
    if not ids:
        return []
    vectors, of = directions(list(uncertain), [not replicates.seen[id].capture.light.dark for id in ids])
    found = along(root, z, vectors, *estimated_errors(replicates, evaluation, ids))
    return [TotalsTest(capture=k, z=score, p=p) for k, (score, p) in zip(of, found, strict=True)]
