"""Leave one capture out: residuals of each capture, the coordinates being fitted without it, to first order."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from .evaluation import stacked
from .gauss_newton import Fit
from .replicates import TOTALS, Cell

# least share of the information on a coordinate in the other captures, for a capture to be left out of the fit;
# otherwise each of its cells is left out by itself. A rule of thumb
_INFORMED_BY_OTHERS = 0.3


def captures_needed(residuals: Mapping[Cell, np.ndarray], jacobian: Mapping[Cell, np.ndarray]) -> set[str]:
    """The captures without which some coordinate, or a combination of coordinates, is hardly informed.

    Args:
        residuals: (cells,) by block.
        jacobian: (cells, coordinates) by block.
    """
    keys = _common_cells(residuals, jacobian)
    parts = {key: jacobian[key].T @ jacobian[key] for key in keys}
    if not parts:
        return set()
    values, vectors = np.linalg.eigh(sum(parts.values()))
    informed = values > 1e-9 * max(float(values.max(initial=0.0)), 1e-300)
    root = vectors[:, informed] / np.sqrt(values[informed])
    out = set()
    for id in {key[0] for key in keys} - {""}:
        own = sum(part for key, part in parts.items() if key[0] == id)
        share = np.linalg.eigvalsh(root.T @ own @ root)  # of the information on each direction
        if share.size and 1 - float(share.max()) < _INFORMED_BY_OTHERS:
            out.add(id)
    return out


def _common_cells(residuals: Mapping[Cell, np.ndarray], jacobian: Mapping[Cell, np.ndarray]) -> list[Cell]:
    return [k for k in jacobian if k in residuals and len(residuals[k]) == len(jacobian[k])]


def leave_one_capture_out(
    residuals: Mapping[Cell, np.ndarray], jacobian: Mapping[Cell, np.ndarray]
) -> dict[Cell, np.ndarray]:
    """The residuals of each capture with the coordinates fitted without it, to first order, (cells,) by block.

    Where one capture alone informs a coordinate, each of its cells is left out by itself. A distance to the minimum
    of the squares, by a bound for example, remains.

    Args:
        residuals: (cells,) at the fit, by block.
        jacobian: (cells, coordinates) by block.
    """
    keys, without = _common_cells(residuals, jacobian), captures_needed(residuals, jacobian)
    z, slope = stacked(residuals, keys), np.concatenate([jacobian[k] for k in keys])
    normal = slope.T @ slope
    out = dict(residuals)
    ridge = 1e-9 * np.trace(normal) * np.eye(len(normal))
    inverse = np.linalg.pinv(normal + ridge)
    lacking = -inverse @ (slope.T @ z)
    for id in {k[0] for k in keys} - {""}:
        mine = np.concatenate([np.full(len(residuals[k]), k[0] == id) for k in keys])
        own = slope[mine]
        if id in without:
            hat = np.minimum(np.einsum("ij,jk,ik->i", own, inverse, own), 0.9)
            beyond = (z[mine] + own @ lacking) * hat / (1 - hat)
        else:
            # 0 where no cell depends on any coordinate
            rest = -np.linalg.pinv(normal - own.T @ own + ridge) @ (slope[~mine].T @ z[~mine])
            beyond = own @ (rest - lacking)
        start = 0
        for key in (k for k in keys if k[0] == id):
            size = len(residuals[key])
            out[key] = residuals[key] + beyond[start : start + size]
            start += size
    return out


def optimism(residuals: Mapping[Cell, np.ndarray], fit: Fit) -> float:
    """The optimism of a fit: the fall of the squares on its own captures less that on captures left out; at least 0.

    For the totals, and for a capture that alone informs a coordinate, it is 2 for each coordinate in the mean
    (Mallows, Technometrics 15 (1973) 661).

    Args:
        residuals: (cells,) at the fit, by block.
    """
    keys, without = _common_cells(residuals, fit.jacobian), captures_needed(residuals, fit.jacobian)
    apart = leave_one_capture_out(residuals, fit.jacobian)
    slope = np.concatenate([fit.jacobian[k] for k in keys])
    inverse = np.linalg.pinv(slope.T @ slope, rcond=1e-10)
    found = 0.0
    for key in keys:
        if key == TOTALS or key[0] in without:
            found += 2 * float(np.trace(inverse @ fit.jacobian[key].T @ fit.jacobian[key]))
        else:
            found += float(apart[key] @ apart[key] - residuals[key] @ residuals[key])
    return max(found, 0.0)
