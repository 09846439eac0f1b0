"""A trip that the host saw keeps the bench from running until a person clears it with a reason."""

from __future__ import annotations

import re
from collections.abc import Iterator
from importlib import resources
from pathlib import Path

import pytest

from drivers import make_driver
from rig.bench.session import Bench
from rig.model.trips import SafetyTrip
from rig.runs.recorder import Recorder
from rig.runs.rigs import load_rig
from rig.runs.store import load_run
from rig.tui.jobs import rig_of_run
from tests.cli.bench import LONG, SHORT, bramah, bramah_here, simulated, started, wait_for
from tests.drivers.plain_module import WIRE, module_process
from tests.drivers.test_modbus_map import rig_text
from tests.services.test_after_zero import commands

RIG = "shinshu-2dof"


@pytest.fixture
def short(tmp_path: Path) -> Path:
    path = tmp_path / "short.yaml"
    path.write_text(SHORT)
    return path


@pytest.fixture
def scenario(tmp_path: Path) -> Path:
    """A sensor reads 6 MPa too high: every run trips."""
    path = tmp_path / "scenario.yaml"
    path.write_text("effects: [{name: sensor_offset, channel: cap_pressure_2, offset: 6 MPa}]\n")
    return path


@pytest.fixture
def faulty(scenario: Path) -> Iterator[str]:
    """The endpoint of a bench whose runs trip."""
    with simulated("--scenario", scenario) as (endpoint, _):
        yield endpoint


def test_after_a_trip_nothing_moves_until_a_reset_with_a_reason(
    short: Path, faulty: str, tmp_path: Path, state: Path
) -> None:
    def line(name: str) -> tuple[object, ...]:
        return ("run", short, "--rig", RIG, "--out", tmp_path / name, "--endpoint", faulty)

    first = bramah(*line("first"))
    assert first.returncode == 3, first.stderr
    assert f"bramah reset --rig {RIG} --endpoint {faulty} --reason" in first.stderr
    put_out = commands(tmp_path / "first")
    assert len(put_out) > 2000
    assert not put_out[-2000:].any()

    around = (tmp_path / "first" / "trip.csv").read_text().splitlines()
    assert f"are in {tmp_path / 'first' / 'trip.csv'}" in first.stderr
    names = around[0].split(",")
    offending = next(k for k, row in enumerate(around[1:]) if float(row.split(",")[0]) == 0.0)
    moved = [
        k
        for k, row in enumerate(around[1:])
        if any(float(v) for n, v in zip(names, row.split(","), strict=True) if "command" in n)
    ]
    # Over the wire, on the device's clock: from the offending sample to zero at most two blocks.
    assert max(moved, default=0) - offending < 2 * 10

    refused = bramah_here(*line("second"))
    assert refused.returncode == 3, refused.stderr
    for word in ("cap_pressure_2", str(tmp_path / "first"), f"--endpoint {faulty} --reason"):
        assert word in refused.stderr
    assert not (tmp_path / "second").exists()

    # A host that knows nothing of the trip, such as another computer: the device itself refuses.
    (note,) = state.rglob("trip.json")
    kept = note.read_text()
    note.unlink()
    elsewhere = bramah_here(*line("third"))
    assert elsewhere.returncode == 3, elsewhere.stderr
    assert "the device tripped earlier" in elsewhere.stderr
    note.write_text(kept)

    asked = bramah_here("probe", "--rig", RIG, "--endpoint", faulty)
    said = next(line for line in asked.stdout.splitlines() if line.startswith("tripped: "))
    for word in ("cap_pressure_2", "the host's connection ended", f"--endpoint {faulty} --reason"):
        assert word in said

    reset = ("reset", "--rig", RIG, "--endpoint", faulty)
    unsaid = bramah_here(*reset)
    assert unsaid.returncode == 2
    assert "--reason TEXT is missing" in unsaid.stderr
    assert bramah_here(*line("fourth")).returncode == 3

    cleared = bramah_here("reset", "--reason", "sensor looked at")  # the one bench that tripped
    assert cleared.returncode == 0, cleared.stderr
    assert "cap_pressure_2" in cleared.stdout
    again = bramah(*line("fifth"))  # it drives the machine, and trips anew
    assert again.returncode == 3, again.stderr
    assert "still" not in again.stderr
    assert (tmp_path / "fifth" / "state").read_text() == "tripped\n"


