"""Where least squares fails, and what the other estimators and their intervals make of it."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.stats import t as student

from analysis.identify import reduction
from analysis.identify.checks import Check
from analysis.identify.estimators.covariance import by_parts, lack_of_fit, spread
from analysis.identify.estimators.equations import least_squares, pieces
from analysis.identify.identify import identify
from analysis.identify.output_error import fit as output_error_fit
from analysis.identify.output_error.fit import output_error
from analysis.identify.output_error.windows import Windows
from analysis.identify.result import Identification, to_json
from analysis.identify.settings import IDENTIFY
from analysis.regression import noise
from analysis.regression.solve import MOSTLY_NOISE, Solution, solve
from analysis.terms import baseline
from analysis.terms.base import Used
from analysis.trace.engine import trace
from rig.model.parse import InputError
from rig.model.records import Record, Run
from tests.analysis import small_bench as bench
from tests.analysis.small_bench import TRUTH
from tests.analysis.straight_line import line
from tests.analysis.trace.hidden import understated
from tests.studies.estimators import coverage as cov


def error(result: Identification, name: str) -> float:
    return abs(result.estimates[name].value / TRUTH[name] - 1)


def check(result: Identification, name: str) -> Check:
    return next(c for c in result.checks if c.name == name)


def inside(result: Identification, name: str) -> bool:
    low, high = result.estimates[name].ci95
    return low <= TRUTH[name] <= high


@pytest.fixture(scope="module")
def noisy_run(multisine_run: Run) -> Run:
    """The same bench with sensors ten times as noisy."""
    rng = np.random.default_rng(5)
    records = tuple(
        replace(r, channels=bench.with_noise(dict(r.channels), rng, np.sqrt(99.0)))
        for r in multisine_run.records
    )
    return replace(multisine_run, records=records)


@pytest.fixture(scope="module")
def noisy(noisy_run: Run) -> Identification:
    return identify([noisy_run], reject_noise=False, estimator="ls")


def test_clean_sensors_leave_nothing_for_instruments_to_mend(multisine_run: Run) -> None:
    found = identify([multisine_run], estimator="auto")
    assert check(found, "noise in regressors").ok
    assert found.model.provenance["estimator"] == "ls"
    assert to_json(found)["estimator"] == "ls"


def test_ten_times_the_noise_biases_least_squares_and_the_check_says_so(
    noisy: Identification,
) -> None:
    said = check(noisy, "noise in regressors")
    assert not said.ok
    assert "least squares is biased" in said.detail
    assert error(noisy, "M2") > 0.01
    # Who insists on least squares gets its value, and an interval that knows of the bias.
    assert inside(noisy, "M2")
    low, high = noisy.estimates["M2"].ci95
    assert high - low > 2 * error(noisy, "M2") * TRUTH["M2"]


def test_the_interval_of_one_repeat_holds_the_bias_that_its_noise_predicts(
    noisy_run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without repeats no instruments show the bias; a low stated noise does not hide it."""
    once = tuple(r for r in noisy_run.records if r.repeat == 1)

    def stating(times: float) -> Identification:
        rig = understated(noisy_run.rig, 1.0 / times)
        return identify([Run(rig, once)], reject_noise=False)

    understating, found = stating(0.1), stating(5.0)
    assert understating.estimates["M2"].std == pytest.approx(found.estimates["M2"].std, rel=0.1)
    monkeypatch.setattr(noise, "white_variance", lambda _: 0.0)
    none = stating(0.1)
    assert found.model.provenance["estimator"] == "ls"
    (said,) = re.findall(r"biases M2 most, by ([\d.]+) %", check(found, "noise bias").detail)
    before, after = none.estimates["M2"], found.estimates["M2"]
    added = np.sqrt(after.std**2 - before.std**2)
    assert added / after.value == pytest.approx(0.01 * float(said), rel=0.05)


def test_a_trace_states_the_parameters_of_identify(noisy_run: Run, both_run: Run) -> None:
    """Both tables of one user's records, whose noise biases least squares."""
    alone = identify([noisy_run])
    assert alone.model.provenance["estimator"] == "iv"
    traced = trace([noisy_run], [both_run], effects=[], free_forms=False, look_ahead=False)
    assert traced.model_before.parameters["M2"].value == alone.estimates["M2"].value


