"""What noise in the regressors, and what is known beforehand, do to least squares."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import t as student

from analysis.identify.estimation import EstimationJob, _intervals
from analysis.identify.estimators.covariance import spread
from analysis.identify.estimators.equations import FamilyBlocks, RepeatBlock, least_squares, pieces
from analysis.identify.estimators.instruments import hausman, instrumental_variables
from analysis.identify.estimators.nuisance import (
    BETWEEN,
    KAPPA,
    TAU,
    Prior,
    implausible,
    prior_rows,
    priors,
    spread_with_priors,
    with_prior_rows,
)
from analysis.identify.estimators.shifts import (
    Shift,
    including,
    largest_shift,
    noise_statement,
    nuisance_statement,
    shift_without,
    shifts_of,
    significant_shift,
)
from analysis.identify.identify import identify
from analysis.identify.settings import IDENTIFY
from rig.model.parameters import gain_names
from rig.model.rig import Rig
from tests.analysis.straight_line import line
from tests.analysis.trace.hidden import pair_of_runs
from tests.variants import kept

CASES = {
    # noise of the regressor, of the equation; is the shift certain, is it large
    "certain and large": (0.2, 0.1, True, True),
    "certain, but small": (0.04, 0.5, True, False),
    "large, but maybe chance": (0.1, 10.0, False, True),
    "neither": (0.002, 0.1, False, False),
}


@pytest.mark.parametrize("case", CASES)
def test_a_shift_must_be_certain_and_large_to_speak_against_least_squares(case: str) -> None:
    blurred, noise, certain, large = CASES[case]
    rng = np.random.default_rng(3)
    blocks = tuple(
        replace(
            b,
            X=b.X + blurred * rng.standard_normal(b.X.shape),
            y=2 * b.X[:, 0] + noise * rng.standard_normal(len(b.y)),
        )
        for b in line(rng, 0.0)
    )
    p = FamilyBlocks("mechanical", ("M1",), 1, blocks)
    fit = least_squares(blocks)
    test = hausman(fit)
    error = spread([pieces(fit)], fit.inverse)
    (shift,) = shifts_of([p], {"mechanical": test}, {"mechanical": error})
    assert (shift.significant, shift.material) == (certain, large)
    said = noise_statement([shift])
    assert said.ok is not (certain and large)
    for figure in (f"M1 by {100 * shift.relative:+.2g} %", f"({shift.t:.2g} of its standard err"):
        assert figure in said.detail
    assert ("too little to matter" in said.detail) is (certain and not large)
    assert ("may be chance" in said.detail) is (large and not certain)
    # Attenuation is 1/(1 + noise/signal); what is certain is in the interval.
    if certain:
        assert shift.relative == pytest.approx(-(blurred**2) / (0.5 + blurred**2), rel=0.3)
        wide = including(error, significant_shift(test, p))
        half = student.ppf(0.975, wide.dof[0]) * np.sqrt(wide.covariance[0, 0])
        assert abs(fit.beta[0] - 2.0) < half


def test_a_shift_nobody_would_notice_does_not_matter_however_narrow_the_interval() -> None:
    assert not Shift("M2", -4e-5, 17.0, 3.0, True).material
    assert Shift("M2", -1e-3, 17.0, 3.0, True).material
    assert not Shift("M2", -1e-3, 17.0, 0.3, True).material
    assert Shift("M2", -6e-3, 17.0, 0.3, True).material
    assert not Shift("b", -6e-3, 17.0, 0.3, True).material
    assert Shift("b", -3e-2, 17.0, 0.3, True).material


def test_nothing_identified_is_not_called_free_of_bias() -> None:
    assert not noise_statement([]).ok


@pytest.mark.parametrize("known", kept([0.02, 0.05], (1,)))
def test_what_is_known_beforehand_narrows_intervals_no_more_than_it_may(known: float) -> None:
    """A second column much like the first, its size known to +- `known`; two steps, 4 repeats."""
    rng = np.random.default_rng(4)
    t = np.arange(200) / 100.0
    x = np.sin(np.pi * t)
    X = np.column_stack((x, 0.5 * x + 0.5 * x * np.abs(x) + 0.15 * np.cos(6 * np.pi * t)))
    parts = np.arange(200) // 25
    hits, narrower = [], []
    for _ in range(200):
        truth = np.array([1.0, known * rng.standard_normal()])
        blocks = [
            RepeatBlock(0, step, r, f"{step}_r{r}", "flow_cap_1", X,
                  X @ truth + size * np.repeat(rng.standard_normal(40), 5), t, parts, parts)
            for step, size in (("a", 0.5), ("b", 0.35)) for r in range(4)
        ]  # fmt: skip
        fit = least_squares(blocks)
        alone = spread([pieces(fit)], fit.inverse)
        prior = Prior("second", np.array([0.0, 1.0]), known)
        rows = prior_rows(fit, [prior])
        joined = with_prior_rows(fit, rows)
        both = spread_with_priors(joined, rows)
        half = student.ppf(0.975, both.dof[0]) * np.sqrt(both.covariance[0, 0])
        hits.append(abs(joined.beta[0] - 1.0) < half)
        narrower.append(both.covariance[0, 0] / alone.covariance[0, 0])
    assert 0.92 < np.mean(hits) < 0.98
    assert np.median(narrower) < 0.3


def test_two_repeats_that_agree_by_chance_do_not_outweigh_what_is_known_of_oils() -> None:
    """Bulk compliance and its slope over half a kelvin, each of 400 experiments of two repeats."""
    rng = np.random.default_rng(6)
    t, parts = np.arange(200) / 100.0, np.arange(200) // 25
    x = np.sin(np.pi * t)
    X = np.column_stack((x, x * np.linspace(0.0, 0.5, 200)))
    truth = np.array([1.0, -0.004])
    hits, outside, stated, contradicted = [], [], [], []
    for _ in range(400):
        blocks = tuple(
            RepeatBlock(0, "a", r, f"a_r{r}", "flow_cap_1", X,
                        X @ truth + 0.1 * np.repeat(rng.standard_normal(40), 5), t, parts, parts)
            for r in range(2)
        )  # fmt: skip
        names = ("b", KAPPA)
        fit = least_squares(blocks)
        error = spread([pieces(fit)], fit.inverse)
        (prior,) = priors(names, fit.beta)
        rows = prior_rows(fit, [prior])
        joined = with_prior_rows(fit, rows)
        both = spread_with_priors(joined, rows)
        hits.append(abs(joined.beta[0] - truth[0]) < both.half[0])
        slope = joined.beta[1] / joined.beta[0]
        outside.append(abs(slope - IDENTIFY.bulk_slope) > 4.0 * IDENTIFY.bulk_slope_std)
        detail = nuisance_statement(prior, names, fit, error, None).detail
        stated.append("hardly varied" not in detail)
        contradicted.append(implausible(prior, fit, error))
    assert np.mean(hits) > 0.9
    assert np.mean(contradicted) < 0.05
    assert not any(outside)
    assert not any(stated)


def test_draws_of_repeats_keep_the_weight_of_what_is_known_beforehand(rig: Rig) -> None:
    """A path between samples whose column is much like the gain's, known to +- 0.05."""
    rng = np.random.default_rng(7)
    t, parts = np.arange(200) / 100.0, np.arange(200) // 25
    x = np.sin(np.pi * t)
    X = np.column_stack((x, 0.98 * x + 0.02 * np.cos(6 * np.pi * t)))
    blocks = tuple(
        RepeatBlock(0, step, r, f"{step}_r{r}", "flow_cap_1", X,
                    x + 0.1 * rng.standard_normal(200), t, parts, parts)
        for step in "abc" for r in range(6)
    )  # fmt: skip
    p = FamilyBlocks("fluid", ("C_pp_1", f"{BETWEEN}1"), 1, blocks)
    fit = least_squares(blocks)
    rows = prior_rows(fit, priors(p.names, fit.beta))
    joined = with_prior_rows(fit, rows)
    between_repeats = spread([pieces(joined)], joined.inverse).covariance[0, 0]
    job = EstimationJob(rig, (), (), (), "ls", 200, rng)
    low, high = _intervals(job, p, "ls", np.zeros(1))["C_pp_1"]
    assert (high - low) / 3.92 == pytest.approx(np.sqrt(between_repeats), rel=0.3)


