"""The trace's study: hidden scenarios on a plant of this process, and whether the trace finds them.

A case is a scenario (effects with sizes), a seed, and what the right answer is. Tuning seeds are
those below 100; figures that judge come from 100 on.
"""

from __future__ import annotations

import math
import multiprocessing
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from protocols.plan import Overrides
from rig.model.parse import InputError
from rig.model.rig import Rig

JUDGING_SEED: Final = 100
NONE, SINGLE, PAIR, OUTSIDE = "none", "single", "pair", "outside"
TRAIN, JUDGE = "lock-and-excite-multisine", "validate"
JUDGE_STEPS: Final = ("step1_1hz", "step2_3hz", "step3_1hz", "both_1hz")
LOUD = 3.0  # repeatable residual over the noise from which an effect must be found

# name, where (the scenario's), key of the size, small, medium and large size, other keys
Sizes = tuple[str, str, str, tuple[str, str, str], str]
SINGLES: Final[tuple[Sizes, ...]] = (
    ("coulomb_friction", "joint {j}", "force", ("15 N", "40 N", "100 N"), ""),
    ("stribeck_friction", "joint {j}", "force", ("30 N", "60 N", "120 N"), "speed: 20 mm/s"),
    (
        "asymmetric_friction", "joint {j}", "extending", ("30 N", "60 N", "120 N"),
        "retracting: 10 N",
    ),
    (
        "pressure_dependent_friction", "joint {j}", "coefficient",
        ("5e-6 N/Pa", "1e-5 N/Pa", "3e-5 N/Pa"), "",
    ),
    ("base_inclination", "bench", "angle", ("1 deg", "2 deg", "4 deg"), ""),
    ("joint_spring", "joint {j}", "stiffness", ("20 N*m/rad", "60 N*m/rad", "150 N*m/rad"), ""),
    ("torque_offset", "joint {j}", "torque", ("2 N*m", "6 N*m", "15 N*m"), ""),
    ("valve_deadband", "joint {j}", "width", ("2 mV", "8 mV", "20 mV"), ""),
    ("spool_offset", "joint {j}", "voltage", ("1 mV", "4 mV", "10 mV"), ""),
    ("underlap_leakage", "joint {j}", "width", ("4 mV", "8 mV", "15 mV"), ""),
    ("spool_lag", "joint {j}", "time", ("1 ms", "2 ms", "5 ms"), ""),
    (
        "internal_leakage", "joint {j}", "conductance",
        ("3e-13 m^3/(s*Pa)", "1e-12 m^3/(s*Pa)", "3e-12 m^3/(s*Pa)"), "",
    ),
    (
        "external_leakage", "joint {j} cap", "conductance",
        ("3e-13 m^3/(s*Pa)", "1e-12 m^3/(s*Pa)", "3e-12 m^3/(s*Pa)"), "",
    ),
    ("supply_sag", "bench", "line_drop", ("0.2 MPa", "0.5 MPa", "1 MPa"), ""),
    ("tank_pressure", "bench", "pressure", ("0.1 MPa", "0.2 MPa", "0.4 MPa"), ""),
    ("entrained_air", "bench", "fraction", ("0.3 %", "1 %", "3 %"), ""),
    ("dead_volume", "joint {j} cap", "volume", ("20 cm^3", "50 cm^3", "100 cm^3"), ""),
    ("channel_delay", "channel cap_pressure_{j}", "time", ("1 ms", "3 ms", "6 ms"), ""),
    ("sensor_gain", "channel cap_pressure_{j}", "gain", ("1.01", "1.03", "1.08"), ""),
    (
        "sensor_offset", "channel rod_pressure_{j}", "offset",
        ("0.03 MPa", "0.1 MPa", "0.2 MPa"), "",
    ),
)  # fmt: skip
# Things the catalogue has no entry for: a spring that hardens, seals soft as a backlash.
STRANGERS: Final = (
    ("hardening spring", "piston",
     "{name: joint_spring, where: joint %d, stiffness: 30 N*m/rad, hardening: 40 rad^-2}"),
    ("backlash of soft seals", "piston velocity",
     "{name: coulomb_friction, where: joint %d, force: 120 N, presliding: 4 mm}"),
)  # fmt: skip
# Where the scenario's size stands in the trace's result: parameter and factor.
SIZE_OF: Final[Mapping[str, tuple[str, float]]] = {
    "coulomb_friction": ("Fc", 1.0), "base_inclination": ("", 1.0),
    "joint_spring": ("k_spring", 1.0), "torque_offset": ("", 1.0),
    "spool_offset": ("u_null", 1.0), "internal_leakage": ("c_internal", 1.0),
    "external_leakage": ("", 1.0), "tank_pressure": ("p_tank", 1.0),
    "valve_deadband": ("w_ahead", 1.0), "spool_lag": ("", 1.0), "sensor_gain": ("", 1.0),
    "sensor_offset": ("", 1.0), "channel_delay": ("", 1.0), "dead_volume": ("", 1.0),
    "pressure_dependent_friction": ("k_friction", 1.0),
}  # fmt: skip


