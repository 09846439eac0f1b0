"""A quick spool under a held command: its path between samples is no late sensor."""

from __future__ import annotations

from dataclasses import replace

import pytest

from analysis.effects.measurement import ChannelDelay, SensorLag
from analysis.effects.valve import SpoolLag
from analysis.trace import engine, finding
from analysis.trace.result import CLEAN, Trace
from rig.runs.rigs import load_rig
from tests.studies.foreign import plant
from tests.studies.foreign.bench import runs_of
from tests.studies.foreign.cases import NONE, case_of


def traced() -> Trace:
    """Trace a machine with nothing wrong whose first-order spools take 1.2 ms."""
    bench = case_of(41, kind=NONE, spool=plant.FIRST_ORDER).bench
    joints = tuple({**own, "spool_time": 1.2e-3} for own in bench.joints)
    bench = replace(bench, joints=joints, noise=0.25, repeats=4, rms=0.05)
    train, held_out = runs_of(bench, 41)
    return engine.trace([train], held_out, look_ahead=False, free_forms=False)


def test_a_spool_that_bends_between_samples_is_nothing_to_name(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    result = traced()
    assert (result.verdict, result.effects) == (CLEAN, ())
    monkeypatch.setattr(finding, "path_terms", lambda _: ())
    assert traced().verdict != CLEAN  # the same records without it


@pytest.mark.parametrize("late", [SpoolLag("joint 1"), ChannelDelay("joint 1 spool"),
                                  SensorLag("bench spool")])  # fmt: skip
def test_no_spool_is_named_late_by_less_than_its_path_may_bend(late: SpoolLag) -> None:
    rig = load_rig("shinshu-2dof")
    assert "between samples" in late.problem(rig, {}, (5e-5,))
    assert not late.problem(rig, {}, (1e-3,))
