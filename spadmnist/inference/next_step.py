"""The next step: what a user does with an answer, in one sentence with the command to type."""

from __future__ import annotations

from .comparison import Comparison
from .results import Diagnosis, nearest

# what commands name; a terminal puts the paths that it was given in their places
SENSOR, MEASUREMENT = "SENSOR", "MEASUREMENT"
_ANOTHER = "a measurement that it was not fitted to tests it"


def after_comparison(found: Comparison, sensor: str = SENSOR, measurement: str = MEASUREMENT, out: str = "next") -> str:
    """What follows a comparison.

    Args:
        sensor, measurement: as the command named them, quoted for a shell.
        out: the folder of a diagnosis, another one than that of the sensor.
    """
    if found.verdict == "adequate" and any(check.significant for check in found.checks):
        return f"spadmnist diagnose {sensor} {measurement} -o {out} finds what makes these checks differ."
    if found.verdict == "adequate":
        if found.full:
            return (
                f"take {' and '.join(found.full)} with less light: nearly all of it is full, so that it tests hardly "
                "anything."
            )
        few = ""
        if found.faint:
            few = (
                f" Of {' and '.join(found.faint)} so few detections are expected that their number alone was compared."
            )
        return (
            f"spadmnist diagnose {sensor} {measurement} gives a 95 % upper limit on each effect; a brighter, a darker "
            f"or a longer capture tests the model further.{few}"
        )
    return f"spadmnist diagnose {sensor} {measurement} -o {out} finds what the model lacks."


def after_diagnosis(
    found: Diagnosis,
    sensor: str = SENSOR,
    measurement: str = MEASUREMENT,
    new: str | None = "next/sensor.yaml",
    same: str = "-o next",
    kept: bool = True,
) -> str:
    """What follows a diagnosis or a fit.

    Args:
        sensor, measurement: as of `after_comparison`.
        new: the next sensor file; None where it was not written.
        same: the options of the same diagnosis.
        kept: a diagnosis that is not finished goes on from its journal.
    """
    if not found.finished:
        how = "goes on to the end" if kept else "begins again, keeps what it simulates, and goes to the end"
        return f"spadmnist diagnose {sensor} {measurement} {same} --within none {how}."
    if found.asked == "fit" and new is None:
        return "the same command with another place for -o writes the fitted model, for compare to check."
    if found.asked == "fit":
        return f"spadmnist compare {new} {measurement} checks the fitted model; {_ANOTHER}."
    if found.verdict == "adequate":
        return "nothing is missing; a brighter, a darker or a longer capture tests the model further."
    if found.advice and found.verdict == "confused":
        return f"take {found.advice[-1]['capture']}, add it to the measurement, and diagnose again."
    if found.verdict == "confused" and found.or_setup:
        last = found.steps[-1]
        start = new if len(found.steps) > 1 and new else sensor  # the file has the steps before it
        option = f"--add {last.effect}" if last.change == "add" else f"--free {last.effect}.{last.parameter}"
        return (
            f"measure {_stated(found)} again and correct measurement.yaml; if it is as stated, spadmnist fit {start} "
            f"{measurement} {option} -o NEXT puts {last.effect} into the model."
        )
    if new is None and found.steps and found.verdict in ("explained", "partly_explained", "confused"):
        return f"spadmnist diagnose {sensor} {measurement} {same} writes the new model, for compare to check."
    if found.verdict == "explained" and found.faulty:
        return (
            f"measure the light of {found.faulty} again, correct measurement.yaml, and type spadmnist compare {new} "
            f"{measurement}."
        )
    if found.verdict == "setup" and found.setup:
        return (
            f"measure {_stated(found)} again, correct measurement.yaml, "
            f"and type spadmnist diagnose {sensor} {measurement} {same}: faint effects, which fail no check, are "
            "looked for where the totals agree."
        )
    if found.verdict == "unexplained":
        near = nearest(found)
        like = f", perhaps like {near[0]}" if near else ""
        return (
            f"spadmnist effects --new NAME writes the file of a new effect{like}; then spadmnist diagnose {sensor} "
            f"{measurement} --plugin NAME.py tries it."
        )
    if found.stopped:
        return f"spadmnist diagnose {new} {measurement} -o further goes on from the new model; it may take more steps."
    if found.verdict == "partly_explained":
        return (
            f"spadmnist compare {new} {measurement} shows what remains; spadmnist effects --new NAME writes the file "
            "of an effect for it."
        )
    return f"spadmnist compare {new} {measurement} checks the new model; {_ANOTHER}."


def _stated(found: Diagnosis) -> str:
    """What of the set-up is to be measured again, in words: the quantities of each capture."""
    quantities: dict[str, list[str]] = {}
    for entry in found.setup:
        quantities.setdefault(entry["capture"] or "all captures", []).append(entry["quantity"])
    captures: dict[str, list[str]] = {}
    for capture, names in quantities.items():
        captures.setdefault(" or ".join(dict.fromkeys(names)), []).append(capture)
    return ", and ".join(f"the {names} of {' and '.join(of)}" for names, of in captures.items())
