"""Base of every kind of signal; a kind is one class in one module of `protocols.signals`."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, Self

from pydantic import Field, model_validator

from protocols.language.part import ProtocolPart
from protocols.language.waveforms import Waveform
from rig.model.quantity import Length, UnitError, Voltage, parse_quantity


class SignalKind(ProtocolPart):
    """A periodic command of one valve; a kind is recognised by its field `kind`.

    To add one: a subclass in a module of `protocols.signals` with ``kind: Literal["name"]``, its
    fields, and `waveform`.
    """

    kind: str

    @abstractmethod
    def waveform(self, sample_rate: float) -> Waveform:
        """Return one period; raises ValueError where it does not suit the sample rate."""

    @abstractmethod
    def scaled(self, factor: float) -> Self:
        """Return the signal with all its amplitudes multiplied."""

    def sized(self, gain: float, sample_rate: float) -> Waveform:
        """Return one period for a piston with `gain` [m/(s V)]."""
        return self.waveform(sample_rate)

    def reseeded(self, seed: int) -> Self:
        """Return the signal with another seed, where it has one."""
        return self


class AmplitudeSignal(SignalKind):
    """A signal with one amplitude: volts of command, or millimetres of piston to either side."""

    amplitude: Voltage = Field(
        default=0.0, gt=0, description="peak of the command [V], or of the piston's motion: '20 mm'"
    )
    travel: Length | None = Field(
        default=None, gt=0, description="peak of the piston's motion [m], instead of volts"
    )

    @property
    def volts(self) -> float:
        """The amplitude [V]; 1 V until a travel is converted (see `sized`)."""
        return self.amplitude if self.travel is None else 1.0

    @model_validator(mode="before")
    @classmethod
    def _amplitude_may_be_a_length(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            return data
        size = data.get("amplitude")
        if isinstance(size, str):
            try:
                parse_quantity(size, "V")
            except UnitError:
                try:
                    travel = parse_quantity(size, "m")
                except UnitError:
                    return data  # refused as a voltage, with the reason
                if "travel" in data:
                    raise ValueError("amplitude and travel both name a length; keep one") from None
                rest = {name: value for name, value in data.items() if name != "amplitude"}
                return {**rest, "travel": f"{travel!r} m"}
        return data

    @model_validator(mode="after")
    def _one_size(self) -> Self:
        named = {"amplitude", "travel"} & self.model_fields_set
        if not named:
            raise ValueError("amplitude is missing; expected volts of command or mm of piston")
        if self.travel is not None and "amplitude" in named:
            raise ValueError("amplitude and travel are both stated; expected one of them")
        return self

    def scaled(self, factor: float) -> Self:
        """Return the signal with its amplitude multiplied."""
        if self.travel is not None:
            return self.model_copy(update={"travel": factor * self.travel})
        return self.model_copy(update={"amplitude": factor * self.amplitude})

    def sized(self, gain: float, sample_rate: float) -> Waveform:
        """Return one period for a piston with `gain` [m/(s V)].

        For a travel s, the volts with which the integral of the command peaks at s / gain.
        """
        wave = self.waveform(sample_rate)
        if self.travel is None:
            return wave
        factor = self.travel / (gain * wave.travel(sample_rate))
        return Waveform(wave.samples * factor, wave.lines, wave.detection_lines)
