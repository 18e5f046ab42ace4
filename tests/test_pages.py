"""The page of a comparison: what matters first, what was measured, and harmless whatever the names are."""

from __future__ import annotations

import base64
import html.parser
import io
import math
import os
import re
import shutil
import socket
import subprocess
import threading
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from spadmnist import pages
from spadmnist.errors import SpadError
from spadmnist.inference.checks import Check
from spadmnist.inference.comparison import Comparison, holm_corrected
from spadmnist.inference.light_checks import light_of
from spadmnist.inference.light_levels import Nuisance
from spadmnist.inference.null_distribution import Judgement
from spadmnist.inference.totals_tests import Level
from spadmnist.pages import _comparison, _figures, _frame
from spadmnist.recording import Capture, Light
from spadmnist.statistics import Statistic, Summary

EVIL = "<script>document.title='ran'</script>\"'><img src=x onerror=document.title='ran'>$\\frac{a}{$ {{ 7*7 }} &lt;"


def summary_of(kind: str, factor: float = 1.0, cells: int = 24) -> tuple[Summary, Judgement]:
    """What a statistic found, and the model's expectation; factor: by which one cell, or a part, is off."""
    draws = np.random.Generator(np.random.SFC64(7))
    n = {
        "map": 256,
        "score map": 256,
        "large map": 600 * 300,
        "line of pixels": 64,
        "one": 1,
        "exact": 2,
        "names": 6,
        "many": 130_000,
    }.get(kind, cells)
    law = {"power": "exponential", "exact": "exact", "names": "normal", "scores": "normal", "score map": "normal"}.get(
        kind, "poisson"
    )
    x = np.arange(n)
    expected = np.full(n, 400.0)
    if kind == "intervals":
        expected = 1e5 * np.exp(-x / 2.0) + 0.01
    elif law == "normal":
        expected = np.zeros(n)
    elif kind == "exact":
        expected = np.array([0.0, 3.0])
    spread = {"poisson": np.sqrt(expected), "exponential": expected}.get(law, np.ones(n))
    values = draws.poisson(expected).astype(float) if law == "poisson" else expected + spread * draws.normal(size=n)
    if law == "exponential":
        values = expected * draws.exponential(size=n)
    odd = n // 3
    if kind == "exact":
        values = expected.copy()
    if factor != 1.0:
        values[odd] = max(expected[odd], 1.0) * factor
    residuals = (values - expected) / np.maximum(spread, 1e-9) if kind != "exact" else 40.0 * (values != expected)
    worst = int(np.argmax(np.abs(residuals)))
    shape = {
        "map": (16, 16),
        "score map": (8, 32),
        "large map": (600, 300),
        "line of pixels": (1, 64),
        "one": (1, 1),
    }.get(kind)
    axis, label, log = None, "", False
    if kind in ("intervals", "power"):
        axis, label, log = 1e-9 * 10 ** (x / 4.0), "interval (s)" if kind == "intervals" else "frequency, Hz", True
    elif kind in ("rows", "line of pixels", "many", "scores"):
        axis, label = x.astype(float), "row"
    found = Summary(
        values,
        law,
        lambda cell: f"place {cell}",
        lambda cell, measured, wanted: (f"{measured:.4g}, {wanted:.4g} expected", (measured - wanted) / 400),
        axis=axis,
        label=label,
        log=log,
        shape=shape,
    )
    return found, Judgement(1e-20, float(np.mean(residuals**2)), residuals, expected, spread, worst)


KINDS = (
    "map",
    "score map",
    "large map",
    "line of pixels",
    "one",
    "exact",
    "names",
    "many",
    "rows",
    "intervals",
    "power",
    "scores",
    "unnamed",
)


def check_of(
    kind: str, p: float, capture: str | None = "flat-20k", statistic: str | None = None, **options: Any
) -> Check:
    found, judged = summary_of(kind, **options)
    text, relative = found.size(judged.worst, float(found.values[judged.worst]), float(judged.expected[judged.worst]))
    return Check(
        statistic or kind.replace(" ", "_"),
        capture,
        judged.misfit,
        p,
        found.where(judged.worst),
        text,
        relative,
        summary=found,
        judgement=judged,
    )


def comparison_of(checks: list[Check], tolerance: float | None = None, **options: Any) -> Comparison:
    judged = holm_corrected(checks, tolerance)
    values: dict[str, Any] = {
        "sensor": "lab tr",
        "measurement": "monday",
        "verdict": "adequate" if all(c.passes for c in judged) else "fails",
        "misfit": 6.43,
        "misfit_null_95": 1.21,
        "nuisances": (Nuisance(None, "light", 1.012, 1.004, 1.02, 0.8),),
        "checks": tuple(judged),
        "replicates": 96,
        "tolerance": tolerance,
    }
    return Comparison(**values | options)


