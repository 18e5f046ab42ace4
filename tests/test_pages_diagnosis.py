"""The page of a diagnosis: all that was found, in order, the ladder at a glance, and harmless whatever the names."""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import matplotlib
import numpy as np
import pytest
from click.testing import CliRunner
from test_pages import (
    EVIL,
    Parts,
    decoded,
    is_dark_where_wanted,
    is_wide_enough,
    marks,
    near,
    needs_a_browser,
    screenshot,
    summary_of,
)

from spadmnist import cli, measurement, pages
from spadmnist.effects import Effect
from spadmnist.errors import InputError, SpadError
from spadmnist.events import Layout
from spadmnist.inference import model_selection
from spadmnist.inference.candidates import Candidate
from spadmnist.inference.results import Diagnosis, Step, Trace, Value, table
from spadmnist.library.answers import Fit
from spadmnist.pages import _diagnosis, _figures
from spadmnist.sensor import Sensor
from spadmnist.statistics import Statistic, Summary
from spadmnist.statistics.checks import Check

SECTIONS = (
    "What is missing",
    "What remains",
    "The set-up",
    "What to measure next",
    "The ladder of errors",
    "Further deviations",
    "What is not there",
    "What this measurement cannot show",
    "Words",
)


def trace_of(kind: str = "poisson", statistic: str = "intervals", label: str = "interval (s)", n: int = 40) -> Trace:
    """A check that the first model fails in its first cells and the last one passes. kind: its law."""
    draws = np.random.Generator(np.random.SFC64(11))
    after = np.zeros(n) if kind == "normal" else np.full(n, 400.0)
    before = np.where(np.arange(n) < 4, after - (9.0 if kind == "normal" else 300.0), after)
    spread = {"poisson": np.sqrt(after), "exponential": after}.get(kind, np.ones(n))
    chance = draws.exponential(size=n) - 1 if kind == "exponential" else draws.normal(size=n)
    summary = Summary(
        np.rint(after + spread * chance) if kind == "poisson" else after + spread * chance,
        kind,
        lambda cell: f"place {cell}",
        lambda *_: ("", 0.0),
        axis=None if kind == "normal" else 1e-8 * 10 ** (np.arange(n) / 12),
        label=label,
        log=True,
    )
    residuals = [(summary.values - model) / spread for model in (before, after)]
    return Trace(statistic, "flat", summary, before, after, spread, *residuals)


def rung(model: str, misfit: float, errors: tuple[float, ...] = (), placebo: bool = False) -> dict[str, Any]:
    names = ("mean_rate", "map", "linearity", "intervals", "neighbours")
    return {"model": model, "misfit": misfit, "errors": dict(zip(names, errors, strict=False)), "placebo": placebo}


def change_of(kind: str, effect: str, parameter: str | None = None) -> Candidate:
    return Candidate(kind, effect, parameter, (), carrier=(effect, "relative") if kind == "per_pixel" else None)


def other(kind: str, effect: str, parameter: str | None, misfit: float) -> dict[str, Any]:
    return {"change": kind, "effect": effect, "parameter": parameter, "misfit": misfit}


