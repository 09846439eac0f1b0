"""The identified model as data and as a file: rig, terms with shapes, parameters, provenance.

The file is JSON, SI throughout, `null` where a parameter could not be identified.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from analysis.effects.base import shapes_of
from analysis.terms import baseline_of, make
from analysis.terms.base import Used
from rig.model.parse import InputError, first_problem
from rig.model.rig import Rig
from rig.runs.files import read_text, write_text

Array = NDArray[np.float64]

FORMAT: Final = "bramah-model"
VERSION: Final = 1
_DIFFERENCES_LISTED: Final = 3  # of two rigs, in a message
_MOST_BYTES: Final = 1 << 26  # of a model file; nine joints with curves have far fewer


@dataclass(frozen=True)
class Estimate:
    """One parameter: SI value, standard error and 95 % interval; NaN where not identifiable."""

    value: float
    unit: str
    std: float
    ci95: tuple[float, float]
    note: str = ""

    @property
    def half(self) -> float:
        """Half the width of the 95 % interval."""
        return 0.5 * (self.ci95[1] - self.ci95[0])

    @property
    def identified(self) -> bool:
        """Whether the records determine the parameter."""
        return math.isfinite(self.value)


@dataclass(frozen=True)
class Model:
    """A rig, the terms that describe it, their parameters and their provenance.

    `covariance` (k, k) belongs to `parameters` in their order; NaN where unknown.
    """

    rig: Rig
    terms: tuple[Used, ...]
    parameters: Mapping[str, Estimate]
    covariance: Array
    provenance: Mapping[str, Any] = field(default_factory=dict)

    @property
    def values(self) -> dict[str, float]:
        """Parameter values by name."""
        return {name: p.value for name, p in self.parameters.items()}


def nominal_model(rig: Rig, terms: Sequence[Used] | None = None) -> Model:
    """Return the model of the rig's nominal values; raises InputError where one is missing.

    Its terms are the rig's baseline by default.
    """
    terms = tuple(map(Used, baseline_of(rig))) if terms is None else terms
    for used in terms:
        for c in used.term.parameters(rig):
            if c.parameter not in rig.nominal:
                raise InputError(
                    f"rig {rig.name!r} has no nominal {c.parameter!r} [{c.unit}]; without it "
                    "nothing can be simulated or predicted: add it under 'nominal' in the rig file"
                )
    return replace(model_of(rig, terms, rig.nominal), provenance={"source": "nominal"})


def model_of(rig: Rig, terms: Sequence[Used], values: Mapping[str, float]) -> Model:
    """Return a model from parameter values without intervals; parameters not given are left out."""
    parameters = {
        c.parameter: Estimate(values[c.parameter], c.unit, math.nan, (math.nan, math.nan))
        for used in terms
        for c in used.term.parameters(rig)
        if c.parameter in values
    }
    k = len(parameters)
    return Model(rig, tuple(terms), parameters, np.full((k, k), np.nan))


def as_loaded(model: Model, loaded: bool | None) -> Model:
    """Return the model of a record: without its load where the record is known to have none."""
    of_load = [u.term for u in model.terms if getattr(u.term, "element", "") == "load"]
    names = {c.parameter for term in of_load for c in term.parameters(model.rig)}
    if loaded is not False or not names:
        return model
    parameters = {
        name: replace(p, value=0.0) if name in names else p for name, p in model.parameters.items()
    }
    return replace(model, parameters=parameters)


def finite(value: float) -> float | None:
    """Return the number, or None if it is not finite (JSON has no such number)."""
    return float(value) if math.isfinite(value) else None


def estimate_json(estimate: Estimate) -> dict[str, Any]:
    """Return one parameter as JSON data, with `note` if there is one."""
    out: dict[str, Any] = {
        "value": finite(estimate.value),
        "unit": estimate.unit,
        "std": finite(estimate.std),
        "ci95": [finite(end) for end in estimate.ci95],
    }
    return out | ({"note": estimate.note} if estimate.note else {})


def model_json(model: Model) -> dict[str, Any]:
    """Return the whole model as plain JSON data."""
    return {
        "format": FORMAT,
        "version": VERSION,
        "rig": model.rig.model_dump(mode="json"),
        "terms": [
            {
                "name": u.term.name,
                "where": u.term.where,
                "shape": list(u.shape),
                "shape_parameters": {
                    s.parameter: {"value": v, "unit": s.unit}
                    for s, v in zip(shapes_of(model.rig, u), u.shape, strict=True)
                },
            }
            for u in model.terms
        ],
        "parameters": {name: estimate_json(p) for name, p in model.parameters.items()},
        "covariance": [[finite(v) for v in row] for row in model.covariance],
        "provenance": dict(model.provenance),
    }


def save_model(model: Model, path: str | Path) -> None:
    """Write the model file, replacing an old one only when the new one is complete."""
    text = json.dumps(model_json(model), indent=1, allow_nan=False)
    write_text(Path(path), text + "\n")


def load_model(path: str | Path) -> Model:
    """Read a model file; raises InputError naming the fault."""
    path = Path(path)
    try:
        data = json.loads(read_text(path, "a model file", limit=_MOST_BYTES))
    except (json.JSONDecodeError, RecursionError) as error:
        raise InputError(f"{path} is not a model file: not valid JSON ({error})") from error
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise InputError(f"{path} is not a model file: 'format' is not {FORMAT!r}")
    if data.get("version") != VERSION:
        raise InputError(
            f"{path} is a model file of version {data.get('version')!r}; this version reads "
            f"{VERSION}: identify again"
        )
    try:
        return _from_json(data)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except ValidationError as error:
        raise InputError(f"{path}: rig.{first_problem(error)}") from error
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{path} is damaged: {type(error).__name__} at {error}") from error


def _number(value: Any) -> float:
    return math.nan if value is None else float(value)


def _from_json(data: Mapping[str, Any]) -> Model:
    rig = Rig.model_validate(data["rig"])
    terms = tuple(
        Used(make(t["name"], t["where"]), tuple(float(v) for v in t["shape"]))
        for t in data["terms"]
    )
    parameters = {}
    for name, p in data["parameters"].items():
        low, high = p["ci95"]
        parameters[name] = Estimate(
            _number(p["value"]), str(p["unit"]), _number(p["std"]),
            (_number(low), _number(high)), str(p.get("note", "")),
        )  # fmt: skip
    for used in terms:
        for c in used.term.parameters(rig):
            if c.parameter not in parameters:
                raise InputError(f"parameters: {c.parameter!r} of {used.term.name!r} is missing")
    covariance = np.array([[_number(v) for v in row] for row in data["covariance"]])
    if covariance.shape != (len(parameters), len(parameters)):
        raise InputError(
            f"covariance: shape {covariance.shape}, expected that of {len(parameters)} parameters"
        )
    return Model(rig, terms, parameters, covariance, dict(data["provenance"]))


def refuse_other_rig(model: Model, rig: Rig, source: str) -> None:
    """Raise InputError if records of `rig` do not belong to the model's rig."""
    reason = rig_difference(model.rig, rig)
    if reason:
        raise InputError(
            f"{source} was recorded on another rig than the model was identified on: {reason}"
        )


