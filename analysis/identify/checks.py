"""Checks of the records before an identification and of its result afterwards.

Records that make a number meaningless are refused (InputError naming record and channel);
everything else that a user should know is a `Check`, ok or not, with the figures.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.identify.settings import IDENTIFY
from analysis.regression.solve import Solution
from analysis.signals.conditioning import clipped_samples, is_used
from analysis.simulation.model import Estimate, rig_difference
from analysis.simulation.model_draws import far_from_nominal
from analysis.simulation.settings import SIMULATION
from analysis.terms.mechanics import chain_matrix, mass_matrix
from rig.model import channels as ch
from rig.model.parameters import gain_names, inertia_names
from rig.model.parse import InputError
from rig.model.records import Record, RecordHead, Run
from rig.model.rig import Rig
from rig.model.tolerances import widest
from rig.model.units import plain
from rig.runs.stream import RunHead

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Check:
    """A statement for the user: its name, whether all is well, and the figures."""

    name: str
    ok: bool
    detail: str


def common_rig(runs: Sequence[Run] | Sequence[RunHead]) -> Rig:
    """Return the rig that all runs share, with the largest tolerance of each number.

    Raises InputError where the rigs differ or the runs hold no record.
    """
    if not runs or not any(run.records for run in runs):
        raise InputError("no records to work on: the run holds none (was it aborted at once?)")
    for run in runs[1:]:
        difference = rig_difference(runs[0].rig, run.rig)
        if difference:
            raise InputError(
                f"{runs[0].source or 'the first run'} and {run.source or 'another'} are of "
                f"different rigs: {difference}; identify them apart"
            )
    if all(is_hold(run.rig, record) for run in runs for record in run.records):
        raise InputError(
            "every record has every joint locked: nothing moved, so nothing can be identified; "
            "record a step that excites a joint"
        )
    rig = runs[0].rig
    tolerances = widest(run.rig.tolerances for run in runs)
    same = tolerances == rig.tolerances
    return rig if same else rig.model_copy(update={"tolerances": tolerances})


def spans_of(record: Record) -> dict[str, tuple[float, float]]:
    """Return the smallest and largest sample of every channel; (inf, -inf) where all were lost."""
    return {
        name: (float(np.fmin.reduce(x, initial=np.inf)), float(np.fmax.reduce(x, initial=-np.inf)))
        for name, x in record.channels.items()
    }


def refuse_constant_channels(
    rig: Rig, record: Record | RecordHead, spans: Mapping[str, tuple[float, float]]
) -> None:
    """Raise InputError for an excited joint that never moved or a channel that is constant.

    `spans` are the smallest and the largest sample of the record's channels (`spans_of`).
    """
    for i in range(1, len(rig.joints) + 1):
        if i in record.locked:
            continue
        for kind in rig.joint_kinds:
            name = ch.channel(kind, i)
            if name not in spans:
                continue
            low, high = spans[name]
            if low > high:
                raise InputError(
                    f"record {record.name!r}, channel {name!r}: every sample was lost; leave the "
                    "record out"
                )
            if low == high:
                raise InputError(
                    f"record {record.name!r}, channel {name!r}: every sample is {low:g}; is the "
                    "sensor connected?"
                )
        position = ch.channel(rig.position_kind, i)
        low, high = spans.get(position, (-np.inf, np.inf))
        travel, noise = high - low, rig.sensors.of(rig.position_kind).noise
        if travel < IDENTIFY.least_travel * noise:
            unit = "m" + rig.unit_of(position)
            raise InputError(
                f"record {record.name!r}, channel {position!r}: joint {i} is not locked but moved "
                f"only {travel * 1e3:.3g} {unit} (sensor noise {noise * 1e3:.3g} {unit}); it was "
                "not excited, or belongs under 'locked'"
            )


def refuse_constant_records(rig: Rig, runs: Iterable[Run]) -> None:
    """Raise InputError for a constant channel in a record (`refuse_constant_channels`)."""
    for run in runs:
        for record in run.records:
            refuse_constant_channels(rig, record, spans_of(record))


def clipped_counts(rig: Rig, record: Record) -> dict[str, int]:
    """Count, per channel that rows need, the samples at an end of their sensor's range."""
    return {
        name: int(mask.sum())
        for name, mask in clipped_samples(rig, record).items()
        if is_used(rig, record, name)
    }


