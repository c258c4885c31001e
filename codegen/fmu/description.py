"""XML of an FMU: model description (FMI 2.0 and 3.0), build description, icon."""

from collections.abc import Sequence
from typing import Final
from xml.etree import ElementTree as ET

from codegen.fmu.definition import FmuDefinition
from codegen.fmu.variables import Variable, base_units

__all__ = ["TIME", "build_description", "icon_description", "model_description"]

TIME: Final = "time"

_FMI2_TYPES: Final = {"real": "Real", "integer": "Integer", "boolean": "Boolean"}
_FMI3_TYPES: Final = {"real": "Float64", "integer": "Int32", "boolean": "Boolean"}
_LOG: Final = ("logStatusError", "Why a call was refused or a step failed")

_STOP_S: Final = 10.0

Attributes = dict[str, str]


def _text(root: ET.Element) -> bytes:
    ET.indent(root)
    text: bytes = ET.tostring(root, encoding="utf-8", xml_declaration=True)
    return text + b"\n"


def _flag(value: bool) -> str:
    return "true" if value else "false"


def _number(value: float, kind: str) -> str:
    if kind == "boolean":
        return _flag(bool(value))
    return str(int(value)) if kind == "integer" else repr(float(value))


def _named(variable: Variable, reference: int) -> Attributes:
    attributes = {
        "name": variable.name,
        "valueReference": str(reference),
        "description": variable.description,
        "causality": variable.causality,
        "variability": variable.variability,
    }
    if variable.causality != "input":  # FMI gives inputs no 'initial'
        attributes["initial"] = variable.initial
    return attributes


def _typed(variable: Variable) -> Attributes:
    attributes = {}
    if variable.unit is not None:
        attributes["unit"] = variable.unit
    for name, value in (
        ("min", variable.min),
        ("max", variable.max),
        ("nominal", variable.nominal),
        ("start", variable.start),
    ):
        if value is not None:
            attributes[name] = _number(value, variable.kind)
    return attributes


def _units(parent: ET.Element, definition: FmuDefinition) -> None:
    units = sorted({"s", *(v.unit for v in definition.variables if v.unit is not None)})
    definitions = ET.SubElement(parent, "UnitDefinitions")
    for unit in units:
        exponents = {base: str(power) for base, power in base_units(unit).items()}
        ET.SubElement(ET.SubElement(definitions, "Unit", name=unit), "BaseUnit", exponents)


def _log_and_experiment(parent: ET.Element, definition: FmuDefinition) -> None:
    categories = ET.SubElement(parent, "LogCategories")
    ET.SubElement(categories, "Category", name=_LOG[0], description=_LOG[1])
    ET.SubElement(
        parent,
        "DefaultExperiment",
        startTime="0",
        stopTime=repr(_STOP_S),
        stepSize=repr(definition.default_step_s),
    )


def _head(definition: FmuDefinition, fmi: str, token_name: str, token: str) -> Attributes:
    return {
        "fmiVersion": fmi,
        "modelName": definition.name,
        token_name: token,
        "description": definition.description,
        "author": "BayesRace contributors",
        "license": "MIT",
        "generationTool": "BayesRace",
        "variableNamingConvention": "flat",
    }


def model_description(definition: FmuDefinition, token: str, sources: list[str]) -> bytes:
    """``modelDescription.xml``; ``sources``: the C files to compile (named in FMI 2.0 only)."""
    if definition.version == 2:
        return _text(_fmi2(definition, token, sources))
    return _text(_fmi3(definition, token))


def _fmi2(definition: FmuDefinition, token: str, sources: list[str]) -> ET.Element:
    root = ET.Element("fmiModelDescription", _head(definition, "2.0", "guid", token))
    saves = definition.saves
    kind = ET.SubElement(
        root,
        "CoSimulation",
        modelIdentifier=definition.identifier,
        canHandleVariableCommunicationStepSize="true",
        canBeInstantiatedOnlyOncePerProcess="false",
        canNotUseMemoryManagementFunctions="true",
        canGetAndSetFMUstate=_flag(saves != "none"),
        canSerializeFMUstate=_flag(saves == "serialised"),
    )
    files = ET.SubElement(kind, "SourceFiles")
    for name in sources:
        ET.SubElement(files, "File", name=name)
    _units(root, definition)
    _log_and_experiment(root, definition)
    variables = ET.SubElement(root, "ModelVariables")
    for reference, variable in enumerate(definition.variables):
        scalar = ET.SubElement(variables, "ScalarVariable", _named(variable, reference))
        ET.SubElement(scalar, _FMI2_TYPES[variable.kind], _typed(variable))
    time = ET.SubElement(
        variables,
        "ScalarVariable",
        name=TIME,
        valueReference=str(len(definition.variables)),
        causality="independent",
        variability="continuous",
    )
    ET.SubElement(time, "Real", unit="s")
    _fmi2_structure(root, definition)
    return root