def answer_of(**options: Any) -> Diagnosis:
    """A diagnosis with something in every part of it; the effects are the catalogue's own."""
    factor = {"value": 1.6, "low": 1.58, "high": 1.62}
    values: dict[str, Any] = {
        "sensor": "lab tr",
        "measurement": "monday",
        "verdict": "partly_explained",
        "before": 61.2,
        "after": 1.04,
        "null_95": 1.2,
        "nuisances": [{"capture": None, "name": "light", "value": 1.0123, "low": 1.0, "high": 1.02, "pull": 3.4}],
        "steps": [
            Step(
                change_of("add", "crosstalk"),
                {"probability": Value(0.0051, 0.0047, 0.0055), "delay": Value(1.12e-9, 9e-10, 1.4e-9, "s")},
                11.2,
                35.2,
                "mean rate +2.20 %",
                [other("add", "source_noise", None, 41.3), other("set", "dead_time", "duration", 58.4)],
            ),
            Step(
                change_of("per_pixel", "detection", "pdp"),
                {"sigma": Value(0.0313, 0.0262, 0.0364), "low_ratio": Value(1.0, None, None)},
                4.1,
                18.0,
                "mean rate +0.01 %",
                [other("per_pixel", "dark_counts", "rate", 7.7)],
            ),
            Step(
                change_of("set", "dead_time", "paralyzable"), {"paralyzable": Value(1.0, None, None)}, 1.04, 9.1, "+1 %"
            ),
        ],
        "setup": [
            {"capture": "flat-20k", "quantity": "light", "factor": factor, "confused": True},
            {"capture": "flat-20k", "quantity": "exposure", "factor": factor, "confused": True},
        ],
        "unexplained": [
            {"statistic": "multiplicity", "capture": "dark", "significance": 40.1, "where": "12 pixels within 1 ns"}
            | {"size": "31 clusters, 0 expected", "deviation": 1},
            {"statistic": "spacing", "capture": "dark", "significance": 30.0, "where": "near", "deviation": 1},
            {"statistic": "spacing", "capture": "flat", "significance": 20.0, "where": "near", "deviation": 1},
            {"statistic": "rate", "capture": None, "significance": 6.5, "where": "all pixels"},
        ],
        "ladder": [
            rung("start", 61.2, (0.022, 0.01, 0.004, 0.0021, 0.00543)),
            rung("placebo: readout_loss", 58.9, (0.021, 0.01, 0.004, 0.0021, 0.005), placebo=True),
            rung("+ crosstalk", 11.2, (0.003, 0.01, 0.004, 0.0021, 0.0001)),
            rung("+ detection.pdp per pixel", 4.1),
            rung("+ dead_time.paralyzable", 1.04),
        ],
        "advice": [
            {"capture": "dark, 100 s", "separates": ["one", "two"], "significance_now": 1.3, "significance_then": 9.04}
        ],
        "excluded": [
            {"effect": "flicker", "parameter": "amplitude", "upper_limit_95": 0.0042},
            {"effect": "slow_recovery", "parameter": "time_constant", "upper_limit_95": 2.2e-9},
        ],
        "invisible": [{"effect": "count_saturation"}],
        "dark": ["dark"],
        "traces": [
            replace(trace_of(), where="side neighbours, 0 to 1 ns", size="0.5 % of detections", step=0),
            replace(trace_of(), capture="dark", first=False, step=0),
            replace(trace_of("normal", "neighbours"), deviation=1, step=0),
            replace(trace_of("exponential", "spectrum", "frequency (Hz)", 900), deviation=2),
        ],
        "file": "somewhere/next/sensor.yaml",
        "simulations": 12345,
    }
    return Diagnosis(**values | options)


BARE: dict[str, Any] = {name: [] for name in ("nuisances", "steps", "setup", "unexplained", "advice", "excluded")}
BARE |= {"invisible": [], "traces": [], "ladder": [rung("start", 1.01)], "before": 1.01, "after": 1.01, "file": None}


def written(found: Diagnosis, folder: Path) -> tuple[str, Parts]:
    path = pages.diagnosis(found, folder)
    assert path == folder / "report.html"
    text = path.read_text(encoding="utf-8")
    return text, Parts(text)


@pytest.fixture(scope="module")
def full_page(tmp_path_factory: pytest.TempPathFactory) -> str:
    return written(answer_of(), tmp_path_factory.mktemp("next"))[0]


def spoken(text: str) -> str:
    """The words of a page, or of a part of it, apart from each other whatever the table."""
    return " ".join(" ".join(Parts(text).words).split())


def section(text: str, title: str) -> str:
    start = text.index(f"<h2>{title}</h2>")
    end = text.find("<h2>", start + 4)
    return spoken(text[start : end if end > 0 else None])


# --- what it says ---------------------------------------------------------------------------------------------------


