"""An operator looks at runs, protocols and the queue, and starts verbs from the screen."""

from __future__ import annotations

import json
import os
import signal
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from protocols.files.library import shipped_names
from rig.queue.items import QueueJob
from rig.queue.store import QueueStore
from rig.runs.runstate import write_state
from rig.runs.store import create_run
from rig.tui import jobs
from rig.tui.app import Monitor
from rig.tui.browse import BrowserState, read_disk
from rig.tui.jobs import VerbJob
from tests.services.children import RIG
from tests.tui.glass import Clock, Glass, Machine, Recorded, endpoint
from tests.tui.recorded import Bench, followed, run, stopped

HERE = endpoint()


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a run that is being written, a corrupt one, and a queue with one item."""
    monkeypatch.setenv("BRAMAH_STATE", str(tmp_path / "state"))
    (tmp_path / "state").mkdir()
    runs = tmp_path / "runs"
    create_run(runs / "fresh", RIG, protocol=None, operator=None)
    (runs / "broken").mkdir()
    (runs / "broken" / "run.yaml").write_text("format: [1")
    with QueueStore(tmp_path / "state" / "queue.sqlite") as store:
        job = QueueJob("validate", "shinshu-2dof", str(runs / "q"), "validate")
        store.add(job, 0, {})
    return runs


@pytest.fixture
def said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A stand-in for the command that keeps each call; `identify` answers with parameters."""
    script = tmp_path / "bramah.py"
    script.write_text(
        "import json, os, pathlib, sys, time\n"
        f"asked = open({str(tmp_path / 'asked')!r}, 'a')\n"
        "asked.write(json.dumps(sys.argv[1:]) + '\\n')\n"
        "asked.close()\n"
        "if sys.argv[1] == 'identify':\n"
        "    print(json.dumps({'parameters': {\n"
        "      'b': {'value': 1e9, 'unit': 'Pa', 'std': 1e7, 'ci95': [9.8e8, 1.02e9]},\n"
        "      'M1': {'value': 1.0, 'unit': 'kg', 'std': 1.0, 'ci95': [-1.0, 3.0]}}}))\n"
        "elif sys.argv[1] == 'check':\n"
        "    print('step1 joint 2 piston   |---[=====]---|')\n"
        "elif sys.argv[1] == 'trace':\n"
        "    sys.exit('bramah: no record is complete')\n"
        "elif sys.argv[1] == 'run':\n"
        "    time.sleep(600)\n"
    )
    monkeypatch.setattr(jobs, "BRAMAH", (sys.executable, str(script)))
    return tmp_path / "asked"


class Office:
    """The page of runs in front of an operator."""

    def __init__(self, folder: Path, machine: Machine | None = None) -> None:
        self.clock = Clock()
        browsed = BrowserState(folder=folder, rig="shinshu-2dof")
        self.app = Monitor(None, machine or Machine(), self.clock, threaded=False, browsed=browsed)

    async def opened(self, shown: Glass, tab: int = 0) -> None:
        await shown.press("0")
        while self.app.browsed.reading:
            await shown.pilot.pause(0.005)
        for _ in range(tab):
            await shown.press("right")
        await shown.watch()

    async def choose(self, shown: Glass, words: str) -> None:
        """Open what can be done with the marked line and choose it."""
        await shown.press("enter")
        assert self.app.dialog is not None
        for _ in range(list(self.app.dialog.choices).index(words)):
            await shown.press("down")
        await shown.press("enter")

    async def ended(self, shown: Glass) -> VerbJob:
        while self.app.browsed.job is None or self.app.browsed.job.code is None:
            await shown.pilot.pause(0.01)
        await shown.watch()
        return self.app.browsed.job


def asked(said: Path) -> list[list[str]]:
    return [json.loads(line) for line in said.read_text().splitlines()]


async def test_runs_protocols_and_the_queue_are_listed_and_a_corrupt_run_is_a_sentence(
    folder: Path,
) -> None:
    office = Office(folder)
    async with office.app.run_test(size=(120, 40)) as pilot:
        shown = Glass(office.app, pilot, office.clock)
        await office.opened(shown)
        assert "lock-and-excite-multisine" in shown.text
        await shown.press("right")
        assert "✕ unreadable" in shown.text
        assert "broken" in shown.text
        assert "● running" in shown.text
        assert "Traceback" not in shown.text
        await shown.press("right")
        assert "validate" in shown.text


