"""Time and memory of `compare` and `diagnose --quick`: the same plan measured twice, with a hidden effect.

    python scripts/inference_cost.py              # both plans; some ten minutes on two idle cores
    python scripts/inference_cost.py frames       # four captures of 64 x 64 pixels x 4,000 frames
    python scripts/inference_cost.py stamps       # 1.5 million time stamps in four captures

The first measurement finds nothing remembered of its plan: each verb has a cache of its own. The second one is another
measurement of the same plan, and finds what the first one left. Compiled code is at hand for both: a small measurement
is diagnosed before. The peak is that of all processes together, shared pages counted once (PSS), as sampled. Only on
Linux.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import sys
import tempfile
import time
from pathlib import Path

import yaml

import spadmnist

sys.path.insert(0, str(Path(__file__).parent))
from memory import peak

SENSOR = """sensor:
  name: bench
  rules: device
  layout: {rows: %d, columns: %d, pixel_area: 25 um^2}
  effects:
    detection: {pdp: 0.5}
    dark_counts: {rate: 200 Hz}
    dead_time: {duration: 50 ns}
    tdc: {resolution: 100 ps}
"""
FRAMES = "modality: qis, frames: %d, frame_time: 10 us"
STAMPS = "modality: tr, exposure: %g ms"
EACH = 404.4 / 250e3  # nW/cm^2 of 500 nm for one detection a second of a pixel of 25 um^2 with a PDP of 50 %


def plan(side: int, captures: dict[str, tuple[str, float]]) -> str:
    """captures: {id: (its clock, detections a second of a pixel; 0: dark)}."""
    lines = []
    for name, (clock, rate) in captures.items():
        lit = f"{{kind: flat, wavelength: 500 nm, irradiance: {EACH * rate:.4g} nW/cm^2, relative_uncertainty: 0.02}}"
        lines.append(f"  - {{id: {name}, {clock}, light: {lit if rate else '{kind: dark}'}}}\n")
    layout = f"{{rows: {side}, columns: {side}}}"
    return f"format: spadmnist-measurement/1\nname: bench\nlayout: {layout}\ncaptures:\n" + "".join(lines)


def frames(side: int, many: int) -> tuple[str, str]:
    rates = {"dark": 0.0, "dim": 3e3, "lit": 1e4, "bright": 4e4}
    return plan(side, {name: (FRAMES % many, rate) for name, rate in rates.items()}), "crosstalk: {probability: 1 %}"


def stamps(side: int, milliseconds: float) -> tuple[str, str]:
    rates = {"dark": 0.0, "dim": 1e4, "lit": 3e4, "bright": 8e4}
    made = plan(side, {name: (STAMPS % milliseconds, rate) for name, rate in rates.items()})
    return made, "afterpulsing: {probability: 1 %, lifetime: 40 ns}"


# plan and hidden effect of each: at its size, and at one that compiles what it needs
KINDS = {
    "frames": (lambda: frames(64, 4000), lambda: frames(8, 200)),
    "stamps": (lambda: stamps(8, 195.0), lambda: stamps(8, 2.0)),
}


def measured(name: str, place: Path) -> None:
    made, small = KINDS[name]
    for each, (text, hidden), seeds in (("small", small(), (0,)), ("lab", made(), (1, 2))):
        model = place / f"{each}-sensor.yaml"
        pixels = yaml.safe_load(text)["layout"]["rows"]
        model.write_text(SENSOR % (pixels, pixels))
        (place / "truth.yaml").write_text(SENSOR % (pixels, pixels) + f"    {hidden}\n")
        (place / "plan.yaml").write_text(text)
        for seed in seeds:
            lab = place / f"{each}-{seed}"
            with contextlib.redirect_stderr(io.StringIO()):
                spadmnist.simulate(place / "truth.yaml", place / "plan.yaml", seed, folder=lab)
            for verb in ("compare", "diagnose"):
                out = place / f"{each}-{seed}-{verb}.json"
                (place / verb).mkdir(exist_ok=True)
                more = ["--quick", "-o", str(place / f"{each}-{seed}-found")] if verb == "diagnose" else []
                began = time.monotonic()
                most = peak([verb, str(model), str(lab), "--json", str(out), *more], place / verb, 3600.0, (0, 1))
                seconds = time.monotonic() - began
                if each == "lab":
                    verdict = json.loads(out.read_text())["verdict"] if out.exists() else "-"
                    print(f"| {name} | {seed} | {verb} | {seconds:.0f} | {most} | {verdict} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=f"of {', '.join(KINDS)} [all]")
    kinds = parser.parse_args().kinds or list(KINDS)
    if unknown := set(kinds) - set(KINDS):
        parser.error(f"no such kind: {', '.join(sorted(unknown))}; there are {', '.join(KINDS)}")
    print("| plan | measurement | verb | seconds | MB | verdict |\n| --- | --- | --- | --- | --- | --- |", flush=True)
    for kind in kinds:
        with tempfile.TemporaryDirectory(prefix="cost-") as place:
            measured(kind, Path(place))


if __name__ == "__main__":
    main()
