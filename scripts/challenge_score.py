"""The score of the hidden-effect challenge: each answer beside its truth, and the tables of the benchmark.

Unseen are captures that the analysis never got: `spadmnist compare` has judged the data sheet's sensor and the found
one by them. A check's misfit is about 1 for a model that is right, which is measured on the nulls; what is above is
error. The share of it that the findings remove is taken over the checks that fail with one of the two sensors: a mean
over all of them would hide a finding of 15 standard deviations among a hundred checks that it does not concern.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.special import ndtr, ndtri

CLEARLY = 1e-6  # p-value of an error that is worth dividing by: 5 standard deviations

# One-step changes that a search of a bare TR sensor chooses among (added effects, wrong values, maps): an ideal test of
# one of them must reach the threshold that keeps 1 % of false alarms over all of them.
CANDIDATES = 26
THRESHOLD = float(-ndtri(0.01 / CANDIDATES))  # standard deviations: 3.4

# A baseline, not the tool: what a lab reads off the check that fails most clearly, by rules that fit on a page (same
# pixel: traps or dead time; neighbours: crosstalk; everyone: lamp or clock; maps: the dark, or the light).
RULES = {
    **dict.fromkeys(("intervals", "fine_intervals", "rescaled"), "afterpulsing"),
    **dict.fromkeys(("autocorrelation", "rescaled_lag", "pixel_fano"), "slow_afterpulsing"),
    **dict.fromkeys(("neighbours", "multiplicity"), "crosstalk"),
    **dict.fromkeys(("far_pairs", "array_fano"), "source_noise"),
    **dict.fromkeys(("codes", "code_periods"), "tdc_nonlinearity"),
    **dict.fromkeys(("pixel_map", "outliers", "spread", "tails"), "per_pixel detection.pdp"),
    "edge_intervals": "set dead_time.duration",
    "spectrum": "flicker",
    "trend": "source_drift",
    "rows": "row_pattern",
    "columns": "column_pattern",
    "surface": "illumination_gradient",
    "slow_series": "blinking_dark_counts",
    "hot_series": "blinking_dark_counts",
    "spacing": "readout_loss",
    "first_arrivals": "short_gate",
    "rate": "background_light",
    "light": "(setup)",
}
# Where a parameter's effect vanishes, if not at 0.
OFF = {"short_gate.fraction": 1.0}
RULES_IN_THE_DARK = {
    **dict.fromkeys(("pixel_map", "outliers", "spread", "tails"), "per_pixel dark_counts.rate"),
    "rate": "set dark_counts.rate",
}


def by_the_rules(compared: dict[str, Any]) -> str:
    """What the rule sheet makes of compare's clearest failure."""
    failing = [check for check in compared.get("checks", []) if not check["passes"]]
    if not failing:
        return "(adequate)"
    worst = min(failing, key=lambda check: (check["p_value"], -check["misfit"]))
    rules = RULES | RULES_IN_THE_DARK if worst["capture"] == "dark" else RULES
    return rules.get(worst["statistic"], "(unexplained)")


def label(step: dict[str, Any]) -> str:
    if step["change"] == "add":
        return str(step["effect"])
    if step["change"] == "unknown":
        return "(outside)"
    return f"{step['change']} {step['effect']}.{step['parameter']}"


def true_label(truth: dict[str, Any]) -> str:
    if truth["class"] in ("null", "outside", "setup"):
        return f"({truth['class']})"
    return " + ".join(sorted(label(step) for step in truth["truth"]))


@dataclass
class Found:
    """A parameter of a right finding. pull: (value - truth) / standard deviation; exact: by the catalogue's own law."""

    name: str
    covers: bool
    pull: float
    exact: bool


