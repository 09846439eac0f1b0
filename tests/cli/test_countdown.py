"""Work of more than a few seconds says how far it is and how long it will take."""

from __future__ import annotations

from pathlib import Path

import pytest

from protocols.files.library import load
from protocols.files.plan import resolve
from rig.cli.bench import figures
from rig.cli.bench.figure import Figure
from rig.cli.proof.proofs import proved
from rig.cli.text.output import LINE_SECONDS, Countdown, clock_text
from rig.runs.files import CACHE_VARIABLE
from rig.runs.rigs import load_rig


class Clock:
    """A clock that a test sets."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def test_short_work_is_quiet_and_long_work_says_what_is_left() -> None:
    clock, said = Clock(), []
    progress = Countdown("tracing", said.append, clock)
    for share in (0.1, 0.2, 0.25):
        clock.now += 0.9
        progress(share)
    assert said == []
    clock.now = 100.0 + 20.0
    progress(0.25001)
    progress(0.26)
    clock.now += LINE_SECONDS
    progress(0.5)
    clock.now += 100.0
    progress(1.0)
    assert said == ["tracing: 25 %, about 1:00 left", "tracing: 50 %, about 0:23 left"]


def test_work_that_does_not_get_on_states_no_remaining_time() -> None:
    """A search of unknown length reports the share reached before it, each time it has tried."""
    clock, said = Clock(), []
    progress = Countdown("tracing", said.append, clock)
    for seconds, share in ((5.0, 0.5), (4.0, 0.5), (3.0, 0.5), (70.0, 0.5), (5.0, 0.8)):
        clock.now += seconds
        progress(share)
    assert said == [
        "tracing: 50 %, about 0:05 left",
        "tracing: 50 % for 0:04, time left unknown",
        "tracing: 50 % for 1:17, time left unknown",
        "tracing: 80 %, about 0:22 left",
    ]


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0, "0:00"), (7.4, "0:07"), (750, "12:30"), (11100, "3:05:00"), (-3, "0:00")],
)
def test_times_are_written_as_on_a_clock(seconds: float, text: str) -> None:
    assert clock_text(seconds) == text


def rises(shares: list[float]) -> bool:
    """Whether shares go up and stay between 0 and 1."""
    return bool(shares) and shares == sorted(shares) and 0.0 < shares[0] <= shares[-1] <= 1.0


def test_a_check_tells_of_each_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    rig = load_rig("shinshu-2dof")
    plan = resolve(load("amplitude-sweep"), rig)
    shares: list[float] = []
    proved(plan, rig, predict=True, progress=shares.append)
    assert rises(shares)
    assert shares[-1] == 1.0
    assert len(shares) == len(plan.excitations) + len(plan.steps)
    assert proved(plan, rig, predict=True, progress=shares.clear).reused


def test_the_figures_say_which_group_comes_and_what_is_left(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each group also has an empty folder: two of them call their first run alike."""
    said: list[str] = []

    def figures_of(*given: object) -> list[Figure]:
        for folder in given:
            if isinstance(folder, Path):
                (folder / "run-0").mkdir()
        return []

    for name in ("plant", "analysis", "trace", "stream", "demo", "growth", "run", "acquisition"):
        monkeypatch.setattr(figures, f"{name}_figures", figures_of)
    figures.measure(10.0, 2, None, said.append)
    assert said[0] == "plant: group 1 of 8, about 17:25 left"
    assert said[-1] == "acquisition: group 8 of 8, about 10:00 left"
