"""Steps of the command: on, off, on the other way, off."""

from __future__ import annotations

from typing import Literal, Self

import numpy as np
from pydantic import Field, model_validator

from protocols.language.signal import AmplitudeSignal
from protocols.language.waveforms import SMOOTH, Waveform, seconds_to_samples, shaped, smooth_edge
from rig.model.quantity import Time


class StepSignal(AmplitudeSignal):
    """+A for `width`, 0 for `rest`, -A for `width`, 0 for `rest`; edges last `edge` each.

    The mean is zero, so that the piston comes back. An edge is a raised cosine: a jump within one
    sample would cause shocks and excite frequencies above Nyquist.
    """

    kind: Literal["step"]
    width: Time = Field(gt=0, description="at full size, with one of its edges")
    rest: Time = Field(gt=0, description="at zero, with one edge")
    edge: Time = Field(default=0.1, gt=0, description="rise and fall")

    @model_validator(mode="after")
    def _edge_fits(self) -> Self:
        if self.edge >= min(self.width, self.rest):
            raise ValueError(
                f"edge {self.edge:g} s leaves nothing of width {self.width:g} s and "
                f"rest {self.rest:g} s; expected a shorter one"
            )
        return self

    def waveform(self, sample_rate: float) -> Waveform:
        """Return one period; raises ValueError where a time is not a whole number of samples."""
        width, rest, edge = (
            seconds_to_samples(getattr(self, name), sample_rate, name)
            for name in ("width", "rest", "edge")
        )
        rise = smooth_edge(edge)
        pulse = np.concatenate((rise, np.ones(width - edge), rise[::-1], np.zeros(rest - edge)))
        wave = np.concatenate((pulse, -pulse))
        return shaped(self.volts * wave, SMOOTH / self.edge, sample_rate)
