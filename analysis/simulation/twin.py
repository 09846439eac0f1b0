"""The twin: a simulation of the rig under planned commands, before it moves.

Its parameters are the rig's nominal values, or those of an identified model with its effects.
"""

from __future__ import annotations

import functools
import logging
from collections.abc import Mapping

import numpy as np
from numba import njit
from scipy.linalg import expm

from analysis.simulation.model import Array, Model, nominal_model
from analysis.simulation.simulate import State, constant_supply, simulate
from rig.model.parse import InputError
from rig.model.parts import Valve
from rig.model.rig import Rig

log = logging.getLogger(__name__)


def spool_response(valve: Valve, command: Array, rate: float) -> Array:
    """Return the spool [V] of a held command [V], (n,): second order, stopped at its stroke.

    u'' + 2 d w u' + w^2 u = w^2 k v with natural frequency w and damping d of the rig file.
    """
    step = _held_response(valve.natural_frequency, valve.damping_ratio, rate)
    held = np.clip(command, -valve.command_range, valve.command_range) * valve.spool_gain
    spool = _followed(step, np.clip(held, -valve.spool_stroke, valve.spool_stroke))
    return np.asarray(np.clip(spool, -valve.spool_stroke, valve.spool_stroke))


@functools.lru_cache(maxsize=32)
def _held_response(frequency: float, damping: float, rate: float) -> Array:
    """Return (2, 3): u and u' of a unit second-order lag after one sample, by u, u' and input."""
    w, d = 2 * np.pi * frequency, damping
    generator = np.array([[0.0, 1.0, 0.0], [-w * w, -2 * d * w, w * w], [0.0, 0.0, 0.0]])
    return np.ascontiguousarray(expm(generator / rate)[:2])


@njit(cache=True)
def _followed(step, held):  # type: ignore[no-untyped-def]
    """Return u (n,) at the samples of a held input (n,), starting from rest."""
    out = np.zeros_like(held)
    u, rate = 0.0, 0.0
    for k in range(1, len(held)):
        v = held[k - 1]
        u, rate = (
            step[0, 0] * u + step[0, 1] * rate + step[0, 2] * v,
            step[1, 0] * u + step[1, 1] * rate + step[1, 2] * v,
        )
        out[k] = u
    return out


def holding_state(rig: Rig, model: Model, piston: Array) -> State:
    """Return the state at rest at piston positions (N,): gravity held, pressures around p_s/2."""
    N = len(rig.joints)
    q = np.array([float(j.linkage.angle(p)) for j, p in zip(rig.joints, piston, strict=True)])
    theta, values = np.cumsum(q), model.values
    gravity = np.array(
        [values.get(f"W{i + 1}", 0.0) * rig.gravity * np.sin(theta[i]) for i in range(N)]
    )
    torque = np.cumsum(gravity[::-1])[::-1]
    cap, rod = np.empty(N), np.empty(N)
    for i, joint in enumerate(rig.joints):
        force = torque[i] / float(joint.linkage.jacobian(q[i]))
        area_cap, area_rod = joint.cylinder.cap_area, joint.cylinder.rod_area
        # The chambers' mean is half the supply, their difference carries the load.
        half = 0.5 * rig.supply.pressure
        pressure_excess = (force - half * (area_cap - area_rod)) / (area_cap + area_rod)
        cap[i] = np.clip(half + pressure_excess, 0.0, rig.supply.pressure)
        rod[i] = np.clip(half - pressure_excess, 0.0, rig.supply.pressure)
    return State(q, np.zeros(N), cap, rod)


def simulate_commands(
    rig: Rig,
    commands: Array,
    start: Array,
    locked: Mapping[int, float],
    model: Model | None = None,
) -> dict[str, Array]:
    """Simulate valve commands (n, N) [V] at the rig's sample rate, on the nominal model by default.

    `start` (N,) are the pistons' first positions [m], `locked` maps a 0-based joint to the piston
    position [m] that holds it. Returns `piston speed cap_pressure rod_pressure spool`, each (n, N)
    in SI, and `valid` (n,), 1 until the simulation failed and 0 afterwards (the last state is then
    held, which lies outside every limit). Raises InputError for a rig without nominal values or
    arrays that do not fit it.
    """
    N = len(rig.joints)
    commands = np.asarray(commands, dtype=np.float64)
    if commands.ndim != 2 or commands.shape[1] != N or len(commands) < 2:
        raise InputError(f"commands of shape {commands.shape} do not fit a rig of {N} joints")
    is_locked = np.array([i in locked for i in range(N)])
    position = np.array([locked.get(i, float(start[i])) for i in range(N)])
    model = nominal_model(rig) if model is None else model
    state = holding_state(rig, model, position)
    n, rate = len(commands), rig.sample_rate
    spool = np.column_stack(
        [spool_response(j.valve, commands[:, i], rate) for i, j in enumerate(rig.joints)]
    )
    spool[:, is_locked] = 0.0
    result = simulate(model, constant_supply(rig, rate, spool, is_locked, state.q), state)
    if result.failure:
        log.info("the twin stopped: %s", result.failure)
    return {
        "piston": result.piston,
        "speed": result.speed,
        "cap_pressure": result.p_cap,
        "rod_pressure": result.p_rod,
        "spool": spool,
        "valid": (np.arange(n) < result.filled).astype(np.float64),
    }
