"""A run is recorded: what was measured is in records.h5, sample by sample, and says its units."""

from __future__ import annotations

import fcntl
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import yaml

from drivers.base import OutputLaw, SampleBlock
from rig.bench.session import Bench
from rig.model.channels import unit_of
from rig.model.parse import InputError
from rig.model.trips import RecordingFailed
from rig.runs import archive
from rig.runs.listing.index import indexed_runs
from rig.runs.recorder import Recorder, RecordMeta
from rig.runs.recover import recover
from rig.runs.rigs import load_rig
from rig.runs.runstate import read_events
from rig.runs.store import load_run, read_header
from tests.services.fake_driver import FakeDriver, samples

RIG = load_rig("shinshu-2dof")


def take(folder: Path, driver: FakeDriver) -> None:
    """Two repeats of a step with something before, between and after."""
    recorder = Recorder(folder, RIG, protocol={"name": "demo", "steps": [1, 2]}, seed=7)
    with Bench(RIG, driver, recorder) as bench:
        bench.upload(1, np.sin(np.linspace(0, 2 * np.pi, 50, endpoint=False)))
        bench.run_for(0.035)
        for repeat in (1, 2):
            start = bench.apply([OutputLaw(), OutputLaw(gain=0.5, limit=2)], restart=True)
            about = {"step": "step1", "locked": (1,), "period": 50, "lines": (1,)}
            with bench.record(
                repeat=repeat, start_tick=start + 3, ticks=100, **about
            ) as record:  # fmt: skip
                bench.run_for(0.11)
                record.note(lock_1="closed", lock_give_m_1=1e-5)
        bench.run_for(0.02)


def test_every_sample_of_every_record_comes_back_with_its_attributes(tmp_path: Path) -> None:
    take(tmp_path / "run", FakeDriver(RIG, first_tick=5000))
    run = load_run(tmp_path / "run")
    assert [r.name for r in run.records] == ["step1_r1", "step1_r2"]
    assert (run.rig, run.state) == (RIG, "done")
    first, second = run.records
    ticks = np.arange(5043, 5143)
    expected = samples(RIG, ticks)
    expected[:, -1] = 0.5 * np.sin(2 * np.pi * (ticks - 5040) / 50)
    expected[:, RIG.recorded.index("spool_2")] = RIG.joints[1].valve.spool_gain * expected[:, -1]
    for column, name in enumerate(RIG.recorded):
        np.testing.assert_allclose(first.channels[name], expected[:, column], rtol=0, atol=1e-9)
    assert (first.step, first.locked, first.repeat, first.sample_rate) == ("step1", (1,), 1, 1000)
    assert (first.period, first.lines, first.start) == (50, (1,), 0.043)
    assert first.attributes["device_s"] == 5.043
    assert first.attributes["lock_1"] == "closed"
    counts = {k: first.attributes[k] for k in ("lost_samples", "late_blocks", "saturated_samples")}
    assert counts == {"lost_samples": 0, "late_blocks": 0, "saturated_samples": 0}
    assert first.attributes["jitter_max_s"] == 0.0
    assert second.attributes["start_tick"] == 5153
    np.testing.assert_array_equal(first.channels["command_2"], second.channels["command_2"])


def test_the_file_is_plain_hdf5_with_units_and_nothing_measured_is_thrown_away(
    tmp_path: Path,
) -> None:
    take(tmp_path / "run", FakeDriver(RIG))
    assert sorted(p.name for p in (tmp_path / "run").iterdir()) == [
        "events.jsonl", "records.h5", "run.yaml", "state",
    ]  # fmt: skip
    assert (tmp_path / "run" / "state").read_text() == "done\n"
    with h5py.File(tmp_path / "run" / "records.h5") as file:
        assert sorted(file) == ["between", "step1_r1", "step1_r2"]
        group = file["step1_r1"]
        for name in RIG.recorded:
            assert group[name].dtype == np.float64
            assert group[name].attrs["units"] == unit_of(name)
        assert list(group.attrs["locked"]) == [1]
        assert group.attrs["locked"].dtype == np.int64
        everything = [
            g["piston_1"][:] for g in (group, file["step1_r2"], *file["between"].values())
        ]
        known = samples(RIG, np.arange(280))[:, RIG.recorded.index("piston_1")]
        np.testing.assert_array_equal(np.sort(np.concatenate(everything)), np.sort(known))


