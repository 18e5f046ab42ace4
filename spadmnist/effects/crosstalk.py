"""Optical crosstalk."""

from __future__ import annotations

import math

import numpy as np

from .. import kernels
from ..events import Children, Events
from ..streams import Draws
from . import Chip, Conditions, Effect, parameter

# neighbours of a pixel on a grid, from which on the closed form is by the fast Fourier transform: with 380 of them that
# is some 10 times as fast (256 x 256 pixels); a rule of thumb
_MANY = 24
_CERTAIN = 40.0  # hazard of a neighbour that is hit for certain: exp(-40) is less than any draw can resolve


class Crosstalk(Effect, stage="correlated"):
    """The light of an avalanche fires other pixels with a probability that falls with their distance.

    The probability for one pixel at distance d, in pitches, is probability * K(d). K(1) = 1 and K(d) =
    diagonal_ratio^((d - 1) / (sqrt 2 - 1)). Beyond the diagonal K(d) is at least far_ratio / d, as for light that
    spreads in the plane of the chip. Pixels beyond `reach` are not fired. Each pixel is fired independently. Under
    `rules: paper` every event may cause crosstalk, and crosstalk causes none. Under `rules: device` only recorded
    detections do, in cascades.
    Source: 0.1 % to side neighbours, 0.016 % to diagonal ones in 48-pixel arrays (Ingargiola et al., bioRxiv 207118,
    whose 1125 pairs this law fits to the scatter among pixels with 0.092 %, 0.16, 0.028 out to 11 pitches); 0.22 % in
    LinoSPAD2, delays below 20 ns (Kulkov et al., arXiv 2406.15323).
    """

    counted = True
    moves = ("neighbours", "far_pairs", "ceiling", "level", "dark_level")

    probability = parameter(
        0.002,
        "",
        "probability that an avalanche fires one given side neighbour",
        symbol="P_xt",
        bounds=(0, 1),
        off=0.0,
        search=(1e-5, 0.05),
    )
    diagonal_ratio = parameter(
        0.3, "", "probability for a diagonal neighbour relative to a side neighbour", bounds=(0, 1), search=(0.02, 1)
    )
    delay = parameter(
        100e-12,
        "s",
        "mean of the exponential delay of the neighbour's avalanche; 0 s: none",
        symbol="tau_xt",
        bounds=(0, None),
        search=(20e-12, 1e-6),
    )
    reach = parameter(
        1.5,
        "",
        "distance of the farthest pixels that are fired, pitches; 1.5: side and diagonal",
        bounds=(1, None),
        search=(1.5, 12),
        kind="count",
        needs="far_ratio",
    )
    far_ratio = parameter(
        0.0,
        "",
        "lower bound of d K(d) beyond the diagonal",
        bounds=(0, 1),
        off=0.0,
        search=(0.003, 1),
    )

    def chance(self, distance: np.ndarray) -> np.ndarray:
        """(k,) chance that an avalanche fires a pixel at these distances (k,), in pitches."""
        steps = np.where(distance < 1.001, 0.0, distance - 1) / (math.sqrt(2) - 1)
        ratio = np.power(self.diagonal_ratio, steps)
        far = np.where(distance < 1.001 * math.sqrt(2), 0.0, self.far_ratio / distance)
        return np.asarray(self.probability * np.maximum(ratio, far))

    def made(self, chip: Chip) -> None:
        layout = chip.layout
        near = layout.neighbours(self.reach)
        chance = self.chance(near.distance)
        hit = chance > 0
        step, chance = near.step[hit], chance[hit]
        if near.first is None:
            # one list for all pixels: its steps may lead out of the array
            self._first = np.array([0, len(chance)])
            self._steps = step
        else:
            self._first = np.concatenate([[0], np.cumsum(hit)])[near.first]
            home = np.repeat(np.arange(layout.pixels), np.diff(self._first))
            self._steps = np.stack([step - home, 0 * home], axis=1)
        self._chance = chance
        self._spectrum: np.ndarray | None = None
        if near.first is None and len(chance) > _MANY:
            rows, columns = layout.shape
            away = np.abs(step).max(axis=0)
            self._padded = (rows + int(away[1]), columns + int(away[0]))  # so that none comes round the end
            kernel = np.zeros(self._padded)
            kernel[step[:, 1], step[:, 0]] = chance
            self._spectrum = np.fft.rfft2(kernel)
        with np.errstate(divide="ignore"):
            hazard = np.minimum(-np.log1p(-chance), _CERTAIN)
        self._shape = layout.shape
        self._sums = np.concatenate([[0.0], np.cumsum(hazard)])

    def spawn(self, events: Events, rng: Draws) -> Children:
        parent, row, delay = _hits(
            events.offsets, self._first, self._sums, self._steps, *self._shape, rng.images, rng.key
        )
        return Children(parent, self.delay * delay, row)

    def mean_delay(self) -> float:
        """That of the neighbour's avalanche, s."""
        return float(self.delay)

    def influence(self) -> float:
        """Pitches to the farthest neighbours that are hit."""
        return float(self.reach) if self.probability else 0.0

    def expected_rate(self, rate: np.ndarray, conditions: Conditions) -> np.ndarray:
        """rate + sum over the other pixels of chance(their distance) * their rate."""
        if self._spectrum is not None:
            images = rate.reshape(len(rate), *self._shape)
            reached = np.fft.irfft2(np.fft.rfft2(images, self._padded) * self._spectrum, self._padded)
            rows, columns = self._shape
            return rate + np.maximum(reached[:, :rows, :columns], 0.0).reshape(rate.shape)
        before, after = np.array(rate, order="C"), np.array(rate, order="C")
        _receive(after, before, self._first, self._chance, self._steps, *self._shape)
        return after