@dataclass(frozen=True)
class Case:
    """One experiment: scenario text, its kind, the right names and places, the seed."""

    kind: str
    label: str
    scenario: str
    truth: tuple[tuple[str, str], ...]
    seed: int
    sizes: tuple[float, ...] = ()
    moves: str = ""


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


def place_of(where: str) -> str:
    """Return the trace's place of a scenario's place or channel (`joint 1 cap`, `bench`)."""
    if not where.startswith("channel "):
        return where
    kind, joint = where.removeprefix("channel ").rsplit("_", 1)
    side = {"cap_pressure": " cap", "rod_pressure": " rod"}.get(kind, "")
    return f"joint {joint}{side}"


def effect_text(sizes: Sizes, joint: int, level: int) -> tuple[str, tuple[str, str], float]:
    """Return the scenario's text of one effect, its name and place, and its size in SI."""

    name, where, key, levels, other = sizes
    place = where.format(j=joint)
    at = (
        f"channel: {place.removeprefix('channel ')}"
        if place.startswith("channel ")
        else (f"where: {place}")
    )
    text = f"{{name: {name}, {at}, {key}: {levels[level]}" + (f", {other}" if other else "") + "}"
    return text, (name, place_of(place)), si_size(levels[level])


def si_size(text: str) -> float:
    """Return the SI value of a size such as ``8 mV`` or ``1.03``."""
    from rig.model.quantity import unit_map

    number, _, unit = text.partition(" ")
    base = {
        "N": "N", "N/Pa": "N/Pa", "deg": "rad", "N*m/rad": "N*m/rad", "N*m": "N*m", "mV": "V",
        "ms": "s", "m^3/(s*Pa)": "m^3/(s*Pa)", "MPa": "Pa", "%": "", "cm^3": "m^3", "": "",
    }[unit]  # fmt: skip
    if unit == "%":
        return float(number) / 100
    scale = unit_map(unit, base)[0] if unit and unit != base else 1.0
    return float(number) * scale


def cases(
    kinds: Sequence[str], seed: int, count: int, only: Sequence[str] = (), level: int | None = None
) -> list[Case]:
    """Return the cases of each kind: seeds run on from `seed`; sizes and places are drawn by it."""
    out: list[Case] = []
    number = seed
    for kind in kinds:
        rng = np.random.default_rng([seed, len(kind)])
        if kind == NONE:
            out += [Case(NONE, "none", "effects: []", (), number + k) for k in range(count)]
            number += count
        elif kind == SINGLE:
            for sizes in SINGLES:
                if only and sizes[0] not in only:
                    continue
                for k in range(count):
                    size = level if level is not None else 2 - k % 3
                    out.append(_case(SINGLE, [(sizes, int(rng.integers(1, 3)), size)], number))
                    number += 1
        elif kind == PAIR:
            loud = [
                s for s in SINGLES if s[0] not in ("entrained_air", "dead_volume", "supply_sag")
            ]
            for _ in range(count):
                one, two = rng.choice(len(loud), size=2, replace=False)
                members = [(loud[int(i)], int(rng.integers(1, 3)), 2) for i in (one, two)]
                out.append(_case(PAIR, members, number))
                number += 1
        elif kind == OUTSIDE:
            for k in range(count):
                label, moves, text = STRANGERS[k % len(STRANGERS)]
                scenario = "effects: [" + text % int(rng.integers(1, 3)) + "]"
                out.append(Case(OUTSIDE, label, scenario, (), number, (), moves))
                number += 1
        else:
            raise InputError(f"kind {kind!r}: expected none, single, pair or outside")
    return out


