"""The next sensor file: every kind of value is read again as it was found, and the answer never depends on it."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

from spadmnist import cli, config, measurement, plugins, sensor_file
from spadmnist.errors import InputError, SpadError
from spadmnist.inference import model_selection
from spadmnist.inference.results import Diagnosis
from spadmnist.plugins import PER, ByWavelength

SENSOR = """sensor:
  name: small
  rules: device
  layout: {rows: ROWS, columns: COLUMNS, pixel_area: 25 um^2, fill_factor: 1.0}
  effects:
    detection: {pdp: 0.42}
    dark_counts: {rate: 100 Hz}
    dead_time: {duration: 50 ns}
    tdc: {resolution: 100 ps}
"""
OF_KIND: dict[str, tuple[str, str]] = {
    "": ("crosstalk", "probability"),
    "pixel": ("detection", "relative"),
    "row": ("row_pattern", "gain"),
    "column": ("column_pattern", "gain"),
    "code": ("tdc_nonlinearity", "widths"),
}


def sensor_in(folder: Path, rows: int, columns: int) -> Path:
    file = folder / "sensor.yaml"
    file.write_text(SENSOR.replace("ROWS", str(rows)).replace("COLUMNS", str(columns)))
    return file


@pytest.mark.parametrize(
    ("rows", "columns", "codes"), [(16, 16, 256), (4, 4, 4), (4, 4, 16), (2, 8, 16), (3, 5, 7), (1, 1, 1), (1, 6, 6)]
)
@pytest.mark.parametrize("per", PER)
def test_a_value_is_written_along_what_it_runs(per: str, rows: int, columns: int, codes: int, tmp_path: Path) -> None:
    file = sensor_in(tmp_path, rows, columns)
    size = {"": 0, "pixel": rows * columns, "row": rows, "column": columns, "code": codes}[per]
    value: Any = 0.005 if size == 0 else np.linspace(0.9, 1.1, size)
    key = OF_KIND[per]
    again = config.read_sensor(
        sensor_file.write(sensor_file.original(file), tmp_path / "next" / "sensor.yaml", {key: value}, {})
    ).resolved()
    found = getattr(again.effect(key[0]), key[1])
    assert np.shape(found) == np.shape(value)
    assert np.array_equal(found, value)


def test_a_config_that_names_its_sensor_s_file_is_followed_there(tmp_path: Path) -> None:
    """What is written is a sensor file, with the comments and the maps of the file that describes it."""
    folder = tmp_path / "sensors"
    folder.mkdir()
    file = sensor_in(folder, 2, 3)
    np.save(folder / "dcr.npy", np.arange(1.0, 7.0))
    file.write_text(file.read_text().replace("{rate: 100 Hz}", "{rate: {file: dcr.npy}}  # measured"))
    lab = tmp_path / "lab.yaml"
    lab.write_text("seed: 1\nscene: {images: {source: uniform}, lux: [1 lux]}\nsensor: sensors/sensor.yaml\n")
    with pytest.raises(InputError, match="is the sensor file itself"):
        sensor_file.check_place(lab, file)
    out = sensor_file.write(
        sensor_file.original(lab), tmp_path / "next" / "sensor.yaml", {("crosstalk", "probability"): 0.005}, {}
    )
    found: dict[str, Any] = {e.name: e for e in config.read_sensor(out).resolved().effects}
    assert found["crosstalk"].probability == 0.005
    assert np.array_equal(found["dark_counts"].rate, np.arange(1.0, 7.0))
    assert "# measured" in out.read_text() and "scene" not in out.read_text()


def test_the_user_s_own_lines_stay_and_the_maps_are_reached_from_the_new_place(tmp_path: Path) -> None:
    """Quotes, blanks and ends of lines are the user's; the name of a map may have blanks, signs and quotes."""
    file = sensor_in(tmp_path, 2, 3)
    np.save(tmp_path / "the dcr, of 300 K.npy", np.arange(1.0, 7.0))
    text = file.read_text().replace("{rate: 100 Hz}", "{ rate: {file:  'the dcr, of 300 K.npy'} }   # measured")
    text = text.replace("  rules: device", "  rules:   'device'  # as on the data sheet\n\n  # its size")
    file.write_bytes(text.replace("\n", "\r\n").encode())
    key = ("crosstalk", "probability")
    out = sensor_file.write(
        sensor_file.original(file), tmp_path / "next" / "sensor.yaml", {key: 0.005}, {key: "from lab"}
    )
    assert np.array_equal(config.read_sensor(out).resolved().effect("dark_counts").rate, np.arange(1.0, 7.0))
    first, *lines = out.read_bytes().decode().split("\r\n")
    assert first.startswith("# Written by")
    map_ = "{rate: {file: '../the dcr, of 300 K.npy'}}"
    text = text.replace("{ rate: {file:  'the dcr, of 300 K.npy'} }", map_)
    added = "    crosstalk: {probability: 0.005}  # from lab\n"
    assert lines == (text + added).split("\n")


