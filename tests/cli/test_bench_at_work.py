"""An operator, a night-shift script and their accidents, on a simulated bench over a real wire."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from typer.testing import CliRunner

from rig.bench.latch import STATE_VARIABLE
from rig.cli.main import app
from rig.runs.rigs import rig_text
from rig.runs.store import load_run
from tests.cli.bench import (
    ENDLESS,
    LONG,
    SHORT,
    bramah,
    bramah_here,
    outputs_are_zero,
    simulated,
    started,
    wait_for,
)
from tests.variants import every_second

RIG = "shinshu-2dof"


@pytest.fixture
def short(tmp_path: Path) -> Path:
    path = tmp_path / "short.yaml"
    path.write_text(SHORT)
    return path


@pytest.fixture
def endless(tmp_path: Path) -> Path:
    path = tmp_path / "endless.yaml"
    path.write_text(ENDLESS)
    return path


@contextmanager
def third_record(endless: Path, run: Path, endpoint: str) -> Iterator[subprocess.Popen[str]]:
    """A run without an end, in its third record."""
    line = ("run", endless, "--rig", RIG, "--out", run, "--endpoint", endpoint)
    with started(*line) as process:
        wait_for("record 3 of", process)
        yield process


def ended_by(act: Callable[[subprocess.Popen[str], str], None], endless: Path, run: Path) -> str:
    """What a run says that `act` ends in its third record, outputs at zero and records kept."""
    with simulated() as (endpoint, _):
        with third_record(endless, run, endpoint) as process:
            act(process, endpoint)
            _, errors = process.communicate(timeout=LONG)
        assert process.returncode == 130, errors
        assert outputs_are_zero(endpoint)
    assert (run / "state").read_text().strip() == "aborted"
    assert len(load_run(run).records) >= 2
    return errors


def test_a_run_goes_on_when_the_reader_of_its_progress_has_ended(
    short: Path, tmp_path: Path
) -> None:
    run = tmp_path / "monday"
    with simulated() as (endpoint, _):
        line = ("run", short, "--rig", RIG, "--out", run, "--endpoint", endpoint)
        with started(*line) as process:
            wait_for("warm-up", process)
            assert process.stderr is not None
            process.stderr.close()
            assert process.wait(LONG) == 0
    assert (run / "state").read_text().strip() == "done"
    assert len(load_run(run).records) == 2


def test_a_protocol_is_checked_run_listed_and_identified(short: Path, tmp_path: Path) -> None:
    checked = bramah_here("check", short, "--rig", RIG)
    assert checked.returncode == 0, checked.stderr
    assert "step1 joint 2 piston" in checked.stdout

    run = tmp_path / "monday"
    with simulated("--seed", 5) as (endpoint, _):
        done = bramah("run", short, "--rig", RIG, "--out", run, "--endpoint", endpoint)
        assert done.returncode == 0, done.stderr
        assert done.stdout.strip() == str(run)
        assert done.stderr.rstrip().endswith("done      2 records")  # and no time left
        again = bramah_here("run", short, "--rig", RIG, "--out", run, "--endpoint", endpoint)
        assert again.returncode == 2
        assert again.stderr.startswith(f"bramah: {run}: is not empty")  # before the twin's minutes

    listed = bramah_here("runs", tmp_path)
    assert "monday" in listed.stdout
    assert "done" in listed.stdout
    records = load_run(run).records
    assert [record.name for record in records] == ["step1_r1", "step1_r2"]
    assert all(record.attributes["lost_samples"] == 0 for record in records)

    found = bramah_here("identify", run, "--json", "-", "--model", tmp_path / "model.json")
    assert found.returncode == 0, found.stderr
    result = json.loads(found.stdout)
    assert result["method"] == "coupled"
    assert result["parameters"]["C_pp_2"]["value"] == pytest.approx(6.28e-7, rel=0.05)
    # Joint 1 was never excited: its gains are not numbers that look fine.
    assert result["parameters"]["C_pp_1"]["value"] is None
    judged = bramah_here("validate", tmp_path / "model.json", run)
    assert judged.returncode == 2
    assert "C_pp_1" in judged.stderr
    assert judged.stderr.count("\n") == 1


def test_ctrl_c_twice_zeroes_the_outputs_and_keeps_the_records(
    endless: Path, tmp_path: Path
) -> None:
    def twice(process: subprocess.Popen[str], _: str) -> None:
        process.send_signal(signal.SIGINT)
        process.send_signal(signal.SIGINT)

    assert "Traceback" not in ended_by(twice, endless, tmp_path / "stopped")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_before_the_bench_is_driven_ends_in_a_line(
    endless: Path, tmp_path: Path, number: signal.Signals
) -> None:
    with simulated() as (endpoint, _):
        line = ("run", endless, "--rig", RIG, "--out", tmp_path / "run", "--endpoint", endpoint)
        with started(*line) as process:
            wait_for("checking endless", process)
            process.send_signal(number)
            _, errors = process.communicate(timeout=LONG)
    assert process.returncode == 130, errors
    assert errors.strip().splitlines()[-1].startswith("bramah: stopped")


def test_stop_from_another_terminal_ends_the_run_and_keeps_the_records(
    endless: Path, tmp_path: Path
) -> None:
    run = tmp_path / "stopped"

    def stop(_: subprocess.Popen[str], __: str) -> None:
        stopped = bramah("stop")  # the bench that this computer drives
        assert stopped.returncode == 0, stopped.stderr
        assert stopped.stdout.startswith("outputs at zero, confirmed by the device")
        assert str(run) in stopped.stderr

    ended_by(stop, endless, run)


def test_stop_reaches_the_bench_of_a_killed_run(endless: Path, tmp_path: Path) -> None:
    """Its device may have no watchdog: nobody has confirmed that its outputs are at zero."""
    with simulated() as (endpoint, _):
        with third_record(endless, tmp_path / "killed", endpoint) as process:
            process.kill()
            process.communicate(timeout=LONG)
        stopped = bramah("stop")
        assert stopped.returncode == 0, stopped.stderr
        assert f"confirmed by the device of shinshu-2dof at {endpoint}" in stopped.stdout
        again = bramah("stop")
        assert again.returncode == 2
        assert "or has left one with outputs not confirmed at zero" in again.stderr


def test_stop_zeroes_one_bench_while_another_does_not_answer(endless: Path, tmp_path: Path) -> None:
    with simulated() as one, simulated() as two:
        # In the order in which `stop` finds them: the first device hangs.
        (hung, device), (sound, _) = sorted((one, two), key=lambda bench: bench[0])
        with (
            third_record(endless, tmp_path / "hung", hung) as beside,
            third_record(endless, tmp_path / "sound", sound) as process,
        ):
            try:
                device.send_signal(signal.SIGSTOP)
                with started("stop") as stopping:
                    said = wait_for("use the emergency stop", stopping)
                    assert f"outputs not confirmed at zero, shinshu-2dof at {hung}" in said[-1]
                    told = [line for line in said if "stopping process" in line]
                    assert any(str(tmp_path / "hung") in line for line in told)
                    confirmed = stopping.stdout.readline()
                    assert confirmed.startswith("outputs at zero, confirmed by the device of ")
                    assert sound in confirmed
                    assert process.wait(LONG) == 130
                    assert outputs_are_zero(sound)
                    assert stopping.poll() is None  # it still asks the other device
                    device.send_signal(signal.SIGCONT)
                    stopping.communicate(timeout=LONG)
            finally:
                device.send_signal(signal.SIGCONT)
            beside.communicate(timeout=LONG)
            assert outputs_are_zero(hung)


def test_stop_by_another_name_of_the_port_ends_the_run(endless: Path, tmp_path: Path) -> None:
    run, link = tmp_path / "stopped", tmp_path / "ttyBENCH"
    with simulated("--wire", "modbus-rtu") as (endpoint, _):
        link.symlink_to(endpoint.removeprefix("modbus-rtu://"))
        with third_record(endless, run, endpoint) as process:
            stopped = bramah_here("stop", "--rig", RIG, "--endpoint", f"modbus-rtu://{link}")
            assert stopped.returncode == 0, stopped.stderr
            assert stopped.stdout.startswith("outputs at zero, confirmed by the device")
            assert str(run) in stopped.stderr
            process.communicate(timeout=LONG)
        assert process.returncode == 130
    assert load_run(run).records


def test_stop_from_another_computer_ends_the_run(
    endless: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another computer knows nothing of the process that drives the bench."""

    def stop(_: subprocess.Popen[str], endpoint: str) -> None:
        monkeypatch.setenv(STATE_VARIABLE, str(tmp_path / "elsewhere"))
        stopped = bramah_here("stop", "--rig", RIG, "--endpoint", endpoint)
        assert stopped.returncode == 0, stopped.stderr

    errors = ended_by(stop, endless, tmp_path / "stopped")
    assert "another program has put the outputs to zero" in errors.splitlines()[-1]


