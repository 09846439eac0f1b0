"""What the trace remembers of records: made once, and no more of it than allowed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from analysis.signals.conditioning import Array, Signals
from analysis.trace.data.cache import Cache, RowCache, SignalCache
from analysis.trace.settings import DATA
from rig.model.rig import Rig


def test_what_is_asked_for_again_is_not_made_again() -> None:
    cache, made = Cache(1e6), []
    for _ in range(3):
        cache.get("rows", lambda: made.append("rows") or {"torque_1": np.zeros(10)})
    assert made == ["rows"]


def test_the_oldest_goes_first() -> None:
    cache, made = Cache(2.5 * 80), []

    def asked(key: str) -> None:
        cache.get(key, lambda: made.append(key) or np.zeros(10))

    for key in "abacba":  # c pushes a out
        asked(key)
    assert made == ["a", "b", "c", "a"]
    assert cache.used <= cache.most


def test_flow_rows_stay_where_torque_rows_are_weighted_anew() -> None:
    """The keys are record group, family of rows, terms."""
    cache, made = RowCache(), []

    def ask(rows: Cache) -> None:
        for family in ("mechanical", "fluid"):
            rows.get(((0, "step1"), family, ()), lambda f=family: made.append(f) or np.zeros(10))

    ask(cache.rows)
    kept = cache.without_family("mechanical")
    assert kept.rows.used == cache.rows.used / 2
    ask(kept.rows)
    assert made == ["mechanical", "fluid", "mechanical"]


def ones(rig: Rig) -> Signals:
    n, N = 200, len(rig.joints)
    fields = ("u", "s", "sd", "q", "qd", "qdd", "theta", "G", "p_cap", "p_rod", "pd_cap", "pd_rod")
    arrays = {name: np.ones((n, N)) for name in (*fields, "V_cap", "V_rod")}
    bench = {name: np.ones(n) for name in ("t", "p_s", "p_tank", "temperature")}
    marks = {"excited": np.ones(N, dtype=bool), "valid": np.ones((n, N), dtype=bool)}
    marks |= {"lost": np.zeros((n, N), dtype=bool), "bands": np.full(N, np.inf)}
    return Signals(rate=1e3, **arrays, **bench, **marks)


def test_what_reads_no_changed_signal_is_not_made_again(rig: Rig) -> None:
    signals = ones(rig)
    values, made = SignalCache(), []

    def rate(seen: Signals) -> Array:
        made.append("rate")
        return np.asarray(seen.V_cap * seen.pd_cap)

    for other in (
        signals, replace(signals, u=2.0 * signals.u), replace(signals, V_cap=2.0 * signals.V_cap)
    ):  # fmt: skip
        assert np.array_equal(values.get("rate", other, rate), other.V_cap * other.pd_cap)
    assert made == ["rate", "rate"]


def test_parts_asked_for_long_ago_are_dropped(rig: Rig) -> None:
    """Each holds the signals that it was made of: a search of shapes makes ever new ones."""
    values, made, signals = SignalCache(), [], ones(rig)

    def part(key: int) -> None:
        values.get(key, signals, lambda x: made.append(key) or x.u)

    part(0)
    for key in range(1, DATA.cached_parts + 100):
        part(key)
        part(0)  # the baseline's, which every model uses
    assert made.count(0) == 1
    part(1)
    assert made.count(1) == 2
