"""The XML files of an FMU."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from ato_hil.tools.export.fmu.variables import MIME, TERMINAL, UNITS, Interface, Variable

BINARY_MOST = 4096  # bytes of Rx_Data and Tx_Data, FMU_BINARY_MOST of fmu.h
LS_BUS = "org.fmi-standard.fmi-ls-bus"
LS_MANIFEST = "http://fmi-standard.org/fmi-ls-manifest"


@dataclass(frozen=True)
class About:
    """What an FMU says of itself."""

    identifier: str  # also the name of its binary
    title: str
    text: str
    version: str
    content: str  # what it was made of: digests of scenario and sources
    period_s: float
    stop_s: float

    @property
    def token(self) -> str:
        """The instantiationToken: another one for other content."""
        digest = hashlib.blake2b(f"{self.identifier} {self.content}".encode(), digest_size=16)
        text = digest.hexdigest()
        return "{" + "-".join((text[:8], text[8:12], text[12:16], text[16:20], text[20:])) + "}"


def text_of(root: Element) -> str:
    """An XML file."""
    ElementTree.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root, "unicode") + "\n"


def model(about: About, made: Interface) -> str:
    """modelDescription.xml."""
    root = Element(
        "fmiModelDescription",
        fmiVersion="3.0",
        modelName=about.title,
        instantiationToken=about.token,
        description=about.text,
        version=about.content,
        generationTool=f"ato-hil {about.version}",
        variableNamingConvention="structured",
    )
    abilities = {
        "modelIdentifier": about.identifier,
        "canGetAndSetFMUState": "true",
        "canSerializeFMUState": "true",
        "canHandleVariableCommunicationStepSize": "true",
        "fixedInternalStepSize": _number(about.period_s),
    }
    if made.has_bus:
        abilities |= {"hasEventMode": "true", "mightReturnEarlyFromDoStep": "true"}
    SubElement(root, "CoSimulation", abilities)
    _units(root, made.variables)
    _enumerations(root, made)
    categories = SubElement(root, "LogCategories")
    SubElement(categories, "Category", name="logStatusError", description="Refused calls")
    SubElement(categories, "Category", name="logEvents", description="What happens on the bus")
    SubElement(
        root,
        "DefaultExperiment",
        startTime="0",
        stopTime=_number(about.stop_s),
        stepSize=_number(about.period_s),
    )
    _variables(root, made)
    _structure(root, made.variables)
    return text_of(root)


def _units(root: Element, variables: Sequence[Variable]) -> None:
    used = {variable.unit for variable in variables if variable.unit}
    if not used:
        return
    units = SubElement(root, "UnitDefinitions")
    for name in sorted(used):
        exponents = {base: str(power) for base, power in UNITS[name].items()}
        SubElement(SubElement(units, "Unit", name=name), "BaseUnit", exponents)


def _enumerations(root: Element, made: Interface) -> None:
    if not made.enumerations:
        return
    types = SubElement(root, "TypeDefinitions")
    for name, items in made.enumerations.items():
        kind = SubElement(types, "EnumerationType", name=name)
        for item, value in items.items():
            SubElement(kind, "Item", name=item, value=str(value))


def _variables(root: Element, made: Interface) -> None:
    listed = SubElement(root, "ModelVariables")
    for reference, variable in enumerate(made.variables):
        attributes = {
            "name": variable.name,
            "valueReference": str(reference),
            "description": variable.description,
            "causality": variable.causality,
        }
        if variable.kind == "Clock":
            attributes["intervalVariability"] = "triggered"
            SubElement(listed, variable.kind, attributes)
            continue
        attributes["variability"] = _variability(variable)
        if variable.kind == "Binary":
            attributes["mimeType"] = MIME
            attributes["maxSize"] = str(BINARY_MOST)
            attributes["clocks"] = str(made.reference(variable.clock))
            if variable.causality == "output":
                attributes["initial"] = "calculated"
            element = SubElement(listed, variable.kind, attributes)
            if variable.causality == "input":
                SubElement(element, "Start", value="")
            continue
        if variable.choices:
            attributes["declaredType"] = variable.choices
        if variable.unit:
            attributes["unit"] = variable.unit
        for key, limit in (("min", variable.low), ("max", variable.high)):
            if limit is not None:
                attributes[key] = _number(limit)
        if variable.start is not None:
            truth = {0: "false", 1: "true"}
            attributes["start"] = (
                truth[int(variable.start)]
                if variable.kind == "Boolean"
                else _number(variable.start)
            )
        elif variable.causality != "independent":
            attributes["initial"] = "calculated"
        SubElement(listed, variable.kind, attributes)


def _variability(variable: Variable) -> str:
    if variable.causality == "independent":
        return "continuous"
    return "fixed" if variable.causality == "parameter" else "discrete"


def _structure(root: Element, variables: Sequence[Variable]) -> None:
    """Outputs depend on nothing within a communication point: they change in steps."""
    structure = SubElement(root, "ModelStructure")
    outputs = [(k, v) for k, v in enumerate(variables) if v.causality == "output"]
    for reference, _variable in outputs:
        SubElement(structure, "Output", valueReference=str(reference), dependencies="")
    for reference, variable in outputs:
        if not variable.clock:
            SubElement(structure, "InitialUnknown", valueReference=str(reference), dependencies="")


def _number(value: float) -> str:
    return str(value) if isinstance(value, int) else repr(value).removesuffix(".0")


def build(about: About, files: Sequence[str]) -> str:
    """sources/buildDescription.xml."""
    root = Element("fmiBuildDescription", fmiVersion="3.0")
    configuration = SubElement(root, "BuildConfiguration", modelIdentifier=about.identifier)
    source_set = SubElement(configuration, "SourceFileSet", language="C99")
    for name in files:
        SubElement(source_set, "SourceFile", name=name)
    return text_of(root)


def terminals(made: Interface) -> str:
    """terminalsAndIcons/terminalsAndIcons.xml: the bus."""
    root = Element("fmiTerminalsAndIcons", fmiVersion="3.0")
    terminal = SubElement(
        SubElement(root, "Terminals"),
        "Terminal",
        name=TERMINAL,
        matchingRule="org.fmi-ls-bus.transceiver",
        terminalKind="org.fmi-ls-bus.network-terminal",
        description="The CAN bus; frames as in its DBC in extra/",
    )
    for member in ("Rx_Data", "Rx_Clock", "Tx_Data", "Tx_Clock"):
        SubElement(
            terminal,
            "TerminalMemberVariable",
            variableName=f"{TERMINAL}.{member}",
            variableKind="signal",
            memberName=member,
        )
    inner = SubElement(
        terminal,
        "Terminal",
        name="Configuration",
        matchingRule="bus",
        terminalKind="org.fmi-ls-bus.network-terminal.configuration",
    )
    SubElement(
        inner,
        "TerminalMemberVariable",
        variableName=f"{TERMINAL}.BusNotifications",
        variableKind="signal",
        memberName="BusNotifications",
    )
    return text_of(root)


def manifest() -> str:
    """extra/org.fmi-standard.fmi-ls-bus/fmi-ls-manifest.xml."""
    ElementTree.register_namespace("fmi-ls", LS_MANIFEST)
    root = Element(
        "fmiLayeredStandardManifest",
        {
            f"{{{LS_MANIFEST}}}fmi-ls-name": LS_BUS,
            f"{{{LS_MANIFEST}}}fmi-ls-version": "1.0.0",
            f"{{{LS_MANIFEST}}}fmi-ls-description": "Simulation of bus communication on the level"
            " of frames",
            "isBusSimulationFMU": "false",
        },
    )
    return text_of(root)
