"""A measurement at a first look: the table and the picture of its captures, and the table of its flux images."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .. import look, pictures, units
from ..errors import SpadError
from ..measurement import Measurement
from ..recording import Capture, Recording
from . import _text as text

_MOST_CAPTURES = 16  # of a picture
_BINS = 200  # of the course of a capture
_PER_DECADE = 10  # bins of intervals


@dataclass(frozen=True)
class Look:
    """What is shown of a capture. numbers: see `look.look`; the others only for a picture, of what was recorded.

    totals: (pixels,) detections; intervals: (edges, s; counts) of TR; course: (time, s; ones or counts of a frame,
    their standard error) of frames.
    """

    capture: Capture
    numbers: dict[str, Any]
    totals: np.ndarray | None = None
    intervals: tuple[np.ndarray, np.ndarray] | None = None
    course: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None


def looks(measurement: Measurement, drawn: bool) -> list[Look]:
    """Read the captures, one after the other. drawn: for a picture, too."""
    found = []
    for i, capture in enumerate(measurement.captures):
        unknown = capture.mean is not None or capture.id in measurement.missing
        recorded = None if unknown else measurement.recording(capture.id)
        numbers = look.look(measurement, capture, recorded)
        if recorded is None or not drawn or i >= _MOST_CAPTURES:
            found.append(Look(capture, numbers))
        elif recorded.events is not None:
            found.append(Look(capture, numbers, recorded.totals, _histogram_of_intervals(recorded)))
        else:
            found.append(Look(capture, numbers, recorded.totals, None, _course(recorded)))
    return found


def _histogram_of_intervals(recorded: Recording) -> tuple[np.ndarray, np.ndarray]:
    assert recorded.events is not None
    exposure, tick = recorded.conditions.exposure, recorded.events.tick or 1e-12
    decades = math.log10(exposure / tick)
    edges = tick * 10 ** np.linspace(0, decades, max(2, round(_PER_DECADE * decades) + 1))
    # edges between ticks, so that each bin holds the whole ones it covers
    edges = np.unique(np.round(edges / tick)) * tick - tick / 2
    counts = np.zeros(len(edges) - 1, np.int64)
    for piece in look.intervals(recorded.events):
        counts += np.histogram(piece, edges)[0]
    return edges, counts


def _course(recorded: Recording) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    sums = []
    for _, part in recorded.chunks():
        if recorded.modality == "qis":
            part = np.bitwise_count(part)
        elif recorded.modality == "str":
            part = part < recorded.none
        sums.append(part.reshape(len(part), -1).sum(axis=1, dtype=np.int64))
    whole = np.concatenate(sums).astype(float)
    starts = np.unique(np.linspace(0, len(whole), min(_BINS, len(whole)), endpoint=False).astype(int))
    sizes = np.diff([*starts, len(whole)])
    means = np.add.reduceat(whole, starts) / sizes
    time = (starts + sizes / 2) * recorded.conditions.exposure / len(whole)
    each = recorded.totals / len(whole)
    variance = each.sum() if recorded.modality == "counts" else (each * (1 - each)).sum()
    return time, means, np.sqrt(variance / sizes)


def capture_table(measurement: Measurement, looks: Sequence[Look]) -> str:
    """What a measurement is, and its captures (one row each). At most 100 characters wide."""
    layout = measurement.layout
    places = ", at places of their own" if layout.positions is not None else ""
    facts = {
        "name": measurement.name,
        "pixels": f"{layout.rows} x {layout.columns}{places}",
        "captures": f"{len(looks)}",
    }
    head = ("capture", "modality", "light", "recorded", "detections", "a pixel", "ones")
    made, seen = [], []
    for one in looks:
        n = one.numbers
        row = (text.short(n["capture"]), n["modality"], n["light"], _recorded(n), text.integer(n["detections"]))
        made.append((*row, text.number(n["mean"]), text.percent(n["ones_share"])))
        if n["detections"] is not None:
            rates = [units.show(n[f"rate_{what}"], "Hz", 3) for what in ("median", "min", "max")]
            odd = [text.integer(n[f"{what}_pixels"]) for what in ("empty", "dead", "hot")]
            shortest = n["shortest_interval"]
            seen.append((row[0], *rates, *odd, "-" if shortest is None else units.show(shortest, "s")))
    blocks = [text.facts(facts), text.aligned(head, made)]
    if seen:
        blocks += [text.aligned(_LOOK_HEADER, seen), _LOOK_LEGEND]
    blocks += [text.wrapped(f"{one.capture.id}: {note}.") for one in looks for note in one.numbers["notes"]]
    return "\n\n".join(blocks)


_LOOK_HEADER = ("capture", "median rate", "min", "max", "empty", "dead", "hot", "shortest interval")
_LOOK_LEGEND = """\
a pixel: mean detections. ones: frames with a detection. rates: of a pixel, as recorded, while it is
live. empty: pixels without a detection. dead: those, where the median pixel has 20 or more.
hot: more than 5 times the median, beyond noise. shortest interval: within a pixel."""


def flux_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Flux images (see `fluxes.Fluxes.rows`), one row each, and what the methods were told of their captures."""
    made, told = [], {}
    for row in rows:
        numbers = (text.number(row[what]) for what in ("mean", "median", "min", "max"))
        made.append(
            (text.short(row["capture"]), row["method"], *numbers, text.integer(row["saturated_pixels"]), row["unit"])
        )
        clock = (units.show(row[what], "s") for what in ("time", "dead_time"))
        told[row["capture"]] = (text.short(row["capture"]), row["modality"], f"{row['pdp']:.4g}", *clock)
    head = ("capture", "method", "mean", "median", "min", "max", "saturated", "unit")
    blocks = [
        text.aligned(head, made),
        text.aligned(("capture", "modality", "q", "T", "dead time"), list(told.values())),
    ]
    return "\n\n".join([*blocks, _FLUX_LEGEND])