def test_everything_that_was_found_is_there_in_its_order(full_page: str) -> None:
    assert tuple(re.findall(r"<h2>(.*?)</h2>", full_page)) == SECTIONS
    verdict = spoken(full_page[: full_page.index("<h2>")])
    assert "Partly explained: crosstalk and detection.pdp per pixel and dead_time.paralyzable" in verdict
    assert (
        "explain a part of the deviations. What remains: 12 pixels within 1 ns, in dark: 31 clusters, 0 expected "
        "(multiplicity)." in verdict
    )
    assert "The misfit on held-out data fell from 61.2 to 1.04" in verdict
    for words in ("below 1.2 in 95 of 100", "lab tr against monday", "sensor.yaml", "12,345", "Next: "):
        assert words in verdict
    assert "somewhere" not in full_page  # whose folder it was is nobody's business
    for title, parts in {
        "The ladder of errors": (
            "start 61.2 2.200 1.000 0.400 0.210 0.543",
            "+ dead_time.paralyzable 1.04 - - - - -",
            "noise floor (95 %) 1.2",
            "The placebo is",
        ),
        "What is missing": (
            "1. crosstalk an effect that the model lacks · 35.2 sigma · mean rate +2.20 %",
            "misfit on held-out data with it 11.2",
            Effect.registry.find("crosstalk").summary(),
            "probability probability that an avalanche fires one given side neighbour 0.0051 0.0047 to 0.0055",
            "1.12 ns 900 ps to 1.4 ns",
            "alternative in-sample misfit with it",
            "source_noise " + Effect.registry.find("source_noise").summary() + " 41.3",
            "dead_time.duration",
            "2. detection.pdp per pixel a number of the model that varies from pixel to pixel",
            "pdp: photon detection probability. " + Effect.registry.find("detection").summary(),
            "sigma relative spread of the bulk of the pixels 0.0313 0.0262 to 0.0364",
            "dark_counts.rate per pixel",
            "3. dead_time.paralyzable a number of the model that is another",
            "Side neighbours, 0 to 1 ns : 0.5 % of detections intervals of flat",
            "mean squared residual",
            "also in dark",
            "1 more deviation",
            "neighbours of flat",
        ),
        "The set-up": (
            "flat-20k or light 1.6000 1.5800 to 1.6200 flat-20k or exposure",
            "cannot separate those",
            "all lit captures 1.0123 1.0000 to 1.0200 +3.4",
        ),
        "Further deviations": ("spectrum of flat",),
        "What remains": (
            "correlated between neighbouring pixels; it is in the dark captures, too",
            "12 pixels within 1 ns: 31 clusters, 0 expected multiplicity of dark "
            + Statistic.registry.find("multiplicity").summary()
            + " also in spacing of dark, flat 40.1 sigma",
            f"all pixels rate of all captures {Check.registry.find('rate').summary()} 6.5 sigma",
        ),
        "What to measure next": ("To separate one from two: take dark, 100 s", "differ by 1.3 sigma now", "9.0 sigma"),
        "What is not there": (
            f"amplitude {Effect.registry.find('flicker').parameters['amplitude'].about} 0.0042",
            "time_constant",
            "2.2 ns",
        ),
        "What this measurement cannot show": (Effect.registry.find("count_saturation").summary(),),
    }.items():
        found = section(full_page, title)
        for part in parts:
            assert re.sub(r"\W+", " ", part) in re.sub(r"\W+", " ", found), (title, part)
    assert "paralyzable" in section(full_page, "What is missing") and ">yes<" in full_page  # no number


def test_the_table_has_a_row_for_each_model_and_the_placebo_aside(full_page: str) -> None:
    table = full_page[full_page.index('<table class="rungs">') :].partition("</table>")[0]
    rows = re.findall(r"<tr(.*?)><td>(.*?)</td><td(.*?)>(.*?)</td>", table)
    assert [(name, misfit) for _, name, _, misfit in rows] == [
        ("start", "61.2"),
        ("+ crosstalk", "11.2"),
        ("+ detection.pdp per pixel", "4.1"),
        ("+ dead_time.paralyzable", "1.04"),
        ("placebo: readout_loss", "58.9"),
        ("noise floor (95 %)", "1.2"),
    ]
    assert [name for kind, name, *_ in rows if "placebo" in kind] == ["placebo: readout_loss"]
    assert [name for _, name, kind, _ in rows if "passes" in kind] == ["+ dead_time.paralyzable"]


