"""A joint that rests: its balance then says nothing of dry friction, and is not counted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from analysis.identify.identify import identify
from analysis.regression.conditioned import condition_runs
from analysis.regression.rows import Filtering, default_filtering
from analysis.terms import baseline_of
from analysis.terms.base import Used
from analysis.trace.data.regression_data import regression_data
from rig.model.records import Record
from rig.model.rig import Rig
from tests.analysis.small_bench import TRUTH
from tests.analysis.trace.foreign_bench import Hidden, experiment


def moving(record: Record) -> Filtering:
    return replace(default_filtering(record), in_motion=(0, 1))


def test_samples_at_rest_count_nothing_and_fast_ones_all(rig: Rig) -> None:
    run = experiment(rig, Hidden(), repeats=1, seed=1)
    (conditioned,) = condition_runs(rig, [run], moving)
    speed = np.abs(conditioned.signals.sd[:, 1])
    rms = np.sqrt(np.mean(speed**2))
    assert conditioned.signals.weight is not None
    weight = conditioned.signals.weight[:, 1]
    assert weight[speed <= 0.03 * rms].max() < 0.003
    assert (weight[speed >= rms] == 1.0).all()
    assert ((weight > 0.0) & (weight < 1.0)).any()


def test_the_weight_adds_little_noise_to_the_filter_s_band(rig: Rig) -> None:
    """A steep weight would fold the noise of the acceleration down from high frequencies."""
    run = experiment(rig, Hidden(), repeats=4, seed=1)
    terms = tuple(map(Used, baseline_of(rig)))
    whole, weighted = (
        regression_data(rig, terms, condition_runs(rig, [run], filtering)).floors
        for filtering in (default_filtering, moving)
    )
    for before, after in zip(whole, weighted, strict=True):
        assert after.noise < 1.5 * before.noise


def test_a_balance_that_holds_at_every_sample_holds_without_the_rests(rig: Rig) -> None:
    """Without friction and with little noise nothing is lost but some of the samples."""
    run = experiment(rig, Hidden(), repeats=2, seed=1, noise=0.05)
    found = identify([run], filtering=moving, estimator="ls").estimates
    for name in ("M2", "W2"):
        assert found[name].value == pytest.approx(TRUTH[name], rel=0.003)
    assert found["Fv2"].value == pytest.approx(TRUTH["Fv2"], rel=0.02)
