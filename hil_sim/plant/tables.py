"""The compiled plant's tables from rig, machine and scenario: joints, bench, converters."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from hil_sim.effects.base import Tables, set_relief
from hil_sim.plant.kernel_data import ATMOSPHERE, BENCH, CHANNEL, JOINT, KIND, Table
from hil_sim.scenario.file import Scenario, check_fits
from hil_sim.scenario.truth import Constants, TrueMachine
from rig.model.channels import kind_of
from rig.model.parse import InputError
from rig.model.parts import Joint
from rig.model.rig import Rig


def inertia_matrix(parameters: Mapping[str, float], joints: int) -> Table:
    """Return R_ij [kg m^2], symmetric (N, N), from M1 M2 R12, from M1, or from R_ij.

    Raises InputError where it is not positive definite: then some pose has no kinetic energy
    (cos(th_i - th_j) keeps definiteness, Schur).
    """
    R = np.zeros((joints, joints))
    if joints == 1:
        R[0, 0] = parameters["M1"]
    elif joints == 2:
        # M1 = R11 + R22, M2 = R22.
        R[0, 0] = parameters["M1"] - parameters["M2"]
        R[1, 1] = parameters["M2"]
        R[0, 1] = R[1, 0] = parameters["R12"]
    else:
        for i in range(joints):
            for k in range(i, joints):
                R[i, k] = R[k, i] = parameters[f"R{i + 1}{k + 1}"]
    if np.linalg.eigvalsh(R)[0] <= 0:
        raise InputError(
            "the inertia parameters give no positive definite mass matrix; "
            "check M1 > M2 > 0 and R12^2 < (M1 - M2) M2, or the R_ij"
        )
    return R


def build(
    rig: Rig, machine: TrueMachine, scenario: Scenario, periods: Mapping[str, float]
) -> Tables:
    """Return the plant's tables; `periods` holds the oil temperature's periods and phases.

    Raises InputError for effects at places that the rig lacks and for impossible parameters.
    """
    check_fits(scenario, rig)
    _refuse_impossible(machine.parameters)
    tables = Tables(
        rig=rig,
        joints=np.zeros(len(rig.joints), JOINT),
        bench=np.zeros(1, BENCH),
        inertia=inertia_matrix(machine.parameters, len(rig.joints)),
        channels=channel_table(rig, scenario.noise),
    )
    for i, joint in enumerate(rig.joints):
        _fill_joint(tables.joints, i, joint, rig, machine)
    _fill_bench(tables, machine.parameters["b"], machine.constants, periods)
    for effect in scenario.effects:
        effect.apply(tables)
    return tables


def _refuse_impossible(parameters: Mapping[str, float]) -> None:
    for name, value in parameters.items():
        if (name == "b" and value <= 0) or (name.startswith(("C_", "Fv")) and value < 0):
            raise InputError(f"parameter {name} is {value:g}; no bench has that, check its sign")


def _fill_joint(table: Table, i: int, joint: Joint, rig: Rig, machine: TrueMachine) -> None:
    a, c, offset = joint.linkage.base_pin, joint.linkage.arm_pin, joint.linkage.offset
    cylinder, valve, constants = joint.cylinder, joint.valve, machine.constants
    half = cylinder.stroke / 2
    true = machine.parameters
    row = {
        "pins": a * a + c * c,
        "product": a * c,
        "mid_length": joint.linkage.mid_length,
        "half_stroke": half,
        "offset": offset,
        "sin_offset": math.sin(offset),
        "cos_offset": math.cos(offset),
        "cap_area": cylinder.cap_area,
        "rod_area": cylinder.rod_area,
        "cap_volume": cylinder.cap_pipe_volume + half * cylinder.cap_area,
        "rod_volume": cylinder.rod_pipe_volume + half * cylinder.rod_area,
        **{f"c_{signs}": true[f"C_{signs}_{i + 1}"] for signs in ("pp", "pm", "mp", "mm")},
        "omega": 2.0 * math.pi * valve.natural_frequency,
        "zeta": valve.damping_ratio,
        "spool_stroke": valve.spool_stroke,
        "spool_rate": constants.spool_rate,
        "spool_gain": valve.spool_gain,
        "viscous": true[f"Fv{i + 1}"],
        "weight": true[f"W{i + 1}"] * rig.gravity,
        "stribeck_speed": 1.0,
        "leak_length": math.inf,
        "contact_stiffness": constants.contact_stiffness,
        "contact_damping": constants.contact_damping,
        "output_top": (1 << (valve.command_bits - 1)) - 1,
        "output_range": valve.command_range,
    }
    for name, value in row.items():
        table[name][i] = value


def _fill_bench(
    tables: Tables, bulk: float, constants: Constants, periods: Mapping[str, float]
) -> None:
    rig = tables.rig
    row = {
        "half_bulk": bulk / 2.0,
        "trapped": 4.0 * constants.residual_air * ATMOSPHERE / bulk,
        "air_dissolution": 1.0,
        "air_exponent": 1.0,
        "laminar": constants.laminar_transition,
        "cos_slope": 1.0,
        "pump": rig.supply.flow,
        "supply_volume": constants.supply_volume,
        "relief_rounding": constants.relief_rounding,
        "manifold_volume": 1.0,
        "tank_lag": 1.0,
        "temperature": rig.oil.temperature,
        "band": rig.oil.temperature_band,
        "bulk_temperature": constants.bulk_temperature,
        **periods,
    }
    for name, value in row.items():
        tables.bench[name] = value
    set_relief(tables, constants.relief_override)


def channel_table(rig: Rig, noise: float) -> Table:
    """Return the sensors of `rig` in the order of its channels, noise scaled; shape (channels,).

    Channel k of `rig.channels` is converted k skews after the tick (the multiplexer runs ahead of
    the tick: along the tangent of the true signal), and shows the signal `delay` before that (cubic
    Hermite through earlier ticks). Then gain, offset, noise, and the converter code
    (`rig.model.wire.codes`).
    """
    table = np.zeros(len(rig.channels), CHANNEL)
    for k, name in enumerate(rig.channels):
        kind, joint = kind_of(name)
        sensor = rig.sensors.of(kind)
        low, high = sensor.range
        top = (1 << sensor.bits) - 1
        row = {
            "kind": KIND[kind],
            "joint": (joint or 1) - 1,
            "noise": sensor.noise * noise,
            "gain": 1.0,
            "lag": sensor.delay - k * rig.sensors.skew,
            "low": low,
            "step": (high - low) / top,
            "scale": top / (high - low),
            "top": top,
        }
        for field, value in row.items():
            table[field][k] = value
    return table


def ring_length(table: Table, period: float) -> int:
    """Return how many ticks of history the longest lag needs."""
    longest = float(np.max(table["lag"], initial=0.0))
    return max(math.ceil(longest / period), 0) + 3
