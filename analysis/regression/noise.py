"""What sensor noise does to the regressor: attenuation predicted from the stated noise.

Noise in the columns biases least squares (NOTES, "Measured traps"). A record is disturbed once more
by the rig's stated noise; the difference D of its rows [X y] before and after is, to first order,
the noise that is in the rows already. With N = D'D and A = X'X,
 bias = - A^-1 (N_xx beta - n_xy),
and the diagonal of A^-1 N_xx is the share of a column's own information that is noise: a parameter
that rests on noise (the inertia of a joint that only trembles in its lock) is no parameter.
Source: Fuller, Measurement Error Models, section 2.2.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from analysis.regression.rows import Filtering, Rows, parameters_of, record_rows
from analysis.signals.conditioning import Mask, condition
from analysis.signals.locks import moving_by_step
from analysis.terms.base import FAMILIES, Used, family_of
from rig.model import channels as ch
from rig.model.records import Record, Run
from rig.model.rig import Rig

Array = NDArray[np.float64]


def noise_moments(
    rig: Rig,
    runs: Sequence[Run],
    terms: Sequence[Used],
    filtering: Callable[[Record], Filtering],
    rng: np.random.Generator,
) -> dict[str, Array]:
    """Return N (k+1, k+1) of [X y] for each family, all records together.

    One record of every step is disturbed and stands for its repeats.
    """
    total = {
        family: np.zeros((1 + len(names), 1 + len(names)))
        for family in FAMILIES
        for names in (parameters_of(rig, terms, family),)
    }
    for run in runs:
        counts: dict[str, int] = {}
        for record in run.records:
            counts[record.step] = counts.get(record.step, 0) + 1
        seen: set[str] = set()
        moving = moving_by_step(rig, run)
        for record in run.records:
            if record.step not in seen:
                seen.add(record.step)
                moments = record_moments(rig, record, terms, filtering, moving[record.step], rng)
                for family, moment in moments.items():
                    total[family] += counts[record.step] * moment
    return total


def disturbed(rig: Rig, record: Record, rng: np.random.Generator) -> Record:
    """Return the record with the rig's stated sensor noise added once more."""
    channels = dict(record.channels)
    for name in rig.channels:
        if name in channels:
            sensor = rig.sensors.of(ch.kind_of(name)[0])
            noise = sensor.noise * rng.standard_normal(record.samples)
            channels[name] = channels[name] + noise
    return replace(record, channels=channels)


def record_moments(
    rig: Rig,
    record: Record,
    terms: Sequence[Used],
    filtering: Callable[[Record], Filtering],
    moving: Mask,
    rng: np.random.Generator,
) -> dict[str, Array]:
    """Return N (k+1, k+1) of [X y] for each family of one record whose joints `moving` (N,)."""
    filters = filtering(record)
    before, after = (
        record_rows(rig, terms, condition(rig, r, filters.channels, moving), filters)
        for r in (record, disturbed(rig, record, rng))
    )
    out: dict[str, Array] = {}
    for name, rows in before.items():
        D = _difference(rows, after[name])
        family = family_of(name)
        out[family] = out.get(family, np.zeros((D.shape[1], D.shape[1]))) + D.T @ D
    return out


def _difference(one: Rows, other: Rows) -> Array:
    """Return the change of [X y] in the rows that both kept."""
    _, a, b = np.intersect1d(one.time, other.time, return_indices=True)
    return np.column_stack((other.matrix[b] - one.matrix[a], other.rhs[b] - one.rhs[a]))
