"""The same experiment over each wire by the commands that a user types, and what they identify."""

from __future__ import annotations

import json
import math
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from analysis.identify.identify import identify
from drivers import make_driver, wire_at
from hil_sim.device.server import TCP, VALVES, WIRES
from protocols.engine import engine
from protocols.files import library
from protocols.files.plan import Plan, resolve
from rig.bench.session import Bench
from rig.cli.errors import WorkError
from rig.cli.simulated.simulated_bench import simulated_bench
from rig.model.rig import Rig
from rig.runs.recorder import Recorder
from rig.runs.rigs import load_rig
from rig.runs.store import load_run
from tests.studies.wires.in_step import run_in_step

RIG: Final = "shinshu-2dof"
VALVES_HZ: Final = 200.0  # what a host may sample over CANopen
Say = Callable[[str], None]

# The shipped lock-and-excite with fewer and shorter records.
PROTOCOL: Final = """
name: three-steps
description: The paper's three steps, three records of 5 s each
joints: 2
steps:
  - name: step1
    lock: [{joint: 1, at: closed, piston: 0 mm, tolerance: 2 mm}]
    excite:
      - joint: 2
        signal: &sine {kind: sine, frequency: 1 Hz, amplitude: 1.0 V}
        centre: 0 mm
        centring: &centring {mode: open-loop, drift: 2 mm, offset: 3 mm, tries: 6}
    repeats: 3
    duration: 5 s
    warm_up: 2
    ramp: 2 s
    settle: 1 s
  - name: step2
    lock: [{joint: 2, at: end_min, tolerance: 2 mm}]
    excite: [{joint: 1, signal: *sine, centre: 0 mm, centring: *centring}]
    repeats: 3
    duration: 5 s
    warm_up: 2
  - name: step3
    lock: [{joint: 2, at: end_max, tolerance: 2 mm}]
    excite: [{joint: 1, signal: *sine, centre: 0 mm, centring: *centring}]
    repeats: 3
    duration: 5 s
    warm_up: 2
"""


@dataclass(frozen=True)
class Interval:
    """A parameter as identified: value and half width of its 95 % interval [SI]."""

    value: float
    half: float


@dataclass(frozen=True)
class WireResult:
    """What was identified over one wire, and how long run and identification took [s]."""

    wire: str
    parameters: Mapping[str, Interval]
    seconds: float

    def apart(self, other: WireResult) -> tuple[str, float]:
        """Return the parameter furthest from another wire's, and |difference| over both halves."""
        shares = {
            name: abs(mine.value - other.parameters[name].value)
            / (mine.half + other.parameters[name].half)
            for name, mine in self.parameters.items()
            if name in other.parameters
        }
        worst = max(shares, key=lambda name: shares[name])
        return worst, shares[worst]


def by_commands(wire: str, folder: Path, seed: int) -> WireResult:
    """Run sim, probe, run and identify on a wire; raises WorkError with what one of them said."""
    folder.mkdir(parents=True)
    protocol, run, found = folder / "three-steps.yaml", folder / "run", folder / "identified.json"
    protocol.write_text(PROTOCOL, "utf-8")
    began = time.perf_counter()
    with simulated_bench(RIG, seed=seed, wire=wire) as endpoint:
        reach = ("--rig", RIG, "--endpoint", endpoint)
        _bramah("probe", *reach)
        _bramah("run", protocol, *reach, "--out", run)
    _bramah("identify", run, "--json", found)
    told = json.loads(found.read_text("utf-8"))["parameters"]
    return WireResult(wire, intervals(told), time.perf_counter() - began)


def valves_in_step(folder: Path, seed: int) -> WireResult:
    """Run the same on valves of CiA 408, host and valves in one time (`in_step`)."""
    folder.mkdir(parents=True)
    protocol = folder / "three-steps.yaml"
    protocol.write_text(PROTOCOL, "utf-8")
    rig = load_rig(RIG).model_copy(update={"sample_rate": VALVES_HZ})
    began = time.perf_counter()
    run_in_step(resolve(library.load(str(protocol), {}), rig), rig, seed, folder / "run")
    return WireResult(VALVES, identified(folder / "run"), time.perf_counter() - began)


def over_wire(plan: Plan, rig: Rig, wire: str, seed: int, folder: Path, rig_file: str) -> None:
    """Run a plan into a folder over a wire of a bench in a process of its own."""
    with simulated_bench(rig_file, seed=seed, wire=wire) as endpoint:
        reached = rig.model_copy(update={"wire": wire_at(endpoint, rig.wire)})
        recorder = Recorder(folder, reached, protocol=plan.protocol.model_dump(mode="json"))
        with Bench(reached, make_driver(reached.wire, reached), recorder, signals=False) as bench:
            engine.run(plan, reached, bench)


def identified(folder: Path) -> dict[str, Interval]:
    """Return what a run tells, parameters that it does not determine left out."""
    found = identify([load_run(folder)]).estimates
    return {
        name: Interval(e.value, 0.5 * (e.ci95[1] - e.ci95[0]))
        for name, e in found.items()
        if math.isfinite(e.value)
    }


def intervals(told: Mapping[str, Any]) -> dict[str, Interval]:
    """Return parameters from the JSON of `identify`."""
    return {
        name: Interval(p["value"], 0.5 * (p["ci95"][1] - p["ci95"][0])) for name, p in told.items()
    }


def every_wire(folder: Path, seed: int, say: Say) -> list[WireResult]:
    """Run the experiment over every wire, Modbus TCP first."""
    results = []
    for wire in WIRES:
        say(f"{wire}: probe, run, identify")
        place = folder / wire
        results.append(
            valves_in_step(place, seed) if wire == VALVES else by_commands(wire, place, seed)
        )
    return results


def agreement_rows(results: Sequence[WireResult]) -> list[tuple[str, ...]]:
    """Return the table's rows: b, the worst known parameter, what lies furthest from TCP's."""
    first = next(result for result in results if result.wire == TCP)
    rows: list[tuple[str, ...]] = []
    for result in results:
        b = result.parameters["b"]
        name, share = result.apart(first)
        rows.append(
            (
                f"`{result.wire}`",
                f"{len(result.parameters)}",
                f"{1e-6 * b.value:.2f} ± {1e-6 * b.half:.2f}",
                "" if result is first else f"{name}, {share:.2f}",
                f"{result.seconds:.0f}",
            )
        )
    return rows


HEADER: Final = ("wire", "parameters", "b [MPa]", "furthest from Modbus TCP's, of both ±", "s")


def _bramah(*words: object) -> None:
    line = [sys.executable, "-c", "from rig.cli.main import run; run()", *map(str, words)]
    done = subprocess.run(line, capture_output=True, text=True, check=False)
    if done.returncode:
        said = done.stderr.strip().splitlines()[-1:] or ["nothing"]
        raise WorkError(f"bramah {words[0]} ended with {done.returncode}: {said[0]}")
