"""Stories of an operator in front of `bramah monitor`."""

from __future__ import annotations

import re
import shlex
import threading
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import pytest

from rig.bench.screens.sockets import Snapshot
from rig.tui.app import HELP, Monitor, automatic_span, farewell
from rig.tui.browse import BrowserState
from tests.cli.bench import bramah_here
from tests.tui.glass import Glass, Machine, Recorded, endpoint, glass
from tests.tui.recorded import Bench, followed, past, run, snapshot, stopped, tripped

HERE = endpoint()


def running(seconds: float = 4.0, bench: Bench | None = None) -> Recorded:
    return Recorded(map(followed, run(bench or Bench(), seconds)))


def colour(shown: Glass, line: int) -> tuple[str, str]:
    """Return the words of a line on a ground of their own, and its colour: red, yellow, cyan."""
    strip = shown.app.screen._compositor.render_strips()[line]
    words, name = "", ""
    for segment in strip:
        style = segment.style
        if style is None or style.bgcolor is None or not segment.text.strip():
            continue
        c = style.bgcolor.get_truecolor()
        if max(c.red, c.green, c.blue) - min(c.red, c.green, c.blue) > 60:
            words += segment.text
            high = [part > 100 for part in (c.red, c.green, c.blue)]
            names = {(True, False, False): "red", (True, True, False): "yellow"}
            name = names.get(tuple(high), "other")
    return words, name


async def test_operator_sees_state_time_left_nearest_limit_and_pressures() -> None:
    async with glass(Machine({HERE: running()})) as shown:
        text = shown.text
        last = snapshot(Bench(), 80)
        assert "● EXCITING" in shown.lines[0]
        assert "████" not in text
        assert "to nearest limit" in text
        assert re.search(r"limit .*piston_1 −37.4 mm, 1.6 mm from its limit −39", text)
        for joint in (1, 2):
            pressure = last.channels[f"cap_pressure_{joint}"].last / 1e6
            assert f"cap      {pressure:.2f} MPa" in text
        assert "step1  excite  repeat 1 of 4" in text
        assert "10%  left 0:36  0 lost" in text
        assert "age 0.01 s  t 0:04" in shown.lines[0]
        assert "supply   6.9" in text
        assert "oil       40.1 °C" in text
        piston = last.channels["piston_2"].last * 1e3
        line = next(line for line in shown.lines if "piston " in line)
        assert f"{piston:+.1f} mm −36".replace("-", "−") in line
        assert "├" in line
        assert "●" in line
        assert "joint 1 ▣ locked" in text
        assert "joint 2 ≈ excited" in text


async def test_a_normal_run_is_grey_and_a_trip_is_red_in_words_first() -> None:
    async with glass(Machine({HERE: running()})) as shown:
        assert [colour(shown, k) for k in range(len(shown.lines))] == [("", "")] * 30
    record = running(7.9, Bench(spike=7.997))
    record.waiting.append(tripped(followed(snapshot(Bench(spike=7.997), 160))))
    async with glass(Machine({HERE: record}), size=(80, 24)) as shown:
        banner = next(i for i, line in enumerate(shown.lines) if "■ TRIPPED  limit" in line)
        said = "".join(shown.lines[banner : banner + 2])
        for part in ("pressure", "9.31 MPa", "joint 2", "7.9970 s", "-0.2 to 9 MPa"):
            assert part in said
        assert colour(shown, banner)[1] == "red"
        assert colour(shown, 0) == (" ■ TRIPPED ", "red")
        # Held by the operator it stays.
        await shown.press("h")
        await shown.watch()
        assert "■ TRIPPED  limit" in shown.text


@pytest.mark.parametrize("state", ["done", "aborted"])
async def test_an_ended_run_is_not_green(state: str) -> None:
    record = running()
    record.waiting.append(replace(followed(snapshot(Bench(), 81)), state=state))
    async with glass(Machine({HERE: record})) as shown:
        await shown.press("space")
        assert not [k for k in range(30) if colour(shown, k)[1] == "other"]