def failing() -> Comparison:
    checks = [check_of(kind, 10.0 ** -(20 + 5 * k), factor=4.0) for k, kind in enumerate(KINDS)]
    checks += [check_of(kind, 0.01 + 0.08 * k, "dark") for k, kind in enumerate(KINDS)]
    checks.append(
        Check("rate", "dark", 30.0, 1e-9, "all pixels, no light", "352 /s in a pixel, 20.03 /s expected", 16.6)
    )
    checks.append(Check("light", None, 0.6, 0.4, "all lit captures", "light +1.2 % of what is stated", 0.012))
    return comparison_of(checks)


def adequate() -> Comparison:
    return comparison_of([check_of(kind, 0.02 + 0.07 * k) for k, kind in enumerate(KINDS)], misfit=1.03)


class Parts(html.parser.HTMLParser):
    """The elements of a page, its text, and its images."""

    def __init__(self, text: str):
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.inside: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attributes)))
        self.inside.append(tag)

    def handle_endtag(self, tag: str) -> None:
        while self.inside and self.inside.pop() != tag:
            pass

    def handle_data(self, data: str) -> None:
        if "style" not in self.inside:
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join("".join(self.words).split())

    @property
    def images(self) -> list[str]:
        return [str(attributes["src"]) for tag, attributes in self.elements if tag == "img"]


def written(found: Comparison, folder: Path) -> tuple[str, Parts]:
    path = pages.comparison(found, folder)
    assert path == folder / "index.html"
    text = path.read_text(encoding="utf-8")
    return text, Parts(text)


def decoded(source: str) -> tuple[str, bytes]:
    found = re.fullmatch(r"data:image/(png|svg\+xml);base64,([A-Za-z0-9+/=]+)", source)
    assert found
    return found[1], base64.b64decode(found[2])


@pytest.fixture(scope="module")
def failing_page(tmp_path_factory: pytest.TempPathFactory) -> tuple[Comparison, str]:
    """A comparison that fails in every kind of picture, and its page."""
    found = failing()
    return found, written(found, tmp_path_factory.mktemp("report"))[0]


# --- what it says ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_failing_model_is_told_first_with_the_numbers_that_matter(failing_page: tuple[Comparison, str]) -> None:
    found, text = failing_page
    parts = Parts(text)
    clearest = found.deviations[0][0]
    verdict = parts.text.index("The model fails 14 of 28 checks: " + clearest.where)
    sentence = parts.text[verdict : parts.text.index("Next:")]
    for words in (
        "6.43",
        "1.21",
        clearest.statistic,
        str(clearest.capture),
        clearest.where,
        clearest.size,
        "p < 10⁻¹²",
    ):
        assert words in sentence
    for words in ("lab tr", "monday", "flat-20k, dark", "96 of each capture", "1 % of comparisons", "1.0120"):
        assert words in parts.text[verdict:]


def test_an_adequate_model_shows_what_came_nearest(tmp_path: Path) -> None:
    _, parts = written(adequate(), tmp_path)
    assert "The model is adequate: none of 13 checks fails. The misfit is 1.03" in parts.text
    assert "What came nearest to failing" in parts.text and "Where it fails" not in parts.text
    assert len(parts.images) == 1 + 3  # the light


def test_every_check_is_in_the_table_and_the_matrix(failing_page: tuple[Comparison, str]) -> None:
    found, text = failing_page
    listed = text[text.index("<h2>All checks, the clearest") :]
    rows = re.findall(r"<tr><td>(.*?)</td><td>(.*?)</td><td class=\"(.*?)\">", listed)
    assert sorted((s, c) for s, c, _ in rows) == sorted((c.statistic, c.capture or "all") for c in found.checks)
    assert sum(mark == "fails" for *_, mark in rows) == len(found.failing)
    matrix = text[text.index("<h2>All checks at a glance") : text.index("<h2>All checks, the clearest")]
    assert len(re.findall(r'<td class="fails">', matrix)) == len(found.failing)
    assert len(re.findall(r'<td class="\w', matrix)) == len(found.checks)
    assert all(f'<th scope="col">{name}</th>' in matrix for name in ("all captures", "dark", "flat-20k"))
    for word in ("misfit", "p-value", "pull", "residual, sigma", "tolerance"):
        assert f"<dt>{word}</dt>" in text


