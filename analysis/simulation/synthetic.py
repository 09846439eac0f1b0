"""Simulated records of the model with known parameters and stated sensor noise, for studies.

They compare estimators and filters and time the pipeline. They cannot test the model itself: the
simulated bench does, with separately written physics.
"""

from __future__ import annotations

import numpy as np

from analysis.simulation.model import Array, Model, nominal_model
from analysis.simulation.settings import SIMULATION
from analysis.simulation.simulate import DrivingInput, Simulation, constant_supply, simulate
from analysis.simulation.twin import holding_state
from rig.model import channels as ch
from rig.model.records import Record, Run
from rig.model.rig import Rig

Wave = tuple[Array, tuple[int, ...]]  # one period of unit RMS, its lines


def multisine(rng: np.random.Generator, rate: float, period: float, top: float) -> Wave:
    """Return one period of unit RMS of a random-phase odd multisine from 0.3 Hz to `top` [Hz]."""
    n = round(period * rate)
    lines = np.arange(1, int(top * period) + 1, 2)
    lines = lines[lines >= 0.3 * period]
    phase = rng.uniform(0, 2 * np.pi, len(lines))
    t = np.arange(n) / n
    wave = np.cos(2 * np.pi * np.outer(t, lines) + phase).sum(axis=1)
    return wave / np.std(wave), tuple(int(line) for line in lines)


def sine(rate: float, hertz: float) -> Wave:
    """Return one period of a sine of unit RMS."""
    n = round(rate / hertz)
    return np.sqrt(2) * np.sin(2 * np.pi * np.arange(n) / n), (1,)


def lock_steps(joints: int) -> list[tuple[str, dict[int, float]]]:
    """Return the lock-and-excite steps (name, 0-based locked joint -> position in half strokes).

    Joint k moves while all others stand: those below it at mid-stroke, the one above it at either
    end while those beyond are retracted, then each of those extended; as the paper's STEP1 to
    STEP3 do for two joints. These are N (N + 1) / 2 steps, as many as inertia parameters.
    """
    steps, end = [], SIMULATION.end_share
    for k in range(joints - 1, -1, -1):
        below = dict.fromkeys(range(k), 0.0)
        beyond = range(k + 1, joints)
        steps.append(below | dict.fromkeys(beyond, -end))
        for extended in range(len(beyond)):
            steps.append(below | {j: end if n >= extended else -end for n, j in enumerate(beyond)})
    return [(f"step{number}", locked) for number, locked in enumerate(steps, start=1)]


def synthetic_run(
    rig: Rig,
    rng: np.random.Generator,
    wave: Wave,
    *,
    rms: float,
    repeats: int,
    seconds: float = 10.0,
    noise: float = 1.0,
) -> Run:
    """Return a run of the lock-and-excite steps on the rig's nominal model.

    `rms` [V] of spool, `noise` scales the rig's stated sensor noise. Channels are sampled at the
    tick, without skew or quantisation.
    """
    from scipy.signal import resample  # noqa: PLC0415 - loads slowly

    rate = rig.sample_rate
    ideal = rig.model_copy(update={"sensors": rig.sensors.model_copy(update={"skew": 0.0})})
    model = nominal_model(rig)
    lead, n = round(SIMULATION.lead * rate), round(seconds * rate)
    records = []
    for step, locked in lock_steps(len(rig.joints)):
        fine = np.asarray(resample(wave[0], SIMULATION.oversampling * len(wave[0])))
        spool = rms * fine[np.arange(SIMULATION.oversampling * (lead + n)) % len(fine)]
        run = _centred(model, spool, locked)
        noiseless = _channels(rig, run[0], run[1], lead)
        for repeat in range(1, repeats + 1):
            channels = {
                name: x + noise * rig.sensors.of(ch.kind_of(name)[0]).noise * rng.standard_normal(n)
                for name, x in noiseless.items()
            }
            names = tuple(i + 1 for i in sorted(locked))
            records.append(
                Record(
                    f"{step}_r{repeat}",
                    step,
                    names,
                    repeat,
                    rate,
                    channels,
                    period=len(wave[0]),
                    lines=wave[1],
                )
            )
    return Run(ideal, tuple(records), source="synthetic")


def _centred(
    model: Model, spool: Array, locked: dict[int, float]
) -> tuple[DrivingInput, Simulation]:
    """Simulate with the spool bias that keeps the moving joint's mean position constant."""
    rig = model.rig
    N, n, rate = len(rig.joints), len(spool), SIMULATION.oversampling * rig.sample_rate
    position = np.array(
        [locked.get(i, 0.0) * 0.5 * joint.cylinder.stroke for i, joint in enumerate(rig.joints)]
    )
    state = holding_state(rig, model, position)
    is_locked = np.array([i in locked for i in range(N)])
    moving = np.flatnonzero(~is_locked)
    t = np.arange(n) / rate
    bias, slope_of_bias = np.zeros(N), np.full(N, np.nan)
    previous: tuple[Array, Array] | None = None
    for attempt in range(SIMULATION.trim_rounds + 1):
        u = np.where(is_locked, 0.0, spool[:, None] + bias)
        drive = constant_supply(rig, rate, u, is_locked, state.q)
        result = simulate(model, drive, state)
        drift = np.array([np.polyfit(t, result.piston[:, i], 1)[0] for i in range(N)])
        if attempt == SIMULATION.trim_rounds:
            break
        if previous is not None:
            slope_of_bias = (drift - previous[1]) / np.where(is_locked, 1.0, bias - previous[0])
        guess = slope_of_bias if previous is not None else np.full(N, 1.5)
        previous = (bias.copy(), drift)
        bias[moving] -= drift[moving] / guess[moving]
    return drive, result


def _channels(rig: Rig, drive: DrivingInput, result: Simulation, lead: int) -> dict[str, Array]:
    channels = result.channels()
    for i in range(len(rig.joints)):
        channels[ch.channel(ch.SPOOL, i + 1)] = drive.u[:, i]
    channels[ch.SUPPLY], channels[ch.TEMPERATURE] = drive.p_s, drive.temperature
    return {name: channels[name][:: SIMULATION.oversampling][lead:] for name in rig.channels}
