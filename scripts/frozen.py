"""Frozen answers of the diagnosis: what a change of the engine changes, on cases that are always the same.

    python scripts/frozen.py make small -o out      # the cases, from one seed; the open ones from ../shared/challenge
    python scripts/frozen.py ask out                # compare and diagnose; again: what is missing
    python scripts/frozen.py changed out            # against scripts/frozen/small.json; 1: a gate is not passed
    python scripts/frozen.py keep out               # these answers are the frozen ones from now on

`small` (about 12 minutes on two cores): the open cases, 12 short ones of the challenge, 20 nulls by `compare`.
`full`: the open cases, 60 of the challenge's of all classes, 200 nulls by `compare`, 40 by `diagnose`.

A change that renames or speeds up must leave every answer byte for byte as it was. A change of the method passes if at
most 2 % of the nulls alarm, no class of Z loses more than two right names net, no case is without an answer, and the
median time is not longer.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import statistics
import sys
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import challenge
from challenge_cases import Case, all_cases, own_seed
from challenge_score import judged, label

OPEN = Path(__file__).parents[2] / "shared" / "challenge"
KEPT = Path(__file__).parent / "frozen"
SEED = 20261125  # of the cases; any number does, but always the same one
SHORT = (
    *("tr-afterpulsing-clear", "tr-crosstalk-moderate", "tr-dead-time-set-clear", "tr-pdp-spread-clear"),
    *("tr-dark-counts-set-clear", "tr-slow-recovery-clear", "qis-hot-pixels-clear", "qis-gate-clear"),
    *("str-converter-clear", "outside-tr-echo-clear", "setup-qis-wavelength", "double-qis-crosstalk-and-flicker"),
)
SETS = {"small": (20, 0, len(SHORT)), "full": (200, 40, 60)}  # nulls by compare, nulls by diagnose, cases
NET_LOSS = 2  # right names that a class of Z may lose
FALSE_ALARMS = 0.02  # share of the nulls; a perfect engine has half of it
CLASSES = ((20.0, "Z 20 or more"), (10.0, "Z 10-20"), (6.0, "Z 6-10"), (4.0, "Z 4-6"), (0.0, "Z below 4"))


def cases_of(name: str) -> list[tuple[Case, tuple[str, ...]]]:
    """The generated cases of a set and the questions that are asked about each."""
    compared, diagnosed, many = SETS[name]
    every = all_cases(compared)
    nulls = [case for case in every if case.kind == "null"]
    if name == "small":
        hidden = [case for case in every if case.name in SHORT]
    else:  # drawn by lot, each class in proportion
        others = [case for case in every if case.kind != "null"]
        order = np.random.default_rng(own_seed(SEED, name, "lot")).permutation(len(others))[:many]
        hidden = [others[k] for k in sorted(order.tolist())]
    asked = [(case, ("compare", "diagnose") if k < diagnosed else ("compare",)) for k, case in enumerate(nulls)]
    return [(case, ("diagnose",)) for case in hidden] + asked


def make(args: argparse.Namespace) -> int:
    folder = Path(args.output)
    for part in ("cases", "unseen", "sealed"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    plan = {}
    with ProcessPoolExecutor(args.jobs) as pool:
        waiting = []
        for case, questions in cases_of(args.set):
            plan[case.name] = list(questions)
            if not (folder / "sealed" / f"{case.name}.json").exists():
                waiting.append(pool.submit(challenge.written, case, SEED, folder, case.name, args.set == "small"))
        for number, one in enumerate(waiting):
            name, seconds, detections = one.result()
            print(f"{number + 1} of {len(waiting)}: {name}, {detections} detections, {seconds:.0f} s", file=sys.stderr)
    opened = sorted(OPEN.glob("*/measurement.yaml"))
    for path in opened:
        plan[path.parent.name] = ["diagnose"]
    (folder / "plan.json").write_text(json.dumps({"set": args.set, "questions": plan}, indent=1))
    missing = "" if opened else f"; the open cases are left out: there is no {OPEN}"
    print(f"{len(plan)} cases in {folder}{missing}; next: ask {folder}")
    return 0


def place_of(folder: Path, case: str) -> Path:
    return OPEN / case if (OPEN / case).is_dir() else folder / "cases" / case


def answer_file(folder: Path, case: str, question: str) -> Path:
    return folder / "answers" / f"{case}.{question}.json"


def ask(args: argparse.Namespace) -> int:
    folder = Path(args.folder)
    (folder / "answers").mkdir(exist_ok=True)
    plan = json.loads((folder / "plan.json").read_text())["questions"]
    until = time.monotonic() + 60 * args.minutes
    able = {option: challenge.has_verb("diagnose", option) for option in ("--jobs", "--within")}
    waiting = [(case, q) for case, asked in plan.items() for q in asked if not answer_file(folder, case, q).exists()]

    def one(case: str, question: str) -> str:
        if time.monotonic() > until:
            return ""
        place, found = place_of(folder, case), folder / "answers" / f"{case}.found"
        partial = answer_file(folder, case, question).with_suffix(".partial")
        command = [question, str(place / "sensor.yaml"), str(place), "--json", str(partial), "--seed", "0"]
        command += ["--jobs", "1"] if able["--jobs"] else []
        if question == "diagnose":
            command += ["--quick", "--output", str(found)] + (["--within", "none"] if able["--within"] else [])
        kept, said = challenge.answered(command, partial, args.timeout)
        answer_file(folder, case, question).write_text(json.dumps(kept, indent=1))
        return f"{case} {question}: {said}, {kept['seconds']:.0f} s"

    with ThreadPoolExecutor(args.jobs) as pool:
        for number, line in enumerate(pool.map(lambda pair: one(*pair), waiting)):
            if line:
                print(f"{number + 1} of {len(waiting)}: {line}", file=sys.stderr, flush=True)
    left = sum(not answer_file(folder, case, q).exists() for case, asked in plan.items() for q in asked)
    print(f"{left} questions are left: ask again" if left else f"every question is asked; next: changed {folder}")
    return 1 if left else 0


def short(answer: dict[str, Any] | None) -> dict[str, Any]:
    """What an answer says, and the digest of all of it but for the place of its files."""
    if answer is None:
        return {"verdict": "no answer", "steps": [], "digest": None}
    whole = {key: value for key, value in answer.items() if key != "sensor"}
    digest = hashlib.sha256(json.dumps(whole, sort_keys=True).encode()).hexdigest()
    misfit = answer.get("misfit")
    numbers = {
        f"{label(step)} {name}": [value.get("value"), value.get("low"), value.get("high")]
        for step in answer.get("steps") or []
        for name, value in (step.get("values") or {}).items()
    }
    steps = [label(step) for step in answer.get("steps") or []]
    return {"verdict": answer["verdict"], "steps": steps, "misfit": misfit, "values": numbers, "digest": digest}


def collected(folder: Path) -> dict[str, Any]:
    """Every answer that is there, with its truth's class and Z where the truth is ours to read."""
    plan = json.loads((folder / "plan.json").read_text())
    found: dict[str, Any] = {}
    for case, asked in plan["questions"].items():
        for question in asked:
            path = answer_file(folder, case, question)
            if not path.exists():
                continue
            told = json.loads(path.read_text())
            entry = {**short(told["answer"]), "seconds": told["seconds"]}
            sealed = folder / "sealed" / f"{case}.json"
            if sealed.exists():
                truth = json.loads(sealed.read_text())
                one = judged(truth, {question: told["answer"]}, told["seconds"])
                entry |= {"class": truth["class"], "z": one.z}
                if truth["class"] in ("single", "double", "triple", "camera"):
                    entry["right"] = len(set(one.right) & set(one.said))
            else:
                entry["class"] = "open"
            found[f"{case} {question}"] = entry
    return {"set": plan["set"], "answers": found}


