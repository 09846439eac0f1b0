"""A quick spool under a held command: its path between samples is no late sensor."""

from __future__ import annotations

from dataclasses import replace

import pytest

from analysis.effects.measurement_delay import ChannelDelay, SensorLag
from analysis.effects.valve import SpoolLag
from analysis.trace import engine
from analysis.trace.data import trace_rows
from analysis.trace.data.candidates import catalogue
from analysis.trace.result import CLEAN
from rig.runs.rigs import load_rig
from tests.studies.foreign import plant
from tests.studies.foreign.bench import records_of
from tests.studies.foreign.cases import NONE, case_of


@pytest.mark.slow
def test_a_spool_that_bends_between_samples_is_nothing_to_name(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Joint 1 of a machine with nothing wrong, whose first-order spools take 1.2 ms."""
    bench = case_of(41, kind=NONE, spool=plant.FIRST_ORDER).bench
    joints = tuple({**own, "spool_time": 1.2e-3} for own in bench.joints)
    bench = replace(bench, joints=joints, noise=0.25, rms=0.05, seconds=4.0)
    train = records_of(bench, ("step2",), 410, 1.0, repeats=4)
    held_out = records_of(bench, ("step2",), 411, 0.7, repeats=2)
    late = catalogue(bench.rig, (ChannelDelay.name,))

    result = engine.trace([train], [held_out], late, look_ahead=False, free_forms=False)
    assert (result.verdict, result.effects) == (CLEAN, ())
    monkeypatch.setattr(trace_rows, "path_terms", lambda _: ())
    without = engine.trace([train], [held_out], late, look_ahead=False, free_forms=False)
    assert without.verdict != CLEAN  # what stays of its path passes for a late channel
    found = (*without.effects, *without.refused)
    assert (ChannelDelay.name, "joint 1") in [(e.name, e.where) for e in found]


@pytest.mark.parametrize("late", [SpoolLag("joint 1"), ChannelDelay("joint 1 spool"),
                                  SensorLag("bench spool")])  # fmt: skip
def test_no_spool_is_named_late_by_less_than_its_path_may_bend(late: SpoolLag) -> None:
    rig = load_rig("shinshu-2dof")
    assert "between samples" in late.problem(rig, {}, (5e-5,))
    assert not late.problem(rig, {}, (1e-3,))
