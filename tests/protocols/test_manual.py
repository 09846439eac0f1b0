"""Moving a joint by hand: only while a key is held, only within limits, one joint at a time."""

from __future__ import annotations

import numpy as np
import pytest

from protocols.engine.manual import Manual
from protocols.engine.settings import ENGINE
from rig.bench.screens.commands import Command
from rig.runs.rigs import load_rig
from tests.protocols.little_bench import LittleBench, default_cylinders

RIG = load_rig("shinshu-2dof")
RATE = RIG.sample_rate


class Hand:
    """A person at a manual session: presses keys at device times, looks at what happened."""

    def __init__(self) -> None:
        self.bench = LittleBench(RIG, default_cylinders())
        self.manual = Manual(self.bench, RIG, lambda: self.bench.tick / RATE, idle_after=60.0)
        self.answers: list[str | None] = []

    def press(self, at: float, word: str, value: str = "") -> None:
        def ask() -> None:
            assert self.bench.judge is not None
            self.answers.append(self.bench.judge(Command(word, value, "me")))

        tick = round(at * RATE)
        while tick in self.bench.happenings:
            tick += 1
        self.bench.happenings[tick] = ask

    def hold(self, first: float, last: float, value: str) -> None:
        """Hold a key as a terminal repeats it: 30 times a second."""
        for at in np.arange(first, last, 1 / 30):
            self.press(float(at), "jog", value)

    def piston(self, joint: int) -> np.ndarray:
        return self.bench.channel(f"piston_{joint}")

    def command(self, joint: int) -> np.ndarray:
        return self.bench.channel(f"command_{joint}")


def test_a_joint_moves_while_the_key_is_held_and_stops_when_it_is_let_go() -> None:
    hand = Hand()
    hand.hold(0.5, 1.5, "1 +")
    hand.press(3.0, "abort")
    hand.manual.run()
    moved, volts = hand.piston(1), hand.command(1)
    assert not volts[: round(0.5 * RATE)].any()
    assert (volts[round(0.6 * RATE) : round(1.4 * RATE)] > 0).all()
    assert volts.max() <= ENGINE.jog_volts
    let_go = round((1.5 + ENGINE.jog_hold + 0.05) * RATE)
    assert not volts[let_go:].any(), "no key, no voltage"
    assert moved[let_go] > moved[0] + 1e-3
    assert not hand.command(2).any()
    assert set(hand.answers) == {None}
    assert hand.bench.laws == [hand.bench.laws[0].__class__()] * 2


def test_a_single_press_is_a_nudge() -> None:
    hand = Hand()
    hand.press(0.5, "jog", "2 -")
    hand.press(2.0, "abort")
    hand.manual.run()
    pushed = np.flatnonzero(hand.command(2)) / RATE
    assert len(pushed)
    assert pushed[-1] - pushed[0] <= ENGINE.jog_hold + 0.03
    assert hand.piston(2)[-1] < hand.piston(2)[0]


def test_a_key_held_for_long_ends_inside_the_limits() -> None:
    hand = Hand()
    hand.manual = Manual(hand.bench, RIG, lambda: hand.bench.tick / RATE, volts=0.6)
    hand.hold(0.2, 9.0, "1 +")
    hand.press(9.5, "abort")
    hand.manual.run()
    low, high = RIG.joints[0].limits.piston
    end = high - ENGINE.jog_margin * (high - low)
    assert hand.piston(1).max() <= end + 0.1 * (high - end)
    assert hand.piston(1)[-1] == pytest.approx(end, abs=2e-3)


def test_a_locked_joint_is_held_watched_and_not_jogged() -> None:
    hand = Hand()
    hand.press(0.3, "lock", "1")
    hand.press(0.6, "jog", "1 +")
    hand.press(0.7, "jog", "2 +")
    hand.press(1.5, "unlock", "1")
    hand.press(1.6, "unlock", "1")
    hand.press(2.0, "abort")
    roles = []
    hand.bench.happenings[round(1.2 * RATE)] = lambda: roles.extend(hand.bench.roles)
    hand.manual.run()
    assert hand.answers == [
        None,
        "jog: joint 1 is locked; unlock it first",
        None,
        None,
        "unlock: joint 1 is not locked",
        None,
    ]
    assert roles[0].locked
    assert roles[0].tolerance == ENGINE.manual_tolerance
    assert not roles[1].locked
    assert np.ptp(hand.piston(1)) < ENGINE.manual_tolerance
    assert not any(role.locked for role in hand.bench.roles)


def test_a_second_joint_takes_the_jog_over() -> None:
    hand = Hand()
    hand.hold(0.2, 0.6, "1 +")
    hand.hold(0.6, 1.0, "2 +")
    hand.press(1.5, "abort")
    hand.manual.run()
    assert not (np.abs(hand.command(1)) * np.abs(hand.command(2))).any()


@pytest.mark.parametrize(
    ("word", "value", "said"),
    [
        ("jog", "3 +", "expected a joint from 1 to 2"),
        ("jog", "1 up", "expected '+' (extend) or '-' (retract)"),
        ("jog", "", "expected a joint"),
        ("lock", "0", "expected a joint"),
        ("lock", "1", "is not known"),  # nothing was measured yet
        ("skip", "", "this is a manual session; expected jog, lock, unlock or abort"),
    ],
)
def test_what_cannot_be_done_is_refused_in_a_sentence(word: str, value: str, said: str) -> None:
    assert said in str(Hand().manual.accept(Command(word, value, "me")))


def test_a_session_that_nobody_commands_ends_by_itself() -> None:
    hand = Hand()
    hand.manual = Manual(hand.bench, RIG, lambda: hand.bench.tick / RATE, idle_after=2.0)
    hand.hold(0.1, 1.0, "1 +")
    hand.manual.run()
    assert 2.9 <= hand.bench.tick / RATE <= 3.2
    assert hand.bench.shown["kind"] == "manual"
