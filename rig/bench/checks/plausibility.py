"""Plausibility: checks of the channels of a joint against each other, over a window.

Features are computed over overlapping windows of the latest samples, `hop` [s] apart. A finding is
reported when it lasts for `confirm` [s]. A window never extends across a change of roles or across
a gap that trips.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.base import SampleBlock
from rig.bench.checks import pressure_sensors
from rig.bench.checks.active_warnings import Key, key_of
from rig.bench.checks.bands import JointRole
from rig.bench.checks.expected_spool import ExpectedSpool
from rig.bench.checks.pressure_sensors import PressureFinding, SlowRows
from rig.bench.checks.single_sensor import SWING
from rig.bench.settings import GuardSettings
from rig.model import channels as ch
from rig.model.parts import converter_step
from rig.model.rig import Rig
from rig.model.trips import (
    ABOVE_SUPPLY,
    DRIFTS,
    EMPTY_CHAMBER,
    NOISY,
    NOT_FOLLOWING,
    NOTHING_MOVES,
    SENSOR_DRIFT,
    SUPPLY_LOST,
    SWAPPED,
    Violation,
)

Array = NDArray[np.float64]
Roles = Sequence[JointRole]

_NORMAL_MEDIAN = 0.6745  # median of |x| of a standard normal x
_THIRD_DIFFERENCE = math.sqrt(20.0)  # deviation of the third difference of white noise: 1 3 3 1
_SLOWEST_RATE = 400.0  # [Hz]; below it, the third difference of a motion is no longer small
_FEWEST = 20  # samples in a window


@dataclass(frozen=True)
class _Window:
    """Samples of a window, `data` (recorded, n) and `expected` spools (joints, n) [V].

    By channel, because numpy reduces rows much faster than columns. `least`, `most` and `mean` of
    each channel, (recorded,).
    """

    data: Array
    expected: Array
    least: list[float]
    most: list[float]
    mean: list[float]

    @classmethod
    def of(cls, data: Array, expected: Array) -> _Window:
        least, most = np.minimum.reduce(data, axis=1), np.maximum.reduce(data, axis=1)
        return cls(data, expected, least.tolist(), most.tolist(), _mean(data).tolist())

    def swing(self, column: int) -> float:
        """Return the peak-to-peak value of a channel."""
        return self.most[column] - self.least[column]

    def at_zero(self, column: int) -> bool:
        """Return whether every sample of a channel is zero."""
        return self.least[column] == 0.0 == self.most[column]


class Plausibility:
    """Checks windows of consecutive blocks."""

    def __init__(self, rig: Rig, settings: GuardSettings) -> None:
        self._rig = rig
        self._settings = settings
        rate = rig.sample_rate
        self._window = max(_FEWEST, round(settings.window * rate))
        self._hop = max(1, round(settings.hop * rate))
        self._confirm = round(settings.confirm * rate)
        self._expected = ExpectedSpool(rig)
        joints = range(1, len(rig.joints) + 1)

        def columns(kind: str) -> list[int]:
            return [rig.recorded.index(ch.channel(kind, i)) for i in joints]

        self._spools_at = np.array(columns(ch.SPOOL))
        self._commands_at = np.array(columns(ch.COMMAND))
        self._spool, self._piston = columns(ch.SPOOL), columns(ch.PISTON)
        self._cap, self._rod = columns(ch.CAP), columns(ch.ROD)
        self._command = columns(ch.COMMAND)
        self._supply = rig.recorded.index(ch.SUPPLY) if ch.SUPPLY in rig.recorded else None
        sensors = [rig.sensors.of(ch.kind_of(name)[0]) for name in rig.channels]
        codes = np.array([converter_step(s) for s in sensors])
        self._noise = np.maximum([s.noise for s in sensors], codes)
        self._spool_floor = [
            max(settings.spool_floor * joint.valve.spool_stroke, 5.0 * float(self._noise[column]))
            for joint, column in zip(rig.joints, self._spool, strict=True)
        ]
        # The noise of a channel's third difference, its median allowed, and that less rounding.
        self._noise_scale = _NORMAL_MEDIAN * _THIRD_DIFFERENCE
        self._noise_allowed = settings.noise * self._noise
        self._noise_bound = (self._noise_allowed * self._noise_scale * (1.0 - 1e-9))[:, None]
        self._slow = SlowRows(rate, len(rig.joints), settings.trend_span)
        slow_noise = self._noise[[self._cap[0], self._rod[0]]] / math.sqrt(self._slow.each)
        self._slow_noise = slow_noise.tolist()
        self._states = np.column_stack([self._piston, self._cap, self._rod, self._command])
        self.forget()

    def forget(self) -> None:
        """Reset: the next samples do not continue the previous ones."""
        self._new: list[Array] = []  # blocks for which the expected spools are not yet computed
        self._expected.forget()
        self.restart()

    def skip(self) -> None:
        """Continue after a few lost samples, with the spools at rest under their next command."""
        self._follow()
        self._expected.forget()
        self._slow.forget()

    def restart(self) -> None:
        """Begin a new window, because the joints' roles change."""
        self._follow()
        self._data: Array = np.empty((len(self._rig.recorded), 0))
        self._spools_expected: Array = np.empty((len(self._rig.joints), 0))
        self._since_look = 0
        self._slow.forget()
        self._pending: dict[Key, Violation] = {}

    def look(self, block: SampleBlock, roles: Roles) -> list[Violation] | None:
        """Take a block; return the confirmed violations, None if no window is due."""
        self._new.append(block.data)
        self._since_look += len(block.data)
        if self._since_look < self._hop:
            return None
        self._since_look = 0
        self._follow()
        if self._data.shape[1] < self._window:
            return None
        window = _Window.of(self._data, self._spools_expected)
        tick = block.tick + len(block.data) - 1
        violations = {key_of(v): v for v in self._findings(window, roles, tick)}
        self._pending = {key: self._pending.get(key, violations[key]) for key in violations}
        return [
            violations[key]
            for key, first in self._pending.items()
            if tick - first.tick >= self._confirm
        ]  # fmt: skip

    def _follow(self) -> None:
        """Compute the expected spools for all blocks since the last window."""
        if self._new:
            data = np.concatenate(self._new)
            self._new = []
            self._slow.add(data[:, self._states])
            expected = self._expected.follow(data[:, self._commands_at].T)
            self._data = _latest(self._window, self._data, data.T)
            self._spools_expected = _latest(self._window, self._spools_expected, expected)

    def _findings(self, window: _Window, roles: Roles, tick: int) -> Iterator[Violation]:
        def report(
            limit: str, column: int, value: float, allowed: tuple[float, float], unit: str = ""
        ) -> Violation:
            name = self._rig.recorded[column]
            joint = ch.kind_of(name)[1]
            return Violation(limit, value, allowed, unit or ch.unit_of(name), joint, name, tick)

        yield from self._spools(window, report)
        yield from self._pistons(window, roles, report)
        yield from self._pressures(window, roles, report)
        yield from self._sensors(window, roles, report)
        yield from self._noisy(window.data, report)

    def _spools(self, window: _Window, report: Callable[..., Violation]) -> Iterator[Violation]:
        settings, expected = self._settings, window.expected
        deviation = window.data[self._spools_at] - expected
        means = _mean(deviation)
        constants = means.tolist()
        moving = _mean(np.abs(deviation - means[:, None])).tolist()
        commanded = _mean(np.abs(expected - _mean(expected)[:, None])).tolist()
        for j, joint in enumerate(self._rig.joints):
            stroke = joint.valve.spool_stroke
            bound = max(settings.spool_share * commanded[j], self._spool_floor[j])
            if moving[j] > bound:
                yield report(NOT_FOLLOWING, self._spool[j], moving[j], (-math.inf, bound))
            elif abs(constants[j]) > settings.spool_constant * stroke:
                bound = settings.spool_constant * stroke
                yield report(NOT_FOLLOWING, self._spool[j], constants[j], (-bound, bound))

    def _pistons(
        self, window: _Window, roles: Roles, report: Callable[..., Violation]
    ) -> Iterator[Violation]:
        settings = self._settings
        for j, (joint, role) in enumerate(zip(self._rig.joints, roles, strict=True)):
            if role.locked:
                continue  # the tolerance of the lock covers it
            column = self._piston[j]
            swing = window.swing(column)
            still = settings.still_piston * float(self._noise[column])
            if self._within_stroke(window, j) and swing < still:
                opening = _mean(np.abs(window.data[self._spool[j]]))
                if opening > settings.open_spool * joint.valve.spool_stroke:
                    yield report(NOTHING_MOVES, column, swing, (still, math.inf))
            if window.at_zero(self._command[j]):
                piston = window.data[column]
                half = len(piston) // 2
                step = float(_mean(piston[half:]) - _mean(piston[:half]))
                speed = step * self._rig.sample_rate / (len(piston) - half)
                drift = settings.drift * joint.limits.speed
                if abs(speed) > drift:
                    yield report(DRIFTS, column, speed, (-drift, drift), "m/s")

    def _pressures(
        self, window: _Window, roles: Roles, report: Callable[..., Violation]
    ) -> Iterator[Violation]:
        settings, nominal = self._settings, self._rig.supply.pressure
        means, peaks = window.mean, window.most
        supply = nominal if self._supply is None else means[self._supply]
        top = settings.above_supply * max(supply, nominal)
        empty = settings.empty_chamber * nominal
        supply_lost = settings.supply_lost * nominal
        excited = any(role.excited for role in roles)
        if excited and self._supply is not None and peaks[self._supply] < supply_lost:
            yield report(SUPPLY_LOST, self._supply, supply, (supply_lost, math.inf))
        for j, (joint, role) in enumerate(zip(self._rig.joints, roles, strict=True)):
            swing = window.swing(self._command[j])
            driven = role.excited and swing > SWING * joint.limits.command
            for column in (self._cap[j], self._rod[j]):
                mean, peak = means[column], peaks[column]
                if mean > top:
                    yield report(ABOVE_SUPPLY, column, mean, (-math.inf, top))
                if driven and peak < empty:
                    yield report(EMPTY_CHAMBER, column, peak, (empty, math.inf))

    def _sensors(
        self, window: _Window, roles: Roles, report: Callable[..., Violation]
    ) -> Iterator[Violation]:
        def shown(limit: str, finding: PressureFinding) -> Violation:
            column = (self._cap if finding.cap else self._rod)[finding.joint]
            return report(limit, column, finding.value, finding.allowed)

        excited = [j for j, role in enumerate(roles) if role.excited]
        locked = [j for j, role in enumerate(roles) if role.locked]
        if len(excited) != 1 or len(excited) + len(locked) != len(roles):
            return  # a free joint loads the others by an unknown amount
        rig, settings, slow = self._rig, self._settings, self._slow
        rows = slow.last(settings.trend_span)
        if rows is not None:
            finding = pressure_sensors.drifting(rig, settings, excited[0], rows, slow.seconds)
            if finding is not None:
                yield shown(SENSOR_DRIFT, finding)
        rows = slow.last(settings.swing_span)
        if rows is None:
            return
        commands = rows[:, :, pressure_sensors.COMMAND]
        still_closed = [j for j in locked if not np.count_nonzero(commands[:, j])]
        closed = [j for j in still_closed if self._within_stroke(window, j)]
        for swap in pressure_sensors.swapped(rig, settings, closed, rows, self._slow_noise):
            yield shown(SWAPPED, swap)

    def _within_stroke(self, window: _Window, j: int) -> bool:
        reach = self._rig.joints[j].cylinder.stroke * (0.5 - self._settings.stroke_end)
        return -reach < window.least[self._piston[j]] and window.most[self._piston[j]] < reach

    def _noisy(self, data: Array, report: Callable[..., Violation]) -> Iterator[Violation]:
        """Estimate each channel's noise from its third difference, in which motion is small.

        The median over the window leaves out the few samples of a step or an impact.
        """
        if self._rig.sample_rate < _SLOWEST_RATE:
            return
        # All channels in one row, three times as fast; the last three samples of each are none.
        steps = data[: len(self._noise)].ravel()
        for _ in range(3):
            steps = steps[1:] - steps[:-1]
        size = np.empty((len(self._noise), data.shape[1]))
        np.abs(steps, out=size.ravel()[:-3])
        size[:, -3:] = 0.0
        # A median above a bound needs half of its samples there. Mostly all channels together have
        # fewer, so that no sorting is needed. NaN counts as above.
        above = size.size - np.count_nonzero(size <= self._noise_bound)
        if 2 * above < size.shape[1] - 3:
            return
        noise, allowed = np.median(size[:, :-3], axis=1) / self._noise_scale, self._noise_allowed
        for column in np.flatnonzero(noise > allowed).tolist():
            bound = float(allowed[column])
            yield report(NOISY, column, float(noise[column]), (-math.inf, bound))


def _mean(values: Array) -> Array:
    """Return the mean along the last axis, three times as fast as numpy's for few rows."""
    mean: Array = np.add.reduce(values, axis=-1) / values.shape[-1]
    return mean


def _latest(count: int, old: Array, new: Array) -> Array:
    """Return the last `count` columns of `old` and `new`, (rows, n) each; fewer if there are."""
    older = max(0, min(old.shape[1], count - new.shape[1]))
    joined = np.empty((len(old), older + min(new.shape[1], count)))
    joined[:, :older] = old[:, old.shape[1] - older :]
    joined[:, older:] = new[:, -count:]
    return joined
