"""The parameters that a set of steps is proven to determine, and why each step is included."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from protocols.engine.centring import Array


class ProofPart(Protocol):
    """A combination of parameters that can be distinguished from the others."""

    @property
    def text(self) -> str:
        """The combination as text."""


class Verdict(Protocol):
    """What rows determine, as `analysis.regression.identifiability.Determinacy`."""

    @property
    def names(self) -> tuple[str, ...]:
        """The parameters of the family."""

    @property
    def rank(self) -> int:
        """Rank of the rows."""

    @property
    def condition(self) -> float:
        """Condition number of the rows with unit columns."""

    @property
    def identified(self) -> tuple[str, ...]:
        """Parameters determined individually."""

    @property
    def undetermined(self) -> tuple[str, ...]:
        """Parameters not determined individually."""

    @property
    def base(self) -> Sequence[ProofPart]:
        """Combinations of undetermined parameters that are determined."""

    @property
    def complete(self) -> bool:
        """Whether every parameter is determined."""


Verdicts = Mapping[str, Verdict]
Triangles = Mapping[str, Array]  # family -> triangle of a step's rows


def complete(verdicts: Verdicts) -> bool:
    """Return whether every parameter of every family is determined."""
    return all(verdict.complete for verdict in verdicts.values())


@dataclass(frozen=True)
class Reason:
    """Why a step is in the set: its contribution in words, and the verdicts once it is added."""

    step: str
    description: str
    why: str
    verdicts: Verdicts


@dataclass(frozen=True)
class Proof:
    """What the steps of a protocol determine on the twin of a rig.

    `help` are further steps, in words, that would determine the undetermined parameters.
    """

    protocol: str
    rig: str
    reasons: tuple[Reason, ...]
    verdicts: Verdicts
    help: tuple[str, ...] = ()

    @property
    def complete(self) -> bool:
        """Whether every parameter of every family is determined."""
        return complete(self.verdicts)

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain data for JSON."""
        return {
            "protocol": self.protocol,
            "rig": self.rig,
            "complete": self.complete,
            "families": {name: _verdict_data(verdict) for name, verdict in self.verdicts.items()},
            "steps": [
                {
                    "step": reason.step,
                    "does": reason.description,
                    "why": reason.why,
                    "rank": {name: v.rank for name, v in reason.verdicts.items()},
                    "condition_number": {name: v.condition for name, v in reason.verdicts.items()},
                }
                for reason in self.reasons
            ],
            "help": list(self.help),
        }


def _verdict_data(verdict: Verdict) -> dict[str, Any]:
    return {
        "parameters": list(verdict.names),
        "rank": verdict.rank,
        "condition_number": verdict.condition,
        "complete": verdict.complete,
        "not_identifiable": list(verdict.undetermined),
        "base_parameters": [part.text for part in verdict.base],
    }
