"""The rig's constants in display units, and a summary of each step of the runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.report import format as fm
from analysis.report.format import constant as _n
from analysis.report.plots.arm_plot import angle_range
from rig.model import channels as ch
from rig.model.parts import Joint
from rig.model.records import Record, Run
from rig.model.rig import ElectricRig, Rig

Array = NDArray[np.float64]

LOCKS = {
    "closed": "valve closed",
    "end_min": "held at its retracted end",
    "end_max": "held at its extended end",
}


def bench_constants(rig: Rig) -> list[tuple[str, str]]:
    """Return (quantity, value with unit) of the bench."""
    if isinstance(rig, ElectricRig):
        p, d = rig.sensors.position, rig.sensors.drive
        units = [rig.unit_of(ch.channel(kind, 1)) for kind in (ch.POSITION, ch.DRIVE)]
        return [
            ("gravity", f"{_n(rig.gravity)} m/s²"),
            ("sampled at", f"{_n(rig.sample_rate)} Hz"),
            ("sensor noise (1σ)", f"position {_n(p.noise)} {units[0]}, drive {_n(d.noise)} "
                                  f"{units[1]}"),
            ("sensor bits", f"position {p.bits}, drive {d.bits}"),
        ]  # fmt: skip
    s = rig.sensors
    out = [
        ("supply", f"{_n(rig.supply.pressure / 1e6)} MPa, {_n(rig.supply.flow * 6e4)} L/min"),
        ("oil", f"{rig.oil.name}, {_n(rig.oil.density)} kg/m³, {_n(rig.oil.temperature)} "
                f"± {_n(rig.oil.temperature_band)} °C"),
        ("gravity", f"{_n(rig.gravity)} m/s²"),
        ("sampled at", f"{_n(rig.sample_rate)} Hz"),
        ("sensor noise (1σ)", f"spool {_n(s.spool.noise * 1e3)} mV, piston "
                              f"{_n(s.piston.noise * 1e6)} µm, pressure "
                              f"{_n(s.chamber_pressure.noise / 1e3)} kPa"),
        ("sensor bits", f"spool {s.spool.bits}, piston {s.piston.bits}, pressure "
                        f"{s.chamber_pressure.bits}"),
        ("supply pressure", "measured" if s.supply_pressure else "taken as constant"),
    ]  # fmt: skip
    if s.skew:
        out.append(("multiplexer skew", f"{_n(s.skew * 1e6)} µs from channel to channel"))
    return out


def joint_constants(rig: Rig) -> list[tuple[str, list[str]]]:
    """Return (quantity and unit, one value per joint)."""

    if isinstance(rig, ElectricRig):
        joints = rig.joints
        return [
            ("name", [j.name for j in joints]),
            ("kind", [j.kind for j in joints]),
            ("drive gain", [f"{_n(j.drive.gain)} {j.force_unit}/{j.drive.unit}" for j in joints]),
            ("limits: position", [
                f"{_n(j.limits.position[0])} to {_n(j.limits.position[1])} {j.position_unit}"
                for j in joints
            ]),
            ("limits: speed, drive", [
                f"{_n(j.limits.speed)} {j.position_unit}/s, {_n(j.limits.drive)} {j.drive.unit}"
                for j in joints
            ]),
        ]  # fmt: skip

    def row(text: str, value: object) -> tuple[str, list[str]]:
        return text, [value(k, joint) for k, joint in enumerate(rig.joints)]  # type: ignore[operator]

    def degrees(k: int, _: Joint) -> str:
        low, high = sorted(np.degrees(angle_range(rig, k)))
        return f"{fm.fixed(low, 1)} to {fm.fixed(high, 1)}"

    return [
        row("name", lambda _, j: j.name),
        row("link length [mm]", lambda _, j: _n(j.link_length * 1e3)),
        row("pins from the joint, inner / outer [mm]",
            lambda _, j: f"{_n(j.linkage.base_pin * 1e3)} / {_n(j.linkage.arm_pin * 1e3)}"),
        row("cylinder length at mid-stroke [mm]", lambda _, j: _n(j.linkage.mid_length * 1e3)),
        row("stroke L [mm]", lambda _, j: _n(j.cylinder.stroke * 1e3)),
        row("joint angle over the stroke [°]", degrees),
        row("areas, cap / rod side [cm²]",
            lambda _, j: f"{_n(j.cylinder.cap_area * 1e4)} / {_n(j.cylinder.rod_area * 1e4)}"),
        row("pipe volumes, cap / rod side [cm³]",
            lambda _, j: f"{_n(j.cylinder.cap_pipe_volume * 1e6)} / "
                         f"{_n(j.cylinder.rod_pipe_volume * 1e6)}"),
        row("valve: spool per command [V/V]", lambda _, j: _n(j.valve.spool_gain)),
        row("valve: natural frequency [Hz]", lambda _, j: _n(j.valve.natural_frequency)),
        row("limits: piston [mm]", lambda _, j: " to ".join(_n(v * 1e3) for v in j.limits.piston)),
        row("limits: pressure [MPa]",
            lambda _, j: " to ".join(_n(v / 1e6) for v in j.limits.pressure)),
        row("limits: speed [m/s], command [V]",
            lambda _, j: f"{_n(j.limits.speed)}, {_n(j.limits.command)}"),
    ]  # fmt: skip


@dataclass(frozen=True)
class StepSummary:
    """All repeats of one step of one run."""

    run: int
    name: str
    locked: tuple[int, ...]
    excited: tuple[int, ...]
    records: tuple[Record, ...]


def steps(rig: Rig, runs: Sequence[Run]) -> list[StepSummary]:
    """Group records by run and step, in the order they were taken."""
    groups: dict[tuple[int, str], list[Record]] = {}
    for index, run in enumerate(runs):
        for record in run.records:
            groups.setdefault((index, record.step), []).append(record)
    joints = range(1, len(rig.joints) + 1)
    return [
        StepSummary(run, name, records[0].locked,
             tuple(i for i in joints if i not in records[0].locked), tuple(records))
        for (run, name), records in groups.items()
    ]  # fmt: skip


def step_rows(rig: Rig, runs: Sequence[Run]) -> list[dict[str, str]]:
    """Return the protocol table; a dash stands for values missing in the records."""
    return [_step_row(runs, step) for step in steps(rig, runs)]


def _step_row(runs: Sequence[Run], step: StepSummary) -> dict[str, str]:
    record = step.records[0]
    attributes = [record.attributes for record in step.records]
    travels = (_largest(attributes, f"lock_give_m_{i}") for i in step.locked)
    yielding = [travel for travel in travels if travel is not None]
    jitter = _largest(attributes, "jitter_max_s")
    period = "not periodic"
    if record.period:
        lines = [k * record.sample_rate / record.period for k in record.lines]
        period = f"{_n(record.period / record.sample_rate)} s"
        if lines:
            period += f", {fm.count(len(lines), 'line')} at {_n(min(lines))}"
            period += f" to {_n(max(lines))} Hz" if len(lines) > 1 else " Hz"
    seconds = float(np.mean([r.samples / r.sample_rate for r in step.records]))
    return {
        "run": fm.folder_name(runs[step.run].source) or f"run {step.run + 1}",
        "name": step.name,
        "locked": "; ".join(_lock(i, record) for i in step.locked) or "none",
        "excited": " and ".join(map(str, step.excited)) or "none",
        "repeats": str(len(step.records)),
        "seconds": _n(round(seconds, 3)),
        "period": period,
        "spool": _per_joint(step, ch.SPOOL, np.std),
        "travel": _per_joint(step, ch.PISTON, np.ptp),
        "yielding": fm.significant(max(yielding) * 1e6) if yielding else fm.DASH,
        "lost": _total(attributes, "lost_samples"),
        "late": _total(attributes, "late_blocks"),
        "jitter": fm.DASH if jitter is None else fm.significant(jitter * 1e3),
        "saturated": _total(attributes, "saturated_samples"),
    }


def _lock(joint: int, record: Record) -> str:
    how = record.attributes.get(f"lock_{joint}")
    return f"{joint}: {LOCKS.get(str(how), str(how))}" if how is not None else str(joint)


Attributes = Sequence[Mapping[str, str | float | int]]


def _numbers(attributes: Attributes, key: str) -> list[float]:
    """Return the attribute of every record that has it as a number."""
    return [
        float(value) for a in attributes
        if isinstance(value := a.get(key), int | float | np.number) and np.isfinite(value)
    ]  # fmt: skip


def _largest(attributes: Attributes, key: str) -> float | None:
    return max((abs(v) for v in _numbers(attributes, key)), default=None)


def _total(attributes: Attributes, key: str) -> str:
    counts = _numbers(attributes, key)
    return f"{sum(counts):.0f}" if counts else fm.DASH


def _per_joint(step: StepSummary, kind: str, figure: Callable[[Array], float]) -> str:
    """Return a figure of each excited joint's channel in thousandths, the mean over repeats."""
    out = []
    for joint in step.excited:
        name = ch.channel(kind, joint)
        values = [
            float(figure(np.asarray(r.channels[name]))) * 1e3
            for r in step.records if name in r.channels
        ]  # fmt: skip
        out.append(fm.significant(float(np.mean(values))) if values else fm.DASH)
    return " / ".join(out) or fm.DASH
