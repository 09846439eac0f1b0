"""An effect with a memory is fitted twice: in the rows, and by the model run over short windows."""

from __future__ import annotations

from dataclasses import replace

import pytest

from analysis.effects.base import Effect
from analysis.identify.output_error.hidden_states import hidden_effects, shot, window_error
from analysis.simulation.model import Estimate, Model
from analysis.terms import make
from analysis.terms.base import Used
from analysis.trace.engine import trace
from analysis.trace.fitted_model import with_shots
from analysis.trace.result import Trace, to_json
from analysis.trace.words import shot_in_words
from rig.model.records import Run
from rig.model.rig import Rig
from tests.analysis.effects.fitting import model_of
from tests.analysis.small_bench import TRUTH
from tests.analysis.trace.hidden import experiment, pair_of_runs

TAU = 3e-3


@pytest.fixture(scope="module")
def runs(rig: Rig) -> tuple[Run, Run]:
    """A bench whose spool lags by 3 ms: training and held-out records."""
    return pair_of_runs(rig, tau_spool=TAU)


@pytest.fixture(scope="module")
def result(runs: tuple[Run, Run]) -> Trace:
    return trace([runs[0]], [runs[1]], look_ahead=False)


def lagging(rig: Rig, tau: float) -> tuple[Model, Effect]:
    effect = make("spool_lag", "joint 2")
    assert isinstance(effect, Effect)
    return model_of(rig, effect, dict(TRUTH), (tau,)), effect


@pytest.mark.slow
def test_shooting_finds_the_lag_from_a_start_that_is_half_of_it(
    rig: Rig, runs: tuple[Run, Run]
) -> None:
    model, effect = lagging(rig, 0.5 * TAU)
    found = shot([runs[0]], model, effect)
    assert found is not None
    assert found.settled
    (tau,) = found.shapes.values()
    assert tau.value == pytest.approx(TAU, rel=0.03)
    right, _ = lagging(rig, tau.value)
    assert window_error([runs[1]], right, effect) < 0.8 * window_error([runs[1]], model, effect)


def test_rows_and_shooting_agree_on_a_lag_and_both_are_told(result: Trace) -> None:
    assert result.verdict == "explained"
    (found,) = result.effects
    assert found.shot is not None
    (mine,), (theirs,) = found.parameters.values(), found.shot.shapes.values()
    assert mine.value == pytest.approx(theirs.value, rel=0.03)
    assert mine.ci95[0] <= theirs.value <= mine.ci95[1]
    assert "by multiple shooting tau_spool_2" in shot_in_words(found)
    assert to_json(result)["effects"][0]["shooting"]["windows"] == found.shot.windows


def test_what_the_rows_keep_has_an_interval_that_holds_both(result: Trace) -> None:
    (found,) = result.effects
    assert found.shot is not None
    (name,) = found.shot.shapes
    far = Estimate(0.004, "s", 1e-5, (0.0039, 0.0041))
    kept = with_shots(found, (replace(found.shot, shapes={name: far}, taken=False),))
    assert kept.parameters[name].value == found.parameters[name].value
    assert kept.parameters[name].ci95[1] == 0.004
    taken = with_shots(found, (replace(found.shot, shapes={name: far}, taken=True),))
    assert taken.parameters[name].ci95 == far.ci95


def test_effects_without_a_memory_are_not_shot(rig: Rig) -> None:
    leaking = make("internal_leakage", "joint 2")
    assert isinstance(leaking, Effect)
    model = model_of(rig, leaking, TRUTH | {"c_internal_2": 1e-12}, ())
    assert hidden_effects(model) == []
    # Nor one without a presliding distance: its contact has no memory.
    stiff = replace(model, terms=(*model.terms, Used(make("coulomb_friction", "joint 2"))))
    assert hidden_effects(stiff) == []


def test_held_out_records_in_which_the_joint_stands_judge_nothing(
    rig: Rig, runs: tuple[Run, Run], result: Trace
) -> None:
    model, effect = lagging(rig, TAU)
    still = replace(runs[1], records=tuple(replace(r, locked=(1, 2)) for r in runs[1].records))
    assert window_error([still], model, effect) == float("inf")
    (found,) = result.effects
    assert found.shot is not None
    unjudged = replace(found.shot, before=float("inf"), after=float("inf"))
    assert "held-out windows do not decide" in shot_in_words(replace(found, shot=unjudged))


def test_records_without_a_whole_window_are_not_shot_and_nothing_falls(rig: Rig) -> None:
    model, effect = lagging(rig, TAU)
    run = experiment(rig, repeats=1, tau_spool=TAU)
    short = replace(
        run,
        records=tuple(
            replace(r, channels={n: c[:400] for n, c in r.channels.items()}) for r in run.records
        ),
    )
    assert shot([short], model, effect) is None
