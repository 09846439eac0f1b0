"""Records are bent as nothing in simulator or catalogue would, and as little as is said."""

from __future__ import annotations

import math

import numpy as np
import pytest

from rig.model.records import Record, Run
from rig.runs.rigs import load_rig
from tests.studies.trace import study as st
from tests.studies.trace.distorted import FAULTS, bent, cases_of
from tests.studies.trace.text import bent_text

RATE, SECONDS = 1000.0, 2.0


@pytest.fixture
def swinging() -> Run:
    """Joint 2 moved by a sine of 20 mm, joint 1 locked; then the other way round."""
    t = np.arange(round(RATE * SECONDS)) / RATE
    still, sine = np.zeros_like(t), 0.02 * np.sin(2 * np.pi * t)
    records = []
    for moved, locked in ((2, 1), (1, 2)):
        channels = {}
        for joint in (1, 2):
            s = sine if joint == moved else still
            channels |= {
                f"piston_{joint}": s, f"spool_{joint}": 0.1 * np.cos(2 * np.pi * t),
                f"cap_pressure_{joint}": 3e6 + 1e5 * s, f"rod_pressure_{joint}": 4e6 - 1e5 * s,
            }  # fmt: skip
        records.append(Record(f"step{moved}_r1", f"step{moved}", (locked,), 1, RATE, channels))
    return Run(load_rig("shinshu-2dof"), tuple(records))


def test_cases_are_drawn_by_seed_and_every_fault_has_its_turn() -> None:
    drawn = cases_of(2 * len(FAULTS), 100)
    assert drawn == cases_of(2 * len(FAULTS), 100)
    assert drawn[: len(FAULTS)] == cases_of(len(FAULTS), 100)
    assert {c.bent.partition(" ")[2] for c in drawn[: len(FAULTS)]} == {f.label for f in FAULTS}
    assert all(c.truth == () and c.moves for c in drawn)
    twice = zip(drawn, drawn[len(FAULTS) :], strict=False)
    assert all(a.sizes != b.sizes for a, b in twice)


@pytest.mark.parametrize("case", cases_of(len(FAULTS), 100), ids=lambda c: c.label)
def test_a_fault_changes_what_it_says_and_nothing_else(swinging: Run, case: st.Case) -> None:
    joint, _, label = case.bent.partition(" ")
    fault = next(f for f in FAULTS if f.label == label)
    cylinder = swinging.rig.joints[int(joint) - 1].cylinder
    changed = bent(swinging, case)
    for before, after in zip(swinging.records, changed.records, strict=True):
        differ = {n for n in before.channels if np.any(before.channels[n] != after.channels[n])}
        if fault.sensor is not None:
            assert differ <= {f"{fault.channel}_{joint}"}
            continue
        both = {f"cap_pressure_{joint}", f"rod_pressure_{joint}"}
        assert differ == (set() if int(joint) in before.locked else both)
        change = {n: after.channels[n] - before.channels[n] for n in both}
        # Half of the force on either side: pressures rise against each other by their areas.
        force = [
            cylinder.cap_area * change[f"cap_pressure_{joint}"],
            -cylinder.rod_area * change[f"rod_pressure_{joint}"],
        ]
        assert force[0] == pytest.approx(force[1], abs=1e-6)


def test_the_table_has_a_row_for_every_bench_in_the_order_drawn() -> None:
    drawn = cases_of(3, 100)
    outcomes = [
        st.Outcome(
            case, "unexplained", (), (), (), 5.0, math.nan, 2.0, 0.01, 90.0, 90.0,
            (f"{case.moves.split()[0]}_1",), (), 3.0,
        )
        for case in reversed(drawn)
    ]  # fmt: skip
    shown = bent_text(outcomes)
    places = [shown.index(case.label) for case in drawn]
    assert places == sorted(places)
    assert "outside" in shown
