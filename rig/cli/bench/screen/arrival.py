"""Lateness of blocks while screens open, close and are killed, and age of the drawn values.

The screen shows its page of diagnostics, which prints the device's tick of the newest sample. The
text is time-stamped where it is read from the terminal, so that an age includes device, wire, run,
socket, screen and terminal.
"""

from __future__ import annotations

import itertools
import math
import re
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rig.cli.bench.acquisition import lateness
from rig.cli.bench.figure import Figure
from rig.cli.bench.screen.runs import RIG, RunTimes, played
from rig.cli.bench.screen.stops import ATTACH, SEED
from rig.cli.bench.screen.terminal import Screen
from rig.cli.errors import WorkError
from rig.cli.simulated.simulated_bench import simulated_bench
from rig.runs.rigs import load_rig

Array = NDArray[np.float64]

AGE_LIMIT: Final = 250.0  # [ms], age of the newest sample on the screen, 99 % of the time
# Lateness that a screen may add, in standard deviations of the lateness without one.
NOISE: Final = 1.0
SLICE: Final = 1.0  # length of the slices of a phase whose medians are compared [s]
SETTLE: Final = 3.0  # wait after a screen was opened or closed, before a phase is measured [s]
PAGE: Final = "4"  # key of the page of diagnostics
_LINE: Final = 40  # number of characters that contain a tick
_TICK: Final = re.compile(r"\btick (\d+)")


@dataclass(frozen=True)
class Phase:
    """Part of a run between two monotonic times [s], with or without a screen."""

    name: str
    first: float
    last: float
    screen: bool


def ages_on_screen(
    drawn: Iterable[tuple[float, str]], origin: float, rate: float
) -> tuple[Array, Array]:
    """Return (age when drawn, time until the next) [s], each (n,), of the ticks in drawn text.

    A value ages on the screen until the next one is drawn.
    """
    samples: list[tuple[float, float]] = []
    newest, before = -1, ""
    for at, piece in drawn:
        text = before + piece  # a line may arrive in two pieces
        before = text[-_LINE:]
        for match in _TICK.finditer(text):
            tick = int(match[1])
            if tick > newest:
                newest = tick
                samples.append((at, at - (origin + tick / rate)))
    moments, ages = np.array(samples).reshape(-1, 2).T
    return ages[:-1], np.diff(moments)


def age_quantile(ages: Array, stays: Array, share: float) -> float:
    """Return the age [s] that the values on the screen do not exceed for a `share` of the time.

    Value k has the age `ages[k]` when drawn and is shown for `stays[k]` [s]. The time spent below
    an age x is therefore the sum of clip(x - ages, 0, stays); this piecewise linear function of x
    is inverted.
    """
    corners = np.sort(np.concatenate((ages, ages + stays)))
    below = np.array([np.clip(x - ages, 0.0, stays).sum() for x in corners])
    return float(np.interp(share * stays.sum(), below, corners))


def phase_medians(phase: Phase, arrivals: Array, late: Array) -> Array:
    """Return the median lateness [s] of every complete slice of a phase."""
    count = max(int((phase.last - phase.first) / SLICE), 1)
    edges = np.searchsorted(arrivals, phase.first + SLICE * np.arange(count + 1))
    pairs = itertools.pairwise(edges)
    return np.array([np.median(late[first:last]) for first, last in pairs if last > first])


def arrival_figures(runtime: Path, say: Callable[[str], None], seconds: float) -> list[Figure]:
    """Measure lateness of a run's blocks, `seconds` per phase, and ages on an open screen."""
    say(f"screen: arrival of blocks with the screen closed, open, killed, restarted: {seconds:g} s")
    phases: list[Phase] = []

    def measure(name: str, screen: Screen | None) -> None:
        time.sleep(SETTLE)
        first = time.monotonic()
        time.sleep(seconds)
        phases.append(Phase(name, first, time.monotonic(), screen is not None))

    with (
        simulated_bench(RIG, seed=SEED, real_time=True) as endpoint,
        played(endpoint, runtime, runtime / "watched", driven=False) as run,
    ):
        measure("closed", None)
        drawn: list[list[tuple[float, str]]] = []  # drawn text of each screen
        for name, after in (("open", "killed"), ("restarted", "closed again")):
            with Screen(runtime) as screen:
                if not run.has_sent("watched", ATTACH):
                    raise WorkError("bench --only screen: the screen did not attach")
                screen.press(PAGE)
                measure(name, screen)
                drawn.append(screen.texts(phases[-1].first, phases[-1].last))
            measure(after, None)
        times = run.end()
    return [*_lateness_figures(times, phases), *_age_figures(times, drawn)]


def _lateness_figures(times: RunTimes, phases: list[Phase]) -> list[Figure]:
    late, _ = lateness(times.ends, times.arrivals)
    figures = [Figure("screen", "blocks of the run", len(late)),
               Figure("screen", "samples lost", times.lost, "", 0.0)]  # fmt: skip
    medians: dict[bool, list[Array]] = {True: [], False: []}
    for phase in phases:
        inside = (times.arrivals >= phase.first) & (times.arrivals < phase.last)
        part = 1e3 * late[inside]
        for word, share in (("median", 0.5), ("99 %", 0.99)):
            name = f"lateness of blocks, {word}, screen {phase.name}"
            figures.append(Figure("screen", name, float(np.quantile(part, share)), "ms"))
        medians[phase.screen].append(phase_medians(phase, times.arrivals, late))
    with_it, without = np.concatenate(medians[True]), np.concatenate(medians[False])
    added = float(with_it.mean() - without.mean())
    noise = float(without.std(ddof=1)) if len(without) > 1 else math.nan
    return [
        *figures,
        Figure("screen", "lateness, median, that a screen adds", 1e3 * added, "ms"),
        Figure("screen", "the same over its deviation without", added / noise, "", NOISE),
    ]


def _age_figures(times: RunTimes, drawn: list[list[tuple[float, str]]]) -> list[Figure]:
    rate = load_rig(RIG).sample_rate
    of_screens = [ages_on_screen(picture, times.origin, rate) for picture in drawn]
    ages, stays = (np.concatenate(parts) for parts in zip(*of_screens, strict=True))
    if not len(ages):
        raise WorkError("bench --only screen: no tick was drawn on the page of diagnostics")
    quantile = {share: 1e3 * age_quantile(ages, stays, share) for share in (0.5, 0.99, 1.0)}
    return [
        Figure("screen", "pictures a second", 1.0 / float(stays.mean())),
        Figure("screen", "sample age on screen, median", quantile[0.5], "ms"),
        Figure("screen", "sample age on screen, 99 %", quantile[0.99], "ms", AGE_LIMIT),
        Figure("screen", "sample age on screen, worst", quantile[1.0], "ms"),
    ]
