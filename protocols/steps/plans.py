"""Steps in device terms: waveforms in samples at the rig's rate, joints counted from 0."""

from __future__ import annotations

import math
from dataclasses import dataclass

from protocols.language.waveforms import Waveform
from protocols.steps.parts import Excite

FIRM_SECONDS = 3.0  # at full amplitude under the firm loop, until its mean correction is known
LOOSEN_SECONDS = 8.0  # about the time to reduce that loop's gain, for the estimate only


@dataclass(frozen=True)
class LockPlan:
    """A joint (0-based) to be held; `piston` [m] is its position."""

    joint: int
    at: str
    piston: float
    tolerance: float


@dataclass(frozen=True)
class ExcitePlan:
    """A joint (0-based) to be moved by one waveform about a centre [m]."""

    joint: int
    wave: Waveform
    settings: Excite

    @property
    def centre(self) -> float:
        """The mean position of the piston [m]."""
        return self.settings.centre


@dataclass(frozen=True)
class StepPlan:
    """One step, lengths in samples.

    `period` is common to all its waveforms; `record`, `trial` (over which the bias is judged)
    and `warm_up` (under the slow loop) are multiples of it. `ramp` and `settle` are in seconds.
    `where` is its file and line, for refusals.
    """

    name: str
    locks: tuple[LockPlan, ...]
    excite: tuple[ExcitePlan, ...]
    repeats: int
    period: int
    record: int
    trial: int
    warm_up: int
    ramp: float
    settle: float
    where: str = ""

    @property
    def located(self) -> str:
        """Its name, after its file and line where they are known."""
        return f"{self.where}: {self.name}" if self.where else self.name

    @property
    def lines(self) -> tuple[int, ...]:
        """The lines that any joint excites, as multiples of 1 / the common period."""
        harmonics = {k * (self.period // e.wave.period) for e in self.excite for k in e.wave.lines}
        return tuple(sorted(harmonics))

    @property
    def tries(self) -> int:
        """How often to trim a bias, or repeat a disturbed record, before giving up."""
        return max(e.settings.centring.tries for e in self.excite)

    def samples(self, rate: float) -> int:
        """Samples from the start of the waveform to its end, if the second trim is good."""
        growing = (self.ramp + 1.5 * FIRM_SECONDS + LOOSEN_SECONDS) * rate
        settling = math.ceil(growing / self.period) * self.period + self.warm_up
        return settling + 2 * self.trial + self.repeats * self.record
