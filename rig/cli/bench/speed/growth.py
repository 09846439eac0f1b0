"""Processor time against the number of records, their length, joints and candidate effects."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, Final

from analysis.effects.base import Effect
from analysis.identify.identify import identify
from analysis.simulation.simulate import compiled, simulate
from analysis.terms import known, with_effects
from analysis.terms.base import Used
from rig.cli.bench.figure import Figure, processor_time
from rig.cli.bench.speed.figures import bench_run
from rig.cli.bench.speed.free_run import both_moving
from rig.cli.text.output import Say
from rig.model.rig import Rig
from rig.runs.rigs import load_rig

GROUP: Final = "growth"
RECORDS: Final = (3, 6, 12, 24)
SECONDS: Final = (5.0, 10.0, 20.0, 40.0)
RIGS: Final = ("boom-1dof", "shinshu-2dof", "digger-3dof")
# Largest number of effects added to the model, as a trace adds its candidates.
CANDIDATES: Final = 4


def growth_figures(say: Say) -> list[Figure]:
    """Measure processor times of identification and simulation for growing sizes, least of five."""
    figures = []
    for name, work in _works(load_rig("shinshu-2dof")):
        say(f"growth: {name}")
        work()  # excludes imports and compilation
        figures.append(Figure(GROUP, name, 1e3 * processor_time(work).least, "ms"))
    return figures


def _works(rig: Rig) -> Iterator[tuple[str, Callable[[], Any]]]:
    for n in RECORDS:
        run = bench_run(rig, repeats=n // 3)
        yield f"identify, {n} records of 10 s", lambda run=run: identify([run])  # type: ignore[misc]
    for length in SECONDS:
        run = bench_run(rig, repeats=2, seconds=length)
        yield f"identify, 6 records of {length:g} s", lambda run=run: identify([run])  # type: ignore[misc]
    yield from _joints()
    yield from _candidates(rig)


def _joints() -> Iterator[tuple[str, Callable[[], Any]]]:
    for rig in (*map(load_rig, RIGS), four_joints(load_rig("digger-3dof"))):
        n = len(rig.joints)
        run = bench_run(rig, repeats=2)
        yield f"identify, {len(run.records)} records, {n} joint(s)", lambda r=run: identify([r])  # type: ignore[misc]
        model, drive, start = both_moving(rig)
        ready = compiled(model)
        yield (
            f"free run of 10 s, {n} joint(s)",
            lambda a=ready, b=drive, c=start: simulate(a, b, c),  # type: ignore[misc]
        )


def _linear_effects(rig: Rig) -> list[str]:
    """Return the names of the joint effects that need no shape parameters, in catalogue order."""
    joint_effects = {
        name: kind("joint 1")
        for name, kind in known().items()
        if issubclass(kind, Effect) and "joint 1" in kind.places(rig)
    }
    return sorted(
        name for name, effect in joint_effects.items() if all(s.detail for s in effect.shapes(rig))
    )


def _candidates(rig: Rig) -> Iterator[tuple[str, Callable[[], Any]]]:
    run = bench_run(rig, repeats=2)
    for count in range(0, CANDIDATES + 1, 2):
        used = [Used(term) for term in with_effects(rig, _linear_effects(rig)[:count])]
        yield (
            f"identify, 6 records, {count} effects of every joint beside the model",
            lambda u=used: identify([run], terms=u),  # type: ignore[misc]
        )


def four_joints(rig: Rig) -> Rig:
    """Return a rig of three joints with a light fourth link at the end of its chain.

    A link of mass m, with its centre of mass at the distance c from its joint, adds m L_i L_j to
    R_ij and m L_i to W_i, and has R_i4 = m c L_i, R_44 = m c^2 + I, W_4 = m c; L_i are the lengths
    of the preceding links.
    """
    mass, centre, inertia = 1.0, 0.15, 0.03
    lengths = (0.8, 0.45, 0.4)
    nominal = dict(rig.nominal)
    for i, reach in enumerate(lengths, start=1):
        for j in range(i, 4):
            nominal[f"R{i}{j}"] += mass * reach * lengths[j - 1]
        nominal[f"R{i}4"] = mass * centre * reach
        nominal[f"W{i}"] += mass * reach
    nominal |= {"R44": mass * centre**2 + inertia, "W4": mass * centre, "Fv4": nominal["Fv3"]}
    for edge in ("pp", "pm", "mp", "mm"):
        nominal[f"C_{edge}_4"] = nominal[f"C_{edge}_3"]
    joints = (*rig.joints, rig.joints[-1])
    return rig.model_copy(update={"name": f"{rig.name}-4", "joints": joints, "nominal": nominal})
