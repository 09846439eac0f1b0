"""Records bent by hand: faults that neither the simulator nor the catalogue has a word for.

A clean bench's records are changed as if something else had acted. A force at a piston is put into
both chambers' pressures by halves, so that the motion stays as it was and the torque row alone
lacks it; a sensor's fault is put into its channel. Training and held-out records are bent alike.
What it should move with was written down beside each before any was traced.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rig.model import channels as ch
from rig.model.records import Record, Run
from rig.model.rig import Rig
from tests.studies.trace.cases import OUTSIDE, Case

Array = NDArray[np.float64]

SMOOTH = 0.02  # [s] half-width of the window through which a force sees piston and speed
RAMP = 0.05  # share of the largest speed at which a friction's sign has turned over
SIZES = (0.7, 1.4, 2.0)  # times the sizes below, in turn


@dataclass(frozen=True)
class Motion:
    """What a force sees: piston over half the stroke, speed over the largest, time [s]; (n,)."""

    s: Array
    v: Array
    t: Array


@dataclass(frozen=True)
class Bent:
    """A fault: what it is, variables that would tell it, and what it does.

    A `force` is a share of supply pressure times cap area; a `sensor` gives a channel's new values
    from its old ones x (n,), time, and half its range.
    """

    label: str
    moves: str
    size: float
    force: Callable[[Motion], Array] | None = None
    channel: str = ""
    sensor: Callable[[Array, Array, float], Array] | None = None


def _sign(v: Array) -> Array:
    return np.asarray(np.tanh(v / RAMP))


def _play(x: Array, width: float) -> Array:
    out, held = np.empty_like(x), float(x[0])
    for k, value in enumerate(x):
        held = min(max(held, value - width), value + width)
        out[k] = held
    return out


FAULTS: Final = (
    Bent("drag by the speed squared", "velocity", 0.2, lambda m: m.v * np.abs(m.v)),
    Bent("spring that goes with the cube", "piston", 0.1, lambda m: m.s**3),
    Bent("guide that waves along the stroke", "piston", 0.01, lambda m: np.sin(25.0 * m.s)),
    Bent(
        "friction that grows along the stroke", "piston velocity", 0.015,
        lambda m: _sign(m.v) * (1.0 + 2.0 * m.s),
    ),
    Bent("pad that is met a little out", "piston", 0.1, lambda m: np.maximum(m.s - 0.15, 0.0)),
    Bent("hum that begins with the record", "time frequency", 0.005, lambda m: np.sin(46.0 * m.t)),
    Bent(
        "play in the spool's sensor", "spool acceleration velocity", 0.002, None, ch.SPOOL,
        lambda x, t, half: _play(x, half),
    ),
    Bent(
        "spool sensor that bends", "spool", 0.05, None, ch.SPOOL,
        lambda x, t, half: x + half * (x / np.max(np.abs(x))) ** 3 * np.max(np.abs(x)),
    ),
    Bent(
        "piston sensor that waves", "piston", 2e-4, None, ch.PISTON,
        lambda x, t, half: x + half * np.sin(2 * np.pi * x / 0.02),
    ),
    Bent(
        "pressure sensor that bends", "cap_pressure", 0.03, None, ch.CAP,
        lambda x, t, half: x + half * (x - np.mean(x)) ** 2 / np.mean(x),
    ),
    Bent(
        "pressure sensor that drifts in every record", "time", 1e5, None, ch.CAP,
        lambda x, t, half: x + half * (t - t[0]) / (t[-1] - t[0]),
    ),
)  # fmt: skip
BY_LABEL: Final[Mapping[str, Bent]] = {fault.label: fault for fault in FAULTS}


def cases_of(count: int, seed: int) -> list[Case]:
    """Return `count` bent benches: faults and sizes in turn, joints drawn by `seed`."""
    rng = np.random.default_rng([seed, 77])
    out = []
    for k in range(count):
        fault = FAULTS[k % len(FAULTS)]
        joint = int(rng.integers(1, 3))
        size = SIZES[k % len(SIZES)]
        label = f"{size:g} x {fault.label} at joint {joint}"
        out.append(
            Case(
                OUTSIDE, label, "effects: []", (), seed + k, (size,), fault.moves,
                bent=f"{joint} {fault.label}",
            )
        )  # fmt: skip
    return out


def bent(run: Run, case: Case) -> Run:
    """Return a run with the case's fault in every record."""
    joint, _, label = case.bent.partition(" ")
    fault, size = BY_LABEL[label], case.sizes[0]
    records = tuple(_bent(run.rig, r, fault, int(joint), size) for r in run.records)
    return replace(run, records=records)


def _bent(rig: Rig, record: Record, fault: Bent, joint: int, times: float) -> Record:
    channels = {name: np.array(x, dtype=np.float64) for name, x in record.channels.items()}
    size = times * fault.size
    if fault.sensor is not None:
        name = ch.channel(fault.channel, joint)
        channels[name] = fault.sensor(channels[name], record.time, size)
    elif fault.force is not None and joint not in record.locked:
        cylinder = rig.joints[joint - 1].cylinder
        force = size * rig.supply.pressure * cylinder.cap_area
        added = force * fault.force(_motion(rig, record, joint))
        channels[ch.channel(ch.CAP, joint)] += 0.5 * added / cylinder.cap_area
        channels[ch.channel(ch.ROD, joint)] -= 0.5 * added / cylinder.rod_area
    return replace(record, channels=channels)


def _motion(rig: Rig, record: Record, joint: int) -> Motion:
    reach = round(SMOOTH * record.sample_rate)
    window = np.hanning(2 * reach + 1)
    piston = np.asarray(record.channels[ch.channel(ch.PISTON, joint)], dtype=np.float64)
    s = np.convolve(np.pad(piston, reach, mode="edge"), window / window.sum(), "valid")
    one = rig.joints[joint - 1]
    v = np.gradient(s) * record.sample_rate
    return Motion(s / (0.5 * one.cylinder.stroke), v / one.limits.speed, record.time)
