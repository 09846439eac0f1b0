"""The measured positioning system (EMPS): models, filters and hold-outs, each as a table.

Published least squares of the record: Janot, Gautier and Brunot, Data Set and Reference Models of
EMPS, 2019.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from analysis.effects.contact import TRANSITION
from analysis.identify.identify import identify
from analysis.identify.result import Identification
from analysis.regression.rows import Filtering, default_filtering
from analysis.signals.filters import butterworth, channel_filter, row_filter, row_step
from analysis.simulation.model import Model
from analysis.simulation.validate import validate
from analysis.terms import with_effects
from analysis.terms.base import Used
from analysis.trace.engine import trace
from rig.cli.text.output import table
from rig.model.records import Record, Run
from rig.runs.exchange.columns import read_table
from rig.runs.exchange.importer import import_records
from rig.runs.store import load_run

Array = NDArray[np.float64]

PUBLISHED: Final = {"M1": 95.1089, "Fv1": 203.5034, "Fc1": 20.3935, "offset1": -3.1648}
KP, KV = 160.18, 243.45  # [1/s], [V s/m] of the machine's own controller
HALF = 12.42  # [s]
PERIOD = 6240  # samples after which the reference comes back
CYCLE, LENGTH = 6.24, 24.84  # [s]
COLUMNS: Final = """columns:
  time: {column: t}
  position_1: {column: qm}
  drive_1: {column: vir}
"""
OUTPUT_ERROR: Final = "the same, output error"
MODELS: Final[dict[str, tuple[str, ...]]] = {
    "M Fv (textbook)": (),
    "with Fc": ("coulomb_friction",),
    "with offset": ("torque_offset",),
    "with Fc and offset": ("coulomb_friction", "torque_offset"),
}


@dataclass(frozen=True)
class Emps:
    """The record as runs (whole, halves, cycles) and the controller's reference (n,)."""

    whole: Run
    first: Run
    second: Run
    cycles: tuple[Run, ...]
    reference: Array


def load(file: Path, period: int = 0) -> Emps:
    """Import the MAT file as a whole, in halves and by cycle; raises InputError.

    With a `period` [samples] the trace tells noise from what comes back.
    """
    parts = {"whole": "", "first": f", end: {HALF} s", "second": f", begin: {HALF} s"}
    cycles = [f"cycle {k + 1}" for k in range(round(LENGTH / CYCLE))]
    for k, name in enumerate(cycles):
        end = min((k + 1) * CYCLE, LENGTH)
        parts[name] = f", begin: {k * CYCLE:.2f} s, end: {end:.2f} s"
    runs = {}
    with tempfile.TemporaryDirectory() as scratch:
        for name, part in parts.items():
            manifest = Path(scratch) / f"{name}.yaml"
            entry = f"file: {str(file.resolve())!r}, step: {name}{part}, period: {period}"
            manifest.write_text(f"rig: emps\nrecords:\n  - {{{entry}}}\n{COLUMNS}")
            runs[name] = load_run(import_records(manifest, Path(scratch) / name).path)
    reference = read_table(file, ["qg"], ["qg"])["qg"]
    each = tuple(runs[name] for name in cycles)
    return Emps(runs["whole"], runs["first"], runs["second"], each, reference)


def fit(
    run: Run,
    effects: tuple[str, ...] = MODELS["with Fc and offset"],
    filtering: Callable[[Record], Filtering] = default_filtering,
    estimator: str = "ls",
) -> Identification:
    """Identify the record with effects."""
    terms = [Used(term) for term in with_effects(run.rig, effects)]
    return identify([run], terms=terms, filtering=filtering, estimator=estimator)


def open_loop(model: Model, run: Run) -> float:
    """Return the RMSE [m] of the position that the measured drive gives the model."""
    (result,) = validate(model, [run])
    return result.rmse["position_1"]


def models_table(data: Emps) -> str:
    """Return what each model finds, and its open-loop errors on data of and not of the fit."""
    ways = {name: (effects, "ls") for name, effects in MODELS.items()}
    ways[OUTPUT_ERROR] = (MODELS["with Fc and offset"], "output-error")
    rows = []
    for name, (effects, estimator) in ways.items():
        found = fit(data.whole, effects, estimator=estimator)
        values = {n: e.value for n, e in found.estimates.items()}
        errors = [open_loop(found.model, data.whole), *unseen(data, effects, estimator)]
        rows.append([name, *_values(values), *(f"{1e3 * e:.2f}" for e in errors)])
    for estimator in ("ls", "output-error"):
        for name, half in (("1st half alone", data.first), ("2nd half alone", data.second)):
            values = {n: e.value for n, e in fit(half, estimator=estimator).estimates.items()}
            rows.append([f"{name}, {estimator}", *_values(values), "", "", ""])
    rows.append(["published", *_values(PUBLISHED), "", "", ""])
    head = ["model", "M [kg]", "Fv [N s/m]", "Fc [N]", "offset [N]"]
    return table([*head, "whole [mm]", "1st on 2nd [mm]", "2nd on 1st [mm]"], rows)


def unseen(data: Emps, effects: tuple[str, ...], estimator: str) -> tuple[float, float]:
    """Return the open-loop RMSE [m] of each half's model on the other half: 2nd, then 1st."""
    first = fit(data.first, effects, estimator=estimator)
    second = fit(data.second, effects, estimator=estimator)
    return open_loop(first.model, data.second), open_loop(second.model, data.first)


