"""What a stranger's bench hides: drawn by a seed, sizes evenly in the logarithm."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from tests.studies.foreign import plant
from tests.studies.foreign.bench import Bench, Sensor, drawn_rig

NONE, SINGLE, PAIR, OUTSIDE = "none", "single", "pair", "outside"
STREAM: Final = 29
DRAWN: Final = ("", "leakage_curve")  # of a laminar leak, of a turbulent one
MIX: Final = ((NONE, 0.15), (SINGLE, 0.60), (PAIR, 0.15), (OUTSIDE, 0.10))


@dataclass(frozen=True)
class Wrong:
    """One thing wrong: the trace's name and place, what it does, true sizes by parameter stem.

    `also` are names at the same place that may stand beside it (a breakaway sits on a level, a
    curve of its mechanism is right for what has no name), `kin` those that may stand beside
    `unexplained`: the right mechanism in a form that is too simple. `curve` is the mechanism's free
    curve, which is as right as the name where the name's own form is another.
    """

    name: str
    where: str
    form: str
    machine: Mapping[str, float] = field(default_factory=dict)
    joint: tuple[int, Mapping[str, float]] = (0, {})
    sensors: Mapping[str, Sensor] = field(default_factory=dict)
    sizes: Mapping[str, float] = field(default_factory=dict)
    also: tuple[str, ...] = ()
    kin: tuple[str, ...] = ()
    curve: str = ""


@dataclass(frozen=True)
class Case:
    """A bench, what it hides, and the seed that drew both."""

    kind: str
    seed: int
    bench: Bench
    hidden: tuple[Wrong, ...] = ()

    @property
    def label(self) -> str:
        """What is hidden, in words."""
        return " + ".join(f"{w.name} at {w.where} ({w.form})" for w in self.hidden) or NONE

    @property
    def truth(self) -> set[tuple[str, str]]:
        """Names and places to be found; none for what lies outside the catalogue."""
        return set() if self.kind == OUTSIDE else {(w.name, w.where) for w in self.hidden}

    @property
    def allowed(self) -> set[tuple[str, str]]:
        """What may be named beside the truth."""
        return {(name, w.where) for w in self.hidden for name in w.also}

    @property
    def related(self) -> set[tuple[str, str]]:
        """What may be named beside `unexplained`."""
        return self.allowed | {(name, w.where) for w in self.hidden for name in w.kin}


Draw = Callable[[np.random.Generator, int], Wrong]


def _size(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(math.log(low), math.log(high))))


def _one_of(rng: np.random.Generator, forms: int, further: int) -> int:
    """Draw one of `forms`, or of `further` ones, which change no other draw of a seed."""
    form, own = int(rng.integers(forms)), rng.spawn(1)[0]
    drawn = int(own.integers(forms + further))
    return drawn if drawn >= forms else form


def _contact(rng: np.random.Generator) -> tuple[str, dict[str, float]]:
    """Return the form of dry friction, with its width: a speed [m/s], or a deflection [m]."""
    form = int(rng.integers(4))
    low, high = {plant.TANH: (1e-4, 1e-2), plant.KARNOPP: (1e-4, 1e-3)}.get(form, (3e-6, 1e-4))
    width = _size(rng, low, high)
    word = ("tanh", "Dahl", "LuGre", "Karnopp")[form]
    unit = "mm/s" if form in (plant.TANH, plant.KARNOPP) else "mm"
    return f"{word} {1e3 * width:.2g} {unit}", {"dry_form": form, "width": width}


def _coulomb(rng: np.random.Generator, i: int) -> Wrong:
    word, contact = _contact(rng)
    force = _size(rng, 10, 150)
    own = {**contact, "ahead": force, "astern": force}
    return Wrong("coulomb_friction", f"joint {i + 1}", f"{force:.0f} N, {word}", joint=(i, own),
                 sizes={"Fc": force})  # fmt: skip


def _asymmetric(rng: np.random.Generator, i: int) -> Wrong:
    word, contact = _contact(rng)
    one, ratio = _size(rng, 20, 100), _size(rng, 1.4, 4)
    ahead, astern = (one, one * ratio) if rng.integers(2) else (one * ratio, one)
    own = {**contact, "ahead": ahead, "astern": astern}
    return Wrong("asymmetric_friction", f"joint {i + 1}", f"{ahead:.0f}/{astern:.0f} N, {word}",
                 joint=(i, own), sizes={"F_ext": ahead, "F_ret": astern})  # fmt: skip


def _stribeck(rng: np.random.Generator, i: int) -> Wrong:
    word, contact = _contact(rng)
    force, more, speed = _size(rng, 5, 50), _size(rng, 30, 150), _size(rng, 5e-3, 4e-2)
    own = {**contact, "ahead": force, "astern": force, "breakaway": more, "stribeck": speed}
    text = f"{force:.0f} + {more:.0f} N to {1e3 * speed:.0f} mm/s, {word}"
    return Wrong("stribeck_friction", f"joint {i + 1}", text, joint=(i, own),
                 also=("coulomb_friction",))  # fmt: skip


def _by_pressure(rng: np.random.Generator, i: int) -> Wrong:
    word, contact = _contact(rng)
    k, form = _size(rng, 5e-6, 4e-5), _one_of(rng, 2, 3)
    own = {**contact, "by_pressure": k, "pressure_form": form}
    load = ("sum", "difference", "cap pressure", "rod pressure", "cap + 0.4 rod pressure")[form]
    text = f"{k:.2g} m2 x {load}, {word}"
    return Wrong("pressure_dependent_friction", f"joint {i + 1}", text, joint=(i, own))


def _viscous(rng: np.random.Generator, i: int) -> Wrong:
    k = _size(rng, 50, 1500)
    own = {"slope_ahead": k, "slope_astern": -k} if rng.integers(2) else {
        "slope_ahead": -k, "slope_astern": k}  # fmt: skip
    return Wrong("asymmetric_viscous_friction", f"joint {i + 1}", f"{k:.0f} N s/m either way",
                 joint=(i, own))  # fmt: skip


def _spring(rng: np.random.Generator, i: int) -> Wrong:
    k = _size(rng, 10, 200)
    return Wrong("joint_spring", f"joint {i + 1}", f"{k:.0f} N m/rad", joint=(i, {"stiffness": k}),
                 sizes={"k_spring": k})  # fmt: skip


def _tilt(rng: np.random.Generator, i: int) -> Wrong:
    tilt = math.radians(_size(rng, 0.3, 4))
    return Wrong("base_inclination", "bench", f"{math.degrees(tilt):.2g} deg",
                 {"inclination": tilt}, sizes={"": tilt})  # fmt: skip


def _torque(rng: np.random.Generator, i: int) -> Wrong:
    torque = _size(rng, 1, 15)
    return Wrong("torque_offset", f"joint {i + 1}", f"{torque:.2g} N m",
                 joint=(i, {"torque": torque}), sizes={"": torque})  # fmt: skip


def _edge(rng: np.random.Generator) -> tuple[str, float, float]:
    form = int(rng.integers(3))
    return ("sharp", "rounded", "notch")[form], form, _size(rng, 0.05, 0.4)


def _deadband(rng: np.random.Generator, i: int) -> Wrong:
    word, form, share = _edge(rng)
    ahead = _size(rng, 1e-3, 2e-2)
    astern = ahead * _size(rng, 0.6, 1.6)
    own = {"edge_ahead": ahead, "edge_astern": astern, "edge_form": form,
           "edge_rounding": share * min(ahead, astern)}  # fmt: skip
    text = f"{1e3 * ahead:.2g}/{1e3 * astern:.2g} mV {word}"
    return Wrong("valve_deadband", f"joint {i + 1}", text, joint=(i, own),
                 sizes={"w_ahead": ahead, "w_astern": astern})  # fmt: skip


def _underlap(rng: np.random.Generator, i: int) -> Wrong:
    word, form, share = _edge(rng)
    width = _size(rng, 2e-3, 1.5e-2)
    own = {"underlap": width, "edge_form": form, "edge_rounding": share * width}
    return Wrong("underlap_leakage", f"joint {i + 1}", f"{1e3 * width:.2g} mV {word}",
                 joint=(i, own), sizes={"w_underlap": width})  # fmt: skip


def _null(rng: np.random.Generator, i: int) -> Wrong:
    null = _size(rng, 1e-3, 1e-2)
    return Wrong("spool_offset", f"joint {i + 1}", f"{1e3 * null:.2g} mV",
                 joint=(i, {"null": null}), sizes={"u_null": null})  # fmt: skip


def _spool_lag(rng: np.random.Generator, i: int) -> Wrong:
    lag = _size(rng, 5e-4, 5e-3)
    return Wrong("spool_lag", f"joint {i + 1}", f"{1e3 * lag:.2g} ms",
                 joint=(i, {"spool_lag": lag}), sizes={"": lag})  # fmt: skip


def _play(rng: np.random.Generator, i: int) -> Wrong:
    play, form = _size(rng, 1e-3, 1e-2), int(rng.integers(3))
    own = {"play": play, "play_form": form, "play_travel": 0.2 * play}
    text = f"{1e3 * play:.2g} mV {('backlash', 'linkage', 'magnet')[form]}"
    return Wrong("spool_hysteresis", f"joint {i + 1}", text, joint=(i, own),
                 sizes={"w_hysteresis": play} if form == plant.BACKLASH else {})  # fmt: skip


def _leak(rng: np.random.Generator) -> tuple[str, int, float]:
    """Draw a leak's form in words and number, and its flow over the pressure [SI] at 1 MPa."""
    form = int(rng.integers(2))
    return ("laminar", "turbulent")[form], form, _size(rng, 2e-13, 4e-12)