def test_lost_samples_are_nan_on_an_unbroken_time_base_and_counted(tmp_path: Path) -> None:
    lost = {4, 5, 9}
    driver = FakeDriver(RIG, spoil=lambda b: None if b.sequence in lost else b)
    recorder = Recorder(tmp_path / "run", RIG)
    with Bench(RIG, driver, recorder) as bench:
        bench.exchange()
        with bench.record(RecordMeta("s")):
            bench.run_for(0.12)
        assert bench.lost_samples == 30
    (record,) = load_run(tmp_path / "run").records
    assert record.samples == 120
    assert record.attributes["lost_samples"] == 30
    known = samples(RIG, np.arange(10, 130))[:, RIG.recorded.index("cap_pressure_2")]
    gone = np.isnan(record.channels["cap_pressure_2"])
    assert np.flatnonzero(gone).tolist() == [*range(30, 50), *range(80, 90)]
    np.testing.assert_array_equal(record.channels["cap_pressure_2"][~gone], known[~gone])
    events = [e for e in read_events(tmp_path / "run") if e["event"] == "samples lost"]
    assert [(e["tick"], e["lost"]) for e in events] == [(40, 20), (90, 10)]


def test_saturated_samples_are_counted_per_channel(tmp_path: Path) -> None:
    def spoil(block: SampleBlock) -> SampleBlock:
        marks = block.saturated.copy()
        marks[2, 1] = marks[7, 1] = marks[3, 4] = True
        return replace(block, saturated=marks)

    with Bench(RIG, FakeDriver(RIG, spoil=spoil), Recorder(tmp_path / "run", RIG)) as bench:
        bench.exchange()
        with bench.record(step="s"):
            bench.run_for(0.05)
    (record,) = load_run(tmp_path / "run").records
    assert record.attributes["saturated_samples"] == 15
    with h5py.File(tmp_path / "run" / "records.h5") as file:
        assert file["s_r1"]["piston_1"].attrs["saturated_samples"] == 10
        assert file["s_r1"][RIG.channels[4]].attrs["saturated_samples"] == 5


def test_late_blocks_are_told_in_real_time_only(tmp_path: Path) -> None:
    now = [0.0]

    def wait(sequence: int) -> None:
        now[0] += 0.010 if sequence != 6 else 0.040
        now[0] -= 0.030 if sequence == 7 else 0.0  # the backlog is read at once

    for name, virtual in (("real", False), ("virtual", True)):
        now[0] = 0.0
        driver = FakeDriver(RIG, virtual=virtual, before_block=wait)
        recorder = Recorder(tmp_path / name, RIG)
        with Bench(RIG, driver, recorder, clock=lambda: now[0]) as bench:
            bench.exchange()
            with bench.record(step="s"):
                bench.run_for(0.10)
    real, virtual_time = (load_run(tmp_path / n).records[0].attributes for n in ("real", "virtual"))
    assert real["late_blocks"] == 1
    assert real["jitter_max_s"] == pytest.approx(0.030, abs=1e-4)
    assert (virtual_time["late_blocks"], virtual_time["jitter_max_s"]) == (0, 0.0)


def test_an_unfinished_record_is_kept_apart_and_a_discarded_one_is_none(tmp_path: Path) -> None:
    with Bench(RIG, FakeDriver(RIG), Recorder(tmp_path / "run", RIG)) as bench:
        bench.exchange()
        with bench.record(step="good"):
            bench.run_for(0.05)
        record = bench.record(step="again").open()
        bench.run_for(0.05)
        record.discard("the lock slipped")
        with bench.record(step="again"):
            bench.run_for(0.03)
        bench.record(step="short", ticks=1000).open().close()
        bench.run_for(0.02)
    run = load_run(tmp_path / "run")
    assert [(r.name, r.samples) for r in run.records] == [("good_r1", 50), ("again_r1", 30)]
    both = load_run(tmp_path / "run", partial=True)
    assert [(r.name, r.samples) for r in both.records][-1] == ("short_r1", 20)
    assert both.records[-1].attributes["complete"] == 0


def test_a_name_is_used_once_and_must_be_one(tmp_path: Path) -> None:
    with Bench(RIG, FakeDriver(RIG), Recorder(tmp_path / "run", RIG)) as bench:
        with pytest.raises(ValueError, match="exchange a block first"):
            bench.record(step="s")
        bench.exchange()
        with bench.record(step="s"):
            bench.exchange()
        with pytest.raises(ValueError, match="this run already has a record"):
            bench.record(step="s").open()
        for name in ("a/b", "", "between", "../x"):
            with pytest.raises(ValueError, match="cannot name a record"):
                bench.record(step="s", name=name or "/")


