"""Sensors without information in a foreign record: constant, stuck, out of range, or clipped.

The range of the converter is unknown, so clipping is detected by shape: the density of samples of
a smooth signal has an inverse square root singularity at a peak, so that few samples within two
percent of the range have exactly the peak's value; of a clipped signal most do.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from rig.model import channels as ch
from rig.model.rig import Rig
from rig.runs.exchange.settings import EXCHANGE

Array = NDArray[np.float64]

_PRESSURES = (ch.CAP, ch.ROD, ch.SUPPLY)
_DRIVEN = (ch.SPOOL, ch.DRIVE)  # channels that a waveform or its limit may keep constant


def silent_sensors(rig: Rig, locked: tuple[int, ...], channels: Mapping[str, Array]) -> list[str]:
    """Return a sentence for each constant, stuck, clipped or far too small channel (n,); else [].

    Also for one beyond its sensor's range. Spool and piston of `locked` joints (1-based) may stand
    still, and so may the oil's temperature; of them only impossible values are reported.
    """
    sentences = []
    for name, values in channels.items():
        kind, joint = ch.kind_of(name)
        if name not in rig.channels:  # a command, or of a sensor that the rig does not describe
            continue
        if kind == ch.TEMPERATURE or joint in locked:
            sentences += _impossible_at_rest(rig, kind, name, values)
            continue
        low, high = float(values.min()), float(values.max())
        if low == high:
            sentences.append(_constant(rig, name, low))
            continue
        if small := _too_small(rig, kind, name, low, high):
            sentences += small
            continue
        outside = _outside_range(rig, kind, name, low, high)
        flat = [] if outside or kind in _DRIVEN else _flat(name, values, rig.unit_of(name))
        sentences += outside + flat
        if joint is not None and kind in (ch.CAP, ch.ROD) and not outside + flat:
            sentences += _stuck(rig, name, values, channels[ch.channel(ch.PISTON, joint)])
    return sentences


def _impossible_at_rest(rig: Rig, kind: str, name: str, values: Array) -> list[str]:
    """Return a sentence on impossible values of a channel (n,) of a joint at rest or the oil."""
    low, high = float(values.min()), float(values.max())
    bottom, top = rig.sensors.of(kind).range
    margin = EXCHANGE.end_share * (top - bottom)
    if low < bottom - margin or high > top + margin:  # a locked piston may rest at an end of it
        return _outside_range(rig, kind, name, low, high)
    if kind not in _PRESSURES:
        return []
    if small := _too_small(rig, kind, name, low, high):
        return small
    return [_constant(rig, name, low)] if low == high else []


def _constant(rig: Rig, name: str, value: float) -> str:
    return f"{name}: every sample is {value:g} {rig.unit_of(name)}; is the sensor connected?"


def _stuck(rig: Rig, name: str, values: Array, piston: Array) -> list[str]:
    """Return a sentence where a pressure keeps one exact value while its piston moves."""
    changes = np.flatnonzero(np.diff(values)) + 1
    starts, stops = np.r_[0, changes], np.r_[changes, len(values)]
    k = int(np.argmax(stops - starts))
    during = slice(int(starts[k]), int(stops[k]))
    if np.ptp(piston[during]) <= EXCHANGE.stuck_travel * np.ptp(piston):
        return []
    return [
        f"{name}: samples {during.start} to {during.stop - 1} are all {values[during.start]:g} "
        f"{rig.unit_of(name)} while the piston moves; did the sensor or its converter hang?"
    ]


def _too_small(rig: Rig, kind: str, name: str, low: float, high: float) -> list[str]:
    (bottom, top), unit = rig.sensors.of(kind).range, rig.unit_of(name)
    if kind in _PRESSURES:  # a pressure may be constant, but is not near zero throughout
        extent, words = max(abs(low), abs(high)), "stays below"
    elif kind in (ch.PISTON, ch.POSITION):
        extent, words = high - low, "moves by"
    else:
        return []
    share = extent / (top - bottom)
    if share >= EXCHANGE.smallest_span:
        return []
    return [
        f"{name}: {words} {extent:.3g} {unit}, {100 * share:.2g} % of the range of "
        "the rig's sensor; is the unit another?"
    ]


def _outside_range(rig: Rig, kind: str, name: str, low: float, high: float) -> list[str]:
    bottom, top = rig.sensors.of(kind).range
    margin = EXCHANGE.end_share * (top - bottom)
    if low > bottom + margin and high < top - margin:
        return []
    return [
        f"{name}: goes from {low:g} to {high:g} {rig.unit_of(name)}, to an end of the range "
        f"{bottom:g} to {top:g} of the rig's sensor; is it clipped, or is the unit another? A "
        "few samples beyond it are taken as lost"
    ]


def _flat(name: str, values: Array, unit: str) -> list[str]:
    span = float(np.ptp(values))
    resolution = float(np.diff(np.unique(values)).min())
    if resolution > span / EXCHANGE.fewest_levels:
        return []
    flat = []
    for end, distance in (("top", values.max() - values), ("bottom", values - values.min())):
        at_level = int(np.count_nonzero(distance < 0.5 * resolution))
        near = int(np.count_nonzero(distance <= EXCHANGE.near_extreme * span))
        if at_level >= EXCHANGE.fewest_equal and at_level > EXCHANGE.clipped_share * near:
            level = values.max() if end == "top" else values.min()
            flat.append(
                f"{name}: {at_level} of {len(values)} samples are exactly {level:g} {unit}, its "
                f"{end}; is the sensor or its converter clipped?"
            )
    return flat
