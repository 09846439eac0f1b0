"""Times of the analysis and the plant: those of reference programs, and for growing sizes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, Final

import numpy as np

from analysis.effects.base import Effect
from analysis.identify.identify import identify
from analysis.identify.reduction import reduce_rows, solve_reductions
from analysis.simulation.simulate import compiled, simulate
from analysis.simulation.synthetic import multisine, synthetic_run
from analysis.terms import known, with_effects
from analysis.terms.base import Used, family_of
from hil_sim.plant.plant import Plant
from hil_sim.scenario.file import Scenario
from rig.cli.bench.figure import Figure, ProcessorTime, processor_time, processor_times
from rig.cli.bench.plant import hard_laws
from rig.cli.bench.speed.free_run import both_moving, free_run_times
from rig.cli.text.output import Say
from rig.model.records import Run
from rig.model.rig import Rig
from rig.runs.rigs import load_rig

BLOCK, TICKS = 10, 5000
# Sizes of the group `growth`.
GROWTH_RECORDS: Final = (3, 6, 12, 24)
GROWTH_SECONDS: Final = (5.0, 10.0, 20.0, 40.0)
GROWTH_RIGS: Final = ("boom-1dof", "shinshu-2dof", "digger-3dof")
# Largest number of effects added to the model, as a trace adds its candidates.
CANDIDATES: Final = 4


def ratio_figures(
    group: str, name: str, measured: ProcessorTime, anchor: tuple[str, ProcessorTime], limit: float
) -> list[Figure]:
    """Return a time, its reference, and their ratio with its limit."""
    other, reference = anchor
    return [
        Figure(group, name, 1e3 * measured.least, "ms"),
        Figure(group, f"{name}, median", 1e3 * measured.median, "ms"),
        Figure(group, other, 1e3 * reference.least, "ms"),
        Figure(group, f"{other}, median", 1e3 * reference.median, "ms"),
        Figure(group, f"{name} over {other}", measured.least / reference.least, "x as long", limit),
    ]


def free_run_figures(rig: Rig) -> list[Figure]:
    """Measure a free run of 10 s and other solvers of the same equations."""
    group, times = "analysis", free_run_times(rig)
    bramah, hand = times["bramah"], times["hand"]
    figures = [
        *ratio_figures(
            group, "free run of 10 s, both joints", bramah, ("the same by hand", hand), 1.4
        ),
        Figure(group, "free run", times["times_real_time"], "x real time", 500, True),
        Figure(group, "difference of the two", times["difference_to_hand"], "rad", 1e-9),
        Figure(group, "its largest error over a state's range", times["error"]),
    ]
    for name, limit in (("odeint", 9.0), ("cvodes", 14.0)):
        if name in times:
            other = times[name]
            figures += [
                Figure(group, f"{name}, as exact", 1e3 * other.least, "ms"),
                Figure(group, f"{name}, median", 1e3 * other.median, "ms"),
                Figure(group, f"{name}, its error", times[f"{name}_error"]),
                Figure(
                    group,
                    f"{name} over free run",
                    other.least / bramah.least,
                    "x as long",
                    limit,
                    True,
                ),
            ]
    return figures


def plant_over_kernel(rig: Rig) -> list[Figure]:
    """Measure the plant in blocks of 10 ticks, as served, and in one call of its compiled loop."""

    def run(ticks: int) -> Callable[[], None]:
        plant, laws = Plant(rig, Scenario(), 1), hard_laws(rig)

        def work() -> None:
            for _ in range(TICKS // ticks):
                plant.advance(ticks, laws)

        return work

    times = processor_times({"blocks": run(BLOCK), "kernel": run(TICKS)})
    blocks, kernel = times["blocks"], times["kernel"]
    seconds = TICKS / rig.sample_rate
    return [
        Figure("plant", "in blocks of 10", seconds / blocks.least, "x real time", 160, True),
        *ratio_figures("plant", "5 s in blocks of 10", blocks, ("5 s at once", kernel), 1.1),
    ]


def bench_run(rig: Rig, repeats: int = 10, seconds: float = 10.0) -> Run:
    """Return `repeats` synthetic records of each lock-and-excite step (two joints: three steps)."""
    rng = np.random.default_rng(0)
    wave = multisine(rng, rig.sample_rate, 10.0, 9.5)
    return synthetic_run(rig, rng, wave, rms=0.025, repeats=repeats, seconds=seconds)


def identify_figures(run: Run, loading: float) -> list[Figure]:
    """Measure identification from a run that was loaded in `loading` [s], and parts of it.

    Processor times: of identifying the first twelve records; of the solve, which computes values
    and covariance from the records' triangular factors; of numpy's `lstsq`, which computes the
    values alone from all rows.
    """
    identify([Run(run.rig, run.records[:1])])  # imports and FFT plans are not measured
    started = time.perf_counter()
    result = identify([run])
    seconds = time.perf_counter() - started
    twelve = Run(run.rig, run.records[:12])
    terms = result.model.terms
    reductions = reduce_rows(run.rig, terms, result.built)
    rows = [(family_of(name), r) for item in result.built for name, r in item.rows.items()]
    stacked = [
        (
            np.concatenate([r.matrix for of, r in rows if of == family]),
            np.concatenate([r.rhs for of, r in rows if of == family]),
        )
        for family in sorted({of for of, _ in rows})
    ]
    works: dict[str, Callable[[], object]] = {
        "solve": lambda: solve_reductions(run.rig, terms, reductions),
        "lstsq": lambda: [np.linalg.lstsq(X, y, rcond=None) for X, y in stacked],
    }
    first = processor_time(lambda: identify([twelve]))
    times = processor_times(works)
    return [
        Figure("analysis", "records of 10 s", len(run.records)),
        Figure("analysis", "load and identify", loading + seconds, "s", 5.0),
        Figure("analysis", "of it the solve", 1e3 * result.solve_seconds, "ms", 50.0),
        *ratio_figures("analysis", "solve", times["solve"], ("numpy's lstsq", times["lstsq"]), 1.1),
        Figure("analysis", "identify 12 of them", 1e3 * first.least, "ms", 300.0),
        Figure("analysis", "identify 12 of them, median", 1e3 * first.median, "ms"),
    ]


def growth_figures(say: Say) -> list[Figure]:
    """Measure processor times of identification and simulation for growing sizes, least of five."""
    figures = []
    for name, work in _works(load_rig("shinshu-2dof")):
        say(f"growth: {name}")
        work()  # excludes imports and compilation
        figures.append(Figure("growth", name, 1e3 * processor_time(work).least, "ms"))
    return figures


def _works(rig: Rig) -> Iterator[tuple[str, Callable[[], Any]]]:
    for n in GROWTH_RECORDS:
        run = bench_run(rig, repeats=n // 3)
        yield f"identify, {n} records of 10 s", partial(identify, [run])
    for length in GROWTH_SECONDS:
        run = bench_run(rig, repeats=2, seconds=length)
        yield f"identify, 6 records of {length:g} s", partial(identify, [run])
    yield from _joints()
    yield from _candidates(rig)


def _joints() -> Iterator[tuple[str, Callable[[], Any]]]:
    for rig in (*map(load_rig, GROWTH_RIGS), four_joints(load_rig("digger-3dof"))):
        n = len(rig.joints)
        run = bench_run(rig, repeats=2)
        yield f"identify, {len(run.records)} records, {n} joint(s)", partial(identify, [run])
        model, drive, start = both_moving(rig)
        yield f"free run of 10 s, {n} joint(s)", partial(simulate, compiled(model), drive, start)


def _linear_effects(rig: Rig) -> list[str]:
    """Return the names of the joint effects that need no shape parameters, sorted."""
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
            partial(identify, [run], terms=used),
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
