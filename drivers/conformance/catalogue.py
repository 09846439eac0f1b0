"""List the checks: each is a function of a `Trial` with a docstring, listed by its name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from drivers.conformance.subject import Capabilities, DeviceUnderTest
from drivers.conformance.trial import Trial

Body = Callable[[Trial], None]

OUTPUTS: Final = "outputs"
TWO_JOINTS: Final = "two joints"
PROBE: Final = "probe of the outputs"
CUT: Final = "cut of the link"
SILENCE: Final = "silence of the host"
LATCH: Final = "latched trips"
FAULTS: Final = "faults of the wire"
LOSS: Final = "a fault that loses the device"
IDENTITY: Final = "refusal of other rigs"
SATURATION: Final = "a sensor at the end of its range"


@dataclass(frozen=True)
class ConformanceCheck:
    """One requirement of every driver.

    `needs` are the capabilities without which it is skipped; `moves` states whether it requests
    outputs other than zero.
    """

    name: str
    says: str
    needs: tuple[str, ...]
    moves: bool
    body: Body


_CHECKS: list[ConformanceCheck] = []


def described(body: Body) -> str:
    """Return a check's docstring in one line."""
    return " ".join((body.__doc__ or "").split())


def check(*needs: str, moves: bool = True) -> Callable[[Body], Body]:
    """List a function in the catalogue under its name, with its docstring as description."""

    def register(body: Body) -> Body:
        needed = (OUTPUTS, *needs) if moves else needs
        _CHECKS.append(ConformanceCheck(body.__name__, described(body), needed, moves, body))
        return body

    return register


def catalogue() -> tuple[ConformanceCheck, ...]:
    """Return every check whose module was imported."""
    return tuple(_CHECKS)


def lacking(check: ConformanceCheck, bench: DeviceUnderTest, claims: Capabilities) -> str | None:
    """Return the first capability that a check needs and a bench lacks, or None."""
    has = {
        OUTPUTS: claims.outputs,
        TWO_JOINTS: len(bench.rig.joints) > 1,
        PROBE: bench.outputs is not None,
        CUT: bench.cut is not None,
        SILENCE: bench.silence is not None,
        LATCH: claims.latches_trips,
        FAULTS: bench.spoil is not None and bool(bench.faults),
        LOSS: bench.spoil is not None and bool(bench.lost),
        IDENTITY: claims.refuses_other_rigs,
        SATURATION: bench.saturate is not None,
    }
    return next((need for need in check.needs if not has[need]), None)
