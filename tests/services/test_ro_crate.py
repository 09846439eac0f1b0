"""A run as an RO-Crate, checked against the specification's rules by code of its own."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from datetime import date, datetime
from pathlib import Path
from typing import Any

import h5py
import pytest
from typer.testing import CliRunner

from rig.bench.session import Bench
from rig.cli.main import command_line
from rig.model.parse import InputError
from rig.model.rig import Rig
from rig.model.trips import RecordingFailed
from rig.runs.recorder import Recorder
from rig.runs.recover import recover
from rig.runs.store import load_run
from tests.cli.bench import bramah_here
from tests.full_disk import largest_file
from tests.services.children import RIG, finish
from tests.services.fake_driver import FakeDriver

LICENCE = "https://creativecommons.org/licenses/by/4.0/"


@pytest.fixture
def run(tmp_path: Path) -> Path:
    data = RIG.model_dump(mode="json")
    data["sensors"]["calibrations"] = {"piston_1": {"date": "2026-02-01", "serial": "A-117"}}
    written = Recorder(tmp_path / "monday", Rig.model_validate(data), operator="Ada")
    with Bench(written.rig, FakeDriver(written.rig), written, signals=False) as bench:
        bench.exchange()
        with bench.record(step="s", repeat=1):
            bench.run_for(0.3)
    return tmp_path / "monday"


def export(run: Path, *more: str) -> Path:
    words = ["export", str(run), "--format", "ro-crate", *more]
    done = CliRunner().invoke(command_line(["export"]), words, standalone_mode=False)
    if done.exception is not None:
        raise done.exception
    return Path(done.stdout.splitlines()[-1])


def references(value: Any) -> Iterator[str]:
    if isinstance(value, dict):
        if set(value) == {"@id"}:
            yield value["@id"]
        for item in value.values():
            yield from references(item)
    elif isinstance(value, list):
        for item in value:
            yield from references(item)


def checked(folder: Path) -> dict[str, dict[str, Any]]:
    """The MUSTs of RO-Crate 1.1, sections 4 to 6; returns the entities by their id."""
    document = json.loads((folder / "ro-crate-metadata.json").read_text(encoding="utf-8"))
    assert document["@context"] == "https://w3id.org/ro/crate/1.1/context"
    graph = document["@graph"]
    entities = {entity["@id"]: entity for entity in graph}
    assert len(entities) == len(graph), "an @id stands twice"
    assert all("@type" in entity for entity in graph)
    descriptor = entities["ro-crate-metadata.json"]
    assert descriptor["@type"] == "CreativeWork"
    assert descriptor["about"] == {"@id": "./"}
    assert descriptor["conformsTo"]["@id"].startswith("https://w3id.org/ro/crate/1.1")
    root = entities["./"]
    assert root["@type"] == "Dataset"
    assert root["name"]
    assert root["description"]
    assert date.fromisoformat(root["datePublished"])
    assert root["license"]
    parts = {part["@id"] for part in root["hasPart"]}
    on_disk = {path.name for path in folder.iterdir()} - {"ro-crate-metadata.json"}
    assert parts == on_disk
    for name in parts:
        entity, content = entities[name], (folder / name).read_bytes()
        assert entity["@type"] == "File"
        assert entity["contentSize"] == str(len(content))
        assert entity["sha256"] == hashlib.sha256(content).hexdigest()
    for entity in graph:  # flattened: nothing nested but references, and none to nothing
        for key, value in entity.items():
            for item in value if isinstance(value, list) else [value]:
                assert not isinstance(item, dict) or set(item) == {"@id"}, (entity["@id"], key)
    known = {*entities, "https://w3id.org/ro/crate/1.1"}
    outside = {r for r in references(graph) if not r.startswith("http://schema.org/")}
    assert outside <= known
    return entities


def test_a_run_becomes_a_crate_that_keeps_the_specification(run: Path) -> None:
    entities = checked(export(run, "--license", LICENCE))
    assert entities["./"]["license"] == {"@id": LICENCE}
    action = entities["#run"]
    assert action["@type"] == "CreateAction"
    assert action["actionStatus"]["@id"].endswith("CompletedActionStatus")
    assert entities[action["agent"]["@id"]]["name"] == "Ada"
    assert {"@id": "records.h5"} in action["result"]
    assert datetime.fromisoformat(action["startTime"]) <= datetime.fromisoformat(action["endTime"])
    units = {e["name"]: e["unitText"] for e in entities.values() if e["@type"] == "PropertyValue"}
    assert units["cap_pressure_1"] == "Pa"
    assert units["oil_temperature"] == "degC"
    assert entities["#sensor-piston_1"]["serialNumber"] == "A-117"
    assert entities["#calibration-piston_1"]["endTime"] == "2026-02-01"
    assert entities["#numpy"]["version"]


def test_the_crate_s_records_are_those_of_the_run(run: Path) -> None:
    folder = export(run, "--out", str(run.parent / "crate"))
    first, again = load_run(run).records[0], load_run(folder).records[0]
    for name, values in first.channels.items():
        assert (values == again.channels[name]).all()


def test_what_a_run_keeps_beside_its_samples_is_archived_too(run: Path) -> None:
    kept = {"proof.json": '{"key": "k"}', "tracked.json": "{}", "trip.csv": "time [s],tick"}
    for name, text in kept.items():
        (run / name).write_text(text)
    (run / "trace.html").write_text("a report that is made anew")
    crate = export(run)
    checked(crate)
    assert {name: (crate / name).read_text() for name in kept} == kept
    assert not (crate / "trace.html").exists()


def test_a_crate_beside_its_run_is_not_counted_as_another_run(run: Path) -> None:
    before = bramah_here("runs", run.parent, "--json", "-")
    names = [Path(entry["path"]).name for entry in json.loads(before.stdout)]
    export(run, "--out", str(run.parent / "for-the-archive"))
    after = bramah_here("runs", run.parent, "--json", "-")
    assert [Path(entry["path"]).name for entry in json.loads(after.stdout)] == names
    assert "copies of runs as RO-Crates:" in after.stderr
    assert "for-the-archive" in after.stderr
    itself = bramah_here("runs", run.parent / "for-the-archive")
    assert "for-the-archive  done" in itself.stdout


def test_a_killed_and_recovered_run_says_so_in_its_crate(tmp_path: Path) -> None:
    finish(tmp_path / "run", "kill at block", 45)
    with pytest.raises(InputError, match="bramah recover"):
        export(tmp_path / "run")
    assert not (tmp_path / "run-ro-crate").exists()
    recover(tmp_path / "run")
    entities = checked(export(tmp_path / "run"))
    assert entities["#run"]["actionStatus"]["@id"].endswith("FailedActionStatus")
    assert "1 of them unfinished" in entities["#run"]["error"]
    assert entities["#no-licence"]["name"] == "No licence was given"


def test_an_occupied_folder_and_a_model_are_refused(run: Path) -> None:
    export(run)
    with pytest.raises(InputError, match="not empty"):
        export(run)
    with pytest.raises(InputError, match="--model cannot be used"):
        export(run, "--model", "m.json", "--out", "x")


@pytest.mark.parametrize("group", ["s_r1", "between/0001"])
def test_damaged_samples_are_not_archived_as_the_right_ones(run: Path, group: str) -> None:
    path = run / "records.h5"
    with h5py.File(path) as file:
        at = file[f"{group}/piston_2"].id.get_chunk_info(0).byte_offset + 8
    raw = bytearray(path.read_bytes())
    raw[at] ^= 1
    path.write_bytes(raw)
    with pytest.raises(InputError, match=f"{group}, channel piston_2: .*checksum") as refused:
        export(run)
    assert str(path) in str(refused.value)
    assert not run.with_name("monday-ro-crate").exists()


def test_a_full_disk_is_no_bad_usage_and_leaves_no_half_crate(run: Path) -> None:
    with largest_file(2_000), pytest.raises(RecordingFailed, match="crate cannot be written"):
        export(run)
    assert not run.with_name("monday-ro-crate").exists()
