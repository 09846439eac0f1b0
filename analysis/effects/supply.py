"""Effects on the pressures at the valves' ports: supply sag, return pressure.

Both depend on the total flow of all valves. The rows compute that flow from the chambers'
continuity, A s' + V p' / b, with the b that an identification without these effects gives; the
simulation solves the orifices for it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Final

import numpy as np
from numba import njit

from analysis.effects.base import SUPPLY, Array, Evidence, Shape, SignalEffect
from analysis.effects.valve import lagged
from analysis.signals.conditioning import Signals
from analysis.terms.base import (
    P_CAP,
    P_ROD,
    P_S,
    P_TANK,
    PREPARE,
    U,
    Used,
    equation,
    kernel,
)
from rig.model.parameters import gain_names
from rig.model.rig import Rig
from rig.model.units import plain

NEWTON: Final = 12  # steps; the equation is monotone and smooth but for u = 0
# [s] Longest lag of a line that loses all pressure at the pump's flow: that of an accumulator.
LONGEST: Final = 2.0
# Of the pump's flow: the steepest line searched loses all of the pressure at this flow.
LEAST_FLOW: Final = 0.05
BULK: Final = "b"  # the parameter's name
BULK_MODULUS: Final = 1e9  # [Pa] with hoses and some air (Jelali and Kroll 2003, section 2.3)
NEAR_PUMP: Final = 0.5  # of the pump's flow: records that reach it need no remark on the drop
# Share r_t of the pump's flow at which a line becomes turbulent: below the least one no flow of a
# record is laminar, and a line with r_t = 0 is laminar throughout, as with `LAMINAR`.
LEAST_SHARE: Final = 1e-3
LAMINAR: Final = 100.0
NEGLIGIBLE: Final = 1e-4  # drop at the pump's whole flow, of the supply pressure


@dataclass(frozen=True)
class PortEffect(SignalEffect):
    """An effect on the pressure at all valves' ports, with shapes only."""

    hydraulic = True
    family = "fluid"
    alters = ("fluid",)
    prepares = True
    stage = SUPPLY


def bulk_modulus(rig: Rig) -> float:
    """Return the rig's nominal bulk modulus [Pa], or a usual one of oil in hoses.

    `analysis.identify.coupled` sets the nominal one to the identified one.
    """
    return rig.nominal.get(BULK, BULK_MODULUS)


def line_drop(name: str, rig: Rig, shares: tuple[float, ...]) -> Shape:
    """Return a line's drop at the pump's whole flow [Pa], from `shares` of the supply pressure.

    A pump is often rated for far more than an arm draws: the drop at its whole flow is then
    nominal, and may be many times the supply pressure.
    """
    p = rig.supply.pressure
    negligible, grid = NEGLIGIBLE * p, tuple(share * p for share in shares)
    return Shape(name, "Pa", negligible, 0.9 * p / LEAST_FLOW**2, grid, neutral=negligible)


def transition_share(name: str, grid: tuple[float, ...]) -> Shape:
    """Return the shape r_t: share of the pump's flow at which a line becomes turbulent."""
    return Shape(name, "", LEAST_SHARE, 3.0, grid, resolution=True, saturates=True)


def packed_line(rig: Rig, dp: float, share: float) -> tuple[float, float]:
    """Return the turbulent part's drop over Q^2 [Pa s^2/m^6] and where it begins [m^3/s]."""
    flow = rig.supply.flow
    return turbulent_part(dp, share) / flow**2, share * flow


def turbulent_part(dp: float, share: float) -> float:
    """Return the drop [Pa] at the pump's whole flow that a line would have without laminar flow."""
    return dp / math.cbrt(1.0 + share**3)


def line_loss(ratio: Array, turbulent: float, share: float) -> Array:
    """Return the drop (n,) [Pa] of a line at flows r (n,) over the pump's, `drop_and_slope`'s law.

    It is turbulent_part r (r^3 + r_t^3)^(1/3).
    """
    return np.asarray(turbulent * ratio * np.cbrt(ratio**3 + share**3))


def largest_flow(rig: Rig, signals: Sequence[Signals], drawn: bool) -> float:
    """Return the records' largest flow [m^3/s] from the supply (`drawn`), or to the tank."""
    return max((float(port_flow(rig, s, drawn).max()) for s in signals), default=0.0)