def clipping(
    rig: Rig, counted: Iterable[tuple[Record | RecordHead, Mapping[str, int]]]
) -> list[Check]:
    """State every sensor that reached an end of its range, with the worst record of each step.

    `counted` holds the result of `clipped_counts` for every record.
    """
    worst: dict[tuple[str, str], tuple[int, float, str]] = {}
    for head, counts in counted:
        for name, count in counts.items():
            share = (count, count / head.samples, head.name)
            worst[head.step, name] = max(share, worst.get((head.step, name), share))
    out = []
    for (_, name), (count, part, record_name) in worst.items():
        low, high = rig.sensors.of(ch.kind_of(name)[0]).range
        out.append(
            Check(
                "clipped sensor",
                part < IDENTIFY.clipped_share,
                f"record {record_name!r}, channel {name!r}: {count} samples "
                f"({plain(100 * part, 2)} %) at the end of {low:g}..{high:g} {rig.unit_of(name)}; "
                "masked (the worst record of its step)",
            )
        )
    return out or [Check("clipped sensor", True, "no sensor reached the end of its range")]


def lost_samples(counted: Iterable[tuple[Record | RecordHead, int]]) -> Check:
    """State how many samples never arrived; `counted` holds (record, number of lost samples)."""
    pairs = [(lost, head) for head, lost in counted]
    total = sum(lost for lost, _ in pairs)
    if not total:
        return Check("lost samples", True, "every sample arrived")
    worst, head = max(pairs, key=lambda pair: pair[0])
    return Check(
        "lost samples",
        total < IDENTIFY.lost_share * sum(head.samples for _, head in pairs),
        f"{total} samples never arrived (most in record {head.name!r}: {worst} of "
        f"{head.samples}); the rows whose filters reach them are masked",
    )


def repeats(strata: Mapping[tuple[int, str], int]) -> Check:
    """State the repeats that the intervals are based on; `strata` maps (run, step) to repeats."""
    single = sorted({step for (_, step), count in strata.items() if count < 2})
    if single:
        return Check(
            "repeats",
            False,
            f"only one repeat of {' '.join(single)}: the scatter between repeats is unknown; the "
            "intervals come from segments within the record and may be too narrow",
        )
    return Check("repeats", True, f"{min(strata.values())} or more repeats of every step")


def is_hold(rig: Rig, head: Record | RecordHead) -> bool:
    """Return whether every joint of a record is locked, so that it has no equations of motion."""
    return set(range(1, len(rig.joints) + 1)) <= set(head.locked)


def leak_down(rig: Rig, records: Sequence[Record | RecordHead]) -> list[Check]:
    """State the fastest creep [m/s] of a piston while every valve was closed (holds)."""
    creeps = [
        (abs(float(creep)) * head.sample_rate / head.samples, abs(float(creep)), i, head)
        for head in records
        if is_hold(rig, head) and head.samples
        for i in range(1, len(rig.joints) + 1)
        if isinstance(creep := head.attributes.get(f"creep_m_{i}"), int | float)
    ]
    if not creeps:
        return []
    speed, creep, joint, head = max(creeps, key=lambda entry: entry[0])
    seconds = head.samples / head.sample_rate
    ok = speed < IDENTIFY.most_creep
    cause = "" if ok else "; oil passes the piston, leaves the joint, or passes a valve at rest"
    return [
        Check(
            "leak-down",
            ok,
            f"record {head.name!r}: with every valve closed joint {joint} crept {1e3 * creep:.2g} "
            f"mm in {seconds:g} s, {1e3 * speed:.2g} mm/s (below {1e3 * IDENTIFY.most_creep:g} "
            f"wanted){cause}",
        )
    ]


