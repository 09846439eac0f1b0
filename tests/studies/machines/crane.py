"""A measured crane boom (University of Agder, btorjus/Bachelor): what its model lacks.

One record runs at full signal without the spool's sensor: there the command, as much later as it
is late elsewhere, stands in.
"""

from __future__ import annotations

import csv
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from analysis.effects.base import Effect, shape_values
from analysis.identify.identify import identify
from analysis.simulation.validate import validate
from analysis.terms import baseline_of, make
from analysis.terms.base import Used
from analysis.trace.data.conditioned_record import conditioned_records
from analysis.trace.data.regression_data import regression_data
from analysis.trace.engine import trace
from analysis.trace.judge import held_out
from analysis.trace.result import Trace
from analysis.trace.search.hypothesis import Hypothesis
from analysis.trace.search.hypothesis_set import HypothesisSet
from analysis.trace.search.refinement import fit_shapes, shapes_in
from rig.cli.text.output import table
from rig.cli.text.trace_text import trace_text
from rig.model.parse import InputError
from rig.model.records import Run, with_common_bandwidth
from rig.model.rig import Rig
from rig.runs.exchange.columns import read_table
from rig.runs.exchange.importer import import_records
from rig.runs.store import load_run

Array = NDArray[np.float64]
Say = Callable[[str], None]

RIG: Final = "uia-crane"
SPOOL, COMMAND = "fSpoolPosition", "fU"
LATE: Final = 0.05  # [s] the spool follows the command in the records that have both
COLUMNS: Final = """columns:
  time: {column: time}
  spool_1: {column: spool, scale: -1.0}
  piston_1: {column: fPistonPosition, offset: -0.25}
  cap_pressure_1: {column: fPa, unit: bar}
  rod_pressure_1: {column: fPb, unit: bar}
  supply_pressure: {column: fPs, unit: bar}
"""
NEEDED: Final = ("time", "fPistonPosition", "fPa", "fPb", "fPs")
RAISED: Final = 20.0  # [s] the ramps rise before it and come down after it
FLOW: Final = (("valve_deadband", "joint 1"),)
TORQUE: Final = (("coulomb_friction", "joint 1"),)


@dataclass(frozen=True)
class Crane:
    """The runs: two ramps up and down, each with the spool's sensor, and one at full signal."""

    first: Run
    second: Run
    full: Run


def load(folder: Path) -> Crane:
    """Import the three records; raises InputError naming what is missing."""
    ramps = sorted(folder.glob("*ramp*.csv"))
    full = sorted(folder.glob("*100signal*.csv"))
    if len(ramps) < 2 or not full:
        raise InputError(
            f"{folder}: found {len(ramps)} ramp(s) and {len(full)} run(s) at full signal; expected "
            "two files *ramp*.csv and one *100signal*.csv of the crane's records"
        )
    with tempfile.TemporaryDirectory() as scratch:
        named = zip(("first", "second", "full"), (*ramps[:2], full[0]), strict=True)
        runs = with_common_bandwidth([_imported(path, n, Path(scratch)) for n, path in named])
        return Crane(*runs)


def _imported(path: Path, step: str, scratch: Path) -> Run:
    with path.open(encoding="utf-8", newline="") as file:
        head = next(csv.reader(file), [])
    name = SPOOL if SPOOL in head else COMMAND
    columns = read_table(path, [*NEEDED, name], [*NEEDED, name])
    spool = np.asarray(columns.pop(name))
    if name == COMMAND:
        late = round(LATE / float(columns["time"][1] - columns["time"][0]))
        spool = np.concatenate((np.full(late, spool[0]), spool[: len(spool) - late]))
    columns["spool"] = spool
    with (scratch / f"{step}.csv").open("w", encoding="utf-8", newline="") as file:
        out = csv.writer(file)
        out.writerow(columns)
        out.writerows(zip(*columns.values(), strict=True))
    manifest = scratch / f"{step}.yaml"
    manifest.write_text(f"rig: {RIG}\nrecords:\n  - {{file: {step}.csv, step: {step}}}\n{COLUMNS}")
    return load_run(import_records(manifest, scratch / step).path)


def part(run: Run, name: str, begin: float = 0.0, end: float = np.inf) -> Run:
    """Return a run with the stretch of its only record from `begin` to before `end` [s]."""
    (record,) = run.records
    kept = (record.time >= begin) & (record.time < end)
    channels = {c: np.asarray(x)[kept] for c, x in record.channels.items()}
    return replace(run, records=(replace(record, name=name, step=name, channels=channels),))


