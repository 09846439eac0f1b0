"""A planned step simulated on the twin: its noise-free record.

A lock at an end stop holds a joint, but one by a closed valve is a spring of oil that yields under
load (2 mm on the seed bench), and this motion carries information. So only joints at an end stop
are held here; a closed valve is simulated.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from analysis.design.settings import DESIGN
from analysis.regression.identifiability import twin_channels
from analysis.simulation.twin import simulate_commands
from rig.model.parse import InputError
from rig.model.records import Record
from rig.model.rig import Rig

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TwinStep:
    """One step in device terms, joints 0-based.

    `waves` maps an excited joint to one period of its command [V] (all the same length), `lines`
    are multiples of 1/period; `held` maps a joint at an end stop, `closed` one behind a closed
    valve, to its piston position [m]; `centres` and `biases` [V] belong to the excited joints;
    `samples` are those of one record. A closed joint may yield by `yields` [m]; an excited one is
    centred to within `offsets` [m], by a loop of `loops` [V/m] before the records; `strokes` are
    the piston positions [m] it starts from, if not its centres. `where` is its file and line as
    `FILE:LINE`, for refusals; empty for a step of no file.
    """

    name: str
    waves: Mapping[int, Array]
    lines: tuple[int, ...]
    held: Mapping[int, float]
    closed: Mapping[int, float]
    centres: Mapping[int, float]
    biases: Mapping[int, float]
    samples: int
    repeats: int
    strokes: Mapping[int, float] = field(default_factory=dict)
    yields: Mapping[int, float] = field(default_factory=dict)
    offsets: Mapping[int, float] = field(default_factory=dict)
    loops: Mapping[int, float] = field(default_factory=dict)
    where: str = ""

    @property
    def located(self) -> str:
        """Its name, after its file and line where they are known."""
        return f"{f'{self.where}: ' if self.where else ''}step {self.name!r}"

    @property
    def period(self) -> int:
        """Samples until all waveforms start again."""
        return len(next(iter(self.waves.values())))

    @property
    def locked(self) -> tuple[int, ...]:
        """The locked joints, 1-based as in records."""
        return tuple(sorted(j + 1 for j in (*self.held, *self.closed)))


@dataclass(frozen=True)
class Played:
    """The twin's simulation of a step: noise-free `record`, the step with trimmed biases, motion.

    `motion` holds the twin's signals within the record, (samples, N) each, by the names of
    `twin.simulate_commands`, and `command` [V]; `gains` [m/(s V)] are the excited pistons' gains
    from their commands, as the bench will measure them to centre the pistons.
    """

    step: TwinStep
    record: Record
    motion: Mapping[str, Array]
    gains: Mapping[int, float]


def ideal(rig: Rig) -> Rig:
    """Return the rig with channels sampled at the tick: the twin has no multiplexer."""
    sensors = rig.sensors
    parts = {
        name: part.model_copy(update={"delay": 0.0})
        for name in type(sensors).model_fields
        if hasattr(part := getattr(sensors, name), "delay")
    }
    return rig.model_copy(update={"sensors": sensors.model_copy(update={**parts, "skew": 0.0})})


def play(rig: Rig, step: TwinStep) -> Played:
    """Simulate a step on the twin, trimming the biases until the pistons stay centred.

    Raises InputError where the twin's simulation fails or a piston cannot be centred.
    """
    for attempt in range(DESIGN.trims):
        commands, start, lead = _commands(rig, step)
        simulated = simulate_commands(rig, commands, start, _held_positions(rig, step))
        valid = simulated["valid"] > 0
        count = len(valid) if valid.all() else int(np.argmin(valid))
        step, steady, gains = _trimmed(rig, step, commands, simulated["piston"], lead, count)
        if count == len(valid) and (steady or attempt == DESIGN.trims - 1):
            motion = {name: values[lead:] for name, values in simulated.items()}
            motion["command"] = commands[lead:]
            return Played(step, _record(rig, step, motion), motion, gains)
    raise InputError(
        f"{step.located}: the twin's simulation fails (end of the linkage, vacuum); "
        "lower the amplitude"
    )


def _held_positions(rig: Rig, step: TwinStep) -> dict[int, float]:
    out = {}
    for joint, piston in step.held.items():
        half = 0.5 * rig.joints[joint].cylinder.stroke - DESIGN.end_distance
        out[joint] = float(np.clip(piston, -half, half))
    return out


def _commands(rig: Rig, step: TwinStep) -> tuple[Array, Array, int]:
    """Return commands (n, N) [V] that end with a record, start pistons (N,), first sample."""
    rate, joints = rig.sample_rate, len(rig.joints)
    lead = min(step.period, round(DESIGN.lead * rate))
    commands = np.zeros((lead + step.samples, joints))
    start = np.zeros(joints)
    ramp = np.minimum(1.0, np.arange(len(commands)) / (DESIGN.ramp * rate))
    for joint, wave in step.waves.items():
        phase = np.arange(-lead, step.samples) % len(wave)
        commands[:, joint] = ramp * (wave[phase] + step.biases.get(joint, 0.0))
        start[joint] = step.strokes.get(joint, step.centres.get(joint, 0.0))
    for joint, piston in step.closed.items():
        start[joint] = piston
    return commands, start, lead


def _trimmed(
    rig: Rig, step: TwinStep, commands: Array, piston: Array, lead: int, count: int
) -> tuple[TwinStep, bool, dict[int, float]]:
    """Return the step with corrected biases and starts, whether it was steady, and the gains."""
    rate, gains = rig.sample_rate, {}
    biases, starts, steady = dict(step.biases), dict(step.strokes), count == len(piston)
    for joint in step.waves:
        span = slice(lead if count > lead + rate else 0, count)
        v, s = commands[span, joint], piston[span, joint]
        # An open-loop piston integrates its valve: s = c + d t + k int(v - mean v).
        basis = np.column_stack(
            (np.ones(len(v)), np.arange(len(v)) / rate, np.cumsum(v - v.mean()) / rate)
        )
        _, drift, gain = np.linalg.lstsq(basis, s, rcond=None)[0]
        if not gain > 0:
            raise InputError(
                f"{step.located}: the twin of joint {joint + 1} does not follow its command "
                f"({gain:.3g} m/s per volt, expected more than 0); lower the amplitude, or correct "
                "the nominal parameters of the rig"
            )
        gains[joint] = float(gain)
        offset = float(s.mean()) - step.centres.get(joint, 0.0)
        centred = abs(drift) * step.samples / rate < DESIGN.drift and abs(offset) < 4 * DESIGN.drift
        if not centred:
            biases[joint] = float(v.mean() - drift / gain)
            centre = starts.get(joint, step.centres.get(joint, 0.0))
            starts[joint] = float(np.clip(centre - offset, *rig.joints[joint].limits.piston))
            steady = False
    return replace(step, biases=biases, strokes=starts), steady, gains


def _record(rig: Rig, step: TwinStep, motion: Mapping[str, Array]) -> Record:
    channels = twin_channels(rig, rig.recorded, motion)
    return Record(
        f"{step.name}_r1", step.name, step.locked, 1, rig.sample_rate, channels,
        period=step.period, lines=step.lines,
    )  # fmt: skip
