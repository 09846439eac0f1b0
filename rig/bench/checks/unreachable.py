"""Limits that no reading can pass: a check with such a limit protects nothing."""

from __future__ import annotations

import numpy as np

from rig.bench.checks.rates import rates
from rig.model import channels as ch
from rig.model.rig import Rig


def unreachable_limits(rig: Rig) -> list[str]:
    """Return a sentence for each limit on a piston or pressure beyond what its sensor can read.

    A rate of change is at most the sensor's range within the window of its check
    (`rates.rate_window`).
    """
    out = []
    for rate in rates(rig):
        per_second = rig.sample_rate / rate.window
        for column in np.flatnonzero(np.isfinite(rate.bounds)).tolist():
            name, bound = rig.recorded[column], rate.bounds[column]
            low, high = rig.range_of(name)
            if bound >= high - low:
                unit = f"{ch.unit_of(name)}/s"
                out.append(
                    f"{name}: no reading can pass the limit of {bound * per_second:g} {unit} on "
                    f"its {rate.limit.split()[-1]}, since it reads at most "
                    f"{(high - low) * per_second:g} {unit}: this limit protects nothing"
                )
    for name in rig.channels:
        kind, joint = ch.kind_of(name)
        if kind != ch.PISTON or joint is None:
            continue
        for limit, end in zip(rig.joints[joint - 1].limits.piston, rig.range_of(name), strict=True):
            if abs(limit) >= abs(end) and limit * end > 0.0:
                out.append(
                    f"{name}: no reading can pass the limit of {limit:g} m, since its sensor ends "
                    f"at {end:g} m: this limit protects nothing"
                )
    return out