def _internal(rng: np.random.Generator, i: int) -> Wrong:
    word, form, c = _leak(rng)
    return Wrong("internal_leakage", f"joint {i + 1}", f"{c:.2g} {word}",
                 joint=(i, {"internal": c, "internal_form": form}),
                 sizes={"c_internal": c}, curve=DRAWN[form])  # fmt: skip


def _external(rng: np.random.Generator, i: int) -> Wrong:
    word, form, c = _leak(rng)
    side = ("cap", "rod")[int(rng.integers(2))]
    return Wrong("external_leakage", f"joint {i + 1} {side}", f"{c:.2g} {word}",
                 joint=(i, {f"{side}_leak": c, "external_form": form}),
                 sizes={"": c}, curve=DRAWN[form])  # fmt: skip


def _sag(rng: np.random.Generator, i: int) -> Wrong:
    form, drop = _one_of(rng, 4, 1), _size(rng, 1e5, 2e6)
    lag = _size(rng, 5e-3, 6e-2)
    word = ("orifice", "laminar line", f"line lag {1e3 * lag:.2g} ms",
            f"accumulator {1e3 * lag:.2g} ms", f"regulator {1e3 * lag:.2g} ms")[form]  # fmt: skip
    return Wrong("supply_sag", "bench", f"{drop / 1e6:.2g} MPa {word}",
                 {"sag": drop, "sag_form": form, "sag_lag": lag})  # fmt: skip


