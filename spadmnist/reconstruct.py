"""The six flux reconstructions: from what a pixel recorded to one number.

Each method is one class; `spadmnist methods` lists them. A method sees only per-pixel sums of the raw stream
(`spadmnist.readout.Recorded`), so that it never needs the events themselves. A user's method gets arrays that cannot
be written, and what it returns is checked: an error names the method and its file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from . import estimators, kernels
from .errors import EffectError, SpadError, did_you_mean
from .events import read_only
from .plugins import Plugin, Registry, blame, is_built_in, source_file
from .readout import Recorded

_ROWS_AT_ONCE = 1 << 15  # numbers whose arithmetic stays in the processor's cache
_VALUES_KEPT = 1 << 25  # of 4 bytes: up to so many the median is found without reading them twice
_SIGN = 1 << 15  # of the upper 16 bits of a negative float
_ASCENDING = np.concatenate([np.arange((1 << 16) - 1, _SIGN - 1, -1), np.arange(_SIGN)])  # those bits, by value

# what a method may ask for (columns of Recorded) -> the readout that it comes from
COLUMNS = {"counts": "tr", "span": "tr", "ones": "qis", "waited": "str"}


@dataclass(frozen=True)
class Settings:
    """What an estimator is told of sensor and recording.

    pdp: nominal PDP at the scene's wavelength (q); exposure, frame_time: s; dead_time: nominal, s, 0 without one;
    tick: s, 0 without a converter; frames: their number.
    """

    pdp: float
    exposure: float
    dead_time: float
    tick: float
    frames: int
    frame_time: float


class Method(Plugin, abstract=True):
    """Base of every reconstruction.

    columns: what it needs of `Recorded`; unit: of the image; normalised: divided by the training median for use.
    """

    registry: ClassVar[Registry] = Registry("method")
    columns: ClassVar[tuple[str, ...]]
    unit: ClassVar[str] = "1/s"
    normalised: ClassVar[bool] = True

    def __init_subclass__(cls, abstract: bool = False, **keywords: Any):
        if not abstract:
            _check_columns(cls)
        super().__init_subclass__(abstract=abstract, **keywords)

    @classmethod
    def readouts(cls) -> tuple[str, ...]:
        """The readouts that must be recorded."""
        return tuple(sorted({COLUMNS[c] for c in cls.columns}))

    def estimate(self, settings: Settings, *columns: Any, **named: Any) -> np.ndarray:
        """The image from the columns, float64; `+inf` where a saturated pixel has no finite estimate.

        Each value is a function of its own pixel's values alone: it may not depend on other pixels, on how many there
        are or on their order. Large images are given in parts; of a single column of small integers, what is given is
        not the pixels but each integer once, 0, 1, 2 and so on, and the image is looked up in what is returned.
        The columns cannot be written.
        """
        raise TypeError(f"{self.name} must define estimate")

    def saturated(self, settings: Settings, *columns: Any, **named: Any) -> int:
        """In how many pixels the formula had no answer of its own and a rule stands in."""
        return 0

    def stored_when_saturated(self, settings: Settings) -> float:
        """What a dataset stores where `estimate` is infinite: a finite number."""
        return np.inf

    def image(self, recorded: Recorded, settings: Settings) -> tuple[np.ndarray, int]:
        """What a dataset stores: ((rows,) float32, how many of them were saturated).

        Raises:
            EffectError: where the code of a user's method fails, or returns what it must not.
        """
        columns = [getattr(recorded, name) for name in self.columns]
        values, saturated = np.empty(columns[0].shape, np.float32), 0
        largest = int(columns[0].max(initial=0)) if len(columns) == 1 and columns[0].dtype.kind in "iu" else None
        if largest is not None and largest < _ROWS_AT_ONCE:
            # a function of one small integer is worked out once for each value that occurs
            whole = np.arange(largest + 1)
            table = stored(self, settings, whole)
            values = estimators.lookup(table, columns[0])
            if not is_built_in(type(self)) and not np.isfinite(table).all():  # of a number that may not occur
                _check_finite(self, values, columns)
            # where no value is saturated no pixel need be looked at again
            return values, _bounded(self, settings, *columns) if _bounded(self, settings, whole) else 0
        for start in range(0, len(values), _ROWS_AT_ONCE):
            part = [column[start : start + _ROWS_AT_ONCE] for column in columns]
            if is_built_in(type(self)):
                values[start : start + _ROWS_AT_ONCE], bounded = self._worked_out(settings, *part)
            else:  # by the hooks alone: it may have changed those of a method that works out both at once
                piece, bounded = stored(self, settings, *part), _bounded(self, settings, *part)
                _check_finite(self, piece, part)
                values[start : start + _ROWS_AT_ONCE] = piece
            saturated += bounded
        return values, saturated

    def _worked_out(self, settings: Settings, *columns: Any) -> tuple[np.ndarray, int]:
        """(finite values, how many were saturated)."""
        return self._finite(settings, *columns), self.saturated(settings, *columns)

    def _finite(self, settings: Settings, *columns: np.ndarray) -> np.ndarray:
        values = _call(self, "estimate", settings, *columns)
        _check_estimate(self, values, columns[0].shape)
        values = values if values.dtype.kind == "f" else values.astype(np.float64)
        infinite = np.isposinf(values)
        if not infinite.any():
            return np.asarray(values)
        rule = _call(self, "stored_when_saturated", settings)
        if np.ndim(rule) or np.asarray(rule).dtype.kind not in "fiu":
            raise _wrong(self, f"stored_when_saturated must return one number, not {rule!r:.80}")
        return np.where(infinite, rule, values)


# --- calls of the hooks: as in `hooks` ----------------------------------------------------------------------------


def stored(method: Method, settings: Settings, *columns: np.ndarray) -> np.ndarray:
    """What `estimate` gives, as a dataset stores it, float32: it is not looked up, and it may not be finite."""
    values = method._finite(settings, *columns)
    with np.errstate(over="ignore"):  # then it is infinite, and refused
        return values.astype(np.float32)


def divisor(method: Method, median: float | None) -> float | None:
    """The median by which images are divided. Raises EffectError where none can be: it is not positive."""
    if median is not None and not median > 0:
        raise _wrong(
            method,
            f"the median of its non-zero values is {median:g}, by which its images cannot be divided: it must be "
            "positive; set normalised = False, or return values of which most are positive",
        )
    return median


def _call(method: Method, hook: str, settings: Settings, *columns: np.ndarray) -> Any:
    """What a hook returns. Raises EffectError where the code of a user's method fails."""
    called: Callable[..., Any] = getattr(method, hook)
    if is_built_in(type(method)):
        return called(settings, *columns)
    try:
        return called(settings, *map(read_only, columns))
    except SpadError:
        raise
    except Exception as error:
        raise blame(type(method), error) from error