@pytest.mark.parametrize(
    ("verdict", "look", "word"),
    [
        ("adequate", "good", "Adequate: nothing is missing"),
        ("explained", "good", "Explained: "),
        ("setup", "open", "Set-up: the set-up explains the deviations"),
        ("confused", "open", "Confused: "),
        ("unexplained", "fails", "Unexplained: no known effect explains"),
    ],
)
def test_what_was_not_found_is_not_spoken_of(tmp_path: Path, verdict: str, look: str, word: str) -> None:
    text, parts = written(answer_of(**BARE | {"verdict": verdict}), tmp_path)
    assert re.findall(r"<h2>(.*?)</h2>", text) == ["The ladder of errors", "Words"]
    assert f'<section class="verdict {look}">' in text and f"{word}" in parts.text
    assert (
        "The misfit on held-out data is 1.01;" in parts.text
        and "fell from" not in parts.text
        and "placebo is" not in parts.text
    )
    assert "next model" not in parts.text
    text, parts = written(answer_of(**BARE | {"ladder": []}), tmp_path)
    assert re.findall(r"<h2>(.*?)</h2>", text) == ["Words"] and not parts.images


def test_a_misfit_that_rises_does_not_fall(tmp_path: Path) -> None:
    _, parts = written(answer_of(after=70.0), tmp_path)
    assert "The misfit on held-out data went from 61.2 to 70" in parts.text


@pytest.mark.slow
def test_where_the_totals_alone_were_wrong_their_error_falls(tmp_path: Path) -> None:
    ladder = [rung("start", 1.01), rung("+ background_light", 1.03)]
    ladder[0]["errors"] |= {"linearity": 0.0142, "map": 0.002}
    ladder[1]["errors"] |= {"linearity": 0.0006, "map": 0.003}
    _, parts = written(answer_of(before=1.01, after=1.03, ladder=ladder), tmp_path)
    assert "does not contain the totals: the error of the linearity fell from 1.42 % to 0.06 %." in parts.text
    _, parts = written(answer_of(ladder=ladder), tmp_path)
    assert "totals:" not in parts.text and "It was as low before" not in parts.text
    # what a trace tells is no matter of the totals
    ladder[1]["errors"]["linearity"] = 0.0140
    _, parts = written(answer_of(before=1.01, after=0.97, ladder=ladder), tmp_path)
    assert "totals:" not in parts.text and "It was as low before: a mean over everything hardly" in parts.text


@pytest.mark.slow
def test_what_would_look_the_same_is_said(tmp_path: Path) -> None:
    said = "But: a dead time that differs from event to event"
    for name, there in (("jitter", True), ("crosstalk", False)):
        step = Step(change_of("add", name), {}, 1.0, 8.0, "mean rate +0 %")
        found = answer_of(steps=[step])
        assert (said in table(found)) == there
        assert (said in written(found, tmp_path)[1].text) == there


def test_the_effect_of_a_plug_in_that_is_not_at_hand(tmp_path: Path) -> None:
    step = Step(change_of("add", "of_a_plug_in"), {"strength": Value(0.25, 0.2, 0.3)}, 1.0, 8.0, "mean rate +1 %")
    limits = [{"effect": "of_a_plug_in", "parameter": "strength", "upper_limit_95": 0.5}]
    text, _ = written(answer_of(steps=[step], excluded=limits, invisible=[{"effect": "of_a_plug_in"}]), tmp_path)
    assert "1. of_a_plug_in an effect" in spoken(text) and "strength 0.25 0.2 to 0.3" in spoken(text)