def test_repeats_of_unequal_length_without_a_period_are_as_good_as_others(noisy_run: Run) -> None:
    """Each later repeat is a tenth shorter: instruments use the part that all of a step have."""

    def cut(r: Record) -> Record:
        n = round(r.samples * (1.1 - 0.1 * r.repeat))
        return replace(r, period=0, channels={k: v[:n] for k, v in r.channels.items()})

    found = identify([replace(noisy_run, records=tuple(map(cut, noisy_run.records)))])
    assert found.model.provenance["estimator"] == "iv"
    assert inside(found, "M2")


def test_instruments_are_not_biased_and_the_tool_prefers_them_unasked(
    noisy_run: Run, noisy: Identification
) -> None:
    iv = identify([noisy_run], reject_noise=False, estimator="iv")
    auto = identify([noisy_run], reject_noise=False)
    assert error(iv, "M2") < 0.3 * error(noisy, "M2")
    assert error(auto, "M2") < 0.3 * error(noisy, "M2")
    assert np.mean([inside(iv, name) for name in TRUTH]) > 0.8
    assert auto.model.provenance["estimator"] == "iv"
    assert auto.estimates["M2"].value == iv.estimates["M2"].value
    for one in (iv, auto):
        assert check(one, "noise in regressors").ok
        assert "instrumental variables instead" in check(one, "noise in regressors").detail
    # Asked for a bootstrap of least squares, its interval knows of the bias as well.
    drawn = identify([noisy_run], reject_noise=False, estimator="ls", bootstrap=100)
    low, high = drawn.estimates["M2"].ci95
    assert low < iv.estimates["M2"].value < high


