"""The noise floor is what repeats do not share, but no lower than a data sheet has a meaning."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from analysis.simulation.synthetic import multisine, synthetic_run
from analysis.terms import baseline_of
from analysis.terms.base import Used
from analysis.trace.data.conditioned_record import scenes
from analysis.trace.data.noise_floor import LEAST, STATED, floors, stated_noise
from analysis.trace.data.regression_data import board
from rig.model.rig import Rig


def floor_over_stated(rig: Rig, noise: float) -> dict[str, float]:
    """Return each equation's floor over the stated noise, with sensors of `noise` times it."""
    wave = multisine(np.random.default_rng(1), rig.sample_rate, 4.0, 9.5)
    run = synthetic_run(rig, np.random.default_rng(2), wave, rms=0.025, repeats=4, noise=noise)
    stage = board(rig, tuple(map(Used, baseline_of(rig))), scenes(rig, [run]))
    found = {(f.group, f.equation): f.noise for f in stage.floors}
    out: dict[str, float] = {}
    for scene, rows in zip(stage.scenes, stage.rows, strict=True):
        if scene.record.repeat == 1:
            stated = stated_noise(rig, stage.terms, scene, rows, stage.beta)
            for e in rows:
                out[f"{scene.group[1]} {e}"] = found[scene.group, e] / stated[e]
    return out


def test_sensors_as_stated_give_the_floor_that_their_data_sheet_says(rig: Rig) -> None:
    for name, ratio in floor_over_stated(rig, 1.0).items():
        assert 0.7 < ratio < 1.4, name  # a few hundred filtered rows know it to some tenths


def test_sensors_far_better_than_stated_do_not_make_a_floor_of_nothing(rig: Rig) -> None:
    ratios = floor_over_stated(rig, 0.0)
    assert ratios
    for name, ratio in ratios.items():
        assert ratio == pytest.approx(LEAST, rel=1e-6), name


def test_a_record_whose_rows_are_all_masked_has_the_stated_floor_and_nothing_left(rig: Rig) -> None:
    """A chamber below tank pressure throughout: the rows of its flow are gone."""
    wave = multisine(np.random.default_rng(1), rig.sample_rate, 4.0, 9.5)
    run = synthetic_run(rig, np.random.default_rng(2), wave, rms=0.025, repeats=1)
    terms = tuple(map(Used, baseline_of(rig)))
    stage = board(rig, terms, scenes(rig, [run]))
    none = [
        {
            e: replace(r, matrix=r.matrix[:0], rhs=r.rhs[:0], time=r.time[:0])
            for e, r in rows.items()
        }
        for rows in stage.rows
    ]
    for floor in floors(rig, terms, stage.scenes, none, stage.beta):
        assert (floor.total, floor.repeatable, floor.source) == (0.0, 0.0, STATED)
        assert floor.noise > 0.0
