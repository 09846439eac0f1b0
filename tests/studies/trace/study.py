"""The trace's study: hidden scenarios on a plant of this process, and whether the trace finds them.

A case is a scenario (effects with sizes), a seed, and what the right answer is. Tuning seeds are
those below 100; figures that judge come from 100 on.
"""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from protocols.files.plan import Overrides
from protocols.files.schema import Protocol
from rig.model.records import Run
from tests.studies.pool import Kept, Workers, performed
from tests.studies.trace.cases import NONE, OUTSIDE, SIZE_OF, Case

TRAIN, JUDGE = "lock-and-excite-multisine", "validate"
# Of what has no name, by the variables that tell it: the mechanism whose free curve explains it.
DRAWN: Final = {
    "piston acceleration": "position_force",
    "piston velocity": "friction_curve",
    "piston pressure_difference cap_pressure rod_pressure": "leakage_along_stroke",
}
JUDGE_STEPS: Final = ("step1_1hz", "step2_3hz", "step3_1hz", "both_1hz")


@dataclass(frozen=True)
class Outcome:
    """What a trace made of a case; `loudness` is the largest repeatable residual over noise."""

    case: Case
    verdict: str
    named: tuple[tuple[str, str], ...]
    tied: tuple[tuple[str, str], ...]
    refused: tuple[tuple[str, str, str], ...]
    loudness: float
    size_error: float
    error_ratio: float
    parameter_error: float
    fit_before: float
    fit_after: float
    depends_on: tuple[str, ...]
    notes: tuple[str, ...]
    seconds: float


def perform(case: Case) -> Outcome:
    """Take a case's records on a plant of this process and trace them."""
    from analysis.trace.engine import trace

    train, held_out, truth = records_of(case)
    started = time.process_time()
    found = trace([train], held_out, look_ahead=False)
    seconds = time.process_time() - started
    named = tuple((e.name, e.where) for e in found.effects)
    after = found.model_after.parameters
    off = [abs(after[n].value / truth[n] - 1) for n in truth if n in after and truth[n]]
    return Outcome(
        case, found.verdict, named, tuple(found.tied),
        tuple(
            (e.name, e.where, "; ".join(f"{g.name}: {g.detail}" for g in e.gates if not g.ok))
            for e in found.refused
        ),
        max(f.ratio for f in found.floors), _size_error(case, found.effects),
        found.worst(found.after), float(np.max(off)) if off else math.nan,
        _mean(found.fit_before), _mean(found.fit_after),
        found.residual_variables, found.notes, seconds,
    )  # fmt: skip


def records_of(case: Case) -> tuple[Run, list[Run], Mapping[str, float]]:
    """Return a case's training records, its held-out ones, and the true parameters.

    Raises InputError or ProtocolAborted where a machine cannot run what was planned for it.
    """
    from hil_sim.scenario.file import parse_scenario
    from rig.runs.rigs import load_rig
    from tests.studies.direct_bench import simulated_run
    from tests.studies.trace import machines

    plan: str | Protocol
    judging: str | Protocol
    if case.machine:
        rig = machines.machine(case.seed)
        scenario = machines.scenario_of(rig, case.seed, case.noise)
        (plan, judging), steps = machines.protocols_of(rig), None
    else:
        rig = load_rig("shinshu-2dof")
        scenario = parse_scenario(case.scenario, case.label)
        plan, judging, steps = TRAIN, JUDGE, JUDGE_STEPS
    train, truth = simulated_run(rig, plan, case.seed, scenario)
    judge, _ = simulated_run(rig, judging, case.seed + 90_000, scenario, Overrides(steps=steps))
    held_out = [judge]
    if case.machine or case.kind != NONE:  # a clean shipped bench is judged by the sines alone
        sizes = Overrides(seed=1000 + case.seed, amplitude_scale=0.7, repeats=2)
        held_out.insert(0, simulated_run(rig, plan, case.seed + 50_000, scenario, sizes)[0])
    if case.bent:
        from tests.studies.trace.distorted import bent

        return bent(train, case), [bent(run, case) for run in held_out], truth
    return train, held_out, truth


def _mean(values: Mapping[str, float]) -> float:
    return float(np.mean(list(values.values()))) if values else math.nan


