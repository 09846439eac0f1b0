"""The tables of docs/faults.md, made of real sessions: one a fault, and many."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

from drivers.base import DeviceLost
from hil_sim.device.server import TCP
from hil_sim.faults.device import DeviceFault
from hil_sim.faults.wire import WireFault
from hil_sim.link.served import SERVED
from rig.cli.bench.faults.bench import fault_bench
from rig.cli.bench.faults.figures import RIG, counted, quiet
from rig.cli.bench.faults.trials import TrialOutcome, kinds, try_fault
from rig.cli.bench.figures import text
from rig.model.trips import SafetyTrip
from rig.runs.rigs import load_rig

HEADER = ("fault", "wire", "what notices", "after", "what the operator reads", "what is kept")
_PLACE = re.compile(r"(/tmp/\S*?/line|127\.0\.0\.1:\d+)")
Say = Callable[[str], None]


def table_rows() -> list[tuple[str, str]]:
    """Return every (fault, wire) that the table has a row for.

    A fault of machine or sensor is the same on every wire.
    """
    rows = []
    for name, kind in kinds().items():
        everywhere = issubclass(kind, WireFault | DeviceFault)
        rows += [(name, wire) for wire in (SERVED if everywhere else (TCP,))]
    return rows


def one_of_each(folder: Path, say: Say) -> list[TrialOutcome]:
    """Run one session in real time for each row of the table."""
    rig, found = load_rig(RIG), []
    with fault_bench() as bench, quiet():
        for seed, (name, wire) in enumerate(table_rows()):
            say(f"{name} on {wire}")
            place = folder / f"one-{seed}"
            found.append(try_fault(bench, rig, wire, name, place, seed, realtime=True))
    return found


def noticed(outcomes: Sequence[TrialOutcome]) -> str:
    """Return the table of one session a fault as Markdown."""
    rows = [HEADER, tuple("---" for _ in HEADER)]
    for outcome in outcomes:
        kind = kinds()[outcome.fault]
        every = issubclass(kind, WireFault | DeviceFault)
        after = "" if outcome.seconds is None else f"{outcome.seconds:.2f} s"
        rows.append(
            (
                f"`{outcome.fault}`",
                outcome.wire if every else "any",
                _what_notices(outcome),
                after,
                _PLACE.sub("ENDPOINT", outcome.message),
                _kept(outcome),
            )
        )
    return "\n".join("| " + " | ".join(cells) + " |" for cells in rows)


def _by_fault(outcomes: Sequence[TrialOutcome]) -> list[tuple[str, ...]]:
    """Return a row for each fault and wire: how often each diagnosis came, and the slowest end."""
    groups: dict[tuple[str, str], list[TrialOutcome]] = {}
    for fault in dict.fromkeys(outcome.fault for outcome in outcomes):
        for wire in SERVED:
            group = [o for o in outcomes if o.fault == fault and o.wire == wire]
            if group:
                groups[fault, wire] = group
    rows: list[tuple[str, ...]] = []
    for (fault, wire), group in groups.items():
        diagnoses = Counter(str(o.diagnosis) for o in group).most_common()
        ends = [o.seconds for o in group if o.seconds is not None]
        rows.append((
            fault, wire, str(len(group)), ", ".join(f"{count} {name}" for name, count in diagnoses),
            f"{max(ends):.2f} s" if ends else "",
        ))  # fmt: skip
    return rows


def counts(outcomes: Sequence[TrialOutcome]) -> str:
    """Return the counts of many sessions as Markdown: the figures, then a row a fault and wire."""
    head = ("fault", "wire", "sessions", "ended as", "slowest end")
    rows = [head, tuple("---" for _ in head), *_by_fault(outcomes)]
    table = "\n".join("| " + " | ".join(cells) + " |" for cells in rows)
    return f"```text\n{text(counted(outcomes))}\n```\n\n{table}"


def _what_notices(outcome: TrialOutcome) -> str:
    error = outcome.error
    if isinstance(error, SafetyTrip):
        return f"guard: {error.limit}"
    if error is not None:
        return "driver: device lost" if isinstance(error, DeviceLost) else "driver: refuses it"
    if outcome.alarm is not None:
        return f"guard warns: {outcome.alarm.check}"
    if outcome.missing:
        return "driver: counts what is missing"
    again = [line for line in outcome.warnings if "again" in line or "dropped" in line]
    if again:
        return f"driver: asks again ({len(again)} times)"
    return "nothing" if outcome.diagnosis == "unnoticed" else "nothing has to: every sample came"


def _kept(outcome: TrialOutcome) -> str:
    whole = outcome.blocks - outcome.lost_blocks
    kept = f"all {whole} blocks" if not outcome.lost_blocks else f"{whole} of {outcome.blocks}"
    return f"{kept}, {outcome.missing} samples marked missing" if outcome.missing else kept
