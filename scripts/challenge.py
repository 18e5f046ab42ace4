"""The hidden-effect challenge: measurements whose truth is sealed, diagnosed blind, scored afterwards.

    python scripts/challenge.py list
    python scripts/challenge.py make all -o out --seed 1        # cases in out/cases, the truth in out/sealed
    python scripts/challenge.py run out --minutes 90            # spadmnist compare and diagnose; again: what is missing
    python scripts/challenge.py score out                       # opens the truth; writes out/score.md; several: as one

CASES are `all`, a class (null, single, double, triple, camera, outside, setup) or a pattern of names
(`tr-crosstalk-*`). Case folders have numbers for names, drawn at random: the first so many are a fair sample. Beside
them stands the sha256 of each sealed truth, with its salt, and each truth holds the sha256 of its case's files:
neither can be changed between `make` and `score`. out/unseen holds captures of the same sensors that `diagnose` never
gets: they judge the sensor it found.
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
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import yaml

sys.path.insert(0, str(Path(__file__).parent))
from challenge_cases import LIGHT_UNCERTAINTY, NANOWATT, Case, Lab, all_cases, built, chosen, own_seed
from challenge_generator import Capture, record
from challenge_score import judged, report

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
    # the same chip and the same lamp on another day; of every case, lest their being there says something
    apart = folder / "unseen" / number
    apart.mkdir(parents=True)
    later = np.random.default_rng(own_seed(seed, case.name, "unseen"))
    for capture in lab.lit_really(lab.unseen):
        record(lab.world, capture, apart / f"{capture.name}.h5", later)
    (apart / "measurement.yaml").write_text(yaml.safe_dump(described(lab, number, lab.unseen), sort_keys=False))

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
        "files": digests(place),
        "unseen": digests(apart),
    }
    text = json.dumps(truth, indent=1, default=float)
    salt = secrets.token_hex(32)
    sealed = folder / "sealed"
    (sealed / f"{number}.json").write_text(text)
    (sealed / f"{number}.salt").write_text(salt)
    (folder / "cases" / f"{number}.sha256").write_text(seal(salt, text) + "\n")
    return case.name, time.perf_counter() - began, detections


def described(lab: Lab, name: str, stated: list[Capture] | None = None) -> dict[str, Any]:
    """measurement.yaml: what the lab noted down."""
    captures = []
    for c in lab.stated if stated is None else stated:
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


def digests(folder: Path) -> dict[str, str]:
    return {path.name: digest(path) for path in sorted(folder.iterdir())}


def make(args: argparse.Namespace) -> int:
    folder = Path(args.output)
    if folder.exists() and any(folder.iterdir()):
        print(f"challenge: {folder} is not empty; a sealed set is made once, in a folder of its own", file=sys.stderr)
        return 2
    seed = secrets.randbits(63) if args.seed is None else args.seed
    cases = chosen(args.cases, args.quick, args.nulls)
    order = np.random.default_rng(seed).permutation(len(cases))[: args.sample]
    unfinished = folder.with_name(folder.name + ".unfinished")
    for part in ("cases", "unseen", "sealed"):
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
        f"{len(tasks)} cases in {folder / 'cases'}, {time.perf_counter() - began:.0f} s, "
        f"{np.median(seconds):.1f} s each, {max(seconds):.1f} s at most; the truth is sealed in {folder / 'sealed'}"
    )
    return 0


# ---- run --------------------------------------------------------------------------------------------------

QUESTIONS = ("compare", "diagnose", "unseen-start", "unseen-found")


def processors() -> int:
    """How many processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run(args: argparse.Namespace) -> int:
    folder = Path(args.folder)
    (folder / "answers").mkdir(exist_ok=True)
    args.able = {verb: has_verb(verb) for verb in ("compare", "diagnose")}
    args.takes_jobs = {verb: able and has_verb(verb, "--jobs") for verb, able in args.able.items()}
    args.until = time.monotonic() + 60 * args.minutes
    if not args.able["diagnose"]:
        print("challenge: this spadmnist has no verb diagnose; its answers will be missing", file=sys.stderr)
    cases = [path.name for path in (folder / "cases").iterdir() if path.is_dir()]
    # what has failed before comes last, lest it takes the time of what has not been asked
    cases.sort(key=lambda case: (failed_before(folder, case), case))
    asked = failures = 0
    with ThreadPoolExecutor(args.jobs) as pool:
        for answers in pool.map(lambda case: list(ask_all(folder, case, args)), cases):
            asked += len(answers)
            failures += answers.count(False)
    left = sum(not answer_file(folder, case, "diagnose").exists() for case in cases)
    print(
        f"{len(cases)} cases, {asked} questions asked now, {failures} without an answer"
        + (f", {left} cases not yet asked: run again" if left and args.able["diagnose"] else "")
        + f"; next: score {folder}"
    )
    return 1 if failures or not args.able["diagnose"] else 0


