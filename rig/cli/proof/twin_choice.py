"""Choose the twin's parameters: the last identified model, a given model file, or nominal.

`identify --model`, `trace --model` and `loop` keep a copy of their model, one per rig, in the
persistent folder `rig.bench.latch.state_folder`. A proof uses this model if it fits the rig and
determines the parameters well enough; otherwise it uses the nominal values and warns. A model file
given by the user is refused instead.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rig.bench.latch import state_folder
from rig.model.parse import InputError
from rig.model.rig import Rig

if TYPE_CHECKING:
    from analysis.simulation.model import Model
    from protocols.design.check import Twin

_FOLDER = "models"
_SAVED = "saved"  # in a model's provenance: when its file was written
_FILE = "file"  # in a model's provenance: where to
_SIMULATED = "simulated"  # in a model's provenance: whether any of its runs was in virtual time
_HASH_SHOWN = 12  # digits of a checksum shown to people


@dataclass(frozen=True)
class TwinSource:
    """Source of the twin's parameters: a model file, or none (nominal values).

    `from_user`: the file was given as an option, not kept by `save_identified`. `shown`: its name
    in messages; for a kept copy, that of the original. `simulated`: one of the model's runs was in
    virtual time, so on a simulated bench.
    """

    path: Path | None = None
    from_user: bool = False
    sha256: str = ""
    shown: str = ""
    saved: str = ""
    simulated: bool = False

    @property
    def key(self) -> str:
        """The text of the source in the key of a proof."""
        return f"{self.sha256} {self.shown} {self.from_user}" if self.path else "nominal"

    def as_dict(self) -> dict[str, Any] | None:
        """Return the source as plain data for JSON, None for nominal values."""
        if self.path is None:
            return None
        return {
            "file": self.shown, "sha256": self.sha256, "saved": self.saved,
            "simulated": self.simulated,
        }  # fmt: skip


@dataclass(frozen=True)
class TwinParameters:
    """The twin, its draws of parameters, and the rig with the twin's parameters as nominal ones.

    `text`: the source of the parameters, for reports. `warning`: why a model was not used.
    """

    rig: Rig
    twin: Twin
    draws: Sequence[Twin]
    text: str
    warning: str = ""


def last_model_path(rig: str) -> Path:
    """Return the path of a rig's last identified model, which may not exist."""
    readable = re.sub(r"[^A-Za-z0-9.-]", "_", rig)
    code = hashlib.sha256(rig.encode()).hexdigest()[:8]
    return state_folder() / _FOLDER / f"{readable}-{code}.json"


def twin_source(rig: Rig, model: Path | None = None, nominal: bool = False) -> TwinSource:
    """Return the source of the twin's parameters; raises InputError for an unreadable file.

    `model`: a file given by the user. `nominal`: use the nominal values.
    """
    if model is not None and nominal:
        raise InputError("--model and --nominal exclude each other: expected one of them")
    path = last_model_path(rig.name) if model is None else model
    if nominal or (model is None and not path.exists()):
        return TwinSource()
    try:
        raw = path.read_bytes()
        changed = path.stat().st_mtime
    except OSError as error:
        raise InputError(f"cannot read the model file {path}: {error}") from error
    provenance = _provenance_of(raw)
    saved = str(provenance.get(_SAVED) or datetime.fromtimestamp(changed, UTC).isoformat())
    shown = str(model if model is not None else provenance.get(_FILE) or path)
    code, simulated = hashlib.sha256(raw).hexdigest(), provenance.get(_SIMULATED) is True
    return TwinSource(path, model is not None, code, shown, saved, simulated)


def _provenance_of(raw: bytes) -> Mapping[str, Any]:
    try:
        provenance = json.loads(raw)["provenance"]
    except (ValueError, KeyError, TypeError, RecursionError):
        return {}  # loading it as a model reports what is wrong with the file
    return provenance if isinstance(provenance, dict) else {}


def source_text(source: TwinSource, now: datetime | None = None) -> str:
    """Return the source and the age of its model in words."""
    if source.path is None:
        return "the nominal values of the rig file"
    what = "model" if source.from_user else "last identified model"
    kind = "of a SIMULATED bench, " if source.simulated else ""
    return (
        f"the {what} {source.shown} ({kind}{_age_text(source.saved, now)} old, SHA-256 "
        f"{source.sha256[:_HASH_SHOWN]})"
    )