@pytest.mark.parametrize(("alike", "ok"), [(0.0, True), (0.9, False)])
def test_an_impossible_law_of_flow_speaks_against_a_gain_that_it_moves_only(
    alike: float, ok: bool
) -> None:
    """A transition known to be below 1e-3 is 0.02; it moves the gain if their columns are alike."""
    rng = np.random.default_rng(5)
    t = np.arange(200) / 100.0
    x, other = np.sin(np.pi * t), np.cos(6 * np.pi * t)
    X = np.column_stack((x, alike * x + np.sqrt(1.0 - alike**2) * other))
    parts = np.arange(200) // 25
    blocks = [
        RepeatBlock(0, "a", r, f"a_r{r}", "flow_cap_1", X,
                    X @ np.array([1.0, 0.02]) + 1e-3 * rng.standard_normal(200), t, parts, parts)
        for r in range(4)
    ]  # fmt: skip
    fit = least_squares(blocks)
    error = spread([pieces(fit)], fit.inverse)
    prior = Prior(TAU, np.array([0.0, 1.0]), 1e-3)
    assert implausible(prior, fit, error)
    without = least_squares([replace(b, X=b.X[:, :1]) for b in blocks])
    names = ("C_pp_1", TAU)
    shift = shift_without(fit.beta, without.beta, error, 1)
    moved = largest_shift(names[:1], fit.beta[:1], shift)
    said = nuisance_statement(prior, names, fit, error, moved)
    assert said.ok is ok
    assert ("no parameter moves by more than" in said.detail) is ok
    # The gain takes up the share of the left-out column that is like its own.
    assert moved == ("C_pp_1", pytest.approx(0.02 * alike, abs=1e-3))


