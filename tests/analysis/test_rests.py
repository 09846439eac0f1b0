"""A joint that rests: its balance then says nothing of dry friction, and is not counted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from analysis.identify.identify import identify
from analysis.regression.conditioned import condition_runs
from analysis.regression.rows import Filtering, default_filtering
from analysis.regression.settings import REGRESSION
from rig.model.records import Record
from rig.model.rig import Rig
from tests.analysis.small_bench import TRUTH
from tests.analysis.trace.foreign_bench import Hidden, experiment


def moving(record: Record) -> Filtering:
    return replace(default_filtering(record), rests=False)


def test_samples_at_rest_count_nothing_and_fast_ones_all(rig: Rig) -> None:
    run = experiment(rig, Hidden(), repeats=1, seed=1)
    (conditioned,) = condition_runs(rig, [run], moving)
    speed = np.abs(conditioned.signals.sd[:, 1])
    rest = REGRESSION.rest_speed * np.sqrt(np.mean(speed**2))
    assert conditioned.signals.weight is not None
    weight = conditioned.signals.weight[:, 1]
    assert (weight[speed <= rest] == 0.0).all()
    assert (weight[speed >= 2 * rest] == 1.0).all()
    assert ((weight > 0.0) & (weight < 1.0)).any()


def test_a_balance_that_holds_at_every_sample_holds_without_the_rests(rig: Rig) -> None:
    """Without friction and with little noise nothing is lost but some of the samples."""
    run = experiment(rig, Hidden(), repeats=2, seed=1, noise=0.05)
    found = identify([run], filtering=moving, estimator="ls").estimates
    for name in ("M2", "W2"):
        assert found[name].value == pytest.approx(TRUTH[name], rel=0.003)
    assert found["Fv2"].value == pytest.approx(TRUTH["Fv2"], rel=0.02)
