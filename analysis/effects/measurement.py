"""Sensor effects: common parts, and the signals that depend on a channel.

They transform the data, not the model: `prepare` undoes them in the signals, and the plant's
equations hold between the corrected signals. `correct` does the same to sampled channels, so that a
simulation is compared with the readings of a correct sensor.

`where` is `joint I cap|rod` for a chamber's pressure, `joint I piston|spool` for those sensors, of
an electric joint `joint I position|drive` (reported as `joint I`: the parameter's name says which),
and `bench` for the supply pressure. An effect on all channels of a kind has the place `bench
pressure|piston|spool|position|drive` (reported as `bench`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from analysis.effects.base import NO_KERNEL, SENSOR, Array, SignalEffect
from analysis.signals.conditioning import Signals
from analysis.terms.base import Used, equation
from rig.model import channels as ch
from rig.model.rig import Rig

HYDRAULIC: Final = {"cap": ch.CAP, "rod": ch.ROD, "piston": ch.PISTON, "spool": ch.SPOOL}
ELECTRIC: Final = {"position": ch.POSITION, "drive": ch.DRIVE}
KINDS: Final = {**HYDRAULIC, **ELECTRIC}


@dataclass(frozen=True)
class Sensor(SignalEffect):
    """Common parts of sensor effects: the channel, and the signals that follow from it."""

    mechanism = "sensor"
    element = "sensor"
    family = "measurement"
    stage = SENSOR
    kernel = NO_KERNEL
    where: str = "joint 1 piston"

    @property
    def shared(self) -> str:
        """The kind whose channels all have the error, as `pressure`; '' where it is one channel."""
        return self.where.removeprefix("bench").strip() if self.where.startswith("bench ") else ""

    @property
    def least_joints(self) -> int:
        """Return the least number of moving joints; with one, all pistons are that joint's."""
        return 2 if self.shared and self.shared != "pressure" else 1

    def each(self, rig: Rig) -> tuple[Sensor, ...]:
        """Return the effect at every channel of the kind `shared`."""
        sides = ("cap", "rod") if self.shared == "pressure" else (self.shared,)
        joints = range(1, len(rig.joints) + 1)
        return tuple(type(self)(f"joint {i} {side}") for i in joints for side in sides)

    @property
    def channel(self) -> str:
        """The channel's name; of all channels of a kind, the kind."""
        if self.shared:
            return self.shared
        if self.where == "bench":
            return ch.SUPPLY
        return ch.channel(KINDS[self.side], self.joint + 1)

    @property
    def suffix(self) -> str:
        """The end of its parameters' names: the channel's name."""
        return self.channel

    @classmethod
    def all_places(cls, rig: Rig) -> tuple[str, ...]:
        """Return every channel that the model uses."""
        joints, sides = range(1, len(rig.joints) + 1), ELECTRIC if rig.electric else HYDRAULIC
        measured = not rig.electric and rig.sensors.supply_pressure is not None
        supply = ("bench",) if measured else ()
        return (*(f"joint {i} {side}" for i in joints for side in sides), *supply)

    def pack(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> Array:
        """Return nothing."""
        return np.zeros(1)

    def undone(self, x: Array, order: int, rate: float, shape: Sequence[float]) -> Array:
        """Return the true derivative of an order (0, 1, 2) from that of the reading, x (n,)."""
        raise NotImplementedError

    def prepare(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Signals:
        """Undo the error in the channel's signal and in all that follows from it."""
        if self.shared:
            for channel in self.each(rig):
                signals = channel.prepare(rig, signals, self.shape_of(rig, shape))
            return signals
        shape = self.shape_of(rig, shape)
        if self.where == "bench":
            return replace(signals, p_s=self.undone(signals.p_s, 0, signals.rate, shape))
        if self.side == "piston":
            return self._moved(rig, signals, shape)
        if self.side == "position":
            return self._turned(signals, shape)
        fields = {"cap": ("p_cap", "pd_cap"), "rod": ("p_rod", "pd_rod")}
        new = {}
        for order, field in enumerate(fields.get(self.side, ("u",))):
            new[field] = getattr(signals, field).copy()
            x = new[field][:, self.joint]
            new[field][:, self.joint] = self.undone(x, order, signals.rate, shape)
        return replace(signals, **new)

    def _moved(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Signals:
        """Return the signals with a corrected piston, and its angles, Jacobian and volumes."""
        i, linkage = self.joint, rig.joints[self.joint].linkage
        names = ("s", "sd", "q", "qd", "qdd", "G", "V_cap", "V_rod")
        new = {name: getattr(signals, name).copy() for name in names}
        old_slope = np.asarray(linkage.jacobian_rate(signals.q[:, i]))
        acceleration = signals.G[:, i] * signals.qdd[:, i] + old_slope * signals.qd[:, i] ** 2
        rate = signals.rate
        s = self.undone(signals.s[:, i], 0, rate, shape)
        s = np.clip(s, *rig.joints[i].sensor_range)
        q, G, slope = linkage.geometry(s)
        sd = self.undone(signals.sd[:, i], 1, rate, shape)
        new["s"][:, i], new["sd"][:, i], new["q"][:, i], new["G"][:, i] = s, sd, q, G
        new["qd"][:, i] = sd / G
        sdd = self.undone(acceleration, 2, rate, shape)
        new["qdd"][:, i] = (sdd - slope * (sd / G) ** 2) / G
        volumes = rig.chamber_volumes(i, s)
        # Other effects may have added to the volumes.
        for field, corrected, read in zip(
            ("V_cap", "V_rod"), volumes, rig.chamber_volumes(i, signals.s[:, i]), strict=True
        ):
            new[field][:, i] += corrected - read
        turn = np.zeros_like(signals.theta)
        turn[:, i:] = (q - signals.q[:, i])[:, None]
        return replace(signals, theta=signals.theta + turn, **new)

    def _turned(self, signals: Signals, shape: Sequence[float]) -> Signals:
        """Return the signals with the position of an electric joint corrected."""
        i, new = self.joint, {}
        for order, names in enumerate((("s", "q"), ("sd", "qd"), ("qdd",))):
            x = self.undone(getattr(signals, names[-1])[:, i], order, signals.rate, shape)
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
            shape = self.shape_of(rig, shape)
            out[self.channel] = self.true_channel(out[self.channel], rate, shape)
        return out

    def true_channel(self, reading: Array, rate: float, shape: Sequence[float]) -> Array:
        """Return what the channel's samples (n,) would be without the error."""
        return self.undone(reading, 0, rate, shape)

    def plotted(self) -> str:
        """Name the channel's quantity, of a position its velocity."""
        names = {"spool": "spool", "drive": "drive", "piston": "velocity", "position": "velocity"}
        return names.get(self.shared or self.side, "pressure")

    def abscissa(self, rig: Rig, signals: Signals) -> Mapping[str, Array]:
        """Return the channel [its unit] (n,), in the rows that use it directly."""
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


def detail_of(shape: Sequence[float]) -> float:
    """Return the detail of the form in a sensor effect's shape, 0 where it has none."""
    return shape[1] if len(shape) > 1 else 0.0


def corrected_channels(
    rig: Rig, terms: Sequence[Used], channels: Mapping[str, Array], rate: float
) -> dict[str, Array]:
    """Return the sampled channels with every sensor effect of a model undone, each (n,)."""
    out = dict(channels)
    for used in terms:
        if isinstance(used.term, Sensor):
            out = used.term.correct(rig, out, rate, used.shape)
    return out