def test_intervals_include_what_a_law_of_flow_that_no_orifice_has_shifts(rig: Rig) -> None:
    """The supply's sensor reads 20 kPa too much: too little to speak against the gains."""
    found = identify([pair_of_runs(rig, offset_supply_pressure=2e4)[0]])
    said = next(c for c in found.checks if c.name == "laminar transition")
    assert said.ok
    assert "which the intervals include" in said.detail
    without = identify([pair_of_runs(rig)[0]])
    for name in gain_names(2):
        gain, exact = found.model.parameters[name], without.model.parameters[name]
        assert abs(gain.value - exact.value) < 2.5 * gain.half
        assert gain.half > 3.0 * exact.half
        assert gain.half < 0.01 * gain.value


def test_what_records_hold_nothing_of_leaves_every_estimate_as_it_is() -> None:
    """A column of zeros, of a joint that stands: joined in, it made every parameter NaN."""
    rng = np.random.default_rng(4)
    t = np.arange(200) / 100.0
    X = np.column_stack((np.sin(np.pi * t), np.zeros(200)))
    parts = np.arange(200) // 25
    blocks = [
        RepeatBlock(0, "a", r, f"a_r{r}", "flow_cap_1", X, X[:, 0] + 0.1 * rng.standard_normal(200),
                    t, parts, parts)
        for r in range(4)
    ]  # fmt: skip
    fit = least_squares(blocks)
    assert prior_rows(fit, [Prior("b", np.array([0.0, 1.0]), 0.1)]) == ()


def test_a_prior_row_is_one_more_row_of_least_squares() -> None:
    """Against numpy's least squares on the rows and the weighted prior observation together."""
    rng = np.random.default_rng(6)
    X, parts = rng.standard_normal((200, 3)), np.arange(200) // 25
    blocks = [
        RepeatBlock(0, "a", r, f"a_r{r}", "flow_cap_1", X,
                    X @ np.array([1.0, 2.0, 0.5]) + 0.1 * rng.standard_normal(200), parts / 4.0,
                    parts, parts)
        for r in range(3)
    ]  # fmt: skip
    fit = least_squares(blocks)
    h = np.array([0.3, 0.0, 1.0])
    (row,) = prior_rows(fit, [Prior("second", h, 0.2)])
    joined = with_prior_rows(fit, [row])
    stacked = np.vstack([*(b.X for b in blocks), np.sqrt(row.weight) * h])
    expected, *_ = np.linalg.lstsq(stacked, np.append(np.concatenate([b.y for b in blocks]), 0.0))
    assert joined.beta == pytest.approx(expected, rel=1e-10)
    assert joined.inverse == pytest.approx(np.linalg.inv(stacked.T @ stacked), rel=1e-9)


def test_a_temperature_that_did_not_vary_hides_no_noise_in_the_regressors() -> None:
    """The slope of 1/b over temperature has only the noise of its sensor in its column.

    Instruments do not determine it. With what is known beforehand about it they still show that
    least squares is 10 % low.
    """
    rng = np.random.default_rng(11)
    t, parts = np.arange(1000) / 100.0, np.arange(1000) // 100
    rate = np.sin(np.pi * t)
    blocks = []
    for r in range(3):
        measured = rate + 0.24 * rng.standard_normal(1000)
        X = np.column_stack((measured, 0.1 * rng.standard_normal(1000) * measured))
        y = rate + 0.1 * rng.standard_normal(1000)
        blocks.append(RepeatBlock(0, "a", r, f"a_r{r}", "flow_cap_1", X, y, t, parts, parts))
    fit = least_squares(blocks)
    rows = prior_rows(fit, [Prior("per kelvin", np.array([0.003, 1.0]), 0.003)])
    instruments = with_prior_rows(instrumental_variables(blocks), rows)
    assert fit.beta[0] == pytest.approx(0.9, abs=0.02)
    assert instruments.beta == pytest.approx([1.0, -0.003], abs=0.02)
    assert hausman(fit, rows).significant[0]
