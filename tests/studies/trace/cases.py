"""The trace's study: which effects, how large, where, with how much noise; drawn by seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from hil_sim.effects import CLASSES
from rig.model.parse import InputError

JUDGING_SEED: Final = 100
NONE, SINGLE, PAIR, OUTSIDE = "none", "single", "pair", "outside"
FORMS: Final = {kind.effect_name(): kind.forms for kind in CLASSES}
LOUD = 3.0  # repeatable residual over the noise from which an effect must be found

# name, where (the scenario's), key of the size, small, medium and large size, other keys
Sizes = tuple[str, str, str, tuple[str, str, str], str]
SINGLES: Final[tuple[Sizes, ...]] = (
    ("coulomb_friction", "joint {j}", "force", ("15 N", "40 N", "100 N"), ""),
    ("stribeck_friction", "joint {j}", "force", ("30 N", "60 N", "120 N"), "speed: 20 mm/s"),
    (
        "asymmetric_friction", "joint {j}", "extending", ("30 N", "60 N", "120 N"),
        "retracting: 10 N",
    ),
    (
        "pressure_dependent_friction", "joint {j}", "coefficient",
        ("5e-6 N/Pa", "1e-5 N/Pa", "3e-5 N/Pa"), "",
    ),
    (
        "asymmetric_viscous_friction", "joint {j}", "extending",
        ("80 N*s/m", "200 N*s/m", "500 N*s/m"), "retracting: 20 N*s/m",
    ),
    (
        "periodic_disturbance", "joint {j}", "torque", ("0.5 N*m", "2 N*m", "6 N*m"),
        "frequency: 7 Hz",
    ),
    ("base_inclination", "bench", "angle", ("1 deg", "2 deg", "4 deg"), ""),
    ("joint_spring", "joint {j}", "stiffness", ("20 N*m/rad", "60 N*m/rad", "150 N*m/rad"), ""),
    ("torque_offset", "joint {j}", "torque", ("2 N*m", "6 N*m", "15 N*m"), ""),
    ("valve_deadband", "joint {j}", "width", ("2 mV", "8 mV", "20 mV"), ""),
    ("spool_offset", "joint {j}", "voltage", ("1 mV", "4 mV", "10 mV"), ""),
    ("underlap_leakage", "joint {j}", "width", ("4 mV", "8 mV", "15 mV"), ""),
    ("spool_lag", "joint {j}", "time", ("1 ms", "2 ms", "5 ms"), ""),
    ("spool_hysteresis", "joint {j}", "width", ("1 mV", "2 mV", "4 mV"), ""),
    ("return_line", "bench", "drop", ("0.4 MPa", "0.8 MPa", "1.5 MPa"), ""),
    ("sensor_lag", "channel cap_pressure_{j}", "time", ("1 ms", "3 ms", "6 ms"), ""),
    ("sensor_crosstalk", "channel cap_pressure_{j}", "share", ("0.01", "0.03", "0.06"), ""),
    (
        "internal_leakage", "joint {j}", "conductance",
        ("3e-13 m^3/(s*Pa)", "1e-12 m^3/(s*Pa)", "3e-12 m^3/(s*Pa)"), "",
    ),
    (
        "external_leakage", "joint {j} cap", "conductance",
        ("3e-13 m^3/(s*Pa)", "1e-12 m^3/(s*Pa)", "3e-12 m^3/(s*Pa)"), "",
    ),
    ("supply_sag", "bench", "line_drop", ("0.2 MPa", "0.5 MPa", "1 MPa"), ""),
    ("tank_pressure", "bench", "pressure", ("0.1 MPa", "0.2 MPa", "0.4 MPa"), ""),
    ("entrained_air", "bench", "fraction", ("0.3 %", "1 %", "3 %"), ""),
    ("dead_volume", "joint {j} cap", "volume", ("20 cm^3", "50 cm^3", "100 cm^3"), ""),
    ("channel_delay", "channel cap_pressure_{j}", "time", ("1 ms", "3 ms", "6 ms"), ""),
    ("sensor_gain", "channel cap_pressure_{j}", "gain", ("1.01", "1.03", "1.08"), ""),
    (
        "sensor_offset", "channel rod_pressure_{j}", "offset",
        ("0.03 MPa", "0.1 MPa", "0.2 MPa"), "",
    ),
    ("laminar_orifice", "bench", "transition", ("0.3 MPa", "0.7 MPa", "1.5 MPa"), ""),
)  # fmt: skip
QUIET: Final = ("entrained_air", "dead_volume", "supply_sag", "laminar_orifice")  # not in pairs
# Things the catalogue has no entry for: what they are, the variables that tell it, the scenario.
# A mechanism whose curve the data draw may stand for those of `FORM_OF`.
STRANGERS: Final = (
    ("hardening spring", "piston acceleration",
     "{name: joint_spring, where: joint %d, stiffness: 30 N*m/rad, hardening: 40 rad^-2}"),
    ("backlash of soft seals", "piston velocity",
     "{name: coulomb_friction, where: joint %d, force: 120 N, presliding: 4 mm}"),
    ("bore worn in its middle", "piston pressure_difference cap_pressure rod_pressure",
     "{name: internal_leakage, where: joint %d, conductance: 4e-12 m^3/(s*Pa), worn: 8 mm}"),
    ("tapered bore", "piston velocity",
     "{name: coulomb_friction, where: joint %d, force: 80 N, taper: 40 m^-1}"),
)  # fmt: skip
FORM_OF: Final[Mapping[str, str]] = {"hardening spring": "position_force"}
# Where the scenario's size stands in the trace's result: parameter and factor.
SIZE_OF: Final[Mapping[str, tuple[str, float]]] = {
    "coulomb_friction": ("Fc", 1.0), "base_inclination": ("", 1.0),
    "joint_spring": ("k_spring", 1.0), "torque_offset": ("", 1.0),
    "spool_offset": ("u_null", 1.0), "internal_leakage": ("c_internal", 1.0),
    "external_leakage": ("", 1.0), "tank_pressure": ("p_tank", 1.0),
    "valve_deadband": ("w_ahead", 1.0), "spool_lag": ("", 1.0), "sensor_gain": ("", 1.0),
    "sensor_offset": ("", 1.0), "channel_delay": ("", 1.0), "dead_volume": ("", 1.0),
    "pressure_dependent_friction": ("k_friction", 1.0),
}  # fmt: skip


@dataclass(frozen=True)
class Case:
    """One experiment: scenario text, its kind, the right names and places, the seed.

    With `machine` the bench and what it hides are drawn by the seed (`study_machines`); `bent` says
    how its records are changed afterwards (`study_distorted`). `form` is the mechanism that may
    stand for what has no name, its curve drawn by the data.
    """

    kind: str
    label: str
    scenario: str
    truth: tuple[tuple[str, str], ...]
    seed: int
    sizes: tuple[float, ...] = ()
    moves: str = ""
    noise: float = 1.0
    machine: bool = False
    bent: str = ""
    form: str = ""


def place_of(where: str) -> str:
    """Return the trace's place of a scenario's place or channel (`joint 1 cap`, `bench`)."""
    if not where.startswith("channel "):
        return where
    kind, joint = where.removeprefix("channel ").rsplit("_", 1)
    side = {"cap_pressure": " cap", "rod_pressure": " rod"}.get(kind, "")
    return f"joint {joint}{side}"


def effect_text(
    sizes: Sizes, joint: int, level: int, form: str = ""
) -> tuple[str, tuple[str, str], float]:
    """Return the scenario's text of one effect, its name and place, and its size in SI."""
    name, where, key, levels, other = sizes
    place = where.format(j=joint)
    at = (
        f"channel: {place.removeprefix('channel ')}"
        if place.startswith("channel ")
        else (f"where: {place}")
    )
    more = (other, f"form: {form}" if form else "")
    text = ", ".join(filter(None, (f"{{name: {name}, {at}, {key}: {levels[level]}", *more))) + "}"
    return text, (name, place_of(place)), si_size(levels[level])