def port_flow(rig: Rig, signals: Signals, drawn: bool) -> Array:
    """Return the flow (n,) [m^3/s] of all valves from the supply (`drawn`), or to the tank."""
    softness = 1.0 / bulk_modulus(rig)
    total = np.zeros(len(signals.t))
    for i, joint in enumerate(rig.joints):
        cap, rod = joint.cylinder.cap_area, joint.cylinder.rod_area
        into_cap = cap * signals.sd[:, i] + softness * signals.V_cap[:, i] * signals.pd_cap[:, i]
        into_rod = softness * signals.V_rod[:, i] * signals.pd_rod[:, i] - rod * signals.sd[:, i]
        positive, negative = signals.u[:, i] > 0.0, signals.u[:, i] < 0.0
        if drawn:
            flow = np.where(positive, into_cap, 0.0) + np.where(negative, into_rod, 0.0)
        else:
            flow = -np.where(positive, into_rod, 0.0) - np.where(negative, into_cap, 0.0)
        total += np.maximum(flow, 0.0)
    return total


@dataclass(frozen=True)
class LineDrop(PortEffect):
    """A line whose first two shapes are its drop at the pump's whole flow [Pa], and r_t.

    Its flow is `drawn` from the supply, or returned to the tank. `powers` are the exponents with
    which the shapes searched scale with the pump's flow over the largest of the records.
    """

    by_data = True
    drawn: ClassVar[bool]
    powers: ClassVar[tuple[int, ...]]

    def points(self, rig: Rig, evidence: Evidence) -> tuple[tuple[float, ...], ...]:
        """Return a starting grid scaled to the largest flow of the records."""
        flow = largest_flow(rig, evidence.signals, self.drawn)
        if flow <= 0.0:
            return ()
        times = min(max(rig.supply.flow / flow, 1.0), 1.0 / LEAST_FLOW)
        axes = [
            [value * times**power for value in shape.grid]
            for shape, power in zip(self.shapes(rig), self.powers, strict=False)
        ]
        return tuple(itertools.product(*axes))

    def line(self, rig: Rig, shape: Sequence[float]) -> tuple[float, float]:
        """Return the drop at the pump's whole flow [Pa], and r_t.

        A shape without r_t is turbulent throughout, one with an r_t of 0 laminar throughout.
        """
        dp, *share = self.shape_of(rig, shape)[:2]
        return dp, (share[0] or LAMINAR) if share else 0.0

    def other_form_starts(self, rig: Rig, shape: Sequence[float]) -> tuple[tuple[float, ...], ...]:
        """Return the line laminar throughout, or one with an r_t, of equal drop at small flow."""
        dp, share = self.line(rig, shape)
        if share != LAMINAR:
            return ((turbulent_part(dp, share) * (share or 0.5), 0.0, *shape[2:]),)
        share = self.shapes(rig)[1].middle
        return ((dp / turbulent_part(share, share), share, *shape[2:]),)

    def _at_largest_flow(
        self, rig: Rig, signals: Sequence[Signals], shape: Sequence[float]
    ) -> tuple[float, float]:
        """Return the largest flow of records over the pump's, and the drop [Pa] there."""
        dp, share = self.line(rig, shape)
        ratio = largest_flow(rig, signals, self.drawn) / rig.supply.flow
        return ratio, drop_and_slope(ratio, turbulent_part(dp, share), share)[0]

    def remark(self, rig: Rig, signals: Sequence[Signals], shape: Sequence[float]) -> str:
        """State the drop at the largest flow of the records where that is not the pump's."""
        ratio, drop = self._at_largest_flow(rig, signals, shape)
        if not 0.0 < ratio < NEAR_PUMP:
            return ""
        pump = 6e4 * rig.supply.flow
        return (
            f"{self.shape_names()[0]} is the drop at the pump's whole {plain(pump, 2)} l/min; at "
            f"the largest flow of these records, {plain(ratio * pump, 2)} l/min, it is "
            f"{plain(drop / 1e6, 2)} MPa"
        )

    def inseparable_beside(
        self, rig: Rig, shape: Sequence[float], others: Sequence[Used]
    ) -> tuple[tuple[str, str], ...]:
        """Return the metering of a single joint's valve, beside the other port's turbulent line.

        An edge in series with such a line has Q = C u sqrt(dp - k Q^2) = C u sqrt(dp) /
        sqrt(1 + k C^2 u^2): the flow of an edge that opens less and less with the spool.
        """
        turbulent = self.line(rig, shape)[1] != LAMINAR
        both_ports = any(isinstance(other.term, LineDrop) for other in others)
        alone = len(rig.joints) == 1 and turbulent and both_ports
        return (("metering_curve", "joint 1"),) if alone else ()

    def extrapolated(
        self, rig: Rig, signals: Sequence[Signals], shape: Sequence[float]
    ) -> Mapping[str, tuple[float, float]]:
        """Return the range of the drop at the pump's whole flow, which the records do not reach.

        Beyond their largest flow the line may be laminar throughout or turbulent throughout.
        """
        ratio, drop = self._at_largest_flow(rig, signals, shape)
        if not 0.0 < ratio < 1.0:
            return {}
        return {self.shape_names()[0]: (drop / ratio, drop / ratio**2)}

    def abscissa(self, rig: Rig, signals: Signals) -> Mapping[str, Array]:
        """Return the flow drawn or returned [m^3/s]."""
        return in_every_flow(signals, port_flow(rig, signals, self.drawn))


