"""Tables of detections as other programs write them, against the csv module and exact fractions."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from importfiles import DARK, SECOND, back, refusal, run

from spadmnist.importers import Said, table
from spadmnist.importers.captures import import_files

UNITS = {"s": 1, "ms": 10**3, "us": 10**6, "µs": 10**6, "μs": 10**6, "ns": 10**9, "ps": 10**12}
LONG = replace(SECOND, exposure=1e4)


def right(text: str, separator: str, tick: Fraction, decimal: str = ".") -> list[tuple[int, int]]:
    """(channel, ticks) of each line, by the csv module and fractions; the columns are pixel (or alike) and time."""
    lines = text.lstrip("\ufeff").replace(" \t", "\t")
    rows = list(csv.reader(io.StringIO(lines), delimiter=separator, skipinitialspace=True))
    head = [cell.strip().lstrip("#").strip().lower() for cell in rows[0]]
    (time,) = (i for i, name in enumerate(head) if name.startswith(("time", "t", "arrival")))
    unit = re.split(r"[(\[_ ]+", head[time].rstrip(")] "))[-1]
    found = []
    for row in rows[1:]:
        if not row:
            continue
        numbers = [Fraction(cell.strip().replace(decimal, ".")) for cell in row]
        ticks = numbers[time] / UNITS[unit] / tick
        found.append((int(numbers[1 - time]), round(ticks)))
    return sorted(found)


def taken(made: Any) -> list[tuple[int, int]]:
    """(channel, ticks) of each detection, from a measurement whose pixels are the channels of the same number."""
    one = back(made)
    assert one.events is not None and one.events.ticks is not None
    return sorted(zip(map(int, one.events.pixel), map(int, one.events.ticks), strict=True))


def lines(seed: int, unit: str, separator: str, decimal: str, digits: int, head: str) -> str:
    """A table of 60 detections in one hour, with so many digits behind the decimal mark, not in order."""
    rng = np.random.Generator(np.random.Philox(seed))
    out = [head]
    for channel, place in zip(rng.integers(0, 40, 60), rng.random(60) * 3600 * UNITS[unit], strict=True):
        number = f"{place:.{digits}f}".replace(".", decimal)
        cells = [str(channel), number]
        out.append(separator.join(cells))
    return "\n".join(out) + "\n"


# --- how columns are written --------------------------------------------------------------------------------------

HEADS = [
    "pixel{sep}time ({unit})",
    "Channel{sep}Time [{unit}]",
    "# ch{sep}time_{unit}",
    "pixel id{sep}Time Tag ({unit})",
    '"detector"{sep}"arrival time ({unit})"',
    "CH{sep}T({unit})",
    "pixel_id{sep}timestamp_{unit}",
]


@pytest.mark.parametrize("head", HEADS)
@pytest.mark.parametrize("separator", [",", ";", "\t"])
@pytest.mark.parametrize("unit", ["s", "us", "µs", "ns", "ps"])
def test_heads_separators_and_units(tmp_path: Path, head: str, separator: str, unit: str) -> None:
    digits = {"s": 9, "us": 4, "ns": 1, "ps": 0}.get(unit, 3)
    text = lines(len(head), unit, separator, ".", digits, head.format(sep=separator, unit=unit))
    (tmp_path / "a.csv").write_text(text, encoding="utf-8")
    made = run(tmp_path / "a.csv", replace(LONG, rows=5, columns=8))
    plain = text.replace(text.split("\n")[0], f"pixel{separator}time ({unit})")
    assert taken(made) == right(plain, separator, Fraction(1, 10**12))


@pytest.mark.parametrize("head", ["pixel time (ns)", "pixel  time[ns]", "# channel time_ns", "  pixel   time ( ns )"])
@pytest.mark.parametrize("space", [" ", "   ", " \t", "\t"])
def test_columns_between_spaces(tmp_path: Path, head: str, space: str) -> None:
    body = "\n".join(f"{space}{p}{space}{t}" for p, t in ((3, "70.5"), (1, "8"), (3, "1e1")))
    (tmp_path / "a.txt").write_text(f"{head}\n{body}\n")
    assert taken(run(tmp_path / "a.txt", replace(SECOND, rows=4))) == [(1, 8000), (3, 10_000), (3, 70_500)]


@pytest.mark.parametrize("unit", ["ms", "us", "ns"])
def test_a_decimal_comma(tmp_path: Path, unit: str) -> None:
    text = lines(3, unit, ";", ",", 3, f"pixel;time ({unit})")
    (tmp_path / "a.csv").write_text(text)
    made = run(tmp_path / "a.csv", replace(LONG, rows=5, columns=8))
    assert taken(made) == right(text, ";", Fraction(1, 10**12), ",")


@pytest.mark.parametrize("name", ["a.csv", "a.tsv", "a.txt", "A.CSV"])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_ends_of_lines_and_byte_order_marks(tmp_path: Path, name: str, end: str, mark: str) -> None:
    text = mark + end.join(["pixel,time (ps)", "1,5", "", "0,7", "1,9"])
    (tmp_path / name).write_bytes(text.encode())
    assert taken(run(tmp_path / name, replace(SECOND, rows=2))) == [(0, 7), (1, 5), (1, 9)]


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0), (1, 2, 0)])
def test_columns_in_any_order(tmp_path: Path, order: Sequence[int]) -> None:
    rows = [["time (us)", "channel", "fine (ps)"], ["3", "1", "250"], ["4.5", "0", "1000"]]
    text = "\n".join(",".join(row[i] for i in order) for row in rows)
    (tmp_path / "a.csv").write_text(text)
    assert taken(run(tmp_path / "a.csv", replace(SECOND, rows=2))) == [(0, 4_501_000), (1, 3_000_250)]


# --- values -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("unit", "tick"), [
    ("ps", "1 ps"), ("ns", "1 ps"), ("us", "1 ps"), ("ms", "1 ps"), ("s", "1 ps"), ("ns", "10 ps"), ("ns", "4 ps"),
    ("us", "1 ns"), ("s", "1 ns"), ("ns", "1 ns"),
])  # fmt: skip
def test_whole_numbers_are_exact(tmp_path: Path, unit: str, tick: str) -> None:
    """Up to 2^53 ticks, which are more than two hours of 1 ps."""
    said = Said.of(tick=tick, exposure="10000 s")
    each = Fraction(10**12, UNITS[unit]) / int(tick.split()[0]) / {"ps": 1, "ns": 1000}[tick.split()[1]]
    most = int(min(2**53 - 1, 10**13 / {"1 ps": 1, "4 ps": 4, "10 ps": 10, "1 ns": 1000}[tick]) / each)
    rng = np.random.Generator(np.random.Philox(11))
    numbers = sorted({0, 1, most, most - 1, *map(int, rng.integers(0, most, 200))})
    (tmp_path / "a.csv").write_text(f"pixel,time ({unit})\n" + "".join(f"0,{n}\n" for n in numbers))
    assert [ticks for _, ticks in taken(run(tmp_path / "a.csv", said))] == [round(n * each) for n in numbers]


@pytest.mark.parametrize("number", ["1e3", "1.0E+03", "+1000", "1000.", "  1000", "1000.4", "999.6"])
def test_how_numbers_are_written(tmp_path: Path, number: str) -> None:
    (tmp_path / "a.csv").write_text(f"pixel,time (ps)\n0,{number}\n")
    assert taken(run(tmp_path / "a.csv")) == [(0, 1000)]


@pytest.mark.parametrize("number", ["1_0", "0x10", "1d3", "", "five", "1,0", '"5"', "5 ps", "5;", "--5", "1e", "٣"])
def test_what_is_no_number(tmp_path: Path, number: str) -> None:
    (tmp_path / "a.csv").write_text(f"pixel,time (ps)\n0,3\n0,{number}\n", encoding="utf-8")
    text = refusal(tmp_path / "a.csv")
    assert "a.csv" in text and ("a line is" in text or "columns" in text)


@pytest.mark.parametrize("number", ["-1", "nan", "inf", "-inf", "1e400", str(2**53), "1e17", "-0.4"])
def test_times_that_are_none(tmp_path: Path, number: str) -> None:
    (tmp_path / "a.csv").write_text(f"pixel,time (ps)\n0,3\n0,{number}\n")
    assert "a.csv:3: 0 at" in refusal(tmp_path / "a.csv", replace(SECOND, exposure=1e6))


@pytest.mark.parametrize("number", ["-1", "0.5", "nan", "inf", "1e8", str(1 << 24), "-0.5"])
def test_pixels_that_are_none(tmp_path: Path, number: str) -> None:
    (tmp_path / "a.csv").write_text(f"pixel,time (ps)\n0,3\n{number},5\n")
    assert "is no pixel (0, 1, ...)" in refusal(tmp_path / "a.csv")


@pytest.mark.parametrize("size", [1, 5, 16, 1 << 20])
@pytest.mark.parametrize("blank", ["", "\n", "\n\n\n"])
def test_the_line_that_is_wrong(tmp_path: Path, size: int, blank: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Empty lines count, in whatever pieces the file is read."""
    monkeypatch.setattr(table, "_AT_ONCE", size)
    text = "pixel,time (ps)\n" + blank + "".join(f"0,{n}\n{blank}" for n in range(9)) + "0,-1\n" + "1,5\n"
    (tmp_path / "a.csv").write_text(text)
    line = text.split("\n").index("0,-1") + 1
    assert f"a.csv:{line}: 0 at -1 ps" in refusal(tmp_path / "a.csv")


