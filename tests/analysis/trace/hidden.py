"""Experiments with something hidden in them: joint 2 of a bench written independently.

Training is one excitation, several repeats that differ in noise only; held out is another
excitation at seven tenths of its size.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rig.model.records import Run
from rig.model.rig import Rig
from tests.analysis.effects import one_joint as bench

RMS = 0.03


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


def hardening(run: Run, force_per_cubed: float) -> Run:
    """Return the run as if a hardening spring pulled at the piston, by its pressures.

    The force F = k s^3 is carried by both chambers alike, so that the motion stays as it is and the
    flows hardly change: something that no entry of the catalogue describes.
    """
    records = []
    for record in run.records:
        s = np.asarray(record.channels["piston_2"])
        extra = force_per_cubed * s**3
        channels = dict(record.channels)
        channels["cap_pressure_2"] = channels["cap_pressure_2"] + 0.5 * extra / 7.0e-4
        channels["rod_pressure_2"] = channels["rod_pressure_2"] - 0.5 * extra / 5.4e-4
        records.append(replace(record, channels=channels))
    return replace(run, records=tuple(records))


def pushed(run: Run, force: float, blocks: tuple[int, ...], keep: float = 0.3) -> Run:
    """Return the run as if something pushed at piston 2 in the middle of some of three blocks."""
    records = []
    for record in run.records:
        t = np.asarray(record.time)
        inside = (t % 1.0 - keep) / (1.0 - 2 * keep)
        here = (inside > 0) & (inside < 1) & np.isin(np.floor(t) % 3, blocks)
        extra = force * np.where(here, np.sin(np.pi * inside) ** 2, 0.0)
        channels = dict(record.channels)
        channels["cap_pressure_2"] = channels["cap_pressure_2"] + 0.5 * extra / 7.0e-4
        channels["rod_pressure_2"] = channels["rod_pressure_2"] - 0.5 * extra / 5.4e-4
        records.append(replace(record, channels=channels))
    return replace(run, records=tuple(records))
