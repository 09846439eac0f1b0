"""Why a protocol ends early; the bench zeroes the outputs on any of them."""

from __future__ import annotations


class ProtocolAborted(Exception):
    """The bench did not do what the step needs; the message names joint, measured, expected."""


class LockFailed(ProtocolAborted):
    """A joint that was to stand still did not; `joint` is 1-based, lengths in m."""

    def __init__(self, step: str, joint: int, what: str, measured: float, expected: str) -> None:
        self.step = step
        self.joint = joint
        self.measured = measured
        self.expected = expected
        super().__init__(
            f"lock failed in {step}: joint {joint} {what}: piston measured at "
            f"{1e3 * measured:.2f} mm, expected {expected}"
        )


class RunEnded(ProtocolAborted):
    """A person, or what stands for one, ended the run; no rule of the protocol goes on after it."""
