"""Stories of an operator in front of `bramah monitor`."""

from __future__ import annotations

import re
import threading
from dataclasses import replace

import pytest

from rig.bench.screens.sockets import Snapshot
from rig.tui.app import Monitor, automatic_span, farewell
from tests.tui.glass import Machine, Recorded, endpoint, glass
from tests.tui.recorded import Bench, run, snapshot, stopped, tripped

HERE = endpoint()
KEYS = "STOP outputs"


def running(seconds: float = 4.0, bench: Bench | None = None) -> Recorded:
    return Recorded(run(bench or Bench(), seconds))


async def test_operator_sees_pressures_with_their_limits_and_where_the_protocol_stands() -> None:
    async with glass(Machine({HERE: running()})) as shown:
        text = shown.text
        last = snapshot(Bench(), 80)
        for joint in (1, 2):
            pressure = last.channels[f"cap_pressure_{joint}"].last / 1e6
            assert f"cap     {pressure:.2f} MPa" in text
        assert re.search(r"\b9┤", text), "the upper pressure limit stands at the plot's axis"
        assert "−0.2┤" in text
        assert "RUNNING" in text
        assert "step1  excite  repeat 1 of 4" in text
        assert "10%  0:04 of 0:40" in text
        assert "device 4.0 s" in text
        assert "age 0.01 s   lost 0" in text
        assert "supply 6.9" in text
        assert "oil 40.1 °C" in text
        piston = last.channels["piston_2"].last * 1e3
        line = next(line for line in shown.lines if "piston" in line)
        assert f"{piston:+.1f} mm −36".replace("-", "−") in line
        assert "├" in line
        assert "●" in line
        assert "joint 1 locked at its retracted end" in text