def cycles_table(data: Emps) -> str:
    """Return what least squares finds in each cycle of the reference alone."""
    rows = []
    for k, run in enumerate(data.cycles):
        values = {n: e.value for n, e in fit(run).estimates.items()}
        rows.append([f"{k + 1}", *_values(values)])
    return table(["cycle alone", "M [kg]", "Fv [N s/m]", "Fc [N]", "offset [N]"], rows)


def _values(values: Mapping[str, float]) -> list[str]:
    return [f"{values[n]:.4f}" if n in values else "—" for n in PUBLISHED]


def filterings(rate: float) -> dict[str, Callable[[Record], Filtering]]:
    """Return the filters to compare, by what they are."""

    def rows_at(cutoff: float) -> Callable[[Record], Filtering]:
        chosen = Filtering(channel_filter(rate), row_filter(rate, cutoff), row_step(rate, cutoff))
        return lambda _: chosen

    def every(step: int) -> Callable[[Record], Filtering]:
        return lambda _: Filtering(butterworth(rate, 100.0), None, step)

    return {
        "default": default_filtering,
        **{f"rows to {hz} Hz": rows_at(float(hz)) for hz in (8, 15, 60)},
        "Butterworth 100 Hz, every row": every(1),
        "the same, each 20th picked": every(20),
    }


def filters_table(data: Emps) -> str:
    """Return the distance from the published values and the open-loop error for each filter."""
    rows = []
    for name, filtering in filterings(data.whole.rig.sample_rate).items():
        found = fit(data.whole, filtering=filtering)
        off = [100 * (found.estimates[n].value / known - 1) for n, known in PUBLISHED.items()]
        error = open_loop(found.model, data.whole)
        rows.append(
            [
                name,
                str(found.rows["mechanical"]),
                *(f"{v:+.2f} %" for v in off),
                f"{1e3 * error:.2f}",
            ]
        )
    return table(["filter", "rows", "M", "Fv", "Fc", "offset", "open loop [mm]"], rows)


def closed_loop(values: Mapping[str, float], gain: float, data: Emps) -> tuple[Array, Array]:
    """Return position [m] and drive [V] (n,) under vir = kv (kp (qg - q) - q').

    Ten explicit steps a sample of M q'' + Fv q' + Fc tanh(q'/v) + offset = gain vir: separate from
    the package's integrator.
    """
    n, steps = len(data.reference), 10
    h = 1.0 / (data.whole.rig.sample_rate * steps)
    position, drive = np.empty(n), np.empty(n)
    measured = data.whole.records[0].channels["position_1"]
    q, qd = float(measured[0]), float(measured[10] - measured[0]) * 100.0
    mass, viscous = values["M1"], values["Fv1"]
    dry, offset = values.get("Fc1", 0.0), values.get("offset1", 0.0)
    for k in range(n):
        v = min(max(KV * (KP * (float(data.reference[k]) - q) - qd), -10.0), 10.0)
        position[k], drive[k] = q, v
        for _ in range(steps):
            force = gain * v - viscous * qd - dry * math.tanh(qd / TRANSITION) - offset
            qd += h * force / mass
            q += h * qd
    return position, drive


def closed_loop_table(data: Emps) -> str:
    """Return what position and drive do under the machine's own controller."""
    record, gain = data.whole.records[0], data.whole.rig.drive_gains[0]
    measured, drive = (np.asarray(record.channels[n]) for n in ("position_1", "drive_1"))
    rows = []
    for name, effects in MODELS.items():
        values = {n: e.value for n, e in fit(data.whole, effects).estimates.items()}
        q, v = closed_loop(values, gain, data)
        relative = np.linalg.norm(v - drive) / np.linalg.norm(drive)
        rms = 1e3 * np.sqrt(np.mean((q - measured) ** 2))
        rows.append([name, f"{rms:.3f}", f"{100 * relative:.1f} %"])
    return table(["closed loop", "position rmse [mm]", "drive error"], rows)


def trace_table(file: Path) -> str:
    """Return what the trace names, with and without the reference's period, either half unseen."""
    rows = []
    for period in (0, PERIOD):
        data = load(file, period)
        for word, seen, unseen in (
            ("1st on 2nd", data.first, data.second), ("2nd on 1st", data.second, data.first)
        ):  # fmt: skip
            found = trace([seen], [unseen], look_ahead=False)
            force = 100 * found.after["torque_1"] / found.size["torque_1"]
            named = ", ".join(
                f"{e.name} {value.value:.3g} {value.unit}"
                for e in found.effects
                for value in list(e.parameters.values())[:1]
            )
            open_loop_error = f"{1e3 * found.rmse_after['position_1']:.2f}"
            period_said = "yes" if period else "no"
            rows.append(
                [word, period_said, found.verdict, named or "nothing", f"{force:.1f} %",
                 open_loop_error]
            )  # fmt: skip
    return table(["trace", "period", "verdict", "named", "force", "open loop [mm]"], rows)


def text(file: Path) -> str:
    """Return all tables."""
    data = load(file)
    tables = (models_table, cycles_table, filters_table, closed_loop_table)
    return "\n\n".join((*(one(data) for one in tables), trace_table(file)))