def ask_all(folder: Path, case: str, args: argparse.Namespace) -> Iterator[bool]:
    """Ask what is missing of a case, as long as there is time; whether there was an answer."""
    for question in args.ask:
        verb = "diagnose" if question == "diagnose" else "compare"
        if not args.able[verb]:
            continue
        if answer_of(folder, case, question)["answer"] is not None:
            continue
        if question == "unseen-found" and not (found_sensor(folder, case).exists() and steps_of(folder, case)):
            continue
        if time.monotonic() > args.until:
            return
        line, good = ask(folder, question, case, args)
        print(line, file=sys.stderr, flush=True)
        yield good


def found_sensor(folder: Path, case: str) -> Path:
    return folder / "answers" / f"{case}.found" / "sensor.yaml"


def steps_of(folder: Path, case: str) -> list[Any]:
    return (answer_of(folder, case, "diagnose")["answer"] or {}).get("steps") or []


def failed_before(folder: Path, case: str) -> bool:
    asked = [answer_of(folder, case, name) for name in QUESTIONS if answer_file(folder, case, name).exists()]
    return any(told["answer"] is None for told in asked)


def package() -> str:
    """sha256 of the program that answers: blind is who does not change it with the truth in view."""
    sources = sorted((Path(__file__).parents[1] / "spadmnist").rglob("*.py"))
    return hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()


def program() -> list[str]:
    return [sys.executable, "-m", "spadmnist.cli"]


def has_verb(verb: str, option: str = "") -> bool:
    told = subprocess.run([*program(), verb, "--help"], capture_output=True, text=True)
    return told.returncode == 0 and option in told.stdout


def answer_file(folder: Path, case: str, question: str) -> Path:
    return folder / "answers" / f"{case}.{question}.json"


def answer_of(folder: Path, case: str, question: str) -> dict[str, Any]:
    path = answer_file(folder, case, question)
    return json.loads(path.read_text()) if path.exists() else {"answer": None, "seconds": None, "after_opening": False}


