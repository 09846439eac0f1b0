"""Errors of measurement in time: a channel's delay and a sensor's lag.

Source: tau y' + y = x(t - delay), the first-order model of a sensor with a delay.

`where` is one channel, as `joint I cap|rod|piston|spool`, of an electric joint `joint I
position|drive`, and `bench` for the supply pressure; or all channels of a kind, as `bench
pressure|piston|spool|position|drive` (reported as `bench`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from analysis.effects.base import Array, Shape, between_samples, longest_lag
from analysis.effects.measurement import ELECTRIC, Sensor, detail_of
from analysis.signals.conditioning import Signals
from analysis.signals.filters import align, channel_filter
from analysis.terms.base import Used
from rig.model.rig import Rig

EQUAL_POLES: Final = 0.25  # of tau^2: two poles of the same time constant
ALIKE: Final = 0.1  # relative difference of times up to which they are taken to be equal
LATE: Final = {"piston", "pressure"}  # all channels of these kinds late: the spools are early
HALF: Final = 0.1  # [samples] error of half a sample
MARGIN: Final = 16  # [samples] reach of the interpolation of a shift


@dataclass(frozen=True)
class TimingError(Sensor):
    """Common parts of delays and lags, which may act on all channels of a kind."""

    @classmethod
    def all_places(cls, rig: Rig) -> tuple[str, ...]:
        """Return every channel, then all channels of a kind where there are several."""
        kinds: tuple[str, ...] = () if rig.electric else ("pressure",)
        if len(rig.joints) > 1:
            kinds = (*kinds, *(ELECTRIC if rig.electric else ("piston", "spool")))
        return (*super().all_places(rig), *(f"bench {kind}" for kind in kinds))

    def shapes(self, rig: Rig) -> tuple[Shape, ...]:
        """Return the delay or time constant [s]."""
        grid = (5e-4, 2e-3, 8e-3, 3e-2)
        return (Shape(self.shape_names()[0], "s", 0.0, longest_lag(rig), grid, 0.0),)

    def problem(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> str:
        """Reject a shape at its bounds, and an input's delay that sampling may cause."""
        is_input = not {"spool", "drive"}.isdisjoint((self.side, self.shared))
        artefact = between_samples(rig, self.shape_of(rig, shape)[0]) if is_input else ""
        return super().problem(rig, values, shape) or artefact

    def extrapolated(
        self, rig: Rig, signals: Sequence[Signals], shape: Sequence[float]
    ) -> dict[str, tuple[float, float]]:
        """Return the time [s] half a sample either way, of an electric joint alone.

        Between samples the current may be held, or follow a held command: its mean leads or lags
        the interpolated reading by up to that.
        """
        if not rig.electric:
            return {}
        value, half = self.shape_of(rig, shape)[0], 0.5 / rig.sample_rate
        return {self.shape_names()[0]: (max(value - half, 0.0), value + half)}

    def alike_together(self, rig: Rig) -> tuple[tuple[str, str], ...]:
        """Return the lag of both spools of a rig beside one time of all its pistons.

        A spool that lags its signal, as its command does in its place, makes the piston late.
        """
        both_late = self.shared == "piston" and len(rig.joints) == 2
        return (("spool_lag", "joint 1"), ("spool_lag", "joint 2")) if both_late else ()

    def inseparable_beside(
        self, rig: Rig, shape: Sequence[float], others: Sequence[Used]
    ) -> tuple[tuple[str, str], ...]:
        """Return the lags of all spools beside equal times of all pistons and all pressures.

        Only the order of the channels in time shows: all but the spools late are the spools early.
        """
        time = self.shape_of(rig, shape)[0]
        equal = [
            other.term.shared
            for other in others
            if isinstance(other.term, TimingError)
            and abs(other.term.shape_of(rig, other.shape)[0] - time) < ALIKE * time
        ]
        if self.shared not in LATE or not {self.shared, *equal} >= LATE:
            return ()
        return tuple(("spool_lag", f"joint {i}") for i in range(1, len(rig.joints) + 1))

    def usual_beside(
        self, rig: Rig, shape: Sequence[float], others: Sequence[Used]
    ) -> tuple[tuple[str, str], ...]:
        """Return the lags of all spools: of valves of one type whose command is recorded."""
        return self.inseparable_beside(rig, shape, others)

    def remark(self, rig: Rig, signals: Sequence[Signals], shape: Sequence[float]) -> str:
        """State that a position half a sample late may be a command that is held, and recorded so.

        A command that is recorded at the start of its hold leads its mean by half a sample.
        """
        samples = self.shape_of(rig, shape)[0] * rig.sample_rate
        late = "position" in (self.side, self.shared) and abs(samples - 0.5) < HALF
        if not late:
            return ""
        return (
            "half a sample late is also what a command makes that is held for a sample and "
            "recorded at its start; record the current, or the command in the middle of its hold"
        )

    def plotted(self) -> str:
        """Name the rate of the channel's quantity."""
        quantity = super().plotted()
        return "acceleration" if quantity == "velocity" else f"{quantity} rate"

    def _shown(self, x: Array, rate: float) -> Array:
        return np.gradient(x[:, self.joint]) * rate


