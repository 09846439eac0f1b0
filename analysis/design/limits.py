"""The share of each limit that an excitation uses, and a linear forecast for other spectra.

A share of 1 is at the limit. Limits are those of the rig file and, more strictly than in `check`,
those of usable records: chamber pressures between tank and supply, flow within the pump's. The
forecast uses the twin's response at each line (its best linear approximation, Pintelon and
Schoukens, ch. 3), one FFT per signal instead of a simulation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from analysis.design.settings import DESIGN
from analysis.design.twin_records import Array, Played, TwinStep
from rig.model.rig import Rig

Spectrum = NDArray[np.complex128]


@dataclass(frozen=True)
class Bound:
    """One signal (n,) of a joint and the range [SI] that it must stay within."""

    name: str
    joint: int
    signal: Array
    low: float
    high: float

    @property
    def share(self) -> float:
        """The largest deviation from the mean over that to the limit."""
        mean = float(np.mean(self.signal))
        if not self.low < mean < self.high:
            return float("inf")
        up, down = float(np.max(self.signal)) - mean, mean - float(np.min(self.signal))
        return max(up / (self.high - mean), down / (mean - self.low))


def bounds(rig: Rig, step: TwinStep, motion: Mapping[str, Array]) -> list[Bound]:
    """Return the signals of a step's motion on the twin with their limits."""
    out: list[Bound] = []
    demand = np.zeros(len(motion["piston"]))
    for j in step.waves:
        out += _joint_bounds(rig, step, motion, j)
        cylinder, speed = rig.joints[j].cylinder, motion["speed"][:, j]
        demand += np.where(speed > 0, cylinder.cap_area * speed, -cylinder.rod_area * speed)
        # Extending fills the cap side, retracting the rod side: the pump bounds the speed.
        least, most = -rig.supply.flow / cylinder.rod_area, rig.supply.flow / cylinder.cap_area
        out.append(Bound("pump flow", j, speed, least, most))
    if len(step.waves) > 1:
        # The flow is positive; with its mirror image appended its mean is zero like the others'.
        mirrored = np.append(demand, -demand)
        out.append(Bound("pump flow", -1, mirrored, -rig.supply.flow, rig.supply.flow))
    for j, tolerance in step.yields.items():
        piston, allowed = motion["piston"][:, j], DESIGN.lock_share * tolerance
        out.append(Bound("closed lock", j, piston - piston.mean(), -allowed, allowed))
    return out


def _joint_bounds(rig: Rig, step: TwinStep, motion: Mapping[str, Array], j: int) -> list[Bound]:
    joint = rig.joints[j]
    limits, valve = joint.limits, joint.valve
    piston = motion["piston"][:, j]
    offset = step.offsets.get(j, 0.0)
    centred = piston - piston.mean() + step.centres.get(j, 0.0)
    command = min(limits.command, valve.spool_stroke / valve.spool_gain)
    margin = DESIGN.pressure_margin * rig.supply.pressure
    floor = max(limits.pressure[0], margin)
    top = min(limits.pressure[1], rig.supply.pressure - margin)
    out = [
        Bound("piston", j, centred, limits.piston[0] + offset, limits.piston[1] - offset),
        Bound("speed", j, motion["speed"][:, j], -limits.speed, limits.speed),
        Bound("command", j, motion["command"][:, j], -command, command),
    ]
    if j in step.loops:
        looped = _under_loop(piston, motion["command"][:, j], step.loops[j], rig.sample_rate)
        out.append(replace(out[0], name="piston under the loop", signal=looped + centred.mean()))
    for chamber in ("cap_pressure", "rod_pressure"):
        pressure = motion[chamber][:, j]
        rate = np.gradient(pressure) * rig.sample_rate
        most = limits.pressure_rate
        out.append(Bound(chamber, j, pressure, floor, top))
        out.append(Bound(f"{chamber} rate", j, rate, -most, most))
    return out


