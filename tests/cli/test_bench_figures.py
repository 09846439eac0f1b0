"""The figures of speed: what stands beside what, and that both do the same work."""

from __future__ import annotations

from pathlib import Path

import pytest

from analysis.simulation.simulate import compiled, simulate
from rig.cli.bench.figure import Figure, processor_times
from rig.cli.bench.figures import text
from rig.cli.bench.speed.figures import four_joints
from rig.cli.bench.speed.free_run import both_moving, free_run_times
from rig.runs.rigs import load_rig


@pytest.mark.slow
def test_a_free_run_and_its_anchors_solve_the_same_equations_to_the_same_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    found = free_run_times(load_rig("shinshu-2dof"), repeats=1)
    assert found["failure"] == ""
    assert found["difference_to_hand"] < 1e-9  # rad: written by hand, and the same
    assert found["error"] < 1e-3  # of a state's range
    # No less exact, and not much more either: an anchor must not do more than is asked for.
    assert 0.2 * found["error"] < found["odeint_error"] <= found["error"]
    assert 0.1 * found["error"] < found["cvodes_error"] <= found["error"]
    assert all(found[name].least > 0.0 for name in ("bramah", "hand", "odeint", "cvodes"))
    assert not list(tmp_path.iterdir()), "compiled code is left in the folder one stands in"


def test_the_table_says_how_busy_the_machine_was() -> None:
    shown = text([Figure("analysis", "free run", 1.5, "ms")])
    assert shown.startswith("load of the machine over 1, 5 and 15 minutes: ")
    assert "analysis: free run" in shown


def test_anchors_take_turns_so_that_a_busy_machine_slows_all_alike() -> None:
    order: list[str] = []
    found = processor_times({n: lambda n=n: order.append(n) for n in "ab"}, 3)  # type: ignore[misc]
    assert "".join(order) == "ababab"
    assert found["a"].least <= found["a"].median


def test_the_arm_of_four_joints_has_an_inertia_that_bodies_can_have() -> None:
    rig = four_joints(load_rig("digger-3dof"))
    model, drive, start = both_moving(rig)
    found = simulate(compiled(model), drive, start, samples=500)
    assert found.failure == ""
    assert found.q.shape == (500, 4)