_FLUX_LEGEND = """\
mean to max: over the pixels. saturated: pixels in which a rule stands in for the formula of the
method (spadmnist methods NAME states it). q: nominal PDP. T: exposure, or frames x frame time."""


def _recorded(numbers: Mapping[str, Any]) -> str:
    if numbers["frames"] is None:
        return units.show(numbers["exposure"], "s")
    frames = f"{numbers['frames']:,} x {units.show(numbers['frame_time'], 's')}"
    if numbers["binary_frames"] == 1:
        return frames
    frames = f"{numbers['frames']:,} x {numbers['binary_frames']:,} x {units.show(numbers['frame_time'], 's')}"
    return f"{frames} = {units.show(numbers['live'], 's')}"


def capture_sheet(measurement: Measurement, looks: Sequence[Look], path: str | Path) -> None:
    """Draw a PNG with a row for each capture: the map of rates, their histogram, and intervals (TR) or the course of
    the frames. Raises SpadError where it cannot be written, or where there are no data.
    """
    shown = [one for one in looks if one.totals is not None]
    if not shown:
        raise SpadError(f"{measurement.source}: of no capture are there data to draw; only means are known")
    pictures.save(_draw_captures(measurement, shown, len(looks)), Path(path))


def _draw_captures(measurement: Measurement, looks: Sequence[Look], captures: int) -> bytes:
    def draw(figure: Any) -> None:
        rest = f", {len(looks)} of {captures} captures" if len(looks) < captures else ""
        figure.suptitle(
            f"{pictures.words(text.short(measurement.name, 80))}: {_size_of(measurement)} pixels{rest}", fontsize=13
        )
        cells = figure.subplots(len(looks), 3, squeeze=False, width_ratios=(1, 1.2, 1.6))
        for row, one in zip(cells, looks, strict=True):
            _rate_map(row[0], measurement, one)
            _rate_histogram(row[1], one)
            if one.intervals is not None:
                _interval_plot(row[2], one)
            else:
                _course_plot(row[2], one)

    return pictures.png(13, 0.9 + 2.7 * len(looks), draw)


def _size_of(measurement: Measurement) -> str:
    return f"{measurement.layout.rows} x {measurement.layout.columns}"


def _rate_map(axes: Any, measurement: Measurement, one: Look) -> None:
    assert one.totals is not None
    rates = one.totals / one.numbers["live"]
    # a few hot or dead pixels must not take the colours from the rest
    below, median, above = np.quantile(rates, [0.16, 0.5, 0.84])
    spread = max(float(above - below) / 2, 1 / one.numbers["live"])
    low, high = max(float(rates.min()), median - 4 * spread), min(float(rates.max()), median + 4 * spread)
    high = max(high, low + spread)  # where all pixels are alike, as without any detection
    scale, unit = _scaled(float(high))
    name = pictures.words(text.short(one.capture.id))
    axes.set_title(f"{name}: {one.numbers['light']}, {_recorded(one.numbers)}", loc="left")
    label = f"detections / pixel, {unit}"
    pictures.draw_map(axes, measurement.layout, rates * scale, low * scale, high * scale, label)


def _scaled(value: float) -> tuple[float, str]:
    """(factor, unit) that bring a rate in Hz between 1 and 1000."""
    unit = units.show(value, "Hz", 17).split()[1] if value > 0 else "Hz"
    return 1 / float(units.parse(f"1 {unit}", "Hz")), unit