def test_a_killed_run_leaves_valves_closed_and_is_recovered(endless: Path, tmp_path: Path) -> None:
    run = tmp_path / "killed"
    with simulated() as (endpoint, _):
        with third_record(endless, run, endpoint) as process:
            process.kill()
            process.wait(LONG)
        assert outputs_are_zero(endpoint)
        refused = bramah_here(
            "run", endless, "--rig", RIG, "--out", tmp_path / "next", "--endpoint", endpoint
        )
        assert refused.returncode == 3, refused.stderr
        assert "bramah reset" in refused.stderr
        cleared = bramah_here(
            "reset", "--rig", RIG, "--endpoint", endpoint, "--reason", "the run was killed"
        )
        assert cleared.returncode == 0, cleared.stderr
        assert not (tmp_path / "next").exists()
    assert "interrupted" in bramah_here("runs", tmp_path).stdout
    unread = bramah_here("identify", run)
    assert unread.returncode == 2
    assert "bramah recover" in unread.stderr
    recovered = bramah_here("recover", run)
    assert recovered.returncode == 0, recovered.stderr
    assert len(load_run(run).records) >= 2


def test_a_bench_that_dies_mid_run_is_reported_and_its_data_kept(
    endless: Path, tmp_path: Path
) -> None:
    run = tmp_path / "lost"
    with simulated() as (endpoint, bench):
        with third_record(endless, run, endpoint) as process:
            os.kill(bench.pid, signal.SIGKILL)
            _, errors = process.communicate(timeout=LONG)
        assert process.returncode == 4, errors
        assert "does not answer" in errors or "not answered" in errors or "closed" in errors
        alarm, lost, last = errors.strip().splitlines()[-3:]
        assert "outputs not confirmed at zero" in alarm
        assert "not confirmed" not in lost
        assert last.startswith("bramah: outputs not confirmed at zero; device: ")
        assert "Traceback" not in errors
    assert len(load_run(run).records) >= 2


