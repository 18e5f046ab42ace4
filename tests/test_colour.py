"""Colour with a wavelength for each channel: photons, detections and fluxes of each at its own PDP."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import laws
import numpy as np
import pytest

import spadmnist
from spadmnist import config, document, factory, light, plan
from spadmnist.errors import ConfigError, InputError
from spadmnist.experiment import Experiment

WAVES = (620e-9, 540e-9, 460e-9)
PDP = {450e-9: 0.30, 550e-9: 0.48, 650e-9: 0.20}
CONFIG = """\
seed: 3
scene:
  images: {source: array, path: rgb.npy}
  wavelength: WAVELENGTH
  LEVEL
recording: {exposure: 1 ms, frames: 100, frame_time: 10 us, readouts: [tr, qis]}
sensor:
  layout: {rows: 4, columns: 6, pixel_area: 100 um^2}
  effects:
    detection: {pdp: {450 nm: 0.30, 550 nm: 0.48, 650 nm: 0.20}}
    dark_counts: {rate: 500 Hz}
    dead_time: {duration: 50 ns}
    tdc: {resolution: 100 ps}
"""
THREE = "[620 nm, 540 nm, 460 nm]"


def config_in(folder: Path, wavelength: str = THREE, level: str = "irradiance: [100 nW/cm^2]", grey: int = 0) -> Path:
    folder.mkdir(exist_ok=True)
    shape = (40, 4, 6) if grey else (40, 3, 4, 6)
    np.save(folder / "rgb.npy", np.full(shape, 204, np.uint8))
    file = folder / "colour.yaml"
    file.write_text(CONFIG.replace("WAVELENGTH", wavelength).replace("LEVEL", level))
    return file


def pdp(wavelength: float) -> float:
    return float(np.interp(wavelength, list(PDP), list(PDP.values())))


def photons(wavelength: float) -> float:
    """Of grey 204 of 255 at 100 nW/cm^2, 1/s on a pixel."""
    return 0.8 * light.photons_from_irradiance(100e-5, 100e-12, wavelength)


def open_(file: Path) -> Any:
    return spadmnist.open(file)["100 nW/cm^2", "train"]


def test_each_channel_is_detected_with_the_pdp_at_its_wavelength(tmp_path: Path) -> None:
    """40 images of 24 pixels, some 100 detections each; the dead time takes less than what 1e-6 can see."""
    part = open_(config_in(tmp_path))
    totals = np.zeros(3)
    for i in range(len(part)):
        totals += part.tr[i].counts.reshape(3, -1).sum(axis=1)
    for wavelength, total in zip(WAVES, totals, strict=True):
        rate = pdp(wavelength) * photons(wavelength) + 500
        mean = 40 * 24 * 1e-3 * rate / (1 + rate * 50e-9)
        laws.poisson_mean(int(total), mean)
    wrong = 40 * 24 * 1e-3 * (pdp(WAVES[0]) * photons(WAVES[1]) + 500)
    with pytest.raises(AssertionError):
        laws.poisson_mean(int(totals[1]), wrong)


@pytest.mark.parametrize("method", ["counts", "passive_free_running", "inter_photon"])
def test_a_flux_is_that_of_its_own_channel(method: str, tmp_path: Path) -> None:
    """Photons/s of each channel, dark counts as photons among them, to 1e-6; that of the first PDP is far away.

    The mean of (N - 1) over the time between N detections is larger than the rate by 1 / N or so.
    """
    part = open_(config_in(tmp_path))
    fluxes = part.reconstruction[method][:]
    assert fluxes.shape == (40, 3, 4, 6)
    for channel, wavelength in enumerate(WAVES):
        found = fluxes[:, channel].ravel()
        expected = photons(wavelength) + 500 / pdp(wavelength)
        if method == "inter_photon":
            expected *= 1 + 1e3 / (pdp(wavelength) * expected)
        bound = 4.9 * found.std() / np.sqrt(found.size) + 2e-3 * expected  # of the dead time that counts ignores
        assert abs(found.mean() - expected) < bound < 0.05 * expected


def test_bits_need_no_pdp(tmp_path: Path) -> None:
    part = open_(config_in(tmp_path))
    assert np.array_equal(part.reconstruction["qis_counts"][0], part.qis[0].sum(axis=1))


def test_three_times_the_same_wavelength_is_one(tmp_path: Path) -> None:
    """The same draws and the same fluxes, bit for bit."""
    one, three = (
        open_(config_in(tmp_path / "a", "540 nm")),
        open_(config_in(tmp_path / "b", "[540 nm, 540 nm, 540 nm]")),
    )
    assert np.array_equal(one.tr[0:40].ticks, three.tr[0:40].ticks)
    for method in one.reconstruction:
        assert np.array_equal(one.reconstruction[method][:], three.reconstruction[method][:])


def test_names_and_a_list_say_the_same(tmp_path: Path) -> None:
    named = config.read(config_in(tmp_path / "a", "{blue: 460 nm, red: 620 nm, green: 0.54 um}"))
    listed = config.read(config_in(tmp_path / "b", "[620 nm, 0.54 um, 460 nm]"))
    assert named.resolved == listed.resolved and named.wavelengths == pytest.approx(WAVES)
    assert named.resolved["scene"]["wavelength"] == ["620 nm", "0.54 um", "460 nm"]
    again = config.build(document.parse(document.dump(named.resolved), "again.yaml"), tmp_path / "a")
    assert again.resolved == named.resolved and again.wavelengths == named.wavelengths
    assert config.read(config_in(tmp_path / "c", "540 nm")).wavelengths == ()


def test_a_dataset_keeps_what_a_config_gives(tmp_path: Path) -> None:
    file = config_in(tmp_path)
    experiment = config.read(file)
    splits = experiment.load_images()
    factory.generate(experiment.with_methods(("counts",)), splits, tmp_path / "out", 1)
    factory.add_reconstructions(tmp_path / "out", ("inter_photon",), 1)
    stored, simulated = open_(tmp_path / "out"), open_(file)
    for method in ("counts", "inter_photon"):
        assert np.array_equal(stored.reconstruction[method][:], simulated.reconstruction[method][:])


def test_what_is_expected_is_what_comes(tmp_path: Path) -> None:
    """Of a dry run: photons and detections of all channels, within the scatter of the dataset."""
    experiment: Experiment = config.read(config_in(tmp_path))
    splits = experiment.load_images()
    told = plan._expected(experiment, experiment.levels[0], splits["train"], 40)
    assert told[0] == pytest.approx(40 * 24 * 1e-3 * sum(map(photons, WAVES)), rel=1e-9)
    part = open_(config_in(tmp_path))
    found = sum(len(part.tr[i]) for i in range(40))
    assert abs(found - told[1]) < laws.z_bound() * np.sqrt(told[1])


@pytest.mark.parametrize(
    ("wavelength", "sentence"),
    [
        ("[620 nm, 540 nm]", "scene.wavelength: .* give one wavelength, or one for each of red, green and blue"),
        ("{red: 620 nm, green: 540 nm, bleu: 460 nm}", "scene.wavelength: .* give red, green and blue"),
        ("[620 nm, 540 nm, 0 nm]", "scene.wavelength: 0 nm is not possible; it must be more than 0"),
        ("0 nm", "scene.wavelength: 0 nm is not possible; it must be more than 0"),
        ("[620 nm, 540 nm, 5 mlux]", "scene.wavelength: '5 mlux' is not"),
        ("[620 nm, 540, 460 nm]", "scene.wavelength: 540 needs a unit|scene.wavelength: .*540"),
        ("[620 nm, 540 nm, 800 nm]", "sensor.effects.detection.pdp: .*800 nm"),
    ],
)
def test_what_no_wavelengths_can_be(wavelength: str, sentence: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=sentence):
        config.read(config_in(tmp_path, wavelength))


def test_grey_images_have_one_wavelength(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="has 3 wavelengths, one for each channel, but the images are grey"):
        config.read(config_in(tmp_path, grey=1)).load_images()
    assert config.read(config_in(tmp_path, "540 nm", grey=1)).load_images()


def test_lux_of_another_colour_than_green_is_noted(tmp_path: Path) -> None:
    (note,) = config.read(config_in(tmp_path, THREE, "lux: [1 lux]")).notes
    assert "not at 620 nm" in note
