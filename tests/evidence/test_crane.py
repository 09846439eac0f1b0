"""The measured crane boom: imported, and what its flows lack told on records not seen.

The records are public (University of Agder, btorjus/Bachelor) and not part of this repository.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from analysis.trace.engine import trace
from rig.model.parse import InputError
from rig.runs.rigs import load_rig
from tests.studies.machines import crane as study

PLACE = Path(os.environ.get("BRAMAH_DATA", Path(__file__).parents[3] / "shared" / "data"))
FOLDER = PLACE / "uia_crane"
measured = pytest.mark.skipif(not FOLDER.is_dir(), reason=f"no measured crane in {FOLDER}")


def test_the_booms_geometry_is_that_of_its_pins() -> None:
    """Base pin and boom pin as points in the plane, against the cylinder's length."""
    linkage = load_rig("uia-crane").joints[0].linkage
    base = np.array([0.427, -1.057])
    for boom in np.radians([-16.0, 0.0, 15.0, 30.0]):
        turn = np.array([[np.cos(boom), -np.sin(boom)], [np.sin(boom), np.cos(boom)]])
        length = np.linalg.norm(turn @ np.array([0.547, -0.133]) - base)
        q = boom + np.pi / 2 + np.arctan2(0.061, 3.216)
        assert linkage.piston(q) + linkage.mid_length == pytest.approx(length, abs=2e-4)


def test_a_folder_without_the_records_is_refused_in_words(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"expected two files \*ramp\*.csv"):
        study.load(tmp_path)


@pytest.mark.slow
@measured
def test_a_dead_band_with_two_edges_is_what_the_flows_lack_most() -> None:
    data = study.load(FOLDER)
    found = trace([data.second, data.full], [data.first], families=("fluid",))
    assert set(found.before) == {"flow_cap_1", "flow_rod_1"}
    best = (*found.effects, *found.refused)[0]
    assert (best.name, best.where) == ("valve_deadband", "joint 1")
    assert best.removed_fraction > 0.5
    edges = {n: e.value for n, e in best.parameters.items()}
    assert 0.15 < edges["w_ahead_1"] < 0.35
    assert 0.15 < edges["w_astern_1"] < 0.35


@measured
@pytest.mark.slow
def test_with_the_dead_band_known_an_unseen_ramp_is_followed_ten_times_closer() -> None:
    data = study.load(FOLDER)
    said, left = study.known_band([data.second, data.full], [data.first])
    plain, known = (line.split() for line in said.splitlines()[2:])
    errors = [float(line[line.index("mm") - 1]) for line in (plain, known)]
    assert errors[1] < 0.15 * errors[0]
    assert (left.verdict, left.effects) == ("unexplained", ())
    # The rod side's pressure opens the counterbalance valve.
    assert any("rod_pressure_1" in d.variable for d in left.depends_on[:2])


@pytest.mark.slow
@measured
def test_the_counterbalance_valve_stays_unexplained() -> None:
    data = study.load(FOLDER)
    down = [study.part(run, "down", begin=study.RAISED) for run in (data.second, data.first)]
    found = trace(down[:1], down[1:], families=("fluid",))
    assert found.verdict == "unexplained"
    assert not found.effects
    assert [clue.variable for clue in found.depends_on[:2]] == ["piston_1", "velocity_1"]