def test_a_passed_limit_trips_with_limit_value_and_joint(short: Path, tmp_path: Path) -> None:
    # A pressure that reads 6 MPa too high: the twin cannot foresee it, the guard must see it.
    scenario = tmp_path / "scenario.yaml"
    scenario.write_text(
        "effects: [{name: sensor_offset, channel: cap_pressure_2, offset: 6 MPa}]\n"
    )
    run = tmp_path / "tripped"
    with simulated("--scenario", scenario) as (endpoint, _):
        done = bramah("run", short, "--rig", RIG, "--out", run, "--endpoint", endpoint)
        assert done.returncode == 3, done.stderr
        last = done.stderr.strip().splitlines()[-1]
        for word in ("joint 2", "cap_pressure_2", "MPa", "9"):
            assert word in last
        assert outputs_are_zero(endpoint)
    assert (run / "state").read_text().strip() == "tripped"
    events = (run / "events.jsonl").read_text().splitlines()
    assert any(json.loads(line)["event"] == "trip" for line in events)


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    every_second(
        [
            (("run", "nothing.yaml", "--rig", RIG, "--out", "x"), 2, "nothing.yaml"),
            (("run", "lock-and-excite", "--rig", "none", "--out", "x"), 2, "shinshu-2dof"),
            (("check", "validate", "--rig", "none.yaml"), 2, "none.yaml"),
            (("identify", "nowhere"), 2, "nowhere"),
            (("identify", "nowhere", "--method", "coupled", "--bogus"), 2, "--bogus"),
            (("validate", "m.json", "nowhere"), 2, "m.json"),
            (("import", "manifest.yaml", "--out", "x"), 2, "manifest.yaml"),
            (("recover", "nowhere"), 2, "nowhere"),
            (("sim", "--rig", RIG, "--wire", "smoke-signals"), 2, "modbus-tcp"),
            (("nonsense",), 2, "No such command 'nonsense'; see --help"),
            (("export", "nowhere", "--format", "xls"), 2, "csv mat parquet mf4 fmu ro-crate"),
        ]
    ),
)
def test_bad_input_is_one_line_that_names_it(
    arguments: tuple[str, ...], code: int, words: str, tmp_path: Path
) -> None:
    done = bramah_here(*arguments, cwd=tmp_path)
    assert done.returncode == code, done.stderr
    assert words in done.stderr
    assert done.stderr.count("\n") == 1, done.stderr
    assert not list(tmp_path.iterdir())