def test_what_is_real_but_small_is_told_apart_from_what_matters(tmp_path: Path) -> None:
    small = check_of("rows", 1e-9, factor=1.2, statistic="small_one")
    large = check_of("rows", 1e-8, factor=9.0, statistic="large_one")
    never = check_of("rows", 0.3, statistic="no_one")
    assert small.relative == pytest.approx(0.2) and large.relative == pytest.approx(8.0)
    text, parts = written(comparison_of([small, large, never], tolerance=0.5), tmp_path)
    assert "The model fails 1 of 3 checks: " in parts.text
    small_ones = text[text.index("<h2>Real, but smaller than the tolerance") : text.index("<h2>All checks at a glance")]
    assert "small_one" in small_ones and "large_one" not in small_ones and "no_one" not in small_ones
    text, parts = written(comparison_of([small, never], tolerance=0.5), tmp_path)
    assert "none of 2 checks fails beyond the tolerance" in parts.text
    assert "1 differs by more than chance, but by less than 50 %" in parts.text
    text, parts = written(comparison_of([small, never]), tmp_path)
    assert "The model fails 1 of 2 checks" in parts.text and "Real, but smaller" not in parts.text


def test_the_significant_are_those_that_compare_finds() -> None:
    p = 10.0 ** -np.linspace(0.5, 9, 40)
    checks = [Check("rows", f"c{k}", 1.0, float(value), "row 1", "1", 0.001) for k, value in enumerate(p)]
    strict, lenient = comparison_of(checks), comparison_of(checks, tolerance=0.01)
    assert 0 < len(strict.failing) < 40 and not lenient.failing
    told = {c.capture for c in lenient.checks if c.significant}
    assert told == {c.capture for c in strict.failing}


def test_one_card_a_deviation_with_its_captures_overlaid_and_the_rest_folded(tmp_path: Path) -> None:
    def check(statistic: str, p: float, capture: str, kind: str = "rows") -> Check:
        return replace(check_of(kind, p, capture, statistic, factor=4.0), excess=300.0)

    checks = [check("neighbours", 1e-40, c) for c in ("flat", "dim", "dark")]
    checks += [check("multiplicity", 1e-50, "flat"), check("pixel_map", 1e-9, "flat", "map")]
    text, _ = written(comparison_of(checks), tmp_path)
    shown = text[text.index("<h2>Where it fails") : text.index("<h2>What was compared")]
    cards = shown.split('<section class="card">')[1:]
    assert len(cards) == 2 and "neighbours</b> of <b>flat" in cards[0] and "pixel_map</b> of <b>flat" in cards[1]
    assert "The same deviation is in multiplicity of flat; neighbours of dim, dark." in cards[0].replace("\n", " ")
    first, _, folded = cards[0].partition("<details>")
    (source,) = re.findall(r'src="(.*?)"', first)
    drawing = decoded(source)[1].decode()
    assert all(f">{name}<" in drawing for name in ("dim", "dark")) and "measured, flat" in drawing
    assert "3 more checks" in folded and len(re.findall("<img", folded)) == 1 and "multiplicity" in folded
    assert "<details>" not in cards[1]


def test_nothing_to_check_and_one_check(tmp_path: Path) -> None:
    _, parts = written(comparison_of([], nuisances=()), tmp_path)
    assert "Nothing could be checked" in parts.text and not parts.images
    _, parts = written(comparison_of([check_of("one", 1e-9, factor=3.0)], nuisances=()), tmp_path)
    assert "The model fails 1 of 1 checks: " in parts.text and len(parts.images) == 1


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0, "< 10⁻¹²"), (1e-300, "< 10⁻¹²"), (3.2e-7, "3·10⁻⁷"), (0.00312, "0.0031"), (0.5, "0.5"), (1.0, "1")],
)
def test_a_p_value_in_words(value: float, text: str) -> None:
    assert _frame.p_value(value) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (1.234, "1.23"),
        (812.6, "813"),
        (4701.2, "4701"),
        (9.955e18, "1.0·10¹⁹"),
        (-2e-7, "-2.0·10⁻⁷"),
        (math.inf, "beyond all numbers"),
    ],
)
def test_a_number_in_words(value: float, text: str) -> None:
    assert _frame.number(value) == text


