"""Somebody takes records to another program: every number arrives, with its unit."""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from asammdf import MDF
from pyarrow import parquet
from scipy.io import loadmat

from rig.bench.session import Bench
from rig.model.parse import InputError
from rig.model.records import Record, Run
from rig.runs.archive import write_run
from rig.runs.exchange import export
from rig.runs.exchange.export import export_run, library_missing
from rig.runs.exchange.importer import import_records
from rig.runs.listing.index import indexed_runs
from rig.runs.recorder import Recorder
from rig.runs.rigs import load_rig
from rig.runs.runstate import STREAM, EventLog, read_events
from rig.runs.store import load_run
from tests.cli.bench import bramah_here
from tests.services.fake_driver import FakeDriver, samples

RIG = load_rig("shinshu-2dof")
DATA = samples(RIG, np.arange(60))
ONE = Record(
    "step1_r1", "step1", (1,), 1, 1000.0, dict(zip(RIG.recorded, DATA.T, strict=True)),
    start=2.5, period=20, lines=(1, 3),
    attributes={"lost_samples": 0, "lock_1": "closed", "loaded": 1},
)  # fmt: skip
# A machine of its own, so that no shipped name can stand in for its description.
OTHER = RIG.model_copy(update={"name": "ours", "gravity": 9.81})


@pytest.fixture
def run(tmp_path: Path) -> Path:
    records = (ONE, replace(ONE, name="step1_r2", repeat=2, start=3.0))
    return write_run(tmp_path / "run", Run(OTHER, records))


@pytest.mark.parametrize("kind", ["csv", "mat"])
def test_what_import_takes_comes_back_to_the_last_bit(run: Path, tmp_path: Path, kind: str) -> None:
    files = export_run(run, tmp_path / "out", kind)
    assert sorted(f.name for f in files) == sorted(p.name for p in (tmp_path / "out").iterdir())
    back = load_run(import_records(tmp_path / "out" / "manifest.yaml", tmp_path / "back").path)
    assert back.rig == OTHER
    for one, other in zip(load_run(run).records, back.records, strict=True):
        for name in (
            "name",
            "step",
            "locked",
            "repeat",
            "sample_rate",
            "period",
            "lines",
            "loaded",
        ):
            assert getattr(one, name) == getattr(other, name)
        for name, values in one.channels.items():
            np.testing.assert_array_equal(values, other.channels[name])


def test_a_folder_of_exported_files_is_not_taken_for_a_run(run: Path, tmp_path: Path) -> None:
    export_run(run, tmp_path / "out", "csv")
    assert [s.path for s in indexed_runs(tmp_path)] == [run]


def test_matlab_finds_vectors_with_their_units_beside_them(run: Path, tmp_path: Path) -> None:
    export_run(run, tmp_path / "out", "mat")
    found = loadmat(tmp_path / "out" / "step1_r1.mat", simplify_cells=True)
    np.testing.assert_array_equal(found["rod_pressure_2"], ONE.channels["rod_pressure_2"])
    assert found["time"][0] == 2.5
    assert found["units"]["rod_pressure_2"] == "Pa"
    assert found["about"]["lock_1"] == "closed"


def test_a_parquet_file_has_units_at_its_fields(run: Path, tmp_path: Path) -> None:
    export_run(run, tmp_path / "out", "parquet")
    found = parquet.read_table(tmp_path / "out" / "step1_r2.parquet")
    assert found.column_names == ["time", *RIG.recorded]
    np.testing.assert_array_equal(found["spool_1"].to_numpy(), ONE.channels["spool_1"])
    assert found.schema.field("spool_1").metadata == {b"unit": b"V"}
    assert json.loads(found.schema.metadata[b"locked"]) == [1]
    assert json.loads(found.schema.metadata[b"lock_1"]) == "closed"