def alarms(answers: dict[str, Any]) -> tuple[int, int]:
    nulls = [entry for entry in answers.values() if entry["class"] == "null"]
    return sum(entry["verdict"] not in ("adequate", "no answer") for entry in nulls), len(nulls)


def gates(before: dict[str, Any], after: dict[str, Any]) -> list[str]:
    """Which gates are not passed, over the questions that both have."""
    both = sorted(before.keys() & after.keys())
    faults = []
    wrong, nulls = alarms({key: after[key] for key in both})
    if wrong > FALSE_ALARMS * nulls:
        faults.append(f"{wrong} of {nulls} nulls alarm")
    net: Counter[str] = Counter()
    for key in both:
        if "right" in before[key]:
            named = next(name for low, name in CLASSES if before[key]["z"] >= low)
            net[named] += after[key]["right"] - before[key]["right"]
    faults += [f"{name}: {-n} right names lost, net" for name, n in sorted(net.items()) if n < -NET_LOSS]
    faults += [f"{key}: no answer" for key in both if after[key]["verdict"] == "no answer"]
    asked = [key for key in both if key.endswith("diagnose") and before[key]["seconds"] and after[key]["seconds"]]
    if asked:
        old, new = (statistics.median(side[key]["seconds"] for key in asked) for side in (before, after))
        if new > 1.05 * old:
            faults.append(f"median time of diagnose {new:.0f} s, {old:.0f} s before (if nothing else ran)")
    return faults