def _unknown(parent: ET.Element, tag: str, place: Attributes, known: Sequence[str] | None) -> None:
    """``known``: places of what it depends on, None for all."""
    element = ET.SubElement(parent, tag, place)
    if known is not None:
        element.set("dependencies", " ".join(known))


def _places(names: tuple[str, ...] | None, place: dict[str, str]) -> list[str] | None:
    return None if names is None else [place[name] for name in names]


def _fmi2_structure(root: ET.Element, definition: FmuDefinition) -> None:
    """Outputs and initial unknowns by index, which counts from 1."""
    index = {variable.name: str(i) for i, variable in enumerate(definition.variables, start=1)}
    outputs = [v for v in definition.variables if v.causality == "output"]
    calculated = [v for v in outputs if v.initial == "calculated"]
    structure = ET.SubElement(root, "ModelStructure")
    if outputs:
        parent = ET.SubElement(structure, "Outputs")
        for v in outputs:
            _unknown(parent, "Unknown", {"index": index[v.name]}, _places(v.dependencies, index))
    if calculated:
        parent = ET.SubElement(structure, "InitialUnknowns")
        for v in calculated:
            known = _places(v.initial_dependencies, index)
            _unknown(parent, "Unknown", {"index": index[v.name]}, known)


def _fmi3_kind(definition: FmuDefinition) -> tuple[str, Attributes]:
    attributes = {
        "modelIdentifier": definition.identifier,
        "canBeInstantiatedOnlyOncePerProcess": "false",
        "canGetAndSetFMUState": _flag(definition.saves != "none"),
        "canSerializeFMUState": _flag(definition.saves == "serialised"),
    }
    if definition.kind == "me":
        attributes["providesDirectionalDerivatives"] = _flag(definition.derivatives)
        attributes["providesAdjointDerivatives"] = _flag(definition.derivatives)
        return "ModelExchange", attributes
    attributes["canHandleVariableCommunicationStepSize"] = "true"
    return "CoSimulation", attributes


def _fmi3(definition: FmuDefinition, token: str) -> ET.Element:
    root = ET.Element("fmiModelDescription", _head(definition, "3.0", "instantiationToken", token))
    ET.SubElement(root, *_fmi3_kind(definition))
    _units(root, definition)
    _log_and_experiment(root, definition)
    reference = {variable.name: str(i) for i, variable in enumerate(definition.variables)}
    variables = ET.SubElement(root, "ModelVariables")
    for i, variable in enumerate(definition.variables):
        attributes = {**_named(variable, i), **_typed(variable)}
        if variable.derivative_of is not None:
            attributes["derivative"] = reference[variable.derivative_of]
        ET.SubElement(variables, _FMI3_TYPES[variable.kind], attributes)
    ET.SubElement(
        variables,
        "Float64",
        name=TIME,
        valueReference=str(len(definition.variables)),
        causality="independent",
        variability="continuous",
        unit="s",
    )
    structure = ET.SubElement(root, "ModelStructure")
    outputs = [v for v in definition.variables if v.causality == "output"]
    derivatives = [v for v in definition.variables if v.derivative_of is not None]
    calculated = [v for v in (*outputs, *derivatives) if v.initial == "calculated"]
    for tag, unknowns in (("Output", outputs), ("ContinuousStateDerivative", derivatives)):
        for v in unknowns:
            known = _places(v.dependencies, reference)
            _unknown(structure, tag, {"valueReference": reference[v.name]}, known)
    for v in calculated:
        known = _places(v.initial_dependencies, reference)
        _unknown(structure, "InitialUnknown", {"valueReference": reference[v.name]}, known)
    return root


def build_description(
    definition: FmuDefinition, sources: list[str], options: str, archives: list[str]
) -> bytes:
    """``sources/buildDescription.xml`` of FMI 3.0."""
    root = ET.Element("fmiBuildDescription", fmiVersion="3.0")
    configuration = ET.SubElement(root, "BuildConfiguration", modelIdentifier=definition.identifier)
    files = ET.SubElement(configuration, "SourceFileSet", language="C11", compilerOptions=options)
    for name in sources:
        ET.SubElement(files, "SourceFile", name=name)
    for name in archives:
        ET.SubElement(configuration, "Library", name=name)
    ET.SubElement(configuration, "Library", name="m", external="true")
    return _text(root)


def icon_description() -> bytes:
    """``terminalsAndIcons/terminalsAndIcons.xml`` of FMI 3.0 beside ``icon.png``."""
    root = ET.Element("fmiTerminalsAndIcons", fmiVersion="3.0")
    graphical = ET.SubElement(root, "GraphicalRepresentation")
    box = {"x1": "-100", "y1": "-100", "x2": "100", "y2": "100"}
    ET.SubElement(graphical, "CoordinateSystem", box, suggestedScalingFactorTo_mm="0.1")
    ET.SubElement(graphical, "Icon", box)
    return _text(root)
