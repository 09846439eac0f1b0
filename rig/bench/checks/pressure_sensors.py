"""Pressure sensors against the physics of their cylinders: two exchanged plugs, a drifting sensor.

Closed cylinder. Behind a shut valve the oil is only compressed, dp_cap/dt = -b A_cap v / V_cap and
dp_rod/dt = b A_rod v / V_rod (Merritt, Hydraulic Control Systems, 3.1), so that the swings of both
pressures are in opposite phase and in the ratio A_cap V_rod / (A_rod V_cap), whatever b and v are.

Force. A_cap p_cap - A_rod p_rod is the load force, a function of position, speed and acceleration
while all other joints are locked. A part that grows with time alone is a sensor's drift.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rig.bench.settings import GuardSettings
from rig.model.rig import Rig

Array = NDArray[np.float64]

ROW_SECONDS = 0.02  # [s] over which samples are averaged for the slow part of the force
PISTON, CAP, ROD, COMMAND = range(4)
_SLIP = 0.1  # share of the largest speed, above which friction has the sign of the speed


@dataclass(frozen=True)
class PressureFinding:
    """A pressure sensor (index among `joints`, cap or rod), its value and the expected one."""

    joint: int
    cap: bool
    value: float
    allowed: tuple[float, float]


def swing_ratio(rig: Rig, joint: int, piston: float) -> float:
    """Return the ratio of cap to rod pressure amplitude of a closed cylinder.

    `joint` is 0-based, `piston` [m] its position.
    """
    part = rig.joints[joint].cylinder
    cap = part.cap_pipe_volume + part.cap_area * (0.5 * part.stroke + piston)
    rod = part.rod_pipe_volume + part.rod_area * (0.5 * part.stroke - piston)
    return part.cap_area * rod / (part.rod_area * cap)


def swapped(
    rig: Rig, settings: GuardSettings, closed: Sequence[int], rows: Array, noise: Sequence[float]
) -> Iterator[PressureFinding]:
    """Find sensors of closed cylinders that are exchanged with sensors of another joint.

    `closed`: joints (0-based) locked behind a shut valve. `rows`: as of `SlowRows.last`. `noise`
    (2,) [Pa]: of cap and rod pressure in `rows`. Reported only if a sensor does not fit its
    cylinder and one of another joint does.
    """
    x = _detrended(rows[:, :, CAP : ROD + 1])
    swings = np.sqrt(np.add.reduce(x * x, axis=0) / len(x)).tolist()
    others_far, others_near = settings.swing_factor, settings.swing_match
    for j in closed:
        expected = swing_ratio(rig, j, float(np.add.reduce(rows[:, j, PISTON]) / len(rows)))
        for side, ratio in ((0, expected), (1, 1.0 / expected)):
            swing, partner = swings[j][side], swings[j][1 - side]
            if min(swing / noise[side], partner / noise[1 - side]) < settings.swing_noise:
                continue
            fitting = ratio * partner
            if fitting / others_far <= swing <= fitting * others_far:
                continue
            for i in range(len(swings)):
                for k in range(2):
                    near = fitting / others_near <= swings[i][k] <= fitting * others_near
                    if i == j or not near:
                        continue
                    together = np.mean(x[:, i, k] * x[:, j, 1 - side]) / (swings[i][k] * partner)
                    if together < -settings.swing_phase:
                        bounds = fitting / others_far, fitting * others_far
                        yield PressureFinding(j, side == 0, swing, bounds)


def drifting(
    rig: Rig, settings: GuardSettings, joint: int, rows: Array, seconds: float
) -> PressureFinding | None:
    """Return the drifting pressure sensor of the only excited joint, others locked; None if none.

    `joint` is 0-based, `rows` as of `SlowRows.last`, `seconds` apart. `value` of the finding is the
    drift [Pa] over the rows. Needs a motion uncorrelated with time, a force with a trend in time,
    and that trend in one chamber alone.
    """
    part = rig.joints[joint].cylinder
    cap, rod = rows[2:-2, joint, CAP], rows[2:-2, joint, ROD]
    force = cap - part.rod_area / part.cap_area * rod
    bound = settings.trend * rig.supply.pressure
    time = np.arange(len(force)) / (len(force) - 1) - 0.5
    least_energy = settings.trend_alone * (time @ time)
    # The Cauchy-Schwarz bound of the trend; mostly it is small and no fit is needed.
    spread = force - np.add.reduce(force) / len(force)
    if spread @ spread < (1.0 - 1e-6) * bound**2 * least_energy:
        return None
    terms = _motion(rows[:, joint, PISTON], seconds)
    unexplained = time - terms @ _fit(terms, time)
    energy = unexplained @ unexplained
    if energy < least_energy:
        return None
    # The coefficient of time in a joint fit of motion and time (Frisch, Waugh 1933).
    trend = (unexplained @ force) / energy
    if abs(trend) < bound:
        return None
    residual = force - terms @ _fit(terms, force)
    explained = residual - unexplained * trend
    if residual @ residual < settings.trend_clear**2 * (explained @ explained):
        return None
    trends = np.array([unexplained @ cap, unexplained @ rod]) / energy
    size = np.abs(trends)
    side = int(np.argmax(size))
    if size[1 - side] > settings.trend_other * size[side]:
        return None
    return PressureFinding(joint, side == 0, float(trends[side]), (-bound, bound))


class SlowRows:
    """The latest samples of a bench, averaged over `ROW_SECONDS` to reduce noise."""

    def __init__(self, rate: float, joints: int, span: float) -> None:
        """Keep `span` [s] of samples at `rate` [Hz]."""
        self._joints = joints
        self.each = max(1, round(ROW_SECONDS * rate))
        self.seconds = self.each / rate
        self._most = round(span / self.seconds)
        self.forget()

    def forget(self) -> None:
        """Reset: the next samples do not continue the previous ones."""
        self._rows: Array = np.empty((0, self._joints, COMMAND + 1))
        self._begun: Array = self._rows

    def add(self, states: Array) -> None:
        """Add the next samples, (n, joints, 4): piston [m], cap and rod [Pa], command [V]."""
        samples = np.concatenate([self._begun, states]) if len(self._begun) else states
        complete = len(samples) // self.each * self.each
        self._begun = samples[complete:]
        groups = samples[:complete].reshape(-1, self.each, *samples.shape[1:])
        rows = np.add.reduce(groups, axis=1) / self.each
        np.maximum.reduce(np.abs(groups[:, :, :, COMMAND]), axis=1, out=rows[:, :, COMMAND])
        self._rows = np.concatenate([self._rows, rows])[-self._most :]

    def last(self, span: float) -> Array | None:
        """Return the rows of the last `span` [s], (rows, joints, 4); None if there are fewer.

        The command of a row is its largest magnitude.
        """
        count = round(span / self.seconds)
        return self._rows[-count:] if count <= len(self._rows) else None


def _motion(piston: Array, seconds: float) -> Array:
    """Return the regressors of a load force, (rows - 4, 5)."""
    speed = (piston[2:] - piston[:-2]) / (2.0 * seconds)
    acceleration = (speed[2:] - speed[:-2]) / (2.0 * seconds)
    speed, piston = speed[1:-1], piston[2:-2]
    sign = np.tanh(speed / max(_SLIP * float(np.abs(speed).max()), 1e-9))
    terms = np.column_stack([np.ones_like(piston), piston, speed, sign, acceleration])
    return np.asarray(terms / np.maximum(np.abs(terms).max(axis=0), 1e-12))


def _fit(terms: Array, values: Array) -> Array:
    return np.asarray(np.linalg.lstsq(terms, values, rcond=1e-9)[0], dtype=np.float64)


def _detrended(x: Array) -> Array:
    """Return columns without their linear trend, shape (n, ...)."""
    time = np.arange(len(x)) - 0.5 * (len(x) - 1)
    columns = x.reshape(len(x), -1)
    centred: Array = columns - np.add.reduce(columns, axis=0) / len(x)
    centred -= np.multiply.outer(time, time @ centred / (time @ time))
    return centred.reshape(x.shape)
