"""Statistics: what a recording is reduced to before it is compared with a model. A file in this folder is found by
itself; a family of statistics stands in one file.

A statistic turns a `Recording` into a `Summary`: numbers in a unit (its cells), each with the law it follows if
nothing but the model is at work, and words for where each one looks. It cannot know whether the recording is measured
or simulated, and it does not know the model: expectations and scatter come from recordings that the model makes, which
are reduced in the same way (`spadmnist.inference`). Cells should not depend on the light level more than they must, for
the level is not known exactly: what is left of it is taken out by regression on the total of the capture.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np

from ..errors import did_you_mean
from ..plugins import Plugin, Registry, parameter
from ..recording import MODALITIES, Recording

if TYPE_CHECKING:
    from ..sensor import Sensor

__all__ = ["LAWS", "Recording", "Statistic", "Summary", "parameter"]

LAWS = ("poisson", "normal", "exponential", "exact")
OTHER_ERRORS = ("mean_rate", "linearity")  # columns of the error budget that come from the totals of captures


@dataclass(frozen=True)
class Summary:
    """What a statistic found in one recording.

    values: (cells,) float64. law: how each cell scatters under the model. "poisson": counts; "normal": about its mean,
    with a spread that the model's recordings show; "exponential": positive, its mean as large as its spread (a power
    spectrum); "exact": it must be what the model's recordings have, always.
    scale: (cells,) relative size of the spread of "normal" cells where it is known, for example 1/sqrt(n): then one
    factor for all is learnt from the model's recordings, otherwise one for each cell.
    where: cell -> what it looks at, "side neighbours, 0 to 1 ns". size: (cell, measured, expected) -> the difference in
    physical units, as text, and as a share of the detections or of the rate (for `--tolerance`).
    axis: (cells,) what a picture has on its horizontal axis, and its label; log: on a logarithmic scale. shape: (rows,
    columns) where the cells are a map of the array. nested: (cells,) of normal scores of which each is of what the one
    before is of and of more, as counts in windows twice as long: their correlation with that one. contrasts: (patterns,
    cells), orthonormal: a deviation of this pattern is tested by itself, for one that is spread over all cells is lost
    in the sum of their squares. contrast_words: the name of each, "a rise or a fall". rate: a value -> the rate that it
    stands for, in any unit, where values of several captures are set in proportion.
    """

    values: np.ndarray
    law: str
    where: Callable[[int], str]
    size: Callable[[int, float, float], tuple[str, float]]
    scale: np.ndarray | None = None
    axis: np.ndarray | None = None
    label: str = ""
    log: bool = False
    shape: tuple[int, int] | None = None
    nested: np.ndarray | None = None
    contrasts: np.ndarray | None = None
    contrast_words: Sequence[str] = ()
    rate: Callable[[float], float] | None = None

    def place(self, cell: int, contrast: int | None = None) -> str:
        """What a cell looks at, in words; as the place where a contrast is clearest, if its index is given."""
        where = self.where(cell)
        return where if contrast is None else f"{self.contrast_words[contrast]}, clearest in {where}"

    def apart(self) -> Summary:
        """The same, but of a nested cell what it does not share with the one before: cells that are independent."""
        if self.nested is None:
            return self
        shared, old, new = self.nested[1:], np.array(self.values, np.float64), np.array(self.values, np.float64)
        root = np.append(1.0, np.sqrt(1.0 - shared**2))
        new[1:] = (new[1:] - shared * new[:-1]) / root[1:]
        where, size = self.where, self.size

        def whole(cell: int, measured: float, expected: float) -> tuple[str, float]:
            """The size of the whole score of a cell, of which `measured` is what it does not share."""
            score = float(old[cell] + (measured - new[cell]) * root[cell])
            return size(cell, score, score - float((measured - expected) * root[cell]))

        beyond = ", beyond that in half of it"
        return replace(self, values=new, where=lambda cell: where(cell) + beyond * (cell > 0), size=whole, nested=None)


class Statistic(Plugin, abstract=True):
    """Base of every statistic."""

    registry: ClassVar[Registry] = Registry("statistic")
    modalities: ClassVar[tuple[str, ...]] = ()  # of "tr", "str", "qis", "counts"
    costly: ClassVar[bool] = False  # left out where very many models are looked at for the first time
    flat: ClassVar[bool] = False  # it sets pixels beside each other as if all saw the same light: not of a scene
    unit: ClassVar[str] = "1"  # of its values
    # whose detections it sets beside each other: a pixel's own, those close by or far apart, all as one; "": it counts
    among: ClassVar[Literal["", "pixel", "neighbours", "far", "array"]] = ""
    # how much a deviation says of the physics: 0 that there is one (a drift, a total); 1 its class (a variance, a
    # spread, clusters); 2 between which detections or pixels; 3 also where: at which delay, frequency, row
    specific: ClassVar[int] = 1
    # the statistics of whose cells this one's are sums: a deviation there shows here, too (`inference.deviations`)
    pools: ClassVar[tuple[str, ...]] = ()
    # of which maps its cells tell: the "counts" of the pixels, the "distribution" of these, "dead times" that differ
    # from pixel to pixel, the "codes" of a converter, folded with its `periods` one after the other; "": of none
    informs: ClassVar[Literal["", "counts", "distribution", "dead times", "codes"]] = ""
    periods: ClassVar[tuple[int, ...]] = ()
    named_from: ClassVar[int] = 0  # a deviation in a cell before this one is no more specific than 0
    error: ClassVar[str] = ""  # the name of its `physical_error` in the error budget of a diagnosis; "": it has none

    def __init_subclass__(cls, **keywords: Any):
        if "error" not in vars(cls):
            cls.error = ""  # a subclass has a column of its own, or none
        elif cls.error in OTHER_ERRORS:
            raise TypeError(f"{cls.__name__}: the error {cls.error!r} is one of no statistic; take another name")
        elif cls.error and cls.physical_error.__func__ is Statistic.physical_error.__func__:  # type: ignore[attr-defined]
            raise TypeError(f"{cls.__name__}: with error = {cls.error!r} it must define physical_error")
        if cls.reduce is Statistic.reduce and not keywords.get("abstract"):
            raise TypeError(f"{cls.__name__}: a statistic must define reduce(recording)")
        wrong = not isinstance(cls.modalities, tuple | list) or [m for m in cls.modalities if m not in MODALITIES]
        if wrong or not (cls.modalities or keywords.get("abstract")):
            near = did_you_mean(str(wrong[0]).lower(), MODALITIES) if isinstance(wrong, list) and wrong else ""
            raise TypeError(
                f"{cls.__name__}: modalities is {cls.modalities!r}; it is a tuple of one or more of "
                f'{", ".join(MODALITIES)}: write modalities = ("tr",).{near}'
            )
        super().__init_subclass__(**keywords)

    @classmethod
    def physical_error(
        cls, measured: np.ndarray, expected: np.ndarray, residuals: np.ndarray, detections: float
    ) -> float:
        """The relative error of a model in what this statistic measures, beyond the noise.

        Args:
            measured, expected: (cells,) in the unit of the statistic.
            residuals: (cells,) standard deviations.
            detections: of the capture.
        """
        raise NotImplementedError

    def unit_likelihood(self, recording: Recording, sensors: Sequence[Sensor]) -> np.ndarray:
        """The log-likelihood of what each pixel recorded, (pixels, sensors), each row up to a constant.

        For maps of a parameter that is `informed_by` this statistic. The captures are those that `reduce` gives a
        summary of.

        Args:
            sensors: models that differ in the value of that parameter, which is the same in all pixels of each.
        """
        raise NotImplementedError

    def reduce(self, recording: Recording) -> Summary | None:
        """The summary of a recording, or None where it has nothing to say of it. The number of cells depends on the
        capture (its conditions and layout) alone, never on the data.
        """
        raise NotImplementedError


def informing(what: str) -> list[str]:
    """The names of the statistics that declare that they inform maps of that kind, the built-in ones first."""
    known = list(Statistic.registry)  # a plug-in may be found by this
    first = [name for name in Statistic.registry.classes if name in known]
    return [name for name in first if Statistic.registry.find(name).informs == what]


def informant(what: str) -> str:
    """The name of the first statistic that declares that it informs maps of that kind; see `informing`."""
    return informing(what)[0]
