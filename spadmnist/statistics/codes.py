"""Codes of the time-to-digital converter."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np

from .. import units
from ..kernels import jit
from ..recording import COMMON_PERIOD
from . import Recording, Statistic, Summary
from ._counting import of_detections, per_cent
from ._frames import first_stamps

# All periods below divide it: a histogram of stamps modulo this number holds those of all of them.
_COMMON = COMMON_PERIOD
_SHOWN = (256, 140, 100)
_FOLDS = tuple(p for p in range(2, 1001) if _COMMON % p == 0)
# (from, to): each period from the shortest that is folded before, so that little is added up. Every one of them divides
# one of the first four that are small.
_MIDDLE = ((_COMMON, 134400), (_COMMON, 84000), (84000, 21000), (134400, 16800), (134400, 13440), (134400, 5376))
_COINCIDENCES = 500.0  # pairs of detections with the same code, from which on chi squared has its law
_TURNS = 16  # periods that an exposure or a frame holds at least, for what is left over at its end to be little


def _steps() -> np.ndarray:
    """(steps, 4): where the histogram that is folded begins and its period, and the same of what it is folded to."""
    steps = list(_MIDDLE)
    for period in reversed(_FOLDS):
        steps.append((min(whole for _, whole in steps if whole % period == 0), period))
    begins, end = {_COMMON: 0}, _COMMON
    for _, part in steps:
        begins[part] = end
        end += part
    return np.array([(begins[whole], whole, begins[part], part) for whole, part in steps])


_STEPS = _steps()


class Codes(Statistic):
    """Code density: how often each code of the converter occurs, with stamps modulo 256, 140 and 100 ticks.

    The period of the converter's coarse clock is unknown. Modulo 256 shows the periods of powers of two up to 256, and
    the lowest eight bits. Modulo 140 and 100 show their divisors (LinoSPAD2 has 140 codes to a period). `code_periods`
    has other periods.
    Law: Poisson. Detections that are independent of the clock have all codes alike.
    Shows: unequal and missing codes, and bits that are stuck.
    """

    modalities = ("tr", "str")
    informs = "codes"
    periods = _SHOWN
    specific = 3
    unit = "detections"

    def reduce(self, recording: Recording) -> Summary | None:
        """Counts of the codes of each period, one after the other."""
        periods = [period for period in _SHOWN if period in _allowed(recording)]
        if not periods:
            return None
        folded = _folds(recording)
        values = np.concatenate([folded[period] for period in periods])
        cells = [(period, code) for period in periods for code in range(period)]
        rate = of_detections(float(folded[periods[0]].sum()))

        def where(cell: int) -> str:
            period, code = cells[cell]
            bits = f" (low bits {code:08b})" if period == 256 else ""
            return f"code {code} of {period}{bits}"

        def size(cell: int, measured: float, expected: float) -> tuple[str, float]:
            _, share = rate(cell, measured, expected)
            wide = measured / expected - 1 if expected > 0 else 0.0
            return f"{per_cent(abs(wide))} too {'often' if wide > 0 else 'seldom'}", share

        return Summary(values.astype(np.float64), "poisson", where, size)


class CodePeriods(Statistic):
    """Unevenness of the converter's codes modulo every period, one number for each period.

    Cells: the 76 periods from 2 to 1000 ticks that divide 672,000; their prime factors are 2, 3, 5 and 7. `codes` shows
    the codes of one period in many cells; here each period has one.
    Law: normal, as the cube root of chi squared of the codes' counts (Wilson and Hilferty), with one degree of freedom
    less than codes. 0 where there are too few detections.
    Shows: unequal codes that repeat with an unknown period.
    """

    modalities = ("tr", "str")
    specific = 2
    pools = ("codes",)
    unit = "standard deviations"

    def reduce(self, recording: Recording) -> Summary | None:
        """Normal scores of the periods."""
        periods = _allowed(recording)
        if not periods:
            return None
        folded, tick = _folds(recording), recording.tick or 0.0
        total = float(folded[periods[0]].sum())
        axis = np.array(periods, np.float64)
        freedom, part = axis - 1, 2 / (9 * (axis - 1))
        products = np.array([counts @ counts for counts in (folded[period].astype(np.float64) for period in periods)])
        squares = products * axis / max(total, 1.0) - total
        enough = total * total >= 2 * _COINCIDENCES * axis
        values = np.where(enough, (np.cbrt(squares / freedom) - (1 - part)) / np.sqrt(part), 0.0)
        uneven = np.where(enough, (squares - freedom) / max(total, 1.0), 0.0)  # squared relative spread of the widths

        def where(cell: int) -> str:
            period = periods[cell]
            return f"codes in a period of {period} ticks ({units.show(period * tick, 's')})"

        def size(cell: int, measured: float, expected: float) -> tuple[str, float]:
            wide = float(np.sqrt(max(uneven[cell], 0.0)))
            return f"widths of the codes vary by {per_cent(wide)} (rms)", wide

        return Summary(values, "normal", where, size, np.ones(len(periods)), axis, "period (ticks)", log=True)


def _allowed(recording: Recording) -> list[int]:
    """The periods of which an exposure or a frame holds enough; none without a converter."""
    if recording.tick is None:
        return []
    conditions = recording.conditions
    length = conditions.exposure if recording.events is not None else conditions.frame_time
    return [period for period in _FOLDS if period * _TURNS * recording.tick <= length]


def _folds(recording: Recording) -> dict[int, np.ndarray]:
    """Period -> (period,) how many stamps have each code, for all of `_FOLDS`."""
    known = recording._kept.get("code folds")
    if known is None:
        number = recording.totals.sum()
        folded = np.zeros(_STEPS[-1, 2:].sum(), np.int32 if number < 2**31 else np.int64)
        density = folded[:_COMMON]
        if recording.events is not None:
            assert recording.events.ticks is not None
            _remainders(recording.events.ticks, density)
        else:
            for _, found in first_stamps(recording):
                _remainders(found.stamps, density)
        _fold(folded, _STEPS)
        known = recording._kept["code folds"] = {
            part: folded[first : first + part].copy() for _, _, first, part in _STEPS.tolist() if part in _FOLDS
        }
    return known  # type: ignore[return-value]


@jit
def _fold(folded, steps):
    """Add up what lies a multiple of a period apart. steps: (steps, 4), see `_steps`."""
    for step in range(steps.shape[0]):
        period = steps[step, 3]
        part = folded[steps[step, 2] : steps[step, 2] + period]
        for first in range(steps[step, 0], steps[step, 0] + steps[step, 1], period):
            whole = folded[first : first + period]
            for k in range(period):
                part[k] += whole[k]


@jit
def _remainders(stamps, out):
    for i in range(stamps.size):
        out[np.uint64(stamps[i]) % np.uint64(_COMMON)] += 1