async def test_a_lost_device_and_unconfirmed_outputs_fill_the_banner() -> None:
    record = running()
    lost = replace(followed(snapshot(Bench(), 81)), device="lost", engine="idle")
    record.waiting.append(lost)
    async with glass(Machine({HERE: record})) as shown:
        assert "■ DEVICE LOST" in shown.lines[0]
        assert any("DEVICE LOST: looking for it" in line for line in shown.lines)
        assert "⊘" in shown.text, "its numbers do not look live"
        message = "the device does not answer; outputs not confirmed at zero"
        record.waiting.append(replace(lost, state="aborted", message=message))
        await shown.watch(0.1)
        assert "■ OUTPUTS NOT CONFIRMED" in shown.lines[0]
        first = next(line for line in shown.lines if "OUTPUTS NOT CONFIRMED AT ZERO" in line)
        assert "keep away" in first


async def test_a_curve_rises_where_the_pressure_does() -> None:
    def with_step(view: Snapshot) -> Snapshot:
        cap = view.channels["cap_pressure_1"]
        level = 1e6 if view.device_time <= 5.0 else 8e6
        n = len(cap.minimum)
        cap = replace(cap, last=level, minimum=[level] * n, maximum=[level] * n)
        return replace(view, channels={**view.channels, "cap_pressure_1": cap})

    record = Recorded(with_step(view) for view in run(Bench(joints=1), 10.0))
    async with glass(Machine({HERE: record}), size=(80, 60)) as shown:
        top = next(i for i, line in enumerate(shown.lines) if "9┤" in line)
        bottom = next(i for i, line in enumerate(shown.lines) if "−0.2┤" in line)
        plot = [line[10:-2] for line in shown.lines[top + 1 : bottom]]
        half = len(plot[0]) // 2
        upper, lower = plot[: len(plot) // 2], plot[len(plot) // 2 :]
        assert all(set(line[: half - 2]) == {"⠀"} for line in upper)
        assert any(set(line[half + 2 :]) - {"⠀"} for line in upper)
        assert any(set(line[: half - 2]) - {"⠀"} for line in lower)
        assert all(set(line[half + 2 :]) == {"⠀"} for line in lower)


@pytest.mark.parametrize("keys", [["s"], ["space"], ["escape", "escape"]])
@pytest.mark.parametrize("page", ["1", "4", "7", "?", "/"])
async def test_stop_is_sent_from_every_page_and_under_a_question(
    keys: list[str], page: str
) -> None:
    if page == "/" and keys == ["s"]:
        pytest.skip("in a line of text s is a letter")
    record = running()
    async with glass(Machine({HERE: record})) as shown:
        await shown.press({"?": "question_mark", "/": "slash"}.get(page, page))
        if page == "?" and keys == ["s"]:
            await shown.press("x")  # any key closes the help
        for key in keys:
            await shown.press(key)
        await shown.answered()
        assert record.commands == ["stop"]
        assert "waiting for the run to confirm" in shown.text
        record.waiting.append(stopped(followed(snapshot(Bench(), 81))))
        await shown.watch(0.1)
        assert "STOP SENT, OUTPUTS ZEROED" in shown.text
        assert "STOPPED" in shown.lines[0]


@pytest.mark.parametrize("size", [(40, 10), (20, 3), (8, 2), (1, 1)])
async def test_a_terminal_too_small_says_the_state_and_still_stops(size: tuple[int, int]) -> None:
    record = running()
    async with glass(Machine({HERE: record}), size=size) as shown:
        if size[0] >= 20:
            assert "● EXCITING" in shown.text
            assert "SPACE STOPS" in shown.text
        await shown.press("space")
        await shown.answered()
        assert record.commands == ["stop"]


@pytest.mark.parametrize("size", [(80, 24), (120, 40), (200, 60)])
async def test_the_keys_are_listed_without_a_wrapped_line(size: tuple[int, int]) -> None:
    async with glass(Machine({HERE: running()}), size) as shown:
        await shown.press("question_mark")
        for line in HELP:
            assert line in shown.text


async def test_one_escape_closes_a_question_and_stops_nothing() -> None:
    record = running()
    async with glass(Machine({HERE: record})) as shown:
        await shown.press("question_mark")
        assert "acknowledge an alarm" in shown.text
        await shown.press("escape")
        assert "acknowledge an alarm" not in shown.text
        shown.clock.now += 5.0
        await shown.press("escape")
        assert record.commands == []


async def test_stop_without_an_answer_says_so_and_names_the_emergency_stop() -> None:
    record = running()
    record.answers = False
    async with glass(Machine({HERE: record})) as shown:
        await shown.press("s")
        await shown.answered()
        assert "STOP: NO ANSWER" in shown.text
        assert "emergency stop" in shown.text


async def test_stop_taken_but_not_confirmed_becomes_an_alarm() -> None:
    async with glass(Machine({HERE: running()})) as shown:
        await shown.press("s")
        await shown.answered()
        await shown.watch(2.5)
        assert "STOP TAKEN, NOT CONFIRMED for 2.5 s" in shown.text


async def test_stop_without_a_run_claims_nothing() -> None:
    async with glass(Machine()) as shown:
        await shown.press("s")
        await shown.answered()
        assert "NOTHING SENT" in shown.text


async def test_a_stop_goes_to_the_only_run_that_is_not_shown_yet() -> None:
    machine = Machine()
    async with glass(machine) as shown:
        record = machine.runs[HERE] = running()
        await shown.press("s")
        await shown.answered()
        assert record.commands == ["stop"]
        assert "shinshu-2dof (process 4711), which is not the run shown: taken" in shown.text
    machine = Machine()
    async with glass(machine) as shown:
        both = [running(), running()]
        machine.runs = {HERE: both[0], endpoint("press", 4712): both[1]}
        await shown.press("s")
        await shown.watch()
        await shown.answered()
        assert [record.commands for record in both] == [[], []], "which of them was not said"
        assert "NOTHING SENT" in shown.text


async def test_stop_leaves_even_while_the_receiving_side_hangs() -> None:
    free = threading.Event()
    sent = threading.Event()

    class Hung(Recorded):
        def receive(self, timeout: float) -> Snapshot | None:
            free.wait()
            return None

        def send(self, command: str) -> bool:
            sent.set()
            return super().send(command)

    record = Hung()
    app = Monitor(None, Machine({HERE: record}))
    try:
        async with app.run_test(size=(80, 24)) as pilot:
            while app.link.frame.endpoint is None:
                await pilot.pause(0.01)
            await pilot.press("s")
            assert sent.wait(30)
            assert record.commands == ["stop"]
            free.set()
    finally:
        free.set()


async def test_old_numbers_are_never_shown_as_live_and_are_said_after_half_a_second() -> None:
    async with glass(Machine({HERE: running()})) as shown:
        await shown.watch(0.4)
        assert "NO DATA" not in shown.text
        await shown.watch(0.2)
        assert "NO DATA for 0.61 s" in shown.text
        assert "joint 1 ▣ locked · STALE" in shown.text
        assert "◌" in shown.text
        assert "age 0.61 s" in shown.text
        await shown.watch(60)
        assert "NO DATA for 61 s" in shown.text


async def test_stale_invalid_and_disconnected_numbers_look_different() -> None:
    record = running()
    last = followed(snapshot(Bench(), 81))
    cap = replace(last.channels["cap_pressure_1"], last=float("nan"))
    record.waiting.append(replace(last, channels={**last.channels, "cap_pressure_1": cap}))
    machine = Machine({HERE: record})
    async with glass(machine) as shown:
        line = next(line for line in shown.lines if "cap " in line)
        assert "✕ invalid" in line
        assert "◌" not in shown.text
        await shown.watch(1.0)
        assert "◌" in shown.text
        del machine.runs[HERE]
        await shown.watch(2.0)
        assert "⊘" in shown.text
        assert "DISCONNECTED" in shown.text


async def test_snapshots_without_new_samples_do_not_look_fresh() -> None:
    record = running()
    async with glass(Machine({HERE: record})) as shown:
        last = followed(snapshot(Bench(), 80))
        nan = {
            name: replace(view, last=float("nan"), minimum=[], maximum=[])
            for name, view in last.channels.items()
        }
        for _ in range(30):
            record.waiting.append(replace(last, channels=nan, message="waiting for the device"))
            await shown.watch(0.05)
        assert "NO DATA for 1.5 s" in shown.text
        assert f"◌{last.channels['cap_pressure_2'].last / 1e6:.2f} MPa" in shown.text


async def test_without_a_session_it_says_how_to_start_one_and_attaches_when_one_appears() -> None:
    machine = Machine()
    async with glass(machine, rig="my-rig") as shown:
        assert "No protocol is running on rig my-rig" in shown.text
        assert "bramah run lock-and-excite --rig my-rig --out RUN" in shown.text
        machine.runs[HERE] = running()
        await shown.watch(1.0)
        assert "EXCITING" in shown.text
        assert "piston" in shown.text


async def test_the_commands_that_an_idle_screen_shows_work_for_its_rig(tmp_path: Path) -> None:
    mine = tmp_path / "my boom.yaml"
    mine.write_text((files("rig") / "shipped" / "boom-1dof.yaml").read_text("utf-8"))
    app = Monitor("boom-1dof", Machine(), browsed=BrowserState(rig=str(mine), joints=1))
    async with app.run_test(size=(200, 30)) as pilot:
        await pilot.pause()
        lines = [strip.text.strip() for strip in app.screen._compositor.render_strips()]
    plan, run_ = (line for line in lines if line.startswith("bramah "))
    assert plan == f"bramah plan --rig '{mine}' --out steps.yaml"
    assert run_ == f"bramah run steps.yaml --rig '{mine}' --out RUN"
    planned = bramah_here(*shlex.split(plan)[1:], cwd=tmp_path)
    assert planned.returncode == 0, planned.stderr
    assert (tmp_path / "steps.yaml").is_file()


async def test_a_screen_that_attaches_late_shows_what_the_run_kept() -> None:
    record = Recorded([followed(snapshot(Bench(), 1000))])
    record.lately = past(Bench(), 50.0)
    async with glass(Machine({HERE: record}), size=(120, 40)) as shown:
        assert len(shown.app.link.frame.window.time) > 100
        line = next(line for line in shown.lines if "−22.0 … +22.0" in line)
        assert "piston" in line
        assert shown.app.link.frame.plan


async def test_with_several_sessions_the_operator_chooses_one() -> None:
    other = endpoint("press", 99)
    one, two = running(), running(2.0, Bench(rig="press", joints=1, pid=99))
    async with glass(Machine({HERE: one, other: two})) as shown:
        assert "Several runs" in shown.text
        assert "press   process 99" in shown.text
        assert "piston" not in shown.text
        await shown.press("down")
        await shown.press("enter")
        await shown.watch(0.1)
        assert "press" in shown.lines[0]
        assert "joint 1" in shown.text
        assert "joint 2" not in shown.text
        await shown.press("c")
        await shown.watch(0.1)
        assert "Several runs" in shown.text
        await shown.press("up")
        await shown.press("s")
        await shown.answered()
        assert (one.commands, two.commands) == (["stop"], [])


async def test_after_the_run_its_last_picture_stays_and_the_next_run_is_joined() -> None:
    record = running()
    record.waiting.append(replace(followed(snapshot(Bench(), 81)), state="done"))
    machine = Machine({HERE: record})
    async with glass(machine) as shown:
        del machine.runs[HERE]
        await shown.watch(2.0)
        assert "□ RUN ENDED" in shown.lines[0]
        assert "RUN ENDED, done: below is its last picture" in shown.text
        assert "joint 1 ▣ locked · last picture" in shown.text
        assert "NO DATA" not in shown.text
        assert "%  ended" in shown.lines[1]
        await shown.press("6")
        assert "left" not in shown.text
        await shown.press("1")
        machine.runs[endpoint(pid=4712)] = running(1.0, Bench(pid=4712, run="runs/second"))
        await shown.watch(2.0)
        assert "second" in shown.lines[0]
        assert "EXCITING" in shown.lines[0]
        assert "last picture" not in shown.text


def machine_that_trips() -> Machine:
    """A run whose bench trips as soon as the screen has joined it."""
    record = running()
    record.waiting.append(tripped(followed(snapshot(Bench(), 81))))
    return Machine({HERE: record})


async def test_a_trip_stays_shown_while_another_bench_runs_until_the_operator_changes() -> None:
    # Two benches in the room: the screen has joined the first by itself, and it trips.
    press = Recorded(other_bench(k) for k in range(1, 41))
    machine, other = machine_that_trips(), endpoint("press", 99)
    async with glass(machine) as shown:
        del machine.runs[HERE]
        machine.runs[other] = press
        for _ in range(5):
            await shown.watch(1.0)
        assert "■ TRIPPED  shinshu-2dof" in shown.lines[0]
        assert "NOT SHOWN: a run on press (process 99); c or bramah" in shown.sentences
        await shown.press("space")
        await shown.answered()
        assert press.commands == []
        press.waiting.extend(other_bench(k) for k in range(41, 51))
        await shown.press("c")
        await shown.watch(1.0)
        assert "EXCITING  press" in shown.lines[0]
        await shown.press("space")
        await shown.answered()
        assert press.commands == ["stop"]


def other_bench(k: int) -> Snapshot:
    view = followed(snapshot(Bench(rig="press", joints=1, pid=99), k))
    return replace(view, wire="modbus-tcp://127.0.0.1:5021")


async def test_of_two_runs_that_begin_after_a_trip_the_one_of_the_same_bench_is_joined() -> None:
    machine = machine_that_trips()
    async with glass(machine) as shown:
        del machine.runs[HERE]
        await shown.watch(1.0)
        machine.runs[endpoint("press", 99)] = Recorded([other_bench(1)])
        await shown.watch(1.0)
        machine.runs[endpoint(pid=4712)] = running(1.0, Bench(pid=4712, run="runs/second"))
        await shown.watch(1.0)
        assert "EXCITING  shinshu-2dof  second" in shown.lines[0]


async def test_a_run_that_the_operator_starts_is_joined_whatever_was_shown() -> None:
    machine = machine_that_trips()
    async with glass(machine) as shown:
        del machine.runs[HERE]
        await shown.watch(1.0)
        shown.app.link.expect(99)
        machine.runs[endpoint("press", 99)] = Recorded([other_bench(1)])
        await shown.watch(1.0)
        assert "EXCITING  press" in shown.lines[0]


async def test_an_idle_screen_draws_nothing() -> None:
    record = running()
    record.waiting.append(replace(followed(snapshot(Bench(), 81)), state="done"))
    machine = Machine({HERE: record})
    async with glass(machine) as shown:
        del machine.runs[HERE]
        await shown.watch(2.0)
        before = shown.app.pictures
        for _ in range(50):
            shown.clock.now += 0.1
            shown.app.link.step(0.0)  # it looks for the next run
            shown.app.draw()
        assert shown.app.pictures == before
        await shown.press("4")
        assert shown.app.pictures > before


async def test_a_run_that_dies_without_a_word_is_called_gone() -> None:
    machine = Machine({HERE: running()})
    async with glass(machine) as shown:
        del machine.runs[HERE]
        await shown.watch(2.0)
        assert "RUN GONE (process 4711" in shown.text
        assert "■ RUN GONE" in shown.lines[0]


async def test_a_held_picture_keeps_its_numbers_says_so_and_lives_again() -> None:
    record = running()
    async with glass(Machine({HERE: record})) as shown:
        await shown.press("h")
        held = f"‖{snapshot(Bench(), 80).channels['cap_pressure_2'].last / 1e6:.2f} MPa"
        record.waiting.extend(followed(snapshot(Bench(), k)) for k in range(81, 111))
        await shown.watch(0.35)
        assert "DISPLAY HELD" in shown.text
        assert held in shown.text
        assert "t 0:05" in shown.lines[0], "the clock goes on"
        await shown.press("h")
        await shown.watch()
        assert "HELD" not in shown.text
        assert held not in shown.text


async def test_lost_samples_are_counted_and_logged() -> None:
    record = running()
    record.waiting.append(replace(followed(snapshot(Bench(), 81)), lost_samples=12))
    async with glass(Machine({HERE: record})) as shown:
        assert "12 lost" in shown.text
        await shown.press("7")
        assert "12 samples lost" in shown.text


async def test_the_log_is_searched_filtered_and_scrolled() -> None:
    record = running(7.0)
    record.waiting.extend(
        replace(followed(snapshot(Bench(), k)), message=f"mark {k}") for k in range(141, 200)
    )
    async with glass(Machine({HERE: record})) as shown:
        await shown.press("7")
        assert "mark 199" in shown.text
        assert "mark 150" not in shown.text
        await shown.press("pageup")
        await shown.press("pageup")
        assert "20 rows back" in shown.text
        assert "mark 199" not in shown.text
        await shown.press("slash")
        for key in "150":
            await shown.press(key)
        await shown.press("enter")
        assert "search: 150" in shown.text
        assert "mark 150" in shown.text
        await shown.press("slash")
        await shown.press("enter")
        await shown.press("f")
        assert "alarms" in shown.text
        assert "WARNING  The supply pressure" in shown.text
        assert "mark 199" not in shown.text


async def test_zoom_and_span_change_the_plots() -> None:
    async with glass(Machine({HERE: running()})) as shown:
        assert "last 10 s" in shown.text
        await shown.press("minus")
        assert "last 5 s" in shown.text
        await shown.press("plus")
        await shown.press("plus")
        assert "last 30 s" in shown.text
        await shown.press("equals_sign")
        await shown.press("2")
        assert "last 10 s" in shown.text
        assert " 9┤" in shown.text
        await shown.press("z")
        assert " 9┤" not in shown.text


async def test_the_four_levels_have_fixed_places() -> None:
    async with glass(Machine({HERE: running()})) as shown:
        await shown.press("2")
        assert "joint 1 ▣ locked of 2" in shown.text
        await shown.press("right")
        assert "joint 2 ≈ excited of 2" in shown.text
        await shown.press("3")
        for _ in range(2):
            await shown.press("down")
        assert "▸  cap_pressure_1" in shown.text
        assert "warns beyond  0.1 … 8.1 MPa" in shown.text
        assert "trips beyond  −0.2 … 9 MPa" in shown.text
        await shown.press("4")
        assert re.search(r"time of the device +4.000 s, tick 4000", shown.text)
        assert "modbus-tcp://127.0.0.1:5020" in shown.text


async def test_four_joints_on_a_small_terminal_are_reached_by_scrolling() -> None:
    async with glass(Machine({HERE: running(2.0, Bench(joints=4))}), size=(80, 24)) as shown:
        assert "joint 2" in shown.text
        assert "2 more joints" in shown.text
        for _ in range(4):
            await shown.press("down")
        assert "joint 4" in shown.text
        assert shown.text.count("piston ") == 2


async def test_joints_that_do_not_all_fit_begin_with_those_that_move() -> None:
    async with glass(Machine({HERE: running(2.0, Bench(joints=4))}), size=(80, 24)) as shown:
        assert "joint 2 ≈ excited" in shown.text
        assert "joint 3 ≈ excited" in shown.text
        assert "joint 1" not in shown.text
        for _ in range(4):
            await shown.press("down")
        assert "joint 1 ▣ locked" in shown.text


async def test_quitting_says_that_the_run_goes_on() -> None:
    record = running()
    async with glass(Machine({HERE: record})) as shown:
        await shown.press("q")
        assert shown.app.return_value == 0
        assert "GOES ON" in farewell(shown.app.link.frame)
        assert record.commands == []


async def test_ctrl_c_leaves_with_130_and_without_a_command() -> None:
    record = running()
    async with glass(Machine({HERE: record})) as shown:
        await shown.press("ctrl+c")
        assert shown.app.return_value == 130
        assert record.commands == []


async def test_words_in_brackets_are_shown_as_they_are() -> None:
    record = running()
    words = "step [red]x[/] of [1, 2]"
    record.waiting.append(replace(followed(snapshot(Bench(), 81)), message=words))
    async with glass(Machine({HERE: record})) as shown:
        await shown.press("7")
        assert words in shown.text


def test_a_fast_bench_gets_a_longer_span() -> None:
    assert automatic_span(1.0) == automatic_span(1.3) == 10.0
    assert automatic_span(50.0) == 300.0
    assert automatic_span(1e6) == 600.0
