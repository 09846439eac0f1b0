"""Sessions with a fault: what ends them, what is kept, and the page that lists them all."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers.base import DeviceError, DeviceLost
from hil_sim.faults.base import Fault
from hil_sim.link.served import SERVED
from rig.cli.bench.faults.bench import FaultBench, fault_bench
from rig.cli.bench.faults.figures import RIG, counted, jobs
from rig.cli.bench.faults.trials import (
    Diagnosis,
    TrialOutcome,
    diagnosis,
    example,
    kinds,
    try_fault,
)
from rig.model.alarms.states import Alarm
from rig.model.rig import Rig
from rig.model.trips import SafetyTrip, Violation
from rig.runs.rigs import load_rig
from tests.studies.faults.page import table_rows

PAGE = (Path(__file__).parents[2] / "docs" / "faults.md").read_text("utf-8")


def patient_rig() -> Rig:
    rig = load_rig(RIG)
    return rig.model_copy(update={"wire": rig.wire.model_copy(update={"timeout": 0.6})})


@pytest.fixture(scope="module")
def bench() -> Iterator[FaultBench]:
    with fault_bench() as found:
        yield found


@pytest.mark.parametrize(
    ("wire", "fault", "diagnosis", "message"),
    [
        ("modbus-tcp", "sensor_stuck", Diagnosis.NAMED, "cap_pressure_1 of joint 1"),
        ("modbus-tcp", "link_closed", Diagnosis.NAMED, "closed the connection"),
        ("modbus-rtu", "queue_overrun", Diagnosis.COUNTED, ""),
        ("serial", "reboots", Diagnosis.NAMED, "has restarted"),
        ("serial", "frame_duplicated", Diagnosis.HARMLESS, ""),
        ("can", "frame_lost", Diagnosis.HARMLESS, ""),
        ("can-slcan", "link_closed", Diagnosis.NAMED, "has gone"),
    ],
)
def test_a_session_meets_a_fault_ends_safe_and_keeps_every_block(
    bench: FaultBench, tmp_path: Path, wire: str, fault: str, diagnosis: Diagnosis, message: str
) -> None:
    found = try_fault(bench, patient_rig(), wire, fault, tmp_path, 3, realtime=False)
    assert (found.diagnosis, found.zeroed, found.lost_blocks) == (diagnosis, True, 0)
    assert found.blocks > 60
    assert found.struck >= 1
    assert message in found.message
    assert (found.missing == 30) == (fault == "queue_overrun")


def test_the_device_itself_says_that_its_outputs_were_on_before(bench: FaultBench) -> None:
    from drivers import make_driver, wire_at
    from drivers.base import OutputLaw

    rig = patient_rig()
    endpoint = bench.begin(rig, "modbus-tcp", (), 1, realtime=False)
    driver = make_driver(wire_at(endpoint, rig.wire), rig)
    driver.connect()
    assert not bench.state().driven
    driver.apply([OutputLaw(bias=0.5, limit=1.0), OutputLaw()])
    assert bench.state().driven
    assert not bench.at_zero(0.05)
    driver.close()
    assert bench.at_zero(1.0)


def test_every_fault_of_the_scenario_file_has_an_example_and_a_row_in_the_page() -> None:
    for name in kinds():
        assert isinstance(example(name), Fault)
    section = PAGE.partition("<!-- noticed -->")[2].partition("<!-- end of noticed -->")[0]
    rows = [line.split(" | ") for line in section.strip().splitlines()[2:]]
    listed = [(row[0].strip("| `"), row[1]) for row in rows]
    wanted = [(fault, wire) for fault, wire in table_rows()]
    assert [fault for fault, _ in listed] == [fault for fault, _ in wanted]
    for (fault, on), (_, wire) in zip(listed, wanted, strict=True):
        assert on in ("any", wire), fault


def test_every_fault_but_a_drifting_clock_is_tried_on_every_wire_and_counted_in_the_page() -> None:
    section = PAGE.partition("<!-- counts -->")[2].partition("<!-- end of counts -->")[0]
    total = 0
    for wire in SERVED:
        chosen = list(jobs(wire, 500))
        total += len(chosen)
        assert {name for _, name in chosen} == set(kinds()) - {"clock_drift"}
        for name in {name for _, name in chosen}:
            assert f"| {name} | {wire} |" in section
    assert total >= 500


def trip(limit: str, joint: int | None, channel: str) -> SafetyTrip:
    return SafetyTrip(Violation(limit, 1.0, (0.0, 0.5), "m", joint, channel, 5), load_rig(RIG))


@pytest.mark.parametrize(
    ("fault", "error", "expected"),
    [
        ("sensor_stuck", trip("frozen sensor", 1, "cap_pressure_1"), Diagnosis.NAMED),
        ("sensor_stuck", trip("frozen sensor", 2, "cap_pressure_2"), Diagnosis.WRONG),
        ("sensor_stuck", DeviceLost("gone"), Diagnosis.WRONG),
        ("sensor_drift", None, Diagnosis.UNNOTICED),
        ("sensor_drift", trip("stale data", None, ""), Diagnosis.UNKNOWN),
        ("pump_off", trip("sample gap", None, ""), Diagnosis.UNKNOWN),
        ("valve_stuck", trip("piston", 1, "piston_1"), Diagnosis.NAMED),
        ("pump_off", trip("supply pressure", None, "supply_pressure"), Diagnosis.NAMED),
        ("hose_burst", trip("supply pressure", None, "supply_pressure"), Diagnosis.UNKNOWN),
        ("frame_lost", None, Diagnosis.HARMLESS),
        ("frame_lost", DeviceLost("the device has not answered"), Diagnosis.NAMED),
        ("frame_lost", trip("stale data", None, ""), Diagnosis.UNKNOWN),
        ("bits_flipped", trip("pressure rate", 1, "cap_pressure_1"), Diagnosis.WRONG),
        ("reboots", DeviceLost("the device has restarted"), Diagnosis.NAMED),
        ("reboots", DeviceLost("closed the connection"), Diagnosis.UNKNOWN),
        ("clock_jump", DeviceError("impossible block: ..."), Diagnosis.NAMED),
    ],
)
def test_a_message_is_judged_by_what_was_done(
    fault: str, error: Exception | None, expected: Diagnosis
) -> None:
    assert diagnosis(example(fault), TrialOutcome(fault, "serial", error=error)) == expected


@pytest.mark.parametrize(
    ("channel", "joint", "expected"),
    [("cap_pressure_1", 1, Diagnosis.NAMED), ("cap_pressure_2", 2, Diagnosis.WRONG)],
)
def test_a_warning_counts_as_noticing_and_is_judged_like_a_trip(
    channel: str, joint: int, expected: Diagnosis
) -> None:
    alarm = Alarm(
        check="noisy sensor", channel=channel, joint=joint, value=2.0, limit=(None, 1.0),
        unit="Pa", tick=5, time=1.5, sentence="A sensor is noisy.", remedy="", trips=False,
    )  # fmt: skip
    outcome = TrialOutcome("sensor_noise", "serial", alarm=alarm)
    assert diagnosis(example("sensor_noise"), outcome) == expected
    assert outcome.message == "warning: A sensor is noisy."


def test_a_missed_number_shows_in_the_figures() -> None:
    good = TrialOutcome(
        "sensor_stuck", "serial", struck=1, seconds=0.3, blocks=9, diagnosis=Diagnosis.NAMED
    )
    bad = TrialOutcome("frame_lost", "serial", struck=4, blocks=9, lost_blocks=1, zeroed=False)
    late = TrialOutcome("valve_stuck", "serial", struck=1, seconds=2.5, diagnosis=Diagnosis.NAMED)
    figures = {figure.name: figure for figure in counted([good, bad, late])}
    assert not figures["outputs left on"].ok
    assert not figures["of them not in records.h5"].ok
    assert figures["frozen or stuck, not within 2 s"].value == 1
    assert figures["faults injected"].value == 6
    assert figures["of them of machine, sensor or device"].value == 2
    assert not figures["faults injected"].ok
