"""Slow waves under the loop that centres them: their peaks turn against one another and grow."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from analysis.design import limits
from protocols.engine.centring import under_loop

RATE, PULL = 100.0, 2.0  # Hz, 1/s


@pytest.fixture
def wave() -> tuple[np.ndarray, np.ndarray]:
    """A speed of five slow lines [m/s] and the piston that follows it freely [m], one period."""
    n = round(10 * RATE)
    t = np.arange(n) / RATE
    phases = (-0.2, -0.73, -1.76, -2.7, 2.75)
    speed = np.sum(
        [0.02 * np.cos(0.2 * np.pi * k * t + a) for k, a in zip((1, 3, 5, 7, 9), phases,
                                                                 strict=True)], axis=0
    )  # fmt: skip
    lines = np.fft.rfft(speed)
    w = 2 * np.pi * np.fft.rfftfreq(n, 1 / RATE)
    lines[1:] /= 1j * w[1:]
    return speed, np.fft.irfft(lines, n)


def test_the_piston_under_the_loop_is_that_of_its_equation(
    wave: tuple[np.ndarray, np.ndarray],
) -> None:
    """ds/dt = v(t) - pull s, integrated until it repeats."""
    speed, free = wave
    t = np.arange(len(speed)) / RATE
    again = solve_ivp(
        lambda at, s: [np.interp(at % 10.0, t, speed, period=10.0) - PULL * s[0]],
        (0.0, 30.0), [0.0], t_eval=20.0 + t, rtol=1e-8, atol=1e-10, max_step=0.02,
    ).y[0]  # fmt: skip
    looped = under_loop(free, PULL, RATE)
    assert looped == pytest.approx(again - again.mean(), abs=2e-3 * np.ptp(again))


def test_designs_and_checks_foresee_the_same_swing(wave: tuple[np.ndarray, np.ndarray]) -> None:
    """Two layers that may not import one another; 0.8 m/s per volt, 2.5 V/m."""
    speed, free = wave
    ours = limits._under_loop(free, speed / 0.8, 2.5, RATE)
    assert ours == pytest.approx(under_loop(free, 0.8 * 2.5, RATE), abs=1e-9)