def _tank(rng: np.random.Generator, i: int) -> Wrong:
    p = _size(rng, 5e4, 5e5)
    return Wrong("tank_pressure", "bench", f"{p / 1e6:.2g} MPa", {"tank": p}, sizes={"p_tank": p})


def _return(rng: np.random.Generator, i: int) -> Wrong:
    drop, lag = _size(rng, 2e5, 2e6), float(rng.choice([0.0, 0.01]))
    return Wrong("return_line", "bench", f"{drop / 1e6:.2g} MPa, lag {1e3 * lag:.0f} ms",
                 {"return_drop": drop, "return_lag": lag})  # fmt: skip


def _air(rng: np.random.Generator, i: int) -> Wrong:
    share, form = _size(rng, 2e-3, 3e-2), int(rng.integers(3))
    word = ("isothermal", "adiabatic", "dissolving")[form]
    own = {"air": share, "air_form": float(form == 2), "polytropic": 1.4 if form == 1 else 1.0}
    return Wrong("entrained_air", "bench", f"{100 * share:.2g} % {word}", own)


def _volume(rng: np.random.Generator, i: int) -> Wrong:
    volume, side = _size(rng, 1e-5, 1e-4), ("cap", "rod")[int(rng.integers(2))]
    return Wrong("dead_volume", f"joint {i + 1} {side}", f"{1e6 * volume:.0f} cm3",
                 joint=(i, {f"{side}_more": volume}), sizes={"": volume})  # fmt: skip