def si_size(text: str) -> float:
    """Return the SI value of a size such as ``8 mV`` or ``1.03``."""
    from rig.model.quantity import unit_map

    number, _, unit = text.partition(" ")
    base = {
        "N": "N", "N/Pa": "N/Pa", "deg": "rad", "N*m/rad": "N*m/rad", "N*m": "N*m", "mV": "V",
        "N*s/m": "N*s/m", "ms": "s", "m^3/(s*Pa)": "m^3/(s*Pa)", "MPa": "Pa", "%": "",
        "cm^3": "m^3", "": "",
    }[unit]  # fmt: skip
    if unit == "%":
        return float(number) / 100
    scale = unit_map(unit, base)[0] if unit and unit != base else 1.0
    return float(number) * scale


NOISE: Final = (1.0, 0.5, 1.0, 2.0)  # times the rig's stated sensor noise, in turn


def cases(
    counts: Mapping[str, int], seed: int, only: Sequence[str] = (), level: int | None = None,
    forms: bool = False,
) -> list[Case]:  # fmt: skip
    """Return `counts[kind]` cases of each kind (of single: of each effect).

    The seeds of each kind go on from `seed`, so that more of one kind leave the others as they are.

    Places and partners are drawn by `seed`, sizes and noise go in turn; with `forms` each effect
    has one of its other forms (`PlantEffect.forms`), in turn. Raises InputError for a
    kind that does not exist.
    """
    unknown = sorted(set(counts) - {NONE, SINGLE, PAIR, OUTSIDE})
    if unknown:
        raise InputError(f"kind {unknown[0]!r}: expected none, single, pair or outside")
    out: list[Case] = []
    for kind, count in counts.items():
        rng = np.random.default_rng([seed, len(kind)])
        if kind == SINGLE:
            drawn = _singles(count, rng, only, level, forms)
        else:
            drawn = {NONE: _clean, PAIR: _pairs, OUTSIDE: _strangers}[kind](count, rng)
        for k, (label, members, text, moves) in enumerate(drawn):
            noise = NOISE[k % len(NOISE)]
            scenario = f"effects: [{text}]\nnoise: {noise:g}"
            truth = tuple(key for _, key, _ in members)
            sizes = tuple(size for *_, size in members)
            out.append(
                Case(
                    kind, label, scenario, truth, seed + k, sizes, moves, noise,
                    form=FORM_OF.get(label, ""),
                )
            )  # fmt: skip
    return out


