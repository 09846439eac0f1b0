"""Experiments with something hidden in them: joint 2 of a bench written independently.

Training is one excitation, several repeats that differ in noise only; held out is another
excitation at seven tenths of its size.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from rig.model.records import Record, Run
from rig.model.rig import Rig
from rig.model.tolerances import Tolerances
from tests.analysis.effects import one_joint as bench

Array = NDArray[np.float64]
RMS = 0.03
STATED = Tolerances(area=0.005, volume=0.1, pin=4e-4, mid_length=5e-4)


def experiment(
    rig: Rig, *, repeats: int = 4, seed: int = 1, rms: float = RMS, **wrong: float
) -> Run:
    """Return a run of `repeats` repeats; `wrong` as `one_joint.Wrong.of`."""
    clean = bench.channels(rig, bench.Wrong.of(**wrong), bench.excitation(rms, seed))
    records = tuple(
        replace(
            bench.record(rig, clean, f"step1_r{k}", 1000 * seed + k),
            repeat=k,
            period=len(clean["piston_2"]),
        )
        for k in range(1, repeats + 1)
    )
    return Run(rig, records, f"seed {seed}")


def pair_of_runs(rig: Rig, **wrong: float) -> tuple[Run, Run]:
    """Return training and held-out run of one bench."""
    return experiment(rig, **wrong), experiment(rig, repeats=2, seed=2, rms=0.7 * RMS, **wrong)


def with_force(run: Run, force: Callable[[Record], Array]) -> Run:
    """Return the run as if a force (n,) [N] braked piston 2, by its pressures.

    It is carried by both chambers alike, so that the motion stays as it is and the flows hardly
    change.
    """
    records = []
    for record in run.records:
        extra, channels = force(record), dict(record.channels)
        channels["cap_pressure_2"] = channels["cap_pressure_2"] + 0.5 * extra / 7.0e-4
        channels["rod_pressure_2"] = channels["rod_pressure_2"] - 0.5 * extra / 5.4e-4
        records.append(replace(record, channels=channels))
    return replace(run, records=tuple(records))


def piston_speed(record: Record) -> Array:
    """Return the smoothed speed (n,) [m/s] of piston 2."""
    window = np.hanning(41) / np.hanning(41).sum()
    s = np.convolve(np.pad(record.channels["piston_2"], 20, mode="edge"), window, "valid")
    return np.asarray(np.gradient(s) * record.sample_rate)


def understated(rig: Rig, times: float = 1.5) -> Rig:
    """Return a rig whose sensors have `times` the noise that it states."""
    quiet = {
        name: sensor.model_copy(update={"noise": sensor.noise / times})
        for name, sensor in rig.sensors if hasattr(sensor, "noise")
    }  # fmt: skip
    return rig.model_copy(update={"sensors": rig.sensors.model_copy(update=quiet)})


def with_filtered_noise(run: Run, times: float, corner: float = 60.0) -> Run:
    """Return a run with `times` the stated noise behind a pole at `corner` [Hz], periods unknown.

    It is added to pistons and chamber pressures.
    """
    rng, records = np.random.default_rng(3), []
    for record in run.records:
        channels = dict(record.channels)
        pole = np.exp(-2 * np.pi * corner / record.sample_rate)
        for name, x in channels.items():
            if name.startswith(("piston", "cap", "rod")):
                size = times * run.rig.sensors.of(name.rsplit("_", 1)[0]).noise
                white = rng.standard_normal(len(x))
                channels[name] = x + size * lfilter([np.sqrt(1 - pole**2)], [1, -pole], white)
        records.append(replace(record, channels=channels, period=0, lines=()))
    return replace(run, records=tuple(records))


def hardening(run: Run, force_per_cubed: float) -> Run:
    """Return the run as if a hardening spring F = k s^3 pulled at the piston.

    No entry of the catalogue describes it.
    """
    return with_force(run, lambda record: force_per_cubed * record.channels["piston_2"] ** 3)


def pushed(run: Run, force: float, blocks: tuple[int, ...], keep: float = 0.3) -> Run:
    """Return the run as if something pushed at piston 2 in the middle of some of three blocks."""

    def push(record: Record) -> Array:
        t = np.asarray(record.time)
        inside = (t % 1.0 - keep) / (1.0 - 2 * keep)
        here = (inside > 0) & (inside < 1) & np.isin(np.floor(t) % 3, blocks)
        return np.asarray(force * np.where(here, np.sin(np.pi * inside) ** 2, 0.0))

    return with_force(run, push)


def misread(run: Run, seed: int = 3, tolerances: Tolerances | None = STATED) -> Run:
    """Return the run as records of a rig file whose numbers are off by `STATED`, one sigma each."""
    rng = np.random.default_rng(seed)
    rig = run.rig.model_copy(update={"tolerances": STATED})
    rig = rig.with_deviations(rng.choice((-1.0, 1.0)) for _ in rig.uncertain_numbers)
    return replace(run, rig=rig.model_copy(update={"tolerances": tolerances}))