@dataclass
class Judged:
    """One case, its answer beside its truth. Without an answer nothing is right."""

    truth: dict[str, Any]
    answer: dict[str, Any] | None
    seconds: float | None = None
    compared: str | None = None  # compare's verdict
    by_rules: str | None = None  # what the rule sheet makes of it
    floor: float | None = None  # misfit of the data sheet's sensor on the unseen captures, all checks
    before: float | None = None  # the same, checks that fail; None where none fails clearly
    after: float | None = None  # of the found one
    verdict: str = "no answer"
    given: str = "no answer"  # label of the first finding
    first_right: bool = False
    class_right: bool = False
    both: bool = False
    exact: bool = False
    flagged: bool = False  # says that something remains unexplained
    setup_right: bool = False
    confident_wrong: bool = False
    found: list[Found] = field(default_factory=list)
    limits: list[tuple[str, bool]] = field(default_factory=list)  # parameter, is its upper limit above the truth?

    @property
    def z(self) -> float:
        return min(self.truth["z"], default=0.0)

    @property
    def detected(self) -> bool:
        return self.verdict not in ("adequate", "no answer")

    @property
    def ideal(self) -> float:
        """Chance that an ideal test, which knows all effects of this case but one, finds each of them."""
        return math.prod(float(ndtr(z - THRESHOLD)) for z in self.truth["z"])

    @property
    def right(self) -> list[str]:
        return [label(step) for step in self.truth["truth"]]

    @property
    def said(self) -> list[str]:
        """The steps that were added, a set-up fault's apart."""
        return [label(step) for step in (self.answer or {}).get("steps") or []] if self.verdict != "setup" else []

    def removed(self, oracle: float) -> float | None:
        """Share of the error on unseen captures that the findings remove."""
        if self.before is None or self.after is None:
            return None
        return 1 - (self.after - oracle) / (self.before - oracle)


def judged(truth: dict[str, Any], told: dict[str, Any], seconds: float | None = None) -> Judged:
    """told: the answer to each question about the case, None or absent where there is none."""
    answer, compared = told.get("diagnose"), told.get("compare")
    case = Judged(truth, answer, seconds)
    if compared:
        case.compared, case.by_rules = compared["verdict"], by_the_rules(compared)
    steps = (answer or {}).get("steps") or []
    start, found_one = told.get("unseen-start"), told.get("unseen-found")
    if start:
        case.floor = start["misfit"]
        # nothing found, nothing removed
        case.before, case.after = errors(start, found_one if steps else start)
    if answer is None:
        return case
    case.verdict = answer["verdict"]
    entries = answer.get("setup") or []
    said, right = [label(step) for step in steps], case.right
    if said and case.verdict != "setup":
        case.given = said[0]
    else:
        case.given = f"({case.verdict})"
    case.first_right = bool(said) and case.verdict != "setup" and said[0] in right
    if said:
        others = [label(other) for other in steps[0].get("alternatives") or []]
        rivals = {said[0], *others} if case.verdict == "confused" else {said[0]}
        case.class_right = case.first_right or (len(rivals) <= 3 and bool(rivals & set(right)))
    case.both = bool(right) and set(right) <= set(said)
    case.exact = set(right) == set(said) and case.verdict != "setup"
    case.flagged = case.verdict in ("unexplained", "partly_explained") and bool(answer.get("unexplained"))
    expected = truth["setup"]
    if expected and case.verdict in ("setup", "confused"):  # confused: a short gate could do the same
        case.setup_right = any(
            entry["quantity"] in expected["quantities"]
            and (entry.get("capture") is None or entry["capture"] in expected["captures"])
            for entry in entries
        )
    if case.verdict == "setup":
        case.confident_wrong = not case.setup_right
    elif case.verdict == "explained":
        case.confident_wrong = not (case.first_right or case.setup_right)
    limits = {f"{e['effect']}.{e['parameter']}": e["upper_limit_95"] for e in answer.get("excluded") or []}
    for exact, named in ((True, truth["parameters"]), (False, truth["near"])):
        for name, value in named.items():
            effect, parameter = name.split(".")
            for step in steps:
                found = (step.get("values") or {}).get(parameter)
                if step["effect"] == effect and label(step) in right and found and found.get("low") is not None:
                    covers = found["low"] <= value <= found["high"]
                    case.found.append(Found(name, covers, pull_of(found, value), exact))
            if effect in right and name in limits:
                off = OFF.get(name, 0.0)
                case.limits.append((name, abs(value - off) <= abs(limits[name] - off)))
    return case


