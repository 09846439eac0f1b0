"""Times and those of their reference programs, as figures."""

from __future__ import annotations

from collections.abc import Callable

from hil_sim.plant.plant import Plant
from hil_sim.scenario.file import Scenario
from rig.cli.bench.figure import Figure
from rig.cli.bench.plant import hard_laws
from rig.cli.bench.speed.free_run import free_run_times
from rig.cli.bench.timing import ProcessorTime, processor_times
from rig.model.rig import Rig

BLOCK, TICKS = 10, 5000


def ratio_figures(
    group: str,
    name: str,
    own: ProcessorTime,
    anchor: tuple[str, ProcessorTime] | None,
    limit: float | None,
) -> list[Figure]:
    """Return a time, its reference and their ratio; `limit` bounds the ratio, else the time."""
    bound = None if anchor else limit
    figures = [
        Figure(group, name, 1e3 * own.least, "ms", bound),
        Figure(group, f"{name}, median", 1e3 * own.median, "ms"),
    ]
    if anchor is None:
        return figures
    other, time = anchor
    return [
        *figures,
        Figure(group, other, 1e3 * time.least, "ms"),
        Figure(group, f"{other}, median", 1e3 * time.median, "ms"),
        Figure(group, f"{name} over {other}", own.least / time.least, "x as long", limit),
    ]


def free_run_figures(rig: Rig) -> list[Figure]:
    """Measure a free run of 10 s and other solvers of the same equations."""
    group, times = "analysis", free_run_times(rig)
    own, hand = times["own"], times["hand"]
    figures = [
        *ratio_figures(
            group, "free run of 10 s, both joints", own, ("the same by hand", hand), 1.4
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
                    other.least / own.least,
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
