"""The figures of `bramah bench`, each with its limit."""

from __future__ import annotations

import math
import os
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from analysis.report import paper
from analysis.trace.engine import trace
from protocols.files.plan import Overrides
from rig.cli.bench import plant
from rig.cli.bench.acquisition import acquisition_figures, wire_figures
from rig.cli.bench.faults.figures import fault_figures
from rig.cli.bench.figure import Figure, processor_time
from rig.cli.bench.screen.arrival import arrival_figures
from rig.cli.bench.screen.cost import cost_figures
from rig.cli.bench.screen.stops import stop_figures
from rig.cli.bench.speed.figures import (
    free_run_figures,
    growth_figures,
    identify_figures,
    plant_over_kernel,
)
from rig.cli.bench.speed.run_figures import run_figures
from rig.cli.bench.stream_figures import stream_figures
from rig.cli.simulated.experiment import HIDDEN, RIG, Experiment, experiment
from rig.cli.text.output import Say, clock_text, table
from rig.model import channels as ch
from rig.model.parse import InputError
from rig.runs.rigs import load_rig
from rig.runs.store import load_run

# Smaller seeds were used for tuning; these and larger ones serve for evaluation only.
JUDGING_SEED = 100
# Approximate time of a group on two cores [s]; `demo`: per seed. Other groups report progress.
SECONDS: Final = {
    "plant": 20.0, "analysis": 60.0, "stream": 60.0, "demo": 30.0, "growth": 120.0, "run": 20.0,
    "trace": 45.0,
}  # fmt: skip
LONG: Final = ("wires", "faults", "screen")  # measured only with --only
STOPS, QUICK_STOPS = 200, 10  # by key at the screen
QUICK_SECONDS: Final = 4.0  # of a part of the screen's figures


def plant_figures(_: Path, say: Say) -> list[Figure]:
    """Measure the plant's accuracy and speed."""
    say("plant: accuracy against scipy, speed, LSODA at equal accuracy")
    exact, fast = plant.accuracy(), plant.speed()
    return [
        Figure("plant", "relative error, angles", exact["angle_error"], "", 1e-6),
        Figure("plant", "relative error, pressures", exact["pressure_error"], "", 1e-6),
        Figure("plant", "speed on one core", fast["real_time_ratio"], "x real time", 100, True),
        Figure("plant", "LSODA at equal accuracy takes", fast["lsoda_ratio"], "x as long"),
        *plant_over_kernel(load_rig(RIG)),
    ]


def analysis_figures(folder: Path, say: Say) -> list[Figure]:
    """Measure identification and simulation on 30 records of 10 s, acquired over the wire."""
    say("analysis: 30 records of 10 s from a simulated bench")
    experiment(folder / "thirty", JUDGING_SEED - 1, Overrides(repeats=10), _quiet)
    started = time.perf_counter()
    run = load_run(folder / "thirty" / "identify")
    loading = time.perf_counter() - started
    return [*identify_figures(run, loading), *free_run_figures(load_rig(RIG))]


def trace_figures(folder: Path, say: Say) -> list[Figure]:
    """Measure the trace of twelve records of a bench with a hidden effect."""
    say("trace: 12 records of a simulated bench with a hidden effect")
    done = experiment(folder / "hidden", JUDGING_SEED - 1, Overrides(repeats=4), _quiet, HIDDEN)
    times = processor_time(lambda: trace([done.run], done.held_out))
    return [
        Figure("trace", "records", len(done.run.records)),
        Figure("trace", "of them the whole trace, processor time", times.least, "s", 8.0),
    ]


def parameter_errors(done: Experiment) -> dict[str, float]:
    """Return each parameter's relative error [%] against the bench's truth."""
    return {
        name: 100.0 * (estimate.value / done.truth[name] - 1.0)
        for name, estimate in done.identification.estimates.items()
    }


def fit_margins(done: Experiment) -> dict[str, float]:
    """Return the difference to the paper's FIT [%] for each cell of its Table IV with a number."""
    measured = {result.step: result for result in done.validation}
    return {
        f"{cell.step} {kind}": measured[cell.step].fit[ch.channel(kind, cell.joint)] - printed
        for cell in paper.TABLE_IV
        if cell.fit is not None
        for kind, printed in zip((ch.PISTON, ch.CAP, ch.ROD), cell.fit, strict=True)
    }


def demo_figures(folder: Path, say: Say, seeds: int) -> list[Figure]:
    """Identify benches of seeds not used for tuning; return the worst errors of each."""
    figures = []
    for seed in range(JUDGING_SEED, JUDGING_SEED + seeds):
        say(f"demo: seed {seed}")
        started = time.monotonic()
        done = experiment(folder / f"seed-{seed}", seed, Overrides(), _quiet)
        seconds = time.monotonic() - started
        errors, margins = parameter_errors(done), fit_margins(done)
        bulk = abs(errors.pop("b"))
        worst = max(errors, key=lambda name: abs(errors[name]))
        least = min(margins, key=lambda name: margins[name])
        group = f"seed {seed}"
        figures += [
            Figure(group, f"worst error but b ({worst})", abs(errors[worst]), "%", 2.0),
            Figure(group, "error of b", bulk, "%", 5.0),
            Figure(group, f"FIT over the paper's, least ({least})", margins[least], "%", 0.0, True),
            Figure(group, "the whole loop", seconds, "s", 120.0),
        ]
    return figures


def screen_figures(say: Say, seconds: float, *, quick: bool) -> list[Figure]:
    """Measure the screen, `seconds` per part; `quick` measures fewer parts and repetitions."""
    # A socket's address holds about 100 bytes: the folder's name must be short.
    with tempfile.TemporaryDirectory(prefix="b", dir="/tmp") as folder:
        runtime = Path(folder)
        spent = min(seconds, QUICK_SECONDS) if quick else seconds
        return [
            *cost_figures(runtime, say, spent),
            *stop_figures(runtime, say, QUICK_STOPS if quick else STOPS),
            *arrival_figures(runtime, say, spent),
        ]


