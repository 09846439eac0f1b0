"""A run as an RO-Crate: the run's files and a JSON-LD description for data archives.

RO-Crate 1.1 (https://w3id.org/ro/crate/1.1) with the Process Run Crate profile: the run is a
`CreateAction` of this software on the rig, by the operator, from run.yaml to records.h5.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from rig.model.trips import RecordingFailed
from rig.runs import store
from rig.runs.files import new_folder
from rig.runs.runstate import ABORTED, DONE, EVENTS, HEADER, read_events
from rig.runs.store import ARCHIVE, CRATE_METADATA, PROOF, TRACKED, TRIP_WINDOW, Header
from rig.runs.stream import RunHead, read_run_head

CONTEXT: Final = "https://w3id.org/ro/crate/1.1/context"
CRATE: Final = "https://w3id.org/ro/crate/1.1"
PROFILE: Final = "https://w3id.org/ro/wfrun/process/0.5"
_FILES: Final = {
    HEADER: ("application/yaml", "How the run was taken: rig, protocol, versions, seeds"),
    ARCHIVE: ("application/x-hdf5", "Every record and what lies between, SI units as attributes"),
    EVENTS: ("application/jsonl", "What happened, one line an event"),
    "state": ("text/plain", "How the run ended"),
    TRIP_WINDOW: ("text/csv", "The samples around the trip"),
    PROOF: ("application/json", "The proof of the protocol on the twin, a figure for each limit"),
    TRACKED: ("application/json", "The parameters estimated during the run"),
}
# UN/CEFACT common codes, as required by schema.org.
_UNIT_CODES: Final = {"V": "VLT", "m": "MTR", "Pa": "PAL", "degC": "CEL", "rad": "C81", "N": "NEW"}
Entity = dict[str, Any]


def _ref(identifier: str) -> Entity:
    return {"@id": identifier}


def _entity(identifier: str, kind: str | list[str], name: str, **properties: Any) -> Entity:
    return {"@id": identifier, "@type": kind, "name": name, **properties}


def _digest(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def export_crate(run: Path, out: Path, licence: str = "") -> list[Path]:
    """Copy a run into the folder `out` and describe it; returns the files.

    `licence` is the URL of the data's licence; without one the crate says that none was given.
    Raises InputError for a run that cannot be read, samples that were changed since they were
    written, or a folder that is occupied, RecordingFailed if the crate cannot be written.
    """
    from rig.runs.archive_reader import verify  # noqa: PLC0415 - h5py loads slowly

    head = read_run_head(run, partial=True)
    header = store.read_header(run)
    store.refuse_occupied(out)
    names = [name for name in _FILES if (run / name).is_file()]
    if ARCHIVE in names:  # the crate's SHA-256 would state damaged samples as the right ones
        verify(run / ARCHIVE)
    try:
        with new_folder(out) as folder:
            for name in names:
                shutil.copyfile(run / name, folder / name)
            text = json.dumps(describe(folder, head, header, names, licence), indent=2) + "\n"
            (folder / CRATE_METADATA).write_text(text, encoding="utf-8")
    except OSError as error:
        raise RecordingFailed(f"{out}: the crate cannot be written: {error.strerror}") from error
    return [out / name for name in (*names, CRATE_METADATA)]


def describe(
    folder: Path, head: RunHead, header: Header, names: list[str], licence: str
) -> dict[str, Any]:
    """Return the crate's metadata document for the copied files `names` of `folder`."""
    name = Path(head.source).resolve().name
    variables = _variables(head, header)
    licence_id = licence or "#no-licence"
    root = _entity(
        "./",
        "Dataset",
        f"Run {name} on {header.rig.name}",
        description=_description(head, header),
        datePublished=datetime.now(UTC).date().isoformat(),
        dateCreated=header.created,
        license=_ref(licence_id),
        creator=_ref("#operator"),
        conformsTo=_ref(PROFILE),
        hasPart=[_ref(part) for part in names],
        mentions=_ref("#run"),
        variableMeasured=[_ref(variable["@id"]) for variable in variables],
    )
    of_crate = {"conformsTo": _ref(CRATE), "about": _ref("./")}
    graph: list[Entity] = [
        {"@id": CRATE_METADATA, "@type": "CreativeWork", **of_crate},
        root,
        *(_file(folder / part) for part in names),
        _action(folder, head, header, names),
        _entity("#operator", "Person", header.operator or "unknown"),
        _entity(
            licence_id,
            "CreativeWork",
            "Licence of the data" if licence else "No licence was given",
            description=licence or "The exporting person named no licence: ask them.",
        ),
        _instrument(header),
        *_software(header.versions),
        _entity(PROFILE, "CreativeWork", "Process Run Crate", version="0.5"),
        *variables,
        *_calibrations(header),
    ]
    return {"@context": CONTEXT, "@graph": graph}


