"""modelDescription.xml of a mock-up unit, versions 2.0 and 3.0 (fmi-standard.org)."""

from __future__ import annotations

from collections.abc import Iterator
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from analysis.simulation.fmu.variables import TIME, UnitVariable, UnitVariables

_Attributes = dict[str, str]

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
    index: dict[str, str] = {}
    for variable, role, value in _described(unit):
        index[variable.name] = str(len(index) + 1)
        item = SubElement(listed, "ScalarVariable", role)
        SubElement(item, "Boolean" if variable in unit.switches else "Real", value)
    structure = SubElement(root, "ModelStructure")
    outputs = SubElement(structure, "Outputs")
    initial = SubElement(structure, "InitialUnknowns")
    for v in unit.outputs:
        reference, start = index[v.name], index[f"{v.name}_start"]
        SubElement(outputs, "Unknown", index=reference, dependencies="")
        SubElement(initial, "Unknown", index=reference, dependencies=start)
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
    time = UnitVariable("time", TIME, "s", 0.0, "simulated time")
    clock = _identity(time) | {"causality": "independent", "variability": "continuous"}
    SubElement(listed, "Float64", clock, unit=time.unit)
    for variable, role, value in _described(unit):
        SubElement(listed, "Boolean" if variable in unit.switches else "Float64", role | value)
    structure = SubElement(root, "ModelStructure")
    for v in unit.outputs:
        SubElement(structure, "Output", valueReference=str(v.reference), dependencies="")
    starts = {v.name: str(v.reference) for v in unit.starts}
    for v in unit.outputs:
        reference, start = str(v.reference), starts[f"{v.name}_start"]
        SubElement(structure, "InitialUnknown", valueReference=reference, dependencies=start)
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


def _described(unit: UnitVariables) -> Iterator[tuple[UnitVariable, _Attributes, _Attributes]]:
    """Yield every variable with the attributes of its identity and role, and of its value."""
    groups = (
        (unit.inputs, "input", "continuous", None, ("unit", "start")),
        (unit.outputs, "output", "continuous", "calculated", ("unit",)),
        (unit.starts, "parameter", "fixed", "exact", ("unit", "start")),
        (unit.constants, "local", "constant", "exact", ("start",)),
        (unit.switches, "parameter", "fixed", "exact", ("start",)),
    )
    for variables, causality, variability, initial, keys in groups:
        role = {"causality": causality, "variability": variability}
        if initial is not None:
            role["initial"] = initial
        for v in variables:
            start = "false" if v in unit.switches else repr(v.start)
            value = {"unit": v.unit, "start": start}
            yield v, _identity(v) | role, {key: value[key] for key in keys}


def _text(root: Element) -> str:
    indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + tostring(root, encoding="unicode") + "\n"
