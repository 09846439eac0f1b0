"""A stranger's bench: machine, steps, excitation and sensors, drawn by a seed, and its records."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from rig.model.channels import CAP, PISTON, ROD, SPOOL, SUPPLY, TEMPERATURE, channel
from rig.model.records import Record, Run
from rig.model.rig import Rig
from rig.model.tolerances import Tolerances
from rig.model.wire.codes import decode_input, encode_input
from rig.runs.rigs import load_rig
from tests.studies.foreign import plant

Array = NDArray[np.float64]

STEPS: Final = (("step1", (1,), (0.0, 0.0)), ("step2", (2,), (0.0, -0.036)),
                ("step3", (2,), (0.0, 0.036)), ("both", (), (0.0, 0.0)))  # fmt: skip
TRAIN: Final = ("step1", "step2", "step3")
PERIOD: Final = 4.0  # [s]
SETTLE: Final = 4.0  # [s] before a record begins
CENTRING: Final = 0.3  # [V/m]
LIMIT: Final = 0.0355  # [m] that no piston passes
TEMPERED: Final = 40.0  # [degC]


# Of cylinders and pins that were measured with a calliper, pipes with a tape.
STATED = Tolerances(area=0.003, volume=0.05, pin=2e-4, mid_length=5e-4)


@dataclass(frozen=True)
class Sensor:
    """What one channel does beside its noise: gain, offset [SI], delay [s], lag [s]."""

    gain: float = 1.0
    offset: float = 0.0
    delay: float = 0.0
    lag: float = 0.0
    crosstalk: tuple[str, float] = ("", 0.0)


@dataclass(frozen=True)
class Bench:
    """A machine with what is wrong with it: numbers by the names of `plant.MACHINE` and `JOINT`."""

    rig: Rig
    truth: Mapping[str, float]
    machine: Mapping[str, float] = field(default_factory=dict)
    joints: tuple[Mapping[str, float], Mapping[str, float]] = ({}, {})
    sensors: Mapping[str, Sensor] = field(default_factory=dict)
    noise: float = 1.0
    seconds: float = 8.0
    repeats: int = 2
    filter_hertz: float = 0.0  # [Hz] of the amplifiers' common one-pole filter; 0: none
    phase: int = 0  # steps of the integrator by which the command's renewal precedes the sample
    form: int = plant.CONTINUOUS  # how the spool follows its command
    rms: float = 0.035  # [V] of the excitation


def drawn_rig(rng: np.random.Generator) -> tuple[Rig, dict[str, float]]:
    """Return a relative of the shipped two-joint rig and its true parameters."""
    base = load_rig("shinshu-2dof")
    supply = float(np.exp(rng.uniform(np.log(5e6), np.log(10e6))))
    load = supply / 7e6
    joints, areas = [], []
    for joint in base.joints:
        area = _factor(rng, 0.15)
        old = joint.cylinder
        joints.append(joint.model_copy(update={"cylinder": old.model_copy(update={
            "cap_area": old.cap_area * area, "rod_area": old.rod_area * area * _factor(rng, 0.06),
            "cap_pipe_volume": old.cap_pipe_volume * _factor(rng, 0.3),
            "rod_pipe_volume": old.rod_pipe_volume * _factor(rng, 0.3),
        })}))  # fmt: skip
        areas.append(area)
    top = base.sensors.chamber_pressure.model_copy(update={"range": (-0.1e6, 1.5 * supply)})
    sensors = base.sensors.model_copy(update={"chamber_pressure": top, "supply_pressure": top})
    rig = base.model_copy(update={
        "joints": tuple(joints), "sensors": sensors,
        "supply": base.supply.model_copy(update={"pressure": supply}),
    })  # fmt: skip
    mass = load * float(np.mean(areas)) * _factor(rng, 0.15)
    truth = {}
    for name, value in base.nominal.items():
        if name[0] in "MRW":
            truth[name] = value * mass
        elif name.startswith("C_"):
            scale = areas[int(name[-1]) - 1] / math.sqrt(load)
            truth[name] = value * scale * _factor(rng, 0.08)
        else:
            truth[name] = value * _factor(rng, 0.25)
    return rig, truth


def _factor(rng: np.random.Generator, spread: float) -> float:
    return float(np.exp(rng.uniform(-spread, spread)))


def _numbers(bench: Bench) -> tuple[Array, Array]:
    """Return the plant's arrays of machine and joints."""
    rig, truth = bench.rig, bench.truth
    machine = {name: truth[name] for name in ("M1", "M2", "R12", "W1", "W2", "Fv1", "Fv2")}
    machine |= {"gravity": rig.gravity, "bulk": truth["b"], "supply": rig.supply.pressure}
    machine |= {"polytropic": 1.4, "sag_lag": 0.02, **bench.machine}
    joints = np.zeros((2, len(plant.JOINT)))
    for i, joint in enumerate(rig.joints):
        pins, cylinder = joint.linkage, joint.cylinder
        own = {
            "a": pins.base_pin, "c": pins.arm_pin, "mid": pins.mid_length, "beta": pins.offset,
            "cap_area": cylinder.cap_area, "rod_area": cylinder.rod_area,
            "cap_volume": cylinder.cap_pipe_volume, "rod_volume": cylinder.rod_pipe_volume,
            "half": cylinder.stroke / 2, "stribeck": 0.02, "width": 1e-3,
            "spool_form": bench.form, "spool_time": 2e-3, "spool_hertz": 90.0,
            "spool_damping": 0.8, "edge_rounding": 1e-4, "rest": angle(bench, i, 0.0),
        }  # fmt: skip
        own |= {k: truth[f"{k}_{i + 1}"] for k in ("C_pp", "C_pm", "C_mp", "C_mm")}
        own |= bench.joints[i]
        joints[i] = [own.get(name, 0.0) for name in plant.JOINT]
    return np.array([machine.get(name, 0.0) for name in plant.MACHINE]), joints