def _size_error(case: Case, effects: Sequence[Any]) -> float:
    """Return the largest relative error of size among the effects found right; NaN for none."""
    errors = []
    for (name, where), size in zip(case.truth, case.sizes, strict=False):
        for e in effects:
            if (e.name, e.where) == (name, where) and name in SIZE_OF and e.parameters:
                stem = SIZE_OF[name][0]
                values = [p.value for n, p in e.parameters.items() if n.startswith(stem)]
                wanted = size - 1.0 if name == "sensor_gain" else size
                got = values[0] - 1.0 if name == "sensor_gain" else values[0]
                errors.append(abs(abs(got) / abs(wanted) - 1.0))
    return max(errors) if errors else math.nan


def all_of(
    work: Sequence[Case], workers: Workers, say: Callable[[str], None], folder: Path | None = None
) -> Iterator[Outcome]:
    """Perform the cases on `workers`, in the order they end; one that fails is told.

    With a `folder` every outcome is kept there, and a study that was ended goes on from it.
    """

    def report(done: int, of: int, case: Case, found: Outcome | Exception) -> None:
        if isinstance(found, Exception):  # a plant that leaves its limits is no result
            say(f"{done}/{of} {case.label}, seed {case.seed}: no records ({found})")
        else:
            say(f"{done}/{of} {line_of(found)}")

    kept = Kept(folder, name_of, asdict, _outcome) if folder else None
    done = performed(work, perform, workers, report, kept)
    return (outcome for _, outcome in done)


def name_of(case: Case) -> str:
    """Return the name of the file of a case's outcome: whatever the case is made of is in it."""
    text = json.dumps(asdict(case), sort_keys=True)
    return f"{case.kind} {case.seed} {hashlib.sha256(text.encode()).hexdigest()[:8]}.json"


def _outcome(case: Case, data: Mapping[str, Any]) -> Outcome:
    pairs = {key: tuple(tuple(one) for one in data[key]) for key in ("named", "tied", "refused")}
    plain = {key: tuple(data[key]) for key in ("depends_on", "notes")}
    return Outcome(**{**data, **pairs, **plain, "case": case})


def line_of(o: Outcome) -> str:
    """Return an outcome in one line."""
    named = ", ".join(f"{n} at {w}" for n, w in o.named) or "nothing named"
    more = "; ".join(f"refused {n} at {w} ({why})" for n, w, why in o.refused)
    tied = ", ".join(f"{n} at {w}" for n, w in o.tied)
    return (
        f"[{right(o)}] {o.case.label} (seed {o.case.seed}, {o.loudness:.1f} x noise): {o.verdict}, "
        f"{named}" + (f"; tied {tied}" if tied else "") + (f"; {more}" if more else "")
        + (f"; moves with {' '.join(o.depends_on[:2])}" if o.depends_on else "")
        + "".join(f"; {note}" for note in o.notes)
        + f"; size off {100 * o.size_error:.1f} %, error {o.error_ratio:.2f} x floor, "
        f"parameters off {100 * o.parameter_error:.1f} %, {o.seconds:.0f} s"
    )  # fmt: skip


def right(o: Outcome) -> str:  # noqa: PLR0911  a table of answers
    """Judge an outcome: right, in class, quiet, wrong, missed, abstained."""
    truth, named = set(o.case.truth), set(o.named)
    if o.case.kind == NONE:
        return "right" if o.verdict == "clean" else ("false alarm" if named else "abstained")
    if o.case.kind == OUTSIDE:
        if o.verdict == "explained" and {n for n, _ in named} == {DRAWN.get(o.case.moves, "")}:
            return "right"  # its mechanism, with the curve that the data draw
        if o.verdict != "unexplained":
            drawn = o.verdict == "explained" and {n for n, _ in named} == {o.case.form}
            return "quiet" if o.verdict == "clean" else "right" if drawn else "wrong"
        wanted = o.case.moves.split()
        clue = any(d.rsplit("_", 1)[0] in wanted for d in o.depends_on[:2])
        return "right" if clue else "no clue"
    if o.verdict == "clean":
        return "quiet"
    if o.verdict in ("explained", "confounded") and named == truth:
        return "right"
    if o.verdict == "confounded" and truth <= named | set(o.tied):
        return "in class"
    if o.verdict in ("explained", "confounded"):
        return "partly" if named < truth else "wrong"
    return "partly" if named and named <= truth else "abstained"