def test_a_used_folder_is_refused_before_anything_moves(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="not empty"):
        Recorder(tmp_path, RIG)
    with pytest.raises(InputError, match="not a folder"):
        Recorder(tmp_path / "notes.txt", RIG)
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]


def test_runs_are_listed_with_their_state_and_records(tmp_path: Path) -> None:
    take(tmp_path / "a", FakeDriver(RIG))
    (tmp_path / "unrelated").mkdir()
    broken = tmp_path / "b"
    broken.mkdir()
    (broken / "run.yaml").write_text("format: 99\n")
    summaries = {s.path.name: s for s in indexed_runs(tmp_path)}
    assert set(summaries) == {"a", "b"}
    found = summaries["a"]
    assert (found.state, found.rig, found.protocol, found.records) == (
        "done", "shinshu-2dof", "demo", 2,
    )  # fmt: skip
    assert summaries["b"].state == "unreadable"
    assert "format 99" in summaries["b"].message


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda run: (run / "records.h5").write_bytes(b"no hdf5"), "not a readable records.h5"),
        (lambda run: (run / "records.h5").unlink(), "bramah recover"),
        (lambda run: (run / "run.yaml").write_text("rig: ["), "run.yaml:1: not valid YAML"),
        (
            lambda run: (run / "run.yaml").write_text("format: 1\ncreated: x\nrig: {}"),
            "run.yaml: rig",
        ),
        (lambda run: (run / "run.yaml").unlink(), "not a run folder"),
    ],
)
def test_a_damaged_run_is_refused_in_one_line(tmp_path: Path, spoil, said: str) -> None:
    take(tmp_path / "run", FakeDriver(RIG))
    spoil(tmp_path / "run")
    with pytest.raises(InputError, match=said) as error:
        load_run(tmp_path / "run")
    assert "\n" not in str(error.value)
    with pytest.raises(InputError, match="no such run folder"):
        load_run(tmp_path / "nowhere")


def test_a_lock_that_a_child_process_still_holds_does_not_keep_the_records_from_the_disk(
    tmp_path: Path,
) -> None:
    # A process started while the archive is open shares its lock until it runs its own program.
    with (
        ExitStack() as child,
        Bench(RIG, FakeDriver(RIG), Recorder(tmp_path / "run", RIG)) as bench,
    ):
        held = child.enter_context((tmp_path / "run" / "records.h5.tmp").open("wb"))
        fcntl.flock(held, fcntl.LOCK_EX)
        bench.exchange()
        with bench.record(step="s"):
            bench.run_for(0.1)
    assert [record.name for record in load_run(tmp_path / "run").records] == ["s_r1"]


@pytest.mark.parametrize("fault", ["a sample", "a section", "a count"])
def test_an_archive_that_differs_from_the_journal_is_never_put_in_its_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fault: str
) -> None:
    assemble, plan = archive.assemble, archive.plan

    def spoiled(*given):
        found = assemble(*given)
        if fault == "a sample":
            found.data[7, 3] = np.nextafter(found.data[7, 3], np.inf)
        return replace(found, lost=found.lost + (fault == "a count"))

    with monkeypatch.context() as patch:
        patch.setattr(archive, "assemble", spoiled)
        if fault == "a section":
            patch.setattr(archive, "plan", lambda *given: plan(*given)[1:])
        with pytest.raises(RecordingFailed, match=r"differs|miscounts|samples of the journal"):
            take(tmp_path / "run", FakeDriver(RIG))
    left = {p.name for p in (tmp_path / "run").iterdir()}
    assert "journal.sqlite" in left
    assert not {"records.h5", "records.h5.tmp"} & left
    assert indexed_runs(tmp_path)[0].state == "aborted"
    assert recover(tmp_path / "run").state == "done"
    assert len(load_run(tmp_path / "run").records) == 2


def test_run_yaml_says_who_took_it_on_what_with_which_software(tmp_path: Path) -> None:
    take(tmp_path / "run", FakeDriver(RIG))
    head = yaml.safe_load((tmp_path / "run" / "run.yaml").read_text())
    assert head["protocol"] == {"name": "demo", "steps": [1, 2]}
    assert (head["seed"], head["device"]) == (7, "fake bench")
    assert {"bramah", "python", "platform"} <= set(head["versions"])
    assert all(head[key] for key in ("created", "operator", "host"))
    assert head["rig"]["joints"][0]["cylinder"]["stroke"] == 0.075
    assert read_header(tmp_path / "run").rig == RIG