# --- what it shows --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("factor", [4.0, 0.0])
def test_every_kind_of_summary_has_a_picture(kind: str, factor: float) -> None:
    picture = _comparison._picture(check_of(kind, 1e-9, factor=factor))
    assert picture is not None
    form, data = decoded(picture.source)
    assert form == "svg+xml"
    assert len(data) < 170_000
    if form == "png":
        with Image.open(io.BytesIO(data)) as image:
            assert np.asarray(image.convert("L")).std() > 5
    else:
        drawing = ElementTree.fromstring(data)
        words = " ".join("".join(e.itertext()) for e in drawing.iter("{http://www.w3.org/2000/svg}text"))
        assert "measured" in words and (kind == "score map" or "simulated" in words)
        assert ("sigmas" in words) == (kind != "exact")
        assert ("residual at the ring: +" in words or "residual at the ring: -" in words) == (
            kind in ("line of pixels", "many", "rows", "intervals", "power", "scores")
        )
        assert ("measured / simulated" in words) == (kind in ("map", "large map"))  # scores have no ratio
        if kind == "intervals":
            assert "100 ns" in words and words.split().count("interval") == 1


def marks(data: bytes, colour: str) -> list[tuple[float, float]]:
    """Where an SVG has markers of a colour."""
    uses = re.findall(r'<use xlink:href="#\w+" x="([\d.]+)" y="([\d.]+)" style="([^"]*)"', data.decode())
    return [(float(x), float(y)) for x, y, style in uses if colour in style]


def test_a_picture_has_a_dot_for_each_cell_and_a_ring_at_the_clearest() -> None:
    picture = _comparison._picture(check_of("rows", 1e-9, factor=4.0))
    assert picture is not None
    data = decoded(picture.source)[1]
    dots = marks(data, f"fill: {_figures.MEASURED}")
    rings = marks(data, f"stroke: {_figures.WORST}")
    by_place: dict[float, list[float]] = {}
    for x, y in dots:
        by_place.setdefault(round(x, 1), []).append(y)
    pairs = [(x, *sorted(ys)) for x, ys in sorted(by_place.items()) if len(ys) == 2]  # not that of the legend
    assert len(pairs) == 24
    x, value, residual = pairs[8]
    assert value == min(y for _, y, _ in pairs) and residual == min(y for *_, y in pairs)  # y runs downwards
    assert {(round(a, 1), b) for a, b in rings} >= {(x, value), (x, residual)} and len(rings) == 3


