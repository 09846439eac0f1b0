"""Provenance for repeating a run: command, files with checksums, overrides, seeds."""

from __future__ import annotations

import hashlib
import shlex
import sys
from dataclasses import asdict
from importlib import resources
from pathlib import Path
from typing import Any

from protocols.files.library import shipped_names
from protocols.files.plan import Overrides, Plan
from rig.runs.rigs import rig_text


def _file(text: str, source: str) -> dict[str, str]:
    return {"source": source, "sha256": hashlib.sha256(text.encode()).hexdigest()}


def _protocol_text(name: str) -> tuple[str, str]:
    if name in shipped_names():
        entry = resources.files("protocols") / "shipped" / f"{name}.yaml"
        return entry.read_text("utf-8"), f"{name}.yaml (shipped)"
    path = Path(name).absolute()
    return path.read_text("utf-8"), str(path)


def _seeds(plan: Plan) -> dict[str, int]:
    """Return the seeds of the played signals by step and joint."""
    return {
        f"{step.name} joint {excited.joint}": int(seed)
        for step in plan.protocol.excitations
        for excited in step.excite
        if (seed := getattr(excited.signal, "seed", None)) is not None
    }


def provenance_of(protocol: str, rig: str, overrides: Overrides, plan: Plan) -> dict[str, Any]:
    """Return the provenance of a run for its run.yaml."""
    text, source = rig_text(rig)
    changed = {k: v for k, v in asdict(overrides).items() if v != getattr(Overrides(), k)}
    return {
        "command": shlex.join(["bramah", *sys.argv[1:]]),
        "files": {"protocol": _file(*_protocol_text(protocol)), "rig": _file(text, source)},
        "overrides": {k: list(v) if isinstance(v, tuple) else v for k, v in changed.items()},
        "seeds": _seeds(plan),
    }