def test_codes_of_each_pixel_are_written_as_they_are(tmp_path: Path) -> None:
    file, widths = sensor_in(tmp_path, 2, 2), np.linspace(0.9, 1.1, 16).reshape(4, 4)
    key = OF_KIND["code"]
    again = config.read_sensor(
        sensor_file.write(sensor_file.original(file), tmp_path / "next.yaml", {key: widths}, {})
    ).resolved()
    assert np.array_equal(again.effect(key[0]).widths, widths)


@pytest.mark.parametrize("effects", ["{pdp: 0.42}", "{pdp: {500 nm: 0.4, 700 nm: 0.2}}"])
def test_a_table_over_the_wavelength_is_read_again(effects: str, tmp_path: Path) -> None:
    file = sensor_in(tmp_path, 2, 2)
    file.write_text(file.read_text().replace("{pdp: 0.42}", effects))
    table = ByWavelength((450e-9, 517.25e-9, 850e-9), (0.3, 0.41, 0.05))
    again = config.read_sensor(
        sensor_file.write(sensor_file.original(file), tmp_path / "next.yaml", {("detection", "pdp"): table}, {})
    )
    found = again.effect("detection").pdp
    assert found.wavelengths == pytest.approx(table.wavelengths, rel=1e-9)
    assert found.values == pytest.approx(table.values, rel=1e-6)


def test_every_parameter_of_the_catalogue_runs_along_what_is_tested() -> None:
    from spadmnist.effects import Effect

    kinds = {p.per for name in Effect.registry for p in Effect.registry.find(name).parameters.values()}
    assert kinds <= set(OF_KIND) == set(PER)


def test_what_cannot_be_read_again_is_not_left_there(tmp_path: Path) -> None:
    out = tmp_path / "next.yaml"
    with pytest.raises(SpadError, match="needs one number for each row"):
        sensor_file.write(sensor_file.original(sensor_in(tmp_path, 4, 4)), out, {OF_KIND["row"]: np.ones(3)}, {})
    assert not out.exists()


# --- plug-ins -------------------------------------------------------------------------------------------------------

ECHO = '''
from spadmnist.effects import Effect, parameter

class EchoOfTest(Effect, stage="dark"):
    """Detections without light.

    Source: a test.
    """

    rate = parameter(1.0, "Hz", "of the echo", bounds=(0, None), off=0.0, search=(1.0, 10.0))

    def apply(self, rate, conditions):
        return rate + self.rate
'''