@kernels.jit
def _receive(after, rate, first, chance, steps, rows, columns):  # type: ignore[no-untyped-def]
    """Add to each pixel what its neighbours' rates (images, pixels) fire there; the lists are those of `_hits`."""
    for i in range(rate.shape[0]):
        for pixel in range(rows * columns):
            entry = 0 if first.size == 2 else pixel
            for k in range(first[entry], first[entry + 1]):
                x = pixel % columns + steps[k, 0]
                y = pixel // columns + steps[k, 1]
                if 0 <= x < columns and 0 <= y < rows:
                    after[i, y * columns + x] += chance[k] * rate[i, pixel]


@kernels.jit
def _hits(offsets, first, sums, steps, rows, columns, images, key):  # type: ignore[no-untyped-def]
    """Who is hit: (event, row, delay in units of its mean), in the order of the events.

    One unit-rate Poisson process runs along an image's events, each as long as the hazards of its pixel's neighbours
    together: entries first[p] to first[p + 1] of `steps`, with `sums` (k + 1,) of their hazards; one list for all
    pixels where `first` has two entries. A neighbour is hit where a point falls into its part, which has the chance
    1 - exp(-hazard) whatever happens to others; a second point there changes nothing.
    """
    pixels = rows * columns
    parents = np.empty(64, np.int64)
    targets = np.empty(64, np.int64)
    delays = np.empty(64)
    found = 0
    for i in range(images.size):
        block = np.uint64(0)
        distance, later = kernels.philox(block, images[i], key[0], key[1], key[2])
        position = kernels.exponential(distance)
        for pixel in range(pixels):
            row = i * pixels + pixel
            entry = 0 if first.size == 2 else pixel
            begin, end = first[entry], first[entry + 1]
            total = sums[end] - sums[begin]
            count = offsets[row + 1] - offsets[row]
            stretch = count * total
            while position < stretch:
                event = min(np.int64(position / total), count - 1)
                within = sums[begin] + (position - event * total)
                step = begin + np.searchsorted(sums[begin + 1 : end], within, side="right")
                x = pixel % columns + steps[step, 0]
                y = pixel // columns + steps[step, 1]
                if 0 <= x < columns and 0 <= y < rows:
                    parent = offsets[row] + event
                    target = i * pixels + y * columns + x
                    known = found
                    while known > 0 and parents[known - 1] == parent and targets[known - 1] != target:
                        known -= 1
                    if known == 0 or parents[known - 1] != parent:
                        if found == parents.size:
                            parents = np.concatenate((parents, parents))
                            targets = np.concatenate((targets, targets))
                            delays = np.concatenate((delays, delays))
                        parents[found] = parent
                        targets[found] = target
                        delays[found] = kernels.exponential(later)
                        found += 1
                block += np.uint64(1)
                distance, later = kernels.philox(block, images[i], key[0], key[1], key[2])
                position += kernels.exponential(distance)
            position -= stretch
    return parents[:found].copy(), targets[:found].copy(), delays[:found].copy()
