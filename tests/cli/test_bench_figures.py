"""The figures of speed: what stands beside what, and that both do the same work."""

from __future__ import annotations

import numpy as np

from rig.cli.bench.analysis import simulation_figures
from rig.cli.bench.figure import Figure
from rig.cli.bench.figures import text
from rig.runs.rigs import load_rig


def test_a_free_run_and_its_anchors_solve_the_same_equations_to_the_same_error() -> None:
    found = simulation_figures(load_rig("shinshu-2dof"), repeats=1)
    assert found["failure"] == ""
    assert found["difference_to_hand"] < 1e-9  # rad: written by hand, and the same
    assert found["angle_error"] < 1e-5
    assert all(np.isfinite(found[name]).all() for name in ("own", "hand", "odeint"))


def test_the_table_says_how_busy_the_machine_was() -> None:
    shown = text([Figure("analysis", "free run", 1.5, "ms")])
    assert shown.startswith("load of the machine over 1, 5 and 15 minutes: ")
    assert "analysis: free run" in shown