Drawn = tuple[str, Sequence[tuple[str, tuple[str, str], float]], str, str]


def _clean(count: int, rng: np.random.Generator) -> list[Drawn]:
    return [("none", (), "", "")] * count


def _singles(
    count: int, rng: np.random.Generator, only: Sequence[str], level: int | None, forms: bool
) -> list[Drawn]:
    out = []
    for sizes in SINGLES:
        if only and sizes[0] not in only:
            continue
        for k in range(count):
            size = level if level is not None else 2 - k % 3
            others = FORMS.get(sizes[0], ())[1:] if forms else ()
            form = others[k % len(others)] if others else ""
            out.append(_drawn([(sizes, int(rng.integers(1, 3)), size, form)]))
    return out


def _pairs(count: int, rng: np.random.Generator) -> list[Drawn]:
    loud = [s for s in SINGLES if s[0] not in QUIET]
    out = []
    for _ in range(count):
        one, two = rng.choice(len(loud), size=2, replace=False)
        out.append(_drawn([(loud[int(i)], int(rng.integers(1, 3)), 2, "") for i in (one, two)]))
    return out


def _strangers(count: int, rng: np.random.Generator) -> list[Drawn]:
    out: list[Drawn] = []
    for k in range(count):
        label, moves, text = STRANGERS[k % len(STRANGERS)]
        out.append((label, (), text % int(rng.integers(1, 3)), moves))
    return out


def _drawn(members: Sequence[tuple[Sizes, int, int, str]]) -> Drawn:
    built = [effect_text(*m) for m in members]
    label = " + ".join(
        f"{m[0][3][m[2]]} {key[0]} at {key[1]}" + (f" ({m[3]})" if m[3] else "")
        for m, (_, key, _) in zip(members, built, strict=True)
    )
    return label, built, ", ".join(text for text, _, _ in built), ""
