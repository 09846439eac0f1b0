"""Identifiability of a planned experiment: the regressor of its motions on the twin.

A step's motion results in the same rows as its record (`analysis.regression.rows`), without sensor
noise: rank and condition number of all steps' rows stacked state what can be identified. The row
filter is omitted: there is no noise to remove, and it does not change the rank.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from analysis.regression.base_parameters import Determinacy, determined
from analysis.regression.rows import Filtering, parameters_of, record_rows
from analysis.regression.settings import REGRESSION
from analysis.regression.solve import square
from analysis.signals.conditioning import condition
from analysis.signals.filters import channel_filter
from analysis.terms import baseline_of
from analysis.terms.base import FAMILIES, Used, family_of
from rig.model import channels as ch
from rig.model.records import Record
from rig.model.rig import Rig

Array = NDArray[np.float64]
Triangles = Mapping[str, Array]  # family -> triangle (k, k) of its rows

_KEYS = {
    ch.SPOOL: "spool", ch.PISTON: "piston", ch.CAP: "cap_pressure", ch.ROD: "rod_pressure",
    ch.COMMAND: "command",
}  # fmt: skip


def twin_channels(rig: Rig, names: Sequence[str], moved: Mapping[str, Array]) -> dict[str, Array]:
    """Return the channels `names`, each (n,), of a motion on the twin, supply and oil steady."""
    channels: dict[str, Array] = {}
    for name in names:
        kind, joint = ch.kind_of(name)
        if joint is not None:
            channels[name] = moved[_KEYS[kind]][:, joint - 1]
        else:
            steady = rig.supply.pressure if kind == ch.SUPPLY else rig.oil.temperature
            channels[name] = np.full(len(moved["piston"]), steady)
    return channels


def predicted_rows(rig: Rig, moved: Mapping[str, Array], locked: Sequence[int]) -> dict[str, Array]:
    """Return the triangle (k, k) of each family's rows of a motion on the twin.

    `moved` is what `analysis.simulation.twin.simulate_commands` returns or a stretch of it, arrays
    (n, N); `locked` the joints (1-based) that were held.
    """
    used = tuple(Used(term) for term in baseline_of(rig))
    ideal = rig.model_copy(update={"sensors": rig.sensors.model_copy(update={"skew": 0.0})})
    channels = twin_channels(rig, rig.channels, moved)
    record = Record("twin", "twin", tuple(locked), 1, rig.sample_rate, channels)
    filters = Filtering(channel_filter(rig.sample_rate), None, REGRESSION.sample_step)
    bands = np.array([0.0 if i + 1 in locked else np.inf for i in range(len(rig.joints))])
    rows = record_rows(ideal, used, condition(ideal, record, filters.channels, bands), filters)
    stacked: dict[str, list[Array]] = {}
    for name, part in rows.items():
        stacked.setdefault(family_of(name), []).append(part.matrix)
    return {family: square(np.vstack(parts)) for family, parts in stacked.items()}


def judge(rig: Rig, steps: Sequence[Triangles]) -> dict[str, Determinacy]:
    """Return, by family, what the rows of these steps determine together."""
    used = tuple(Used(term) for term in baseline_of(rig))
    out = {}
    for family in FAMILIES:
        names = parameters_of(rig, used, family)
        X = np.vstack([step[family] for step in steps]) if steps else np.zeros((1, len(names)))
        out[family] = determined(names, X)
    return out
