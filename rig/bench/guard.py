"""Limits on every sample: which one was passed, by how much, where and when.

Glossary: a *role* is what one joint does now (excited, moving freely, locked) and decides which
piston limits hold; a *window* is the span over which a rate is taken; a *violation* is the first
sample, in device time, that a limit does not allow.

Rates are differences over the shortest window in which the sensor's own noise stays below a
tenth of the limit: |x[k] - x[k-w]| fs / w, 6 sqrt(2) sigma fs / w <= 0.1 limit. A block is
checked together with the tail of the one before it, so nothing falls between blocks.

A sensor is *frozen* when an excited joint's channel keeps one value over `frozen_after` while that
joint's command and another of its channels move. This cannot be a slow signal on a coarse
converter: only sensors whose stated noise is a code or more are judged. Even at rest, two samples
in a row of such a sensor read the same code with a probability of at most q / (2 sigma sqrt(pi)) <
0.29 (q: one code), 250 of them with 0.29^249. Noise four times smaller than stated would still need
a pressure or position constant to a code while the joint moves. What rests at an end of its range
is left to the check for saturation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.base import SampleBlock
from rig.model import channels as ch
from rig.model.rig import Rig
from rig.model.trips import DEVICE, FINITE, FROZEN, Violation

Array = NDArray[np.float64]
Counts = NDArray[np.int64]

_HUGE = float(np.finfo(np.float64).max)  # finite, so that an infinite sample still violates it
_VACUUM = -90e3  # no gauge pressure far below this exists, so none hides under such a range
_SWING = 0.05  # of the command's limit, peak to peak: such a command moves the joint
_MOVED = 12.0  # standard deviations, peak to peak: noise alone reaches some 7 in 250 samples
_STROKE_MARGIN = 0.02  # of the stroke: give of the end stop and offset of the sensor


@dataclass(frozen=True)
class JointRole:
    """What one joint does now.

    An `excited` joint keeps `limits.piston`; any other may touch the ends of its stroke. A locked
    one has `locked_at` [m] and may leave it by `tolerance` [m] at most.
    """

    excited: bool = False
    locked_at: float | None = None
    tolerance: float = math.inf


FREE = JointRole()
EXCITED = JointRole(excited=True)


@dataclass(frozen=True)
class GuardSettings:
    """Patience of the checks that no rig file states."""

    saturated_samples: int = 5  # so many in a row blind a channel
    saturated_samples_vacuum: int = 50  # cavitating oil rests at the low end, but with noise
    max_gap: float = 0.1  # [s] of device time without samples
    frozen_after: float = 0.25  # [s] of device time that a moving joint's sensor keeps one value
    stale_after: float | None = None  # [s] of wall time; default: the rig's watchdog


@dataclass(frozen=True)
class _Rate:
    """A bound on |x[k] - x[k-window]| of some columns."""

    limit: str
    columns: NDArray[np.intp]
    window: int
    bounds: Array


def rate_window(noise: float, limit: float, sample_rate: float) -> int:
    """Return the samples over which a rate is taken: the fewest that keep noise below limit/10."""
    return max(1, math.ceil(6.0 * math.sqrt(2.0) * noise * sample_rate / (0.1 * limit)))


def _rates(rig: Rig) -> tuple[_Rate, ...]:
    found: dict[tuple[str, int], list[tuple[int, float]]] = {}
    for column, name in enumerate(rig.channels):
        kind, joint = ch.kind_of(name)
        if joint is None or kind not in (ch.PISTON, ch.CAP, ch.ROD):
            continue
        limits = rig.joints[joint - 1].limits
        limit = limits.speed if kind == ch.PISTON else limits.pressure_rate
        window = rate_window(rig.sensors.of(kind).noise, limit, rig.sample_rate)
        what = "piston speed" if kind == ch.PISTON else "pressure rate"
        found.setdefault((what, window), []).append((column, limit))
    return tuple(
        _Rate(
            what,
            np.array([column for column, _ in entries]),
            window,
            np.array([limit for _, limit in entries]) * (window / rig.sample_rate),
        )
        for (what, window), entries in found.items()
    )


class _Frozen:
    """Finds a channel of one joint (0-based) that stands still while the joint moves."""

    def __init__(self, rig: Rig, joint: int) -> None:
        own = [(c, *ch.kind_of(name)) for c, name in enumerate(rig.channels)]
        parts = [(c, rig.sensors.of(kind)) for c, kind, which in own if which == joint + 1]
        self._columns = np.array([column for column, _ in parts])
        codes = np.array([np.ptp(s.range) / ((1 << s.bits) - 1) for _, s in parts])
        noise = np.array([s.noise for _, s in parts])
        self._judged = noise >= codes
        self._moved = _MOVED * np.maximum(noise, codes)
        self._low = np.array([s.range[0] for _, s in parts]) + codes
        self._high = np.array([s.range[1] for _, s in parts]) - codes
        self._command = rig.recorded.index(ch.channel(ch.COMMAND, joint + 1))
        self._swing = _SWING * rig.joints[joint].limits.command

    def find(self, window: Array) -> int | None:
        """Return the column that kept one value over a window of samples, None if none did."""
        values = window[:, self._columns]
        still = (values == values[0]).all(axis=0) & self._judged
        still &= (values[0] > self._low) & (values[0] < self._high)
        if not still.any() or np.ptp(window[:, self._command]) < self._swing:
            return None
        if not (np.ptp(values, axis=0) > self._moved).any():
            return None
        return int(self._columns[np.argmax(still)])


class Guard:
    """Checks blocks in the order of `Rig.recorded`; the first violation is what it returns."""

    def __init__(self, rig: Rig, settings: GuardSettings | None = None) -> None:
        self.rig = rig
        self.settings = settings or GuardSettings()
        self.stale_after = self.settings.stale_after or rig.wire.watchdog
        self._rates = _rates(rig)
        self._frozen = tuple(_Frozen(rig, j) for j in range(len(rig.joints)))
        self._window = max(2, round(self.settings.frozen_after * rig.sample_rate))
        self._keep = max((rate.window for rate in self._rates), default=0)
        self._keep = max(self._keep, self._window)
        self._allowed_run = self._saturation_patience()
        self.roles: tuple[JointRole, ...] = (FREE,) * len(rig.joints)
        self.set_roles(self.roles)
        self.forget()

    def _saturation_patience(self) -> tuple[Counts, Array]:
        """Return the allowed run per measured channel at (high end, low end), and mid-ranges."""
        counts, middles = [], []
        for name in self.rig.channels:
            kind, _ = ch.kind_of(name)
            low, high = self.rig.sensors.of(kind).range
            vacuum = kind in (ch.CAP, ch.ROD) and low <= _VACUUM
            usual = self.settings.saturated_samples
            counts.append((usual, self.settings.saturated_samples_vacuum if vacuum else usual))
            middles.append((low + high) / 2)
        return np.array(counts).T, np.array(middles)

    def forget(self) -> None:
        """Drop the tail of the previous block: what comes next does not continue it."""
        self._tail: Array = np.empty((0, len(self.rig.recorded)))
        self._runs: Counts = np.zeros(len(self.rig.channels), dtype=np.int64)

    def set_roles(self, roles: Sequence[JointRole]) -> None:
        """Say what each joint does from the next block on; raises ValueError for a wrong number."""
        joints = self.rig.joints
        if len(roles) != len(joints):
            raise ValueError(f"{len(roles)} roles given for {len(joints)} joints")
        self.roles = tuple(roles)
        low, high = [], []
        for name in self.rig.recorded:
            bottom, top = self._bounds(name)
            low.append(bottom)
            high.append(top)
        self._low, self._high = np.array(low), np.array(high)

    def _bounds(self, name: str) -> tuple[float, float]:
        kind, joint = ch.kind_of(name)
        if joint is None:
            limits = self.rig.limits
            shared = limits.supply_pressure if kind == ch.SUPPLY else limits.oil_temperature
            return shared or (-_HUGE, _HUGE)
        if kind == ch.SPOOL:
            return -_HUGE, _HUGE
        part = self.rig.joints[joint - 1]
        if kind == ch.COMMAND:  # the output converter may round up by a step
            step = part.valve.command_range / ((1 << (part.valve.command_bits - 1)) - 1)
            return -part.limits.command - step, part.limits.command + step
        if kind in (ch.CAP, ch.ROD):
            return part.limits.pressure
        _, low, high = piston_bounds(self.roles[joint - 1], self.rig, joint - 1)
        return low, high

    def gap(self, lost: int, tick: int) -> Violation | None:
        """Return the violation of `lost` missing samples before `tick`; rates start anew there."""
        self.forget()
        allowed = self.settings.max_gap
        seconds = lost / self.rig.sample_rate
        if seconds <= allowed:
            return None
        return Violation("sample gap", seconds, (-math.inf, allowed), "s", None, "", tick)

    def stale(self, age: float, tick: int) -> Violation | None:
        """Return the violation of data `age` [s] old by wall time (real-time mode only)."""
        if age <= self.stale_after:
            return None
        return Violation("stale data", age, (-math.inf, self.stale_after), "s", None, "", tick)

    def device_tripped(self, tick: int) -> Violation:
        """Return the violation of a device that has zeroed its own outputs."""
        return Violation(DEVICE, math.nan, (math.nan, math.nan), "", None, "", tick)

    def check(self, block: SampleBlock) -> Violation | None:
        """Return the first violation in a block that continues the previous one, or None."""
        data = block.data
        found: list[Violation] = []
        inside = (data >= self._low) & (data <= self._high)  # a NaN is never inside
        if not inside.all():
            row = int(np.argmin(inside.all(axis=1)))
            found.append(self._range_violation(block, row, int(np.argmin(inside[row]))))
        joined = np.concatenate((self._tail, data))
        for rate in self._rates:
            found += self._rate_violation(rate, joined, block.tick - len(self._tail))
        found += self._saturation(block)
        found += self._frozen_sensor(joined[-self._window :], block)
        self._tail = joined[-self._keep :]
        return min(found, key=lambda violation: violation.tick, default=None)

    def _range_violation(self, block: SampleBlock, row: int, column: int) -> Violation:
        name = self.rig.recorded[column]
        value = float(block.data[row, column])
        kind, joint = ch.kind_of(name)
        allowed = (float(self._low[column]), float(self._high[column]))
        if not math.isfinite(value):
            limit = FINITE
        elif kind == ch.PISTON and joint is not None:
            limit = piston_bounds(self.roles[joint - 1], self.rig, joint - 1)[0]
        elif joint is None:
            limit = "supply pressure" if kind == ch.SUPPLY else "oil temperature"
        else:
            limit = "command" if kind == ch.COMMAND else "pressure"
        return Violation(limit, value, allowed, ch.unit_of(name), joint, name, block.tick + row)

    def _frozen_sensor(self, window: Array, block: SampleBlock) -> list[Violation]:
        """Return the violation of an excited joint's channel that kept one value all the window."""
        if len(window) < self._window:
            return []
        for joint, (role, frozen) in enumerate(zip(self.roles, self._frozen, strict=True), 1):
            column = frozen.find(window) if role.excited else None
            if column is None:
                continue
            name = self.rig.recorded[column]
            value, tick = float(window[-1, column]), block.tick + len(block.data) - 1
            allowed = (-math.inf, self.settings.frozen_after)
            return [Violation(FROZEN, value, allowed, ch.unit_of(name), joint, name, tick)]
        return []

    def _rate_violation(self, rate: _Rate, joined: Array, first: int) -> list[Violation]:
        values = joined[:, rate.columns]
        with np.errstate(invalid="ignore"):  # inf - inf: the range check names it
            steps = values[rate.window :] - values[: -rate.window]
        over = np.abs(steps) > rate.bounds
        if not over.any():
            return []
        row = int(np.argmax(over.any(axis=1)))
        column = int(np.argmax(over[row]))
        name = self.rig.recorded[rate.columns[column]]
        per_second = self.rig.sample_rate / rate.window
        bound = float(rate.bounds[column]) * per_second
        value = float(steps[row, column]) * per_second
        joint = ch.kind_of(name)[1]
        unit = f"{ch.unit_of(name)}/s"
        tick = first + row + rate.window
        return [Violation(rate.limit, value, (-bound, bound), unit, joint, name, tick)]

    def _saturation(self, block: SampleBlock) -> list[Violation]:
        marks = block.saturated
        if not marks.any():
            self._runs[:] = 0
            return []
        rows = np.arange(len(marks))[:, None]
        # Length of the run of marks that ends at each row: rows since the last clear sample.
        clear = np.where(marks, -1, rows)
        last = np.maximum.accumulate(clear, axis=0)
        runs = np.where(last < 0, rows + 1 + self._runs, rows - last)
        (at_high, at_low), middle = self._allowed_run
        measured = block.data[:, : marks.shape[1]]
        allowed = np.where(measured > middle, at_high, at_low)
        over = runs >= allowed
        self._runs = runs[-1].astype(np.int64)
        if not over.any():
            return []
        row = int(np.argmax(over.any(axis=1)))
        column = int(np.argmax(over[row]))
        name = self.rig.channels[column]
        kind, joint = ch.kind_of(name)
        ends = self.rig.sensors.of(kind).range
        value = float(measured[row, column])
        tick = block.tick + row
        return [Violation("saturated sensor", value, ends, ch.unit_of(name), joint, name, tick)]


def piston_bounds(role: JointRole, rig: Rig, joint: int) -> tuple[str, float, float]:
    """Return (name of the limit, lowest, highest) of a joint's piston in its role."""
    part = rig.joints[joint]
    if role.locked_at is not None and math.isfinite(role.tolerance):
        return "lock", role.locked_at - role.tolerance, role.locked_at + role.tolerance
    if role.excited:
        return "piston", *part.limits.piston
    reach = part.cylinder.stroke * (0.5 + _STROKE_MARGIN)
    return "stroke end", -reach, reach