def test_one_odd_pixel_of_a_large_map_is_seen() -> None:
    values = np.zeros((700, 512))
    values[401, 77], values[12, 500] = -9.0, 7.0
    reduced = _figures._largest_of(values, 3)
    assert reduced.shape == (234, 171)
    assert reduced[401 // 3, 77 // 3] == -9.0 and reduced[4, 166] == 7.0 and np.count_nonzero(reduced) == 2


def test_the_clearest_cell_of_too_many_is_drawn() -> None:
    residuals = np.random.Generator(np.random.SFC64(1)).normal(size=100_000)
    residuals[54_321] = -30.0
    some = _figures._thinned(residuals, 20_000)
    assert 54_321 in some and 15_000 < some.size <= 20_000 and (np.diff(some) > 0).all()


def test_the_band_holds_what_it_says() -> None:
    draws = np.random.Generator(np.random.SFC64(3))
    for law, values in (
        ("exponential", draws.exponential(5.0, 100_000)),
        ("normal", draws.normal(5.0, 2.0, 100_000)),
        ("poisson", draws.poisson(5000.0, 100_000)),
    ):
        low, high = _figures._band(law, np.array([values.mean()]), np.array([values.std()]))
        inside = np.mean((values >= low[0]) & (values <= high[0]))
        assert inside == pytest.approx(0.95, abs=4 * math.sqrt(0.95 * 0.05 / 1e5)), law


def test_an_axis_that_is_no_axis_is_not_used() -> None:
    good, _ = summary_of("intervals")
    assert _figures._axis_of(good)[1:] == ("interval (s)", True)
    assert good.axis is not None
    for axis in (None, good.axis[:-1], np.where(good.axis > 1e-6, np.nan, good.axis), np.tile(good.axis[:12], 2)):
        assert _figures._axis_of(replace(good, axis=axis))[0] is None
    long, _ = summary_of("rows", cells=1000)
    axis, label, _ = _figures._axis_of(replace(long, axis=None))
    assert axis is not None and axis.size == 1000 and label == "cell, 0 to 999"
    zero = replace(good, axis=good.axis - good.axis[0])  # a lag of 0 is not on a logarithmic scale
    assert _figures._axis_of(zero)[2] is False
    falling = _comparison._picture(replace(check_of("intervals", 1e-9), summary=replace(good, axis=good.axis[::-1])))
    assert falling is not None


@pytest.mark.slow
def test_numbers_beyond_all_bounds_are_drawn() -> None:
    for kind in ("rows", "names", "map", "intervals"):
        check = check_of(kind, 1e-9)
        assert check.summary is not None and check.judgement is not None
        values, residuals = check.summary.values.copy(), check.judgement.residuals.copy()
        values[:4], residuals[:4] = [np.nan, np.inf, -np.inf, 1e200], [np.nan, np.inf, -np.inf, 1e200]
        broken = replace(
            check,
            summary=replace(check.summary, values=values),
            judgement=replace(check.judgement, residuals=residuals, worst=1),
        )
        picture = _comparison._picture(broken)
        assert picture is not None and len(decoded(picture.source)[1]) > 5000


def test_a_statistic_of_ones_own_that_fails_to_name_a_cell_does_not_cost_the_page() -> None:
    def where(cell: int) -> str:
        raise RuntimeError("no name")

    check = check_of("names", 1e-9)
    assert check.summary is not None
    picture = _comparison._picture(replace(check, summary=replace(check.summary, where=where)))
    assert picture is not None and b"cell 5" in decoded(picture.source)[1]


def test_a_card_says_what_the_statistic_looks_at(tmp_path: Path) -> None:
    name = next(iter(Statistic.registry), None)
    if name is None:
        pytest.skip("no statistic is there")
    found = comparison_of([check_of("rows", 1e-9, statistic=name), check_of("names", 0.5, statistic="of_a_plug_in")])
    _, parts = written(found, tmp_path)
    assert Statistic.registry.find(name).summary() in parts.text and "of_a_plug_in" in parts.text


# --- light ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("uncertainty", [0.015, 0.04, 1e-4])
@pytest.mark.parametrize("shift", [0.01, -0.08])
def test_the_picture_of_the_light_shows_what_is_stated(uncertainty: float, shift: float) -> None:
    conditions: Any = None
    levels = []
    for k in range(3):
        capture = Capture(f"flat-{k}", "tr", Light(500e-9, 1.0, "irradiance", uncertainty, 0.002), conditions)
        levels.append(Level(capture, shift + 0.001 * k, 0.003, 1.0))
    nuisances, _ = light_of(levels, [])
    assert nuisances[0].capture is None and len(nuisances) == 4
    assert nuisances[0].stated == uncertainty and nuisances[1].stated == 0.002
    form, data = decoded(_comparison._light_picture(nuisances).source)
    assert form == "svg+xml" and b"all lit captures" in data and b"flat-2" in data
    assert f"within {196 * uncertainty:.2g} %".encode() in data


def test_what_was_not_compared_is_there(tmp_path: Path) -> None:
    _, parts = written(replace(adequate(), not_compared=(("frame_limits", "flat"),), faint=("dark",)), tmp_path)
    assert "frame_limits of flat: some simulations have too few data for that" in parts.text
    assert "dark: so few detections are expected" in parts.text
    _, parts = written(adequate(), tmp_path / "whole")
    assert "not compared" not in parts.text and "by number alone" not in parts.text


def test_many_lights_are_a_picture_of_the_oddest(tmp_path: Path) -> None:
    many = [Nuisance(f"flat-{k}", "light", 1.0, 0.99, 1.01, k / 100) for k in range(150)]
    picture = _comparison._light_picture([Nuisance(None, "light", 1.0, 0.99, 1.01, 0.0), *many])
    data = decoded(picture.source)[1].decode()
    assert "all lit captures" in data and "flat-149" in data and "flat-3<" not in data and "151" in picture.note


# --- the file -------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_it_is_one_small_file_and_always_the_same(tmp_path: Path, failing_page: tuple[Comparison, str]) -> None:
    found, before = failing_page
    path = pages.comparison(found, tmp_path / "deep" / "report")
    assert [p.name for p in path.parent.iterdir()] == ["index.html"]
    assert path.read_text() == before
    assert 50_000 < path.stat().st_size < 3_000_000
    assert len(Parts(before).images) == 1 + 8  # the light, and the clearest deviations


def test_the_names_in_a_drawing_are_counted() -> None:
    """The last digit of a layout, of which matplotlib makes them, is not the same in every run."""
    one, other = (
        f'<path id="{m}"/><clipPath id="{p}"/><use xlink:href="#{m}" clip-path="url(#{p})"/>'.encode()
        for m, p in (("m0123456789", "p65bda3e1a1"), ("mabcdef0123", "pe87669e245"))
    )
    assert _figures._numbered(one) == _figures._numbered(other)
    assert b'<clipPath id="p1"/><use xlink:href="#m0" clip-path="url(#p1)"/>' in _figures._numbered(one)


def test_twelve_large_maps_are_still_a_small_page() -> None:
    picture = _comparison._picture(check_of("large map", 1e-9, factor=4.0))
    assert picture is not None and _comparison._PICTURES * len(picture.source) < 2_200_000


@pytest.mark.slow
@pytest.mark.long
def test_a_thousand_captures_are_still_a_page(tmp_path: Path) -> None:
    checks = [
        Check(f"statistic_{s}", f"image-{k:05d}", 1.0, 0.001 + 0.5 * ((17 * k + s) % 100) / 100, "row 3", "1 %", 0.01)
        for k in range(1000)
        for s in range(12)
    ]
    path = pages.comparison(comparison_of(checks), tmp_path)
    assert path.stat().st_size < 3_000_000
    assert "The 4000 clearest of 12000" in Parts(path.read_text()).text


@pytest.mark.slow
def test_other_peoples_files_stay(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    pages.comparison(adequate(), tmp_path)
    pages.comparison(adequate(), tmp_path)
    assert (tmp_path / "notes.txt").read_text() == "mine" and len(list(tmp_path.iterdir())) == 2
    page = tmp_path / "index.html"
    for other in ("<html>my homepage</html>", ""):
        page.write_text(other)
        with pytest.raises(SpadError, match=r"index\.html is there already and is not from a comparison"):
            pages.comparison(adequate(), tmp_path)
        assert page.read_text() == other
    page.unlink()
    (tmp_path / "elsewhere.html").write_text(f"<head>{_frame._mark('comparison')}")
    page.symlink_to(tmp_path / "elsewhere.html")
    with pytest.raises(SpadError, match="left alone"):
        pages.comparison(adequate(), tmp_path)
    assert page.is_symlink()


def test_where_no_page_may_be_put(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(SpadError, match="is a file, but a report is a folder"):
        pages.check_place(tmp_path / "file")
    (tmp_path / "manifest.json").write_text('{"format": "spadmnist-dataset/1"}')
    with pytest.raises(SpadError, match="lies inside the dataset"):
        pages.comparison(adequate(), tmp_path / "report")
    assert not (tmp_path / "report").exists()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(SpadError, match="cannot write"):
        pages.comparison(adequate(), tmp_path / "report")


# --- harmless -------------------------------------------------------------------------------------------------------


def evil() -> Comparison:
    """Names that would do something if they could, wherever a name stands."""
    checks = []
    for kind in ("rows", "intervals", "names", "map", "one"):
        check = check_of(kind, 1e-9, EVIL, EVIL if kind == "one" else None, factor=3.0)
        assert check.summary is not None
        words = replace(check.summary, where=lambda cell: EVIL, label=EVIL)
        checks.append(replace(check, summary=words, where=EVIL, size=EVIL))
    checks.append(Check(EVIL, None, 1.0, 0.5, EVIL, EVIL, 0.0))
    nuisances = tuple(Nuisance(c, EVIL, 1.01, 1.0, 1.02, 4.0) for c in (None, EVIL, EVIL + "\ud800\x00\u202e"))
    return comparison_of(checks, sensor=EVIL, measurement=EVIL, nuisances=nuisances)


def test_no_name_can_do_anything(tmp_path: Path) -> None:
    _, parts = written(evil(), tmp_path)
    allowed = {"html", "head", "meta", "title", "style", "body", "main", "section", "figure", "figcaption", "img"}
    allowed |= {
        "h1",
        "h2",
        "h3",
        "p",
        "b",
        "span",
        "dl",
        "dt",
        "dd",
        "div",
        "table",
        "thead",
        "tbody",
        "tr",
        "th",
        "td",
        *("nav", "ul", "li", "a", "details", "summary", "pre", "code"),
    }
    assert {tag for tag, _ in parts.elements} <= allowed
    for tag, attributes in parts.elements:
        assert not any(name.startswith("on") or name in ("style", "srcset") for name in attributes), tag
        assert re.fullmatch(r"#part-\d+", attributes.get("href") or "#part-1"), attributes
    assert parts.text.count("{{ 7*7 }}") > 5 and "49" not in re.sub(r"\d\.\d+|10⁻\d+", "", parts.text)
    assert parts.text.count("<script>") > 5  # as words
    for source in parts.images:
        form, data = decoded(source)
        if form == "svg+xml":
            drawing = ElementTree.fromstring(data)
            kinds = {str(e.tag).rpartition("}")[2] for e in drawing.iter()}
            assert not kinds & {"script", "foreignObject", "a", "iframe"}
            links = {v for e in drawing.iter() for k, v in e.attrib.items() if k.endswith("href")}
            assert all(link.startswith(("#", "data:image/png;base64,")) for link in links)
            assert not any(k.startswith("on") for e in drawing.iter() for k in e.attrib)


def test_the_page_forbids_everything_else(failing_page: tuple[Comparison, str]) -> None:
    text = failing_page[1]
    parts = Parts(text)
    policies = [a["content"] for tag, a in parts.elements if a.get("http-equiv") == "Content-Security-Policy"]
    assert policies == ["default-src 'none'; img-src data:; style-src 'unsafe-inline'"]
    first = [tag for tag, _ in parts.elements].index("style")
    assert "Content-Security-Policy" in {
        a.get("http-equiv") for _, a in parts.elements[:first]
    }  # before all it governs
    assert "http" not in re.sub(r"data:[\w/+;,=]+|http-equiv", "", text)


# --- in a browser ---------------------------------------------------------------------------------------------------

BROWSER = next(
    (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None
)
needs_a_browser = pytest.mark.skipif(BROWSER is None, reason="no Chromium to look at the page with")


def browse(page: Path, folder: Path, *options: str) -> str:
    assert BROWSER is not None
    command = [BROWSER, "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"]
    command += ["--hide-scrollbars", "--disable-background-networking", f"--user-data-dir={folder / 'profile'}"]
    command += ["--no-first-run", "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1"]  # nothing asks outside
    command += [*options, page.resolve().as_uri()]
    environment = os.environ | {"HOME": str(folder)}
    return subprocess.run(command, capture_output=True, text=True, timeout=120, env=environment).stdout


def screenshot(page: Path, folder: Path, height: int = 4000, width: int = 1280) -> np.ndarray:
    target = folder / "screen.png"
    browse(page, folder, f"--window-size={width},{height}", f"--screenshot={target}")
    with Image.open(target) as image:
        return np.asarray(image.convert("RGB"))


def near(picture: np.ndarray, colour: str, by: int = 6) -> np.ndarray:
    """Which points have a colour."""
    wanted = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)])
    return (np.abs(picture.astype(int) - wanted) <= by).all(axis=2)


@pytest.mark.slow
@needs_a_browser
def test_a_browser_shows_words_and_pictures(tmp_path: Path, failing_page: tuple[Comparison, str]) -> None:
    page = tmp_path / "index.html"
    page.write_text(failing_page[1])
    seen = screenshot(page, tmp_path)
    assert seen.shape == (4000, 1280, 3)
    dark = (seen < 100).all(axis=2)
    assert 0.005 < dark.mean() < 0.2
    strips = dark.reshape(20, 200, 1280).any(axis=(1, 2))
    assert strips.all()  # nowhere a blank screen
    assert near(seen, _figures.BAND).sum() > 5000  # drawn, not only linked
    assert near(seen, _figures.MODEL).sum() > 1000
    background = near(seen, "#fafaf8") | near(seen, "#ffffff")
    assert background[:, :100].all() and background[:, -100:].all()  # nothing runs over the edge
    # of a page whose pictures are forbidden the same test fails
    page.write_text(page.read_text().replace("img-src data:;", ""))
    assert near(screenshot(page, tmp_path), _figures.BAND).sum() < 1000


def framed(page: Path, folder: Path, width: int, height: int) -> np.ndarray:
    """A page as wide as a telephone, which is less than a browser's least window: in a frame with scroll bars."""
    outer = folder / "outer.html"
    style = f"border:0;width:{width}px;height:{height}px"
    outer.write_text(f'<body style="margin:0;background:#ff00ff"><iframe src="{page.name}" style="{style}"></iframe>')
    return screenshot(outer, folder, height, 600)[:, :width]


@pytest.mark.slow
@needs_a_browser
def test_four_hundred_points_are_wide_enough(tmp_path: Path, failing_page: tuple[Comparison, str]) -> None:
    page = tmp_path / "index.html"
    page.write_text(failing_page[1])
    is_wide_enough(page, tmp_path)


def is_wide_enough(page: Path, tmp_path: Path) -> None:
    """A page fits on a telephone."""
    seen = framed(page, tmp_path, 400, 3000)
    background = near(seen, "#fafaf8") | near(seen, "#ffffff")
    assert background[:, :8].all() and background[:, -8:].all()  # nothing runs over the edge
    assert (seen[:, 12:-12] < 100).all(axis=2).mean() > 0.01
    # a page that holds something wider has it at the edge
    page.write_text(page.read_text().replace("<main>", '<main><p style="width:900px;background:#000">.</p>'))
    wider = framed(page, tmp_path, 400, 3000)
    assert not (near(wider, "#fafaf8") | near(wider, "#ffffff"))[:, -8:].all()


@pytest.mark.slow
@needs_a_browser
def test_it_is_dark_where_the_reader_wants_it(tmp_path: Path, failing_page: tuple[Comparison, str]) -> None:
    page = tmp_path / "index.html"
    page.write_text(failing_page[1])
    is_dark_where_wanted(page, tmp_path)


def is_dark_where_wanted(page: Path, tmp_path: Path) -> None:
    """A page and its pictures are dark for a reader who prefers that."""
    target = tmp_path / "screen.png"
    # 0: dark
    options = ("--blink-settings=preferredColorScheme=0", "--window-size=1280,2500", f"--screenshot={target}")
    browse(page, tmp_path, *options)
    with Image.open(target) as image:
        seen = np.asarray(image.convert("RGB")).astype(int)
    assert (seen.max(axis=2) < 70).mean() > 0.8  # pictures, too, that have no ground of their own
    assert (seen.min(axis=2) > 170).mean() > 0.003  # letters
    assert not near(seen, "#ffffff").mean() > 0.02


@pytest.fixture
def visits() -> Iterator[tuple[int, list[bytes]]]:
    """A port of this machine, and what is asked there."""
    asked: list[bytes] = []
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(0.2)
        over = threading.Event()

        def listen() -> None:
            while not over.is_set():
                try:
                    connection, _ = server.accept()
                except TimeoutError:
                    continue
                with connection:
                    connection.settimeout(1.0)
                    try:
                        asked.append(connection.recv(200))
                    except TimeoutError:
                        asked.append(b"")

        thread = threading.Thread(target=listen)
        thread.start()
        yield server.getsockname()[1], asked
        over.set()
        thread.join()


@pytest.mark.slow
@needs_a_browser
def test_nothing_is_asked_for_and_nothing_runs(tmp_path: Path, visits: tuple[int, list[bytes]]) -> None:
    port, asked = visits
    where = f"http://127.0.0.1:{port}"
    name = (
        f"<script>fetch('{where}/a');document.title='ran'</script><img src={where}/b onerror=\"document.title='ran'\">"
    )
    checks = [replace(check_of("names", 1e-9, name, factor=3.0), where=name, size=name)]
    page = pages.comparison(comparison_of(checks, sensor=name), tmp_path / "report")
    # what the names would do if they were not escaped, with and without the policy
    text = page.read_text()
    page.write_text(text.replace("<main>", f"<main>{name}"))
    assert "<title>ran" not in browse(page, tmp_path, "--dump-dom") and not asked
    page.write_text(re.sub(r"<meta http-equiv[^>]*>", "", text).replace("<main>", f"<main>{name}"))
    assert "<title>ran" in browse(page, tmp_path, "--dump-dom") and asked
    asked.clear()
    page.write_text(text)
    shown = browse(page, tmp_path, "--dump-dom")
    assert "<title>&lt;script&gt;" in shown and "<script" not in shown and not asked


def cells_that_say(size: Any) -> Any:
    values = np.array([14.7, 0.0, 2.0])
    summary = Summary(values, "normal", str, size)
    return _figures.Cells("autocorrelation", summary, np.zeros(3), np.ones(3), values, 0)


def test_a_picture_shows_the_model_where_it_is() -> None:
    """Of a check whose words take what was found from the recording itself, whatever value they are asked for."""
    found = np.array([10.0, 0.0, 1.0])
    said = _figures._as_said(
        cells_that_say(lambda k, measured, expected: (f"{found[k]:g} % of detections, {expected:g} % expected", 0.0)),
        np.arange(3),
        [np.array([14.7, 0.0, 2.0]), np.zeros(3), np.full(3, -1.96), np.full(3, 1.96)],
    )
    assert said is not None
    assert [list(values) for values in said[0]] == [[10.0, 0.0, 1.0], [0.0] * 3, [-1.96] * 3, [1.96] * 3]


def test_numbers_of_two_units_are_on_no_scale() -> None:
    words = ["980 ns, 1.02 us expected", "1 us, 1.02 us expected", "1 us, 1.02 us expected"]
    cells = cells_that_say(lambda k, measured, expected: (words[k], 0.0))
    assert _figures._as_said(cells, np.arange(3), [np.zeros(3)] * 4) is None
    assert _figures._as_said(cells, np.arange(1, 3), [np.zeros(2)] * 4) is not None


@pytest.mark.parametrize(("uncertain", "told"), [(0.0, "the stated level"), (0.5, "the other captures")])
def test_what_a_capture_is_compared_with_is_said(uncertain: float, told: str) -> None:
    conditions: Any = None
    captures = [Capture(id, "tr", Light(500e-9, 1.0, "irradiance", uncertain), conditions) for id in ("a", "b")]
    _, checks = light_of([Level(capture, 0.18, 0.002, 1.0) for capture in captures], captures)
    assert all(told in check.size for check in checks if check.capture), [check.size for check in checks]