def differences(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    lines = []
    for name in ("verdict", "steps", "misfit"):
        if old.get(name) != new.get(name):
            lines.append(f"{name}: {old.get(name)} -> {new.get(name)}")
    told = {**old.get("values", {})}
    lines += [
        f"{name}: {told.get(name)} -> {value}"
        for name, value in new.get("values", {}).items()
        if told.get(name) != value
    ]
    return lines or ["only in what is not a step: limits, advice, checks, ladder"]


def changed(args: argparse.Namespace) -> int:
    now = collected(Path(args.folder))
    path = Path(args.against) if args.against else KEPT / f"{now['set']}.json"
    if not path.exists():
        print(f"frozen: there is no {path}; keep {args.folder} writes it", file=sys.stderr)
        return 2
    before, after = json.loads(path.read_text())["answers"], now["answers"]
    both = sorted(before.keys() & after.keys())
    other = [key for key in both if before[key]["digest"] != after[key]["digest"]]
    for key in other:
        print(key, *(f"    {line}" for line in differences(before[key], after[key])), sep="\n")
    faults = gates(before, after)
    print(
        f"{len(both)} questions of {len(before)}: {len(both) - len(other)} answers byte for byte, {len(other)} others"
    )
    wrong, nulls = alarms(after)
    print(f"nulls that alarm: {wrong} of {nulls}")
    print("\n".join(f"not passed: {fault}" for fault in faults) or "every gate is passed")
    return 1 if faults or (args.same and other) else 0


def keep(args: argparse.Namespace) -> int:
    now = collected(Path(args.folder))
    KEPT.mkdir(exist_ok=True)
    path = KEPT / f"{now['set']}.json"
    path.write_text(json.dumps({**now, "program": challenge.package()}, indent=1, sort_keys=True) + "\n")
    print(f"{len(now['answers'])} answers kept in {path}")
    return 0


def main(arguments: list[str] | None = None) -> int:
    about = (__doc__ or "").split("\n\n")
    parser = argparse.ArgumentParser(
        description="\n\n".join(about[:2]), formatter_class=argparse.RawDescriptionHelpFormatter
    )
    verbs = parser.add_subparsers(dest="verb", required=True)
    processors = os.cpu_count() or 1
    making = verbs.add_parser("make", help="write the cases; again: what is missing")
    making.add_argument("set", choices=SETS)
    making.add_argument("-o", "--output", required=True, metavar="FOLDER")
    making.add_argument("--jobs", type=int, default=processors)
    asking = verbs.add_parser("ask", help="compare and diagnose; again: what is missing")
    asking.add_argument("folder", metavar="FOLDER")
    asking.add_argument("--jobs", type=int, default=2, help="cases at a time [2]")
    asking.add_argument("--minutes", type=float, default=float("inf"), help="ask nothing new after so long [no end]")
    asking.add_argument("--timeout", type=float, default=1800.0, help="seconds for one answer [1800]")
    telling = verbs.add_parser("changed", help="what is other than in the frozen answers, and which gates are passed")
    telling.add_argument("folder", metavar="FOLDER")
    telling.add_argument("--against", metavar="FILE", help="other answers than the frozen ones")
    telling.add_argument("--same", action="store_true", help="every answer must be as it was, byte for byte")
    keeping = verbs.add_parser("keep", help="write these answers as the frozen ones")
    keeping.add_argument("folder", metavar="FOLDER")
    args = parser.parse_args(arguments)
    return {"make": make, "ask": ask, "changed": changed, "keep": keep}[args.verb](args)


if __name__ == "__main__":
    raise SystemExit(main())
