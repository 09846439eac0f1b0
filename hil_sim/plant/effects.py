"""What each effect of a scenario does to the plant's tables."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from hil_sim.plant.kernel_data import Table
from hil_sim.scenario import effects as fx
from rig.model.rig import Rig

# The bristle's relaxation is kept below this rate [1/s] for the fixed step's sake.
BRISTLE_LIMIT = 8e3


@dataclass(frozen=True)
class Tables:
    """The plant's tables while they are being made; the arrays are filled in place."""

    rig: Rig
    joints: Table
    bench: Table
    inertia: Table
    channels: Table


def _coulomb(t: Tables, e: fx.CoulombFriction) -> None:
    t.joints["friction_plus"][e.joint] += e.force
    t.joints["friction_minus"][e.joint] += e.force
    t.joints["friction_taper"][e.joint] += e.taper
    _bristles(t, e.joint, e.force, e.presliding)


def _stribeck(t: Tables, e: fx.StribeckFriction) -> None:
    t.joints["stribeck"][e.joint] += e.force
    t.joints["stribeck_speed"][e.joint] = e.speed
    _bristles(t, e.joint, e.force, e.presliding)


def _asymmetric(t: Tables, e: fx.AsymmetricFriction) -> None:
    t.joints["friction_plus"][e.joint] += e.extending
    t.joints["friction_minus"][e.joint] += e.retracting
    _bristles(t, e.joint, max(e.extending, e.retracting), e.presliding)


def _by_pressure(t: Tables, e: fx.PressureDependentFriction) -> None:
    t.joints["friction_pressure"][e.joint] += e.coefficient
    _bristles(t, e.joint, e.coefficient * t.rig.supply.pressure, e.presliding)


def _bristles(t: Tables, joint: int | None, force: float, presliding: float) -> None:
    # Friction of several causes shares one set of bristles: their stiffnesses add.
    row = t.joints[joint : joint + 1] if joint is not None else t.joints
    row["friction_scale"] += force
    row["bristle_stiffness"] += force / presliding
    row["bristle_limit"] = BRISTLE_LIMIT
    # Enough micro-damping that presliding does not ring, little against Fv G^-2.
    row["bristle_damping"] += 2e-3 * force / presliding


def _inclination(t: Tables, e: fx.BaseInclination) -> None:
    t.bench["sin_slope"], t.bench["cos_slope"] = math.sin(e.angle), math.cos(e.angle)


def _payload(t: Tables, e: fx.Payload) -> None:
    # A point mass at the tip: R_ij += m l_i l_j, W_i += m l_i.
    lengths = np.array([j.link_length for j in t.rig.joints])
    t.inertia[:] += e.mass * np.outer(lengths, lengths)
    t.joints["weight"] += e.mass * t.rig.gravity * lengths


def _spring(t: Tables, e: fx.JointSpring) -> None:
    rest = e.rest
    if rest is None:
        rest = float(t.rig.joints[e.joint or 0].linkage.angle(0.0))
    t.joints["spring"][e.joint] = e.stiffness
    t.joints["spring_rest"][e.joint] = rest
    t.joints["spring_hardening"][e.joint] = e.hardening


def _torque(t: Tables, e: fx.TorqueOffset) -> None:
    t.joints["torque_offset"][e.joint] += e.torque


def _deadband(t: Tables, e: fx.ValveDeadband) -> None:
    t.joints["lap_ahead"][e.joint] += e.width
    t.joints["lap_astern"][e.joint] += e.astern or e.width
    t.joints["rounding"][e.joint] += e.rounding or 0.2 * e.width


def _underlap(t: Tables, e: fx.UnderlapLeakage) -> None:
    t.joints["lap_ahead"][e.joint] -= e.width
    t.joints["lap_astern"][e.joint] -= e.width
    t.joints["rounding"][e.joint] += e.rounding or 0.5 * e.width


def _null(t: Tables, e: fx.SpoolOffset) -> None:
    t.joints["null"][e.joint] += e.voltage


def _lag(t: Tables, e: fx.SpoolLag) -> None:
    t.joints["opening_rate"][e.joint] = 1.0 / e.time


def _internal(t: Tables, e: fx.InternalLeakage) -> None:
    t.joints["leak_internal"][e.joint] += e.conductance
    t.joints["leak_length"][e.joint] = e.worn or math.inf


def _external(t: Tables, e: fx.ExternalLeakage) -> None:
    for chamber in (e.chamber,) if e.chamber else ("cap", "rod"):
        t.joints[f"leak_{chamber}"][e.joint] += e.conductance


def _supply(t: Tables, e: fx.SupplySag) -> None:
    rated = t.rig.supply.flow
    if e.flow is not None:
        t.bench["pump"] = e.flow
    if e.override is not None:
        set_relief(t, e.override)
    if e.line_drop is not None:
        t.bench["line_gain"] = rated / math.sqrt(e.line_drop)
        t.bench["manifold_volume"] = e.manifold_volume


def set_relief(t: Tables, override: float) -> None:
    """Set the relief valve so that the idle pump's whole flow passes at the rig's set pressure.

    slope over cracking, rounded by w: k (x + sqrt(x^2 + w^2)) / 2 = Q_pump at x = D - w^2 / 4 D
    with D = Q_pump / k, the override.
    """
    rounding = t.bench["relief_rounding"]
    t.bench["relief_slope"] = t.rig.supply.flow / override
    t.bench["relief_crack"] = t.rig.supply.pressure - (override - rounding**2 / (4.0 * override))


def _tank(t: Tables, e: fx.TankPressure) -> None:
    t.bench["tank_pressure"] = e.pressure
    t.bench["tank_resistance"] = e.back_pressure / t.rig.supply.flow**2
    t.bench["tank_lag"] = e.lag


def _air(t: Tables, e: fx.EntrainedAir) -> None:
    t.bench["air"] = e.fraction
    t.bench["air_dissolution"] = e.dissolution


def _dead_volume(t: Tables, e: fx.DeadVolume) -> None:
    t.joints[f"{e.chamber}_volume"][e.joint] += e.volume


def _delay(t: Tables, e: fx.ChannelDelay) -> None:
    t.channels["lag"][t.rig.channels.index(e.channel)] += e.time


def _gain(t: Tables, e: fx.SensorGain) -> None:
    t.channels["gain"][t.rig.channels.index(e.channel)] *= e.gain


def _offset(t: Tables, e: fx.SensorOffset) -> None:
    t.channels["offset"][t.rig.channels.index(e.channel)] += e.offset


APPLY: dict[type, Callable[[Tables, Any], None]] = {
    fx.CoulombFriction: _coulomb,
    fx.StribeckFriction: _stribeck,
    fx.AsymmetricFriction: _asymmetric,
    fx.PressureDependentFriction: _by_pressure,
    fx.BaseInclination: _inclination,
    fx.Payload: _payload,
    fx.JointSpring: _spring,
    fx.TorqueOffset: _torque,
    fx.ValveDeadband: _deadband,
    fx.UnderlapLeakage: _underlap,
    fx.SpoolOffset: _null,
    fx.SpoolLag: _lag,
    fx.InternalLeakage: _internal,
    fx.ExternalLeakage: _external,
    fx.SupplySag: _supply,
    fx.TankPressure: _tank,
    fx.EntrainedAir: _air,
    fx.DeadVolume: _dead_volume,
    fx.ChannelDelay: _delay,
    fx.SensorGain: _gain,
    fx.SensorOffset: _offset,
}
