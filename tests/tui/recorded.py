"""A run as a screen receives it: snapshots of a two-joint arm, made from closed formulas.

Joint 1 rests at its retracted end, joint 2 is excited at 1 Hz; nothing here is physics, only
numbers of the size that the seed bench shows.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from rig.bench.screens.snapshot import PastMinute, PlanLine
from rig.bench.screens.sockets import ChannelView, Snapshot
from rig.model.alarms.states import Alarm, AlarmState

RATE = 1000.0  # samples a second
LIMITS = {
    "piston_1": (-0.039, 0.039),
    "piston_2": (-0.036, 0.036),
    "cap_pressure": (-0.2e6, 9e6),
    "rod_pressure": (-0.2e6, 9e6),
    "command": (-4.0, 4.0),
}
UNITS = {"cap": "Pa", "rod": "Pa", "piston": "m", "spool": "V", "command": "V", "supply": "Pa"}


@dataclass(frozen=True)
class Bench:
    """What the recorded bench does."""

    joints: int = 2
    run: str = "runs/2024-05-17-lock-and-excite"
    rig: str = "shinshu-2dof"
    pid: int = 4711
    total: float = 40.0  # device seconds of the whole protocol
    spike: float | None = None  # cap pressure of joint 2 passes its limit at this time [s]


def samples(bench: Bench, time: np.ndarray) -> dict[str, np.ndarray]:
    """Return every channel at these device times [s], in SI."""
    found: dict[str, np.ndarray] = {}
    noise = np.random.default_rng(7).normal(size=len(time))
    for joint in range(1, bench.joints + 1):
        moving = 0.0 if joint == 1 else 1.0
        phase = 2 * np.pi * time + joint
        found[f"spool_{joint}"] = moving * 0.1 * np.sin(phase) + 2e-4 * noise
        found[f"piston_{joint}"] = np.where(
            moving, -0.022 * np.cos(phase) + 1e-5 * noise, -0.0374 + 1e-5 * noise
        )
        swing = moving * 1.1e6 * (np.sin(phase) + 0.3 * np.sin(3 * phase)) + 5e3 * noise
        found[f"cap_pressure_{joint}"] = 2.4e6 + 0.4e6 * joint + swing
        found[f"rod_pressure_{joint}"] = 3.9e6 - 0.3e6 * joint - 0.8 * swing
    if bench.spike is not None:
        found["cap_pressure_2"] = np.where(
            np.abs(time - bench.spike) < 0.003, 9.31e6, found["cap_pressure_2"]
        )
    found["supply_pressure"] = 6.9e6 - 0.2e6 * np.abs(np.sin(2 * np.pi * time)) + 5e3 * noise
    found["oil_temperature"] = 40.0 + 0.02 * time
    for joint in range(1, bench.joints + 1):
        found[f"command_{joint}"] = 10 * found[f"spool_{joint}"]
    return found


def _limits(name: str) -> tuple[float | None, float | None]:
    return LIMITS.get(name) or LIMITS.get(name.rsplit("_", 1)[0], (None, None))


def _unit(name: str) -> str:
    return "degC" if name == "oil_temperature" else UNITS[name.split("_", maxsplit=1)[0]]


def snapshot(bench: Bench, k: int, step: float = 0.05) -> Snapshot:
    """Return snapshot k (from 1): the samples of `step` device seconds up to k * step."""
    first, last = round((k - 1) * step * RATE), round(k * step * RATE)
    time = np.arange(first, last) / RATE
    cuts = np.linspace(0, len(time), min(len(time), 25) + 1).astype(int)[:-1]
    channels = {
        name: ChannelView(
            _unit(name),
            *_limits(name),
            float(values[-1]),
            np.minimum.reduceat(values, cuts).tolist(),
            np.maximum.reduceat(values, cuts).tolist(),
        )
        for name, values in samples(bench, time).items()
    }
    now = last / RATE
    repeat = min(int(now // 10) + 1, 4)
    settling = now % 10 < 2
    return Snapshot(
        run=bench.run,
        rig=bench.rig,
        pid=bench.pid,
        state="running",
        step="step1",
        phase="settle" if settling else "excite",
        repeat=repeat,
        repeats=4,
        done_s=now,
        total_s=bench.total,
        tick=last,
        device_time=now,
        wall_time=1.7e9 + now,
        block_age=0.012,
        lost_samples=0,
        trip=None,
        message="joint 1 locked at its retracted end" if now > 1 else "filling the lines",
        channels=channels,
    )


def run(bench: Bench, seconds: float, step: float = 0.05) -> Iterator[Snapshot]:
    """Return the snapshots of the first `seconds` of a run."""
    return (snapshot(bench, k, step) for k in range(1, round(seconds / step) + 1))


PLAN = (
    PlanLine("lock", "joint 1 to its retracted end", 4.0),
    PlanLine("step1", "joint 2 excited, joint 1 locked, 4 records of 6 s", 30.0),
    PlanLine("step2", "joint 1 excited, joint 2 locked, 1 record", 6.0),
)


def followed(view: Snapshot) -> Snapshot:
    """Return a snapshot as a run of today says it: roles, engine, plan, warnings, a warning."""
    channels = {
        name: replace(channel, warn_low=0.1e6, warn_high=8.1e6) if "_pressure_" in name
        else replace(channel, warn_low=5.6e6, warn_high=8e6) if name == "supply_pressure"
        else replace(channel, warn_low=20.0, warn_high=60.0) if name == "oil_temperature"
        else channel
        for name, channel in view.channels.items()
    }  # fmt: skip
    roles = ["locked" if joint == 1 else "excited" for joint in range(1, len(_joints(view)) + 1)]
    return replace(
        view, channels=channels, roles=roles, engine="exciting", part=2, parts=len(PLAN),
        wire="modbus-tcp://127.0.0.1:5020", sample_rate=RATE,
        alarms=(warning(),) if view.device_time > 6 else (),
        **tracked(view.device_time),
    )  # fmt: skip


def tracked(time: float, *, bad: bool = False) -> dict[str, dict[str, list[float | None]]]:
    """Return what `--track` says after so many seconds, new every half second.

    Joint 1 is not excited yet. In a bad experiment no interval shrinks and the residual grows.
    """
    count = int(2 * time)
    if count < 2:
        return {}
    spread = 1.0 if bad else count**-0.5
    swing = 0.3 * spread * np.sin(1.7 * count)
    estimates: dict[str, list[float | None]] = {"C_pp_1": [None, None, None]}
    for name, value, share in (("b", 2.33e8, 0.12), ("C_pp_2", 6.28e-7, 0.05)):
        at, half = value * (1.0 + share * swing), value * share * spread
        estimates[name] = [at, at - half, at + half]
    left = 0.02 + 0.004 * count if bad else 0.004 * (1.0 + 2.0 / count)
    return {"estimates": estimates, "residuals": {"fluid": [left * 3e-5, 3e-5]}}


def _joints(view: Snapshot) -> list[str]:
    return [name for name in view.channels if name.startswith("piston")]


def warning() -> Alarm:
    """Return a warning of the supply that began after 6 s."""
    return Alarm(
        "supply pressure", "supply_pressure", None, 5.5e6, (5.6e6, 8e6), "Pa", 6000, 6.0,
        "The supply pressure is outside its band. supply_pressure: 5.5 MPa at 6.0000 s, "
        "expected 5.6 to 8 MPa",
        "Check pump and relief valve.",
    )  # fmt: skip


def trip_alarms(time: float) -> tuple[Alarm, ...]:
    """Return the alarms of a trip: its cause, latched, and one that follows from it."""
    cause = Alarm(
        "pressure", "cap_pressure_2", 2, 9.31e6, (-0.2e6, 9e6), "Pa", round(time * RATE), time,
        "A chamber pressure is outside its limits. cap_pressure_2 of joint 2 (arm): 9.31 MPa",
        "Check what the load pushes against, then the relief valve.",
        trips=True, state=AlarmState.LATCHED,
    )  # fmt: skip
    follows = Alarm(
        "spool does not follow", "spool_2", 2, 0.4, (-0.1, 0.1), "V", round(time * RATE) + 2,
        time + 0.002, "The spool of joint 2 does not follow its command.",
        "Check the valve's connector.", cause=cause.key,
    )  # fmt: skip
    return (cause, follows)


def past(bench: Bench, seconds: float, step: float = 0.05) -> PastMinute:
    """Return what a run of so many seconds kept of itself: one bucket per snapshot."""
    names = tuple(samples(bench, np.zeros(1)))
    table = []
    for k in range(1, round(seconds / step) + 1):
        time = np.arange(round((k - 1) * step * RATE), round(k * step * RATE)) / RATE
        values = samples(bench, time)
        table.append([k * step, *(values[n].min() for n in names),
                      *(values[n].max() for n in names)])  # fmt: skip
    raw = np.array(table)
    cut = 1 + len(names)
    return PastMinute(names, raw[:, 0], raw[:, 1:cut], raw[:, cut:], PLAN)


def tripped(last: Snapshot) -> Snapshot:
    """Return what a run says last when joint 2 passed its pressure limit."""
    trip = (
        "safety trip: limit 'pressure', cap_pressure_2 of joint 2 (arm): 9.31 MPa at "
        f"{last.device_time - 0.003:.4f} s, allowed -0.2 to 9 MPa"
    )
    alarms = (*last.alarms, *trip_alarms(last.device_time - 0.003))
    return replace(
        last, state="tripped", trip=trip, message="outputs zeroed", alarms=alarms, engine="tripped"
    )


def stopped(last: Snapshot) -> Snapshot:
    """Return what a run says last when the operator stopped it."""
    still = {
        name: replace(view, last=0.0, minimum=[], maximum=[])
        if name.startswith("command")
        else view
        for name, view in last.channels.items()
    }
    return replace(
        last, state="aborted", message="stopped by operator: outputs zeroed", channels=still
    )


def of_this_process(bench: Bench) -> Bench:
    """Return the bench as this process would publish it."""
    return replace(bench, pid=os.getpid())
