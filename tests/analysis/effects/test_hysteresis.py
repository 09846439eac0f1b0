"""A spool whose friction builds up along its travel: play with details against the law itself."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from analysis.effects.hysteresis import SpoolHysteresis
from rig.model.rig import Rig

WIDTH = 0.4  # V


def spool(t: np.ndarray) -> np.ndarray:
    """Return a spool [V] that passes the width at each reversal."""
    return np.asarray(1.5 * np.sin(2.0 * t))


def by_friction(t: np.ndarray, travel: float) -> np.ndarray:
    """Return the opening [V] where friction holds the spool off (Dahl 1968), integrated.

    The offset is w / 2 h with dh = (1 - h sign(du)) du / travel.
    """

    def rate(at: float, h: np.ndarray) -> np.ndarray:
        speed = 3.0 * np.cos(2.0 * at)
        return np.asarray((speed - abs(speed) * h) / travel)

    h = solve_ivp(rate, (t[0], t[-1]), [0.0], t_eval=t, rtol=1e-8, atol=1e-10, max_step=1e-2)
    return np.asarray(spool(t) - 0.5 * WIDTH * h.y[0])


@pytest.mark.parametrize("travel", [0.13, 0.2, 0.5])
def test_operators_whose_widths_spread_follow_friction_that_builds_up(
    rig: Rig, travel: float
) -> None:
    t = np.linspace(0.0, 10.0, 5001)
    effect = SpoolHysteresis("joint 1")
    truth = by_friction(t, travel)
    steepness = WIDTH / travel - 1.0

    def error(*shape: float) -> float:
        opening = effect.opening(rig, spool(t), shape)
        return float(np.sqrt(np.mean((opening - truth)[1000:] ** 2)) / WIDTH)

    assert error(WIDTH, 1.0, steepness) < 0.03
    assert error(WIDTH) > 0.045  # play alone stands still for all of its width
