"""Proof of a queued item on the twin, in a separate process."""

from __future__ import annotations

from typing import Any

from rig.cli.errors import BAD_INPUT, WorkError
from rig.model.parse import InputError
from rig.queue.items import QueueJob
from rig.queue.processes import BRAMAH, call
from rig.queue.runner import QueueSettings

_KEPT = (
    "protocol",
    "rig",
    "seconds",
    "ok",
    "twin",
    "model",
    "warning",
)  # keys of the proof that the queue keeps; the pictures are omitted


def prove(job: QueueJob) -> dict[str, Any]:
    """Run `bramah check` on an item; raises InputError if refused, WorkError if check fails."""
    answer = call(BRAMAH, job.check_words(), QueueSettings().check_seconds)
    if answer.code == BAD_INPUT:
        raise InputError(f"not queued: {answer.reason}")
    if answer.code != 0:
        raise WorkError(f"not queued: {answer.reason}")
    proof = answer.as_json()
    return {key: proof[key] for key in _KEPT if isinstance(proof, dict) and key in proof}
