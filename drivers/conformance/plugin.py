"""A pytest plugin: a test that takes `conformance_check` runs once per check.

In a test module, with `SUBJECT` (or `SUBJECTS`) one or several `drivers.conformance.Subject`:

    pytest_plugins = ["drivers.conformance.plugin"]

    def test_conformance(conformance_check):
        conformance_check()
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from drivers.conformance.catalogue import ConformanceCheck
from drivers.conformance.runner import CheckVerdict, all_checks, run_check
from drivers.conformance.subject import Subject

FIXTURE = "conformance_check"


def pytest_generate_tests(metafunc: Any) -> None:
    """Make one test of each check for each subject of the module; ValueError without any."""
    if FIXTURE not in metafunc.fixturenames:
        return
    declared = getattr(metafunc.module, "SUBJECT", None)
    subjects: tuple[Subject, ...] = (declared,) if declared is not None else ()
    subjects = (*subjects, *getattr(metafunc.module, "SUBJECTS", ()))
    if not subjects:
        raise ValueError(f"{metafunc.module.__name__}: {FIXTURE} needs SUBJECT or SUBJECTS")
    cases: dict[str, Callable[[], None]] = {
        f"{subject.name}-{check.name}": partial(_assert_passes, check, subject)
        for subject in subjects
        for check in all_checks()
    }
    metafunc.parametrize(FIXTURE, list(cases.values()), ids=list(cases))


def _assert_passes(check: ConformanceCheck, subject: Subject) -> None:
    """Run one check; fails or skips the test with the reason."""
    import pytest  # noqa: PLC0415 - a dependency of development only

    result = run_check(check, subject)
    if result.verdict == CheckVerdict.SKIPPED:
        pytest.skip(result.reason)
    if result.verdict == CheckVerdict.FAILED:
        pytest.fail(f"{subject.name}: {check.says} {result.reason}", pytrace=False)
