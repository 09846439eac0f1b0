"""Somebody knows what the machine has, and not how much: the shape comes from the records."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import pytest

from analysis.effects.base import open_shapes
from analysis.identify.identify import identify
from analysis.terms import with_effects
from analysis.terms.base import Used
from analysis.trace.data.regression_data import RegressionData
from analysis.trace.judge.inference import with_shape_errors
from analysis.trace.search import refinement
from analysis.trace.search.exact_fit import ExactFit, fit_coefficients
from analysis.trace.search.refinement import ShapeFit, fit_shapes, shapes_in
from analysis.trace.settings import SEARCH
from rig.model.records import BANDWIDTH, Run
from rig.model.rig import Rig
from tests.analysis.small_bench import TRUTH
from tests.analysis.trace.hidden import experiment


def used(rig: Rig, *effects: str) -> list[Used]:
    return [Used(term) for term in with_effects(rig, effects)]


def shaped(run: Run, terms: list[Used]) -> ShapeFit:
    found = fit_shapes([run], terms)
    assert found is not None
    return found


@pytest.fixture(scope="module")
def overlapped(rig: Rig) -> Run:
    return experiment(rig, repeats=2, w_ahead=8e-3, w_astern=5e-3)


def test_a_dead_band_is_found_with_both_edges_and_the_gains_come_back(
    rig: Rig, overlapped: Run
) -> None:
    terms = shaped(overlapped, used(rig, "valve_deadband@joint 2")).terms
    sizes = {name: shape.value for name, shape in shapes_in(rig, terms).items()}
    assert sizes["w_ahead_2"] == pytest.approx(8e-3, rel=0.05)
    assert sizes["w_astern_2"] == pytest.approx(5e-3, rel=0.05)
    found = identify([overlapped], terms=terms).estimates
    plain = identify([overlapped]).estimates
    off = [abs(e["C_pp_2"].value / TRUTH["C_pp_2"] - 1) for e in (found, plain)]
    assert off[0] < 0.01
    assert off[1] > 0.05


def test_records_of_unlike_bandwidths_pass_alike_filters(rig: Rig, overlapped: Run) -> None:
    """Imported motions: as `identify` fits them."""
    slow, quick = (of_bandwidth(overlapped, width) for width in (3.0, 10.0))
    found = fit_shapes([slow, quick], used(rig, "valve_deadband@joint 2"))
    assert found is not None
    assert {c.record.bandwidth for c in found.data.records} == {10.0}


def of_bandwidth(run: Run, width: float) -> Run:
    """Return the run with motion below `width` [Hz] and no list of excited lines."""
    stated = [
        replace(r, lines=(), attributes={**r.attributes, BANDWIDTH: width}) for r in run.records
    ]
    return replace(run, records=tuple(stated))


def test_what_the_records_do_not_have_comes_out_as_next_to_nothing(rig: Rig) -> None:
    """And not as edges that no spool ever reaches."""
    run = experiment(rig, repeats=2)
    terms = shaped(run, used(rig, "valve_deadband@joint 2")).terms
    sizes = {name: shape.value for name, shape in shapes_in(rig, terms).items()}
    assert max(sizes["w_ahead_2"], sizes["w_astern_2"]) < 1e-3


@pytest.mark.slow
def test_a_search_that_ended_in_a_local_minimum_beside_another_effect_is_begun_anew(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From a dead band of half a volt no search leads on, with the right lag beside it neither."""
    run = experiment(rig, repeats=2, w_ahead=8e-3, w_astern=8e-3, tau_spool=3e-3)
    terms = used(rig, "valve_deadband@joint 2", "spool_lag@joint 2")
    whole, calls = refinement.refine, []

    def refined(data: RegressionData, trial: Sequence[Used]) -> ExactFit:
        calls.append(trial)
        if len(calls) > SEARCH.shape_starts:
            return whole(data, trial)
        return fit_coefficients(data, (*trial[:-1], Used(trial[-1].term, (0.5, 0.5, 0.0))))

    monkeypatch.setattr(refinement, "refine", refined)
    found = {n: e.value for n, e in shapes_in(rig, shaped(run, terms).terms).items()}
    assert found["w_ahead_2"] == pytest.approx(8e-3, rel=0.05)
    assert found["tau_spool_2"] == pytest.approx(3e-3, rel=0.05)


def test_a_shape_that_is_given_stays_and_dry_friction_needs_none(rig: Rig, overlapped: Run) -> None:
    terms = used(rig, "coulomb_friction@joint 2", "valve_deadband@joint 2")
    assert [open_shapes(rig, u) for u in terms[-2:]] == [False, True]
    given = (*terms[:-1], Used(terms[-1].term, (0.01, 0.01, 0.0)))
    assert fit_shapes([overlapped], given) is None
    assert fit_shapes([overlapped], terms[:-1]) is None
    assert shapes_in(rig, given)["w_ahead_2"].value == 0.01


def test_edges_come_with_intervals_that_hold(rig: Rig, overlapped: Run) -> None:
    found = shaped(overlapped, used(rig, "valve_deadband@joint 2"))
    model = identify([overlapped], terms=found.terms).model
    wider, edges = with_shape_errors(found, model)
    for name, size in (("w_ahead_2", 8e-3), ("w_astern_2", 5e-3)):
        low, high = edges[name].ci95
        assert low < size < high
        assert high - low < 0.2 * size
    assert wider.values == model.values


@pytest.mark.slow
def test_intervals_include_the_errors_of_the_shapes_that_the_records_gave(rig: Rig) -> None:
    """Friction slides at 20 N; its transition and presliding distance decide how much that is."""
    run = experiment(rig, repeats=2, Fc=20.0, Fs=60.0)
    found = shaped(run, used(rig, "coulomb_friction@joint 2", "stribeck_friction@joint 2"))
    exact = identify([run], terms=found.terms).model
    wider, _ = with_shape_errors(found, exact)
    (low, high), (least, most) = (m.parameters["Fc2"].ci95 for m in (exact, wider))
    assert not low < 20.0 < high
    assert least < 20.0 < most
    assert wider.parameters["M2"].half > 2.0 * exact.parameters["M2"].half