def ask(folder: Path, question: str, case: str, args: argparse.Namespace) -> tuple[str, bool]:
    """One question about one case; its answer, or why there is none, goes to a file of its own."""
    place, target = folder / "cases" / case, answer_file(folder, case, question)
    sensor, found = place / "sensor.yaml", found_sensor(folder, case).parent
    if question.startswith("unseen"):
        place = folder / "unseen" / case
        sensor = found_sensor(folder, case) if question == "unseen-found" else sensor
    told = target.with_suffix(".partial")
    told.unlink(missing_ok=True)
    verb = "diagnose" if question == "diagnose" else "compare"
    options = ["--json", str(told), "--seed", "0"]
    if args.takes_jobs[verb]:
        options += ["--jobs", str(max(processors() // args.jobs, 1))]
    if verb == "diagnose":
        shutil.rmtree(found, ignore_errors=True)
        answer_file(folder, case, "unseen-found").unlink(missing_ok=True)
        options += ["--output", str(found), *(["--quick"] if args.quick else [])]
        options += ["--within", args.within] if args.within else []
    kept, said = answered([verb, str(sensor), str(place), *options], told, args.timeout)
    if verb == "diagnose":
        for page in found.glob("*.html"):
            page.unlink()
    kept["after_opening"] = (folder / "sealed" / "opened").exists()
    target.write_text(json.dumps(kept, indent=1))
    return f"{case} {question}: {said}, {kept['seconds']:.0f} s", kept["answer"] is not None


def answered(command: list[str], told: Path, timeout: float) -> tuple[dict[str, Any], str]:
    """(answer of one command whose JSON goes to `told`, with its seconds and why there is none; its verdict)."""
    began, status, error = time.perf_counter(), None, ""
    try:
        done = subprocess.run([*program(), *command], capture_output=True, text=True, timeout=timeout)
        status, error = done.returncode, done.stderr[-2000:]
    except subprocess.TimeoutExpired:
        error = f"no answer in {timeout:g} s"
    seconds = time.perf_counter() - began
    answer = None
    if status in (0, 1) and told.exists():
        answer, error = json.loads(told.read_text()), ""
    told.unlink(missing_ok=True)
    kept = {
        "command": command,
        "seconds": round(seconds, 1),
        "status": status,
        "error": error,
        "package": package(),
        "answer": answer,
    }
    last = error.strip().splitlines()[-1] if error.strip() else status
    return kept, answer["verdict"] if answer else f"no answer ({last})"


# ---- score ------------------------------------------------------------------------------------------------


def opened(folder: Path) -> tuple[list[dict[str, Any]], list[str]]:
    """The truths, and what is wrong with their seals."""
    cases = {
        path.name for path in (folder / "cases").iterdir() if path.is_dir() and (folder / "unseen" / path.name).is_dir()
    }
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
        for part, sealed in (("cases", truth["files"]), ("unseen", truth["unseen"])):
            if digests(folder / part / name) != sealed:
                faults.append(f"{name}: the data in {part} are not those that were sealed")
        found.append(truth)
    return found, faults


def score(args: argparse.Namespace) -> int:
    folders = [Path(folder) for folder in args.folders]
    sets = [opened(folder) for folder in folders]
    faults = [f"{folder}: {fault}" for folder, (_, wrong) in zip(folders, sets, strict=True) for fault in wrong]
    seen: dict[str, Path] = {}
    for path in (path for folder in folders for path in sorted((folder / "cases").glob("*.sha256"))):
        first = seen.setdefault(path.read_text().strip(), path)
        if first is not path:
            faults.append(f"{path} is {first} once more: give each set once")
    if faults:
        for fault in faults:
            print(f"challenge: {fault}", file=sys.stderr)
        print("challenge: nothing is scored", file=sys.stderr)
        return 1
    cases, late = [], 0
    for folder, (truths, _) in zip(folders, sets, strict=True):
        answers = []
        for truth in truths:
            if not answer_file(folder, truth["case"], "diagnose").exists():
                continue  # not yet asked
            told = {question: answer_of(folder, truth["case"], question) for question in QUESTIONS}
            answers += list(told.values())
            found = {name: one["answer"] for name, one in told.items()}
            name = truth["case"] if len(folders) == 1 else f"{folder.resolve().name}/{truth['case']}"
            cases.append(judged({**truth, "case": name}, found, told["diagnose"]["seconds"]))
        (folder / "sealed" / "opened").touch()
        # of each set by itself: what is blind of one may have been written with the truth of another in view
        blind = {one["package"] for one in answers if one["answer"] and not one["after_opening"]}
        late += sum(bool(one["after_opening"]) and one["package"] not in blind for one in answers)
    text = report(cases, sum(len(truths) for truths, _ in sets))
    if late:
        text += (
            f"\n{late} answers are of a program that was changed after the truth had been opened: they are not blind.\n"
        )
    (folders[0] / "score.md").write_text(text)
    print(text, end="")
    return 0


# ---- the command line -------------------------------------------------------------------------------------


def main(arguments: list[str] | None = None) -> int:
    about = (__doc__ or "").split("\n\n")
    parser = argparse.ArgumentParser(
        description="\n\n".join(about[:2]), formatter_class=argparse.RawDescriptionHelpFormatter
    )
    verbs = parser.add_subparsers(dest="verb", required=True)
    verbs.add_parser("list", help="the names of all cases")
    making = verbs.add_parser("make", help="write cases, seal their truth")
    making.add_argument("cases", nargs="+", metavar="CASES", help="all, a class, or patterns of names")
    making.add_argument("-o", "--output", required=True, metavar="FOLDER")
    making.add_argument("--seed", type=int, help="default: nobody knows it")
    making.add_argument("--quick", action="store_true", help="16 of the cases, captures half as long")
    making.add_argument("--nulls", type=int, default=30, help="measurements without any effect [30]")
    making.add_argument("--sample", type=int, metavar="N", help="so many of them, drawn by lot [all]")
    making.add_argument("--jobs", type=int, default=processors())
    running = verbs.add_parser("run", help="spadmnist compare and diagnose over all cases; again: what is missing")
    running.add_argument("folder", metavar="FOLDER")
    running.add_argument(
        "--jobs", type=int, default=2, help="cases at a time, which share the cores; on slow ones 1 [2]"
    )
    running.add_argument("--quick", action="store_true", help="diagnose --quick")
    running.add_argument("--within", metavar="TIME", help="diagnose --within TIME [its default]")
    running.add_argument("--ask", nargs="+", choices=QUESTIONS, default=QUESTIONS, help="these questions only")
    running.add_argument("--minutes", type=float, default=math.inf, help="ask no new question after so long [no end]")
    running.add_argument("--timeout", type=float, default=1800.0, help="seconds for one answer [1800]")
    scoring = verbs.add_parser("score", help="open the truth, check the seals, write score.md into the first")
    scoring.add_argument("folders", nargs="+", metavar="FOLDER", help="scored together")
    args = parser.parse_args(arguments)
    if args.verb == "list":
        print("\n".join(case.name for case in all_cases()))
        return 0
    return {"make": make, "run": run, "score": score}[args.verb](args)


if __name__ == "__main__":
    raise SystemExit(main())