@pytest.mark.parametrize(
    ("head", "cells", "says"),
    [
        ("pixel,time (ps)", "0,abc", "could not convert 'abc' to a number; a line is 3,1250"),
        ("pixel,time (ps)", "0,", "could not convert '' to a number; a line is 3,1250"),
        ("pixel,time (ps)", '0,"5"', "could not convert '\"5\"' to a number; a line is 3,1250; take the quotes out"),
        ("pixel,time (ps)", "0,1_0", "could not convert '1_0' to a number"),
        (
            "pixel\ttime (ps)",
            "0\t5,5",
            "could not convert '5,5' to a number; a line is 3,1250; write a decimal point, or separate the",
        ),
        (
            "pixel,time (ps)",
            "0,5,5",
            "has 3 columns, and the lines before 2; a line is 3,1250; numbers may have a deci",
        ),
        ("time (ps)", "x", "could not convert 'x' to a number; a line is 1250"),
    ],
)
def test_the_line_of_a_cell_that_is_no_number(tmp_path: Path, head: str, cells: str, says: str) -> None:
    right = "7" if head.startswith("time") else head.replace("pixel", "0").replace("time (ps)", "7")
    (tmp_path / "a.csv").write_text(f"{head}\n{right}\n\n{right}\n{cells}\n{right}\n")
    assert f"a.csv:5: {says}" in refusal(tmp_path / "a.csv")


