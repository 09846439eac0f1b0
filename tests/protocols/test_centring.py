"""From a piston's samples to the bias that keeps it centred, on motion known exactly."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocols.engine.centring import follow, forecast, leaves, motion, recentring, trim

RATE = 1000.0
gains = st.floats(0.05, 0.4)
nulls = st.floats(-0.1, 0.1)


def integrate(gain: float, null: float, command: np.ndarray, start: float = 0.0) -> np.ndarray:
    """A piston that integrates its command: the sum, not the formula under test."""
    return start + np.cumsum(gain * (command - null)) / RATE


@settings(max_examples=50)
@given(gain=gains, null=nulls, seconds=st.floats(0.7, 6.0), seed=st.integers(0, 1000))
def test_gain_and_null_are_found_from_any_stretch(
    gain: float, null: float, seconds: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    time = np.arange(round(seconds * RATE)) / RATE
    command = 0.03 + 0.5 * np.sin(2 * np.pi * 1.3 * time) + 0.2 * np.sin(2 * np.pi * 4.1 * time)
    piston = integrate(gain, null, command) + 1e-5 * rng.standard_normal(len(time))
    seen = follow(command, piston, RATE)
    assert seen.gain == pytest.approx(gain, rel=0.01)
    assert seen.null == pytest.approx(null, abs=1e-3)
    assert seen.drift == pytest.approx(gain * (command.mean() - null), abs=1e-4)


def test_a_few_lost_blocks_do_not_matter() -> None:
    time = np.arange(3000) / RATE
    command = 0.5 * np.sin(2 * np.pi * time)
    piston = integrate(0.16, 0.02, command)
    piston[700:750] = np.nan
    command[700:750] = np.nan
    seen = follow(command, piston, RATE)
    assert seen.gain == pytest.approx(0.16, rel=0.02)
    assert seen.null == pytest.approx(0.02, abs=1e-3)


def test_a_command_that_does_not_vary_tells_nothing() -> None:
    seen = follow(np.full(1000, 0.1), np.linspace(0, 1e-3, 1000), RATE)
    assert np.isnan(seen.gain)
    assert np.isnan(follow(np.full(5, np.nan), np.zeros(5), RATE).null)


@settings(max_examples=50)
@given(drift=st.floats(-5e-3, 5e-3), centre=st.floats(-0.01, 0.01), seed=st.integers(0, 99))
def test_drift_is_what_differs_between_two_periods(drift: float, centre: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    period = np.cumsum(rng.standard_normal(1000)) * 1e-4  # any shape at all
    time = np.arange(2000) / RATE
    piston = centre + np.tile(period, 2) + drift * time + 1e-5 * rng.standard_normal(2000)
    seen = motion(piston, 1000, RATE)
    assert seen.drift == pytest.approx(drift, abs=1e-5)
    assert seen.ends == pytest.approx(centre + period.mean() + drift * 2.0, abs=1e-5)


@settings(max_examples=50)
@given(gain=gains, null=nulls, bias=nulls, offset=st.floats(-3e-3, 3e-3))
def test_one_trim_stops_the_drift_and_takes_out_half_the_offset(
    gain: float, null: float, bias: float, offset: float
) -> None:
    wave = 0.4 * np.sin(2 * np.pi * np.arange(2000) / 1000)
    before = integrate(gain, null, wave + bias, offset)
    seen = motion(before, 1000, RATE)
    wanted = recentring(seen, 0.0, 2.0, cap=np.inf)
    better = trim(bias, seen.drift, wanted, gain)
    after = motion(integrate(gain, null, wave + better, float(before[-1])), 1000, RATE)
    assert after.drift == pytest.approx(wanted, abs=1e-7)
    # `ends` holds half a sample past the last sample, at which the next record starts.
    shift = 0.5 * (wanted - seen.drift) / RATE
    assert after.ends == pytest.approx(0.5 * seen.ends + shift, abs=1e-9)


def test_recentring_never_looks_like_a_drift() -> None:
    far = motion(np.full(200, 0.02), 100, RATE)
    assert recentring(far, 0.0, 10.0, cap=1e-3) == pytest.approx(-1e-4)


def wide(drift: float, seconds: float, start: float = 0.0) -> np.ndarray:
    time = np.arange(round(seconds * RATE)) / RATE
    return start + 0.025 * np.sin(2 * np.pi * 0.5 * time) + drift * time


def test_a_steady_drift_is_forecast_a_record_ahead() -> None:
    reference = wide(0.0, 2.0)
    seen = wide(2e-3, 4.0)
    ahead = forecast(reference, seen, 4000, RATE, 200)
    truth = wide(2e-3, 8.0)[4000:]
    assert ahead.slope == pytest.approx(2e-3, rel=0.01)
    assert ahead.low == pytest.approx(truth.min(), abs=2e-4)
    assert ahead.high == pytest.approx(truth.max(), abs=2e-4)
    assert leaves(ahead, -0.036, 0.036)
    assert not leaves(ahead, -0.045, 0.045)


def test_a_line_is_continued_no_further_than_it_was_seen() -> None:
    reference = wide(0.0, 2.0)
    short = forecast(reference, wide(5e-3, 0.5), 20_000, RATE, 200)
    assert short.high < 0.025 + 5e-3 * 1.0 + 1e-4  # not 0.025 + 5e-3 * 20


def test_a_steady_piston_is_left_alone_whatever_the_noise() -> None:
    rng = np.random.default_rng(5)
    reference = wide(0.0, 2.0) + 1e-5 * rng.standard_normal(2000)
    for seconds in (0.1, 0.3, 1.1, 3.7, 9.9):
        seen = wide(0.0, seconds) + 1e-5 * rng.standard_normal(round(seconds * RATE))
        ahead = forecast(reference, seen, round((10 - seconds) * RATE), RATE, 200)
        assert not leaves(ahead, -0.026, 0.026)