def _bounded(method: Method, settings: Settings, *columns: np.ndarray) -> int:
    """How many pixels are saturated."""
    found = _call(method, "saturated", settings, *columns)
    if not isinstance(found, int | np.integer) or not 0 <= found <= columns[0].size:
        raise _wrong(method, f"saturated must say how many of the {columns[0].size} pixels are, not {found!r:.80}")
    return int(found)


def _check_estimate(method: Method, values: Any, shape: tuple[int, ...]) -> None:
    """Raises EffectError where `estimate` does not return one number for each pixel."""
    if isinstance(values, np.ma.MaskedArray):
        raise _wrong(method, "estimate returns a masked array; give each pixel a number (.filled)")
    if not isinstance(values, np.ndarray) or values.shape != shape or values.dtype.kind not in "fiu":
        what = f"{values.dtype} of shape {values.shape}" if isinstance(values, np.ndarray) else type(values).__name__
        raise _wrong(method, f"estimate must return one number for each pixel, float64 of shape {shape}, not {what}")


def _check_finite(method: Method, values: np.ndarray, columns: Sequence[np.ndarray]) -> None:
    """Raises EffectError where an image of a user's method cannot be stored."""
    finite = np.isfinite(values)
    if not finite.all():
        pixel = int(np.argmin(finite))
        named = zip(method.columns, columns, strict=True)
        place = " and ".join(f"{name} is {column[pixel]:g}" for name, column in named)
        raise _wrong(
            method,
            f"its image is not finite: it is {values[pixel]:g} where {place}; return finite values, or +inf where a "
            "pixel is saturated, and define stored_when_saturated(self, settings): the finite number that is stored "
            "there",
        )


def _wrong(method: Method, what: str) -> EffectError:
    """The error that a hook returns what it must not."""
    return EffectError(f"{source_file(type(method))}: the method {method.name}: {what}")


