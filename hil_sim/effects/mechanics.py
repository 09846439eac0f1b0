"""Effects on the arm: an inclined base, a payload, a spring, a constant or a periodic torque."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from hil_sim.effects.base import BenchEffect, JointEffect, Tables, in_unit
from rig.model.quantity import Angle, Frequency

Torque = Annotated[float, in_unit("N*m")]
Mass = Annotated[float, in_unit("kg")]
SpringRate = Annotated[float, in_unit("N*m/rad")]


class BaseInclination(BenchEffect):
    """The base tilts about the joints' axis; positive adds to the first angle."""

    sizes: ClassVar = {"angle": (0.017, 0.07)}
    signed = ("angle",)

    name: Literal["base_inclination"]
    angle: Angle

    def apply(self, t: Tables) -> None:
        t.bench["sin_slope"], t.bench["cos_slope"] = math.sin(self.angle), math.cos(self.angle)


class Payload(BenchEffect):
    """A mass at the tip of the last link."""

    sizes: ClassVar = {"mass": (0.5, 6.5)}

    name: Literal["payload"]
    mass: Mass = Field(gt=0)

    def apply(self, t: Tables) -> None:
        # A point mass at the tip: R_ij += m l_i l_j, W_i += m l_i.
        lengths = np.array([j.link_length for j in t.rig.joints])
        t.inertia[:] += self.mass * np.outer(lengths, lengths)
        t.joints["weight"] += self.mass * t.rig.gravity * lengths


class JointSpring(JointEffect):
    """A hose that pulls the joint back to `rest` (default: mid-stroke), hardening [1/rad^2]."""

    sizes: ClassVar = {"stiffness": (30.0, 150.0)}

    name: Literal["joint_spring"]
    stiffness: SpringRate = Field(gt=0)
    rest: Angle | None = None
    hardening: Annotated[float, in_unit("rad^-2")] = Field(default=0.25, ge=0)

    def apply(self, t: Tables) -> None:
        rest = self.rest
        if rest is None:
            rest = float(t.rig.joints[self.joint or 0].linkage.angle(0.0))
        t.joints["spring"][self.joint] = self.stiffness
        t.joints["spring_rest"][self.joint] = rest
        t.joints["spring_hardening"][self.joint] = self.hardening


class TorqueOffset(JointEffect):
    """A constant torque [N m], positive in the direction of a growing joint angle."""

    sizes: ClassVar = {"torque": (3.0, 15.0)}
    signed = ("torque",)

    name: Literal["torque_offset"]
    torque: Torque

    def apply(self, t: Tables) -> None:
        t.joints["torque_offset"][self.joint] += self.torque


class PeriodicDisturbance(JointEffect):
    """A torque of one frequency that begins with the joint's excitation.

    ``sine``, ``triangle``, or ``pulses``: a sine raised to its fifth power.
    """

    sizes: ClassVar = {"torque": (1.0, 6.0), "frequency": (2.0, 12.0)}
    name: Literal["periodic_disturbance"]
    torque: Torque = Field(gt=0)
    frequency: Frequency = Field(gt=0, le=200)
    form: Literal["sine", "triangle", "pulses"] = "sine"

    def apply(self, t: Tables) -> None:
        t.joints["wave_torque"][self.joint] = self.torque
        t.joints["wave_rate"][self.joint] = self.frequency
        t.joints["wave_form"][self.joint] = float(self.forms.index(self.form))