def _case(kind: str, members: Sequence[tuple[Sizes, int, int]], seed: int) -> Case:
    built = [effect_text(*m) for m in members]
    scenario = "effects: [" + ", ".join(text for text, _, _ in built) + "]"
    label = " + ".join(
        f"{m[0][3][m[2]]} {key[0]} at {key[1]}"
        for m, (_, key, _) in zip(members, built, strict=True)
    )
    return Case(
        kind, label, scenario, tuple(k for _, k, _ in built), seed, tuple(s for *_, s in built)
    )


def perform(case: Case) -> Outcome:
    """Take a case's records on a plant of this process and trace them."""
    from analysis.trace.engine import trace
    from hil_sim.scenario import parse_scenario
    from rig.cli.direct_bench import simulated_run
    from rig.services.rigs import load_rig

    rig: Rig = load_rig("shinshu-2dof")
    scenario = parse_scenario(case.scenario, case.label)
    train, truth = simulated_run(rig, TRAIN, case.seed, scenario)
    other, _ = simulated_run(
        rig, TRAIN, case.seed + 50_000, scenario,
        Overrides(seed=1000 + case.seed, amplitude_scale=0.7, repeats=2),
    )  # fmt: skip
    judge, _ = simulated_run(rig, JUDGE, case.seed + 90_000, scenario, Overrides(steps=JUDGE_STEPS))
    started = time.process_time()
    found = trace([train], [other, judge], look_ahead=False)
    seconds = time.process_time() - started
    named = tuple((e.name, e.where) for e in found.effects)
    ratio = max(found.after[e] / found.noise_floor[e] for e in found.after)
    after = found.model_after.parameters
    off = [abs(after[n].value / truth[n] - 1) for n in truth if n in after and truth[n]]
    return Outcome(
        case, found.verdict, named,
        tuple((r.name, r.where) for e in found.effects for r in e.rivals if r.tied),
        tuple(
            (e.name, e.where, "; ".join(f"{g.name}: {g.detail}" for g in e.gates if not g.ok))
            for e in found.refused
        ),
        max(f.ratio for f in found.floors), _size_error(case, found.effects), ratio,
        float(np.max(off)) if off else math.nan, _mean(found.fit_before), _mean(found.fit_after),
        tuple(d.variable for d in found.depends_on), found.notes, seconds,
    )  # fmt: skip


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


def all_of(work: Sequence[Case], workers: int, say: Callable[[str], None]) -> Iterator[Outcome]:
    """Perform the cases on `workers` processes, in the order they end; one that fails is told."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context) as pool:
        waiting = {pool.submit(perform, case): case for case in work}
        for k, done in enumerate(as_completed(waiting), start=1):
            case = waiting[done]
            try:
                outcome = done.result()
            except Exception as error:  # a plant that leaves its limits is no result
                say(f"{k}/{len(work)} {case.label}, seed {case.seed}: no records ({error})")
                continue
            say(f"{k}/{len(work)} {line_of(outcome)}")
            yield outcome


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
        if o.verdict != "unexplained":
            return "quiet" if o.verdict == "clean" else "wrong"
        wanted = o.case.moves.split()
        clue = any(d.rsplit("_", 1)[0] in wanted for d in o.depends_on[:2])
        return "right" if clue else "no clue"
    if o.verdict == "clean":
        return "quiet"
    if o.verdict in ("explained", "confounded") and named == truth:
        return "right"
    if o.verdict == "confounded" and truth <= named | set(o.tied):
        return "in class"
    if o.verdict == "explained":
        return "wrong"
    return "partly" if named and named <= truth else "abstained"
