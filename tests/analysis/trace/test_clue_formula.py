"""What no catalogue has a word for is offered as a formula: a clue that a person can read."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from analysis.trace.clues.formula import is_balance
from analysis.trace.data.candidates import catalogue
from analysis.trace.engine import trace
from analysis.trace.result import Formula, Trace, to_json
from rig.cli.text.trace_text import trace_text
from rig.model.records import Record, Run
from rig.model.rig import Rig
from tests.analysis.trace.hidden import hardening, pair_of_runs, piston_speed, with_force

# The formula does not hang on what was tried before it; few candidates are quick.
FEW = ("coulomb_friction", "joint_spring", "torque_offset", "sensor_offset")


def dragged(run: Run, k: float) -> Run:
    """Return the run as if F = k v |v| braked the piston."""

    def drag(record: Record) -> NDArray[np.float64]:
        v = piston_speed(record)
        return np.asarray(k * v * np.abs(v))

    return with_force(run, drag)


@pytest.fixture(scope="module")
def quiet(rig: Rig) -> tuple[Run, Run]:
    return pair_of_runs(rig)


def traced(runs: tuple[Run, Run], *, free_forms: bool) -> Trace:
    effects = catalogue(runs[0].rig, FEW)
    return trace([runs[0]], [runs[1]], effects, look_ahead=False, free_forms=free_forms)


@pytest.fixture(scope="module")
def hardened(quiet: tuple[Run, Run]) -> tuple[Run, Run]:
    train, held_out = (hardening(run, 2.0e7) for run in quiet)
    return train, held_out


@pytest.fixture(scope="module")
def sprung(hardened: tuple[Run, Run]) -> Trace:
    """The answer where no mechanism may have a curve in place of a name."""
    return traced(hardened, free_forms=False)


def test_a_curve_is_named_where_mechanisms_may_have_one(hardened: tuple[Run, Run]) -> None:
    result = traced(hardened, free_forms=True)
    assert [(e.name, e.where) for e in result.effects] == [("position_force", "joint 2")]


@pytest.mark.slow
def test_a_spring_that_goes_with_the_cube_is_read_off_with_its_stiffness(sprung: Trace) -> None:
    (found,) = sprung.formulas
    assert found.equation == "torque_2"
    assert found.at_piston
    assert set(found.terms) == {"piston_2³"}
    assert found.terms["piston_2³"] == pytest.approx(2.0e7, rel=0.02)
    assert found.share > 0.95


@pytest.mark.slow
def test_drag_by_the_square_of_the_speed_is_read_off(quiet: tuple[Run, Run]) -> None:
    train, held_out = (dragged(run, 6.0e4) for run in quiet)
    result = traced((train, held_out), free_forms=False)
    assert result.verdict == "unexplained"
    best = max(result.formulas, key=lambda f: f.share)
    assert set(best.terms) == {"velocity_2 |velocity_2|"}
    assert best.terms["velocity_2 |velocity_2|"] == pytest.approx(6.0e4, rel=0.05)
    assert result.depends_on[0].variable == "velocity_2"


def test_it_is_told_as_a_clue_and_no_name(sprung: Trace) -> None:
    assert sprung.effects == ()
    assert "parameter  " not in trace_text(sprung)  # nothing changed: no table of changes
    assert "2e+07 piston_2³" in sprung.sentence
    assert "a clue, not a named effect" in trace_text(sprung)
    (told,) = to_json(sprung)["unexplained"]["formulas"]
    assert told["terms"]["piston_2³"] == sprung.formulas[0].terms["piston_2³"]
    assert sprung.residual_variables[0] == "piston_2"


@pytest.mark.parametrize(
    ("terms", "variables"),
    [
        ({"1": 1.0, "piston_1 sign(velocity_1)": 2.0}, ("piston_1", "velocity_1")),
        ({"velocity_12 |velocity_12|": 1.0}, ("velocity_12",)),
        ({"cap_pressure_2²": 1.0}, ("cap_pressure_2",)),
        ({"time": 1.0}, ("time",)),
        ({"1": 1.0}, ()),
    ],
)
def test_its_variables_are_read_from_its_monomials(
    terms: dict[str, float], variables: tuple[str, ...]
) -> None:
    found = Formula("torque_1", terms, 0.95, True)
    assert found.variables == variables
    assert found.sure == bool(variables)
    assert not replace(found, share=0.5).sure


@pytest.mark.parametrize(
    ("terms", "balance"),
    [
        ({"cap_pressure_1 time": 1e-3, "rod_pressure_1 time": -7e-4}, True),
        ({"1": 2.0, "cap_pressure_1 sign(velocity_1)": 1.0, "rod_pressure_1 time": -1.0}, False),
        ({"cap_pressure_1 sign(velocity_1)": 1.0, "rod_pressure_1 sign(velocity_1)": 1.0}, False),
        ({"cap_pressure_1 time": 1e-3}, False),
    ],
)
def test_the_cylinders_force_times_a_factor_is_no_clue(
    terms: dict[str, float], balance: bool
) -> None:
    """A seal pressed on by both chambers, and one sensor that drifts, are none of it."""
    assert is_balance("torque_1", terms) is balance
    assert not is_balance("flow_cap_1", terms)
