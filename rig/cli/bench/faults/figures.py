"""Figures of the group `faults` of `bramah bench`."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from hil_sim.faults.wire import WireFault
from hil_sim.link.served import SERVED
from rig.cli.bench.faults.bench import fault_bench
from rig.cli.bench.faults.trials import Diagnosis, TrialOutcome, kinds, try_fault, with_timeout
from rig.cli.bench.figure import Figure
from rig.cli.text.output import Say
from rig.runs.rigs import load_rig

RIG: Final = "shinshu-2dof"
GROUP: Final = "faults"
LEAST: Final = 500  # faults
TIMEOUT: Final = 0.1  # [s]: a device in virtual time may take ten times as long
REAL_TIME_ONLY: Final = frozenset({"clock_drift"})
_WITHIN: Final = 2.0  # [s] of excitation within which a frozen or stuck signal must be detected
_FROZEN: Final = ("sensor_stuck", "valve_stuck", "broken_wire")


def jobs(wire: str, least: int) -> Iterator[tuple[int, str]]:
    """Yield (seed, fault) for a wire's share of at least `least` trials, every fault in turn."""
    names = [name for name in kinds() if name not in REAL_TIME_ONLY]
    rounds = -(-least // (len(names) * len(SERVED)))
    for number in range(rounds * len(names)):
        yield SERVED.index(wire) + len(SERVED) * number, names[number % len(names)]


def fault_trials(folder: Path, least: int, say: Say) -> list[TrialOutcome]:
    """Run at least `least` trials in virtual time, each with one fault."""
    with quiet(), ThreadPoolExecutor(len(SERVED)) as pool:  # trials wait more than they compute
        outcomes = pool.map(lambda wire: _on_wire(folder, wire, least, say), SERVED)
        return [outcome for part in outcomes for outcome in part]


def _on_wire(folder: Path, wire: str, least: int, say: Say) -> list[TrialOutcome]:
    rig, trials = with_timeout(load_rig(RIG), TIMEOUT), []
    chosen = list(jobs(wire, least))
    with fault_bench() as bench:
        for seed, name in chosen:
            trial_folder = folder / f"fault-{seed}"
            trials.append(try_fault(bench, rig, wire, name, trial_folder, seed, realtime=False))
            if len(trials) % 24 == 0:
                say(f"faults: {len(trials)} of {len(chosen)} on {wire}")
    return trials


def fault_figures(folder: Path, say: Say, least: int = LEAST) -> list[Figure]:
    """Inject faults on every wire; count outputs left on, samples lost, faults named."""
    say(f"faults: at least {least} trials on {', '.join(SERVED)}")
    return counted(fault_trials(folder, least, say))


def counted(outcomes: Sequence[TrialOutcome]) -> list[Figure]:
    """Return the counts of trials as figures."""
    counts = Counter(outcome.diagnosis for outcome in outcomes)
    classes = kinds()
    machine = [o for o in outcomes if not issubclass(classes[o.fault], WireFault)]
    frozen = [o for o in outcomes if o.fault in _FROZEN]
    late = [o for o in frozen if o.seconds is None or o.seconds > _WITHIN]
    return [
        Figure(GROUP, "faults injected", sum(o.struck for o in outcomes), "", LEAST, True),
        Figure(GROUP, "of them of machine, sensor or device", len(machine)),
        Figure(GROUP, "sessions, each with one kind of fault", len(outcomes)),
        Figure(GROUP, "outputs left on", sum(not o.zeroed for o in outcomes), "", 0.0),
        Figure(GROUP, "blocks taken", sum(o.blocks for o in outcomes)),
        Figure(GROUP, "of them not in records.h5", sum(o.lost_blocks for o in outcomes), "", 0.0),
        Figure(GROUP, "harmless: every sample came", counts[Diagnosis.HARMLESS]),
        Figure(GROUP, "samples missing and counted", counts[Diagnosis.COUNTED]),
        Figure(GROUP, "ended, named rightly", counts[Diagnosis.NAMED]),
        Figure(GROUP, "ended, cause left open", counts[Diagnosis.UNKNOWN]),
        Figure(GROUP, "ended, named wrongly", counts[Diagnosis.WRONG], "", 0.0),
        Figure(GROUP, "not noticed", counts[Diagnosis.UNNOTICED], "", 0.0),
        Figure(GROUP, "frozen or stuck, not within 2 s", len(late), "", 0.0),
    ]


@contextmanager
def quiet() -> Iterator[None]:
    """Suppress the log: the outcomes hold the hundreds of warnings that faults cause."""
    root = logging.getLogger()
    handlers, root.handlers = root.handlers, [logging.NullHandler()]
    try:
        yield
    finally:
        root.handlers = handlers