def test_the_first_sentence_is_whole_and_alone() -> None:
    class LongWinded(Effect, stage="readout"):
        """It goes on over
        two lines with a `name`, v1.5 of it. The second sentence is another matter.

        So is the rest.
        """

        def limit(self, counts: np.ndarray) -> np.ndarray:
            return counts

    assert _diagnosis._about("long_winded") == "It goes on over two lines with a name, v1.5 of it."


# --- what it shows --------------------------------------------------------------------------------------------------

SVG = "{http://www.w3.org/2000/svg}"


def bars(data: bytes) -> list[tuple[str, float, float, float]]:
    """(colour, left, top, bottom) of the filled rectangles of a picture, in points; y runs downwards."""
    found = []
    for path in ElementTree.fromstring(data).iter(f"{SVG}path"):
        colour = re.search(r"fill: (#\w+)", path.get("style", ""))
        points = [(float(x), float(y)) for x, y in re.findall(r"[ML] ([\d.]+) ([\d.]+)", path.get("d", ""))]
        if colour and len(points) >= 4:
            ys = [y for _, y in points]
            found.append((colour[1], points[0][0], min(ys), max(ys)))
    return found


@pytest.mark.parametrize("width", [_diagnosis._BROAD, _diagnosis._NARROW])
def test_the_bars_fall_to_the_floor_on_a_logarithmic_axis(width: float) -> None:
    ladder = sorted(answer_of().ladder, key=lambda row: bool(row["placebo"]))
    picture = _diagnosis._ladder_picture(ladder, 1.2, width)
    data = decoded(picture.source)[1]
    drawn = [bar for bar in bars(data) if bar[0] in (_diagnosis._ABOVE, _diagnosis._REACHED, _diagnosis._PLACEBO)]
    colours = [colour for colour, *_ in drawn if colour != "#ffffff"]
    assert colours == [_diagnosis._ABOVE] * 3 + [_diagnosis._REACHED, _diagnosis._PLACEBO]
    lefts, heights = [left for _, left, _, _ in drawn], [bottom - top for *_, top, bottom in drawn]
    assert lefts == sorted(lefts)
    misfits = np.array([61.2, 11.2, 4.1, 1.04, 58.9])
    slope = (heights[0] - heights[1]) / math.log(61.2 / 11.2)
    assert np.allclose(heights, heights[0] + slope * np.log(misfits / 61.2), atol=0.5)
    (floor,) = [bar for bar in bars(data) if bar[0] == _diagnosis._FLOOR]
    assert floor[3] - floor[2] == pytest.approx(heights[0] + slope * math.log(1.2 / 61.2), abs=0.5)
    words = [" ".join(e.itertext()) for e in ElementTree.fromstring(data).iter(f"{SVG}text")]
    for word in ("61.2", "1.04", "58.9", "+ crosstalk", "1.2"):
        assert any(word in text for text in words), word
    assert "+ crosstalk: 11.2" in picture.alternative


@pytest.mark.parametrize("misfits", [[1.0], [0.0], [1e300, 1.0], [0.4, 0.3], [5.0] * 12])
def test_any_misfit_is_a_ladder(misfits: list[float]) -> None:
    for width in (_diagnosis._BROAD, _diagnosis._NARROW):
        picture = _diagnosis._ladder_picture([rung(f"+ effect_{k}", m) for k, m in enumerate(misfits)], 1.2, width)
        assert len(decoded(picture.source)[1]) > 3000


def test_both_models_are_set_beside_the_data() -> None:
    card = _diagnosis._pictured([trace_of()])
    assert card.picture is not None
    assert card.before == pytest.approx(0.1 * 225 + 0.9, rel=0.3) and card.after == pytest.approx(1.0, abs=0.5)
    data = decoded(card.picture.source)[1]
    text = data.decode()
    for word in ("measured", "model before", "model after", "residual, sigmas", "100 ns"):
        assert word in text
    assert text.index("model before") < text.index("model after")
    before, after = marks(data, f"fill: {_figures.BEFORE}"), marks(data, f"fill: {_figures.MEASURED}")
    assert len(before) == 40 and len(after) == 81  # residuals of both, the measured, and one in the legend
    below = sorted(before)
    assert max(y for _, y in below[:4]) < min(y for _, y in below[4:])  # where the first model fails
    rings = marks(data, f"stroke: {_figures.WORST}")
    assert sum(any(abs(x - a) < 0.1 and abs(y - b) < 0.1 for a, b in below[:4]) for x, y in rings) == 1


