"""What every driver must do, on any wire, as checks that anybody can run (docs/conformance.md)."""

from drivers.conformance.catalogue import Check
from drivers.conformance.live import live_subject
from drivers.conformance.random_calls import Effort
from drivers.conformance.runner import Report, Result, Verdict, all_checks, run, run_check
from drivers.conformance.subject import HEALTHY, Bench, Capabilities, Subject
from drivers.conformance.watched import NotConforming

__all__ = [
    "HEALTHY",
    "Bench",
    "Capabilities",
    "Check",
    "Effort",
    "NotConforming",
    "Report",
    "Result",
    "Subject",
    "Verdict",
    "all_checks",
    "live_subject",
    "run",
    "run_check",
]