def _check_columns(cls: type[Method]) -> None:
    """Raises TypeError where a class does not say which columns it needs."""
    known = f"the columns are {', '.join(COLUMNS)}"
    example = "write for example columns = ('counts',)"
    columns = getattr(cls, "columns", None)
    if columns is None:
        raise TypeError(f"{cls.__name__}: it has no columns, which say what estimate is given; {known}: {example}")
    if not isinstance(columns, tuple | list) or not columns:
        raise TypeError(f"{cls.__name__}: columns is {columns!r:.80}, not a tuple of names; {known}: {example}")
    for name in columns:
        if name not in COLUMNS:
            raise TypeError(f"{cls.__name__}: {name!r} is not a column; {known}.{did_you_mean(str(name), COLUMNS)}")


class Counts(Method):
    """Detections over exposure: N / (q T).

    No detection gives 0. Source: Suonsivu et al., eq. 4a.
    """

    columns = ("counts",)

    def estimate(self, settings: Settings, counts: np.ndarray) -> np.ndarray:
        return counts / (settings.pdp * settings.exposure)


class PassiveFreeRunning(Method):
    """Detections over live time: N / (q (T - N tau_d)).

    No detection gives 0. Where no live time is left the estimate is infinite; a dataset stores its value at
    N_max - 1/2 detections, N_max = T / tau_d, and counts such pixels. Source: Suonsivu et al., eq. 4b.
    """

    columns = ("counts",)

    def estimate(self, settings: Settings, counts: np.ndarray) -> np.ndarray:
        live = self._live(settings, counts)
        return np.where(live > 0, counts / (settings.pdp * np.where(live > 0, live, 1.0)), np.inf)

    def _live(self, settings: Settings, counts: np.ndarray) -> np.ndarray:
        live = settings.exposure - counts * settings.dead_time
        # where the exposure is a whole number of dead times, a rounding error is no live time
        return np.where(live > 1e-12 * settings.exposure, live, 0.0)

    def saturated(self, settings: Settings, counts: np.ndarray) -> int:
        return int(np.count_nonzero(self._live(settings, counts) <= 0))

    def stored_when_saturated(self, settings: Settings) -> float:
        if settings.dead_time <= 0:
            return np.inf
        most = settings.exposure / settings.dead_time
        # a dead time longer than twice the exposure leaves less than half a detection, and still no negative flux
        return float(self.estimate(settings, np.asarray(most - 0.5 if most > 0.5 else most / 2)))


class InterPhoton(Method):
    """Intervals between first and last detection over their live time: (N - 1) / (q (X_N - X_1 - (N - 1) tau_d)).

    Fewer than two detections give 0. Rounded stamps can leave no live time: it is taken as at least half a tick per
    interval, and such pixels are counted. Source: Suonsivu et al., eq. 4c.
    """

    columns = ("counts", "span")

    def _worked_out(self, settings: Settings, counts: np.ndarray, span: np.ndarray) -> tuple[np.ndarray, int]:
        # without a converter two stamps still lie a rounding error apart
        half = settings.tick / 2 if settings.tick > 0 else np.spacing(settings.exposure)
        return estimators.inter_photon(counts, span, settings.pdp, settings.dead_time, half)

    def estimate(self, settings: Settings, counts: np.ndarray, span: np.ndarray) -> np.ndarray:
        return self._worked_out(settings, counts, span)[0]

    def saturated(self, settings: Settings, counts: np.ndarray, span: np.ndarray) -> int:
        return self._worked_out(settings, counts, span)[1]


class StrFlux(Method):
    """Frames with a detection over the time waited for it: sum 1(D_i != T_f) / (q sum D_i).

    No detection gives 0. Where every stamp is 0, each counts as half a tick. Source: Suonsivu et al., eq. 5.
    """

    columns = ("ones", "waited")

    @classmethod
    def readouts(cls) -> tuple[str, ...]:
        return ("str",)  # the bits are those of the STR frames

    def _worked_out(self, settings: Settings, ones: np.ndarray, waited: np.ndarray) -> tuple[np.ndarray, int]:
        half = settings.tick / 2 if settings.tick > 0 else np.spacing(settings.frame_time)
        return estimators.first_photon(ones, waited, settings.pdp, settings.frames * half)

    def estimate(self, settings: Settings, ones: np.ndarray, waited: np.ndarray) -> np.ndarray:
        return self._worked_out(settings, ones, waited)[0]

    def saturated(self, settings: Settings, ones: np.ndarray, waited: np.ndarray) -> int:
        return self._worked_out(settings, ones, waited)[1]


