"""A torque at one frequency, independent of the joint's motion."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from analysis.effects.base import Array, Effect, Evidence, Shape
from analysis.effects.mechanics import torque_limit
from analysis.signals.conditioning import Signals
from analysis.terms.base import (
    CONTRIBUTE,
    TIME,
    TORQUE,
    Coefficient,
    Columns,
    equation,
    kernel,
)
from rig.model.rig import Rig

FREQUENCY: Final = (0.5, 60.0)  # [Hz] slower is drift, faster does not pass the rows' filter
PEAKS: Final = 3  # of the residual's spectrum that a search begins at
BAND: Final = 0.4  # of the rows' rate: peaks above it come from the rows' filter
FINE: Final = 4  # points of the spectrum per 1 / record length


@kernel
def _wave(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    if phase == CONTRIBUTE:
        angle = par[3] * bench[TIME]
        out[TORQUE, int(par[0])] += par[1] * math.sin(angle) + par[2] * math.cos(angle)


@dataclass(frozen=True)
class PeriodicDisturbance(Effect):
    """Torque T_sin sin(2 pi f t) + T_cos cos(2 pi f t) on the joint, t since the record began.

    For example an eccentric, mains hum, or a controller's dither that begins with the record (one
    Fourier line). Where the phase differs between repeats, it is found in the differences between
    them; then its amplitude is reported, and no model or free run contains it.
    """

    mechanism = "disturbance"
    name = "periodic_disturbance"
    smallest_coefficients = (1.0, 0.0)  # [N m]
    family = "mechanics"
    variable = "time, at one frequency"
    quantity = "time"
    confounders = ("torque_offset", "joint_spring")
    separated_by = (
        "another excitation, which changes effects of the joint's motion but not this one"
    )
    by_data = True
    shape_stems = ("frequency",)
    kernel = _wave
    where: str = "joint 1"

    def _names(self) -> tuple[str, str]:
        return f"T_sin_{self.joint + 1}", f"T_cos_{self.joint + 1}"

    def coefficients(self, rig: Rig) -> tuple[Coefficient, ...]:
        """Return T_sin, T_cos [N m] (electric: N or N m)."""
        unit = str(getattr(rig.joints[self.joint], "force_unit", "N*m"))
        return tuple(Coefficient(name, unit, "mechanical") for name in self._names())

    def shapes(self, rig: Rig) -> tuple[Shape, ...]:
        """Return the frequency [Hz]."""
        return (Shape(self.shape_names()[0], "Hz", *FREQUENCY, (7.0,)),)

    def points(self, rig: Rig, evidence: Evidence) -> tuple[tuple[float, ...], ...]:
        """Return the frequencies of the largest residual in the joint's torque rows."""
        name = equation("torque", self.joint)
        parts = [record[name] for record in evidence.residuals if name in record]
        if not parts:
            return ()
        step = float(np.median(np.diff(parts[0][0])))
        length = max(float(time[-1] - time[0]) for time, _ in parts)
        high = min(FREQUENCY[1], BAND / step)
        samples = math.ceil(FINE * length / step)
        f = np.fft.rfftfreq(samples, step)
        total = np.zeros(len(f), dtype=complex)
        for time, residual in parts:
            uniform = np.zeros(samples)  # missing rows are zero
            uniform[np.rint((time - time[0]) / step).astype(int)] = residual
            total += np.exp(-2j * np.pi * f * time[0]) * np.fft.rfft(uniform)
        inside = (f >= max(FREQUENCY[0], 2.0 / length)) & (f < high)
        f, total = f[inside], total[inside]
        power = np.abs(total)
        inner = (power[1:-1] >= power[:-2]) & (power[1:-1] >= power[2:])
        peaks = 1 + np.flatnonzero(inner)
        return tuple((float(f[k]),) for k in peaks[np.argsort(-power[peaks])][:PEAKS])

    def columns(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Columns:
        """Return -sin and -cos: the disturbance is on the drive's side."""
        angle = 2 * np.pi * self.shape_of(rig, shape)[0] * signals.t
        waves = (-np.sin(angle), -np.cos(angle))
        return {equation("torque", self.joint): dict(zip(self._names(), waves, strict=True))}

    def pack(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> Array:
        """Return joint, T_sin, T_cos, 2 pi f."""
        linear = [values[name] for name in self._names()]
        return np.array([self.joint, *linear, 2 * np.pi * self.shape_of(rig, shape)[0]])

    def problem(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> str:
        """Reject more than half of the drive's torque, and a frequency at its bounds."""
        amplitude = math.hypot(*(values[name] for name in self._names()))
        limit = torque_limit(rig, self.joint)
        if not amplitude < limit:
            return f"an amplitude of {amplitude:.4g} N*m is not below {limit:.4g}"
        return self.outside(rig, shape)

    def abscissa(self, rig: Rig, signals: Signals) -> Mapping[str, Array]:
        """Return time [s]."""
        return {equation("torque", self.joint): signals.t}


TERMS = (PeriodicDisturbance,)