def pull_of(found: dict[str, Any], truth: float) -> float:
    """(value - truth) / standard deviation; of a whole number of which no other is left, 0 or infinite."""
    apart, deviation = found["value"] - truth, (found["high"] - found["low"]) / (2 * 1.959964)
    if deviation > 0:
        return float(apart / deviation)
    return math.copysign(math.inf, apart) if apart else 0.0


def errors(start: dict[str, Any], found: dict[str, Any] | None) -> tuple[float | None, float | None]:
    """Mean misfits with two sensors of the checks that fail with either; None where it is not known."""
    before = {(c["statistic"], c["capture"]): c for c in start["checks"]}
    if not any(not c["passes"] and c["p_value"] <= CLEARLY for c in before.values()):
        return None, None
    after = {(c["statistic"], c["capture"]): c for c in (found or start)["checks"]}
    failing = [key for key in before.keys() & after.keys() if not (before[key]["passes"] and after[key]["passes"])]
    means = [float(np.mean([checks[key]["misfit"] for key in failing])) for checks in (before, after)]
    return means[0], means[1] if found else None


def wilson(successes: int, trials: int, z: float = 1.959964) -> tuple[float, float]:
    """95 % interval of a share (Wilson)."""
    if trials == 0:
        return 0.0, 1.0
    share = successes / trials
    centre = (share + z**2 / (2 * trials)) / (1 + z**2 / trials)
    half = z / (1 + z**2 / trials) * math.sqrt(share * (1 - share) / trials + z**2 / (4 * trials**2))
    return max(0.0, centre - half), min(1.0, centre + half)


@dataclass(frozen=True)
class Goal:
    """What a share is to reach: `low` to `high`.

    It is reached where the share or a part of its Wilson interval lies in there, and the share is no less than `least`.
    Of false alarms `allowed` of `cases` are allowed, and that alone decides: the interval of 2 of 40 lies above 1 %.
    With fewer than `cases` the goal is only said to be out of reach, or nothing is said: of 20, one is 5 %.
    """

    low: float = 0.0
    high: float = 1.0
    least: float = 0.0
    allowed: int | None = None
    cases: int = 20

    @property
    def cells(self) -> tuple[str, str]:
        """The goal and the least as text."""
        low, high = 100 * self.low, 100 * self.high
        goal = f">= {low:g} %" if high == 100 else f"<= {high:g} %" if low == 0 else f"{low:g}-{high:g} %"
        if self.allowed is not None:
            return goal, f"{self.allowed} of {self.cases}"
        return goal if high else "0", f"{100 * self.least:g} %" if self.least else ""

    def kept(self, successes: int, trials: int) -> bool:
        share, (low, high) = successes / trials, wilson(successes, trials)
        if self.allowed is not None:
            return share <= self.allowed / self.cases
        return min(share, low) <= self.high and max(share, high) >= self.low and share >= self.least

    def reached(self, successes: int, trials: int) -> str:
        """yes or no; few: too few cases, and the goal can be reached with the others."""
        missing = max(self.cases - trials, 0)
        possible = any(self.kept(successes + more, trials + missing) for more in range(missing + 1))
        return "no" if not possible else "few" if missing else "yes"


STRONG = Goal(low=0.98, least=0.92)
GOALS = {
    "nulls: false alarm (any verdict but adequate)": Goal(high=0.01, allowed=2, cases=40),
    "nulls: false alarm of `compare`": Goal(high=0.01, allowed=4, cases=200),
    "single, Z >= 10: detected": Goal(low=0.98),
    "single, Z >= 10: right effect first": STRONG,
    "single, Z >= 10: right, or among at most 3 confused": Goal(low=0.98),
    "single, Z 20 or more: right effect first": STRONG,
    "single, Z 10-20: right effect first": STRONG,
    "single, Z 6-10: right effect first": Goal(low=0.92, least=0.82),
    "single, Z 4-6: right effect first": Goal(low=0.75, least=0.60),
    "single, Z below 3: detected": Goal(high=0.20),
    "single, Z below 3: upper limit above the truth": Goal(low=0.93),
    "double: both found": Goal(low=0.92),
    "double: exact set": Goal(low=0.65),
    "triple: all found": Goal(low=0.80),
    "camera: share of what is hidden that is found": Goal(low=0.85),
    "outside the catalogue: flagged as unexplained": Goal(low=0.95, least=0.85),
    "outside the catalogue: confidently wrong": Goal(high=0.01),
    "set-up: said so, and where": Goal(low=0.95),
    "steps that are not hidden, of all steps added": Goal(high=0.03),
    "cases without an answer": Goal(high=0.0),
    "unfinished within the budget": Goal(high=0.03),
    "95 % intervals that cover the truth, by the catalogue's law": Goal(low=0.93, high=0.97, cases=400),
}


