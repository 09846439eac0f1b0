"""The lines of a residual say whether its cause is linear, symmetric or not."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from analysis.trace.data.spectral_lines import (
    CONSTANT,
    EVEN,
    EXCITED,
    KINDS,
    ODD,
    meaning,
    spectral_lines,
    spectrum,
)
from analysis.trace.engine import trace
from analysis.trace.result import Trace, to_json
from rig.model.rig import Rig
from tests.analysis.trace.hidden import pair_of_runs
from tests.analysis.trace.test_next_experiment import sine

Array = NDArray[np.float64]
EXCITED_LINES = (1, 3, 7, 9, 13, 15)  # 5 and 11 are left empty
PER, K = 200, 40


def wave(phases: Array) -> Array:
    """Return one period of an odd multisine with empty lines."""
    t = np.arange(PER) / PER
    return np.sum(
        [np.cos(2 * np.pi * (k * t + p)) for k, p in zip(EXCITED_LINES, phases, strict=True)],
        axis=0,
    )


def powers(y: Array, missing: int = 0) -> dict[str, float]:
    """Return the share of each kind of line, from pairs, the last `missing` of a half absent."""
    half = PER // 2
    kept = np.arange(half - missing)
    series = np.stack((y[kept], y[kept + half]), axis=-1)[None]
    power = np.abs(spectrum(kept / PER, series, K)[0]) ** 2
    number = np.arange(K + 1)
    excited = np.isin(number, EXCITED_LINES)
    parts = (number == 0, excited, (number % 2 == 1) & ~excited, (number % 2 == 0) & (number > 0))
    return {kind: float(power[own].sum()) for kind, own in zip(KINDS, parts, strict=True)}


def test_the_lines_are_those_of_the_fourier_series_where_nothing_is_missing() -> None:
    y = np.random.default_rng(3).standard_normal(PER)
    full = np.fft.rfft(y) / PER
    y = np.fft.irfft(np.where(np.arange(PER // 2 + 1) <= K, full, 0) * PER, PER)
    series = np.stack((y[: PER // 2], y[PER // 2 :]), axis=-1)[None]
    found = np.abs(spectrum(np.arange(PER // 2) / PER, series, K)[0])
    size = np.abs(full[: K + 1]) * np.where(np.arange(K + 1) > 0, np.sqrt(2), 1)
    assert found == pytest.approx(size, rel=0.02)
    assert (found**2).sum() == pytest.approx(np.mean(y**2), rel=0.03)


@pytest.mark.parametrize("missing", [0, 8])
def test_a_linear_cause_a_symmetric_one_and_an_asymmetric_one_have_their_own_lines(
    missing: int,
) -> None:
    x = wave(np.random.default_rng(4).random(len(EXCITED_LINES)))
    linear, cubic, square = (powers(y, missing) for y in (x, x**3, x**2))
    assert linear[EXCITED] > 0.95 * sum(linear.values())
    assert linear[EVEN] + linear[CONSTANT] < 1e-12
    assert cubic[EVEN] + cubic[CONSTANT] < 1e-9 * cubic[ODD]
    assert cubic[ODD] > 0.1 * cubic[EXCITED]
    assert square[ODD] + square[EXCITED] < 1e-9 * square[EVEN]
    assert square[CONSTANT] > 0


def test_what_the_shares_mean_is_judged_beside_the_motions_own_lines() -> None:
    straight = {CONSTANT: 0.0, EXCITED: 0.97, ODD: 0.01, EVEN: 0.02}
    bent = {CONSTANT: 0.0, EXCITED: 0.6, ODD: 0.05, EVEN: 0.35}
    assert meaning(bent, straight) == "asymmetric"
    assert meaning(bent, bent) == "linear in the motion"  # the linkage alone does that
    both = {CONSTANT: 0.0, EXCITED: 0.3, ODD: 0.3, EVEN: 0.4}
    assert meaning(both, straight) == "asymmetric and a symmetric nonlinearity"
    assert meaning({CONSTANT: 0.9, EXCITED: 0.05, ODD: 0.0, EVEN: 0.05}, straight) == "constant"
    assert meaning(dict.fromkeys(KINDS, 0.0), straight) == "not above the noise"


def traced(rig: Rig, **wrong: float) -> Trace:
    """Trace a bench moved by odd lines of 0.25 Hz up to 9.25 Hz, two periods a record."""
    train, held_out = (
        replace(run, records=tuple(replace(r, period=4000) for r in run.records))
        for run in pair_of_runs(rig, **wrong)
    )
    return trace([train], [held_out], look_ahead=False)


def test_a_single_sine_is_followed_to_where_the_row_filter_ends() -> None:
    """Its harmonics are what tells: the odd ones are all empty lines."""
    _, train_data = sine()
    found = spectral_lines(train_data, train_data.mean_residual)
    assert {one.equation for one in found} == {"torque_2", "flow_cap_2", "flow_rod_2"}
    for one in found:
        assert np.flatnonzero(one.excited).tolist() == [1]
        assert one.frequency[-1] > 8.0  # [Hz] of the slowest row filter


@pytest.mark.slow
def test_friction_shows_on_the_empty_odd_lines_and_a_null_on_the_even_ones(rig: Rig) -> None:
    friction = traced(rig, Fc=60)
    (loudest, *_) = friction.lines
    assert loudest.equation == "torque_2"
    assert "symmetric nonlinearity" in loudest.meaning
    assert loudest.above_noise_after < 0.3 * loudest.above_noise

    null = traced(rig, u_null=5e-3)
    assert null.lines[0].equation.startswith("flow")
    assert null.lines[0].shares[EVEN] + null.lines[0].shares[CONSTANT] > 0.8
    assert null.lines[0].meaning in ("asymmetric", "mostly asymmetric", "constant")
    data = json.loads(json.dumps(to_json(null), allow_nan=False))
    assert data["lines"][0]["text"] == null.lines[0].text
