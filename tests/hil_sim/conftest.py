"""A device of either kind of time, fresh for every test."""

from __future__ import annotations

import pytest

from tests.hil_sim.device_bench import Bench


@pytest.fixture
def virtual() -> Bench:
    return Bench(realtime=False)


@pytest.fixture
def real() -> Bench:
    return Bench(realtime=True)
