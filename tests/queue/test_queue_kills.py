"""A runner killed at any moment: nothing runs twice, nothing is forgotten, nothing is lost."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from rig.queue.runner import end_orphan
from rig.queue.store import QueueStore
from rig.runs.store import load_run
from tests.queue.nights import LONG, Night, until
from tests.variants import every_second, kept


@pytest.fixture
def night(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Night:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))
    return Night(tmp_path)


def test_an_item_killed_together_with_its_runner_is_interrupted_and_recovered(
    night: Night,
) -> None:
    night.forked = False
    night.add("endless")
    night.add("done")
    runner = night.process()
    until(lambda: night.recorded(1) and night.item(1).pid is not None, "the item has recorded")
    runner.kill()
    runner.wait(LONG)
    pid = night.item(1).pid
    assert pid is not None
    os.kill(pid, signal.SIGKILL)
    report = night.run()
    assert night.states() == ["interrupted", "done"]
    assert "killed while no runner watched" in night.item(1).reason
    assert "recovered: " in night.item(1).reason
    assert load_run(night.item(1).run, partial=True).records
    assert [night.starts(1), night.starts(2)] == [1, 1]
    assert [item.id for item in report.ended] == [1, 2]


def test_an_item_that_outlives_its_runner_is_waited_for_and_not_started_again(
    night: Night,
) -> None:
    night.add("endless")
    night.add("done")
    runner = night.process()
    until(lambda: night.starts(1) == 1, "the item runs")
    runner.kill()
    runner.wait(LONG)
    second = night.process()
    log = night.folder / "runner.log"
    until(lambda: "still runs" in log.read_text() or second.poll() is not None, "waited for")
    with QueueStore(night.path) as store:
        store.cancel(1, "me")
    assert second.wait(LONG) == 1
    assert night.states() == ["cancelled", "done"]
    assert night.starts(1) == 1
    assert (Path(night.item(1).run) / "state").read_text() == "aborted\n"


def test_an_item_without_a_runner_can_be_cancelled_all_the_same(night: Night) -> None:
    night.add("endless")
    runner = night.process()
    until(lambda: night.starts(1) == 1 and night.item(1).pid is not None, "the item runs")
    runner.kill()
    runner.wait(LONG)
    with QueueStore(night.path) as store:
        assert end_orphan(night.path, store.cancel(1, "me"))
    state = Path(night.item(1).run) / "state"
    until(lambda: state.read_text() == "aborted\n", "ended by its signal")
    night.run()
    assert night.states() == ["cancelled"]


@pytest.mark.parametrize(
    "place", every_second(["claim", "begin", "note_process", "finish", "keep_results"])
)
@pytest.mark.parametrize("after", kept([False, True], (1,)))
def test_killed_at_each_of_its_steps_the_next_runner_carries_on(
    night: Night, place: str, after: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    night.add("done")
    night.add("done")
    monkeypatch.setenv("TEST_KILL", f"{place} {int(after)}")
    runner = night.process()
    assert runner.wait(LONG) == -signal.SIGKILL
    monkeypatch.delenv("TEST_KILL")
    night.run()
    states = night.states()
    assert states[1] == "done"
    assert night.starts(1) <= 1
    assert night.starts(2) == 1
    if place in ("claim", "finish", "keep_results") or (place, after) == ("begin", False):
        assert states[0] == "done"
    elif place == "begin":  # the moment between the note and the process: it never began
        assert states[0] == "interrupted"
        assert night.starts(1) == 0
    else:
        assert states[0] == "done", night.item(1).reason
        assert "ended while no runner was watching" in night.item(1).reason
    assert night.events(1).count("running") <= 1