def test_the_ring_is_where_the_sentence_says() -> None:
    trace = replace(trace_of(), worst=30)  # cells together decide: the cell that stands for them, not the largest one
    picture = _diagnosis._pictured([trace]).picture
    assert picture is not None
    data = decoded(picture.source)[1]
    before = sorted(marks(data, f"fill: {_figures.BEFORE}"))
    rings = marks(data, f"stroke: {_figures.WORST}")
    assert any(abs(x - before[30][0]) < 0.1 for x, _ in rings)
    assert f"{trace.residuals_before[30]:+.1f} sigma before" in data.decode()


@pytest.mark.parametrize(
    "kind", ["map", "large map", "score map", "names", "rows", "many", "exact", "one", "intervals"]
)
def test_every_kind_of_summary_has_a_picture_of_two_models(kind: str) -> None:
    summary, judged = summary_of(kind, factor=4.0)
    before, earlier = judged.expected * 0.8 - 1, judged.residuals + 5
    cells = _figures.Cells(
        "a", summary, judged.expected, judged.spread, judged.residuals, judged.worst, before, earlier
    )
    form, data = decoded(_figures.picture(cells, "words").source)
    assert len(data) < 300_000
    if form != "png":
        words = " ".join("".join(e.itertext()) for e in ElementTree.fromstring(data).iter(f"{SVG}text"))
        assert "before" in words and "after" in words and "simulated" not in words


@pytest.mark.slow
def test_numbers_beyond_all_bounds_are_drawn() -> None:
    odd = np.array([np.nan, np.inf, -np.inf, 1e200, 0.0])
    for kind in ("poisson", "exponential", "normal"):
        trace = trace_of(kind)
        for name in ("before", "after", "spread", "residuals_before", "residuals_after"):
            changed: dict[str, Any] = {name: np.concatenate([odd, getattr(trace, name)[5:]])}
            card = _diagnosis._pictured([replace(trace, **changed)])
            assert card.picture is not None and len(decoded(card.picture.source)[1]) > 5000
            assert math.isfinite(card.before) and math.isfinite(card.after)
    nothing = [np.zeros(0) for _ in range(5)]
    assert (
        _diagnosis._pictured([Trace("intervals", "flat", replace(trace.summary, values=nothing[0]), *nothing)]).picture
        is None
    )


# --- the file -------------------------------------------------------------------------------------------------------


def test_it_is_one_small_file_and_always_the_same(tmp_path: Path, full_page: str) -> None:
    with matplotlib.rc_context({"font.size": 30, "axes.facecolor": "red"}):  # a user's own settings
        path = pages.diagnosis(answer_of(), tmp_path / "deep" / "next")
    assert [p.name for p in path.parent.iterdir()] == ["report.html"]
    assert path.read_text() == full_page
    assert path.stat().st_size < 1_000_000
    assert len(Parts(full_page).images) == 2 + 3  # the ladder, broad and narrow, and the checks


@pytest.mark.slow
def test_other_peoples_files_stay(tmp_path: Path) -> None:
    (tmp_path / "sensor.yaml").write_text("mine")
    (tmp_path / "index.html").write_text("of a comparison")
    pages.diagnosis(answer_of(), tmp_path)
    pages.diagnosis(answer_of(), tmp_path)
    assert len(list(tmp_path.iterdir())) == 3 and (tmp_path / "index.html").read_text() == "of a comparison"
    page = tmp_path / "report.html"
    page.write_text("<html>my own report</html>")
    with pytest.raises(SpadError, match=r"report\.html is there already and is not from a diagnosis"):
        pages.diagnosis(answer_of(), tmp_path)
    assert page.read_text() == "<html>my own report</html>"


