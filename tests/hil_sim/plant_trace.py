"""What the tests know of the bench on their own: true signals, Newton and mass balances."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import rig as rig_package
from hil_sim.plant.interface import Law
from hil_sim.plant.plant import Plant
from hil_sim.scenario.file import Scenario, parse_scenario
from rig.model.parse import parse_model
from rig.model.rig import Rig

Array = NDArray[np.float64]
TEXT = (Path(rig_package.__file__).parent / "shipped" / "shinshu-2dof.yaml").read_text()
CLOSED = Law()
EDGES = ("C_pp", "C_pm", "C_mp", "C_mm")


def bench(rate: float = 1000.0, **sensors: Any) -> Rig:
    """Return the shipped bench sampled at `rate` [Hz], sensors changed by name."""
    rig = parse_model(Rig, TEXT, "shinshu-2dof.yaml")
    return rig.model_copy(
        update={"sample_rate": rate, "sensors": rig.sensors.model_copy(update=sensors)}
    )


def scenario(text: str) -> Scenario:
    """Read a scenario of one or more effects in YAML flow style."""
    return parse_scenario(f"effects: [{text}]", "today.yaml")


def sine(rig: Rig, amplitude: float, frequency: float = 1.0, **more: float) -> Law:
    """Return a sine command [V]."""
    n = round(rig.sample_rate / frequency)
    wave = np.sin(2.0 * np.pi * np.arange(n) / n)
    return Law(wave=wave, gain=amplitude, limit=4.0, **more)


@dataclasses.dataclass(frozen=True)
class Trace:
    """True signals at every tick: per joint (ticks, N), of the bench (ticks,)."""

    rig: Rig
    truth: dict[str, float]
    signals: dict[str, Array]

    def __getitem__(self, name: str) -> Array:
        return self.signals[name]

    @property
    def period(self) -> float:
        return 1.0 / self.rig.sample_rate

    def slope(self, x: Array) -> Array:
        """Differentiate by central differences of fourth order, (ticks - 4, ...)."""
        return (8.0 * (x[3:-1] - x[1:-3]) - (x[4:] - x[:-4])) / (12.0 * self.period)

    def missing_torque(self) -> Array:
        """Return what Newton's law asks for and the baseline model does not give, (ticks - 4, 2).

        M(q) q'' + h + Fv q' + g - G F, in relative angles as NOTES "Mechanics, 2 DOF" writes it.
        """
        t, q, v = self.truth, self["angle"][2:-2], self["rate"][2:-2]
        a = self.slope(self["rate"])
        c2, s2 = t["R12"] * np.cos(q[:, 1]), t["R12"] * np.sin(q[:, 1])
        inertia_1 = (t["M1"] + 2 * c2) * a[:, 0] + (t["M2"] + c2) * a[:, 1]
        inertia_2 = (t["M2"] + c2) * a[:, 0] + t["M2"] * a[:, 1]
        h1, h2 = -s2 * v[:, 1] * (2 * v[:, 0] + v[:, 1]), s2 * v[:, 0] ** 2
        g = self.rig.gravity
        g2 = t["W2"] * g * np.sin(q[:, 0] + q[:, 1])
        g1 = t["W1"] * g * np.sin(q[:, 0]) + g2
        need = np.stack([inertia_1 + h1 + g1, inertia_2 + h2 + g2], axis=1)
        for i, joint in enumerate(self.rig.joints):
            lever = joint.linkage.jacobian(q[:, i])
            need[:, i] += t[f"Fv{i + 1}"] * v[:, i] - lever * self.force()[2:-2, i]
        return need

    def missing_force(self) -> Array:
        """Return the same at the piston [N], positive if something pushes it out."""
        q = self["angle"][2:-2]
        levers = [j.linkage.jacobian(q[:, i]) for i, j in enumerate(self.rig.joints)]
        return self.missing_torque() / np.stack(levers, axis=1)

    def force(self) -> Array:
        """Return the cylinders' pressure force [N]."""
        areas = np.array([(j.cylinder.cap_area, j.cylinder.rod_area) for j in self.rig.joints])
        return areas[:, 0] * self["cap_pressure"] - areas[:, 1] * self["rod_pressure"]

    def flow(self, joint: int) -> tuple[Array, Array]:
        """Return C sqrt(dp) u of the open edges into cap and rod [m^3/s], zero lap, turbulent."""
        pp, pm, mp, mm = (self.truth[f"{name}_{joint + 1}"] for name in EDGES)
        u, cap, rod = (self[n][:, joint] for n in ("spool", "cap_pressure", "rod_pressure"))
        ps = self["supply_pressure"]
        out, back = np.maximum(u, 0.0), np.maximum(-u, 0.0)

        def root(p: Array) -> Array:
            return np.sign(p) * np.sqrt(np.abs(p))

        return (
            pp * out * root(ps - cap) - pm * back * root(cap),
            mm * back * root(ps - rod) - mp * out * root(rod),
        )

    def missing_flow(self, joint: int) -> tuple[Array, Array]:
        """Return what fills cap and rod beyond the baseline's edges [m^3/s], (ticks - 4,) each.

        A s' + V p' / b - edges, with b at the oil's temperature.
        """
        c, i = self.rig.joints[joint].cylinder, joint
        s, speed = self["piston"][2:-2, i], self["speed"][2:-2, i]
        warm = 1.0 - 0.004 * (self["oil_temperature"][2:-2] - self.rig.oil.temperature)
        b = self.truth["b"] * warm
        volume_cap, volume_rod = self.rig.chamber_volumes(i, s)
        edge_cap, edge_rod = (f[2:-2] for f in self.flow(joint))
        cap = c.cap_area * speed + volume_cap / b * self.slope(self["cap_pressure"][:, i])
        rod = -c.rod_area * speed + volume_rod / b * self.slope(self["rod_pressure"][:, i])
        return cap - edge_cap, rod - edge_rod


def watch(plant: Plant, rig: Rig, laws: Sequence[Law], seconds: float) -> Trace:
    """Run the plant tick by tick and keep its true state after each."""
    rows = []
    for _ in range(round(seconds * rig.sample_rate)):
        plant.advance(1, laws)
        rows.append(plant.snapshot())
    return Trace(rig, plant.truth(), {k: np.stack([r[k] for r in rows]) for k in rows[0]})


def story(
    laws: Sequence[Law], seconds: float, effects: str = "", rate: float = 2000.0, seed: int = 1
) -> Trace:
    """Watch a fresh bench with these effects."""
    rig = bench(rate)
    return watch(Plant(rig, scenario(effects), seed), rig, laws, seconds)