def _description(head: RunHead, header: Header) -> str:
    protocol = str((header.protocol or {}).get("name", "")) or header.source or "no protocol"
    complete = sum(bool(record.attributes["complete"]) for record in head.records)
    return (
        f"{complete} complete and {len(head.records) - complete} unfinished records of {protocol} "
        f"at {header.rig.sample_rate:g} Hz; the run ended as {head.state}"
    )


def _file(path: Path) -> Entity:
    kind, about = _FILES[path.name]
    return _entity(
        path.name,
        "File",
        path.name,
        description=about,
        encodingFormat=kind,
        contentSize=str(path.stat().st_size),
        sha256=_digest(path),
    )


def _action(folder: Path, head: RunHead, header: Header, names: list[str]) -> Entity:
    events = read_events(folder)
    failed = head.state != DONE
    status = "FailedActionStatus" if failed else "CompletedActionStatus"
    action = _entity(
        "#run",
        "CreateAction",
        header.provenance.get("command") or f"Run on {header.rig.name}",
        startTime=header.created,
        endTime=str(events[-1].get("time", header.created)) if events else header.created,
        agent=_ref("#operator"),
        instrument=_ref("#bramah"),
        object=[_ref(HEADER), _ref("#rig")],
        result=[_ref(name) for name in names if name in (ARCHIVE, EVENTS)],
        actionStatus=_ref(f"http://schema.org/{status}"),
    )
    if failed:
        ends = [e for e in events if e.get("event") in ("trip", "end", "recovered")]
        message = str(ends[-1].get("message", "")) if ends else ""
        action["error"] = message or (ABORTED if head.state == ABORTED else head.state)
    return action


def _instrument(header: Header) -> Entity:
    description = (
        f"Test bench with {len(header.rig.joints)} joint(s); device: {header.device or 'unknown'}; "
        f"computer: {header.host or 'unknown'}"
    )
    kinds = ["IndividualProduct", "Thing"]
    return _entity("#rig", kinds, header.rig.name, description=description)


def _software(versions: Mapping[str, str]) -> list[Entity]:
    others = {
        name: version for name, version in versions.items() if name not in ("bramah", "commit")
    }
    kind = "SoftwareApplication"
    needs = [_ref(f"#{name}") for name in others]
    version = versions.get("bramah", "unknown")
    main = _entity("#bramah", kind, "bramah", version=version, softwareRequirements=needs)
    if "commit" in versions:
        main["identifier"] = versions["commit"]
    return [main, *(_entity(f"#{name}", kind, name, version=v) for name, v in others.items())]


def _variables(head: RunHead, header: Header) -> list[Entity]:
    names = dict.fromkeys(name for record in head.records for name in record.channels)
    variables = []
    for name in names:
        unit = header.rig.unit_of(name)
        variable = _entity(f"#channel-{name}", "PropertyValue", name, unitText=unit or "1")
        if unit in _UNIT_CODES:
            variable["unitCode"] = _UNIT_CODES[unit]
        if name in _calibrated(header):
            variable["measurementTechnique"] = _ref(f"#calibration-{name}")
        variables.append(variable)
    return variables


def _calibrated(header: Header) -> Mapping[str, Any]:
    return getattr(getattr(header.rig, "sensors", None), "calibrations", None) or {}


def _calibrations(header: Header) -> list[Entity]:
    calibrations = _calibrated(header).items()
    acts = [
        _entity(
            f"#calibration-{name}",
            "CreateAction",
            f"Calibration of {name}",
            endTime=calibration.date.isoformat(),
            object=_ref(f"#sensor-{name}"),
            description=calibration.certificate or "no certificate was named",
        )
        for name, calibration in calibrations
    ]
    return acts + [
        _entity(
            f"#sensor-{name}",
            "IndividualProduct",
            f"Sensor of {name}",
            serialNumber=calibration.serial,
        )
        for name, calibration in calibrations
    ]