async def test_a_run_that_ends_while_it_is_listed_is_not_shown_as_running(folder: Path) -> None:
    here = folder / "fresh"
    record = Recorded(replace(view, run=str(here)) for view in run(Bench(), 1.0))
    machine = Machine({HERE: record})
    office = Office(folder, machine)
    async with office.app.run_test(size=(120, 40)) as pilot:
        shown = Glass(office.app, pilot, office.clock)
        await shown.watch()
        await office.opened(shown, tab=1)
        assert "fresh   ● running" in shown.text
        last = office.app.link.frame.snapshot
        assert last is not None
        record.waiting.append(stopped(last))  # its folder is still being written
        await shown.watch()
        assert "● running" not in shown.text
        assert "fresh   ▲ aborted" in shown.text

        write_state(here, "aborted")
        machine.runs.clear()
        await shown.watch(2.0)
        while office.app.browsed.reading:
            await pilot.pause(0.005)
        assert [r.state for r in office.app.browsed.runs if r.path == here] == ["aborted"]


def test_a_folder_that_is_not_there_is_a_sentence(tmp_path: Path) -> None:
    found = read_disk(BrowserState(folder=tmp_path / "nowhere"))
    assert "nowhere" in found.trouble
    assert "\n" not in found.trouble
    assert found.protocols


def test_the_folders_own_protocols_are_listed_before_the_shipped_ones(tmp_path: Path) -> None:
    (tmp_path / "evening.yaml").write_text("version: 2\nname: evening\nsteps:\n  - hold: 1 s\n")
    (tmp_path / "arm.yaml").write_text("name: arm\nnote: {steps: none}\n")
    (tmp_path / "gone.yaml").symlink_to(tmp_path / "nowhere")
    found = read_disk(BrowserState(folder=tmp_path)).protocols
    assert found[0] == str(tmp_path / "evening.yaml")
    assert found[1:] == shipped_names()


async def test_a_protocol_is_picked_and_checked_and_its_envelopes_are_shown(
    folder: Path, said: Path
) -> None:
    office = Office(folder)
    async with office.app.run_test(size=(120, 40)) as pilot:
        shown = Glass(office.app, pilot, office.clock)
        await office.opened(shown)
        await office.choose(shown, "check on the twin")
        await office.ended(shown)
        (words,) = asked(said)
        assert words[0] == "check"
        assert words[2:] == ["--rig", "shinshu-2dof"]
        assert "|---[=====]---|" in shown.text
        assert "check: done" in shown.text


async def test_a_run_is_started_after_a_yes_and_outlives_the_screen(
    folder: Path, said: Path
) -> None:
    office = Office(folder)
    async with office.app.run_test(size=(120, 40)) as pilot:
        shown = Glass(office.app, pilot, office.clock)
        await office.opened(shown)
        await office.choose(shown, "start on the bench")
        assert "THE BENCH MOVES" in shown.text
        await shown.press("enter")  # no
        assert not said.exists()
        await office.choose(shown, "start on the bench")
        await shown.press("down")
        await shown.press("enter")
        while not said.exists() or not said.read_text().endswith("\n"):
            await pilot.pause(0.01)
        assert office.app.browsed.job is not None
        pid = office.app.browsed.job.pid
        assert f"process {pid}" in shown.text or pid
        await shown.press("q")
    (words,) = asked(said)
    assert words[0] == "run"
    assert "--unattended" in words
    os.kill(pid, 0)
    assert os.getsid(pid) == pid, "a session of its own: the terminal's end is not its end"
    os.kill(pid, signal.SIGKILL)


async def test_no_run_is_started_while_one_holds_the_bench(folder: Path, said: Path) -> None:
    machine = Machine({HERE: Recorded(map(followed, run(Bench(), 1.0)))})
    office = Office(folder, machine)
    async with office.app.run_test(size=(120, 40)) as pilot:
        shown = Glass(office.app, pilot, office.clock)
        await shown.watch()
        await office.opened(shown)
        await office.choose(shown, "start on the bench")
        assert "holds the bench; wait for its end" in shown.text
        assert not said.exists()


async def test_a_run_is_identified_with_intervals_and_a_failure_is_a_sentence(
    folder: Path, said: Path
) -> None:
    office = Office(folder)
    async with office.app.run_test(size=(120, 40)) as pilot:
        shown = Glass(office.app, pilot, office.clock)
        await office.opened(shown, tab=1)
        await office.choose(shown, "identify its parameters")
        await office.ended(shown)
        line = next(line for line in shown.lines if " b " in line and "Pa" in line)
        assert "9.8e+08 … 1.02e+09" in line
        assert "±2.0%" in line
        assert "▲ wide" in next(line for line in shown.lines if " M1 " in line)
        await office.choose(shown, "trace what its model lacks")
        assert "it needs a second run" in shown.text


def test_a_verb_that_fails_says_why_in_one_line(said: Path) -> None:
    import threading

    over = threading.Event()
    heard: list[VerbJob] = []

    def changed(job: VerbJob) -> None:
        heard.append(job)
        if job.code is not None:
            over.set()

    jobs.begin(("trace", "a"), changed)
    assert over.wait(60)
    assert heard[0].ended == ""
    assert heard[-1].ended == "could not be done: no record is complete"