@pytest.mark.parametrize("number", ["1e2000000", "9e999999999999999999999"])
def test_exponents_beyond_decimals(tmp_path: Path, number: str) -> None:
    (tmp_path / "a.csv").write_text(f"pixel,time (ps)\n0,3\n0,{number}\n")
    assert "a.csv:3: 0 at inf ps is no pixel (0, 1, ...) and a time" in refusal(tmp_path / "a.csv")


def test_a_time_too_small_for_decimals_is_0(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("pixel,time (s)\n0,1e-999999999999999999999999\n0,8000\n")
    assert taken(run(tmp_path / "a.csv", Said(exposure=1e4))) == [(0, 0), (0, 8 * 10**15)]


# --- x and y ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("names", [("x", "y"), ("col", "row"), ("Column", "Row"), ("X", "Y")])
@pytest.mark.parametrize("first", ["x", "y", "time"])
def test_x_and_y(tmp_path: Path, names: tuple[str, str], first: str) -> None:
    """x is the column, y the row, whichever column of the table comes first."""
    places = {"x": [0, 4, 3, 4], "y": [0, 2, 1, 0], "time": [10, 20, 30, 40]}
    order = sorted(places, key=lambda name: name != first)
    head = ",".join({"x": names[0], "y": names[1], "time": "time (ps)"}[name] for name in order)
    body = "".join(",".join(str(places[name][i]) for name in order) + "\n" for i in range(4))
    (tmp_path / "a.csv").write_text(f"{head}\n{body}")
    made = run(tmp_path / "a.csv", replace(SECOND, rows=3, columns=5))
    assert taken(made) == [(0, 10), (4, 40), (8, 30), (14, 20)] and back(made).layout.shape == (3, 5)


@pytest.mark.parametrize(
    ("x", "y"),
    [("5", "0"), ("0", "3"), ("-1", "0"), ("0", "-1"), ("0.5", "0"), ("0", "0.2"), ("0.5", "0.5"), ("1.5", "2.5"),
     ("nan", "0"), ("0", "inf")],
)  # fmt: skip
def test_places_outside_or_between(tmp_path: Path, x: str, y: str) -> None:
    """A place between pixels is none, even where 5 rows of halves make a whole number."""
    (tmp_path / "a.csv").write_text(f"x,y,time (ps)\n0,0,1\n{x},{y},7\n")
    text = refusal(tmp_path / "a.csv", replace(SECOND, rows=3, columns=5))
    assert f"a.csv:3: x = {x}, y = {y} at 7 ps is no pixel" in text


def test_x_and_y_need_their_numbers(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("x,y,time (ps)\n0,0,1\n")
    for said in (SECOND, replace(SECOND, rows=3), replace(SECOND, columns=3)):
        assert "say how many there are with --rows and --columns" in refusal(tmp_path / "a.csv", said)


def test_x_and_y_as_channels(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("x,y,time (ps)\n0,0,1\n4,2,7\n")
    said = replace(SECOND, rows=3, columns=5, channels=("0", "14"))
    assert "2 channels are no 3 x 5 pixels" in refusal(tmp_path / "a.csv", said)


# --- one pixel ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "ticks"),
    [
        ("time (ps)\n70\n5\n", [5, 70]),
        ("Arrival Time (ns)\n0.5\n\n7\n", [500, 7000]),
        ("fine (ps),time (us)\n250,3\n", [3_000_250]),
        ('"timestamp_ns"\n1\n', [1000]),
    ],
)
def test_times_alone_are_of_one_pixel_and_it_is_said(tmp_path: Path, text: str, ticks: list[int]) -> None:
    (tmp_path / "a.csv").write_text(text)
    assert "of one pixel, not of 4 x 1; leave --rows" in refusal(tmp_path / "a.csv", replace(SECOND, rows=4))
    made = run(tmp_path / "a.csv")
    assert taken(made) == [(0, n) for n in ticks] and back(made).layout.shape == (1, 1)
    said = f"{tmp_path / 'a.csv'}: has no column of pixels; all its detections are taken as of one pixel"
    assert said in made.notes


def test_a_time_of_one_pixel_that_is_none(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("time (ps)\n5\n-7\n")
    assert "a.csv:3: the detection at -7 ps is no" in refusal(tmp_path / "a.csv")
    (tmp_path / "a.csv").write_text("time (ps)\n5\nseven\n")
    assert "a line is 1250" in refusal(tmp_path / "a.csv")


# --- what is refused ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("head", "says"),
    [
        ("0,100", "is a line of numbers, and a header is missing; write pixel,time (ps)"),
        ("0;100,5", "is a line of numbers, and a header is missing"),
        ("1 5e3", "is a line of numbers, and a header is missing"),
        ("pixel,time", "'time' has no unit; write pixel,time (ps)"),
        ("pixel,nanotime (ps)", "was recorded in T3 mode"),
        ("pixel,time (ns),nanotime", "was recorded in T3 mode"),
        ("pixel,time (ns),dtime (ps)", "was recorded in T3 mode"),
        ("pixel,time (ns),tcspc", "was recorded in T3 mode"),
        ("pixel,time (min)", "'1 min' is not a time"),
        ("pixel,time (m)", "'1 m' is not a time"),
        ("pixel,time (Hz)", "is not a time"),
        ("pixel,time (ns),intensity", "is no header"),
        ("pixel,channel,time (ns)", "is no header"),
        ("pixel,x,y,time (ns)", "is no header"),
        ("x,time (ns)", "is no header"),
        ("pixel,time (ns),time (s)", "is no header"),
        ("pixel,fine (ps)", "is no header"),
        ("pixel", "is no header"),
        ("", "is no header"),
        ("pixel,time (ns),", "is no header"),
        ("A;B", "is no header"),
    ],
)
def test_heads_that_are_none(tmp_path: Path, head: str, says: str) -> None:
    (tmp_path / "a.csv").write_text(f"{head}\n0,1\n")
    text = refusal(tmp_path / "a.csv", replace(SECOND, rows=2, columns=2))
    assert "a.csv:1: " in text and says in text


@pytest.mark.parametrize("line", ["0,1,2", "0", "0;1", "0 1", "# a remark", "pixel,time (ps)"])
def test_lines_that_are_none(tmp_path: Path, line: str) -> None:
    (tmp_path / "a.csv").write_text(f"pixel,time (ps)\n0,3\n{line}\n")
    assert "a.csv" in refusal(tmp_path / "a.csv")


def test_text_in_other_encodings(tmp_path: Path) -> None:
    for encoding in ("utf-16", "latin-1"):
        (tmp_path / "a.csv").write_bytes("pixel,time (µs)\n0,1\n".encode(encoding))
        assert "is not UTF-8 text" in refusal(tmp_path / "a.csv")


def test_times_that_fall_back(tmp_path: Path) -> None:
    """A counter that went round, or two recordings in one file: the lines are sorted, and it is said."""
    (tmp_path / "a.csv").write_text("pixel,time (us)\n0,1\n1,4\n0,900\n1,2\n0,3\n0,5\n")
    made = run(tmp_path / "a.csv", replace(SECOND, exposure=1e-3))
    (note,) = made.notes
    assert "its times fall back 2 times within a pixel, by up to 897 us; they were sorted" in note
    assert taken(made) == sorted([(0, t * 10**6) for t in (1, 3, 5, 900)] + [(1, 2 * 10**6), (1, 4 * 10**6)])
    # in time order, or pixel by pixel, nothing is said
    for n, body in enumerate(("0,1\n1,2\n0,3\n1,4\n", "1,2\n1,4\n0,1\n0,3\n")):
        (tmp_path / f"{n}.csv").write_text("pixel,time (us)\n" + body)
        said = replace(SECOND, exposure=5e-6)
        assert not import_files([tmp_path / f"{n}.csv"], tmp_path / str(n), said, DARK).notes


@pytest.mark.parametrize("size", [1, 7, 40, 1 << 20])
def test_pieces_of_any_size(tmp_path: Path, size: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(table, "_AT_ONCE", size)
    text = lines(8, "ns", ",", ".", 1, "pixel,time (ns)")
    (tmp_path / "a.csv").write_text(text.replace("\n", "\n\n", 5))
    made = run(tmp_path / "a.csv", replace(LONG, rows=5, columns=8))
    assert taken(made) == right(text, ",", Fraction(1, 10**12))


@pytest.mark.parametrize(
    ("text", "said"),
    [("1,2\n3\n", ":3: has 1 column, and the lines before 2"), ("0,1\n\n1,2,7\n", ":4: has 3 columns")],
)
def test_a_line_with_other_columns_is_named(text: str, said: str, tmp_path: Path) -> None:
    file = tmp_path / "a.csv"
    file.write_text("pixel,time (ps)\n" + text)
    message = refusal(file)
    assert said in message and "usecols" not in message
