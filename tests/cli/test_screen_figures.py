"""The figures of the screen: its stop on the device's clock, the age of what it shows."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from rig.cli.bench.screen.arrival import age_quantile, ages_on_screen
from rig.cli.bench.screen.runs import RunTimes, played
from rig.cli.bench.screen.stops import many_stops
from rig.cli.bench.screen.terminal import Screen
from rig.cli.simulated.simulated_bench import simulated_bench


@pytest.fixture
def runtime() -> Iterator[Path]:
    """A folder short enough for the address of a socket."""
    with tempfile.TemporaryDirectory(prefix="b", dir="/tmp") as folder:
        yield Path(folder)


def test_ages_are_from_the_sample_to_the_text_in_the_terminal() -> None:
    drawn = [(10.10, "time 0.050 s, tick 50 "), (10.20, "tick 150"), (10.21, "no number\n"),
             (10.30, "tick 2"), (10.31, "50 of ")]  # fmt: skip
    ages, stays = ages_on_screen(drawn, 10.0, 1000.0)
    assert ages == pytest.approx([0.05, 0.05])
    assert stays == pytest.approx([0.10, 0.11]), "a number in two pieces counts with its second"


def test_a_number_grows_older_until_the_next_is_drawn() -> None:
    """Against ages sampled every 10 us."""
    rng = np.random.default_rng(3)
    ages, stays = rng.uniform(0.02, 0.1, 40), rng.uniform(0.05, 0.2, 40)
    moments = np.concatenate(
        [age + np.arange(0.0, stay, 1e-5) for age, stay in zip(ages, stays, strict=True)]
    )
    for share in (0.5, 0.9, 0.99):
        assert age_quantile(ages, stays, share) == pytest.approx(
            np.quantile(moments, share), abs=1e-4
        )
    assert age_quantile(ages, stays, 1.0) == pytest.approx((ages + stays).max())


def test_the_origin_of_the_device_is_never_taken_too_early() -> None:
    ends = np.array([0.01, 0.02, 0.03])
    times = RunTimes(ends, 100.0 + ends + [0.004, 0.002, 0.05], 0, 0.5, (), "", held=True)
    assert times.origin == pytest.approx(100.002)


def test_keys_in_a_terminal_stop_real_runs_and_are_timed_by_the_device(runtime: Path) -> None:
    found, failed = many_stops(runtime, lambda _: None, 2)
    assert failed == 0
    for acted, zeroed in found:
        assert 0.0 < acted < np.inf
        assert 0.0 < zeroed < np.inf


@pytest.mark.slow
def test_a_run_that_nobody_stops_loses_nothing_when_its_screen_is_killed(runtime: Path) -> None:
    with (
        simulated_bench("digger-3dof", seed=1, real_time=True) as endpoint,
        played(endpoint, runtime, runtime / "run", driven=False) as run,
    ):
        with Screen(runtime):
            assert run.has_sent("watched", 60.0)
        times = run.end()
    assert times.lost == 0
    assert times.reason == ""
    assert np.all(np.diff(times.ends) > 0.0)
    assert np.isnan(times.zeroed), "no output was touched"
