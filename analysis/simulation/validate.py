"""Validation: the model driven by the measured spool (electric: drive), compared with the record.

FIT = 100 (1 - |y - yhat| / |y - mean y|) per channel (Sakai and Maeshima, Table IV), from a free
run of the whole record; windowed RMSE restarts the model from the data every 0.25 s, which shows
the model's rates without the accumulated drift of a free run.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from analysis.effects.measurement import corrected_channels
from analysis.regression.rows import Array, default_filtering
from analysis.signals.conditioning import Mask, Signals, aligned_channels, condition, lost_samples
from analysis.signals.filters import Smoother
from analysis.signals.locks import bands_by_step
from analysis.simulation.model import Model, as_loaded, finite, refuse_other_rig
from analysis.simulation.settings import SIMULATION
from analysis.simulation.simulate import (
    Simulation,
    State,
    compiled,
    drive_of,
    hidden_paths,
    sensor_corrected,
    simulate,
    state_at,
)
from rig.model import channels as ch
from rig.model.parse import InputError
from rig.model.records import Record, Run, refuse_malformed
from rig.model.rig import Rig


@dataclass(frozen=True)
class RecordValidation:
    """One record: FIT [%], RMSE and windowed RMSE [SI] per channel of the excited joints.

    `simulation` is the free run and `measured` the aligned channels, for plots; `failure` and
    `outside` are the free run's; NaN stands where a window's model failed.
    """

    record: str
    step: str
    fit: Mapping[str, float]
    rmse: Mapping[str, float]
    window_rmse: Mapping[str, float]
    failure: str
    outside: int
    simulation: Simulation
    measured: Mapping[str, Array]
    time: Array
    units: Mapping[str, str] = field(default_factory=dict)


def fit_percent(measured: Array, simulated: Array) -> float:
    """Return FIT [%] of one channel (n,); NaN where the measured one stands still."""
    spread = float(np.linalg.norm(measured - measured.mean()))
    if spread == 0:
        return float("nan")
    return 100.0 * (1.0 - float(np.linalg.norm(measured - simulated)) / spread)


def validate(model: Model, runs: Sequence[Run]) -> list[RecordValidation]:
    """Simulate every record of the runs with its measured spool and compare.

    Raises InputError for a run of another rig, a record too short, or a model with parameters
    that were not identified.
    """
    refuse_malformed(runs)
    out = []
    for run in runs:
        refuse_other_rig(model, run.rig, run.source or "the run")
        bands = bands_by_step(run.rig, run.records)
        out += [
            validate_record(model, run.rig, record, bands=bands[record.step])
            for record in run.records
        ]
    if not out:
        raise InputError("no records to validate on: the run holds none")
    return out


def validate_record(
    model: Model, rig: Rig, record: Record, bands: Array | None = None
) -> RecordValidation:
    """Validate on one record (see `validate`).

    `bands` (N,) [Hz] is the decision for all repeats of its step (`analysis.signals.locks`), by
    default of this record alone.
    """
    model = as_loaded(model, record.loaded)
    smoother = default_filtering(record).channels
    present = arrived(rig, record)
    signals = sensor_corrected(rig, model.terms, condition(rig, record, smoother, bands))
    # Sensors are corrected by the model's sensor effects before anything is compared.
    channels = aligned_channels(rig, record)
    channels = corrected_channels(rig, model.terms, channels, record.sample_rate)
    measured = compared(rig, channels, signals)
    ready, drive = compiled(model), drive_of(signals)
    hidden = hidden_paths(model, signals)
    initial = first_state(rig, record, signals, channels)
    free_run = simulate(ready, drive, replace(initial, hidden=hidden[0]))
    simulated = free_run.channels()
    windows = dict.fromkeys(measured, 0.0)
    count = 0
    for start, length in _windows(record, smoother):
        if not present[start : start + length].all():
            continue
        state = replace(state_at(signals, start), hidden=hidden[start])
        window_run = simulate(ready, drive, state, start, length)
        window_channels = window_run.channels()
        for name, y in measured.items():
            error = window_channels[name] - y[start : start + length]
            windows[name] += np.nan if window_run.failure else float(error @ error)
        count += length
    return RecordValidation(
        record.name,
        record.step,
        {name: fit_percent(y[present], simulated[name][present]) for name, y in measured.items()},
        {
            name: float(np.sqrt(np.mean((y - simulated[name])[present] ** 2)))
            for name, y in measured.items()
        },
        {name: float(np.sqrt(v / count)) if count else np.nan for name, v in windows.items()},
        free_run.failure,
        free_run.outside,
        free_run,
        measured,
        record.time,
        {name: rig.unit_of(name) for name in measured},
    )


def arrived(rig: Rig, record: Record) -> Mask:
    """Return which samples (n,) arrived; raises InputError for a gap too long to bridge.

    The model is driven by the measured spool, which over a short gap is a straight line.
    """
    lost = lost_samples(rig, record).any(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate(([False], lost, [False])).astype(np.int8)))
    longest = int(np.max(edges[1::2] - edges[::2], initial=0))
    if longest > SIMULATION.longest_gap * record.sample_rate:
        raise InputError(
            f"record {record.name!r}: {longest} samples in a row were lost; leave it out: a model "
            f"cannot run for more than {1000 * SIMULATION.longest_gap:g} ms without its spool"
        )
    return np.asarray(~lost)


def compared(rig: Rig, channels: Mapping[str, Array], signals: Signals) -> dict[str, Array]:
    """Return the measured piston and pressures (electric: position) of the excited joints."""
    return {
        ch.channel(kind, i + 1): channels[ch.channel(kind, i + 1)]
        for i in signals.excited_joints
        for kind in rig.simulated_kinds
    }


def _windows(record: Record, smoother: Smoother) -> Iterator[tuple[int, int]]:
    length = round(SIMULATION.window * record.sample_rate)
    for start in range(smoother.reach, record.samples - smoother.reach - length + 1, length):
        yield start, length


def first_state(rig: Rig, record: Record, signals: Signals, channels: Mapping[str, Array]) -> State:
    """Return the state at the first sample, from a cubic fitted to the first 40 ms of `channels`.

    A zero-phase filter would need samples before the first. The velocity is the cubic's derivative.
    """
    count = min(
        record.samples,
        max(SIMULATION.start_degree + 2, round(SIMULATION.start_samples * record.sample_rate)),
    )
    t = np.arange(count) / record.sample_rate
    state = state_at(signals, 0)
    q, qd, cap, rod = (a.copy() for a in (state.q, state.qd, state.p_cap, state.p_rod))
    for i in signals.excited_joints:

        def fitted(kind: str, joint: int = i) -> Array:
            samples = channels[ch.channel(kind, joint + 1)][:count]
            return np.asarray(np.polynomial.polynomial.polyfit(t, samples, SIMULATION.start_degree))

        s = fitted(rig.position_kind)
        q[i], G, _ = rig.joints[i].geometry(s[0])
        qd[i] = s[1] / G
        if ch.CAP in rig.simulated_kinds:
            cap[i], rod[i] = fitted(ch.CAP)[0], fitted(ch.ROD)[0]
    return replace(state, q=q, qd=qd, p_cap=cap, p_rod=rod)


def to_json(results: Sequence[RecordValidation]) -> dict[str, Any]:
    """Return the validation as JSON data; `failure` and `outside` added per record."""
    return {
        "records": [
            {
                "record": r.record,
                "step": r.step,
                "fit": {name: finite(v) for name, v in r.fit.items()},
                "rmse": {name: finite(v) for name, v in r.rmse.items()},
                "window_rmse": {name: finite(v) for name, v in r.window_rmse.items()},
                "failure": r.failure or None,
                "outside_samples": r.outside,
            }
            for r in results
        ]
    }
