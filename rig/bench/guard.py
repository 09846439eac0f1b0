"""The guard: checks every sample of every block against bands, rates, ranges and plausibility.

Glossary: the *role* of a joint (excited, free, locked) determines its piston limits; a *violation*
is the first sample, in device time, that a check does not allow. A violation that trips is
returned, and the bench zeroes its outputs; one that only warns is in `warnings` while it lasts.
The checks are modules of `rig.bench.checks`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.base import SampleBlock
from rig.bench.checks import bands
from rig.bench.checks.frozen import Frozen
from rig.bench.checks.plausibility import Plausibility
from rig.bench.checks.rates import rate_window, rates
from rig.bench.checks.roles import EXCITED, FREE, JointRole, piston_bounds
from rig.bench.checks.saturation import Saturation
from rig.bench.checks.settings import GuardSettings
from rig.bench.checks.standing import Key, Standing
from rig.model import channels as ch
from rig.model.rig import Rig
from rig.model.trips import (
    ABOVE_SUPPLY,
    DEVICE,
    DRIFTS,
    EMPTY_CHAMBER,
    FINITE,
    FROZEN,
    GAP,
    NOISY,
    NOT_FOLLOWING,
    NOTHING_MOVES,
    SENSOR_DRIFT,
    STALE,
    SUPPLY_LOST,
    SWAPPED,
    Violation,
)

__all__ = [
    "EXCITED", "FREE", "Guard", "GuardSettings", "JointRole", "piston_bounds", "rate_window",
]  # fmt: skip

Array = NDArray[np.float64]

# Checks whose action the rig file sets (`rig.model.alarms.bands.CheckActions`).
ACTIONS: Final = {
    FROZEN: "frozen_sensor",
    NOT_FOLLOWING: "spool_not_following",
    EMPTY_CHAMBER: "chamber_without_pressure",
    SUPPLY_LOST: "supply_lost",
    NOTHING_MOVES: "nothing_moves",
    ABOVE_SUPPLY: "pressure_above_supply",
    DRIFTS: "drift_at_rest",
    NOISY: "noisy_sensor",
    SWAPPED: "swapped_pressures",
    SENSOR_DRIFT: "drifting_pressure_sensor",
}


class Guard:
    """Checks blocks, with columns in the order of `Rig.recorded`; returns the first violation."""

    def __init__(self, rig: Rig, settings: GuardSettings | None = None) -> None:
        self.rig = rig
        self.settings = settings or GuardSettings()
        self.stale_after = self.settings.stale_after or rig.wire.watchdog
        self._actions = {limit: getattr(rig.alarms.checks, key) for limit, key in ACTIONS.items()}
        self._rates = rates(rig)
        self._frozen = tuple(Frozen(rig, j) for j in range(len(rig.joints)))
        self._window = max(2, round(self.settings.frozen_after * rig.sample_rate))
        self._rate_window = max((rate.window for rate in self._rates), default=0)
        bounds = [rate.bounds for rate in self._rates] or [np.full(len(rig.recorded), math.inf)]
        self._steady = rig.alarms.warning_share * np.minimum.reduce(bounds)
        self._keep = max(self._rate_window, self._window)
        self._saturation = Saturation(rig, self.settings)
        self._plausibility = Plausibility(rig, self.settings)
        warning, trip = bands.delays(rig, self.settings)
        self._outside_trip = bands.Delayed(trip)
        self._outside_warning = bands.Delayed(warning)
        self._standing = Standing(round(self.settings.return_after * rig.sample_rate))
        self.roles: tuple[JointRole, ...] = ()
        self.set_roles((FREE,) * len(rig.joints))
        self.forget()

    @property
    def warnings(self) -> Mapping[Key, Violation]:
        """The active warnings by key, each with its first violation."""
        return self._standing.warnings

    def forget(self) -> None:
        """Reset: the next block does not continue the previous one."""
        self._tail: Array = np.empty((0, len(self.rig.recorded)))
        self._unbroken = 0  # rows at the end of the tail without a gap
        for check in (self._saturation, self._outside_trip, self._outside_warning):
            check.forget()
        self._plausibility.forget()

    def set_roles(self, roles: Sequence[JointRole]) -> None:
        """Set the joints' roles from the next block on; raises ValueError for a wrong number."""
        joints = self.rig.joints
        if len(roles) != len(joints):
            raise ValueError(f"{len(roles)} roles given for {len(joints)} joints")
        if tuple(roles) == self.roles:
            return
        self.roles = tuple(roles)
        self._trip = bands.trip_bounds(self.rig, self.roles)
        self._warn = bands.warning_bounds(self.rig, self.roles, self.settings)
        self._inner = bands.inner_bounds(self.rig, self._warn, self.settings)
        self._tightest = self._trip.within(self._warn)
        excited = [
            frozen.judged for r, frozen in zip(roles, self._frozen, strict=True) if r.excited
        ]
        self._may_freeze = np.any(excited or [np.zeros(len(self.rig.recorded), bool)], axis=0)
        self._plausibility.restart()

    def gap(self, lost: int, tick: int) -> Violation | None:
        """Return the violation of `lost` missing samples before `tick`; rates restart there.

        A gap shorter than the limit is a warning, and windows continue across it: a polled device
        often loses single samples when the host is busy, and must still be checked.
        """
        allowed = self.settings.max_gap
        seconds = lost / self.rig.sample_rate

        def longer(than: float) -> Violation:
            return Violation(GAP, seconds, (-math.inf, than), "s", None, "", tick)

        if seconds > allowed:
            self.forget()
            return longer(allowed)
        self._unbroken = 0
        self._plausibility.skip()
        self._standing.see([longer(0.0)], tick)
        return None

    def stale(self, age: float, tick: int) -> Violation | None:
        """Return the violation of data that are `age` [s] old by wall time (real time only)."""
        if age > self.stale_after:
            return Violation(STALE, age, (-math.inf, self.stale_after), "s", None, "", tick)
        near = self.settings.stale_warning * self.stale_after
        if age > near:
            self._standing.see(
                [Violation(STALE, age, (-math.inf, near), "s", None, "", tick)], tick
            )
        return None

    def device_tripped(self, tick: int) -> Violation:
        """Return the violation of a device that has zeroed its own outputs."""
        return Violation(DEVICE, math.nan, (math.nan, math.nan), "", None, "", tick)

    def check(self, block: SampleBlock) -> Violation | None:
        """Check a block that continues the previous one; return the first violation that trips.

        Updates `warnings`.
        """
        data = block.data
        last = block.tick + len(data) - 1
        joined = np.concatenate((self._tail, data))
        recent = joined[-(len(data) + self._rate_window) :]
        least, most = np.minimum.reduce(recent, axis=0), np.maximum.reduce(recent, axis=0)
        calm = self._tightest.contain(least, most)  # true for almost every block
        trips = [self._band_trip(block, calm)]
        self._unbroken = min(self._unbroken, len(self._tail)) + len(data)
        # The range of the samples bounds every difference.
        if not (calm and np.count_nonzero(most - least <= self._steady) == len(self._steady)):
            with np.errstate(invalid="ignore"):  # inf - inf; the check of bands reports the sample
                trips += self._rate_trips(joined[-self._unbroken :], len(data), last)
        measured = data[:, : block.saturated.shape[1]]
        trips.append(self._saturation.find(block.saturated, measured, block.tick))
        trips += self._act(self._frozen_sensors(joined[-self._window :], last), last)
        trips += self._act(self._plausibility.look(block, self.roles) or (), last)
        self._band_warnings(block, last, calm)
        self._standing.expire(last)
        self._tail = joined[-self._keep :]
        violations = [violation for violation in trips if violation is not None]
        return min(violations, key=lambda violation: violation.tick, default=None)

    def _rate_trips(self, rows: Array, new: int, last: int) -> list[Violation | None]:
        """Return the trips by rate in the last `new` of `rows`, which end at tick `last`."""
        trips = []
        for rate in self._rates:
            first = last + 1 - len(rows)
            trip, near = rate.find(self.rig, rows, first, new, self.rig.alarms.warning_share)
            trips.append(trip)
            self._standing.see(near, last)
        return trips

    def _act(self, violations: Sequence[Violation], last: int) -> list[Violation]:
        """Warn or trip as the rig file says; return the violations that trip."""
        if not violations:
            return []
        self._standing.see([v for v in violations if self._actions[v.limit] == "warn"], last)
        return [v for v in violations if self._actions[v.limit] == "trip"]

    def _band_trip(self, block: SampleBlock, calm: bool) -> Violation | None:
        over = self._outside_trip.over(None if calm else self._trip.outside(block.data))
        if over is None:
            return None
        row, column = bands.first_of(over)
        return self._of_band(block, row, column, self._trip)

    def _band_warnings(self, block: SampleBlock, last: int, calm: bool) -> None:
        over = self._outside_warning.over(None if calm else self._warn.outside(block.data))
        if over is not None:
            columns = np.flatnonzero(over.any(axis=0)).tolist()
            rows = [int(np.argmax(over[:, column])) for column in columns]
            pairs = zip(rows, columns, strict=True)
            self._standing.see([self._of_band(block, r, c, self._warn) for r, c in pairs], last)
        if self._standing.warnings:
            outside = self._inner.outside(block.data).any(axis=0)
            for column in np.flatnonzero(outside).tolist():
                name = self.rig.recorded[column]
                self._standing.keep(name, self._band_of(name), last)

    def _band_of(self, name: str) -> str:
        """Return the name of a channel's limit for its joint's role."""
        kind, joint = ch.kind_of(name)
        if kind == ch.PISTON and joint is not None:
            return piston_bounds(self.roles[joint - 1], self.rig, joint - 1)[0]
        usual = {ch.SUPPLY: "supply pressure", ch.TEMPERATURE: "oil temperature", ch.SPOOL: "spool"}
        return usual.get(kind, "command" if kind == ch.COMMAND else "pressure")

    def _of_band(
        self, block: SampleBlock, row: int, column: int, bounds: bands.Bounds
    ) -> Violation:
        name = self.rig.recorded[column]
        value = float(block.data[row, column])
        limit = self._band_of(name) if math.isfinite(value) else FINITE
        joint = ch.kind_of(name)[1]
        tick = block.tick + row
        return Violation(limit, value, bounds.of(column), ch.unit_of(name), joint, name, tick)

    def _frozen_sensors(self, window: Array, last: int) -> list[Violation]:
        """Return the violation of an excited joint's channel that kept one value in the window."""
        if len(window) < self._window:
            return []
        if not np.count_nonzero((window[0] == window[-1]) & self._may_freeze):
            return []  # mostly the first and last value differ, and no further check is needed
        for joint, (role, frozen) in enumerate(zip(self.roles, self._frozen, strict=True), 1):
            column = frozen.find(window) if role.excited else None
            if column is None:
                continue
            name = self.rig.recorded[column]
            allowed = (-math.inf, self.settings.frozen_after)
            value = float(window[-1, column])
            return [Violation(FROZEN, value, allowed, ch.unit_of(name), joint, name, last)]
        return []
