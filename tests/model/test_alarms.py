"""Alarms as an operator meets them, and the section of a rig file that sets them."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from rig.model.alarms.states import (
    Alarm,
    AlarmState,
    AlarmTable,
    acknowledged,
    folded,
    raised,
    returned,
)
from rig.model.parse import InputError
from rig.runs.rigs import load_rig


def alarm(check: str, joint: int | None = 1, time: float = 1.0, *, trips: bool = False) -> Alarm:
    channel = f"piston_{joint}" if joint else "supply_pressure"
    return Alarm(
        check, channel, joint, 1.0, (0.0, 0.5), "m", round(1000 * time), time, "", "", trips
    )


def states_of(table: AlarmTable) -> list[AlarmState]:
    return [one.state for one in table.alarms]


def test_a_warning_leaves_only_when_it_was_seen_and_the_value_is_back() -> None:
    table = raised(AlarmTable(), alarm("piston"))
    (key,) = [one.key for one in table.alarms]
    assert states_of(table) == [AlarmState.ACTIVE]
    back_first = returned(table, key)
    assert states_of(back_first) == [AlarmState.RETURNED]
    assert states_of(acknowledged(back_first)) == []
    seen_first = acknowledged(table, key)
    assert states_of(seen_first) == [AlarmState.ACKNOWLEDGED]
    assert states_of(returned(seen_first, key)) == []


def test_a_warning_that_comes_again_must_be_seen_again() -> None:
    table = raised(AlarmTable(), alarm("piston"))
    table = raised(returned(table, "piston: piston_1"), alarm("piston", time=3.0))
    (one,) = table.alarms
    assert (one.state, one.acknowledged, one.count) == (AlarmState.ACTIVE, False, 2)
    assert one.time == 1.0  # since when it has been standing


def test_a_trip_stays_whatever_the_value_and_though_it_was_acknowledged() -> None:
    table = raised(AlarmTable(), alarm("piston", trips=True))
    key = "piston: piston_1"
    assert states_of(returned(table, key)) == [AlarmState.LATCHED]
    table = acknowledged(table, key)
    assert states_of(table) == states_of(returned(table, key)) == [AlarmState.LATCHED]


def test_the_first_cause_stands_above_what_follows_from_it() -> None:
    table = AlarmTable()
    for one in (
        alarm("oil temperature", None, 0.0),
        alarm("supply pressure", None, 10.0),
        alarm("nothing moves", 2, 11.0),
        alarm("lock", 1, 12.0, trips=True),
        alarm("noisy sensor", 2, 40.0),
    ):
        table = raised(table, one)
    groups = [(first.check, [one.check for one in rest]) for first, rest in folded(table)]
    assert groups == [
        ("supply pressure", ["nothing moves", "lock"]),  # the one with a trip comes first
        ("oil temperature", []),
        ("noisy sensor", []),
    ]
    gone = returned(acknowledged(table, "supply pressure: supply_pressure"),
                    "supply pressure: supply_pressure")  # fmt: skip
    alone = [first.check for first, _ in folded(gone)]
    assert alone == ["lock", "oil temperature", "nothing moves", "noisy sensor"]


def test_alarms_of_two_joints_do_not_explain_each_other() -> None:
    table = raised(raised(AlarmTable(), alarm("lock", 1, 1.0)), alarm("pressure", 2, 1.5))
    assert [len(rest) for _, rest in folded(table)] == [0, 0]


def test_a_trip_takes_the_place_of_its_own_warning() -> None:
    table = acknowledged(raised(AlarmTable(), alarm("piston")))
    (one,) = raised(table, alarm("piston", time=1.2, trips=True)).alarms
    assert (one.state, one.acknowledged, one.time) == (AlarmState.LATCHED, False, 1.2)


ACTS = st.lists(
    st.tuples(
        st.sampled_from(["raise", "trip", "return", "acknowledge"]),
        st.sampled_from(["piston", "lock", "pressure"]),
        st.integers(1, 2),
    ),
    max_size=30,
)


# A first cause that leaves and comes back after its consequence has consequences of its own.
@example(
    [
        ("raise", "pressure", 2), ("return", "pressure", 2), ("raise", "piston", 2),
        ("acknowledge", "pressure", 2), ("raise", "lock", 2), ("raise", "pressure", 2),
    ]
)  # fmt: skip
@given(ACTS)
def test_no_order_of_events_loses_a_latched_trip_or_shows_an_alarm_twice(
    acts: list[tuple[str, str, int]],
) -> None:
    table, latched = AlarmTable(), set()
    for k, (act, check, joint) in enumerate(acts):
        key = f"{check}: piston_{joint}"
        if act in ("raise", "trip"):
            table = raised(table, alarm(check, joint, float(k), trips=act == "trip"))
            latched |= {key} if act == "trip" else set()
        elif act == "return":
            table = returned(table, key)
        elif act == "acknowledge" and table.get(key):
            table = acknowledged(table, key)
        keys = [one.key for one in table.alarms]
        assert len(keys) == len(set(keys))
        assert {one.key for one in table.alarms if one.trips} == latched
        shown = [one.key for first, rest in folded(table) for one in (first, *rest)]
        assert sorted(shown) == sorted(keys)
        assert AlarmState.NORMAL not in states_of(table)


SHINSHU = (Path(__file__).parents[2] / "rig/shipped/shinshu-2dof.yaml").read_text()


def rig_with(tmp_path: Path, alarms: str) -> object:
    path = tmp_path / "mine.yaml"
    path.write_text(f"{SHINSHU}\nalarms: {alarms}\n")
    return load_rig(str(path))


def test_a_rig_file_sets_bands_in_its_own_units(tmp_path: Path) -> None:
    rig = rig_with(
        tmp_path,
        "{channels: {cap_pressure_1: {warning: [null, 80 bar], trip: [-1 bar, 85 bar], "
        "dead_band: 200 kPa, warning_delay: 20 ms}, oil_temperature: {warning: [20 degC, 50 degC], "
        "dead_band: 1 delta_degC}}, checks: {drift_at_rest: ignore}}",
    )
    band = rig.alarms.channels["cap_pressure_1"]
    assert band.warning == (None, pytest.approx(8e6))
    assert band.trip == (pytest.approx(-1e5), pytest.approx(8.5e6))
    assert (band.dead_band, band.warning_delay) == (pytest.approx(2e5), pytest.approx(0.02))
    assert rig.alarms.channels["oil_temperature"].dead_band == pytest.approx(1.0)
    assert rig.alarms.checks.drift_at_rest == "ignore"
    assert math.isinf(rig.limits_of("spool_1")[1])


def test_the_example_of_the_page_is_a_rig_file(tmp_path: Path) -> None:
    page = (Path(__file__).parents[2] / "docs/rig-files.md").read_text()
    (example,) = [part for part in page.split("```yaml\n")[1:] if part.startswith("alarms:")]
    path = tmp_path / "page.yaml"
    path.write_text(f"{SHINSHU}\n{example.split('```')[0]}")
    assert load_rig(str(path)).alarms.channels["oil_temperature"].trip_delay == 1.0


@pytest.mark.parametrize(
    ("alarms", "words"),
    [
        ("{channels: {cap_pressure_3: {}}}", "cap_pressure_3: this rig has no such channel"),
        ("{channels: {pressure: {}}}", "unknown channel 'pressure'"),
        ("{channels: {piston_1: {warning: [-50 mm, 30 mm]}}}",
         "alarms channels piston_1 warning: -0.05 is outside the range of its sensor, -0.04"),
        ("{channels: {cap_pressure_1: {trip: [0 Pa, 9.5 MPa]}}}",
         "alarms channels cap_pressure_1 trip: 9.5e+06 is outside its limits, -200000 to 9e+06"),
        ("{channels: {cap_pressure_1: {warning: [0 Pa, 8 MPa], trip: [0 Pa, 7 MPa]}}}",
         "alarms channels cap_pressure_1 warning: 8e+06 is outside what trips, 0 to 7e+06"),
        ("{channels: {spool_1: {warning: [1 V, 0 V]}}}", "lower 1 is not below upper 0"),
        ("{channels: {spool_1: {warning: [-1 V, 1 V], dead_band: 1 V}}}", "leaves nothing of"),
        ("{channels: {spool_1: {warning: [-1, 1]}}}", "has no unit"),
        ("{channels: {spool_1: {warn: [-1 V, 1 V]}}}", "warn: unknown key"),
        ("{channels: {spool_1: {trip_delay: 2 s}}}", "trip_delay"),
        ("{checks: {drift: warn}}", "checks.drift: unknown key"),
        ("{checks: {drift_at_rest: maybe}}", "drift_at_rest"),
        ("{warning_share: 1.2}", "warning_share"),
    ],
)  # fmt: skip
def test_a_band_that_could_not_do_what_it_says_is_refused_by_its_key(
    tmp_path: Path, alarms: str, words: str
) -> None:
    with pytest.raises(InputError) as refused:
        rig_with(tmp_path, alarms)
    assert words in str(refused.value)
    assert "mine.yaml:" in str(refused.value)
    assert "\n" not in str(refused.value)