def angle(bench: Bench, i: int, piston: float) -> float:
    """Return the angle [rad] of a piston displacement [m], by bisection on the pins' triangle."""
    pins = bench.rig.joints[i].linkage
    low, high = -pins.offset, math.pi - pins.offset
    if pins.offset < -3.0:  # the shipped arm folds the other way round
        low, high = low - 2 * math.pi, high - 2 * math.pi
    for _ in range(60):
        middle = 0.5 * (low + high)
        turned = middle + pins.offset
        square = pins.base_pin**2 + pins.arm_pin**2
        square -= 2 * pins.base_pin * pins.arm_pin * math.cos(turned)
        shorter = math.sqrt(square) - pins.mid_length < piston
        low, high = (middle, high) if shorter else (low, middle)
    return low


def multisine(rng: np.random.Generator, joints: tuple[int, ...], rms: float) -> Array:
    """Return rows (joint, amplitude [V], rad/s, phase) of odd multisines up to 9.5 Hz."""
    rows = []
    lines = np.arange(1, 39, 2)
    tilt = rng.uniform(0.2, 0.7)
    for i in joints:
        weight = lines**-tilt
        amplitude = rms * math.sqrt(2) * weight / np.linalg.norm(weight)
        phases = rng.uniform(0, 2 * math.pi, len(lines))
        rows += [
            (i, a, 2 * math.pi * n / PERIOD, p)
            for a, n, p in zip(amplitude, lines, phases, strict=True)
        ]
    return np.array(rows)


def _start(bench: Bench, at: tuple[float, float]) -> Array:
    """Return the state at rest: gravity is held, the rod side is at half the supply."""
    y = np.zeros(plant.SIZE)
    y[0], y[1] = (angle(bench, i, at[i]) for i in (0, 1))
    truth, g = bench.truth, bench.rig.gravity
    far = truth["W2"] * g * math.sin(y[0] + y[1])
    torques = (truth["W1"] * g * math.sin(y[0]) + far, far)
    _, joints = _numbers(bench)
    for i in (0, 1):
        lever = plant.stroke(y[i], joints[i])[1]
        rod = 0.5 * bench.rig.supply.pressure
        area = bench.rig.joints[i].cylinder
        y[plant.P + 2 * i] = (torques[i] / lever + area.rod_area * rod) / area.cap_area
        y[plant.P + 2 * i + 1] = rod
    return y


def channels(bench: Bench, step: str, wave_seed: int, scale: float) -> dict[str, Array]:
    """Return noise-free channels of one step; raises RuntimeError where a piston meets its end."""
    _, locked, at = next(s for s in STEPS if s[0] == step)
    rng = np.random.default_rng([wave_seed, len(step), *locked])
    free = tuple(i for i in (0, 1) if i + 1 not in locked)
    waves = multisine(rng, free, bench.rms * scale * (0.7 if len(free) > 1 else 1.0))
    for _ in range(4):
        out = _centred(bench, locked, at, waves)
        if all(np.abs(out[channel(PISTON, i + 1)]).max() < LIMIT for i in free):
            return out
        waves = waves.copy()
        waves[:, 1] *= 0.7
    raise RuntimeError(f"{step}: a piston meets its end of stroke")


