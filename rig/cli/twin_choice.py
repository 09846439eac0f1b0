"""Whose parameters the twin of a rig has: the last identified model's, a stated one's, nominal.

`identify --model`, `trace --model` and `loop` keep a copy of the model they write, one a rig, in
the folder that outlives a session (`rig.bench.latch.state_folder`). A proof on the twin takes it
where it belongs to the rig and is known well enough, and says so; otherwise it takes the nominal
values and warns. A model that was asked for by name is refused instead.
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
_SIMULATED = "simulated"  # in a model's provenance: whether a run of its was in virtual time
_HASH_SHOWN = 12  # digits of a checksum that people compare


@dataclass(frozen=True)
class TwinSource:
    """Where the twin's parameters come from: a model file, or none (nominal values).

    `shown` is what people call the file: a kept copy goes by the name it was written to.
    `simulated`: a run that it was identified from was in virtual time, so on a simulated bench.
    """

    path: Path | None = None
    asked: bool = False
    sha256: str = ""
    shown: str = ""
    saved: str = ""
    simulated: bool = False

    @property
    def key(self) -> str:
        """What a proof depends on."""
        return f"{self.sha256} {self.shown} {self.asked}" if self.path else "nominal"

    def as_dict(self) -> dict[str, Any] | None:
        """Return it as plain data for JSON, None for nominal values."""
        if self.path is None:
            return None
        return {
            "file": self.shown, "sha256": self.sha256, "saved": self.saved,
            "simulated": self.simulated,
        }  # fmt: skip


@dataclass(frozen=True)
class TwinParameters:
    """A twin ready to simulate: itself, its draws, the rig with its parameters as nominal ones.

    `text` says in a report whose parameters they are; `warning` why a model was not taken.
    """

    rig: Rig
    twin: Twin
    draws: Sequence[Twin]
    text: str
    warning: str = ""


def kept_model(rig: str) -> Path:
    """Return where the last identified model of a rig is kept, whether there is one or not."""
    readable = re.sub(r"[^A-Za-z0-9.-]", "_", rig)
    code = hashlib.sha256(rig.encode()).hexdigest()[:8]
    return state_folder() / _FOLDER / f"{readable}-{code}.json"


def twin_source(rig: Rig, model: Path | None = None, nominal: bool = False) -> TwinSource:
    """Return the model that the twin of a rig is to take; raises InputError for an unreadable file.

    `model` is a file that a person stated; `nominal` asks for the nominal values.
    """
    if model is not None and nominal:
        raise InputError("--model and --nominal exclude each other: state one of them")
    path = kept_model(rig.name) if model is None else model
    if nominal or (model is None and not path.exists()):
        return TwinSource()
    try:
        raw = path.read_bytes()
        changed = path.stat().st_mtime
    except OSError as error:
        raise InputError(f"cannot read the model file {path}: {error}") from error
    origin = _provenance(raw)
    saved = str(origin.get(_SAVED) or datetime.fromtimestamp(changed, UTC).isoformat())
    shown = str(model if model is not None else origin.get(_FILE) or path)
    code, simulated = hashlib.sha256(raw).hexdigest(), origin.get(_SIMULATED) is True
    return TwinSource(path, model is not None, code, shown, saved, simulated)


def _provenance(raw: bytes) -> Mapping[str, Any]:
    try:
        provenance = json.loads(raw)["provenance"]
    except (ValueError, KeyError, TypeError, RecursionError):
        return {}  # what is wrong with the file is said when it is loaded as a model
    return provenance if isinstance(provenance, dict) else {}


def source_text(source: TwinSource, now: datetime | None = None) -> str:
    """Say in a sentence which model a source is, and how old."""
    if source.path is None:
        return "the nominal values of the rig file"
    which = "model" if source.asked else "last identified model"
    of = "of a SIMULATED bench, " if source.simulated else ""
    return (
        f"the {which} {source.shown} ({of}{_age_text(source.saved, now)} old, SHA-256 "
        f"{source.sha256[:_HASH_SHOWN]})"
    )


def _age_text(saved: str, now: datetime | None = None) -> str:
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

    Raises InputError for a stated model that cannot serve; a kept one that cannot is left for the
    nominal values, with a warning.
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
    if reason and source.asked:
        raise InputError(f"{source.shown} cannot be the twin of rig {rig.name!r}: {reason}")
    if reason:
        warning = (
            f"the last identified model {source.shown} is not used, {reason}; the twin has the "
            "nominal values of the rig file"
        )
        return replace(nominal, warning=warning)
    return _twin_of(model, rig, source)


def _twin_of(model: Model, rig: Rig, source: TwinSource) -> TwinParameters:
    import numpy as np

    from analysis.simulation.model_draws import model_draws
    from analysis.simulation.settings import SIMULATION
    from analysis.simulation.twin import simulate_commands

    # The model's rig is the same physics; limits, wire and rate are those of today's file.
    here = replace(model, rig=rig)
    rng = np.random.default_rng(SIMULATION.twin_seed)
    draws = model_draws(here, SIMULATION.twin_draws, rng)
    return TwinParameters(
        rig.model_copy(update={"nominal": {**rig.nominal, **model.values}}),
        partial(simulate_commands, model=here),
        tuple(partial(simulate_commands, model=draw) for draw in draws),
        f"model {source.shown}",
    )


def _in_virtual_time(runs: Iterable[str]) -> bool:
    """Whether any of the runs was taken from a device in virtual time; unknown ones count as no."""
    from rig.runs.store import read_header

    for folder in runs:
        with suppress(InputError):
            if read_header(Path(folder)).virtual_time:
                return True
    return False


def save_identified(model: Model, path: Path, say: Callable[[str], None]) -> None:
    """Write a model file and keep a copy as the last identified model of its rig.

    `say` hears whether the copy was kept, or why not (the model before it then stays).
    """
    from analysis.simulation.model import save_model
    from analysis.simulation.model_draws import unusable

    origin = {
        _SAVED: datetime.now(UTC).isoformat(timespec="seconds"),
        _FILE: str(path.absolute()),
        _SIMULATED: _in_virtual_time(model.provenance.get("runs", ())),
    }
    dated = replace(model, provenance={**model.provenance, **origin})
    save_model(dated, path)
    if model.rig.electric:
        return  # no twin of an electric rig is checked
    reason = unusable(model, model.rig)
    if reason:
        say(f"note: {path} does not become the model that check and run prove on: {reason}")
        return
    kept = kept_model(model.rig.name)
    try:
        kept.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        save_model(dated, kept)
    except OSError as error:
        say(f"note: {path} could not be kept for check and run ({kept}: {error.strerror})")
        return
    say(f"check and run of rig {model.rig.name} are proved on {path} from now on (not: --nominal)")
