"""modelDescription.xml of a mock-up unit, versions 2.0 and 3.0 (fmi-standard.org)."""

from __future__ import annotations

from collections.abc import Sequence
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from analysis.simulation.fmu.variables import TIME, UnitVariable, UnitVariables

# Exponents of SI base units, for the units that a simulation tool may convert.
_BASE_UNITS: dict[str, dict[str, str]] = {
    "s": {"s": "1"},
    "m": {"m": "1"},
    "m/s": {"m": "1", "s": "-1"},
    "rad": {"rad": "1"},
    "rad/s": {"rad": "1", "s": "-1"},
    "Pa": {"kg": "1", "m": "-1", "s": "-2"},
    "V": {"kg": "1", "m": "2", "s": "-3", "A": "-1"},
    "degC": {"K": "1", "offset": "273.15"},
}


def description_2(name: str, about: str, token: str, step: float, unit: UnitVariables) -> str:
    """Return the description of version 2.0; `step` [s] is the communication step suggested."""
    root = Element(
        "fmiModelDescription",
        fmiVersion="2.0", modelName=name, guid=token, description=about,
        generationTool="Bramah", variableNamingConvention="structured", numberOfEventIndicators="0",
    )  # fmt: skip
    simulation = SubElement(
        root, "CoSimulation",
        modelIdentifier=name, canHandleVariableCommunicationStepSize="true",
        canInterpolateInputs="true", canGetAndSetFMUstate="true", canSerializeFMUstate="true",
        canBeInstantiatedOnlyOncePerProcess="false",
    )  # fmt: skip
    files = SubElement(simulation, "SourceFiles")
    SubElement(files, "File", name="fmi2.c")
    _units(root, unit)
    SubElement(root, "DefaultExperiment", startTime="0", stopTime="1", stepSize=repr(step))
    listed = SubElement(root, "ModelVariables")
    order: list[str] = []

    def add(variable: UnitVariable, kind: str, attributes: dict[str, str], **more: str) -> None:
        order.append(variable.name)
        item = SubElement(listed, "ScalarVariable", _identity(variable) | more)
        SubElement(item, kind, attributes)

    for v in unit.inputs:
        add(v, "Real", _real(v), causality="input", variability="continuous")
    for v in unit.outputs:
        add(v, "Real", {"unit": v.unit}, causality="output", variability="continuous",
            initial="calculated")  # fmt: skip
    for v in unit.starts:
        add(v, "Real", _real(v), causality="parameter", variability="fixed", initial="exact")
    for v in unit.constants:
        add(v, "Real", {"start": repr(v.start)}, causality="local", variability="constant",
            initial="exact")  # fmt: skip
    for v in unit.switches:
        add(v, "Boolean", {"start": "false"}, causality="parameter", variability="fixed",
            initial="exact")  # fmt: skip
    structure = SubElement(root, "ModelStructure")
    for part in ("Outputs", "InitialUnknowns"):
        unknowns = SubElement(structure, part)
        for v in unit.outputs:
            depends = _start_of(v, unit.starts)
            index = str(order.index(v.name) + 1)
            if part == "Outputs":
                SubElement(unknowns, "Unknown", index=index, dependencies="")
            else:
                on = str(order.index(depends) + 1)
                SubElement(unknowns, "Unknown", index=index, dependencies=on)
    return _text(root)


def description_3(name: str, about: str, token: str, step: float, unit: UnitVariables) -> str:
    """Return the description of version 3.0; `step` [s] is the communication step suggested."""
    root = Element(
        "fmiModelDescription",
        fmiVersion="3.0", modelName=name, instantiationToken=token, description=about,
        generationTool="Bramah", variableNamingConvention="structured",
    )  # fmt: skip
    SubElement(
        root, "CoSimulation",
        modelIdentifier=name, canHandleVariableCommunicationStepSize="true",
        canGetAndSetFMUState="true", canSerializeFMUState="true",
        canBeInstantiatedOnlyOncePerProcess="false",
    )  # fmt: skip
    _units(root, unit)
    SubElement(root, "DefaultExperiment", startTime="0", stopTime="1", stepSize=repr(step))
    listed = SubElement(root, "ModelVariables")

    def add(variable: UnitVariable, kind: str, **more: str) -> None:
        SubElement(listed, kind, _identity(variable) | more)

    time = UnitVariable("time", TIME, "s", 0.0, "simulated time")
    add(time, "Float64", causality="independent", variability="continuous", unit="s")
    for v in unit.inputs:
        add(v, "Float64", causality="input", variability="continuous", **_real(v))
    for v in unit.outputs:
        add(v, "Float64", causality="output", variability="continuous", initial="calculated",
            unit=v.unit)  # fmt: skip
    for v in unit.starts:
        add(v, "Float64", causality="parameter", variability="fixed", initial="exact", **_real(v))
    for v in unit.constants:
        add(v, "Float64", causality="local", variability="constant", initial="exact",
            start=repr(v.start))  # fmt: skip
    for v in unit.switches:
        add(v, "Boolean", causality="parameter", variability="fixed", initial="exact",
            start="false")  # fmt: skip
    structure = SubElement(root, "ModelStructure")
    for v in unit.outputs:
        SubElement(structure, "Output", valueReference=str(v.reference), dependencies="")
    by_name = {v.name: v.reference for v in unit.starts}
    for v in unit.outputs:
        on = str(by_name[_start_of(v, unit.starts)])
        reference = str(v.reference)
        SubElement(structure, "InitialUnknown", valueReference=reference, dependencies=on)
    return _text(root)


def build_description(name: str) -> str:
    """Return sources/buildDescription.xml of version 3.0: how to compile the sources."""
    root = Element("fmiBuildDescription", fmiVersion="3.0")
    build = SubElement(root, "BuildConfiguration", modelIdentifier=name)
    files = SubElement(build, "SourceFileSet", language="C99")
    SubElement(files, "SourceFile", name="fmi3.c")
    return _text(root)


def _units(root: Element, unit: UnitVariables) -> None:
    definitions = SubElement(root, "UnitDefinitions")
    for name in unit.units:
        item = SubElement(definitions, "Unit", name=name)
        if name in _BASE_UNITS:
            SubElement(item, "BaseUnit", _BASE_UNITS[name])


def _identity(variable: UnitVariable) -> dict[str, str]:
    return {
        "name": variable.name,
        "valueReference": str(variable.reference),
        "description": variable.description,
    }


def _real(variable: UnitVariable) -> dict[str, str]:
    return {"unit": variable.unit, "start": repr(variable.start)}


def _start_of(output: UnitVariable, starts: Sequence[UnitVariable]) -> str:
    return next(v.name for v in starts if v.name == f"{output.name}_start")


def _text(root: Element) -> str:
    indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + tostring(root, encoding="unicode") + "\n"