@kernel
def _sag(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    if phase == PREPARE and par[0] > 0.0:
        Q = _valve_flow(x, bench[P_S], 1.0, par[0], par[1], par, True)
        bench[P_S] -= drop_and_slope(Q, par[0], par[1])[0]


@dataclass(frozen=True)
class SupplySag(LineDrop):
    """The valves see p_s - dp r ((r^3 + r_t^3) / (1 + r_t^3))^(1/3), r = Q / Q_pump.

    dp is the drop at the pump's whole flow. Where the rig measures its supply, this is the line
    between sensor and valves: laminar below the share r_t of the pump's flow, turbulent above
    (Merritt 1967, chapter 3; the two asymptotes joined as in Churchill and Usagi 1972). Where it
    does not, the pressure of pump or relief valve falls nearly in proportion to the flow. A sudden
    demand is first met by the oil V_supply between sensor and valves, or by an accumulator of equal
    capacity: dQ/dt = (Q_drawn - Q) b / (V_supply d dp/dQ). The regulator of a pump (constant_lag)
    follows with the time constant V_supply / b d dp/dQ of the pump's whole flow, at any flow. The
    simulation leaves both out. dp, r_t and V_supply are shapes; a line that no record shows
    turbulent is laminar throughout, without r_t.
    """

    mechanism = "supply_curve"
    element = "supply"
    name = "supply_sag"
    drawn = True
    powers = (2, -1, -1)
    smallest_shape = (0.2e6, LEAST_SHARE, 0.0)  # [Pa] at the rated flow
    variable = "the flow drawn from the supply"
    quantity = "flow drawn"
    confounders = ("tank_pressure", "sensor_gain", "sensor_offset")
    separated_by = (
        "two amplitudes, one and both joints at once: the drop depends on the whole bench's flow"
    )
    shape_stems = ("dp_supply", "laminar_share", "V_supply", "constant_lag")
    kernel = _sag

    def shapes(self, rig: Rig) -> tuple[Shape, ...]:
        """Return the drop at the pump's whole flow [Pa], r_t, the volume [m^3], a constant lag."""
        most = LONGEST * rig.supply.flow * BULK_MODULUS / rig.supply.pressure
        return (
            line_drop("dp_supply", rig, (0.05, 0.2)),
            transition_share("laminar_share", (0.2, 1.2)),
            Shape("V_supply", "m^3", 0.0, most, (0.002 * most, 0.04 * most), resolution=True),
            Shape("constant_lag", "1", 1.0, 1.0, (1.0,), detail=True, fixed=True),
        )

    def other_form_starts(self, rig: Rig, shape: Sequence[float]) -> tuple[tuple[float, ...], ...]:
        """Return the lines of `LineDrop`, and one of constant lag in the place of oil."""
        starts = super().other_form_starts(rig, shape)
        if len(shape) > 3:
            return starts
        volume = max(shape[2], self.shapes(rig)[2].grid[0])
        return (*starts, (*shape[:2], volume, 1.0))

    def prepare(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Signals:
        """Subtract the drop from the supply pressure."""
        dp, share = self.line(rig, shape)
        turbulent = turbulent_part(dp, share)
        ratio = np.ascontiguousarray(port_flow(rig, signals, self.drawn) / rig.supply.flow)
        capacity = self.shape_of(rig, shape)[2] / (bulk_modulus(rig) * rig.supply.flow)
        if shape[3:]:
            lag = capacity * drop_and_slope(1.0, turbulent, share)[1]
            drop = lagged(line_loss(ratio, turbulent, share), lag * signals.rate)
        else:
            drop = _lagged_drop(ratio, 1.0 / signals.rate, turbulent, share, capacity)
        return replace(signals, p_s=signals.p_s - drop)

    def pack(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> Array:
        """Return the line (`packed_line`), C_pp and C_mm of each joint."""
        return np.array(
            [*packed_line(rig, *self.line(rig, shape)), *edge_gains(rig, values, (0, 3))]
        )


@kernel
def _tank(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    if phase == PREPARE:
        bench[P_TANK] += par[0]
        if par[1] > 0.0:
            Q = _valve_flow(x, bench[P_TANK], -1.0, par[1], 0.0, par, False)
            bench[P_TANK] += par[1] * Q * Q


@dataclass(frozen=True)
class TankPressure(PortEffect):
    """The return pressure is p_t + p_back (Q / Q_pump)^2 instead of zero (Merritt 1967, chapter 3).

    The line's part is turbulent; Q is the flow that the valves return.
    """

    mechanism = "return_line"
    element = "tank"
    name = "tank_pressure"
    smallest_shape = (0.1e6, 0.0)  # [Pa]
    variable = "the pressure left across the edge to the tank"
    quantity = "pressure"
    confounders = ("supply_sag", "sensor_offset", "external_leakage")
    separated_by = (
        "motion at low chamber pressure, where the drop across the edge to the tank is small"
    )
    shape_stems = ("p_tank", "p_back")
    kernel = _tank

    def shapes(self, rig: Rig) -> tuple[Shape, ...]:
        """Return both [Pa]; `p_back`, at the whole flow of the pump, may be an extrapolation."""
        p = rig.supply.pressure
        return (
            Shape("p_tank", "Pa", 0.0, 0.5 * p, (0.02 * p, 0.1 * p), 0.0),
            Shape("p_back", "Pa", 0.0, 0.75 * p, (0.0, 0.05 * p), 0.0),
        )

    def prepare(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Signals:
        """Raise the tank pressure."""
        constant, back = self.full_shape(rig, shape)
        ratio = port_flow(rig, signals, drawn=False) / rig.supply.flow if back else 0.0
        return replace(signals, p_tank=signals.p_tank + constant + back * ratio**2)

    def pack(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> Array:
        """Return p_t, p_back / Q_pump^2, then C_mp and C_pm of each joint."""
        constant, back = self.full_shape(rig, shape)
        return np.array([constant, back / rig.supply.flow**2, *edge_gains(rig, values, (2, 1))])

    def problem(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> str:
        """Reject pressures at their bounds; the line's part may be zero."""
        constant, back = self.full_shape(rig, shape)
        if constant <= 1e-3 * rig.supply.pressure:
            also = "" if back <= constant else ": this is return_line"
            return f"p_tank = {constant:.4g} Pa is negligible{also}"
        # A part of zero is replaced by a value within its bounds.
        values_and_shapes = zip((constant, back), self.shapes(rig), strict=True)
        checked = (v if v > 1e-3 * s.high else s.grid[-1] for v, s in values_and_shapes)
        return self.outside(rig, tuple(checked))


@kernel
def _return_line(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    if phase == PREPARE and par[0] > 0.0:
        Q = _valve_flow(x, bench[P_TANK], -1.0, par[0], par[1], par, False)
        bench[P_TANK] += drop_and_slope(Q, par[0], par[1])[0]


@dataclass(frozen=True)
class ReturnLine(LineDrop):
    """The return pressure is its line's drop, dp r ((r^3 + r_t^3) / (1 + r_t^3))^(1/3).

    r = Q / Q_pump, and dp is the drop at the pump's whole flow. Laminar below the share r_t of the
    pump's flow, turbulent above (as `supply_sag`; Merritt 1967, chapter 3). A pressure at zero flow
    is `tank_pressure`.
    """

    name = "return_line"
    drawn = False
    powers = (2,)
    mechanism = "return_line"
    element = "tank"
    smallest_shape = (0.2e6,)  # [Pa] at the rated flow
    variable = "the flow returned to the tank"
    quantity = "flow returned"
    confounders = ("tank_pressure", "supply_sag")
    separated_by = "two amplitudes: a tank's own pressure stays the same, the line's grows"
    shape_stems = ("dp_return", "return_laminar")
    kernel = _return_line

    def shapes(self, rig: Rig) -> tuple[Shape, ...]:
        """Return the drop at the pump's whole flow [Pa], and r_t."""
        return (
            line_drop("dp_return", rig, (0.03, 0.15)),
            replace(transition_share("return_laminar", (0.5,)), detail=True),
        )

    def prepare(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Signals:
        """Raise the tank pressure."""
        dp, share = self.line(rig, shape)
        ratio = port_flow(rig, signals, self.drawn) / rig.supply.flow
        drop = line_loss(ratio, turbulent_part(dp, share), share)
        return replace(signals, p_tank=signals.p_tank + drop)

    def pack(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> Array:
        """Return the line (`packed_line`), C_mp and C_pm of each joint."""
        line = packed_line(rig, *self.line(rig, shape))
        return np.array([*line, *edge_gains(rig, values, (2, 1))])


def edge_gains(rig: Rig, values: Mapping[str, float], chosen: tuple[int, int]) -> list[float]:
    """Return each joint's gains of its two chosen edges, that of a positive spool first."""
    names = (gain_names(i) for i in range(1, len(rig.joints) + 1))
    return [values[joint[k]] for joint in names for k in chosen]


def in_every_flow(signals: Signals, variable: Array) -> dict[str, Array]:
    """Return a variable (n,) for every flow equation."""
    kinds = ("flow_cap", "flow_rod")
    return {equation(kind, i): variable for i in range(signals.joints) for kind in kinds}


@njit(cache=True, error_model="numpy")
def drop_and_slope(Q, turbulent, turning):  # type: ignore[no-untyped-def]
    """Return value and slope of turbulent Q (Q^3 + turning^3)^(1/3) for a flow Q >= 0."""
    inner = Q**3 + turning**3
    if inner <= 0.0:
        return 0.0, 0.0
    root = inner ** (1.0 / 3.0)
    return turbulent * Q * root, turbulent * (root + Q**3 / root**2)


@njit(cache=True)
def _lagged_drop(ratio, step, turbulent, share, capacity):  # type: ignore[no-untyped-def]
    # Between two samples the demand is linear and the time constant is constant.
    drop = np.zeros_like(ratio)
    flow, slope = ratio[0], 0.0
    for k in range(len(ratio)):
        if k and capacity > 0.0:
            lag = max(capacity * slope, 1e-9)
            decay = math.exp(-step / lag)
            rise = ratio[k] - ratio[k - 1]
            flow = ratio[k] - rise * (1 - decay) * lag / step + decay * (flow - ratio[k - 1])
        else:
            flow = ratio[k]
        loss, slope = drop_and_slope(flow, turbulent, share)
        drop[k] = max(loss, 0.0)
    return drop


@njit(cache=True, error_model="numpy")
def _valve_flow(x, level, sign, turbulent, turning, par, drawn):  # type: ignore[no-untyped-def]
    """Solve Q = sum C |u| sqrt(dp_i - drop(Q)) for the common flow Q [m^3/s], by Newton.

    dp_i is the pressure drop of each open edge at Q = 0. The right side falls as Q rises.
    """
    Q = 0.0
    for _ in range(NEWTON):
        drop, slope_drop = drop_and_slope(Q, turbulent, turning)
        flow, slope = 0.0, 0.0
        for i in range(x.shape[1]):
            u = x[U, i]
            at_cap = (u > 0.0) == drawn  # the cap's edge is the open one
            p = x[P_CAP, i] if at_cap else x[P_ROD, i]
            gain = par[2 + 2 * i] if u > 0.0 else par[3 + 2 * i]
            remaining = sign * (level - p) - drop
            if remaining > 0.0 and u != 0.0:
                root = gain * abs(u) * math.sqrt(remaining)
                flow += root
                slope -= 0.5 * root / remaining * slope_drop
        step = (flow - Q) / (1.0 - slope)
        Q = max(Q + step, 0.0)
        if abs(step) < 1e-10:
            break
    return Q


TERMS = (SupplySag, TankPressure, ReturnLine)