class QisCounts(Method):
    """Frames with a detection: S = sum B_t.

    Never normalised. Source: Suonsivu et al., eq. 6a.
    """

    columns = ("ones",)
    unit = "1"
    normalised = False

    def estimate(self, settings: Settings, ones: np.ndarray) -> np.ndarray:
        return ones.astype(np.float64)


class QisLinear(Method):
    """Detections that the frames with one stand for: -M ln(1 - S / M).

    S = M is taken as M - 1/2, and such pixels are counted. Never normalised. Source: Suonsivu et al., eq. 6b.
    """

    columns = ("ones",)
    unit = "1"
    normalised = False

    def estimate(self, settings: Settings, ones: np.ndarray) -> np.ndarray:
        empty = np.where(ones < settings.frames, 1.0 - ones / settings.frames, 0.5 / settings.frames)
        # + 0.0: the image of an empty pixel is 0, not -0
        return -settings.frames * kernels.logarithm(empty.ravel()).reshape(empty.shape) + 0.0

    def saturated(self, settings: Settings, ones: np.ndarray) -> int:
        return int(np.count_nonzero(ones >= settings.frames))


def find(name: str) -> Method:
    """The method of that name. Raises KeyError with a sentence."""
    return Method.registry.find(name)()


def median_of_nonzero(chunks: Callable[[], Iterable[np.ndarray]]) -> float | None:
    """The median of all non-zero values; see `medians_of_nonzero`."""
    return medians_of_nonzero(lambda: ({"": chunk} for chunk in chunks())).get("")


def medians_of_nonzero(chunks: Callable[[], Iterable[Mapping[str, np.ndarray]]]) -> dict[str, float | None]:
    """Exact medians of the non-zero values (finite float32), in memory that does not grow with their number.

    chunks: gives the values anew at each call, in any order, as arrays by name; it is called twice where there are more
    values than are kept. Non-negative floats are ordered as their bits are, and negative ones the other way round, so
    the upper and then the lower 16 bits of the two middle values are found by counting. None where every value is zero.
    """
    upper: dict[str, np.ndarray] = {}
    kept: list[dict[str, np.ndarray]] = []
    room = _VALUES_KEPT
    for nonzero in map(_nonzero, chunks()):
        for name, bits in nonzero.items():
            counted = upper.setdefault(name, np.zeros(1 << 16, np.int64))
            counted += np.bincount(bits >> 16, minlength=1 << 16)
        room -= sum(bits.size for bits in nonzero.values())
        kept.append(nonzero)
        if room < 0:
            kept.clear()
    # for each name the ranks of the two middle values, as (bin of the upper bits, rank within it)
    wanted: dict[str, list[tuple[int, int]]] = {}
    for name, counted in upper.items():
        ascending = counted[_ASCENDING]
        running = np.cumsum(ascending)
        total = int(running[-1])
        ranks = [(total - 1) // 2, total // 2] if total else []
        at = [int(np.searchsorted(running, rank, side="right")) for rank in ranks]
        wanted[name] = [
            (int(_ASCENDING[i]), rank - int(running[i] - ascending[i])) for i, rank in zip(at, ranks, strict=True)
        ]
    lower = {(name, b): np.zeros(1 << 16, np.int64) for name, pairs in wanted.items() for b, _ in pairs}
    for nonzero in kept if room >= 0 else map(_nonzero, chunks()):
        for name, bits in nonzero.items():
            for b in {b for b, _ in wanted[name]}:
                lower[name, b] += np.bincount(bits[bits >> 16 == b] & 0xFFFF, minlength=1 << 16)
    medians: dict[str, float | None] = {}
    for name, pairs in wanted.items():
        middle = []
        for b, rank in pairs:
            negative = b >= _SIGN
            counted = lower[name, b][::-1] if negative else lower[name, b]
            low = int(np.searchsorted(np.cumsum(counted), rank, side="right"))
            low = 0xFFFF - low if negative else low
            middle.append(float(np.array([(b << 16) | low], np.uint32).view(np.float32)[0]))
        medians[name] = sum(middle) / len(middle) if middle else None
    return medians


def _nonzero(chunk: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {name: _bits_of_nonzero(values) for name, values in chunk.items()}


def _bits_of_nonzero(values: np.ndarray) -> np.ndarray:
    flat = np.ascontiguousarray(values, np.float32).ravel()
    return flat.view(np.uint32)[flat != 0]  # -0 is zero as well
