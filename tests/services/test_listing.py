"""What `bramah runs` says of finished, killed, recovered and foreign folders, and its index."""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
from datetime import UTC, datetime, timedelta
from pathlib import Path

import h5py
import pytest
from typer.testing import CliRunner

from drivers.base import SampleBlock
from rig.bench.session import Bench
from rig.cli.main import command_line
from rig.model.parse import InputError
from rig.model.rig import Rig
from rig.runs import recorder
from rig.runs.listing import index, summary
from rig.runs.listing.index import INDEX, indexed_runs, rebuild
from rig.runs.recorder import Recorder
from rig.runs.recover import recover
from rig.runs.runstate import read_events
from rig.runs.store import load_run, read_header
from tests.services.children import RIG, finish, start
from tests.services.fake_driver import FakeDriver


def take(folder: Path, driver: FakeDriver | None = None, repeats: int = 2, **about: object) -> Path:
    """0.1 s, then records of 0.3 s."""
    written = Recorder(folder, RIG, **about)  # type: ignore[arg-type]
    with Bench(RIG, driver or FakeDriver(RIG), written, signals=False) as bench:
        bench.run_for(0.1)
        for repeat in range(1, repeats + 1):
            with bench.record(step="s", repeat=repeat):
                bench.run_for(0.3)
    return folder


def told(*words: object) -> list[dict[str, object]]:
    line = ["runs", *map(str, words), "--json", "-"]
    done = CliRunner().invoke(command_line(["runs"]), line, standalone_mode=False)
    assert done.exception is None, done.exception
    return json.loads(done.stdout)


def test_records_and_samples_are_counted_as_they_lie_in_the_folder(tmp_path: Path) -> None:
    def gap(block: SampleBlock) -> SampleBlock | None:
        return None if block.sequence in (15, 16) else block

    take(tmp_path / "gap", FakeDriver(RIG, spoil=gap))
    (one,) = told(tmp_path)
    assert (one["records"], one["partial"], one["state"]) == (2, 0, "done")
    assert (one["samples"], one["lost_samples"], one["outside"]) == (580, 20, 100)
    assert one["seconds"] == pytest.approx(0.7)
    with h5py.File(tmp_path / "gap" / "records.h5") as file:  # an independent count
        whole = sum(int((~(g["piston_1"][:] != g["piston_1"][:])).sum()) for g in
                    (file["s_r1"], file["s_r2"]))  # fmt: skip
    assert whole == one["samples"]


def test_an_interrupted_run_says_what_to_do_and_after_recover_that_it_was_done(
    tmp_path: Path,
) -> None:
    run = tmp_path / "killed"
    finish(run, "kill at block", 45)
    (before,) = told(tmp_path)
    assert (before["state"], before["recovered"]) == ("interrupted", False)
    assert "bramah recover" in str(before["message"])
    assert (before["records"], before["partial"]) == (1, 1)
    assert before["samples"] == 440
    report = recover(run)
    (after,) = told(tmp_path)
    assert (after["state"], after["recovered"]) == ("interrupted", True)
    assert "bramah recover" not in str(after["message"])
    assert str(after["message"]).startswith("recovered: 2 record(s), 1 of them unfinished")
    for key in ("records", "partial", "samples", "outside"):
        assert after[key] == before[key], key
    assert (report.samples, report.outside) == (440, after["outside"])


def test_a_running_run_is_counted_while_it_is_written_and_never_taken_from_the_index(
    tmp_path: Path,
) -> None:
    child = start(tmp_path / "now", "serve", 100_000)
    try:
        while not (found := told(tmp_path)) or int(str(found[0]["samples"])) < 100:
            assert child.poll() is None
        assert found[0]["state"] == "running"
    finally:
        child.kill()
        child.communicate()
    assert told(tmp_path)[0]["state"] == "interrupted"


def test_runs_are_filtered_by_state_time_rig_and_protocol(tmp_path: Path) -> None:
    take(tmp_path / "a", protocol={"name": "warm-up"})
    take(tmp_path / "b", protocol={"name": "amplitude-1"})
    take(tmp_path / "c", protocol={"name": "amplitude-2"})
    finish(tmp_path / "d", "kill at block", 20)

    def names(*words: object) -> list[str]:
        return [Path(str(one["path"])).name for one in told(tmp_path, *words)]

    assert names("--state", "done") == ["a", "b", "c"]
    assert names("--protocol", "amplitude-*") == ["b", "c"]
    assert names("--protocol", "amplitude-1", "--protocol", "warm-up") == ["a", "b"]
    assert names("--rig", "boom-*") == []
    assert names("--rig", "shinshu-2dof", "--state", "interrupted") == ["d"]
    assert names("--since", "1h") == ["a", "b", "c", "d"]
    tomorrow = (datetime.now(UTC) + timedelta(days=1)).isoformat()
    assert names("--since", tomorrow) == []
    for words in (("--state", "finished"), ("--since", "yesterday")):
        line = ["runs", str(tmp_path), *words]
        done = CliRunner().invoke(command_line(["runs"]), line, standalone_mode=False)
        assert isinstance(done.exception, InputError)


