"""The law that commands must follow, computed independently from the interface's formula."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.base import Array, OutputLaw, SampleBlock
from drivers.conformance.watched import NotConforming
from rig.model import channels as ch
from rig.model.rig import Rig


@dataclass(frozen=True)
class Playing:
    """The law and waveform [V] of each joint, begun at tick `origin`."""

    laws: tuple[OutputLaw, ...]
    waves: tuple[Array, ...]
    origin: int = 0

    def volts(self, rig: Rig, ticks: NDArray[np.int64], data: Array) -> Array:
        """Return the commands [V] of the law at `ticks`, shape (n, joints)."""
        columns = []
        for joint, (law, wave) in enumerate(zip(self.laws, self.waves, strict=True)):
            command = law.gain * wave[(ticks - self.origin) % len(wave)] + law.bias
            if law.position_gain:
                at = data[:, rig.recorded.index(ch.channel(rig.position_kind, joint + 1))]
                command = command + law.position_gain * (law.setpoint - at)
            columns.append(np.clip(command, -law.limit, law.limit))
        return np.column_stack(columns)


def steps(rig: Rig) -> Array:
    """Return the step [V] of each joint's output converter, shape (joints,)."""
    valves = [joint.valve for joint in rig.joints]
    return np.array([v.command_range / ((1 << (v.command_bits - 1)) - 1) for v in valves])


def commands(block: SampleBlock, rig: Rig) -> Array:
    """Return the commands [V] in a block, shape (n, joints)."""
    return block.data[:, len(rig.channels) :]


def require_law(block: SampleBlock, playing: Playing, rig: Rig) -> None:
    """Require that every row of a block follows the law, to 1.1 steps of the converter."""
    ticks = block.tick + np.arange(len(block.data))
    wanted, measured = playing.volts(rig, ticks, block.data), commands(block, rig)
    near = np.abs(measured - wanted) <= 1.1 * steps(rig) + 1e-9  # NaN is never near
    wrong = np.flatnonzero(~near.all(axis=1))
    if len(wrong):
        row = int(wrong[0])
        raise NotConforming(
            f"at tick {ticks[row]} the commands are {in_volts(measured[row])}, "
            f"the law makes {in_volts(wanted[row])}"
        )


def in_volts(values: Array) -> str:
    """Return voltages of all joints as text."""
    return "(" + ", ".join(f"{value:.3f}" for value in values) + ") V"