def test_the_command_writes_it_and_says_before_the_work_that_it_cannot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[int] = []

    def diagnose(*arguments: Any, **options: Any) -> Diagnosis:
        asked.append(1)
        return answer_of(**BARE | {"verdict": "adequate"})

    monkeypatch.setattr(model_selection, "diagnose", diagnose)
    monkeypatch.setattr(measurement, "open", lambda path: SimpleNamespace(file=None, captures=()))
    sensor = str(Path(__file__).parents[1] / "configs" / "spad23.yaml")
    folder = tmp_path / "next"
    told = CliRunner().invoke(cli.cli, ["diagnose", sensor, "lab", "-o", str(folder)])
    assert told.exit_code == 0, told.output
    assert {p.name for p in folder.iterdir()} == {"answer.json", "report.html", "sensor.yaml"}
    assert "Adequate" in (folder / "report.html").read_text() and f"Report: {folder / 'report.html'}" in told.stderr
    page = (folder / "report.html").read_text()
    assert "the same model is in the file <b>sensor.yaml</b> (nothing was added)" in page
    for words in ("<dt>command</dt>", "<dt>date</dt>", "<dt>seed</dt><dd>0</dd>", "the sensor, spad23.yaml", "SPAD23"):
        assert words in page, words
    (folder / "report.html").write_text("mine")
    told = CliRunner().invoke(cli.cli, ["diagnose", sensor, "lab", "-o", str(folder)])
    assert isinstance(told.exception, SpadError) and len(asked) == 1


def test_figures_have_names(tmp_path: Path) -> None:
    fit = Fit(answer_of(), Sensor(Layout(2, 2, 1e-10, 1.0), []))
    assert len(fit.figure("ladder").axes[0].patches) >= 5  # a bar for each model
    with pytest.raises(InputError, match="figure 'map': is none of this answer; there are ladder, or a number from 0"):
        fit.figure("map")
    with pytest.raises(InputError, match="there are none with a name"):
        Fit(answer_of(**BARE | {"ladder": []}), fit.start).figure("ladder")


@pytest.mark.slow
def test_what_is_nearest_to_what_remains_is_named(tmp_path: Path) -> None:
    _, parts = written(answer_of(), tmp_path)
    assert "Nearest, but" not in parts.text
    found = answer_of(verdict="unexplained")
    found.unexplained[0]["alternatives"] = [other("set", "dead_time", "duration", 9.0)]
    _, parts = written(found, tmp_path)
    assert "Nearest, but it explains too little of its own cells: dead_time.duration." in parts.text


# --- harmless -------------------------------------------------------------------------------------------------------


def evil() -> Diagnosis:
    """Names that would do something if they could, wherever a name stands."""
    base = answer_of()
    step = Step(
        change_of("set", EVIL, EVIL),
        {EVIL: Value(1.0, 0.5, 2.0, "s"), "b": Value(1.0, 0.5, 2.0, EVIL)},
        3.0,
        5.0,
        EVIL,
        [other("set", EVIL, EVIL, 3.0), other(EVIL, EVIL, EVIL, 3.0)],
    )
    traces = [replace(trace_of(kind), statistic=EVIL, capture=EVIL) for kind in ("poisson", "normal")]
    traces = [replace(t, summary=replace(t.summary, label=EVIL, where=lambda cell: EVIL)) for t in traces]
    traces = [replace(t, where=EVIL, size=EVIL, deviation=k, step=0 if k else None) for k, t in enumerate(traces)]
    return answer_of(
        sensor=EVIL,
        measurement=EVIL + "\ud800\x00\u202e",
        nuisances=[base.nuisances[0] | {"capture": EVIL, "name": EVIL}],
        steps=[step],
        setup=[base.setup[0] | {"capture": EVIL, "quantity": EVIL}],
        unexplained=[{"statistic": EVIL, "capture": EVIL, "significance": 5.0, "where": EVIL}],
        ladder=[rung(EVIL, 3.0), rung(EVIL, 2.0, placebo=True)],
        advice=[base.advice[0] | {"capture": EVIL, "separates": [EVIL, EVIL]}],
        excluded=[{"effect": EVIL, "parameter": EVIL, "upper_limit_95": 0.1}],
        invisible=[{"effect": EVIL}],
        traces=traces,
        file=f"{EVIL.replace('/', '')}",
    )