@pytest.mark.slow
def test_a_spool_that_leads_its_samples_does_not_soften_the_oil(multisine_run: Run) -> None:
    """What a held command does between samples; a flow that follows the spool's rate is not b's."""
    lead = 0.1  # of a sample's interval

    def behind(channels: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        n = np.arange(len(channels["spool_1"]))
        late = {c: np.interp(n - lead, n, channels[c]) for c in ("spool_1", "spool_2")}
        return {**channels, **late}

    records = tuple(replace(r, channels=behind(dict(r.channels))) for r in multisine_run.records)
    run = replace(multisine_run, records=records)
    found, blind = identify([run], estimator="ls"), identify([run], estimator="plain")
    assert inside(found, "b")
    assert not inside(blind, "b")
    assert error(found, "b") < 0.2 * error(blind, "b")
    for joint in (1, 2):
        said = check(found, f"spool's path between samples at joint {joint}")
        assert said.ok
        assert float(said.detail.split()[0]) == pytest.approx(lead, rel=0.2)


def test_weights_from_measured_noise_do_not_move_what_is_right(multisine_run: Run) -> None:
    found = identify([multisine_run], estimator="wls")
    assert max(error(found, name) for name in TRUTH) < 0.004


def test_weights_do_without_a_chamber_that_one_repeat_lacks(multisine_run: Run) -> None:
    """A rod pressure above the supply throughout: its rows are masked, those of the cap are not."""
    records = list(multisine_run.records)
    k = next(i for i, r in enumerate(records) if r.name == "step1_r2")
    high = 1.01 * multisine_run.rig.supply.pressure
    pressure = np.full_like(records[k].channels["rod_pressure_2"], high)
    pressure += 0.02 * records[k].channels["rod_pressure_2"]
    channels = {**records[k].channels, "rod_pressure_2": pressure}
    records[k] = replace(records[k], channels=channels)
    found = identify([replace(multisine_run, records=tuple(records))], estimator="wls")
    assert max(error(found, name) for name in ("b", "C_pp_2", "C_mp_2")) < 0.01


def test_copies_of_one_record_have_no_scatter_to_weigh_by(multisine_run: Run) -> None:
    first = [r for r in multisine_run.records if r.repeat == 1]
    copies = [replace(r, repeat=2, name=f"{r.step}_r2") for r in first]
    with pytest.raises(InputError, match="are they copies of one record"):
        identify([replace(multisine_run, records=(*first, *copies))], estimator="wls")


def test_spikes_in_one_record_are_set_aside_by_the_robust_loss(multisine_run: Run) -> None:
    rng = np.random.default_rng(8)
    records = list(multisine_run.records)
    k = next(i for i, r in enumerate(records) if r.name == "step2_r2")
    channels = dict(records[k].channels)
    for name, size in (("cap_pressure_1", 2e6), ("piston_1", 10e-3)):
        x = channels[name].copy()
        x[rng.integers(500, 9500, 30)] += size
        channels[name] = x
    records[k] = replace(records[k], channels=channels)
    spoilt = replace(multisine_run, records=tuple(records))
    plain, robust = (identify([spoilt], estimator=e) for e in ("ls", "robust"))
    names = ("M1", "Fv1", "W1", "b", "C_pp_1", "C_mm_1")
    assert max(error(robust, n) for n in names) < 0.004
    assert max(error(plain, n) for n in names) > 5 * max(error(robust, n) for n in names)
    said = check(robust, "outliers fluid")
    assert not said.ok
    assert "'step2_r2'" in said.detail
    # A record of the same name in another run has no part in it.
    both = identify([bench.one_sample_shorter(multisine_run), spoilt], estimator="robust")
    share, _, _ = check(both, "outliers fluid").detail.partition(" %")
    assert float(share) == pytest.approx(float(said.detail.partition(" %")[0]), rel=0.2)


@pytest.mark.slow
def test_output_error_converges_from_a_start_five_percent_off(
    multisine_run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    # One repeat: what instruments cannot do.
    one = replace(multisine_run, records=tuple(r for r in multisine_run.records if r.repeat == 1))
    signs = np.resize([1.0, -1.0], len(TRUTH))
    start = {
        n: (1.0 / v if n == "b" else v) * (1.0 + 0.05 * sign)
        for (n, v), sign in zip(TRUTH.items(), signs, strict=True)
    }
    found = output_error(one.rig, [one], [Used(term) for term in baseline()], start)
    assert found.check.ok, found.check.detail
    value = dict(zip(found.names, found.value, strict=False))
    off = {n: value[n] / (1.0 / v if n == "b" else v) - 1.0 for n, v in TRUTH.items()}
    # One record a step: friction of the light joint is known to 2 % only.
    assert max(abs(v) for v in off.values()) < 0.03
    assert max(abs(v) for n, v in off.items() if n[0] in "bC") < 0.002
    monkeypatch.setattr(output_error_fit, "IDENTIFY", replace(IDENTIFY, fit_rounds=1))
    early = output_error(one.rig, [one], [Used(term) for term in baseline()], start).check
    assert not early.ok
    assert "not settled: the last still moved a parameter by" in early.detail


def test_windows_compare_the_same_instants_of_a_record_at_half_the_rigs_rate(
    multisine_run: Run,
) -> None:
    record = multisine_run.records[0]
    thinned = replace(
        record,
        sample_rate=record.sample_rate / 2,
        channels={name: x[::2] for name, x in record.channels.items()},
        period=None if record.period is None else record.period // 2,
    )
    terms = [Used(term) for term in baseline()]
    whole, half = (
        Windows(multisine_run.rig, [replace(multisine_run, records=(r,))], terms)
        for r in (record, thinned)
    )
    assert len(whole.placed) == len(half.placed)
    for one, other in zip(whole.placed, half.placed, strict=True):
        assert one.first == pytest.approx(2 * other.first, abs=30)
        assert one.measured.shape == other.measured.shape


def test_output_error_needs_a_model_that_is_complete(multisine_run: Run) -> None:
    first = [r for r in multisine_run.records if r.step == "step1"]
    with pytest.raises(InputError, match=r"does not determine .*C_pp_1"):
        identify([replace(multisine_run, records=tuple(first))], estimator="output-error")


@pytest.mark.slow
def test_bootstrap_and_cluster_intervals_agree_on_clean_data(multisine_run: Run) -> None:
    cluster = identify([multisine_run], estimator="ls")
    drawn = identify([multisine_run], estimator="ls", bootstrap=100, rng=np.random.default_rng(1))
    again = identify([multisine_run], estimator="ls", bootstrap=100, rng=np.random.default_rng(1))
    ratios = []
    for name, p in drawn.estimates.items():
        assert p.value == cluster.estimates[name].value
        assert p.ci95 == again.estimates[name].ci95
        own = cluster.estimates[name].ci95
        ratios.append((p.ci95[1] - p.ci95[0]) / (own[1] - own[0]))
    assert 0.5 < np.median(ratios) < 1.5


@pytest.mark.parametrize("estimator", ["iv", "wls"])
def test_one_repeat_only_is_refused_with_what_to_do(multisine_run: Run, estimator: str) -> None:
    single = replace(
        multisine_run, records=tuple(r for r in multisine_run.records if r.repeat == 1)
    )
    with pytest.raises(InputError, match=r"step1 step2 step3\. Record more repeats"):
        identify([single], estimator=estimator)
    alone = identify([single], estimator="auto")
    assert alone.model.provenance["estimator"] == "ls"
    assert all(np.isfinite(p.std) for p in alone.estimates.values())


def test_an_unknown_estimator_and_too_few_draws_are_refused(multisine_run: Run) -> None:
    with pytest.raises(InputError, match="unknown estimator 'best'; known: ls wls iv"):
        identify([multisine_run], estimator="best")
    with pytest.raises(InputError, match="take 100 or more"):
        identify([multisine_run], bootstrap=20)
    with pytest.raises(InputError, match="does not go with --estimator output-error"):
        identify([multisine_run], estimator="output-error", bootstrap=100)


def test_a_misfit_that_every_repeat_shares_widens_the_interval() -> None:
    rng = np.random.default_rng(1)
    straight, bent = (least_squares(line(rng, bend)) for bend in (0.0, 0.3))
    assert not lack_of_fit(pieces(straight), straight.inverse).any()
    found = spread([pieces(bent)], bent.inverse)
    assert found.systematic[0] > 0.8
    assert abs(bent.beta[0] - 2.0) > 0.2  # the slope at the origin is not what is found
    assert np.sqrt(found.covariance[0, 0]) > 5 * np.sqrt(
        spread([pieces(straight)], straight.inverse).covariance[0, 0]
    )


def test_intervals_of_a_single_repeat_hold_the_truth_as_often_as_they_say() -> None:
    rng = np.random.default_rng(2)
    hits = []
    for _ in range(300):
        fit = least_squares(line(rng, 0.0, repeats=1))
        found = by_parts(pieces(fit), fit.inverse)
        half = student.ppf(0.975, found.dof[0]) * np.sqrt(found.covariance[0, 0])
        hits.append(abs(fit.beta[0] - 2.0) < half)
    assert 0.90 < np.mean(hits) < 0.99


def test_a_parameter_that_no_row_shows_has_no_scatter_and_changes_no_other() -> None:
    """A shape may make a column vanish; a single repeat is then judged by the others."""
    blocks = line(np.random.default_rng(4), 0.0, repeats=1)
    wide = [replace(b, X=np.column_stack((b.X, np.zeros(len(b.y))))) for b in blocks]
    one, two = (least_squares(b) for b in (blocks, wide))
    alone, beside = (by_parts(pieces(fit), fit.inverse) for fit in (one, two))
    assert beside.covariance[0, 0] == pytest.approx(alone.covariance[0, 0], rel=1e-9)
    assert beside.covariance[1, 1] == 0.0


def test_coverage_is_counted_with_its_own_uncertainty() -> None:
    rng = np.random.default_rng(3)
    z = 0.01 * rng.standard_normal(200)
    trials = [cov.Trial({"b": e}, {"b": e - 0.0196}, {"b": e + 0.0196}) for e in z]
    (row,) = cov.rows(trials)
    assert row.coverage == np.mean(np.abs(z) < 0.0196)
    assert row.coverage_low < 0.95 < row.coverage_high
    assert row.bias == pytest.approx(z.mean())
    assert cov.overall([row]) == row.coverage


def test_a_parameter_that_is_not_stated_keeps_its_part_of_the_motion(
    multisine_run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise another one takes it: R33 of three joints was eleven times too large."""
    whole = identify([multisine_run], estimator="ls")

    def without_m2(*given: Any) -> Solution:
        solution = solve(*given)
        if "M2" in solution.names:
            solution.unidentifiable["M2"] = MOSTLY_NOISE
            solution.value[solution.names.index("M2")] = np.nan
        return solution

    monkeypatch.setattr(reduction, "solve", without_m2)
    found = identify([multisine_run], estimator="ls")
    assert not found.estimates["M2"].identified
    for name in ("M1", "R12", "Fv2", "W2"):
        assert found.estimates[name].value == pytest.approx(whole.estimates[name].value, rel=1e-6)