def effects_table(
    runs: Sequence[Run], holdout_data: Sequence[Run], family: str, chain: Sequence[tuple[str, str]]
) -> str:
    """Return the held-out error of every equation as effects of a chain join one by one.

    In percent of the equation's right side; shapes and all parameters are fitted to `runs` each
    time, and the last column has the effects' own (SI).
    """
    rig = runs[0].rig
    terms = tuple(map(Used, baseline_of(rig)))
    train, judged = (conditioned_records(rig, x, families=(family,)) for x in (runs, holdout_data))
    train_data = regression_data(rig, terms, train)
    hypotheses = HypothesisSet(train_data, ())
    bench = regression_data(rig, terms, judged, train_data.beta)
    size = held_out.errors(rig, judged, hypotheses.empty.fit, hypotheses.empty.fit).size
    rows = []
    one = hypotheses.empty
    for name, where in (("", ""), *chain):
        if name:
            one = hypotheses.refined((*one.effects, _start(rig, name, where)))
        error = held_out.rms_of(bench, one.fit)
        words = f"+ {name} at {where}" if name else "baseline"
        shares = [f"{100 * error[e] / size[e]:.1f} %" for e in size]
        rows.append([words, *shares, _own(rig, one)])
    return table(["model", *size, "found"], rows)


def _start(rig: Rig, name: str, where: str) -> Used:
    term = make(name, where)
    assert isinstance(term, Effect)
    return Used(term, term.shape_of(rig, ()))


def _own(rig: Rig, one: Hypothesis) -> str:
    found: list[tuple[str, float]] = []
    for used in one.effects:
        found += [(c.parameter, one.fit.beta[c.parameter]) for c in used.term.coefficients(rig)]
        found += ((n, v) for n, v in shape_values(rig, used).items() if v)  # 0: not in the form
    return ", ".join(f"{name} {value:.3g}" for name, value in found)


def known_band(runs: Sequence[Run], holdout_data: Sequence[Run]) -> tuple[str, Trace]:
    """Return the free runs of `holdout_data` without and with a dead band whose edges `runs` give.

    And the trace of what the flows lack when the dead band is taken as known.
    """
    plain = [Used(term) for term in baseline_of(runs[0].rig)]
    found = fit_shapes(runs, [*plain, *(Used(make(name, where)) for name, where in FLOW)])
    assert found is not None
    band = found.terms
    rows = []
    for name, terms in (("baseline", plain), ("dead band known", band)):
        (run,) = validate(identify(runs, terms=terms).model, holdout_data)
        error = f"{1e3 * run.rmse['piston_1']:.1f} mm"
        shapes = shapes_in(runs[0].rig, terms).items()
        edges = ", ".join(f"{n} {shape.value:.3g}" for n, shape in shapes)
        rows.append([name, f"{run.fit['piston_1']:.1f} %", error, edges])
    told = trace(runs, holdout_data, families=("fluid",), terms=band)
    return table(["model", "piston FIT", "RMSE", "edges"], rows), told


def text(folder: Path, say: Say) -> str:
    """Return tables and traces: flows, torques while rising, flows while coming down."""
    data = load(folder)
    ramps = {"first": data.first, "second": data.second}
    parts = []
    for seen, unseen in (("second", "first"), ("first", "second")):
        say(f"fitting the {seen} ramp, judging the {unseen}")
        title = f"{seen} ramp, judged on the {unseen}"
        flow = effects_table([ramps[seen], data.full], [ramps[unseen]], "fluid", FLOW)
        rising = [part(ramps[k], "rising", end=RAISED) for k in (seen, unseen)]
        torque = effects_table(rising[:1], rising[1:], "mechanical", TORQUE)
        parts.append(f"flows: {title}; full signal beside it\n\n{flow}")
        parts.append(f"torque while rising: {title}\n\n{torque}")
    say("tracing the flows")
    everything = trace([data.second, data.full], [data.first], families=("fluid",))
    parts.append(f"trace of the flows\n\n{trace_text(everything)}")
    say("tracing the flows with the dead band taken as known")
    free, beyond = known_band([data.second, data.full], [data.first])
    seconds = data.first.records[0].time[-1]
    parts.append(f"free run of the first ramp, {seconds:.0f} s from its first state\n\n{free}")
    parts.append(f"trace of the flows, the dead band taken as known\n\n{trace_text(beyond)}")
    say("tracing the flows while coming down")
    down = [part(ramps[k], "down", begin=RAISED) for k in ("second", "first")]
    lowering = trace(down[:1], down[1:], families=("fluid",))
    parts.append(f"trace of the flows while coming down\n\n{trace_text(lowering)}")
    return "\n\n".join(parts)