async def test_a_curve_rises_where_the_pressure_does() -> None:
    def with_step(view: Snapshot) -> Snapshot:
        cap = view.channels["cap_pressure_1"]
        level = 1e6 if view.device_time <= 5.0 else 8e6
        n = len(cap.minimum)
        cap = replace(cap, last=level, minimum=[level] * n, maximum=[level] * n)
        return replace(view, channels={**view.channels, "cap_pressure_1": cap})

    record = Recorded(with_step(view) for view in run(Bench(joints=1), 10.0))
    async with glass(Machine({HERE: record}), size=(80, 40)) as shown:
        top = next(i for i, line in enumerate(shown.lines) if "9┤" in line)
        bottom = next(i for i, line in enumerate(shown.lines) if "−0.2┤" in line)
        plot = [line[9:-2] for line in shown.lines[top + 1 : bottom]]
        half = len(plot[0]) // 2
        upper, lower = plot[: len(plot) // 2], plot[len(plot) // 2 :]
        assert all(set(line[: half - 2]) == {"⠀"} for line in upper)
        assert any(set(line[half + 2 :]) - {"⠀"} for line in upper)
        assert any(set(line[: half - 2]) - {"⠀"} for line in lower)
        assert all(set(line[half + 2 :]) == {"⠀"} for line in lower)


@pytest.mark.parametrize("key", ["s", "space"])
async def test_stop_is_sent_at_once_and_confirmed_by_the_run(key: str) -> None:
    record = running()
    async with glass(Machine({HERE: record})) as shown:
        await shown.press(key)
        await shown.answered()
        assert record.commands == ["stop"]
        assert "waiting for the run to confirm" in shown.text
        record.waiting.append(stopped(snapshot(Bench(), 81)))
        await shown.watch(0.1)
        assert "STOP SENT, OUTPUTS ZEROED" in shown.text
        assert "ABORTED" in shown.text


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
        await shown.watch()
        assert "NOTHING SENT" in shown.text


async def test_stop_works_under_the_help_page() -> None:
    record = running()
    async with glass(Machine({HERE: record})) as shown:
        await shown.press("question_mark")
        assert "zero all outputs" in shown.text
        await shown.press("s")
        await shown.answered()
        assert record.commands == ["stop"]


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


async def test_a_trip_is_unmistakable_and_names_limit_value_joint_and_time() -> None:
    record = running(7.9, Bench(spike=7.997))
    record.waiting.append(tripped(snapshot(Bench(spike=7.997), 160)))
    async with glass(Machine({HERE: record}), size=(80, 24)) as shown:
        banner = next(i for i, line in enumerate(shown.lines) if " TRIP " in line)
        said = "".join(shown.lines[banner : banner + 2])
        for part in ("pressure", "9.31 MPa", "joint 2", "7.9970 s", "-0.2 to 9 MPa"):
            assert part in said
        strip = shown.app.screen._compositor.render_strips()[banner]
        styles = [segment.style for segment in strip if segment.text.strip()]
        assert all(s is not None and s.bgcolor is not None for s in styles)
        red = styles[0].bgcolor.get_truecolor()
        assert red.red > 2 * max(red.green, red.blue)
        assert "TRIPPED" in shown.text
        # A pause must not hide it either.
        await shown.press("p")
        await shown.watch()
        assert " TRIP " in shown.text


async def test_old_numbers_are_never_shown_as_live() -> None:
    async with glass(Machine({HERE: running()})) as shown:
        assert "NO DATA" not in shown.text
        await shown.watch(1.5)
        assert "NO DATA for 1.5 s" in shown.text
        assert "joint 1 · OLD, 1.5 s" in shown.text
        assert "age 1.5 s" in shown.text
        await shown.watch(60)
        assert "NO DATA for 62 s" in shown.text


async def test_snapshots_without_new_samples_do_not_look_fresh() -> None:
    record = running()
    async with glass(Machine({HERE: record})) as shown:
        last = snapshot(Bench(), 80)
        nan = {
            name: replace(view, last=float("nan"), minimum=[], maximum=[])
            for name, view in last.channels.items()
        }
        for _ in range(30):
            record.waiting.append(replace(last, channels=nan, message="waiting for the device"))
            await shown.watch(0.05)
        assert "NO DATA for 1.5 s" in shown.text
        assert f"cap     {last.channels['cap_pressure_2'].last / 1e6:.2f} MPa" in shown.text


async def test_without_a_session_it_says_how_to_start_one_and_attaches_when_one_appears() -> None:
    machine = Machine()
    async with glass(machine, rig="my-rig") as shown:
        assert "No protocol is running on rig my-rig" in shown.text
        assert "bramah run lock-and-excite --rig my-rig --out RUN" in shown.text
        machine.runs[HERE] = running()
        await shown.watch(1.0)
        assert "RUNNING" in shown.text
        assert "piston" in shown.text


async def test_with_several_sessions_the_operator_chooses_one() -> None:
    other = endpoint("press", 99)
    one, two = running(), running(2.0, Bench(rig="press", joints=1, pid=99))
    async with glass(Machine({HERE: one, other: two})) as shown:
        assert "Several protocols are running" in shown.text
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
        assert "Several protocols are running" in shown.text
        await shown.press("up")
        await shown.press("s")
        await shown.answered()
        assert (one.commands, two.commands) == (["stop"], [])


async def test_after_the_run_its_last_picture_stays_and_the_next_run_is_joined() -> None:
    record = running()
    record.waiting.append(replace(snapshot(Bench(), 81), state="done"))
    machine = Machine({HERE: record})
    async with glass(machine) as shown:
        del machine.runs[HERE]
        await shown.watch(2.0)
        assert "RUN ENDED, done: below is its last picture" in shown.text
        assert "joint 1 · last picture" in shown.text
        assert "NO DATA" not in shown.text
        machine.runs[endpoint(pid=4712)] = running(1.0, Bench(pid=4712, run="runs/second"))
        await shown.watch(2.0)
        assert "runs/second" in shown.lines[0]
        assert "RUNNING" in shown.lines[0]
        assert "last picture" not in shown.text


async def test_a_run_that_dies_without_a_word_is_called_gone() -> None:
    machine = Machine({HERE: running()})
    async with glass(machine) as shown:
        del machine.runs[HERE]
        await shown.watch(2.0)
        assert "RUN GONE (process 4711" in shown.text
        assert " GONE " in shown.lines[0]


async def test_a_paused_display_holds_its_numbers_says_so_and_lives_again() -> None:
    record = running()
    async with glass(Machine({HERE: record})) as shown:
        await shown.press("p")
        held = f"cap     {snapshot(Bench(), 80).channels['cap_pressure_2'].last / 1e6:.2f} MPa"
        record.waiting.extend(snapshot(Bench(), k) for k in range(81, 88))
        await shown.watch(0.35)
        assert "DISPLAY PAUSED" in shown.text
        assert "paused at 4.0 s" in shown.text
        assert held in shown.text
        assert "device 4.3" in shown.text, "the header goes on"
        await shown.press("p")
        await shown.watch()
        assert "PAUSED" not in shown.text
        assert held not in shown.text


async def test_lost_samples_are_counted_and_logged() -> None:
    record = running()
    record.waiting.append(replace(snapshot(Bench(), 81), lost_samples=12))
    async with glass(Machine({HERE: record})) as shown:
        assert "lost 12" in shown.text
        assert "12 samples lost" in shown.text


async def test_zoom_and_span_change_the_plots() -> None:
    async with glass(Machine({HERE: running()})) as shown:
        assert "last 10 s" in shown.text
        await shown.press("minus")
        assert "last 5 s" in shown.text
        await shown.press("plus")
        await shown.press("plus")
        assert "last 30 s" in shown.text
        await shown.press("0")
        await shown.press("z")
        assert "last 10 s" in shown.text
        assert "9┤" not in shown.text


@pytest.mark.parametrize("size", [(80, 24), (160, 50)])
@pytest.mark.parametrize("ended", [False, True])
async def test_small_and_large_terminals_show_all_that_matters(
    size: tuple[int, int], ended: bool
) -> None:
    record = running(7.9)
    if ended:
        record.waiting.append(tripped(snapshot(Bench(spike=7.997), 160)))
    async with glass(Machine({HERE: record}), size=size) as shown:
        text = shown.text
        assert len(shown.lines) == size[1]
        assert KEYS in shown.lines[-1]
        assert "q quit, run goes on" in shown.lines[-1]
        for word in ("cap", "rod", "piston", "spool", "command", "9┤", "−0.2┤"):
            assert len(re.findall(rf"{word}", text)) >= 2, word
        for word in ("age", "lost 0", "supply", "°C", "repeat 1 of 4", "0:40", "shinshu-2dof"):
            assert word in text
        plots = [line for line in shown.lines if "│⠀" in line or "┤⠀" in line or "┤⠁" in line]
        assert len(plots) >= 2, "curves keep some height"


async def test_four_joints_on_a_small_terminal_are_reached_by_scrolling() -> None:
    async with glass(Machine({HERE: running(2.0, Bench(joints=4))}), size=(80, 24)) as shown:
        assert "joint 2" in shown.text
        assert "piston" in shown.text
        for _ in range(4):
            await shown.press("down")
        assert "joint 4" in shown.text
        assert shown.text.count("command") == 2


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
    record.waiting.append(replace(snapshot(Bench(), 81), message="step [red]x[/] of [1, 2]"))
    async with glass(Machine({HERE: record})) as shown:
        assert "step [red]x[/] of [1, 2]" in shown.text


def test_a_fast_bench_gets_a_longer_span() -> None:
    assert automatic_span(1.0) == automatic_span(1.3) == 10.0
    assert automatic_span(50.0) == 300.0
    assert automatic_span(1e6) == 600.0