def terms_like(path: Path, rigs: Mapping[str, Rig]) -> tuple[Used, ...]:
    """Return the terms of a model file; raises InputError if one of `rigs` (by source) differs."""
    model = load_model(path)
    for source, rig in rigs.items():
        refuse_other_rig(model, rig, source or "the run")
    return model.terms


def rig_difference(rig: Rig, other: Rig) -> str:
    """Return the physical difference between two rigs in words ('' if there is none).

    Tolerances are ignored: they state how well a rig is known.
    """
    if rig.name != other.name:
        return f"name {rig.name!r} and {other.name!r}"
    if len(rig.joints) != len(other.joints):
        return f"{len(rig.joints)} and {len(other.joints)} joints"
    values, others = _physical_values(rig), _physical_values(other)
    differing = [key for key in {**values, **others} if values.get(key) != others.get(key)]
    if not differing:
        return ""
    listed = ", ".join(
        f"{key} {values.get(key, 'absent')} and {others.get(key, 'absent')}"
        for key in differing[:_DIFFERENCES_LISTED]
    )
    unlisted = len(differing) - _DIFFERENCES_LISTED
    return f"{listed} (SI){f' and {unlisted} more values' if unlisted > 0 else ''}"


def _physical_values(rig: Rig) -> dict[str, Any]:
    """Return the values of a rig that describe the machine, by their keys: joints.1.link_length."""
    ignored = {"description", "nominal", "wire", "sample_rate", "tolerances"}
    data = rig.model_dump(exclude=ignored)
    joints = {
        str(i): {k: v for k, v in joint.items() if k not in ("limits", "name")}
        for i, joint in enumerate(data["joints"], start=1)
    }
    return dict(_leaves("", {**data, "joints": joints}))


def _leaves(key: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield the values of nested mappings with their keys, joined by dots."""
    if not isinstance(value, dict):
        yield key, value
        return
    for name, inner in value.items():
        yield from _leaves(f"{key}.{name}" if key else name, inner)
