"""A small part of the study `fuzz`: readers of damaged bytes refuse them, and nothing else."""

from __future__ import annotations

import logging
import random
from collections.abc import Iterator

import pytest

from tests.studies.fuzz.mutation import damaged
from tests.studies.fuzz.run import FuzzResult, cases, fuzz
from tests.studies.fuzz.targets import MAKERS, SHARES, Target

FEW = {"rig": 6, "protocol": 8, "scenario": 20, "journal": 5, "archive": 12}


@pytest.fixture(autouse=True)
def _quiet() -> Iterator[None]:
    logging.disable(logging.CRITICAL)
    yield
    logging.disable(logging.NOTSET)


@pytest.mark.parametrize("key", MAKERS)
@pytest.mark.filterwarnings("ignore")
def test_a_reader_of_damaged_bytes_refuses_them_or_reads_them(key: str) -> None:
    found = FuzzResult(key)
    cases(MAKERS[key](), FEW.get(key, 600), 1, found, lambda: None)
    assert not found.wrong
    assert found.cases == FEW.get(key, 600)


def test_the_shares_of_all_readers_are_the_whole() -> None:
    assert set(SHARES) == set(MAKERS)
    assert sum(SHARES.values()) == pytest.approx(1.0)


def test_damage_is_of_every_kind_and_the_same_by_its_seed() -> None:
    whole = bytes(range(40))
    found = {damaged(random.Random(seed), whole, [whole]) for seed in range(300)}
    assert len(found) > 250
    assert {len(data) > 40 for data in found} == {True, False}
    assert damaged(random.Random(7), whole, [whole]) == damaged(random.Random(7), whole, [whole])


def _leaky(data: bytes) -> None:
    if len(data) > 12:
        raise IndexError("beyond the end")


def test_an_error_that_nobody_expects_and_a_crash_are_found() -> None:
    found = FuzzResult("leaky")
    cases(Target("leaky", (b"0123456789",), _leaky, (ValueError,)), 200, 0, found, lambda: None)
    assert any(what.startswith("IndexError: beyond the end (case ") for what in found.wrong)
    assert found.cases == 200
    (wrong,) = fuzz("no such reader", 10, 0).wrong
    assert wrong.startswith("crash (1)")