def _under_loop(piston: Array, command: Array, loop: float, rate: float) -> Array:
    """Return a period (n,) of the piston, about zero, while a loop [V/m] centres it beforehand.

    With w_c = loop times the piston's speed per volt, a line is multiplied by j w / (j w + w_c).
    Slow lines shrink and phases change, so that peaks may grow.
    """
    n = len(piston)
    w = 2 * np.pi * np.fft.rfftfreq(n, 1.0 / rate)
    wave, position = np.fft.rfft(command), np.fft.rfft(piston)
    speed = 1j * w * position
    gain = np.real(np.vdot(wave[1:], speed[1:])) / np.real(np.vdot(wave[1:], wave[1:]))
    return np.fft.irfft(position * 1j * w / (1j * w + max(gain, 0.0) * loop + 1e-12), n)


def tightest_limit(rig: Rig, played: Played) -> tuple[float, str]:
    """Return the largest share of any limit, and that limit's name."""
    worst = max(bounds(rig, played.step, played.motion), key=lambda b: b.share)
    where = "bench" if worst.joint < 0 else f"joint {worst.joint + 1}"
    return worst.share, f"{played.step.name} {where} {worst.name}"


@dataclass(frozen=True)
class LimitForecast:
    """The linear response of every bounded signal to one joint's command, about its mean.

    `lines` (k,) are the known lines, `responses` (b, k), `low` and `high` (b,) how far below and
    above its mean each signal may go; `n` samples per period.
    """

    n: int
    lines: NDArray[np.int64]
    responses: Spectrum
    low: Array
    high: Array

    def motion(self, spectrum: Spectrum) -> Array:
        """Return one period of each bounded signal about its mean, (b, n)."""
        full = np.zeros((len(self.low), self.n // 2 + 1), dtype=np.complex128)
        full[:, self.lines] = self.responses * spectrum * (self.n / 2.0)
        return np.asarray(np.fft.irfft(full, self.n, axis=1))

    def shares(self, motion: Array) -> Array:
        """Return the share (b,) of its limit that each signal uses."""
        return np.asarray(
            np.maximum(motion.max(axis=1) / self.high, -motion.min(axis=1) / self.low)
        )

    def flattened(self, spectrum: Spectrum, rounds: int) -> tuple[Spectrum, float]:
        """Return the spectrum with the phases of the lowest largest share found, and that share.

        The worst signal is clipped and the phases of the result are used: time-frequency swapping
        (Van der Ouderaa, Schoukens and Renneboog 1988), for whichever signal is worst.
        """
        best, lowest = spectrum, float("inf")
        size = np.abs(spectrum)
        for _ in range(rounds):
            motion = self.motion(spectrum)
            shares = self.shares(motion)
            worst = int(np.argmax(shares))
            if shares[worst] < lowest:
                best, lowest = spectrum, float(shares[worst])
            level = DESIGN.peak_clip * shares[worst]
            clipped = np.clip(motion[worst], -level * self.low[worst], level * self.high[worst])
            swapped = np.fft.rfft(clipped)[self.lines]
            response = self.responses[worst]
            response = np.where(np.abs(response) > 0, response, 1.0)
            spectrum = size * np.exp(1j * np.angle(swapped / response))
        return best, lowest


def forecast_of(rig: Rig, played: Played, joint: int, lines: NDArray[np.int64]) -> LimitForecast:
    """Measure the responses at the lines that are excited and interpolate them to the others."""
    n = played.step.period
    command = np.fft.rfft(played.motion["command"][-n:, joint])
    excited = lines[np.abs(command[lines]) > 1e-6 * np.abs(command[lines]).max()]
    responses, low, high = [], [], []
    for bound in bounds(rig, played.step, played.motion):
        if bound.joint < 0 or not bound.low < bound.signal.mean() < bound.high:
            continue
        response = np.fft.rfft(bound.signal[-n:])[excited] / command[excited]
        responses.append(
            np.interp(lines, excited, response.real) + 1j * np.interp(lines, excited, response.imag)
        )
        low.append(bound.signal.mean() - bound.low)
        high.append(bound.high - bound.signal.mean())
    return LimitForecast(n, lines, np.array(responses), np.array(low), np.array(high))