def _quiet(_: str) -> None:
    pass


def measure(
    minutes: float, seeds: int, only: str | None, say: Say, *, quick: bool = False
) -> list[Figure]:
    """Measure all groups, or the group `only`; raises InputError for an unknown name.

    `quick` measures fewer stops by key.
    """
    streamed = min(60.0 * minutes, 60.0)  # [s] in real time, within the group `run`
    groups: Mapping[str, Callable[[Path, Say], list[Figure]]] = {
        "plant": plant_figures,
        "analysis": analysis_figures,
        "trace": trace_figures,
        "stream": stream_figures,
        "demo": lambda folder, progress: demo_figures(folder, progress, seeds),
        "growth": lambda _, progress: growth_figures(progress),
        "run": lambda folder, progress: run_figures(folder, progress, streamed),
        "acquisition": lambda _, progress: acquisition_figures(progress, minutes),
        "wires": lambda _, progress: wire_figures(progress, minutes),
        "faults": fault_figures,
        "screen": lambda _, progress: screen_figures(
            progress, min(60.0 * minutes, 30.0), quick=quick
        ),
    }
    if only is not None and only not in groups:
        raise InputError(f"--only {only}: expected one of: {' '.join(groups)}")
    with tempfile.TemporaryDirectory(prefix="bramah-bench-") as folder:
        chosen = [only] if only else [name for name in groups if name not in LONG]
        expected = {
            "acquisition": 60.0 * minutes,
            "demo": SECONDS["demo"] * seeds,
            "run": SECONDS["run"] + streamed,
        }
        seconds = {name: expected.get(name, SECONDS.get(name, 0.0)) for name in chosen}
        figures: list[Figure] = []
        for number, name in enumerate(chosen):
            remaining = sum(seconds[later] for later in chosen[number:])
            remaining_text = f", about {clock_text(remaining)} left" if remaining else ""
            say(f"{name}: group {number + 1} of {len(chosen)}{remaining_text}")
            group_folder = Path(folder) / name  # two groups may use the same names of runs
            group_folder.mkdir()
            figures += groups[name](group_folder, say)
        return figures


def as_json(figures: Sequence[Figure]) -> list[dict[str, Any]]:
    """Return the figures as plain data."""
    return [{**asdict(figure), "ok": figure.ok} for figure in figures]


_PAGE = """# Figures

Written by `bramah bench --docs docs/figures.md` on {cores} cores; `bramah bench` measures yours.
The limits are the project's own targets; seeds from {first} on serve for evaluation only, never for
tuning.

```text
{table}
```

- **plant**: error of the simulated bench's fixed step against scipy (DOP853, rtol 1e-10) over 1 s
  of a multisine of 1.6 V, 0.5 to 9.5 Hz, on both joints; speed in processor time with converters
  and noise, in blocks as served and in one call of the same compiled loop; the time of scipy's
  LSODA for the same input at equal accuracy.
- **analysis**: 30 records of 10 s taken over the wire, loaded and identified; a free run of
  10 s of both joints, compared with the same equations and steps written by hand, with scipy's
  odeint over the same compiled equations, and with CVODES over C code from CasADi (with the extra
  `bench`). The solvers run at the loosest tolerance, in steps of a quarter of a decade, at which no
  state is less accurate; all give the same output. The solve computes values and covariance of all
  records from their triangles, lstsq the values from all rows.
- **trace**: twelve records of 10 s of a bench with an effect that the analysis is not told, with
  detection limits and free runs; least of five.
- **growth**: times against the number of records, their length, joints and effects; least of five.
- **run**: lock-and-excite over the wire, compared with bare pymodbus sending the same requests to
  the same device: processor time of this process and wall time of a block, in virtual and real
  time; wall time of writing a block of 100 ms to the journal, 1000 times.
- **seed N**: a simulated bench started, run, identified and validated as in `bramah demo`; FIT
  is compared with every cell of the paper's Table IV.
- **acquisition**: every channel at 1 kHz in real time over the wire. Lateness is the arrival of a
  block by the host's clock minus the time of its last sample by the device's clock.

Times are processor time, least and median of five, unless stated otherwise.
`bramah bench --only wires --minutes 10` (each wire: losses, processor time, lateness, the bare
library), `--only faults` ([faults](faults.md)) and `--only screen` (the operator's screen:
processor load, delay of a stop, age of its values: [screen](screen.md#figures)) are run separately.
"""


def page(figures: Sequence[Figure]) -> str:
    """Return the figures as a Markdown page."""
    return _PAGE.format(cores=os.cpu_count(), first=JUDGING_SEED, table=text(figures))


def text(figures: Sequence[Figure]) -> str:
    """Return the figures as a table with their limits."""
    rows = []
    for figure in figures:
        limit = ""
        if figure.limit is not None and math.isfinite(figure.limit):
            limit = f"{'>=' if figure.above else '<='} {figure.limit:g}"
        verdict = "" if figure.limit is None else ("ok" if figure.ok else "MISSED")
        name = f"{figure.group}: {figure.name}"
        rows.append([name, f"{figure.value:.4g}", figure.unit, limit, verdict])
    load = ", ".join(f"{part:.1f}" for part in os.getloadavg())
    head = f"load of the machine over 1, 5 and 15 minutes: {load}; {os.cpu_count()} cores"
    return f"{head}\n\n{table(['figure', 'measured', 'unit', 'wanted', ''], rows)}"
