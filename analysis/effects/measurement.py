"""Effects of measurement: delay or lag of a channel, wrong gain, offset, cross-talk.

They transform the data, not the model: `prepare` undoes them in the signals, and the plant's
equations hold between the corrected signals. `correct` does the same to sampled channels, so that a
simulation is compared with the readings of a correct sensor.

`where` is `joint I cap|rod` for a chamber's pressure, `joint I piston|spool` for those sensors, of
an electric joint `joint I position|drive` (reported as `joint I`: the parameter's name says which),
and `bench` for the supply pressure. An effect on all channels of a kind has the place `bench
pressure|piston|spool|position|drive` (reported as `bench`).
Source: each is the first-order model of a sensor, tau y' + y = gain x(t - delay) + offset.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Final

import numpy as np

from analysis.effects.base import (
    NO_KERNEL,
    SENSOR,
    Array,
    Effect,
    Shape,
    between_samples,
    longest_lag,
)
from analysis.signals.conditioning import Signals
from analysis.signals.filters import align
from analysis.terms.base import Coefficient, Columns, Kernel, Used, equation
from rig.model import channels as ch
from rig.model.rig import Rig
from rig.model.units import plain

HYDRAULIC: Final = {"cap": ch.CAP, "rod": ch.ROD, "piston": ch.PISTON, "spool": ch.SPOOL}
ELECTRIC: Final = {"position": ch.POSITION, "drive": ch.DRIVE}
KINDS: Final = {**HYDRAULIC, **ELECTRIC}
MARGIN: Final = 16  # [samples] that the interpolation of a shift reaches


@dataclass(frozen=True)
class Sensor(Effect):
    """Common parts of sensor effects: the channel, and the signals that follow from it."""

    mechanism: ClassVar[str] = "sensor"
    element: ClassVar[str] = "sensor"
    hydraulic: ClassVar[bool] = True
    family: ClassVar[str] = "measurement"
    stage: ClassVar[int] = SENSOR
    where: str = "joint 1 piston"

    @property
    def kernel(self) -> Kernel:
        """Return a kernel that does nothing: sensors do not act on the plant."""
        return NO_KERNEL

    @property
    def shared(self) -> str:
        """The kind of all channels that share it, as `pressure` or `piston`; none: ''."""
        return self.where.removeprefix("bench").strip() if self.where.startswith("bench ") else ""

    @property
    def least_joints(self) -> int:
        """Return how many joints must move; with one, all pistons are that joint's."""
        return 2 if self.shared and self.shared != "pressure" else 1

    def each(self, rig: Rig) -> tuple[Sensor, ...]:
        """Return the effect at every channel that shares it."""
        sides = ("cap", "rod") if self.shared == "pressure" else (self.shared,)
        joints = range(1, len(rig.joints) + 1)
        return tuple(type(self)(f"joint {i} {side}") for i in joints for side in sides)

    @property
    def channel(self) -> str:
        """The channel's name, or of several the kind."""
        if self.shared:
            return self.shared
        if self.where == "bench":
            return ch.SUPPLY
        return ch.channel(KINDS[self.side], self.joint + 1)

    @classmethod
    def all_places(cls, rig: Rig) -> tuple[str, ...]:
        """Return every channel that the model uses."""
        joints, sides = range(1, len(rig.joints) + 1), ELECTRIC if rig.electric else HYDRAULIC
        measured = not rig.electric and rig.sensors.supply_pressure is not None
        supply = ("bench",) if measured else ()
        return (*(f"joint {i} {side}" for i in joints for side in sides), *supply)

    def coefficients(self, rig: Rig) -> tuple[Coefficient, ...]:
        """Return nothing: a sensor's error is in every column."""
        return ()

    def columns(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Columns:
        """Return nothing."""
        return {}

    def pack(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> Array:
        """Return nothing."""
        return np.zeros(1)

    def undone(self, x: Array, order: int, rate: float, value: float) -> Array:
        """Return d^order/dt^order of the true quantity from that of the reading x (n,)."""
        raise NotImplementedError

    def prepare(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Signals:
        """Undo the error in the channel's signal and in all that follows from it."""
        if self.shared:
            for channel in self.each(rig):
                signals = channel.prepare(rig, signals, self.shape_of(rig, shape))
            return signals
        value = self.shape_of(rig, shape)[0]
        if self.where == "bench":
            return replace(signals, p_s=self.undone(signals.p_s, 0, signals.rate, value))
        if self.side == "piston":
            return self._moved(rig, signals, value)
        if self.side == "position":
            return self._turned(signals, value)
        fields = {"cap": ("p_cap", "pd_cap"), "rod": ("p_rod", "pd_rod")}
        new = {}
        for order, field in enumerate(fields.get(self.side, ("u",))):
            new[field] = getattr(signals, field).copy()
            x = new[field][:, self.joint]
            new[field][:, self.joint] = self.undone(x, order, signals.rate, value)
        return replace(signals, **new)

    def _moved(self, rig: Rig, signals: Signals, value: float) -> Signals:
        """Return the signals with another piston: angles, Jacobian and volumes follow."""
        i, linkage = self.joint, rig.joints[self.joint].linkage
        names = ("s", "sd", "q", "qd", "qdd", "G", "V_cap", "V_rod")
        new = {name: getattr(signals, name).copy() for name in names}
        old_slope = np.asarray(linkage.jacobian_rate(signals.q[:, i]))
        acceleration = signals.G[:, i] * signals.qdd[:, i] + old_slope * signals.qd[:, i] ** 2
        rate = signals.rate
        s = self.undone(signals.s[:, i], 0, rate, value)
        half = 0.55 * rig.joints[i].cylinder.stroke
        s = np.clip(s, -half, half)
        q, G, slope = linkage.geometry(s)
        sd = self.undone(signals.sd[:, i], 1, rate, value)
        new["s"][:, i], new["sd"][:, i], new["q"][:, i], new["G"][:, i] = s, sd, q, G
        new["qd"][:, i] = sd / G
        sdd = self.undone(acceleration, 2, rate, value)
        new["qdd"][:, i] = (sdd - slope * (sd / G) ** 2) / G
        volumes = rig.chamber_volumes(i, s)
        # Other effects may have added to the volumes.
        for field, now, before in zip(
            ("V_cap", "V_rod"), volumes, rig.chamber_volumes(i, signals.s[:, i]), strict=True
        ):
            new[field][:, i] += now - before
        turn = np.zeros_like(signals.theta)
        turn[:, i:] = (q - signals.q[:, i])[:, None]
        return replace(signals, theta=signals.theta + turn, **new)

    def _turned(self, signals: Signals, value: float) -> Signals:
        """Return the signals with another position of an electric joint."""
        i, new = self.joint, {}
        for order, names in enumerate((("s", "q"), ("sd", "qd"), ("qdd",))):
            x = self.undone(getattr(signals, names[-1])[:, i], order, signals.rate, value)
            for name in names:
                new[name] = getattr(signals, name).copy()
                new[name][:, i] = x
        turn = np.zeros_like(signals.theta)
        turn[:, i:] = (new["q"][:, i] - signals.q[:, i])[:, None]
        return replace(signals, theta=signals.theta + turn, **new)

    def correct(
        self, rig: Rig, channels: Mapping[str, Array], rate: float, shape: Sequence[float]
    ) -> dict[str, Array]:
        """Return the channels as a correct sensor would have sampled them, each (n,)."""
        out = dict(channels)
        for channel in self.each(rig) if self.shared else ():
            out = channel.correct(rig, out, rate, self.shape_of(rig, shape))
        if self.channel in out:
            value = self.shape_of(rig, shape)[0]
            out[self.channel] = self.undone(out[self.channel], 0, rate, value)
        return out

    def problem(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> str:
        """Reject a shape at its bounds."""
        return self.outside(rig, shape)

    def plotted(self) -> str:
        """Name the channel's quantity, of a position its velocity."""
        names = {"spool": "spool", "drive": "drive", "piston": "velocity", "position": "velocity"}
        return names.get(self.shared or self.side, "pressure")

    def abscissa(self, rig: Rig, signals: Signals) -> Mapping[str, Array]:
        """Return the channel, in the rows in which it occurs first."""
        if self.shared:
            parts = [channel.abscissa(rig, signals) for channel in self.each(rig)]
            return {name: x for channel in parts for name, x in channel.items()}
        if self.where == "bench":
            kinds = ("flow_cap", "flow_rod")
            joints = range(signals.joints)
            return {equation(kind, i): signals.p_s for kind in kinds for i in joints}
        i = self.joint
        if self.side in ELECTRIC:
            x = signals.u if self.side == "drive" else signals.sd
            return {equation("torque", i): self._shown(x, signals.rate)}
        flows = (equation("flow_cap", i), equation("flow_rod", i))
        if self.side == "spool":
            return dict.fromkeys(flows, self._shown(signals.u, signals.rate))
        if self.side == "piston":
            speed = self._shown(signals.sd, signals.rate)
            return dict.fromkeys((*flows, equation("torque", i)), speed)
        p = signals.p_cap if self.side == "cap" else signals.p_rod
        rows = (equation(f"flow_{self.side}", i), equation("torque", i))
        return dict.fromkeys(rows, self._shown(p, signals.rate))

    def _shown(self, x: Array, rate: float) -> Array:
        return x[:, self.joint]


@dataclass(frozen=True)
class Late(Sensor):
    """Common parts of delays and lags, which may act on all channels of a kind."""

    hydraulic: ClassVar[bool] = False

    @classmethod
    def all_places(cls, rig: Rig) -> tuple[str, ...]:
        """Return every channel, then all of a kind, where these are several."""
        kinds: tuple[str, ...] = () if rig.electric else ("pressure",)
        if len(rig.joints) > 1:
            kinds = (*kinds, *(ELECTRIC if rig.electric else ("piston", "spool")))
        return (*super().all_places(rig), *(f"bench {kind}" for kind in kinds))

    def shapes(self, rig: Rig) -> tuple[Shape, ...]:
        """Return the delay or time constant [s]."""
        grid = (5e-4, 2e-3, 8e-3, 3e-2)
        return (Shape(self.shape_names()[0], "s", 0.0, longest_lag(rig), grid, 0.0),)

    def problem(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> str:
        """Reject a shape at its bounds, and a delay of an input within its path between samples."""
        held = not {"spool", "drive"}.isdisjoint((self.side, self.shared))
        bent = between_samples(rig, self.shape_of(rig, shape)[0]) if held else ""
        return super().problem(rig, values, shape) or bent

    def plotted(self) -> str:
        """Name the rate of the channel's quantity."""
        quantity = super().plotted()
        return "acceleration" if quantity == "velocity" else f"{quantity} rate"

    def _shown(self, x: Array, rate: float) -> Array:
        return np.gradient(x[:, self.joint]) * rate


@dataclass(frozen=True)
class ChannelDelay(Late):
    """reading(t) = x(t - delay), beyond the delay and skew that the rig file states."""

    name: ClassVar[str] = "channel_delay"
    exact: ClassVar[bool] = True
    least_shape: ClassVar[tuple[float, ...]] = (1e-3,)  # [s]
    variable: ClassVar[str] = "the channel's rate"
    confounders: ClassVar[tuple[str, ...]] = (
        "sensor_lag",
        "spool_lag",
        "entrained_air",
        "dead_volume",
    )
    separated_by: ClassVar[str] = (
        "a wide band: a delay turns the phase in proportion to frequency and leaves the amplitude"
    )

    def shape_names(self) -> tuple[str, ...]:
        """Name the delay."""
        return (f"delay_{self.channel}",)

    def undone(self, x: Array, order: int, rate: float, value: float) -> Array:
        """Return x(t + delay)."""
        return align(x, value * rate)

    def prepare(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Signals:
        """Advance the channel; the samples that come from beyond the record's end are invalid."""
        lost = math.ceil(self.shape_of(rig, shape)[0] * signals.rate) + MARGIN
        valid = signals.valid.copy()
        valid[len(valid) - lost :] = False
        return super().prepare(rig, replace(signals, valid=valid), shape)


@dataclass(frozen=True)
class SensorLag(Late):
    """tau d(reading)/dt + reading = x: a damped gauge line, an amplifier's filter."""

    name: ClassVar[str] = "sensor_lag"
    amplifies: ClassVar[bool] = True
    least_shape: ClassVar[tuple[float, ...]] = (1e-3,)  # [s]
    variable: ClassVar[str] = "the channel's rate"
    confounders: ClassVar[tuple[str, ...]] = ("channel_delay", "spool_lag", "dead_volume")
    separated_by: ClassVar[str] = (
        "a wide band: a lag loses amplitude at high frequencies, a delay only phase"
    )

    def shape_names(self) -> tuple[str, ...]:
        """Name the time constant."""
        return (f"lag_{self.channel}",)

    def undone(self, x: Array, order: int, rate: float, value: float) -> Array:
        """Return x + tau dx/dt."""
        return np.asarray(x + value * rate * np.gradient(x))


@dataclass(frozen=True)
class SensorCrosstalk(Sensor):
    """reading of one chamber's pressure = p + k times the other chamber's (electrical coupling)."""

    rescales: ClassVar[bool] = True
    name: ClassVar[str] = "sensor_crosstalk"
    exact: ClassVar[bool] = True
    least_shape: ClassVar[tuple[float, ...]] = (0.01,)
    variable: ClassVar[str] = "the other chamber's pressure"
    confounders: ClassVar[tuple[str, ...]] = (
        "sensor_gain",
        "sensor_offset",
        "pressure_dependent_friction",
    )
    separated_by: ClassVar[str] = (
        "loads at which one chamber's pressure changes and the other does not"
    )
    where: str = "joint 1 cap"

    @classmethod
    def all_places(cls, rig: Rig) -> tuple[str, ...]:
        """Return each chamber's pressure."""
        places = super().all_places(rig)
        return tuple(place for place in places if place.endswith(("cap", "rod")))

    def remark(self, rig: Rig, signals: Sequence[Signals], shape: Sequence[float]) -> str:
        """State the wrong area of the other chamber that has the same force."""
        cylinder, other = rig.joints[self.joint].cylinder, self._other
        areas = getattr(cylinder, f"{self.side}_area") / getattr(cylinder, f"{other}_area")
        return _same_force(other, 1.0 + self.shape_of(rig, shape)[0] * areas)

    @property
    def _other(self) -> str:
        """The other chamber of the cylinder."""
        return "rod" if self.side == "cap" else "cap"

    def shape_names(self) -> tuple[str, ...]:
        """Name the share."""
        return (f"crosstalk_{self.channel}",)

    def shapes(self, rig: Rig) -> tuple[Shape, ...]:
        """Return the share of the other pressure that is seen [-], up to three tenths."""
        return (Shape(self.shape_names()[0], "", -0.3, 0.3, (-0.06, -0.015, 0.015, 0.06), 0.0),)

    def prepare(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Signals:
        """Subtract the other chamber's share from the pressure and its rate."""
        share, i, other = self.shape_of(rig, shape)[0], self.joint, self._other
        new = {}
        for field in ("p", "pd"):
            x = getattr(signals, f"{field}_{self.side}").copy()
            x[:, i] -= share * getattr(signals, f"{field}_{other}")[:, i]
            new[f"{field}_{self.side}"] = x
        return replace(signals, **new)

    def correct(
        self, rig: Rig, channels: Mapping[str, Array], rate: float, shape: Sequence[float]
    ) -> dict[str, Array]:
        """Return the channels as a correct sensor would have sampled them, each (n,)."""
        out = dict(channels)
        other = ch.channel(KINDS[self._other], self.joint + 1)
        if self.channel in out and other in out:
            out[self.channel] = out[self.channel] - self.shape_of(rig, shape)[0] * out[other]
        return out


@dataclass(frozen=True)
class SensorGain(Sensor):
    """reading = gain x; of a pressure p reading = gain p (1 + bend (2 p/p_S - 1)).

    The bend is a detail of the form: a sensor whose characteristic is not straight. It is the
    relative error at the supply's pressure p_S, and there is none at half of it.
    """

    rescales: ClassVar[bool] = True
    name: ClassVar[str] = "sensor_gain"
    exact: ClassVar[bool] = True
    least_shape: ClassVar[tuple[float, ...]] = (1.01,)
    variable: ClassVar[str] = "the channel itself"
    confounders: ClassVar[tuple[str, ...]] = (
        "sensor_offset",
        "supply_sag",
        "tank_pressure",
        "pressure_dependent_friction",
    )
    separated_by: ClassVar[str] = (
        "two amplitudes and two working points: an offset does not grow with either"
    )

    def absorbed(self, rig: Rig) -> str:
        """Return that the flow gains absorb a spool's gain."""
        return "the flow gains absorb a spool's gain completely" if self.side == "spool" else ""

    def remark(self, rig: Rig, signals: Sequence[Signals], shape: Sequence[float]) -> str:
        """State the wrong area of a chamber that has the same force."""
        if self.side not in ("cap", "rod"):
            return ""
        return _same_force(self.side, 1.0 / self.shape_of(rig, shape)[0])

    @property
    def _bends(self) -> bool:
        return ch.unit_of(self.channel) == "Pa"

    def shape_names(self) -> tuple[str, ...]:
        """Name the gain, and the bend of a pressure."""
        bend = (f"bend_{self.channel}",) if self._bends else ()
        return (f"gain_{self.channel}", *bend)

    def shapes(self, rig: Rig) -> tuple[Shape, ...]:
        """Return reading over truth [-], 2/3 to 3/2, and the bend [-] of a pressure."""
        gain = Shape(self.shape_names()[0], "", 0.67, 1.5, (0.9, 0.98, 1.02, 1.1), 1.0)
        bends = self.shape_names()[1:]
        return (gain, *(Shape(n, "", -0.3, 0.3, (-0.03, 0.03), 0.0, detail=True) for n in bends))

    def undone(self, x: Array, order: int, rate: float, value: float) -> Array:
        """Return x / gain."""
        return x / value

    def prepare(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Signals:
        """Undo gain and bend in the channel's signal and in its rate."""
        new, bend, supply = super().prepare(rig, signals, shape), _bend(shape), rig.supply.pressure
        if bend == 0.0:
            return new
        if self.where == "bench":
            return replace(new, p_s=_straight(new.p_s, bend, supply))
        p, pd = getattr(new, f"p_{self.side}").copy(), getattr(new, f"pd_{self.side}").copy()
        i = self.joint
        p[:, i] = _straight(p[:, i], bend, supply)
        pd[:, i] /= 1.0 - bend + 4.0 * bend * p[:, i] / supply
        return replace(new, **{f"p_{self.side}": p, f"pd_{self.side}": pd})

    def correct(
        self, rig: Rig, channels: Mapping[str, Array], rate: float, shape: Sequence[float]
    ) -> dict[str, Array]:
        """Return the channels as a correct sensor would have sampled them, each (n,)."""
        out = super().correct(rig, channels, rate, shape)
        if _bend(shape) and self.channel in out:
            out[self.channel] = _straight(out[self.channel], _bend(shape), rig.supply.pressure)
        return out


def _same_force(side: str, ratio: float) -> str:
    """Say that an area `ratio` times that of the rig file has the force of a sensor's error."""
    change = f"{plain(100.0 * abs(ratio - 1.0), 2)} % {'larger' if ratio > 1.0 else 'smaller'}"
    return (
        f"a {side} area {change} than the rig file's has the same force, and flow gains take up "
        "most of the rest: measure the cylinder too before the sensor is changed"
    )


@dataclass(frozen=True)
class SensorOffset(Sensor):
    """reading = x + offset, in the channel's unit.

    Of a spool's LVDT it is the same as the null's offset, and is listed under that name
    (`spool_offset`); it is a candidate for all other channels. Of a supply that no sensor measures
    it is the error of the pressure that the rig file states.
    """

    name: ClassVar[str] = "sensor_offset"
    exact: ClassVar[bool] = True
    variable: ClassVar[str] = "nothing: it is constant"
    confounders: ClassVar[tuple[str, ...]] = (
        "torque_offset",
        "sensor_gain",
        "base_inclination",
        "internal_leakage",
        "tank_pressure",
    )
    separated_by: ClassVar[str] = (
        "working points far apart: low and high pressure, both ends of the stroke"
    )

    def least_shapes(self) -> tuple[float, ...]:
        """Return the offset of interest of a pressure or a piston, none of other channels."""
        kind = ch.kind_of(self.channel)[0]
        return {ch.PISTON: (0.3e-3,), ch.SPOOL: (), ch.TEMPERATURE: ()}.get(kind, (0.03e6,))

    def inseparable(self) -> tuple[tuple[str, str], ...]:
        """Return the null's offset for a spool: data cannot separate valve and sensor."""
        return (("spool_offset", self.place),) if self.side == "spool" else ()

    @classmethod
    def all_places(cls, rig: Rig) -> tuple[str, ...]:
        """Return every channel that the model uses but the spools, and a supply that is stated."""
        places = tuple(place for place in super().all_places(rig) if not place.endswith("spool"))
        return places if rig.electric or "bench" in places else (*places, "bench")

    def shape_names(self) -> tuple[str, ...]:
        """Name the offset."""
        return (f"offset_{self.channel}",)

    def shapes(self, rig: Rig) -> tuple[Shape, ...]:
        """Return the offset, within a quarter of the sensor's span, or of a stated supply."""
        kind = ch.kind_of(self.channel)[0]
        if self._is_stated(rig):
            span = rig.supply.pressure
        else:
            low, high = rig.sensors.of(kind).range
            span = high - low
        grid = (-0.02 * span, -0.004 * span, 0.004 * span, 0.02 * span)
        unit = ch.unit_of(self.channel)
        return (Shape(self.shape_names()[0], unit, -0.25 * span, 0.25 * span, grid, 0.0),)

    def undone(self, x: Array, order: int, rate: float, value: float) -> Array:
        """Return x - offset; derivatives as they are."""
        return x - value if order == 0 else x

    def remark(self, rig: Rig, signals: Sequence[Signals], shape: Sequence[float]) -> str:
        """State the pressure of a supply that no sensor measures."""
        if not self._is_stated(rig):
            return ""
        pressure = (rig.supply.pressure - self.shape_of(rig, shape)[0]) / 1e6
        return (
            f"no sensor measures the supply; by these records its pressure is {pressure:.4g} MPa, "
            f"not the {rig.supply.pressure / 1e6:.4g} MPa of the rig file (`supply: pressure`)"
        )

    def _is_stated(self, rig: Rig) -> bool:
        """Return whether it is that of the supply's pressure, which the rig file states."""
        return self.where == "bench" and rig.sensors.supply_pressure is None


def _bend(shape: Sequence[float]) -> float:
    """Return the bend of a gain's shape, 0 where it has none."""
    return shape[1] if len(shape) > 1 else 0.0


def _straight(y: Array, bend: float, supply: float) -> Array:
    """Return the pressure p (n,) [Pa] for which y (n,) [Pa] is p (1 + bend (2 p/p_S - 1)).

    `supply` is p_S [Pa]. A value beyond the curve's turn, which is noise, is taken as its turn.
    """
    root = np.sqrt(np.maximum((1.0 - bend) ** 2 + 8.0 * bend * y / supply, 0.0))
    return np.asarray(2.0 * y / (1.0 - bend + root))


def corrected_channels(
    rig: Rig, terms: Sequence[Used], channels: Mapping[str, Array], rate: float
) -> dict[str, Array]:
    """Return the sampled channels with every sensor effect of a model undone, each (n,)."""
    out = dict(channels)
    for used in terms:
        if isinstance(used.term, Sensor):
            out = used.term.correct(rig, out, rate, used.shape)
    return out


TERMS = (ChannelDelay, SensorLag, SensorGain, SensorOffset, SensorCrosstalk)
