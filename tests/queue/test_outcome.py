"""How an item ended whose process nobody watched: read from its folder and its last line."""

from __future__ import annotations

from pathlib import Path

import pytest

from rig.queue.outcome import outcome_of_folder
from rig.runs.rigs import load_rig
from tests.services.children import finish
from tests.services.fake_driver import FakeDriver
from tests.services.test_recorder import take


@pytest.mark.parametrize(
    ("last_line", "state"),
    [
        ("device: the device does not answer", "device lost"),
        ("outputs not confirmed at zero; device: the device does not answer", "device lost"),
        ("device in use: another client has control", "device lost"),
        ("stopped by a person", "stopped"),
        ("records.h5: cannot be written", "failed"),
    ],
)
def test_a_lost_device_is_one_also_where_the_outputs_could_not_be_confirmed(
    tmp_path: Path, last_line: str, state: str
) -> None:
    folder = tmp_path / "run"
    take(folder, FakeDriver(load_rig("shinshu-2dof")))
    (folder / "state").write_text("aborted\n")
    outcome = outcome_of_folder(folder, last_line)
    assert outcome.state == state
    assert last_line in outcome.reason


def test_a_lost_device_is_one_also_where_its_process_was_killed_as_it_ended(tmp_path: Path) -> None:
    code, _ = finish(tmp_path / "run", "kill at end of a lost device", 5)
    assert code == -9
    outcome = outcome_of_folder(tmp_path / "run", "")
    assert outcome.state == "device lost"
    assert "does not answer" in outcome.reason
