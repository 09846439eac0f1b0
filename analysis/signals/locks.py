"""Classifies joints as moving or locked, once for all repeats of a step.

A locked joint may still move a little. Measured on a finer plant, leaving out the motion of
a joint held by a closed valve made M2 47 % and Fv2 190 % too large, and that of an end-stop contact
R12 1.5 %; with it the error is below 0.05 %. A locked joint counts as moving where its acceleration
within one of `moving_bands` exceeds that of sensor noise alone, as stated or, if that is less, as
the repeats measure it; any other is held at its mean, because noise in the place of an absent
motion would make unidentifiable parameters look identified.

A joint whose motion is visible only within a narrow band is filtered to that band, since its signal
outside is noise. On a crane whose valves held the other joints, with a resonance at a
few hertz and noise of the acceleration ten times the motion, a wide band alone left them out: R12
was 7 % and R22 12 % off, and the torque error 2.9 times its noise.

Decided record by record, a motion near the noise enters the rows of some repeats and not those of
others; on the simulated bench that alone doubled the scatter of M1 and put 0.02 % on R12. The
repeats of a step are synchronised, so their mean shows the motion with less noise.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from analysis.signals.filters import FirSmoother, row_filter
from analysis.signals.settings import SIGNALS
from rig.model import channels as ch
from rig.model.records import Record, bridged
from rig.model.rig import Rig

Array = NDArray[np.float64]


def bands_by_step(rig: Rig, records: Sequence[Record]) -> dict[str, Array]:
    """Return, by step, the band (N,) [Hz] in which each joint moves in the records of one run."""
    steps: dict[str, list[Record]] = {}
    for record in records:
        steps.setdefault(record.step, []).append(record)
    return {step: motion_bands(rig, repeats) for step, repeats in steps.items()}


def motion_bands(rig: Rig, repeats: Sequence[Record]) -> Array:
    """Return the band (N,) [Hz] in which each joint moves in the repeats of one step.

    Infinite for a joint that is excited or yields in the widest band, or without a position channel
    in any repeat; 0 for one that is held.
    """
    rate, noise = repeats[0].sample_rate, rig.sensors.of(rig.position_kind).noise
    bands = []
    for i in range(1, len(rig.joints) + 1):
        name = ch.channel(rig.position_kind, i)
        locked = [r for r in repeats if i in r.locked and name in r.channels]
        if len(locked) < len(repeats):
            bands.append(np.inf)
            continue
        # A repeat that was cut short is left out: it may end before the motion begins.
        longest = max(r.samples for r in locked)
        long = [r for r in locked if r.samples >= SIGNALS.deciding_share * longest]
        length = min(SIGNALS.deciding_samples, *(r.samples for r in long))
        positions = np.array([bridged(np.asarray(r.channels[name])[:length]) for r in long])
        bands.append(_band(positions, rate, noise))
    return np.array(bands)


def _band(positions: Array, rate: float, noise: float) -> float:
    """Return the band [Hz] in which a locked joint moves, of its positions (repeats, n) [m]."""
    count = len(positions)
    # In the mean, the motions of repeats that are not synchronised would cancel.
    if any(accelerates(x, rate, noise) for x in positions):
        return np.inf
    for k, band in enumerate(SIGNALS.moving_bands):
        filtering = row_filter(rate, band)
        if positions.shape[1] <= 4 * filtering.reach:
            break
        inner = _accelerations(positions.T, filtering).T
        mean = inner.mean(axis=0)
        stated = noise * float(np.linalg.norm(filtering.taps[2]))
        limits = [(SIGNALS.common_ratio if k else SIGNALS.moving_ratio) * stated]
        if count > 1:
            measured = float(np.sqrt(np.sum((inner - mean) ** 2) / (count - 1) / len(mean)))
            limits.append(SIGNALS.common_ratio * measured)
        if np.std(mean) > min(limits) / np.sqrt(count):
            return band if k else np.inf
    return 0.0


def accelerates(position: Array, rate: float, noise: float) -> bool:
    """Return whether a locked position (n,) accelerates visibly above its sensor's noise [m]."""
    band = row_filter(rate, SIGNALS.moving_bands[0])
    if len(position) <= 4 * band.reach:
        return False
    floor = noise * float(np.linalg.norm(band.taps[2]))
    return bool(np.std(_accelerations(position, band)) > SIGNALS.moving_ratio * floor)


def _accelerations(positions: Array, band: FirSmoother) -> Array:
    """Return the accelerations of positions (n, ...) within a band, without both ends."""
    return band.apply(bridged(positions), 2)[band.reach : -band.reach]


def band_reach(rate: float, bands: Array) -> int:
    """Return how many samples on either side the filters of `within_band` depend on."""
    narrow = bands[(bands > 0) & np.isfinite(bands)]
    return max((row_filter(rate, band).reach for band in narrow), default=0)


def within_band(position: Array, rate: float, band: float) -> Array:
    """Return a position (n,) filtered to the band [Hz] in which its joint moves."""
    if band <= 0.0 or not np.isfinite(band):
        return position
    return row_filter(rate, band).apply(position)


def held_positions(rig: Rig, parts: Iterable[Record]) -> Array:
    """Return each joint's mean position (N,) [m; electric: rad or m] over a record's `parts`."""
    names = [ch.channel(rig.position_kind, i + 1) for i in range(len(rig.joints))]
    total, count = np.zeros(len(names)), np.zeros(len(names))
    for part in parts:
        positions = np.array([part.channels[name] for name in names])
        total += np.nansum(positions, axis=1)
        count += (~np.isnan(positions)).sum(axis=1)
    return np.asarray(total / np.maximum(count, 1.0))