def _centred(
    bench: Bench, locked: tuple[int, ...], at: tuple[float, float], waves: Array
) -> dict[str, Array]:
    machine, joints = _numbers(bench)
    rig, rate = bench.rig, bench.rig.sample_rate
    held = round(1.0 / (rate * plant.STEP))
    shut = np.array([i + 1 in locked for i in (0, 1)])
    start, bias = _start(bench, at), np.zeros(2)

    def states(seconds: float, first: int) -> tuple[Array, Array]:
        steps = round((SETTLE + seconds) / plant.STEP) + 4 * held
        found: tuple[Array, Array] = plant.integrated(
            start, steps, held, machine, joints, shut, waves, bias, CENTRING, first
        )
        return found

    for _ in range(2):
        y, _ = states(0.0, round((SETTLE - PERIOD / 2) / plant.STEP))
        for i in (0, 1):
            if not shut[i]:
                mean = np.mean([plant.stroke(q, joints[i])[0] for q in y[::100, i]])
                bias[i] -= 1.5 * CENTRING * float(mean)
    lead = 50 * held  # of history for delays and filters
    first = round(SETTLE / plant.STEP) - lead
    y, spools = states(bench.seconds, first)
    time = plant.STEP * np.arange(len(y)) - lead * plant.STEP + bench.phase * plant.STEP
    n = round(bench.seconds * rate)
    true: dict[str, Array] = {}
    for i in (0, 1):
        j = joints[i]
        square = j[plant.A] ** 2 + j[plant.C] ** 2
        turned = np.cos(y[:, i] + j[plant.BETA])
        true[channel(PISTON, i + 1)] = (
            np.sqrt(square - 2 * j[plant.A] * j[plant.C] * turned) - j[plant.MID]
        )
        true[channel(SPOOL, i + 1)] = spools[:, i]
        true[channel(CAP, i + 1)] = y[:, plant.P + 2 * i]
        true[channel(ROD, i + 1)] = y[:, plant.P + 2 * i + 1]
    true[SUPPLY] = np.full(len(y), rig.supply.pressure)
    true[TEMPERATURE] = np.full(len(y), TEMPERED)
    out = {}
    for k, name in enumerate(rig.channels):
        sensor = bench.sensors.get(name, Sensor())
        x = true[name]
        for pole in (1 / (2 * math.pi * bench.filter_hertz) if bench.filter_hertz else 0.0,
                     sensor.lag):  # fmt: skip
            if pole > 0.0:
                x = _lagged(x, plant.STEP / pole)
        instant = np.arange(n) / rate + rig.sensors.skew * k - sensor.delay
        x = np.interp(instant, time, x)
        other, share = sensor.crosstalk
        if other:
            x = x + share * np.interp(instant, time, true[other])
        out[name] = sensor.gain * x + sensor.offset
    return out


def _lagged(x: Array, ratio: float) -> Array:
    """Return a first-order lag's answer to samples joined by lines; `ratio` is step over lag.

    Exact for such an input: the answer to a ramp is the ramp, one lag late.
    """
    keep = math.exp(-ratio)
    now, before = 1.0 - (1.0 - keep) / ratio, (1.0 - keep) / ratio - keep
    return np.asarray(lfilter([now, before], [1.0, -keep], x, zi=[(1.0 - now) * x[0]])[0])


def _sensed(bench: Bench, clean: Mapping[str, Array], rng: np.random.Generator) -> dict[str, Array]:
    """Return channels with white noise, in the converters' steps."""
    out = {}
    for name, x in clean.items():
        kind = name.rsplit("_", 1)[0] if name[-1].isdigit() else name
        sensor = bench.rig.sensors.of(kind)
        noisy = x + bench.noise * sensor.noise * rng.standard_normal(len(x))
        low, high = sensor.range
        out[name] = decode_input(
            encode_input(noisy, low, high, sensor.bits), low, high, sensor.bits
        )
    return out


def stated_rig(rig: Rig, seed: int) -> Rig:
    """Return a rig file's machine: with tolerances, and numbers that are wrong by draws of them."""
    rng = np.random.default_rng([seed, 23])
    rig = rig.model_copy(update={"tolerances": STATED})
    return rig.with_deviations(rng.standard_normal(len(rig.uncertain_numbers)).tolist())


def records_of(bench: Bench, steps: tuple[str, ...], seed: int, scale: float, repeats: int) -> Run:
    """Return a run of `repeats` of each step, excited by the waveform of `seed`."""
    rng = np.random.default_rng([seed, 17])
    records = []
    for step in steps:
        clean = channels(bench, step, seed, scale)
        locked = next(s[1] for s in STEPS if s[0] == step)
        records += [
            Record(f"{step}_r{k}", step, locked, k, bench.rig.sample_rate,
                   _sensed(bench, clean, rng), period=round(PERIOD * bench.rig.sample_rate),
                   lines=tuple(range(1, 39, 2)))
            for k in range(1, repeats + 1)
        ]  # fmt: skip
    return Run(bench.rig, tuple(records), f"foreign bench, seed {seed}")


def training_of(bench: Bench, seed: int) -> Run:
    """Return the training records alone."""
    return records_of(bench, TRAIN, 10 * seed, 1.0, bench.repeats)


def runs_of(bench: Bench, seed: int) -> tuple[Run, list[Run]]:
    """Return training records and held-out ones: another waveform, seven tenths; both joints."""
    held_out = replace(bench, repeats=min(bench.repeats, 2))
    return (
        training_of(bench, seed),
        [
            records_of(held_out, TRAIN, 10 * seed + 1, 0.7, held_out.repeats),
            records_of(held_out, ("both",), 10 * seed + 2, 0.8, held_out.repeats),
        ],
    )
