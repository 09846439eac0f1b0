"""Records that leave parameters open: named, with what they do determine and what would help."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from analysis.identify.advice import base_statements
from analysis.identify.identify import identify
from analysis.identify.result import Identification
from analysis.regression.identifiability import determined
from analysis.regression.solve import RowCluster, solve, triangle
from rig.model.parse import InputError
from rig.model.records import Run
from rig.runs.rigs import load_rig

NAMES = ("R11", "R22", "R12", "W1", "Fv1")


def detail(result: Identification, name: str) -> str:
    return next(check.detail for check in result.checks if check.name == name)


def test_columns_that_only_come_together_are_written_as_one_base_parameter() -> None:
    rng = np.random.default_rng(0)
    a, b, c = rng.normal(size=(3, 50))
    found = determined(NAMES, np.column_stack((a, a, 1.56 * a, 1e-3 * b, 1e3 * c)))
    assert found.rank == 3
    assert not found.complete
    assert found.identified == ("W1", "Fv1")
    assert found.undetermined == ("R11", "R22", "R12")
    assert [part.text for part in found.base] == ["R11 + R22 + 1.56 R12"]


def test_what_the_base_parameters_say_the_rows_say() -> None:
    """Any two parameter sets with the same base parameters give the same right-hand side."""
    rng = np.random.default_rng(1)
    mixing = rng.normal(size=(3, 5)) * [1.0, 1e3, 1e-2, 5.0, 0.1]
    X = rng.normal(size=(40, 3)) @ mixing
    found = determined(NAMES, X)
    assert len(found.base) == found.rank == 3
    p = rng.normal(size=5)
    other = p + found.null.T @ rng.normal(size=2)
    np.testing.assert_allclose(X @ p, X @ other, atol=1e-9 * np.abs(X).max())
    for part in found.base:
        values = [
            sum(share * x[NAMES.index(name)] for name, share in part.parts) for x in (p, other)
        ]
        assert values[0] == pytest.approx(values[1], rel=1e-6, abs=1e-9)


def test_a_column_of_zeros_is_lost_alone() -> None:
    X = np.eye(5)
    X[:, 2] = 0.0
    found = determined(NAMES, X)
    assert found.undetermined == ("R12",)
    assert found.base == ()
    assert found.identified == ("R11", "R22", "W1", "Fv1")


def test_a_direction_made_of_noise_is_not_determined() -> None:
    rng = np.random.default_rng(2)
    X = np.column_stack((rng.normal(size=500), 0.1 * rng.normal(size=500)))
    noise = np.diag([0.0, 0.01 * 500])
    assert determined(("M1", "M2"), X).complete
    assert determined(("M1", "M2"), X, noise).undetermined == ("M2",)


def test_one_step_of_three_names_what_is_open_and_the_steps_to_add(multisine_run: Run) -> None:
    only = replace(
        multisine_run, records=tuple(r for r in multisine_run.records if r.step == "step2")
    )
    result = identify([only])
    said = detail(result, "base parameters mechanical")
    assert "M1" in said
    assert "R12" in said
    assert "excite joint 2 with joint 1 closed" in said
    assert "excite joint 1 with joint 2 at end_max" in said
    assert "excite joint 2 in both directions" in detail(result, "base parameters fluid")
    assert not result.estimates["M2"].identified


def test_all_steps_leave_nothing_to_say(multisine_run: Run) -> None:
    names = {check.name for check in identify([multisine_run]).checks}
    assert not any(name.startswith("base parameters") for name in names)


def test_an_electric_robot_is_told_its_combinations_as_well() -> None:
    robot = load_rig("electric-2dof")
    X = np.array([[1.0, 1.0, 0.0], [2.0, 2.0, 1.0], [1.0, 1.0, 3.0]])
    solution = solve(("M1", "M2", "W1"), [RowCluster("s", 1, triangle(X, np.ones(3)), 3)])
    (said,) = base_statements(robot, {"mechanical": solution})
    assert not said.ok
    assert "M1 + M2" in said.detail


def test_records_in_which_nothing_moved_are_refused(multisine_run: Run) -> None:
    still = replace(
        multisine_run, records=tuple(replace(r, locked=(1, 2)) for r in multisine_run.records)
    )
    with pytest.raises(InputError, match="every joint locked"):
        identify([still])