def table(*rows: Iterable[object]) -> list[str]:
    """Markdown; the first row is the head."""
    head, *body = (["", *("" if cell is None else str(cell) for cell in row), ""] for row in rows)
    lines = [" | ".join(cells).strip() for cells in (head, ["", *["---"] * (len(head) - 2), ""], *body)]
    return lines


def report(cases: list[Judged], made: int | None = None) -> str:
    """The table of the benchmark in Markdown, with everything that went wrong by name. made: cases there are."""

    def line(
        what: str, members: list[Judged], good: Callable[[Judged], bool], bad: bool = False, best: bool = False
    ) -> str:
        told = [c for c in members if c.answer is not None]
        # silence is no success: it stays among the cases unless the line counts failures
        ideal = sum(c.ideal for c in members) / len(members) if best and members else None
        return row(what, sum(map(good, told)), len(told if bad else members), len(members) - len(told), ideal)

    def row(what: str, successes: int, trials: int, silent: int = 0, ideal: float | None = None) -> str:
        low, high = wilson(successes, trials)
        share = f"{100 * successes / trials:.0f} %" if trials else "-"
        interval = f"{100 * low:.0f}-{100 * high:.0f} %" if trials else "-"
        best = "" if ideal is None else f"{100 * ideal:.0f} %"
        goal = GOALS.get(what)
        must = ("", "", "") if goal is None else (*goal.cells, goal.reached(successes, trials))
        return f"| {what} | {successes} of {trials} | {share} | {interval} | {best} | {' | '.join(must)} | {silent} |"

    def of(kind: str, low: float = -1.0, high: float = math.inf) -> list[Judged]:
        return [c for c in cases if c.truth["class"] == kind and low <= c.z < high]

    nulls, singles, strong = of("null"), of("single"), of("single", 10)
    doubles, outside, setups = of("double"), of("outside"), of("setup")
    several = of("triple"), of("camera")
    made = len(cases) if made is None else made
    out = [
        "# Hidden-effect challenge",
        "",
        f"{len(cases)} cases."
        if len(cases) == made
        else f"{len(cases)} of {made} cases, those asked so far (their numbers are random: a fair sample).",
        "",
        "Z: the weakest hidden effect's expected significance in the best test that knows its family and strength. "
        "Intervals: Wilson, 95 %. Ideal: what that test finds at the threshold that keeps 1 % of false alarms over "
        f"{CANDIDATES} candidates. A case without an answer is no success and none of the failures that a line counts.",
        "",
        "Reached: the share or its interval meets the goal, and the share is not below the least. Of false alarms, the "
        "least says how many are allowed. Few: too few cases to say.",
        "",
        "| what | cases | share | 95 % | ideal | goal | least | reached | no answer |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
        line("nulls: false alarm (any verdict but adequate)", nulls, lambda c: c.detected, bad=True),
    ]
    compared = [c for c in nulls if c.compared]
    alarms = sum(c.compared == "fails" for c in compared)
    out.append(row("nulls: false alarm of `compare`", alarms, len(compared), len(nulls) - len(compared)))
    out.append(line("single, Z >= 10: detected", strong, lambda c: c.detected))
    out.append(line("single, Z >= 10: right effect first", strong, lambda c: c.first_right))
    out.append(line("single, Z >= 10: right, or among at most 3 confused", strong, lambda c: c.class_right))
    bands = [("20 or more", 20, math.inf), ("10-20", 10, 20), ("6-10", 6, 10), ("4-6", 4, 6), ("3-4", 3, 4)]
    bands.append(("below 3", -1, 3))
    for name, low, high in bands:
        members = of("single", low, high)
        out.append(line(f"single, Z {name}: right effect first", members, lambda c: c.first_right, best=True))
    for name, low, high in bands[2:]:
        out.append(line(f"single, Z {name}: detected", of("single", low, high), lambda c: c.detected, bad=low < 0))
    limits = [above for c in of("single", -1, 3) for _, above in c.limits]
    out.append(row("single, Z below 3: upper limit above the truth", sum(limits), len(limits)))
    out.append(line("single: exact set of findings", singles, lambda c: c.exact))
    out.append(line("double: both found", doubles, lambda c: c.both, best=True))
    out.append(line("double: exact set", doubles, lambda c: c.exact))
    out.append(line("triple: all found", several[0], lambda c: c.both, best=True))
    hidden_in = [(set(c.right), set(c.said)) for c in several[1]]
    found_in, all_in = (sum(len(x) for x in y) for y in ([a & b for a, b in hidden_in], [a for a, _ in hidden_in]))
    silent = sum(c.answer is None for c in several[1])
    out.append(row("camera: share of what is hidden that is found", found_in, all_in, silent))
    out.append(line("outside the catalogue: flagged as unexplained", outside, lambda c: c.flagged))
    out.append(line("outside the catalogue: confidently wrong", outside, lambda c: c.confident_wrong, bad=True))
    out.append(line("set-up: said so, and where", setups, lambda c: c.setup_right))
    steps = [(step in c.right) for c in cases for step in c.said]
    out.append(row("steps that are not hidden, of all steps added", steps.count(False), len(steps)))
    silent = sum(c.answer is None for c in cases)
    out.append(row("cases without an answer", silent, len(cases), silent))
    unfinished = [c for c in cases if c.answer and "finished" in c.answer]
    if unfinished:
        late = sum(not (c.answer or {})["finished"] for c in unfinished)
        out.append(row("unfinished within the budget", late, len(unfinished)))
    everything = [found for c in cases for found in c.found]
    for exact, what in ((True, "by the catalogue's law"), (False, "another law")):
        covers = [found.covers for found in everything if found.exact is exact]
        out.append(row(f"95 % intervals that cover the truth, {what}", sum(covers), len(covers)))
    compares = [c for c in cases if c.truth["class"] != "null" and c.z >= 10 and c.compared]
    out.append(row("`compare` fails, Z >= 10", sum(c.compared == "fails" for c in compares), len(compares)))
    for name, low, high in (("Z >= 10", 10, math.inf), ("Z 6-10", 6, 10)):
        ruled = [c for c in of("single", low, high) if c.by_rules]
        hits = sum(c.by_rules in c.right for c in ruled)
        out.append(row(f"baseline, a rule sheet on `compare`: single, {name}: right effect", hits, len(ruled)))
    times = [c.seconds for c in cases if c.seconds is not None and c.verdict != "no answer"]
    if times:
        out += ["", f"Time of `diagnose`: median {np.median(times):.0f} s, longest {max(times):.0f} s."]

    told, removed = unseen(nulls, strong, of("double"))
    out += ["", "## Error on unseen captures", "", *told]

    out += ["", "## Each effect, Z 6 or more", ""]
    groups = defaultdict(list)
    for c in of("single", 6) + of("double", 6):
        groups[true_label(c.truth)].append(c)
    rows: list[list[object]] = []
    for name, members in sorted(groups.items()):
        shares = [removed[id(c)] for c in members if id(c) in removed]
        rows.append([name, len(members), sum(c.detected for c in members), sum(c.first_right for c in members)])
        rows[-1] += [sum(c.class_right for c in members), sum(c.exact for c in members)]
        rows[-1] += [sum(c.by_rules in c.right for c in members), f"{np.median(shares):.2f}" if shares else ""]
    head = ["truth", "cases", "detected", "right first", "or confused", "exact set", "rule sheet", "error removed"]
    out += table(head, *rows)

    pull = "Pull: (value - truth) / standard deviation. Where values and intervals are right, its median is 0 and the "
    out += ["", "## Parameters of right findings", "", pull + "median of its size 0.67."]
    by_name = defaultdict(list)
    for found in everything:
        by_name["(all)" if found.exact else "(all, another law)", found.exact].append(found)
        by_name[found.name, found.exact].append(found)
    rows = []
    for (name, exact), parameters in sorted(by_name.items()):
        pulls = [found.pull for found in parameters]
        covered = f"{sum(found.covers for found in parameters)} of {len(parameters)}"
        must = "within 0.3" if name == "(all)" else ""
        law = "the catalogue's" if exact else "another"
        rows.append([name, law, covered, f"{np.median(pulls):+.2f}", must, f"{np.median(np.abs(pulls)):.2f}"])
    out += ["", *table(["parameter", "law", "covered", "median pull", "must", "median size"], *rows)]

    out += ["", "## Truth (rows) and first finding (columns)", ""]
    pairs = Counter((true_label(c.truth), c.given) for c in cases)
    across = sorted({given for _, given in pairs})
    down = sorted({name for name, _ in pairs})
    out += table(["", *across], *([name, *(pairs[name, given] or "" for given in across)] for name in down))

    def names(title: str, members: list[Judged]) -> None:
        out.extend(["", f"## {title}: {len(members)}", ""])
        for c in members:
            which = f"{c.truth['case']} {c.truth['name']} (Z {c.z:.1f})"
            out.append(f"- {which}: {c.verdict}, {c.given}; true: {true_label(c.truth)}")
            out.append(f"  sha256 of measurement.yaml {c.truth['files'].get('measurement.yaml', '?')[:16]}")

    names("Confident wrong answers", [c for c in cases if c.confident_wrong])
    names("False alarms", [c for c in nulls if c.detected])
    wrong = [c for c in singles + doubles if c.detected and not c.first_right and not c.confident_wrong]
    names("Other wrong first findings", wrong)
    names(
        "Set-up faults that were missed",
        [c for c in setups if not c.setup_right and not c.confident_wrong and c.answer],
    )
    names(
        "Outside the catalogue, not flagged",
        [c for c in outside if not c.flagged and not c.confident_wrong and c.answer],
    )
    names("Not seen, Z 4 or more", [c for c in singles + doubles if c.verdict == "adequate" and c.z >= 4])
    names("Error that stayed: less than 0.75 removed", [c for c in cases if removed.get(id(c), 1.0) < 0.75])
    names("No answer", [c for c in cases if c.answer is None])
    misses = [f"{c.truth['case']} {f.name} ({f.pull:+.1f})" for c in cases for f in c.found if not f.covers]
    out += ["", f"## Intervals that miss the truth: {len(misses)}", "", *(f"- {miss}" for miss in misses)]
    return "\n".join(out) + "\n"