def test_no_name_can_do_anything(tmp_path: Path) -> None:
    _, parts = written(evil(), tmp_path)
    allowed = {"html", "head", "meta", "title", "style", "body", "main", "section", "figure", "img", "h1", "h2", "h3"}
    allowed |= {"nav", "ul", "li", "a", "details", "summary", "pre", "code"}
    allowed |= {"p", "b", "br", "span", "dl", "dt", "dd", "div", "table", "thead", "tbody", "tr", "th", "td"}
    assert {tag for tag, _ in parts.elements} <= allowed
    for tag, attributes in parts.elements:
        assert not any(name.startswith("on") or name in ("style", "srcset") for name in attributes), tag
        assert re.fullmatch(r"#part-\d+", attributes.get("href") or "#part-1"), attributes
    assert parts.text.count("{{ 7*7 }}") > 20 and "49" not in re.sub(r"\d+\.\d+", "", parts.text)
    assert parts.text.count("<script>") > 20  # as words
    assert len(parts.images) == 2 + 2
    for source in parts.images:
        drawing = ElementTree.fromstring(decoded(source)[1])
        kinds = {str(e.tag).rpartition("}")[2] for e in drawing.iter()}
        assert not kinds & {"script", "foreignObject", "a", "iframe"}
        links = {v for e in drawing.iter() for k, v in e.attrib.items() if k.endswith("href")}
        assert all(link.startswith("#") for link in links)
        assert not any(k.startswith("on") for e in drawing.iter() for k in e.attrib)


def test_the_page_forbids_everything_else(full_page: str) -> None:
    parts = Parts(full_page)
    policies = [a["content"] for _, a in parts.elements if a.get("http-equiv") == "Content-Security-Policy"]
    assert policies == ["default-src 'none'; img-src data:; style-src 'unsafe-inline'"]
    assert full_page.index("Content-Security-Policy") < full_page.index("<style>")  # before all it governs
    assert "http" not in re.sub(r"data:[\w/+;,=]+|http-equiv", "", full_page)
    assert not re.search(r"url\(|@import", full_page) and all(s.startswith("data:image/") for s in parts.images)


# --- in a browser ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
@needs_a_browser
def test_a_browser_shows_the_ladder_beside_its_table_and_on_a_telephone_above_it(
    tmp_path: Path, full_page: str
) -> None:
    page = tmp_path / "report.html"
    page.write_text(full_page)
    placed = {}
    for width in (1280, 500):
        seen = screenshot(page, tmp_path, 6400, width)
        background = near(seen, "#fafaf8") | near(seen, "#ffffff")
        assert background[:, :8].all() and background[:, -8:].all()  # nothing runs over the edge
        bar, floor = (near(seen, colour) for colour in (_diagnosis._ABOVE, _diagnosis._FLOOR))
        assert bar.sum() > 3000 and floor.sum() > 500
        bar &= (bar.sum(axis=1) > 25)[:, None]  # not the letters and rings of that colour
        rows, columns = np.nonzero(bar)
        shown = seen[rows.min() - 60 : rows.max() + 600]
        heads = np.nonzero(near(shown, "#f1f2f1").sum(axis=1) > 100)[0] + rows.min() - 60  # of the table
        placed[width] = (heads.min() < rows.max(), columns.max() / width)
    assert placed[1280][0] and placed[1280][1] < 0.5  # side by side
    assert not placed[500][0] and placed[500][1] > 0.4  # below


@pytest.mark.slow
@needs_a_browser
def test_the_page_fits_on_a_telephone_and_is_dark_where_the_reader_wants_it(tmp_path: Path, full_page: str) -> None:
    page = tmp_path / "report.html"
    page.write_text(full_page)
    is_dark_where_wanted(page, tmp_path)
    is_wide_enough(page, tmp_path)
