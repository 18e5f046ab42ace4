"""The hidden-effect challenge: measurements whose truth is sealed, diagnosed blind, scored afterwards.

    python scripts/challenge.py list
    python scripts/challenge.py make all -o out --seed 1        # cases in out/cases, the truth in out/sealed
    python scripts/challenge.py run out                         # spadmnist compare and diagnose, over all cases
    python scripts/challenge.py score out                       # opens the truth; writes out/score.md

CASES are `all`, a class (null, single, double, outside, setup) or a pattern of names (`tr-crosstalk-*`). Case folders
have numbers for names. Beside them stands the sha256 of each sealed truth, with its salt, and each truth holds the
sha256 of its case's files: neither can be changed between `make` and `score`.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import math
import os
import secrets
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

sys.path.insert(0, str(Path(__file__).parent))
from challenge_cases import LIGHT_UNCERTAINTY, NANOWATT, Case, Lab, all_cases, built, chosen, own_seed
from challenge_generator import record

# ---- make -------------------------------------------------------------------------------------------------


def written(case: Case, seed: int, folder: Path, number: str, quick: bool) -> tuple[str, float, int]:
    """Make one case, seal its truth; (its name, seconds, detections)."""
    began = time.perf_counter()
    lab, hidden = built(case, seed, quick)
    rng = np.random.default_rng(own_seed(seed, case.name, "captures"))
    place = folder / "cases" / number
    place.mkdir(parents=True)
    detections = sum(record(lab.world, capture, place / f"{capture.name}.h5", rng) for capture in lab.real)
    effects = {name: lab.effects[name] for name in sorted(lab.effects)}  # their order says nothing
    sensor = {"name": f"lab {case.family}", "rules": "device", "layout": lab.layout, "effects": effects}
    (place / "sensor.yaml").write_text(yaml.safe_dump({"sensor": sensor}, sort_keys=False))
    (place / "measurement.yaml").write_text(yaml.safe_dump(described(lab, number), sort_keys=False))

    truth = {
        "name": case.name,
        "case": number,
        "class": case.kind,
        "family": case.family,
        "tier": case.tier,
        "z": [round(h.z, 2) for _, _, h in hidden],
        "argument": [h.argument for _, _, h in hidden],
        "truth": [step for _, _, h in hidden for step in h.truth],
        "setup": next((h.setup for _, _, h in hidden if h.setup), None),
        "parameters": {name: value for _, _, h in hidden for name, value in h.parameters.items()},
        "near": {name: value for _, _, h in hidden for name, value in h.near.items()},
        "hidden": {name: {"strength": x, **h.settings} for name, x, h in hidden},
        "irradiance_scale": lab.scale,
        "seed": seed,
        "files": {path.name: digest(path) for path in sorted(place.iterdir())},
    }
    text = json.dumps(truth, indent=1, default=float)
    salt = secrets.token_hex(32)
    sealed = folder / "sealed"
    (sealed / f"{number}.json").write_text(text)
    (sealed / f"{number}.salt").write_text(salt)
    (folder / "cases" / f"{number}.sha256").write_text(seal(salt, text) + "\n")
    return case.name, time.perf_counter() - began, detections


def described(lab: Lab, name: str) -> dict[str, Any]:
    """measurement.yaml: what the lab noted down."""
    captures = []
    for c in lab.stated:
        entry: dict[str, Any] = {
            "id": c.name,
            "file": f"{c.name}.h5",
            "modality": c.modality,
            "light": {"kind": "dark"},
        }
        if not c.dark:
            entry["light"] = {
                "kind": "flat",
                "wavelength": f"{c.wavelength * 1e9:.0f} nm",
                "irradiance": f"{c.irradiance / NANOWATT:.6g} nW/cm^2",
                "relative_uncertainty": LIGHT_UNCERTAINTY,
            }
        if c.frames:
            frame = f"{c.frame_time * 1e6:g} us"
            entry |= {"frames": c.frames, "frame_time": frame, "frame_period": frame}
        else:
            entry["exposure"] = f"{c.exposure * 1e3:g} ms"
        captures.append(entry)
    layout = {"rows": lab.world.rows, "columns": lab.world.columns}
    return {"format": "spadmnist-measurement/1", "name": name, "layout": layout, "captures": captures}


def seal(salt: str, truth: str) -> str:
    return hashlib.sha256((salt + truth).encode()).hexdigest()


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def make(args: argparse.Namespace) -> int:
    folder = Path(args.output)
    if folder.exists() and any(folder.iterdir()):
        print(f"challenge: {folder} is not empty; a sealed set is made once, in a folder of its own", file=sys.stderr)
        return 2
    seed = secrets.randbits(63) if args.seed is None else args.seed
    cases = chosen(args.cases, args.quick, args.nulls)
    order = np.random.default_rng(seed).permutation(len(cases))
    unfinished = folder.with_name(folder.name + ".unfinished")
    for part in ("cases", "sealed"):
        shutil.rmtree(unfinished / part, ignore_errors=True)
        (unfinished / part).mkdir(parents=True)
    began, seconds = time.perf_counter(), []
    tasks = [
        (cases[place], seed, unfinished, f"case-{number + 1:03d}", args.quick)
        for number, place in enumerate(order.tolist())
    ]
    with ProcessPoolExecutor(args.jobs) if args.jobs > 1 else contextlib.nullcontext() as pool:
        made = pool.map(written, *zip(*tasks, strict=True)) if pool else (written(*task) for task in tasks)
        for (*_, number, _), (_, took, detections) in zip(tasks, made, strict=True):
            seconds.append(took)
            print(f"{number}: {detections} detections, {took:.1f} s", file=sys.stderr)
    if folder.exists():
        folder.rmdir()
    unfinished.rename(folder)
    print(
        f"{len(cases)} cases in {folder / 'cases'}, {time.perf_counter() - began:.0f} s, "
        f"{np.median(seconds):.1f} s each, {max(seconds):.1f} s at most; the truth is sealed in {folder / 'sealed'}"
    )
    return 0


# ---- run --------------------------------------------------------------------------------------------------


def run(args: argparse.Namespace) -> int:
    folder = Path(args.folder)
    answers = folder / "answers"
    answers.mkdir(exist_ok=True)
    verbs = [] if args.no_compare else ["compare"]
    if has_verb("diagnose"):
        verbs.append("diagnose")
    else:
        print("challenge: this spadmnist has no verb diagnose; its answers will be missing", file=sys.stderr)
    cases = sorted(path.name for path in (folder / "cases").iterdir() if path.is_dir())
    args.one_job = {verb: has_verb(verb, "--jobs") for verb in verbs}
    tasks = [(verb, case) for case in cases for verb in verbs if not answered(answers / f"{case}.{verb}.json")]
    failures = 0
    with ThreadPoolExecutor(args.jobs) as pool:
        for line, good in pool.map(lambda task: ask(folder, task[0], task[1], args), tasks):
            failures += not good
            print(line, file=sys.stderr)
    print(f"{len(cases)} cases, {len(tasks)} questions asked now, {failures} without an answer; next: score {folder}")
    return 1 if failures or "diagnose" not in verbs else 0


def program() -> list[str]:
    return [sys.executable, "-m", "spadmnist.cli"]


def has_verb(verb: str, option: str = "") -> bool:
    told = subprocess.run([*program(), verb, "--help"], capture_output=True, text=True)
    return told.returncode == 0 and option in told.stdout


def answered(path: Path) -> bool:
    return path.exists() and json.loads(path.read_text())["answer"] is not None


def ask(folder: Path, verb: str, case: str, args: argparse.Namespace) -> tuple[str, bool]:
    """One question about one case; its answer, or why there is none, goes to a file of its own."""
    place, target = folder / "cases" / case, folder / "answers" / f"{case}.{verb}.json"
    told = folder / "answers" / f"{case}.{verb}.partial"
    told.unlink(missing_ok=True)
    command = [*program(), verb, str(place / "sensor.yaml"), str(place), "--json", str(told), "--seed", "0"]
    if args.one_job[verb]:
        command += ["--jobs", "1"]
    if args.quick and verb == "diagnose":
        command.append("--quick")
    began, status, error = time.perf_counter(), None, ""
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=args.timeout)
        status, error = done.returncode, done.stderr[-2000:]
    except subprocess.TimeoutExpired:
        error = f"no answer in {args.timeout:g} s"
    answer = None
    if status in (0, 1) and told.exists():
        answer, error = json.loads(told.read_text()), ""
    told.unlink(missing_ok=True)
    seconds = time.perf_counter() - began
    found = {
        "command": [verb, *command[len(program()) + 1 :]],
        "seconds": round(seconds, 1),
        "status": status,
        "error": error,
        "after_opening": (folder / "sealed" / "opened").exists(),
        "answer": answer,
    }
    target.write_text(json.dumps(found, indent=1))
    said = answer["verdict"] if answer else f"no answer ({error.strip().splitlines()[-1] if error.strip() else status})"
    return f"{case} {verb}: {said}, {seconds:.0f} s", answer is not None


# ---- score ------------------------------------------------------------------------------------------------


def opened(folder: Path) -> tuple[list[dict[str, Any]], list[str]]:
    """The truths, and what is wrong with their seals."""
    cases = {path.name for path in (folder / "cases").iterdir() if path.is_dir()}
    seals = {path.stem for path in (folder / "cases").glob("*.sha256")}
    truths = {path.stem for path in (folder / "sealed").glob("*.json")}
    faults = [
        f"{name}: data, seal or truth is missing"
        for name in sorted((cases | seals | truths) - (cases & seals & truths))
    ]
    found = []
    for name in sorted(cases & seals & truths):
        text = (folder / "sealed" / f"{name}.json").read_text()
        salt = folder / "sealed" / f"{name}.salt"
        expected = (folder / "cases" / f"{name}.sha256").read_text().strip()
        if not salt.exists() or seal(salt.read_text(), text) != expected:
            faults.append(f"{name}: the truth is not the one that was sealed")
            continue
        truth = json.loads(text)
        files = {path.name: digest(path) for path in sorted((folder / "cases" / name).iterdir())}
        if files != truth["files"]:
            faults.append(f"{name}: the data are not those that were sealed")
        found.append(truth)
    return found, faults


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
class Judged:
    """One case, its answer beside its truth. Without an answer nothing is right."""

    truth: dict[str, Any]
    answer: dict[str, Any] | None
    seconds: float | None
    compared: str | None  # compare's verdict
    verdict: str = "no answer"
    given: str = "no answer"  # label of the first finding
    first_right: bool = False
    class_right: bool = False
    both: bool = False
    exact: bool = False
    flagged: bool = False  # says that something remains unexplained
    setup_right: bool = False
    confident_wrong: bool = False
    intervals: list[tuple[str, bool, bool]] = field(default_factory=list)  # parameter, covers, by the catalogue's law

    @property
    def z(self) -> float:
        return min(self.truth["z"], default=0.0)

    @property
    def detected(self) -> bool:
        return self.verdict not in ("adequate", "no answer")


def judged(truth: dict[str, Any], answer: dict[str, Any] | None, seconds: float | None, compared: str | None) -> Judged:
    case = Judged(truth, answer, seconds, compared)
    if answer is None:
        return case
    case.verdict = answer["verdict"]
    steps = answer.get("steps") or []
    entries = answer.get("setup") or []
    said, right = [label(step) for step in steps], [label(step) for step in truth["truth"]]
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
    for exact, named in ((True, truth["parameters"]), (False, truth["near"])):
        for name, value in named.items():
            effect, parameter = name.split(".")
            for step in steps:
                found = (step.get("values") or {}).get(parameter)
                if step["effect"] == effect and label(step) in right and found and found.get("low") is not None:
                    case.intervals.append((name, found["low"] <= value <= found["high"], exact))
    return case


def wilson(successes: int, trials: int, z: float = 1.959964) -> tuple[float, float]:
    """95 % interval of a share (Wilson)."""
    if trials == 0:
        return 0.0, 1.0
    share = successes / trials
    centre = (share + z**2 / (2 * trials)) / (1 + z**2 / trials)
    half = z / (1 + z**2 / trials) * math.sqrt(share * (1 - share) / trials + z**2 / (4 * trials**2))
    return max(0.0, centre - half), min(1.0, centre + half)


def report(cases: list[Judged]) -> str:
    """The table of the benchmark in Markdown, with everything that went wrong by name."""

    def line(what: str, members: list[Judged], good: Callable[[Judged], bool], must: str, bad: bool = False) -> str:
        told = [c for c in members if c.answer is not None]
        # silence is no success: it stays among the cases unless the line counts failures
        return row(what, sum(map(good, told)), len(told if bad else members), must, len(members) - len(told))

    def row(what: str, successes: int, trials: int, must: str, silent: int = 0) -> str:
        low, high = wilson(successes, trials)
        share = f"{100 * successes / trials:.0f} %" if trials else "-"
        interval = f"{100 * low:.0f}-{100 * high:.0f} %" if trials else "-"
        return f"| {what} | {successes} of {trials} | {share} | {interval} | {must} | {silent} |"

    def of(kind: str, low: float = -1.0, high: float = math.inf) -> list[Judged]:
        return [c for c in cases if c.truth["class"] == kind and low <= c.z < high]

    nulls, singles, strong = of("null"), of("single"), of("single", 10)
    doubles, outside, setups = of("double"), of("outside"), of("setup")
    out = [
        "# Hidden-effect challenge",
        "",
        f"{len(cases)} cases. Z: the weakest hidden effect's expected significance for an oracle. "
        "Intervals: Wilson, 95 %. A case without an answer is no success, and none of the failures that a line counts.",
        "",
        "| what | cases | share | 95 % | must | no answer |",
        "| --- | --- | --- | --- | --- | --- |",
        line("nulls: false alarm (any verdict but adequate)", nulls, lambda c: c.detected, "<= 2.7 %", True),
    ]
    compared = [c for c in nulls if c.compared]
    alarms = sum(c.compared == "fails" for c in compared)
    out.append(row("nulls: false alarm of `compare`", alarms, len(compared), "1 %", len(nulls) - len(compared)))
    out.append(line("single, Z >= 10: detected", strong, lambda c: c.detected, ">= 98 %"))
    out.append(line("single, Z >= 10: right effect first", strong, lambda c: c.first_right, ">= 90 %"))
    out.append(line("single, Z >= 10: right, or among at most 3 confused", strong, lambda c: c.class_right, ">= 98 %"))
    bands = [("20 or more", 20, math.inf, ">= 90 %"), ("10-20", 10, 20, ">= 90 %"), ("6-10", 6, 10, ">= 80 %")]
    bands += [("4-6", 4, 6, ">= 55 %"), ("3-4", 3, 4, ""), ("below 3", -1, 3, "")]
    for name, low, high, must in bands:
        out.append(
            line(f"single, Z {name}: right effect first", of("single", low, high), lambda c: c.first_right, must)
        )
    for name, low, high, _ in bands[2:]:
        out.append(
            line(
                f"single, Z {name}: detected",
                of("single", low, high),
                lambda c: c.detected,
                "<= 20 %" if low < 0 else "",
                bad=low < 0,
            )
        )
    out.append(line("single: exact set of findings", singles, lambda c: c.exact, ""))
    out.append(line("double: both found", doubles, lambda c: c.both, ">= 80 %"))
    out.append(line("double: exact set", doubles, lambda c: c.exact, ">= 65 %"))
    out.append(line("outside the catalogue: flagged as unexplained", outside, lambda c: c.flagged, ">= 80 %"))
    out.append(line("outside the catalogue: confidently wrong", outside, lambda c: c.confident_wrong, "<= 5 %", True))
    out.append(line("set-up: said so, and where", setups, lambda c: c.setup_right, ">= 85 %"))
    everything = [interval for c in cases for interval in c.intervals]
    for exact, what, must in ((True, "by the catalogue's law", "90-98 %"), (False, "another law", "")):
        covers = [covered for _, covered, same in everything if same is exact]
        out.append(row(f"95 % intervals that cover the truth, {what}", sum(covers), len(covers), must))
    compares = [c for c in cases if c.truth["class"] != "null" and c.z >= 10 and c.compared]
    out.append(row("`compare` fails, Z >= 10", sum(c.compared == "fails" for c in compares), len(compares), ""))
    times = [c.seconds for c in cases if c.seconds is not None and c.verdict != "no answer"]
    if times:
        out += ["", f"Time of `diagnose`: median {np.median(times):.0f} s, longest {max(times):.0f} s (must: 300 s)."]

    out += ["", "## Truth (rows) and first finding (columns)", ""]
    table = Counter((true_label(c.truth), c.given) for c in cases)
    across = sorted({given for _, given in table})
    out += ["| | " + " | ".join(across) + " |", "| --- |" + " --- |" * len(across)]
    for name in sorted({name for name, _ in table}):
        out.append(f"| {name} | " + " | ".join(str(table[name, given] or "") for given in across) + " |")

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
    names("No answer", [c for c in cases if c.answer is None])
    misses = [f"{c.truth['case']} {name}" for c in cases for name, covered, _ in c.intervals if not covered]
    out += ["", f"## Intervals that miss the truth: {len(misses)}", "", *(f"- {miss}" for miss in misses)]
    return "\n".join(out) + "\n"


def answer_of(folder: Path, case: str, verb: str) -> dict[str, Any]:
    path = folder / "answers" / f"{case}.{verb}.json"
    return json.loads(path.read_text()) if path.exists() else {"answer": None, "seconds": None, "after_opening": False}


def score(args: argparse.Namespace) -> int:
    folder = Path(args.folder)
    truths, faults = opened(folder)
    if faults:
        for fault in faults:
            print(f"challenge: {fault}", file=sys.stderr)
        print("challenge: nothing is scored with a broken seal", file=sys.stderr)
        return 1
    cases, late = [], 0
    for truth in truths:
        told = answer_of(folder, truth["case"], "diagnose")
        compared = answer_of(folder, truth["case"], "compare")
        late += bool(told["after_opening"] or compared["after_opening"])
        verdict = compared["answer"]["verdict"] if compared["answer"] else None
        cases.append(judged(truth, told["answer"], told["seconds"], verdict))
    (folder / "sealed" / "opened").touch()
    text = report(cases)
    if late:
        text += f"\n{late} cases were answered after the truth had been opened: this set is no longer blind.\n"
    (folder / "score.md").write_text(text)
    print(text, end="")
    return 0


# ---- the command line -------------------------------------------------------------------------------------


def main(arguments: list[str] | None = None) -> int:
    about = (__doc__ or "").split("\n\n")
    parser = argparse.ArgumentParser(
        description="\n\n".join(about[:2]), formatter_class=argparse.RawDescriptionHelpFormatter
    )
    verbs = parser.add_subparsers(dest="verb", required=True)
    processors = os.cpu_count() or 1
    verbs.add_parser("list", help="the names of all cases")
    making = verbs.add_parser("make", help="write cases, seal their truth")
    making.add_argument("cases", nargs="+", metavar="CASES", help="all, a class, or patterns of names")
    making.add_argument("-o", "--output", required=True, metavar="FOLDER")
    making.add_argument("--seed", type=int, help="default: nobody knows it")
    making.add_argument("--quick", action="store_true", help="16 of the cases, captures half as long")
    making.add_argument("--nulls", type=int, default=30, help="measurements without any effect [30]")
    making.add_argument("--jobs", type=int, default=processors)
    running = verbs.add_parser("run", help="spadmnist compare and diagnose over all cases; again: what is missing")
    running.add_argument("folder", metavar="FOLDER")
    running.add_argument("--jobs", type=int, default=2, help="cases at a time [2]")
    running.add_argument("--quick", action="store_true", help="diagnose --quick")
    running.add_argument("--no-compare", action="store_true", help="leave out spadmnist compare")
    running.add_argument("--timeout", type=float, default=1800.0, help="seconds for one answer [1800]")
    scoring = verbs.add_parser("score", help="open the truth, check the seals, write score.md")
    scoring.add_argument("folder", metavar="FOLDER")
    args = parser.parse_args(arguments)
    if args.verb == "list":
        print("\n".join(case.name for case in all_cases()))
        return 0
    return {"make": make, "run": run, "score": score}[args.verb](args)


if __name__ == "__main__":
    raise SystemExit(main())
