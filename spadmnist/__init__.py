"""spadmnist: what a single-photon camera would have recorded.

Vocabulary, used everywhere in this package:

photon       light that arrives at a pixel's active area; flux: photons per second there
PDP          photon detection probability: the chance that a photon starts an avalanche
avalanche    what fires in a pixel: by a photon, in the dark (dark count rate, DCR), or as a late echo (afterpulse)
detection    an avalanche that is recorded; dead time: how long the pixel is blind after one
event        one entry of a stream
exposure     how long an image is recorded; frame: a slice of it, frame time: how long a frame looks
TR           every detection's time stamp; STR: the first one of each frame; QIS: one bit a frame
effect       one physical cause, in one file, at one stage of the line from photons to readouts

The words of the inference; a cell is one number of a statistic, a candidate one change of the model:

replicate             a recording that the model makes of a capture; all models draw the same random numbers for it
null distribution     how a statistic is distributed if the model is right
residual              measured less expected, in units of the cell's scatter; misfit: their mean square, expected 1
nuisance parameter    a number that is fitted and not asked for: the light level of a capture
signature             the shift of every cell that a candidate makes, in proportion to its strength
score test            the data's projection on a signature, in standard deviations of the null distribution
trials factor         the effective number of independent tests of which the smallest p-value is the best
covariance            of fitted numbers: how their errors go together; the diagonal has their variances
profile likelihood    the largest likelihood at one value of a number; its fall by a given amount ends an interval
random effect         values of pixels, rows or columns that are draws from one law; its width is fitted
empirical Bayes       a map of pixels by a prior that is taken from all of them
leave-one-out         each capture is judged by a fit to the others
optimism              how much smaller the squares are in the captures of a fit than in captures that are left out
effective parameters  half of the optimism: so many free numbers would fit as much of the noise
evidence              twice the log-likelihood ratio of two models, less two for each effective parameter
confused              the verdict where another explanation is as good
mimic                 what no effect describes, and leaves the trace of one
experiment design     which further capture would separate two explanations
upper limit           the largest strength that the data allow, at 95 %, of an effect that was not found
ladder                a row for each model from the given one to the found one: held-out misfit and physical errors
placebo               a row of the ladder: an unrelated effect at its best strength
"""

import sys


def _leave_the_current_folder() -> None:
    """Take the current folder off the path of the program, whose libraries a file there could stand in for.

    `python -m spadmnist` puts it there, and so does an empty entry of PYTHONPATH. What PYTHONPATH names is asked for.
    A program that imports the package keeps its path.
    """
    import os  # what `python -m` is made of has imported it

    first = sys.argv[0] if sys.argv else ""
    word = sys.orig_argv[-len(sys.argv)] if first == "-m" else ""  # so it is while `python -m` looks for the module
    module = word.partition("m")[2] if word.startswith("-") else word
    started = module.partition(".")[0] == __name__
    if not started and os.path.basename(first) != __name__:
        return
    named = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    meant = (started and not sys.flags.safe_path) or (len(named) > 1 and "" in named)
    here = os.getcwd()
    if meant and here in sys.path and here not in [os.path.abspath(entry) for entry in named if entry]:
        sys.path.remove(here)
        if here == os.path.dirname(os.path.dirname(os.path.abspath(__file__))):
            sys.path.append(here)  # the package itself is there, and its workers look for it


_leave_the_current_folder()  # before anything is imported: no `from __future__` above

# A program answers no signal before this is done (`start`): what takes time is imported where it is needed.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

__version__ = "0.1.0"

# imported when they are first used: `spadmnist --help` needs neither numpy nor numba
_PUBLIC = {
    "open": "dataset",
    "concatenate": "dataset",
    "fetch": "fetching",
    "Dataset": "dataset",
    "Part": "dataset",
    "open_measurement": "measurement",
    "Capture": "measurement",
    "simulate": "library",
    "compare": "library",
    "diagnose": "library",
    "fit": "library",
    "Measurement": "measurement",
    "Events": "events",
    "Layout": "events",
    "Sensor": "sensor",
    "read_sensor": "config",
    "Effect": "effects",
    "Conditions": "effects",
    "parameter": "plugins",
    "Children": "events",
    "SpadError": "errors",
}

_MODULES = ("effects",)  # spadmnist.effects.DarkCounts(rate=100.0)

__all__ = sorted([*_PUBLIC, *_MODULES])


def __getattr__(name: str) -> "Any":
    if name not in _PUBLIC and name not in _MODULES:
        raise AttributeError(f"module 'spadmnist' has no attribute {name!r}")
    from importlib import import_module

    if name in _MODULES:
        return import_module(f".{name}", __name__)
    return getattr(import_module(f".{_PUBLIC[name]}", __name__), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
