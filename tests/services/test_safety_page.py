"""The page on safety says what the guard does, check by check."""

from __future__ import annotations

import re
from pathlib import Path

from rig.bench import guard
from rig.bench.checks.catalogue import catalogue, page
from rig.model import trips
from rig.model.alarms.bands import CheckActions

DOCS = Path(__file__).parents[2] / "docs"


def test_the_table_of_checks_is_that_of_the_guard() -> None:
    """To renew it: print `rig.bench.checks.catalogue.page()` into docs/safety.md."""
    assert page() in (DOCS / "safety.md").read_text()


def test_every_check_has_words_and_every_action_a_check() -> None:
    named = [text.limit for text in catalogue()]
    assert len(set(named)) == len(named)
    constants = {v for k, v in vars(trips).items() if k.isupper() and isinstance(v, str)}
    assert constants <= set(named)
    assert set(guard.ACTIONS.values()) == set(CheckActions.model_fields)
    acts = {text.key.removeprefix("checks."): text.acts for text in catalogue()}
    for key, action in CheckActions().model_dump().items():
        assert acts[key] == {"trip": "trip", "warn": "warning"}[action]
    for text in catalogue():
        assert re.match(r"[A-Z].*[.]$", text.sentence)
        assert re.match(r"[A-Z].*[.]$", text.remedy)