@pytest.mark.parametrize("words", [("stop",), ("depressurise",), ("reset", "--reason", "x")])
def test_where_no_bench_is_known_the_rig_is_asked_for(words: tuple[str, ...]) -> None:
    asked = bramah_here(*words)
    assert asked.returncode == 2
    assert asked.stderr.strip().endswith("name the bench: --rig RIG")


def test_the_command_that_a_trip_names_works_for_a_rig_file_of_any_name(
    short: Path, scenario: Path, tmp_path: Path, state: Path
) -> None:
    """Also where what is stored of another bench is damaged."""
    (state / "another").mkdir(parents=True)
    (state / "another" / "trip.json").write_text("[]")
    (state / "another" / "rig.yaml").write_text("[")
    shipped = (resources.files("rig") / "shipped" / f"{RIG}.yaml").read_text("utf-8")
    mine = tmp_path / "arm in lab 2.yaml"
    mine.write_text(shipped.replace(f"name: {RIG}", "name: left-arm", 1), encoding="utf-8")
    with simulated("--scenario", scenario, rig=mine) as (endpoint, _):
        at = ("--rig", mine, "--endpoint", endpoint)
        tripped = bramah("run", short, *at, "--out", tmp_path / "run")
        assert tripped.returncode == 3, tripped.stderr
        (command,) = set(re.findall(r"`bramah (reset [^`]*) --reason TEXT`", tripped.stderr))
        assert command == f"reset --rig left-arm --endpoint {endpoint}"
        # Also where only the device knows the trip: the host stood still, and lost its connection.
        (state / re.sub(r"[^a-z0-9.-]", "_", endpoint.replace("://", "_")) / "trip.json").unlink()
        cleared = bramah_here(*command.split(), "--reason", "sensor looked at")
        assert cleared.returncode == 0, cleared.stderr
        unknown = bramah_here("reset", "--rig", "right-arm", "--reason", "again")
        assert unknown.returncode == 2
        assert "right-arm" in unknown.stderr


@pytest.mark.parametrize("by", ["message", "rig file", "screen"])
def test_a_trip_over_a_register_map_is_reset_though_an_endpoint_has_no_map(
    tmp_path: Path, by: str
) -> None:
    run, path = tmp_path / "monday", tmp_path / "plain.yaml"
    with module_process() as (_, port):
        text = rig_text(WIRE.format(port=port)).replace(f"name: {RIG}", "name: lab-module")
        path.write_text(text.replace("pressure: [-0.2 MPa, 9 MPa]", "pressure: [-0.2 MPa, 1 MPa]"))
        rig = load_rig(path)
        driver = make_driver(rig.wire, rig)
        with pytest.raises(SafetyTrip) as tripped, Bench(rig, driver, Recorder(run, rig)) as bench:
            bench.exchange()
        notes = " ".join(tripped.value.__notes__)
        named = re.findall(r"`bramah (reset [^`]*) --reason TEXT`", notes)
        assert named == [f"reset --rig lab-module --endpoint {rig.wire.endpoint}"]
        at = ("--endpoint", rig.wire.endpoint)
        command = {
            "message": named[0].split(),
            "rig file": ("reset", "--rig", path, *at),
            "screen": ("reset", "--rig", rig_of_run(str(run), rig.name), *at),
        }[by]
        cleared = bramah_here(*command, "--reason", "sensor looked at")
    assert cleared.returncode == 0, cleared.stderr
    assert "cap_pressure_1" in cleared.stdout


def test_a_second_run_on_a_bench_in_use_names_the_run_that_has_it(tmp_path: Path) -> None:
    endless = tmp_path / "endless.yaml"
    endless.write_text(SHORT.replace("repeats: 2", "repeats: 400"))
    run = tmp_path / "monday"
    with simulated() as (endpoint, _):
        line = ("run", endless, "--rig", RIG, "--endpoint", endpoint, "--out")
        with started(*line, run) as process:
            wait_for("record 1 of", process)
            at = ("--rig", RIG, "--endpoint", endpoint)
            for second in (
                bramah_here(*line, tmp_path / "second"),
                bramah_here("probe", *at),
                bramah_here("reset", *at, "--reason", "none"),
            ):
                assert second.returncode == 4, second.stderr
                assert (
                    f"device in use: the bench at {endpoint} is in use by process {process.pid} of "
                    f"this computer, which writes {run}"
                ) in second.stderr
            assert process.poll() is None
            process.terminate()
            process.communicate(timeout=LONG)
            assert process.returncode == 130
    assert load_run(run, partial=True).records
