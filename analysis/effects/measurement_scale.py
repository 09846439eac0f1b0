"""Errors of measurement in value: a sensor's gain, offset and cross-talk.

Source: y = gain x + offset, and for a chamber's pressure y = p + k times the other chamber's.

`where` is one channel, as `joint I cap|rod|piston|spool` (reported as `joint I`: the parameter's
name says which), and `bench` for the supply pressure. On an electric chain a gain is that of a
drive (`joint I drive`), whose motor constant may be wrong, and an offset that of an encoder (`joint
I position`); an offset of a drive is a `torque_offset`, one of the first encoder an inclined base.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from analysis.effects.base import Array, Effect, Shape
from analysis.effects.measurement import KINDS, Sensor, detail_of
from analysis.signals.conditioning import Signals
from rig.model import channels as ch
from rig.model.rig import Rig
from rig.model.units import plain


@dataclass(frozen=True)
class SensorCrosstalk(Sensor):
    """reading of one chamber's pressure = p + k times the other chamber's (electrical coupling)."""

    rescales = True
    name = "sensor_crosstalk"
    hydraulic = True
    exact = True
    smallest_shape = (0.01,)
    variable = "the other chamber's pressure"
    confounders = ("sensor_gain", "sensor_offset", "pressure_dependent_friction")
    separated_by = "loads at which one chamber's pressure changes and the other does not"
    shape_stems = ("crosstalk",)
    where: str = "joint 1 cap"

    @classmethod
    def all_places(cls, rig: Rig) -> tuple[str, ...]:
        """Return each chamber's pressure."""
        places = super().all_places(rig)
        return tuple(place for place in places if place.endswith(("cap", "rod")))

    def remark(self, rig: Rig, signals: Sequence[Signals], shape: Sequence[float]) -> str:
        """State the wrong area of the other chamber that has the same force."""
        cylinder, other = rig.joints[self.joint].cylinder, self._other_side
        areas = getattr(cylinder, f"{self.side}_area") / getattr(cylinder, f"{other}_area")
        return _same_force(other, 1.0 + self.shape_of(rig, shape)[0] * areas)

    @property
    def _other_side(self) -> str:
        """The other chamber of the cylinder."""
        return "rod" if self.side == "cap" else "cap"

    def shapes(self, rig: Rig) -> tuple[Shape, ...]:
        """Return the share k of the other pressure in the reading [-], up to three tenths."""
        return (Shape(self.shape_names()[0], "", -0.3, 0.3, (-0.06, -0.015, 0.015, 0.06), 0.0),)

    def prepare(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Signals:
        """Subtract the other chamber's share from the pressure and its rate."""
        share, i, other = self.shape_of(rig, shape)[0], self.joint, self._other_side
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
        other = ch.channel(KINDS[self._other_side], self.joint + 1)
        if self.channel in out and other in out:
            out[self.channel] = out[self.channel] - self.shape_of(rig, shape)[0] * out[other]
        return out


@dataclass(frozen=True)
class SensorGain(Sensor):
    """reading = gain x; of a pressure p reading = gain p (1 + bend (2 p/p_S - 1)).

    The bend is a detail of the form: a sensor whose characteristic is not straight. It is the
    relative error at the supply's pressure p_S, and there is none at half of it.
    """

    rescales = True
    name = "sensor_gain"
    exact = True
    smallest_shape = (1.01,)
    variable = "the channel itself"
    confounders = ("sensor_offset", "supply_sag", "tank_pressure", "pressure_dependent_friction")
    separated_by = "two amplitudes and two working points: an offset does not grow with either"

    @classmethod
    def all_places(cls, rig: Rig) -> tuple[str, ...]:
        """Return every channel that the model uses; of an electric chain the drives.

        All parameters of a single electric joint absorb the gain of its drive.
        """
        if not rig.electric:
            return super().all_places(rig)
        joints = range(1, len(rig.joints) + 1) if len(rig.joints) > 1 else ()
        return tuple(f"joint {i} drive" for i in joints)

    def alternatives_to_detail(self) -> tuple[Effect, ...]:
        """Return a pressure's offset: a sensor has one more often than it is bent."""
        return () if self.side == "drive" else (SensorOffset(self.where),)

    def absorbed(self, rig: Rig) -> str:
        """Return that the flow gains absorb a spool's gain."""
        return "the flow gains absorb a spool's gain completely" if self.side == "spool" else ""

    def remark(self, rig: Rig, signals: Sequence[Signals], shape: Sequence[float]) -> str:
        """State the wrong area, or the gain of the other pressures, with the same residual."""
        gain = self.shape_of(rig, shape)[0]
        if self.where == "bench":
            return (
                f"a gain of {plain(1.0 / gain, 4)} of all chamber sensors leaves the same residual;"
                " if they are wrong, masses, weights, viscous friction and b are "
                f"{plain(gain, 4)} times those given, flow gains {plain(gain**-0.5, 4)} times: "
                "compare a chamber's sensor with the supply's"
            )
        return _same_force(self.side, 1.0 / gain) if self.side in ("cap", "rod") else ""

    def shape_names(self) -> tuple[str, ...]:
        """Name the gain, and the bend of a pressure."""
        bend = (f"bend_{self.channel}",) if ch.unit_of(self.channel) == "Pa" else ()
        return (f"gain_{self.channel}", *bend)

    def shapes(self, rig: Rig) -> tuple[Shape, ...]:
        """Return reading over truth [-], 2/3 to 3/2, and the bend [-] of a pressure."""
        gain = Shape(self.shape_names()[0], "", 0.67, 1.5, (0.9, 0.98, 1.02, 1.1), 1.0)
        bends = self.shape_names()[1:]
        return (gain, *(Shape(n, "", -0.3, 0.3, (-0.03, 0.03), 0.0, detail=True) for n in bends))

    def undone(self, x: Array, order: int, rate: float, shape: Sequence[float]) -> Array:
        """Return x / gain."""
        return x / shape[0]

    def prepare(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Signals:
        """Undo gain and bend in the channel's signal and in its rate."""
        new, bend = super().prepare(rig, signals, shape), detail_of(shape)
        if bend == 0.0:
            return new
        supply = rig.supply.pressure
        if self.where == "bench":
            return replace(new, p_s=_linearised(new.p_s, bend, supply))
        p, pd = getattr(new, f"p_{self.side}").copy(), getattr(new, f"pd_{self.side}").copy()
        i = self.joint
        p[:, i] = _linearised(p[:, i], bend, supply)
        pd[:, i] /= 1.0 - bend + 4.0 * bend * p[:, i] / supply
        return replace(new, **{f"p_{self.side}": p, f"pd_{self.side}": pd})

    def correct(
        self, rig: Rig, channels: Mapping[str, Array], rate: float, shape: Sequence[float]
    ) -> dict[str, Array]:
        """Return the channels as a correct sensor would have sampled them, each (n,)."""
        out = super().correct(rig, channels, rate, shape)
        if detail_of(shape) and self.channel in out:
            out[self.channel] = _linearised(
                out[self.channel], detail_of(shape), rig.supply.pressure
            )
        return out


def _same_force(side: str, ratio: float) -> str:
    """Return the remark that an area `ratio` times the rig file's explains the same force."""
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

    name = "sensor_offset"
    exact = True
    variable = "nothing: it is constant"
    confounders = (
        "torque_offset",
        "sensor_gain",
        "base_inclination",
        "internal_leakage",
        "tank_pressure",
    )
    separated_by = "working points far apart: low and high pressure, both ends of the stroke"
    shape_stems = ("offset",)

    def shape_of_smallest_size(self) -> tuple[float, ...]:
        """Return the offset of interest of a pressure, piston or encoder, none of others."""
        kind = ch.kind_of(self.channel)[0]
        smallest: dict[str, tuple[float, ...]] = {
            ch.PISTON: (0.3e-3,), ch.POSITION: (2e-3,), ch.SPOOL: (), ch.TEMPERATURE: (),
        }  # fmt: skip
        return smallest.get(kind, (0.03e6,))

    def inseparable(self, shape: Sequence[float] = ()) -> tuple[tuple[str, str], ...]:
        """Return the null's offset for a spool: data cannot separate valve and sensor."""
        return (("spool_offset", self.place),) if self.side == "spool" else ()

    @classmethod
    def all_places(cls, rig: Rig) -> tuple[str, ...]:
        """Return every channel that the model uses but the spools, and a supply that is stated.

        Of an electric chain, the encoders of all joints but the first.
        """
        if rig.electric:
            return tuple(f"joint {i} position" for i in range(2, len(rig.joints) + 1))
        places = tuple(place for place in super().all_places(rig) if not place.endswith("spool"))
        return places if "bench" in places else (*places, "bench")

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

    def undone(self, x: Array, order: int, rate: float, shape: Sequence[float]) -> Array:
        """Return x - offset; derivatives as they are."""
        return x - shape[0] if order == 0 else x

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


def _linearised(y: Array, bend: float, supply: float) -> Array:
    """Return the pressure p (n,) [Pa] for which y (n,) [Pa] is p (1 + bend (2 p/p_S - 1)).

    `supply` is p_S [Pa]. Beyond the parabola's vertex, which only noise reaches, it is the vertex.
    """
    root = np.sqrt(np.maximum((1.0 - bend) ** 2 + 8.0 * bend * y / supply, 0.0))
    return np.asarray(2.0 * y / (1.0 - bend + root))


TERMS = (SensorGain, SensorOffset, SensorCrosstalk)