def joints_excited(rig: Rig, records: Sequence[Record | RecordHead]) -> Check:
    """State joints that no record excites: their parameters cannot be identified."""
    idle = [
        i for i in range(1, len(rig.joints) + 1) if all(i in record.locked for record in records)
    ]
    if idle:
        return Check(
            "excited joints", False,
            f"no record excites joint {' '.join(map(str, idle))}: its gains and friction are not "
            "identifiable from these records; add a step that excites it",
        )  # fmt: skip
    return Check("excited joints", True, "every joint is excited in some record")


def supply_measured(rig: Rig) -> list[Check]:
    """State, if no sensor measures it, that the supply pressure is assumed (C_pp, C_mm need it)."""
    if rig.electric or rig.sensors.supply_pressure is not None:
        return []
    return [
        Check(
            "supply pressure", False,
            f"not measured: taken as {rig.supply.pressure / 1e6:.3g} MPa in every sample, which "
            "the intervals take as exact. Where it was 1 % lower C_pp and C_mm are at least 0.5 % "
            "too small, more with a chamber near it; a sensor (sensors.supply_pressure) shows it",
        )
    ]  # fmt: skip


def identifiability(solutions: Mapping[str, Solution]) -> list[Check]:
    """State each family's unidentified parameters, with reasons, and its condition number."""
    out = []
    for family, solution in solutions.items():
        reasons = "; ".join(f"{name}: {cause}" for name, cause in solution.unidentifiable.items())
        out.append(
            Check(f"identifiable {family}", not reasons, reasons or "every parameter is determined")
        )
        out.append(
            Check(
                f"condition {family}",
                solution.condition_number < IDENTIFY.condition_limit,
                f"{solution.condition_number:.1f} (scaled columns; below "
                f"{IDENTIFY.condition_limit:g} wanted, a richer excitation lowers it)",
            )
        )
    return out


def noise_bias(solutions: Mapping[str, Solution], unbiased: bool) -> Check:
    """State the largest relative bias predicted from the stated sensor noise in the columns.

    The prediction is for least squares; `unbiased` says that the estimator used is not affected.
    """
    biases = [
        (abs(bias / value), name)
        for solution in solutions.values()
        for name, value, bias in zip(
            solution.names, solution.value, solution.noise_bias, strict=True
        )
        if np.isfinite(value) and np.isfinite(bias) and value != 0
    ]
    if not biases:
        return Check("noise bias", False, "nothing identified to judge")
    worst, name = max(biases)
    return Check(
        "noise bias",
        bool(worst < IDENTIFY.noise_bias) or unbiased,
        f"the stated sensor noise biases {name} most, by {100 * worst:.2g} % as predicted "
        f"(below {100 * IDENTIFY.noise_bias:g} % wanted)"
        + ("; that is of least squares, and these values are not from it" if unbiased else ""),
    )


def masked(rows: int, dropped: int) -> Check:
    """State the share of rows lost to pressures outside [0, p_s] or clipped sensors."""
    share = dropped / max(rows + dropped, 1)
    return Check(
        "masked rows",
        share < IDENTIFY.masked_share,
        f"{dropped} of {rows + dropped} rows ({100 * share:.2g} %) lie outside the model's "
        "domain (chamber pressure below tank or above supply, clipped sensor, lost samples) and "
        "were left out",
    )


def consistency(rig: Rig, estimates: Mapping[str, Estimate]) -> list[Check]:
    """Check signs, inertia over the workspace, R12/W2 against l1, b's range, nominal values."""
    parts = [_signs(rig, estimates), *_inertia(rig, estimates), *_bulk_modulus(estimates)]
    return parts + _nominal(rig, estimates)