def unseen(nulls: list[Judged], *strong: list[Judged]) -> tuple[list[str], dict[int, float]]:
    """(what to say about the unseen captures, share of the error removed by id() of the case)."""
    floor = [c.floor for c in nulls if c.floor is not None]
    if not floor:
        return ["No null has been asked, which would tell what an oracle leaves."], {}
    oracle, scatter = float(np.mean(floor)), float(np.std(floor))
    removed: dict[int, float] = {}
    rows: list[list[object]] = [["what", "value", "must", "cases"]]
    rows.append(
        ["nulls: misfit of the right model", f"{oracle:.3f}, sd {scatter:.3f}", "1", f"{len(floor)} of {len(nulls)}"]
    )
    for name, members in zip(("single", "double"), strong, strict=True):
        shares = {id(c): share for c in members if (share := c.removed(oracle)) is not None}
        removed |= shares
        many = f"{len(shares)} of {len(members)}"
        for what, quantile, must in (("median", 0.5, ">= 0.90"), ("10th percentile", 0.1, ">= 0.75")):
            value = f"{np.quantile(list(shares.values()), quantile):.3f}" if shares else "-"
            rows.append([f"{name}, Z >= 10: share of the excess error removed, {what}", value, must, many])
    text = (
        "`compare` judges the data sheet's sensor and the found one by captures that `diagnose` never got, at other "
        "levels. Removed: 1 - (found - oracle) / (data sheet - oracle), of the mean misfit of the checks that fail; "
        "oracle: the mean over the nulls, whose data sheet is right. Only cases where the data sheet's sensor fails a "
        f"check with p <= {CLEARLY:g} there; the share of so small an error is uncertain by 0.2."
    )
    return [text, "", *table(*rows)], removed
