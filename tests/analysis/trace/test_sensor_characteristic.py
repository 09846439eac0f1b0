"""A pressure sensor's characteristic: straight with a gain and an offset, or bent."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from analysis.terms import baseline, make
from analysis.terms.base import Used
from analysis.trace.data.candidates import at_start, catalogue
from analysis.trace.data.conditioned_record import conditioned_records
from analysis.trace.data.regression_data import regression_data
from analysis.trace.engine import trace
from analysis.trace.result import Trace
from analysis.trace.search import extensions as search_extensions
from analysis.trace.search.extensions import extensions
from analysis.trace.search.hypothesis_set import HypothesisSet
from analysis.trace.search.refinement import refine
from analysis.trace.settings import SEARCH
from rig.model.records import Run
from rig.model.rig import Rig
from tests.analysis.trace.hidden import pair_of_runs

Array = NDArray[np.float64]
SENSOR = "cap_pressure_2"


@pytest.fixture(scope="module")
def runs(rig: Rig) -> tuple[Run, Run]:
    return pair_of_runs(rig)


def read_by(run: Run, reading: Callable[[Array], Array]) -> Run:
    """Return a run whose sensor gives `reading` of the pressure (n,) [Pa]."""
    records = (
        replace(r, channels={**r.channels, SENSOR: reading(r.channels[SENSOR])})
        for r in run.records
    )
    return replace(run, records=tuple(records))


def traced(runs: tuple[Run, Run], reading: Callable[[Array], Array]) -> Trace:
    """Trace runs whose sensor gives `reading` of the pressure (n,) [Pa]."""
    train, held_out = (read_by(run, reading) for run in runs)
    names = ("sensor_gain", "sensor_offset", "sensor_crosstalk", "torque_offset")
    candidates = [e for e in catalogue(train.rig, names) if e.where.startswith("joint 2")]
    return trace([train], [held_out], candidates, look_ahead=False, free_forms=False)


@pytest.mark.parametrize(
    ("reading", "bent"),
    [
        (lambda p: 0.95 * p - 0.24e6, False),
        (lambda p: 1.05 * p - 0.3e6, False),
        (lambda p: 1.02 * p * np.exp(0.04 * p / 7e6), True),
    ],
)
def test_a_gain_is_bent_only_where_an_offset_beside_it_leaves_more(
    rig: Rig, runs: tuple[Run, Run], reading: Callable[[Array], Array], bent: bool
) -> None:
    """Over part of the range a bend does nearly what an offset does: the gain would be 7 % off."""
    terms = tuple(map(Used, baseline()))
    records = conditioned_records(rig, [read_by(runs[0], reading)])
    gain = at_start(rig, make("sensor_gain", "joint 2 cap"))
    fit = refine(regression_data(rig, terms, records), (*terms, gain))
    assert len(fit.terms[-1].shape) == (2 if bent else 1)


def test_a_gain_with_an_offset_is_not_taken_for_a_bent_characteristic(
    runs: tuple[Run, Run],
) -> None:
    result = traced(runs, lambda p: 0.95 * p - 0.24e6)
    assert result.verdict == "explained"
    assert {e.name for e in result.effects} == {"sensor_gain", "sensor_offset"}
    sizes = {name: p for e in result.effects for name, p in e.parameters.items()}
    assert sizes[f"gain_{SENSOR}"].value == pytest.approx(0.95, abs=2e-3)
    # The offset is of the pressure that the sensor multiplies.
    assert sizes[f"offset_{SENSOR}"].value == pytest.approx(-0.24e6 / 0.95, rel=0.05)


def test_a_gain_is_tried_beside_an_offset_whatever_else_seems_to_leave_less(
    rig: Rig, runs: tuple[Run, Run], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Alone the offset is fitted at three times its size, and no column shows the gain."""
    monkeypatch.setattr(search_extensions, "SEARCH", replace(SEARCH, refined_extensions=0))
    records = conditioned_records(rig, [read_by(runs[0], lambda p: 0.95 * p - 0.24e6)])
    data = regression_data(rig, tuple(map(Used, baseline())), records)
    gain, offset = (make(name, "joint 2 cap") for name in ("sensor_gain", "sensor_offset"))
    hypotheses = HypothesisSet(data, [gain, offset, make("torque_offset", "joint 2")])
    alone = hypotheses.refined([at_start(rig, offset)])
    (both,) = extensions(hypotheses, alone)
    assert both.keys == {gain.key, offset.key}
    assert both.total < 0.01 * alone.total


def test_a_bent_characteristic_keeps_its_one_name(rig: Rig, runs: tuple[Run, Run]) -> None:
    """Exponential: 4 % more of the pressure at the supply's than near 0."""
    result = traced(runs, lambda p: 1.02 * p * np.exp(0.04 * p / rig.supply.pressure))
    assert result.verdict == "explained"
    assert [e.name for e in result.effects] == ["sensor_gain"]
    low, high = result.effects[0].parameters[f"bend_{SENSOR}"].ci95
    assert 0.0 < low < 0.02 < high < 0.03