def _pressure(rng: np.random.Generator, i: int) -> tuple[str, str, str]:
    """Return a pressure's channel, its place, and its neighbour's channel."""
    side, other = [("cap", "rod"), ("rod", "cap")][int(rng.integers(2))]
    return f"{side}_pressure_{i + 1}", f"joint {i + 1} {side}", f"{other}_pressure_{i + 1}"


def _delay(rng: np.random.Generator, i: int) -> Wrong:
    name, place, _ = _pressure(rng, i)
    delay = _size(rng, 5e-4, 6e-3)
    if rng.integers(3) == 0:
        own = {f"{s}_pressure_{k}": Sensor(delay=delay) for s in ("cap", "rod") for k in (1, 2)}
        return Wrong("channel_delay", "bench", f"{1e3 * delay:.2g} ms, all pressures", sensors=own,
                     sizes={"": delay})  # fmt: skip
    return Wrong("channel_delay", place, f"{1e3 * delay:.2g} ms",
                 sensors={name: Sensor(delay=delay)}, sizes={"": delay})  # fmt: skip


def _sensor_lag(rng: np.random.Generator, i: int) -> Wrong:
    name, place, _ = _pressure(rng, i)
    lag = _size(rng, 5e-4, 6e-3)
    return Wrong("sensor_lag", place, f"{1e3 * lag:.2g} ms", sensors={name: Sensor(lag=lag)},
                 sizes={"": lag})  # fmt: skip


def _gain(rng: np.random.Generator, i: int) -> Wrong:
    name, place, _ = _pressure(rng, i)
    more = _size(rng, 0.005, 0.08) * (1 if rng.integers(2) else -1)
    return Wrong("sensor_gain", place, f"{100 * more:+.2g} %",
                 sensors={name: Sensor(gain=1 + more)}, sizes={"": 1 + more})  # fmt: skip


def _offset(rng: np.random.Generator, i: int) -> Wrong:
    name, place, _ = _pressure(rng, i)
    offset = _size(rng, 2e4, 3e5)
    return Wrong("sensor_offset", place, f"{offset / 1e6:.2g} MPa",
                 sensors={name: Sensor(offset=offset)}, sizes={"": offset})  # fmt: skip


def _crosstalk(rng: np.random.Generator, i: int) -> Wrong:
    name, place, other = _pressure(rng, i)
    share = _size(rng, 0.005, 0.05)
    return Wrong("sensor_crosstalk", place, f"{100 * share:.2g} % of the other side",
                 sensors={name: Sensor(crosstalk=(other, share))})  # fmt: skip


SINGLES: Final[Mapping[str, Draw]] = {
    "coulomb_friction": _coulomb, "asymmetric_friction": _asymmetric,
    "stribeck_friction": _stribeck, "pressure_dependent_friction": _by_pressure,
    "asymmetric_viscous_friction": _viscous, "joint_spring": _spring, "base_inclination": _tilt,
    "torque_offset": _torque, "valve_deadband": _deadband, "underlap_leakage": _underlap,
    "spool_offset": _null, "spool_lag": _spool_lag, "spool_hysteresis": _play,
    "internal_leakage": _internal, "external_leakage": _external, "supply_sag": _sag,
    "tank_pressure": _tank, "return_line": _return, "entrained_air": _air, "dead_volume": _volume,
    "channel_delay": _delay, "sensor_lag": _sensor_lag, "sensor_gain": _gain,
    "sensor_offset": _offset, "sensor_crosstalk": _crosstalk,
}  # fmt: skip


def _hardening(rng: np.random.Generator, i: int) -> Wrong:
    own = {"stiffness": _size(rng, 20, 60), "cubic": _size(rng, 20, 80)}
    return Wrong("hardening spring", f"joint {i + 1}", "cubic", joint=(i, own),
                 also=("position_force",), kin=("joint_spring",))  # fmt: skip


def _drag(rng: np.random.Generator, i: int) -> Wrong:
    own = {"square": _size(rng, 2e3, 2e4)}
    return Wrong("drag by the speed squared", f"joint {i + 1}", f"{own['square']:.2g} N s2/m2",
                 joint=(i, own), also=("friction_curve",))  # fmt: skip


