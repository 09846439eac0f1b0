"""Run the checks and return named results, each with a reason in one line."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from drivers.base import DeviceError
from drivers.conformance import fault_checks, output_checks, session_checks
from drivers.conformance.catalogue import ConformanceCheck, catalogue, described, lacking
from drivers.conformance.random_calls import RandomCallBudget, try_random_calls
from drivers.conformance.subject import Subject
from drivers.conformance.trial import Trial
from drivers.conformance.watched import NotConforming, Skipped

logger = logging.getLogger(__name__)

MODULES: Final = (session_checks, output_checks, fault_checks)


class CheckVerdict(StrEnum):
    """The result of one check."""

    PASSED = "passed"
    FAILED = "failed"
    SKIPPED = "skipped"


@dataclass(frozen=True)
class Result:
    """One check's verdict; `reason` states in one line why it failed or was skipped."""

    check: str
    verdict: CheckVerdict
    reason: str = ""


@dataclass(frozen=True)
class ConformanceReport:
    """The results of every check run on a subject."""

    subject: str
    results: tuple[Result, ...]

    def of(self, verdict: CheckVerdict) -> tuple[Result, ...]:
        """Return the results of one verdict."""
        return tuple(result for result in self.results if result.verdict == verdict)


def random_calls(trial: Trial) -> None:
    """Random sequences of every call, losses and faults among them: ticks rise, samples follow
    the law, and after zero, close or an error the outputs are zero."""
    try_random_calls(trial.subject, RandomCallBudget())


RANDOM_CALLS: Final = ConformanceCheck(
    "random_calls", described(random_calls), (), True, random_calls
)


def all_checks() -> tuple[ConformanceCheck, ...]:
    """Return every check: of sessions, outputs and faults; the random calls last."""
    order = [module.__name__ for module in MODULES]
    known = [check for check in catalogue() if check.body.__module__ in order]
    return (*sorted(known, key=lambda check: order.index(check.body.__module__)), RANDOM_CALLS)


def run_check(
    check: ConformanceCheck, subject: Subject, effort: RandomCallBudget | None = None
) -> Result:
    """Run one check on a fresh bench of the subject; never raises for the driver's errors."""
    try:
        if check is RANDOM_CALLS:
            try_random_calls(subject, effort or RandomCallBudget())
        else:
            with subject.make() as bench:
                need = lacking(check, bench, subject.capabilities)
                if need is not None:
                    raise Skipped(f"not claimed: {need}")
                _run_on(check, Trial(subject, bench))
    except Skipped as skipped:
        return Result(check.name, CheckVerdict.SKIPPED, str(skipped))
    except NotConforming as error:
        return Result(check.name, CheckVerdict.FAILED, _line(str(error)))
    except DeviceError as error:
        text = f"unexpected {type(error).__name__}: {error}"
        return Result(check.name, CheckVerdict.FAILED, _line(text))
    logger.debug("%s: %s passed", subject.name, check.name)
    return Result(check.name, CheckVerdict.PASSED)


def _run_on(check: ConformanceCheck, trial: Trial) -> None:
    try:
        check.body(trial)
    except BaseException:
        # Report the first failure; a driver that fails may also fail to close.
        try:
            trial.end()
        except NotConforming as error:
            logger.debug("after %s: %s", check.name, error)
        raise
    trial.end()


def _line(text: str) -> str:
    return " ".join(text.split())


def run(
    subject: Subject,
    *,
    only: Sequence[str] = (),
    outputs: bool = True,
    effort: RandomCallBudget | None = None,
    until_failure: bool = False,
) -> ConformanceReport:
    """Run the checks on a subject and return their results.

    `only` names checks to run instead of all; `outputs` False omits checks that request outputs
    other than zero; `until_failure` ends at the first failure. Raises ValueError for a name that no
    check has.
    """
    known = {check.name: check for check in all_checks()}
    for name in only:
        if name not in known:
            raise ValueError(f"no check is called {name!r}; there are: {' '.join(known)}")
    results: list[Result] = []
    for check in known.values():
        if only and check.name not in only:
            continue
        if check.moves and not outputs:
            cause = "asks for outputs other than zero"
            results.append(Result(check.name, CheckVerdict.SKIPPED, cause))
            continue
        results.append(run_check(check, subject, effort))
        if until_failure and results[-1].verdict == CheckVerdict.FAILED:
            break
    return ConformanceReport(subject.name, tuple(results))
