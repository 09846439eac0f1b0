"""Predicted error of the bulk modulus from samples that a host takes late.

A host-timed device has no sample clock: sample k is taken at k + e_k periods, e_k >= 0 random, and
put onto the even grid by `rig.model.wire.resample`. The twin's noise-free records (a cubic spline
through them, for the instants between ticks) are sampled so, resampled as the driver does it, and
identified; b moves by

    m = mean over draws of b_uneven / b_even - 1,

and scatters by s / sqrt(n) for n repeats, s the draws' standard deviation. Where h is the relative
half width of b's interval by sensor noise, the widened one is |m| + sqrt(h^2 + (2 s)^2 / n).
Assumed: e is exponential, independent from sample to sample, and stamped without error.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from analysis.design.settings import DESIGN
from analysis.design.twin_records import Array, Played, ideal
from analysis.identify.stacked_rows import build_rows
from analysis.regression.rows import parameters_of
from analysis.regression.solve import merge, triangle
from analysis.terms.base import Used, family_of
from rig.model.records import Record, Run
from rig.model.rig import Rig
from rig.model.wire.resample import Resampler

BULK = "b"


@dataclass(frozen=True)
class LatenessCost:
    """Error of b by late samples: `jitter` [s] as assumed, shift and scatter relative to b.

    `scatter` is that of one experiment; both are NaN where no draw determined b; `missing` is the
    share of samples left out because two neighbouring samples were too far apart.
    """

    jitter: float
    shift: float
    scatter: float
    missing: float

    def widened(self, half: float) -> float:
        """Return the relative half width of b's interval with this error added to `half`."""
        return abs(self.shift) + math.hypot(half, 2.0 * self.scatter)


def late_times(samples: int, jitter: float, rng: np.random.Generator) -> Array:
    """Return when a host serves ticks 0 to `samples` - 1 [periods], `jitter` [periods] its spread.

    A host that is late by more than a period serves the newest due tick, as `drivers.polled` does.
    """
    times: list[float] = []
    tick = 0
    late = rng.exponential(jitter, samples) if jitter > 0.0 else np.zeros(samples)
    while tick < samples:
        earliest = max(float(tick), times[-1]) if times else float(tick)
        times.append(earliest + late[tick])
        tick = max(tick + 1, math.floor(times[-1]))
    return np.array(times)


def taken_late(record: Record, jitter: float, rng: np.random.Generator) -> Record:
    """Return a record as sampled by a host with `jitter` [s]; missing samples are NaN."""
    from scipy.interpolate import CubicSpline  # noqa: PLC0415 - loads slowly

    names, n = list(record.channels), record.samples
    ticks = np.arange(n, dtype=float)
    times = late_times(n, jitter * record.sample_rate, rng)
    spline = CubicSpline(ticks, np.column_stack([record.channels[name] for name in names]))
    values = spline(np.minimum(times, n - 1.0))
    out, resampler = np.full((n, len(names)), np.nan), Resampler()
    unmarked = np.zeros(len(names), dtype=np.bool_)
    for time, row in zip(times, values, strict=True):
        for sample in resampler.add(float(time), row, unmarked):
            if sample.tick < n:
                out[sample.tick] = sample.values
    # The driver's stream continues before and after a record; the twin's ends here.
    out[:1], out[-1:] = values[:1], values[-1:]
    return replace(record, channels={name: out[:, k] for k, name in enumerate(names)})


def lateness_cost(
    rig: Rig, played: Sequence[Played], terms: Sequence[Used], jitter: float
) -> LatenessCost | None:
    """Return the error of b by `jitter` [s] in these steps; None if they do not determine b."""
    rng = np.random.default_rng(DESIGN.seed)
    even = _bulk(rig, played, terms, {})
    if even is None:
        return None
    shifts, missing = [], []
    for _ in range(DESIGN.late_draws):
        late = {play.step.name: taken_late(play.record, jitter, rng) for play in played}
        bulk = _bulk(rig, played, terms, late)
        if bulk is not None:
            shifts.append(bulk / even - 1.0)
        channel = rig.channels[0]
        missing += [float(np.isnan(record.channels[channel]).mean()) for record in late.values()]
    share = float(np.mean(missing))
    if not shifts:
        return LatenessCost(jitter, math.nan, math.nan, share)
    repeats = min(max(play.step.repeats, 1) for play in played)
    scatter = float(np.std(shifts, ddof=1)) / math.sqrt(repeats) if len(shifts) > 1 else 0.0
    return LatenessCost(jitter, float(np.mean(shifts)), scatter, share)


def _bulk(
    rig: Rig, played: Sequence[Played], terms: Sequence[Used], late: Mapping[str, Record]
) -> float | None:
    """Return b [Pa] by least squares over one record per step, weighted by its repeats."""
    exact = ideal(rig)
    names = parameters_of(rig, terms, "fluid")
    if BULK not in names:
        return None
    triangles = []
    for play in played:
        record = late.get(play.step.name, play.record)
        (built,) = build_rows(exact, [Run(exact, (record,), source="twin")], terms)
        fluid_rows = [r for name, r in built.rows.items() if family_of(name) == "fluid"]
        weight = math.sqrt(max(play.step.repeats, 1))
        X = np.concatenate([r.matrix for r in fluid_rows])
        triangles.append(weight * triangle(X, np.concatenate([r.rhs for r in fluid_rows])))
    R = merge(triangles)
    k = len(names)
    scale = np.sqrt((R[:k, :k] ** 2).sum(axis=0))
    filled = scale > 0.0
    if not filled[names.index(BULK)]:
        return None
    beta = np.zeros(k)
    beta[filled] = np.linalg.lstsq(R[:, :k][:, filled] / scale[filled], R[:, k])[0] / scale[filled]
    inverse = beta[names.index(BULK)]
    return float(1.0 / inverse) if inverse > 0.0 else None