def _worn(rng: np.random.Generator, i: int) -> Wrong:
    own = {"internal": _size(rng, 5e-13, 2e-12), "worn": _size(rng, 2, 8)}
    text = f"x {own['worn']:.2g} in its middle"
    return Wrong("worn bore", f"joint {i + 1}", text, joint=(i, own),
                 also=("leakage_along_stroke",), kin=("internal_leakage",))  # fmt: skip


def _tapered(rng: np.random.Generator, i: int) -> Wrong:
    force, (word, contact) = _size(rng, 40, 150), _contact(rng)
    own = {**contact, "ahead": force, "astern": force, "taper": _size(rng, 15, 25)}
    return Wrong("tapered bore", f"joint {i + 1}", f"{force:.0f} N, {word}", joint=(i, own),
                 also=("friction_curve",), kin=("coulomb_friction",))  # fmt: skip


STRANGERS: Final[tuple[Draw, ...]] = (_hardening, _drag, _worn, _tapered)


REDRAWN = 20  # times that the second of two causes alone is drawn again


def _same_cause(one: Wrong, other: Wrong) -> bool:
    """Return whether two effects set the same sensor or the same number of a joint."""
    own = one.joint[0] == other.joint[0] and bool(set(one.joint[1]) & set(other.joint[1]))
    return own or bool(set(one.sensors) & set(other.sensors))


def case_of(
    seed: int, only: str = "", kind: str = "", spool: int | None = None, alone: int | None = None
) -> Case:
    """Return the case of a seed.

    With `only` an effect of that name alone is hidden; `kind` and how the spool follows its command
    (`spool`, `plant.CONTINUOUS` …) are drawn where they are not given. `alone` is the position of
    the one effect that is left of those drawn, on the same bench.
    """
    rng = np.random.default_rng([seed, STREAM])
    rig, truth = drawn_rig(rng)
    bench: dict[str, Any] = {
        "form": int(rng.integers(3)), "phase": int(rng.integers(0, 25)),
        "filter_hertz": float(rng.choice([0.0, 0.0, 250.0])),
        "noise": float(rng.choice([0.5, 1.0, 1.0, 2.0])),
        "repeats": int(rng.choice([1, 2, 4, 4])), "rms": _size(rng, 0.025, 0.05),
    }  # fmt: skip
    if spool is not None:
        bench["form"] = spool
    own = {"spool_time": _size(rng, 1e-3, 3e-3), "spool_hertz": _size(rng, 50, 120),
           "spool_damping": float(rng.uniform(0.6, 0.9))}  # fmt: skip
    names = list(SINGLES)
    drawn = str(rng.choice([k for k, _ in MIX], p=[p for _, p in MIX]))
    kind = kind or (SINGLE if only else drawn)
    if kind == SINGLE:
        draws = [SINGLES[only or names[int(rng.integers(len(names)))]]]
    elif kind == PAIR:
        draws = [SINGLES[names[int(k)]] for k in rng.choice(len(names), 2, replace=False)]
    else:
        draws = [STRANGERS[int(rng.integers(len(STRANGERS)))]] if kind == OUTSIDE else []
    hidden = tuple(draw(rng, int(rng.integers(2))) for draw in draws)
    tried = 0
    while len(hidden) == 2 and _same_cause(*hidden):
        tried += 1  # a delay of all pressures leaves no sensor for a gain
        first = draws[0](rng, int(rng.integers(2))) if tried > REDRAWN else hidden[0]
        hidden = (first, draws[1](rng, int(rng.integers(2))))
    hidden = hidden if alone is None else hidden[alone : alone + 1]
    machine: dict[str, float] = {}
    joints: tuple[dict[str, float], dict[str, float]] = ({**own}, {**own})
    sensors: dict[str, Sensor] = {}
    for wrong in hidden:
        machine |= wrong.machine
        joints[wrong.joint[0]].update(wrong.joint[1])
        sensors |= wrong.sensors
    for i, joint in enumerate(joints):
        for side in ("cap", "rod"):
            more = joint.pop(f"{side}_more", 0.0)
            pipe = getattr(rig.joints[i].cylinder, f"{side}_pipe_volume")
            joint[f"{side}_volume"] = pipe + more
    return Case(kind, seed, Bench(rig, truth, machine, joints, sensors, **bench), hidden)