def test_a_sensor_file_says_which_plug_in_it_needs_and_the_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    file, out = sensor_in(tmp_path, 2, 2), Path("next", "sensor.yaml")
    sensor_file.write(sensor_file.original(file), out, {("crosstalk", "probability"): 0.005}, {})
    assert "plug-in" not in out.read_text()
    Path("my echo.py").write_text(ECHO)
    plugins.load_file("my echo.py")
    sensor_file.write(sensor_file.original(file), out, {("echo_of_test", "rate"): 2.0}, {})
    said = "# Its effect echo_of_test is in the plug-in my echo.py. The command with it: spadmnist compare "
    command = "next/sensor.yaml MEASUREMENT --plugin 'my echo.py'"
    assert out.read_text().splitlines()[1] == said + command
    sensor_file.write(sensor_file.original(out), Path("third.yaml"), {("crosstalk", "probability"): 0.005}, {})
    assert Path("third.yaml").read_text().count("# Its effect") == 1
    assert "compare third.yaml MEASUREMENT" in Path("third.yaml").read_text()
    saved = sensor_file.save(config.read_sensor(out), Path("saved.yaml"))
    assert saved.read_text().splitlines()[1].endswith("compare saved.yaml MEASUREMENT --plugin 'my echo.py'")


def test_the_next_command_names_the_plug_ins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "my echo.py").write_text(ECHO)
    done = answered(tmp_path, monkeypatch, {("echo_of_test", "rate"): 2.0}, "--plugin", str(tmp_path / "my echo.py"))
    assert done.exit_code == 0, done.output
    last = [line for line in done.output.splitlines() if line.startswith("Next: ")]
    assert f"--plugin '{tmp_path / 'my echo.py'}'" in last[0]


# --- the answer stays -----------------------------------------------------------------------------------------------


def answered(folder: Path, monkeypatch: pytest.MonkeyPatch, values: dict[Any, Any], *options: str) -> Result:
    """`diagnose` on the command line, where these values were found."""
    lists: list[Any] = [[], [], [], [], [], [], []]
    found = Diagnosis("small", "lab", "explained" if options else "adequate", 1.0, 1.0, 1.2, *lists, values=values)
    monkeypatch.setattr(model_selection, "diagnose", lambda *_, **__: found)
    monkeypatch.setattr(measurement, "open", lambda path: SimpleNamespace(file=None, captures=()))
    (folder / "lab").mkdir()
    asked = ["diagnose", str(sensor_in(folder, 16, 16)), str(folder / "lab"), "-o", str(folder / "next")]
    return CliRunner().invoke(cli.cli, [*asked, *options, "--json", str(folder / "answer.json")])


def test_as_many_codes_as_pixels_are_a_next_sensor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    widths = np.linspace(0.9, 1.1, 256)
    done = answered(tmp_path, monkeypatch, {OF_KIND["code"]: widths})
    assert done.exit_code == 0, done.output
    told = json.loads((tmp_path / "answer.json").read_text())
    assert "not_written" not in told
    again = config.read_sensor(Path(told["sensor"])).resolved()
    assert np.array_equal(again.effect("tdc_nonlinearity").widths, widths)


@pytest.mark.parametrize(
    "error", [InputError("the disk is full"), OSError(28, "the disk is full"), KeyError("the disk is full")]
)
def test_an_answer_outlives_its_sensor_file(error: Exception, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: Any) -> Path:
        raise error

    monkeypatch.setattr(sensor_file, "write", fails)
    done = answered(tmp_path, monkeypatch, {})
    assert done.exit_code == 2
    assert "the next sensor file was not written" in done.stderr and "the disk is full" in done.stderr
    told = json.loads((tmp_path / "answer.json").read_text())
    assert told["sensor"] is None and "the disk is full" in told["not_written"]
    assert "ADEQUATE" in done.stdout and "the disk is full" in " ".join(done.stdout.split())
    assert "the disk is full" in (tmp_path / "next" / "report.html").read_text()


def test_an_answer_outlives_its_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from spadmnist import pages

    def fails(*_: Any) -> Path:
        raise InputError("no room for a page")

    monkeypatch.setattr(pages, "diagnosis", fails)
    done = answered(tmp_path, monkeypatch, {})
    assert isinstance(done.exception, InputError)
    assert json.loads((tmp_path / "answer.json").read_text())["verdict"] == "adequate"
    assert "ADEQUATE" in done.stdout