@dataclass(frozen=True)
class ChannelDelay(TimingError):
    """reading(t) = x(t - delay), beyond the delay and skew that the rig file states."""

    name = "channel_delay"
    exact = True
    smallest_shape = (1e-3,)  # [s]
    variable = "the channel's rate"
    confounders = ("sensor_lag", "spool_lag", "entrained_air", "dead_volume")
    separated_by = (
        "a wide band: a delay turns the phase in proportion to frequency and leaves the amplitude"
    )
    shape_stems = ("delay",)

    def undone(self, x: Array, order: int, rate: float, shape: Sequence[float]) -> Array:
        """Return x(t + delay)."""
        return align(x, shape[0] * rate)

    def prepare(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Signals:
        """Advance the channel; samples interpolated beyond the record's end become invalid."""
        invalid = math.ceil(self.shape_of(rig, shape)[0] * signals.rate) + MARGIN
        valid = signals.valid.copy()
        valid[len(valid) - invalid :] = False
        return super().prepare(rig, replace(signals, valid=valid), shape)


@dataclass(frozen=True)
class SensorLag(TimingError):
    """tau d(reading)/dt + reading = x: a damped gauge line, an amplifier's filter.

    A detail of the form is a second pole: reading + tau d(reading)/dt + k tau^2 d2(reading)/dt2 = x
    with k = tau_1 tau_2 / (tau_1 + tau_2)^2 of the poles' time constants, at most 1/4.
    """

    name = "sensor_lag"
    amplifies = True
    smallest_shape = (1e-3,)  # [s]
    variable = "the channel's rate"
    confounders = ("channel_delay", "spool_lag", "dead_volume")
    separated_by = "a wide band: a lag loses amplitude at high frequencies, a delay only phase"
    shape_stems = ("lag", "second_pole")

    def shapes(self, rig: Rig) -> tuple[Shape, ...]:
        """Return the time constant [s] and the share k of the second pole [-]."""
        share = Shape(
            self.shape_names()[1], "", 0.0, EQUAL_POLES, (EQUAL_POLES,), 0.0,
            saturates=True, detail=True,
        )  # fmt: skip
        return (*super().shapes(rig), share)

    def undone(self, x: Array, order: int, rate: float, shape: Sequence[float]) -> Array:
        """Return x + tau dx/dt + k tau^2 d2x/dt2."""
        first = shape[0] * rate * np.gradient(x)
        second = detail_of(shape) * shape[0] * rate * np.gradient(first)
        return np.asarray(x + first + second)

    def true_channel(self, reading: Array, rate: float, shape: Sequence[float]) -> Array:
        """Return x + tau dx/dt + k tau^2 d2x/dt2, the rates those of the low-passed samples.

        Differences of raw samples would multiply their noise by about tau times the sample rate.
        """
        low_passed = channel_filter(rate)
        first = shape[0] * low_passed.apply(reading, 1)
        second = detail_of(shape) * shape[0] ** 2 * low_passed.apply(reading, 2)
        return np.asarray(reading + first + second)


TERMS = (ChannelDelay, SensorLag)
