"""Proofs of plans on the twin, cached so that an unchanged plan is not simulated again.

The key of a proof is the hash of everything that it depends on: the resolved protocol, the rig, the
model with the twin's parameters, the source code of the twin and of the check, and the versions of
their libraries. A proof is kept in the user's cache folder and with each run.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

from protocols.design.check_report import CheckReport
from protocols.files.plan import Plan
from protocols.steps.plans import StepPlan
from rig.cli.proof.twin_choice import TwinParameters, TwinSource, load_twin, twin_source, twin_text
from rig.cli.text.output import write_json
from rig.model.parse import InputError
from rig.model.rig import Rig
from rig.runs.files import cache_folder
from rig.runs.store import PROOF

Progress = Callable[[float], None]
CACHE_SIZE = 200  # largest number of proofs; the oldest are removed
_ROOT = Path(__file__).parents[3]
_SOURCES = (
    "analysis/signals", "analysis/simulation", "analysis/terms", "analysis/regression",
    "analysis/identify", "analysis/design", "protocols/design", "protocols/files",
    "protocols/language", "protocols/signals", "protocols/steps", "protocols/engine/centring.py",
    "rig/model", "rig/cli/proof/predicted_errors.py", "rig/cli/proof/twin_choice.py",
    "analysis/effects",
)  # fmt: skip
_LIBRARIES = ("numpy", "scipy", "numba")


@dataclass(frozen=True)
class PlanProof:
    """Result of a plan's check on the twin; `prediction` and its `text` are from the analysis.

    `source`: intended source of the twin's parameters. `warning`: why it was not used.
    """

    key: str
    report: CheckReport
    prediction: Mapping[str, Any] | None = None
    text: str = ""
    source: TwinSource = field(default_factory=TwinSource)
    warning: str = ""
    reused: bool = False

    def as_dict(self) -> dict[str, Any]:
        """Return the proof as JSON data."""
        return {
            "key": self.key,
            "report": self.report.as_dict(),
            "prediction": self.prediction,
            "text": self.text,
            "model": self.source.as_dict(),
            "warning": self.warning,
        }

    @property
    def twin_text(self) -> str:
        """Return the source of the twin's parameters, or why it uses nominal values instead."""
        return twin_text(self.source, self.warning)

    def keep(self, folder: Path) -> None:
        """Write the proof into a run's folder."""
        write_json(folder / PROOF, self.as_dict())


def proved(
    plan: Plan,
    rig: Rig,
    *,
    predict: bool = False,
    progress: Progress | None = None,
    source: TwinSource | None = None,
) -> PlanProof:
    """Return the proof of a plan, from the cache if nothing changed.

    `predict` adds the predicted standard errors; `progress` receives the share done; `source` is
    the source of the twin's parameters (default: the last identified model of the rig). Raises
    InputError if the twin cannot follow the plan. The report states whether limits are kept.
    """
    source = twin_source(rig) if source is None else source
    key = proof_key(plan, rig, source)
    cached = _from_cache(key)
    if cached is not None and (cached.text or not predict):
        return replace(cached, source=source, report=replace(cached.report, places=plan.places))
    parameters = load_twin(source, rig)
    from protocols.design.check import NotCentred
    from protocols.design.check_report import remedy_text

    try:
        report, prediction, text = _checked(plan, parameters, predict, progress)
    except NotCentred as refused:
        scale = _passing_scale(refused.step, parameters)
        remedy = remedy_text(scale)
        raise InputError(f"{refused}; {remedy}; the twin uses {parameters.text}") from refused
    if not report.ok:
        refused_steps = {check.step for check in report.steps if not check.ok}
        scales = {
            step.name: _passing_scale(step, parameters)
            for step in plan.excitations
            if step.name in refused_steps
        }
        report = replace(report, scales=scales)
    report = replace(report, twin=parameters.text)
    proof = PlanProof(key, report, prediction, text, source, parameters.warning)
    _to_cache(proof)
    return proof


def _checked(
    plan: Plan, parameters: TwinParameters, predict: bool, progress: Progress | None
) -> tuple[CheckReport, Mapping[str, Any] | None, str]:
    if predict:
        from rig.cli.proof.predicted_errors import of_plan, prediction_json, prediction_text

        forecast = of_plan(plan, parameters, progress)
        return forecast.limits, prediction_json(forecast), prediction_text(forecast)
    from protocols.design.check import check

    report = check(plan, parameters.rig, parameters.twin, progress, parameters.draws)
    return report, None, ""


def _passing_scale(step: StepPlan, parameters: TwinParameters) -> float | None:
    from protocols.design.check import passing_scale

    return passing_scale(step, parameters.rig, parameters.twin, parameters.draws)


def proof_key(plan: Plan, rig: Rig, source: TwinSource) -> str:
    """Return the SHA-256 hash of everything that a proof depends on."""
    parts = (
        plan.protocol.model_dump_json(),
        rig.model_dump_json(exclude={"wire"}),
        f"{rig.wire.kind} {rig.wire.jitter}",  # whether the host times the samples, and its jitter
        source.key,
        _source_digest(),
    )
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()


@cache
def _source_digest() -> str:
    digest = hashlib.sha256()
    for source in _SOURCES:
        for path in sorted((_ROOT / source).rglob("*.py")) or [_ROOT / source]:
            digest.update(path.read_bytes())
    for library in _LIBRARIES:
        digest.update(f"{library} {metadata.version(library)}".encode())
    return digest.hexdigest()


def _from_cache(key: str) -> PlanProof | None:
    path = cache_folder() / "proofs" / f"{key}.json"
    try:
        data = json.loads(path.read_text("utf-8"))
        report = CheckReport.from_dict(data["report"])
        if data["key"] != key:
            return None
        return PlanProof(
            key, report, data["prediction"], data["text"], warning=data["warning"], reused=True
        )
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _to_cache(proof: PlanProof) -> None:
    folder = cache_folder() / "proofs"
    with suppress(OSError):  # without the cache the plan is proved again next time
        write_json(folder / f"{proof.key}.json", proof.as_dict())
        proofs = sorted(folder.glob("*.json"), key=lambda path: path.stat().st_mtime)
        for old in proofs[:-CACHE_SIZE]:
            old.unlink(missing_ok=True)
