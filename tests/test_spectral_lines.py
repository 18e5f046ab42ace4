"""Lines: frequencies that stand out of the power spectra."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from spadmnist.inference.laws import Exponential
from spadmnist.inference.spectral_lines import CaptureSpectrum, fitted_line, spectral_lines

STEPS = {"dark": 10.0, "dim": 20.0, "bright": 66.7, "red": 33.3}  # Hz, from bin to bin
BINS = 400


RECORDINGS = 32


def beside(powers: dict[str, np.ndarray], usual: dict[str, np.ndarray] | None = None) -> tuple[Any, Any]:
    """Replicates and an evaluation with these spectra, in units of their mean, which 32 recordings of the model tell.

    usual: the model's own spectra, where they are not flat.
    """
    rng = np.random.default_rng(sum(power.size for power in powers.values()))
    cells = {(id, "spectrum"): power for id, power in powers.items()}
    seen = {
        id: SimpleNamespace(
            capture=SimpleNamespace(light=SimpleNamespace(dark=id == "dark")),
            total=1000.0,
            summaries={"spectrum": SimpleNamespace(values=power, axis=STEPS[id] * np.arange(1, power.size + 1))},
        )
        for id, power in powers.items()
    }
    means = {
        cell: rng.gamma(RECORDINGS, 1 / RECORDINGS, p.size) * (usual[cell[0]] if usual else 1.0)
        for cell, p in cells.items()
    }
    residuals = {
        cell: stats.norm.isf((1 + np.maximum(p, 1e-12) / means[cell] / RECORDINGS) ** -RECORDINGS)
        for cell, p in cells.items()
    }
    nulls = {
        cell: SimpleNamespace(
            law=Exponential(), recordings=RECORDINGS, expected=lambda total, mean=mean: (mean, RECORDINGS**-0.5)
        )
        for cell, mean in means.items()
    }
    return SimpleNamespace(seen=seen), SimpleNamespace(residuals=residuals, nulls=nulls)


def noise(seed: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {id: rng.exponential(size=BINS) for id in STEPS}


def swinging(seed: int, frequency: float, strength: float, dark: bool = False) -> dict[str, np.ndarray]:
    """Noise, and in the captures with light (or the dark one) a line of so much power."""
    powers = noise(seed)
    for id, power in powers.items():
        if (id == "dark") == dark:
            power[round(frequency / STEPS[id]) - 1] += strength
    return powers


@pytest.mark.parametrize("seed", range(5))
def test_a_line_that_no_capture_shows_by_itself_is_seen_in_all_of_them(seed: int) -> None:
    # e^-9 in one of 400 bins is nothing; three of them at one frequency are 1e-8 after 400 bins of four captures
    found = spectral_lines(*beside(swinging(seed, 200.0, 9.0)))
    assert found and abs(found[0].frequency - 200.0) < 40.0 and found[0].p < 1e-3


def test_a_line_of_the_dark_capture_alone_is_seen_too() -> None:
    found = spectral_lines(*beside(swinging(3, 1000.0, 40.0, dark=True)))
    assert len(found) == 1 and abs(found[0].frequency - 1000.0) < 10.0


@pytest.mark.parametrize("seed", range(20))
def test_a_lamp_that_fluctuates_has_no_line_but_one_that_also_swings(seed: int) -> None:
    """Power of 50 times the noise that falls off with the frequency. False alarms: 1e-3 of a set, 2 % of them all."""
    powers = noise(seed)
    for id in powers:
        frequency = STEPS[id] * np.arange(1, BINS + 1)
        powers[id] *= 1 + (id != "dark") * 50 / (1 + (frequency / 1500.0) ** 2)
    assert not spectral_lines(*beside(powers))
    for id, power in powers.items():
        if id != "dark":
            power[round(2000.0 / STEPS[id]) - 1] += 400.0
    found = spectral_lines(*beside(powers))
    assert found and abs(found[0].frequency - 2000.0) < 70.0


@pytest.mark.parametrize("bin_", [1, 3, 6, 200, BINS - 2])
def test_a_strong_line_is_seen_wherever_it_is_and_beside_another(bin_: int) -> None:
    """It does not raise its own neighbourhood, at neither end of the spectrum, and two do not hide each other."""
    for others in ((), (bin_ + 8,)):
        powers = noise(5)
        for k in (bin_, *others):
            powers["dark"][min(k, BINS - 1)] += 300.0
        found = spectral_lines(*beside(powers))
        assert found and found[0].log_p < -50
        assert min(abs(found[0].frequency - 10.0 * (k + 1)) for k in (bin_, *others)) < 10.0


@pytest.mark.parametrize("seed", range(5))
def test_what_swings_less_than_one_and_a_half_times_is_no_line(seed: int) -> None:
    """A ramp's harmonics fall as 1 over their number; what swings twice in the longest capture does swing."""
    rng = np.random.default_rng(seed)
    k = np.arange(1, BINS + 1)

    def lit(amplitude: Any) -> dict[str, np.ndarray]:
        chance = {id: rng.standard_normal(BINS) + 1j * rng.standard_normal(BINS) for id in STEPS}
        return {id: abs(z / np.sqrt(2) + (id != "dark") * amplitude(id)) ** 2 for id, z in chance.items()}

    assert all(line.frequency >= 30.0 for line in spectral_lines(*beside(lit(lambda id: 4.0 / k))))
    found = spectral_lines(*beside(lit(lambda id: 12.0 * np.sinc(40.0 / STEPS[id] - k))))
    assert found and abs(found[0].frequency - 40.0) < 5.0


