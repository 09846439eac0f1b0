"""A few of what `make study NAME=kills` and `NAME=nights` do by the hundred."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.studies.nights.endurance import endure
from tests.studies.nights.faulty_queue import faulty_queue
from tests.studies.nights.kills import kills_on
from tests.variants import kept


@pytest.mark.parametrize("wire", kept(["modbus-rtu", "serial"], (1,)))
def test_runs_killed_on_a_real_wire_lose_nothing_and_leave_the_outputs_at_zero(
    wire: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("BRAMAH_STATE", str(tmp_path / "state"))
    found = kills_on(wire, 2, 3, tmp_path / wire, 5.0)
    assert [kill.wrong for kill in found] == [(), ()]
    assert sum(kill.acknowledged for kill in found) > 0


@pytest.mark.slow
def test_a_queue_with_faults_and_killed_runners_forgets_nothing(tmp_path: Path) -> None:
    found = faulty_queue(tmp_path / "queue", 8, 2, 4)
    assert found.wrong == ()
    assert sum(found.states.values()) == 8


def test_a_long_recording_keeps_every_sample(tmp_path: Path) -> None:
    found = endure(tmp_path / "long", 0.02)
    assert found.kept == found.samples == 72_000
