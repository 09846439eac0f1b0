"""Requirements of every driver, on any wire, as executable checks (docs/conformance.md)."""

from drivers.conformance.catalogue import ConformanceCheck
from drivers.conformance.random_calls import RandomCallBudget
from drivers.conformance.runner import (
    CheckVerdict,
    ConformanceReport,
    Result,
    all_checks,
    run,
    run_check,
)
from drivers.conformance.subject import (
    HEALTHY,
    Capabilities,
    DeviceUnderTest,
    Subject,
    live_subject,
)
from drivers.conformance.watched import NotConforming

__all__ = [
    "HEALTHY",
    "Capabilities",
    "CheckVerdict",
    "ConformanceCheck",
    "ConformanceReport",
    "DeviceUnderTest",
    "NotConforming",
    "RandomCallBudget",
    "Result",
    "Subject",
    "all_checks",
    "live_subject",
    "run",
    "run_check",
]
