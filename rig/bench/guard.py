"""The guard: checks every sample of every block against bands, rates, ranges and plausibility.

Glossary: the *role* of a joint (excited, free, locked) determines its piston limits; a *violation*
is the first sample, in device time, that a check does not allow. A violation that trips is
returned, and the bench zeroes its outputs; one that only warns is in `warnings` while it lasts.
The checks are modules of `rig.bench.checks`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.base import SampleBlock
from rig.bench.checks import bands
from rig.bench.checks.active_warnings import ActiveWarnings, Key
from rig.bench.checks.bands import EXCITED, FREE, JOGGED, JointRole, piston_bounds
from rig.bench.checks.catalogue import catalogue
from rig.bench.checks.plausibility import Plausibility
from rig.bench.checks.rates import rate_window, rates
from rig.bench.checks.recent import Recent
from rig.bench.checks.single_sensor import Frozen, Saturation
from rig.bench.settings import GuardSettings
from rig.model import channels as ch
from rig.model.rig import Rig
from rig.model.trips import DEVICE, FINITE, FROZEN, GAP, STALE, Violation

__all__ = [
    "EXCITED", "FREE", "JOGGED", "Guard", "GuardSettings", "JointRole", "piston_bounds",
    "rate_window",
]  # fmt: skip

Array = NDArray[np.float64]

# Checks whose action the rig file sets, by name (`rig.model.alarms.bands.CheckActions`).
ACTIONS: Final = {
    text.limit: text.key.removeprefix("checks.")
    for text in catalogue()
    if text.key.startswith("checks.")
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
        near = [rate.near for rate in self._rates]
        self._steady = np.minimum.reduce([np.full(len(rig.recorded), math.inf), *near])
        self._keep = max(self._rate_window, self._window)
        self._recent = Recent(len(rig.recorded), self._keep)
        self._saturation = Saturation(rig, self.settings)
        self._plausibility = Plausibility(rig, self.settings)
        warning, trip = bands.delays(rig, self.settings)
        self._outside_trip = bands.Delayed(trip)
        self._outside_warning = bands.Delayed(warning)
        self._active = ActiveWarnings(round(self.settings.return_after * rig.sample_rate))
        self.roles: tuple[JointRole, ...] = ()
        self.set_roles((FREE,) * len(rig.joints))
        self.forget()

    @property
    def warnings(self) -> Mapping[Key, Violation]:
        """The active warnings by key, each with its first violation."""
        return self._active.warnings

    def forget(self) -> None:
        """Reset: the next block does not continue the previous one."""
        self._recent.forget()
        self._unbroken = 0  # latest samples without a gap
        self._forget_outside()
        self._saturation.forget()
        self._plausibility.forget()

    def _forget_outside(self) -> None:
        self._outside_trip.forget()
        self._outside_warning.forget()
        self._calm = True  # no sample of the latest block was outside its band

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
        driven = [frozen.judged for r, frozen in zip(roles, self._frozen, strict=True) if r.driven]
        self._may_freeze = np.any(driven, axis=0) if driven else None
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
        self._active.add([longer(0.0)], tick)
        return None

    def stale(self, age: float, tick: int) -> Violation | None:
        """Return the violation of data that are `age` [s] old by wall time (real time only)."""
        if age > self.stale_after:
            return Violation(STALE, age, (-math.inf, self.stale_after), "s", None, "", tick)
        near = self.settings.stale_warning * self.stale_after
        if age > near:
            self._active.add([Violation(STALE, age, (-math.inf, near), "s", None, "", tick)], tick)
        return None

    def device_tripped(self, tick: int) -> Violation:
        """Return the violation of a device that has zeroed its own outputs."""
        return Violation(DEVICE, math.nan, (math.nan, math.nan), "", None, "", tick)

    def check(self, block: SampleBlock) -> Violation | None:
        """Check a block that continues the previous one; return the first violation that trips.

        Updates `warnings`.
        """
        data = block.data
        new, last = len(data), block.tick + len(data) - 1
        self._recent.add(data)
        self._unbroken = min(self._unbroken, self._keep) + new
        recent = self._recent.last(new + self._rate_window)
        least, most = np.minimum.reduce(recent, axis=0), np.maximum.reduce(recent, axis=0)
        trips: list[Violation] = []
        was_calm, self._calm = self._calm, self._tightest.contain(least, most)
        if not self._calm:  # few blocks
            trips += self._band_trips(block)
        elif not was_calm:
            self._forget_outside()
        if not (self._calm and np.count_nonzero(most - least <= self._steady) == len(most)):
            trips += self._rate_trips(new, last, least, most)
        trips += self._saturation.find(block)
        if self._may_freeze is not None:
            trips += self._frozen_sensors(last)
        findings = self._plausibility.look(block, self.roles)
        if findings:
            trips += self._act(findings, last)
        if not self._calm:
            self._band_warnings(block, last)
        if self._active.warnings:
            self._end_warnings(block, last)
        return min(trips, key=lambda violation: violation.tick) if trips else None

    def _rate_trips(self, new: int, last: int, least: Array, most: Array) -> list[Violation]:
        """Return the trips by rate in the latest `new` samples, which end at tick `last`.

        `least` and `most` (recorded,) are of these samples and bound every difference.
        """
        rows, trips = self._recent.last(self._unbroken), []
        first = last + 1 - len(rows)
        # inf - inf, which no calm block has; the check of bands reports the sample
        with nullcontext() if self._calm else np.errstate(invalid="ignore"):
            swing = most - least
            for rate in self._rates:
                if self._calm and np.count_nonzero(swing <= rate.near) == len(swing):
                    continue
                trip, near = rate.find(self.rig, rows, first, new)
                if trip is not None:
                    trips.append(trip)
                self._active.add(near, last)
        return trips

    def _act(self, violations: Sequence[Violation], last: int) -> list[Violation]:
        """Warn or trip as the rig file says; return the violations that trip."""
        self._active.add([v for v in violations if self._actions[v.limit] == "warn"], last)
        return [v for v in violations if self._actions[v.limit] == "trip"]

    def _band_trips(self, block: SampleBlock) -> list[Violation]:
        over = self._outside_trip.over(self._trip.outside(block.data))
        return [] if over is None else [self._of_band(block, *bands.first_of(over), self._trip)]

    def _band_warnings(self, block: SampleBlock, last: int) -> None:
        over = self._outside_warning.over(self._warn.outside(block.data))
        if over is not None:
            columns = np.flatnonzero(over.any(axis=0)).tolist()
            rows = [int(np.argmax(over[:, column])) for column in columns]
            pairs = zip(rows, columns, strict=True)
            self._active.add([self._of_band(block, r, c, self._warn) for r, c in pairs], last)

    def _end_warnings(self, block: SampleBlock, last: int) -> None:
        """End the warnings whose cause has been absent for long enough, with hysteresis."""
        outside = self._inner.outside(block.data).any(axis=0)
        for column in np.flatnonzero(outside).tolist():
            name = self.rig.recorded[column]
            self._active.keep(name, self._band_of(name), last)
        self._active.expire(last)

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

    def _frozen_sensors(self, last: int) -> list[Violation]:
        """Return the trip of a moved joint's channel that kept one value in the window."""
        window = self._recent.last(self._window)
        if len(window) < self._window:
            return []
        if not np.count_nonzero((window[0] == window[-1]) & self._may_freeze):
            return []  # mostly the first and last value differ, and no further check is needed
        for joint, (role, frozen) in enumerate(zip(self.roles, self._frozen, strict=True), 1):
            column = frozen.find(window, role.jogged) if role.driven else None
            if column is None:
                continue
            name = self.rig.recorded[column]
            frozen_sensor = Violation(
                FROZEN, float(window[-1, column]), (-math.inf, math.inf), ch.unit_of(name), joint,
                name, last, within=self.settings.frozen_after,
            )  # fmt: skip
            return self._act([frozen_sensor], last)
        return []