def _nominal(rig: Rig, estimates: Mapping[str, Estimate]) -> list[Check]:
    if not rig.nominal:
        return []
    deviating = far_from_nominal(rig, {name: e.value for name, e in estimates.items()})
    within = f"within a factor of {SIMULATION.far_from_nominal:g} of the rig file's"
    return [Check("nominal values", not deviating, deviating or within)]


def _signs(rig: Rig, estimates: Mapping[str, Estimate]) -> Check:
    joints = range(1, len(rig.joints) + 1)
    positive = [f"Fv{i}" for i in joints] + ["b"]
    positive += [name for i in joints for name in gain_names(i)]
    violations = [
        f"{name} = {estimates[name].value:.4g}"
        for name in positive
        if name in estimates and estimates[name].value <= 0
    ]
    judged = (
        "friction, bulk modulus and flow gains are" if "fluid" in rig.families else "friction is"
    )
    return Check("signs", not violations, "; ".join(violations) or f"{judged} positive")


def _inertia(rig: Rig, estimates: Mapping[str, Estimate]) -> list[Check]:
    N = len(rig.joints)
    names = inertia_names(N)
    values = {name: estimates[name].value for name in names if name in estimates}
    if len(values) < len(names) or not np.isfinite(list(values.values())).all():
        return [Check("inertia", False, "cannot be judged: not every inertia is identified")]
    R = chain_matrix(values, N)
    smallest, where = min(
        ((float(np.linalg.eigvalsh(mass_matrix(R, q))[0]), q) for q in workspace(rig)),
        key=lambda pair: pair[0],
    )
    turns = rig.unit_of_parameter(names[0]) != "kg"
    angles = " ".join(f"{np.degrees(v):.0f} deg" if turns else f"{v:.3g} m" for v in where)
    out = [
        Check(
            "inertia",
            smallest > 0,
            f"smallest eigenvalue of M over the workspace {smallest:.4g} "
            f"{rig.unit_of_parameter(names[0])}, at q = {angles}",
        )
    ]
    for i in range(N):
        for j in range(i + 1, N):
            W = estimates[f"W{j + 1}"].value if f"W{j + 1}" in estimates else np.nan
            if np.isfinite(W) and W != 0:
                length, ratio = rig.joints[i].link_length, R[i, j] / W
                if not length:
                    continue
                deviation = ratio / length - 1
                out.append(
                    Check(
                        "link length",
                        bool(abs(deviation) < IDENTIFY.length_tolerance),
                        f"R{i + 1}{j + 1}/W{j + 1} = {ratio:.4g} m against link {i + 1} of "
                        f"{length:g} m ({100 * deviation:+.1f} %); rigid bodies give equality",
                    )
                )
    return out


def _bulk_modulus(estimates: Mapping[str, Estimate]) -> list[Check]:
    b = estimates["b"].value if "b" in estimates else np.nan
    if not np.isfinite(b):
        return []
    low, high = IDENTIFY.bulk_modulus_range
    detail = f"b = {b / 1e6:.4g} MPa; plausible {low / 1e6:g} to {high / 1e6:g} MPa"
    return [Check("bulk modulus", low < b < high, detail)]


_GRID = 9  # points over the stroke of each joint


def workspace(rig: Rig) -> list[Array]:
    """Return joint positions (N,) [rad or m] spread over the stroke: a grid, or a fixed lattice."""
    N = len(rig.joints)
    if _GRID**N <= 4096:
        axes = np.meshgrid(*([np.linspace(0, 1, _GRID)] * N), indexing="ij")
        unit = np.column_stack([axis.ravel() for axis in axes])
    else:
        # Additive recurrence with square roots of primes fills the cube evenly.
        steps = np.sqrt([2, 3, 5, 7, 11, 13, 17, 19, 23][:N])
        unit = np.outer(np.arange(4096), steps) % 1.0
    angles = np.empty_like(unit)
    for i, joint in enumerate(rig.joints):
        low, high = joint.position_range
        angles[:, i] = joint.geometry(low + unit[:, i] * (high - low))[0]
    return list(angles)