def test_an_mdf_file_has_signals_over_the_time_of_the_run(run: Path, tmp_path: Path) -> None:
    """Its start and a signal's time give the date of a sample, whenever it is exported."""
    log = EventLog(run)
    log.append(STREAM, 7000, {"t": 0.5, "stream": 0})
    log.close()
    (event,) = read_events(run)
    export_run(run, tmp_path / "out", "mf4")
    with MDF(tmp_path / "out" / "step1_r1.mf4") as found:
        zero = datetime.fromisoformat(event["time"]) - timedelta(seconds=0.5)
        assert abs(found.header.start_time - zero) < timedelta(milliseconds=1)
        signal = found.get("cap_pressure_1")
        np.testing.assert_array_equal(signal.samples, ONE.channels["cap_pressure_1"])
        np.testing.assert_allclose(signal.timestamps, 2.5 + ONE.time, rtol=1e-12)
        assert signal.unit == "Pa"


def test_a_models_channels_stand_beside_the_measured_ones(run: Path, tmp_path: Path) -> None:
    export_run(run, tmp_path / "out", "parquet", lambda r: {"piston_1": 2 * r.channels["piston_1"]})
    found = parquet.read_table(tmp_path / "out" / "step1_r1.parquet")
    np.testing.assert_array_equal(found["model_piston_1"], 2 * ONE.channels["piston_1"])
    assert found.schema.field("model_piston_1").metadata == {b"unit": b"m"}


def test_lost_samples_stay_lost_and_import_says_where(run: Path, tmp_path: Path) -> None:
    holed = {name: values.copy() for name, values in ONE.channels.items()}
    for values in holed.values():
        values[7] = np.nan
    write_run(tmp_path / "holed", Run(RIG, (replace(ONE, channels=holed),)))
    export_run(tmp_path / "holed", tmp_path / "out", "csv")
    with pytest.raises(InputError, match=r"step1_r1\.csv.*row 9"):
        import_records(tmp_path / "out" / "manifest.yaml", tmp_path / "back")


def test_a_record_that_was_cut_short_is_named_where_it_is_left_out(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "run", RIG)
    with Bench(RIG, FakeDriver(RIG), recorder, signals=False) as bench:
        bench.exchange()
        with bench.record(step="s", repeat=1):
            bench.run_for(0.3)
        with suppress(RuntimeError), bench.record(step="s", repeat=2):
            bench.run_for(0.1)
            raise RuntimeError
    done = bramah_here("export", tmp_path / "run", "--format", "csv")
    assert "left out, not recorded to the end: s_r2 (--format ro-crate contains" in done.stderr
    assert not (tmp_path / "run-csv" / "s_r2.csv").exists()


def test_refusals_come_before_anything_is_written(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(InputError, match="xls: expected one of: csv mat parquet mf4"):
        export_run(run, tmp_path / "out", "xls")
    with pytest.raises(InputError, match="no such run folder"):
        export_run(tmp_path / "none", tmp_path / "out", "csv")
    assert not (tmp_path / "out").exists()
    with pytest.raises(InputError, match="not empty"):
        export_run(run, run, "csv")
    assert not library_missing("parquet")
    monkeypatch.setitem(export.LIBRARIES, "parquet", "no_such_library")
    assert library_missing("parquet") == "no_such_library"


def test_half_an_export_does_not_stay_and_pass_for_a_whole_one(run: Path, tmp_path: Path) -> None:
    def fails(record: Record) -> dict[str, np.ndarray]:
        if record.repeat == 2:
            raise InputError("no")
        return {}

    with pytest.raises(InputError):
        export_run(run, tmp_path / "out", "csv", fails)
    assert not (tmp_path / "out").exists()
    assert export_run(run, tmp_path / "out", "csv")


@pytest.mark.parametrize("made_before", [False, True])
def test_the_files_of_an_export_appear_together(
    run: Path, tmp_path: Path, *, made_before: bool
) -> None:
    # A process killed meanwhile removes nothing: until the last file is written none is there.
    out = tmp_path / "out"
    if made_before:
        out.mkdir()
    seen = []

    def looks(record: Record) -> dict[str, np.ndarray]:
        seen.append(sorted(path.name for path in out.glob("[!.]*")))
        return {}

    files = export_run(run, out, "csv", looks)
    assert seen == [[]] * len(seen)
    assert len(seen) > 1
    assert sorted(out.iterdir()) == sorted(files)
    assert list(tmp_path.glob(".*")) == []