def test_the_index_spares_reading_unchanged_folders_and_follows_every_change(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in "abc":
        take(tmp_path / name)
    first = indexed_runs(tmp_path)
    read: list[str] = []

    def counted(folder: Path) -> summary.RunSummary:
        read.append(folder.name)
        return summary.summarise(folder)

    monkeypatch.setattr(index, "summarise", counted)
    assert indexed_runs(tmp_path) == first
    assert read == []
    (tmp_path / "b" / "state").write_text("aborted\n")
    shutil.rmtree(tmp_path / "c")
    take(tmp_path / "e")
    now = {one.path.name: one.state for one in indexed_runs(tmp_path)}
    assert now == {"a": "done", "b": "aborted", "e": "done"}
    assert sorted(read) == ["b", "e"]
    with sqlite3.connect(tmp_path / INDEX) as db:
        rows = db.execute("SELECT name, state, samples FROM run ORDER BY name").fetchall()
    db.close()
    assert rows == [("a", "done", 600), ("b", "aborted", 600), ("e", "done", 600)]


def test_a_run_that_can_be_read_again_is_listed_so(tmp_path: Path) -> None:
    archive = take(tmp_path / "monday") / "records.h5"
    whole, about = archive.read_bytes(), archive.stat()
    archive.write_bytes(bytes(len(whole)))  # a disk that returns zeros, until the backup is there
    os.utime(archive, ns=(about.st_atime_ns, about.st_mtime_ns))
    (damaged,) = told(tmp_path)
    assert damaged["records"] == -1
    assert "not a readable records.h5" in str(damaged["message"])
    archive.write_bytes(whole)
    os.utime(archive, ns=(about.st_atime_ns, about.st_mtime_ns))
    (restored,) = told(tmp_path)
    assert (restored["records"], restored["message"]) == (2, "")


@pytest.mark.parametrize("damage", ["rubbish", "truncated", "lying", "older"])
def test_a_damaged_index_is_made_anew_from_the_folders(tmp_path: Path, damage: str) -> None:
    take(tmp_path / "a")
    first = indexed_runs(tmp_path)
    path = tmp_path / INDEX
    if damage == "rubbish":
        path.write_bytes(b"rubbish" * 500)
    elif damage == "truncated":
        path.write_bytes(path.read_bytes()[:5000])
    else:
        db = sqlite3.connect(path)
        if damage == "older":
            db.executescript("DROP TABLE run; CREATE TABLE run (x); PRAGMA user_version=0")
        else:
            db.execute("UPDATE run SET line = '{\"path\": 3}'")
        db.commit()
        db.close()
    assert indexed_runs(tmp_path) == first
    path.write_bytes(b"")
    assert rebuild(tmp_path) == 1
    assert indexed_runs(tmp_path) == first


def test_a_folder_that_may_only_be_read_is_listed_all_the_same(tmp_path: Path) -> None:
    take(tmp_path / "a")
    (tmp_path / INDEX).mkdir()  # no database can be made there
    assert [one.records for one in indexed_runs(tmp_path)] == [2]


def test_all_times_count_from_the_first_sample_across_a_restart_of_the_device(
    tmp_path: Path,
) -> None:
    driver = FakeDriver(RIG, first_tick=70_000)
    with Bench(RIG, driver, Recorder(tmp_path / "run", RIG), signals=False) as bench:
        bench.exchange()
        with bench.record(step="s", repeat=1):
            bench.run_for(0.5)
        driver.tick = 3_000  # the device was switched off and on: its clock begins anew
        bench.restart()
        bench.run_for(0.1)
        with bench.record(step="s", repeat=2):
            bench.run_for(0.5)
            bench.event("looked at", bench.tick)
    first, second = load_run(tmp_path / "run").records
    assert (first.start, second.start) == (0.01, pytest.approx(0.61))
    assert first.attributes["device_s"] == 70.01
    assert second.attributes["device_s"] == 3.1
    hosts = [datetime.fromisoformat(str(r.attributes["stream_host_time"])) for r in (first, second)]
    assert hosts[0] <= hosts[1]
    events = read_events(tmp_path / "run")
    assert [e["t"] for e in events] == sorted(e["t"] for e in events)
    (looked,) = (e for e in events if e["event"] == "looked at")
    assert (looked["t"], looked["tick"]) == (pytest.approx(1.11), 3_600)
    assert {"time", "tick", "t"} <= set(events[-1])


def test_in_real_time_the_pause_between_two_streams_is_part_of_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = [100.0]
    monkeypatch.setattr(recorder.time, "monotonic", lambda: clock[0])
    written = Recorder(tmp_path / "run", RIG)
    driver = FakeDriver(RIG, virtual=False)
    written.open(driver.info)
    for _ in range(2):
        written.begin_stream()
        written.append(driver.read_block(), 0.0)
        clock[0] += 7.5
    written.finish("done")
    streams = [e for e in read_events(tmp_path / "run") if e["event"] == "stream begins"]
    assert [e["t"] for e in streams] == [0.0, 7.5]


def test_a_run_keeps_what_it_takes_to_take_it_again(tmp_path: Path) -> None:
    provenance = {"command": "bramah run x", "seeds": {"step1 joint 2": 7}}
    take(tmp_path / "run", provenance=provenance)
    header = read_header(tmp_path / "run")
    assert header.provenance == provenance
    assert {"bramah", "python", "numpy", "h5py", "numba"} <= set(header.versions)


def test_a_sensor_s_calibration_has_a_date_and_a_serial_number() -> None:
    data = RIG.model_dump(mode="json")
    given = {"date": "2026-02-01", "serial": "A-117", "certificate": "DKD 4711"}
    data["sensors"]["calibrations"] = {"cap_pressure_1": given}
    rig = Rig.model_validate(data)
    assert rig.sensors.calibrations["cap_pressure_1"].date.isoformat() == "2026-02-01"
    assert Rig.model_validate(rig.model_dump(mode="json")) == rig
    soon = {**given, "date": "soon"}
    for wrong in ({"piston": given}, {"piston_3": given}, {"piston_1": soon}, {"piston_1": {}}):
        data["sensors"]["calibrations"] = wrong
        with pytest.raises(ValueError, match="calibrations"):
            Rig.model_validate(data)