def test_what_few_recordings_hide_their_neighbours_tell() -> None:
    """7 more in each of three bins are seen in 55 of 60 sets; each beside its own mean of 32 recordings, in 11."""
    found = [spectral_lines(*beside(swinging(seed, 200.0, 7.0))) for seed in range(60)]
    assert sum(bool(f) and abs(f[0].frequency - 200.0) < 40.0 for f in found) > 30


def test_a_line_that_the_model_has_is_none() -> None:
    usual = {id: np.ones(BINS) for id in STEPS}
    for id, mean in usual.items():
        mean[round(200.0 / STEPS[id]) - 1] += 30.0
    powers = {id: power * usual[id] for id, power in noise(5).items()}
    for id, power in powers.items():
        power[round(200.0 / STEPS[id]) - 1] = 40.0
    assert not spectral_lines(*beside(powers, usual))


def test_of_noise_no_more_is_called_a_line_than_is_said() -> None:
    # each set has a line with p <= 1e-3; of 300 sets 4 and more do with a chance of 3e-4
    assert sum(bool(spectral_lines(*beside(noise(1000 + n)))) for n in range(300)) <= 3


def test_where_it_lies_between_two_bins() -> None:
    time = np.arange(4096) * 1e-4
    powers = {}
    for id, length in (("dark", 1000), ("dim", 500), ("bright", 150), ("red", 300)):
        swing = 0.0 if id == "dark" else 0.3
        n = np.random.default_rng(length).poisson(1000 * (1 + swing * np.cos(2 * np.pi * 213.0 * time[:length])))
        power = np.abs(np.fft.rfft(n)[1:-1]) ** 2
        powers[id] = power / np.median(power) * np.log(2)
    found = spectral_lines(*beside(powers))
    assert abs(found[0].frequency - 213.0) < 3 * found[0].error and found[0].error < 3.0


@pytest.mark.parametrize(
    ("strength", "frequency"),
    [
        (560.0, 307.0),
        (1e6, 307.0),  # its error is a hundredth of the distance of the places that are tried first
        *(pytest.param(s, f, marks=pytest.mark.slow) for s in (60.0, 5000.0) for f in (294.0, 300.0, 307.0, 310.0)),
    ],
)
def test_how_exactly_it_is_known(strength: float, frequency: float) -> None:
    """Two captures, of one a bin and of the other a third of one; its distance has a normal law of the stated width.

    In the middle of a bin, 300 Hz, both sides say as much, so that it is nearer than its error says.
    """
    rng, trials = np.random.default_rng(8), 300
    pulls = []
    for _ in range(trials):
        group = []
        for step, bins in ((20.0, 200), (100 / 3, 120)):
            x = frequency / step - np.arange(1, bins + 1)
            line = np.sqrt(strength) * np.sinc(x) * np.exp(1j * (2 * np.pi * rng.random() + np.pi * x))
            power = np.abs(line + (rng.standard_normal(bins) + 1j * rng.standard_normal(bins)) / np.sqrt(2)) ** 2
            group.append(CaptureSpectrum(power, np.sqrt(power), power, step, False))
        about = 20.0 * (1 + int(np.argmax(group[0].power[:60])))
        found = fitted_line(group, about, -50.0)
        pulls.append((found.frequency - frequency) / found.error)
    covered = np.abs(pulls) < 1.96
    # of 300 at 95 %, 265 and fewer have a chance of 1e-6
    assert covered.sum() > 265
    assert frequency == 300.0 or 0.8 < np.std(pulls) < 1.5
