"""Make calls in random order, with losses and faults: a state machine around `calls_model`.

Every block read must continue the one before and follow the law of each of its ticks; after zero,
close and any error the device's outputs are zero. Hypothesis draws the calls and shortens a
sequence that fails; it is a dependency of development, imported when used.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

from drivers.conformance.calls_model import DeviceModel
from drivers.conformance.subject import Subject
from drivers.conformance.watched import NotConforming, Skipped

_CALLS_SHOWN: Final = 14  # calls named in the message
_LAW = tuple[float, float, float]


@dataclass(frozen=True)
class RandomCallBudget:
    """Number and length of the sequences of calls, and whether to shorten them."""

    sequences: int = 60
    calls: int = 30
    shorten: bool = True


def _machine(subject: Subject, recent: dict[str, list[str]]) -> Any:
    """Return the state machine's class; `recent["calls"]` holds the calls of the last sequence."""
    from hypothesis import strategies as st  # noqa: PLC0415 - a dependency of development only
    from hypothesis.stateful import RuleBasedStateMachine, precondition, rule  # noqa: PLC0415

    connected = precondition(lambda self: self.model.connected)
    laws = st.lists(
        st.tuples(
            st.sampled_from((1.0, 0.5, -1.0, 0.0)),
            st.sampled_from((0.0, 0.5, -0.5, 0.9)),
            st.sampled_from((1.0, 0.8, 0.4, 0.0)),
        ),
        min_size=9,
        max_size=9,
    )
    joints, lengths = st.integers(0, 8), st.sampled_from((61, 7, 1))

    class Calls(RuleBasedStateMachine):
        """Draws calls; the model checks their results."""

        def __init__(self) -> None:
            super().__init__()
            self.model = DeviceModel(subject)
            recent["calls"] = self.model.driver.log

        def read_blocks(self, blocks: int) -> None:
            for _ in range(blocks if self.model.streaming else 0):
                self.model.read()

        @precondition(lambda self: not self.model.connected)
        @rule(start=st.booleans())
        def connect(self, start: bool) -> None:
            self.model.connect()
            if start:
                self.model.start()

        @connected
        @rule(laws=laws, restart=st.booleans(), blocks=st.integers(0, 3))
        def apply(self, laws: list[_LAW], restart: bool, blocks: int) -> None:
            self.model.apply(laws[: self.model.trial.joints], restart)
            self.read_blocks(blocks)

        @connected
        @rule(joint=joints, samples=lengths, seed=st.integers(0, 3), laws=laws, blocks=st.just(2))
        def play(self, joint: int, samples: int, seed: int, laws: list[_LAW], blocks: int) -> None:
            self.model.upload(joint % self.model.trial.joints, samples, seed)
            self.model.apply(laws[: self.model.trial.joints], False)
            self.read_blocks(blocks)

        @connected
        @rule(joint=joints, samples=lengths, blocks=st.integers(0, 2))
        def upload(self, joint: int, samples: int, blocks: int) -> None:
            self.model.upload(joint % self.model.trial.joints, samples)
            self.read_blocks(blocks)

        @connected
        @rule(value=st.sampled_from((float("nan"), float("inf"))))
        def apply_impossible(self, value: float) -> None:
            self.model.apply_impossible(value)

        @connected
        @rule(blocks=st.integers(0, 2))
        def start(self, blocks: int) -> None:
            self.model.start()
            self.read_blocks(blocks)

        @connected
        @rule(blocks=st.integers(1, 3))
        def read(self, blocks: int) -> None:
            for _ in range(blocks):
                self.model.read()

        @connected
        @rule()
        def zero(self) -> None:
            self.model.zero()

        @connected
        @rule()
        def stop(self) -> None:
            self.model.stop()

        @connected
        @rule()
        def reset(self) -> None:
            self.model.reset()

        @connected
        @rule(
            how=st.sampled_from(("close", "cut", "silence", "spoiled")),
            which=st.integers(0, 99),
            call=st.sampled_from(("read", "start", "stop", "zero", "apply", "upload")),
        )
        def end(self, how: str, which: int, call: str) -> None:
            bench = self.model.trial.bench
            if how == "cut" and bench.cut is not None:
                self.model.cut()
            elif how == "silence" and bench.silence is not None:
                self.model.silence()
            elif how == "spoiled" and bench.faults:
                self.model.spoiled(bench.faults[which % len(bench.faults)], call)
            else:
                self.model.close()

        def teardown(self) -> None:
            self.model.end()

    return Calls


def try_random_calls(subject: Subject, effort: RandomCallBudget) -> None:
    """Try random sequences of calls on fresh benches.

    Raises NotConforming with the calls that led to it, Skipped without hypothesis.
    """
    try:
        from hypothesis import HealthCheck, Phase, settings  # noqa: PLC0415
        from hypothesis.stateful import run_state_machine_as_test  # noqa: PLC0415
    except ImportError as error:
        raise Skipped("needs the package hypothesis: pip install hypothesis") from error
    recent: dict[str, list[str]] = {"calls": []}
    phases = (Phase.generate, Phase.shrink) if effort.shorten else (Phase.generate,)
    try:
        run_state_machine_as_test(
            _machine(subject, recent),
            settings=settings(
                max_examples=effort.sequences,
                stateful_step_count=effort.calls,
                deadline=None,
                database=None,
                derandomize=True,
                phases=phases,
                print_blob=False,
                report_multiple_bugs=False,
                suppress_health_check=list(HealthCheck),
            ),
        )
    except Exception as error:
        calls = recent["calls"]
        cut = "... " if len(calls) > _CALLS_SHOWN else ""
        shown = f"{cut}{', '.join(calls[-_CALLS_SHOWN:])}"
        raise NotConforming(f"{error} (calls: {shown})") from error
