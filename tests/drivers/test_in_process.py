"""An object of this process behind the interface of every driver."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from drivers.base import OFF, ActiveLaw, DeviceError, DeviceLost, OutputLaw
from drivers.conformance import (
    Capabilities,
    CheckVerdict,
    DeviceUnderTest,
    RandomCallBudget,
    Subject,
    run,
)
from drivers.in_process import Advancing, InProcessDriver
from rig.model.rig import Rig
from tests.hil_sim.integrator import IntegratorPlant, seed_rig

MAKE = "tests.hil_sim.integrator:IntegratorPlant"
BARE = Capabilities(latches_trips=False, refuses_other_rigs=False)


def imported(path: str = MAKE) -> InProcessDriver:
    rig = seed_rig()
    return InProcessDriver(rig.wire.reached_by("in-process", {"object": path}), rig)


def over(made: Advancing, rig: Rig) -> InProcessDriver:
    return InProcessDriver(rig.wire.reached_by("in-process", {}), rig, make=lambda _: made)


class Straight:
    """Answers in SI: pistons stand, outputs follow the law."""

    def __init__(self, rig: Rig) -> None:
        self.rig, self.tick = rig, 0

    def advance(self, ticks: int, laws: Sequence[ActiveLaw]) -> tuple[Any, Any]:
        measured = np.full((ticks, len(self.rig.channels)), 0.001)
        now = range(self.tick, self.tick + ticks)
        self.tick += ticks
        return measured, np.array([[law.volts(tick, 0.001) for law in laws] for tick in now])


@pytest.mark.parametrize("make", [IntegratorPlant, Straight])
def test_it_conforms(make: Any) -> None:
    @contextmanager
    def bench() -> Iterator[DeviceUnderTest]:
        yield DeviceUnderTest(seed_rig(), lambda rig: over(make(rig), rig))

    report = run(Subject("in-process", bench, BARE), effort=RandomCallBudget(6, 20, shorten=False))
    assert report.of(CheckVerdict.FAILED) == ()
    assert len(report.of(CheckVerdict.PASSED)) >= 25


def test_codes_of_a_plant_become_si() -> None:
    driver = imported()
    assert driver.connect().identity == "IntegratorPlant"
    driver.start()
    driver.apply([OutputLaw(bias=0.5, limit=1.0), OFF])
    block = driver.read_block()
    names = seed_rig().recorded
    assert block.data[:, names.index("cap_pressure_1")] == pytest.approx(2.0e6, rel=1e-4)
    assert block.data[:, names.index("command_1")] == pytest.approx(0.5, abs=0.005)
    driver.close()


class Breaks:
    def __init__(self, rig: Rig) -> None:
        self.rig = rig

    def advance(self, ticks: int, laws: Sequence[ActiveLaw]) -> tuple[Any, Any]:
        raise ZeroDivisionError("no oil")


class TooFew(Breaks):
    def advance(self, ticks: int, laws: Sequence[ActiveLaw]) -> tuple[Any, Any]:
        return np.zeros((ticks, 3)), np.zeros((ticks, 2))


@pytest.mark.parametrize(("make", "says"), [(Breaks, "no oil"), (TooFew, r"\(10, 3\)")])
def test_an_object_that_fails_is_a_lost_device(make: Any, says: str) -> None:
    rig = seed_rig()
    driver = over(make(rig), rig)
    driver.connect()
    driver.start()
    with pytest.raises(DeviceLost, match=says):
        driver.read_block()


@pytest.mark.parametrize(
    ("path", "says"),
    [
        ("", "expected package.module:name"),
        ("no_such_module:name", "cannot import no_such_module:name"),
        ("math:no_such_name", "cannot import math:no_such_name"),
        ("builtins:repr", "has no method advance"),
        ("math:sqrt", "failed"),
    ],
)
def test_what_cannot_be_made_says_so(path: str, says: str) -> None:
    with pytest.raises(DeviceError, match=says):
        imported(path).connect()