def _rate_histogram(axes: Any, one: Look) -> None:
    """Draw the histogram of the pixels' detections, in bins of whole numbers, with the law of equal pixels."""
    from scipy.special import gammaln, xlog1py, xlogy

    assert one.totals is not None
    totals, live, frames = one.totals, one.numbers["live"], one.numbers["frames"]
    binary = one.capture.modality in ("qis", "str")
    median = float(np.median(totals))
    inner = totals[totals <= 3 * median + 20]
    usual = inner[np.abs(inner - median) <= 5 * math.sqrt(median * (1 - median / frames if binary else 1) + 1)]
    mean = float(usual.mean())
    low, high = int(inner.min()), int(inner.max())
    bins = int(np.clip(2 * math.sqrt(len(inner)), 12, 50))
    width = max(1, -(-(high - low + 1) // bins))
    edges = np.arange(low, high + width + 1, width)
    scale, unit = _scaled(high / live)
    to_rate = scale / live
    axes.stairs(np.histogram(inner, edges)[0], (edges - 0.5) * to_rate, fill=True, color="0.75", label="pixels")
    n = np.arange(edges[0], edges[-1])
    if binary:
        p = min(mean / frames, 1.0)
        n = np.minimum(n, frames)
        ways = gammaln(frames + 1) - gammaln(n + 1) - gammaln(frames - n + 1)
        law, name = np.exp(ways + xlogy(n, p) + xlog1py(frames - n, -p)), "binomial law"
    else:
        law, name = np.exp(xlogy(n, mean) - mean - gammaln(n + 1)), "Poisson law"
    sums = np.add.reduceat(law, edges[:-1] - edges[0]) * len(usual)
    axes.stairs(sums, (edges - 0.5) * to_rate, color="tab:orange", label=f"{name}, equal pixels")
    beyond = len(totals) - len(inner)
    more = f" ({beyond:,} beyond)" if beyond else ""
    axes.margins(y=0.3)  # room for the legend
    axes.set(xlabel=f"detections of a pixel, {unit}{more}", ylabel="pixels")
    if low == 0:  # half of the bar of no detections lies below
        axes.set_xlim(left=0)
    axes.legend(frameon=False, fontsize=7, loc="upper right")


def _interval_plot(axes: Any, one: Look) -> None:
    assert one.intervals is not None and one.totals is not None
    edges, counts = one.intervals
    exposure = one.numbers["exposure"]
    if not counts.sum():
        axes.text(0.5, 0.5, "no two detections in a pixel", ha="center", transform=axes.transAxes)
        axes.set_axis_off()
        return
    widths = np.diff(edges)
    axes.stairs(counts / widths, np.maximum(edges, 1e-15), color="tab:blue", label="intervals of a pixel")
    # each pixel steady at its own rate, and nothing else
    expected = np.zeros(len(counts))
    for total, pixels in zip(*np.unique(one.totals, return_counts=True), strict=True):
        if total > 1:
            expected += pixels * (total - 1) * -np.diff(np.exp(-total / exposure * edges))
    axes.stairs(expected / widths, np.maximum(edges, 1e-15), color="tab:orange", label="steady light, no dead time")
    shortest = one.numbers["shortest_interval"]
    if shortest:
        axes.axvline(
            shortest, color="0.6", linewidth=0.8, linestyle=":", label=f"shortest: {units.show(shortest, 's')}"
        )
    some = counts > 0
    low, high = float((counts / widths)[some].min()), float(max((counts / widths).max(), (expected / widths).max()))
    right = edges[1:][some].max()
    axes.set(xscale="log", yscale="log", ylim=(low / 2, high * 2 * (high / low) ** 0.25))
    axes.set(xlim=(max(edges[0], (shortest or 0) / 5), right), xlabel="interval, s", ylabel="intervals / s")
    axes.legend(frameon=False, fontsize=7, loc="upper right")


def _course_plot(axes: Any, one: Look) -> None:
    assert one.course is not None
    time, means, errors = one.course
    # where frames are all alike, the errors are 0 and the means the same
    mean = float(np.average(means, weights=errors**-2) if (errors > 0).all() else means.mean())
    factor = next(f for f, _ in _TIMES if time[-1] * f >= 1 or f == _TIMES[-1][0])
    unit = dict(_TIMES)[factor]
    axes.fill_between(time * factor, mean - 2 * errors, mean + 2 * errors, color="0.88", label="2 standard errors")
    axes.plot(time * factor, means, color="tab:blue", linewidth=0.9)
    what = "counts" if one.capture.modality == "counts" else "ones"
    axes.margins(y=0.2)
    axes.set(xlabel=f"time, {unit}", ylabel=f"{what} of a frame", ylim=(max(0.0, axes.get_ylim()[0]), None))
    axes.legend(frameon=False, fontsize=7, loc="upper right")


_TIMES = ((1.0, "s"), (1e3, "ms"), (1e6, "us"), (1e9, "ns"))