def test_a_wire_that_no_driver_serves_is_named_with_file_and_line(tmp_path: Path) -> None:
    """Before anything is proved or reached, whatever is asked of the bench."""
    text, _ = rig_text(RIG)
    for right, wrong in (
        ("kind: modbus-tcp", "kind: modbus-tpc"),
        ("port: 5020", "port: 502000"),
        ("port: 5020", "port: 0"),
    ):
        path = tmp_path / "bench.yaml"
        path.write_text(text.replace(right, wrong))
        for verb in (("probe",), ("check", "validate"), ("run", "validate", "--out", "runs")):
            done = bramah_here(*verb, "--rig", path, cwd=tmp_path)
            assert done.returncode == 2
            assert f"bench.yaml:52: wire: {wrong.split(':')[0]}: " in done.stderr
            assert wrong.split()[1] in done.stderr
            assert done.stderr.count("\n") == 1, done.stderr


def test_nobody_at_the_other_end_is_exit_code_4(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # bound, not listening: refuses
        endpoint = f"modbus-tcp://127.0.0.1:{taken.getsockname()[1]}"
        done = bramah(
            "run", "validate", "--rig", RIG, "--out", tmp_path / "x", "--endpoint", endpoint
        )
    assert done.returncode == 4
    assert not (tmp_path / "x").exists()


def test_a_busy_port_is_said_with_its_number() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        done = bramah("sim", "--rig", RIG, "--port", port)
    assert done.returncode == 1
    assert str(port) in done.stderr
    assert done.stdout == ""


def test_every_verb_explains_itself_with_an_example() -> None:
    top = bramah("--help")
    verbs = [line.split()[0] for line in top.stdout.split("Commands:")[1].splitlines() if line]
    assert {"demo", "sim", "check", "run", "monitor", "runs", "recover", "import"} <= set(verbs)
    for verb in verbs:
        shown = CliRunner().invoke(app, [verb, "--help"])
        assert shown.exit_code == 0
        assert f"Example: bramah {verb}" in " ".join(shown.stdout.split())