def twin_text(source: TwinSource, warning: str = "") -> str:
    """Return the source of the twin's parameters, or why it uses nominal values instead."""
    if warning:
        return f"WARNING: {warning}"
    note = "" if source.path is None else "; limits hold at the edge of its 95 % intervals"
    return f"the twin uses {source_text(source)}{note}"


def _age_text(saved: str, now: datetime | None) -> str:
    try:
        written = datetime.fromisoformat(saved)
        seconds = ((now or datetime.now(UTC)) - written).total_seconds()
    except (ValueError, TypeError):
        return "of unknown age, perhaps"
    for size, unit in ((86400.0, "days"), (3600.0, "h"), (60.0, "min")):
        if seconds >= 2.0 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{max(seconds, 0.0):.0f} s"


def load_twin(source: TwinSource, rig: Rig) -> TwinParameters:
    """Load the twin of a rig from its source.

    Raises InputError for a given model that cannot be used; a kept model that cannot be used is
    replaced by the nominal values, with a warning.
    """
    from analysis.simulation.twin import simulate_commands

    nominal = TwinParameters(rig, simulate_commands, (), "nominal values")
    if source.path is None:
        return nominal
    from analysis.simulation.model import load_model
    from analysis.simulation.model_draws import unusable

    try:
        model = load_model(source.path)
        reason = unusable(model, rig)
    except InputError as error:
        reason = str(error)
    if reason and source.from_user:
        raise InputError(f"{source.shown} cannot be the twin of rig {rig.name!r}: {reason}")
    if reason:
        warning = (
            f"the last identified model {source.shown} is not used, {reason}; the twin uses the "
            "nominal values of the rig file"
        )
        return replace(nominal, warning=warning)
    return _twin_of(model, rig, source)


def _twin_of(model: Model, rig: Rig, source: TwinSource) -> TwinParameters:
    import numpy as np

    from analysis.simulation.model_draws import model_draws
    from analysis.simulation.settings import SIMULATION
    from analysis.simulation.twin import simulate_commands

    # The physics is that of the model's rig; limits, wire and rate are those of the rig file.
    of_rig = replace(model, rig=rig)
    rng = np.random.default_rng(SIMULATION.twin_seed)
    draws = model_draws(of_rig, SIMULATION.twin_draws, rng)
    return TwinParameters(
        rig.model_copy(update={"nominal": {**rig.nominal, **model.values}}),
        partial(simulate_commands, model=of_rig),
        tuple(partial(simulate_commands, model=draw) for draw in draws),
        f"model {source.shown}",
    )


def _in_virtual_time(runs: Iterable[str]) -> bool:
    """Return whether any run was recorded in virtual time; an unreadable run counts as no."""
    from rig.runs.store import read_header

    for folder in runs:
        with suppress(InputError):
            if read_header(Path(folder)).virtual_time:
                return True
    return False


def write_identified(model: Model, path: Path) -> Model:
    """Write a model file; returns the model as written, with when, where and from what runs."""
    from analysis.simulation.model import save_model

    origin = {
        _SAVED: datetime.now(UTC).isoformat(timespec="seconds"),
        _FILE: str(path.absolute()),
        _SIMULATED: _in_virtual_time(model.provenance.get("runs", ())),
    }
    dated = replace(model, provenance={**model.provenance, **origin})
    save_model(dated, path)
    return dated


def save_identified(model: Model, path: Path, say: Callable[[str], None]) -> None:
    """Write a model file and keep a copy as the last identified model of its rig.

    `say` receives whether the copy was kept, or why not; then the earlier copy remains.
    """
    from analysis.simulation.model import save_model
    from analysis.simulation.model_draws import unusable

    dated = write_identified(model, path)
    if model.rig.electric:
        return  # electric rigs are not checked on a twin
    reason = unusable(model, model.rig)
    if reason:
        say(f"note: {path} is not used by check and run: {reason}")
        return
    copy_path = last_model_path(model.rig.name)
    try:
        copy_path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        save_model(dated, copy_path)
    except OSError as error:
        say(f"note: {path} could not be stored for check and run ({copy_path}: {error.strerror})")
        return
    say(f"check and run of rig {model.rig.name} now use {path} for the twin (unless --nominal)")
