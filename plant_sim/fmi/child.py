"""The process of one FMU: loads it with FMPy, and answers requests on a socket.

What the FMU does to this process, it does to no other. It keeps the inputs of a run, so that it can
be asked whether the same inputs give the same outputs again.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import re
import socket
import sys
import zipfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec

from ato_hil.plant_sim.fmi import (
    COUNT,
    ERROR,
    EVENT,
    HEAD,
    OPEN,
    RESET,
    STEP,
    TURN,
    VERIFY,
    Opened,
    Port,
    Wanted,
    archive,
)
from ato_hil.plant_sim.fmi.archive import FmuError

MADE_FOR = re.compile(r"(\w+), scenario (\w+)(?:, law ([^,]+))?")  # how an FMU of ours says it
TRANSCEIVER = "org.fmi-ls-bus.transceiver"
ITERATIONS_MAX = 50  # of one event
TEXT_MOST = 400  # characters of an error: names and texts in it are of others
TROUBLE = (2, 3, 4)  # fmi2Status, fmi3Status: discard, error, fatal
REALS = ("Real", "Float64", "Float32")
WHOLES = (
    *("Integer", "Boolean", "Enumeration"),
    *(f"{sign}Int{bits}" for sign in ("", "U") for bits in (8, 16, 32, 64)),
)
KINDS = {"real": REALS, "whole": WHOLES, "number": (*REALS, *WHOLES)}
# A unit of an FMU by its exponents of the SI's base units, and other names that tools give it.
UNITS: dict[str, tuple[dict[str, int], tuple[str, ...]]] = {
    "m": ({"m": 1}, ("metre", "meter")),
    "m/s": ({"m": 1, "s": -1}, ("m.s-1", "m s-1", "m*s-1", "m/second")),
    "m/s2": ({"m": 1, "s": -2}, ("m.s-2", "m/s^2", "m/s²", "m s-2", "m/(s.s)", "m/s/s")),
    "N": ({"kg": 1, "m": 1, "s": -2}, ("newton", "kg.m/s2", "kg.m.s-2")),
    "kg": ({"kg": 1}, ("kilogram",)),
}


class Group:
    """Variables of one type, set or got by one call."""

    def __init__(self, kind: str, references: Sequence[int], fmi: str) -> None:
        import ctypes

        count = len(references)
        prefix = "fmi2" if fmi == "2.0" else "fmi3"
        if fmi == "2.0":
            call = "Integer" if kind == "Enumeration" else kind
            item: Any = {"Real": ctypes.c_double}.get(kind, ctypes.c_int)
        else:
            call = "Int64" if kind == "Enumeration" else kind
            sizes: dict[str, Any] = {"Float64": ctypes.c_double, "Float32": ctypes.c_float}
            sizes["Boolean"] = ctypes.c_bool
            item = sizes.get(call) or getattr(ctypes, f"c_{call.lower()}")
        self.set_name, self.get_name = f"{prefix}Set{call}", f"{prefix}Get{call}"
        self.references = (ctypes.c_uint * count)(*references)
        self.values = (item * count)()
        self.count = count
        self.counts = (count,) if fmi == "2.0" else (count, count)

    def set(self, slave: Any, values: Sequence[float]) -> None:
        self.values[:] = values
        getattr(slave, self.set_name)(
            slave.component, self.references, self.count, self.values, *self.counts[1:]
        )

    def get(self, slave: Any) -> list[Any]:
        getattr(slave, self.get_name)(
            slave.component, self.references, self.count, self.values, *self.counts[1:]
        )
        return list(self.values)


class Ports:
    """The variables of one way, in the order in which their values come."""

    def __init__(self, found: list[Any], fmi: str) -> None:
        self.reals = [v for v in found if v.type in REALS]
        self.wholes = [v for v in found if v.type in WHOLES]
        self.groups: list[tuple[Group, list[int]]] = []
        listed = [*self.reals, *self.wholes]
        for kind in dict.fromkeys(v.type for v in listed):
            places = [k for k, v in enumerate(listed) if v.type == kind]
            references = [listed[k].valueReference for k in places]
            self.groups.append((Group(kind, references, fmi), places))
        self.names = [[v.name for v in self.reals], [v.name for v in self.wholes]]
        self.struct = f"<{len(self.reals)}d{len(self.wholes)}q"

    def set(self, slave: Any, values: Sequence[Any]) -> None:
        for group, places in self.groups:
            group.set(slave, [values[k] for k in places])

    def get(self, slave: Any) -> list[Any]:
        values: list[Any] = [0] * (len(self.reals) + len(self.wholes))
        for group, places in self.groups:
            for k, value in zip(places, group.get(slave), strict=True):
                values[k] = value
        return values


class Fmu:
    """One FMU, with one instance at a time. Raises FmuError for one that is not as wanted."""

    def __init__(self, wanted: Wanted, folder: Path) -> None:
        self.wanted = wanted
        with archive.opened(wanted.file) as packed:
            self.description = described(wanted.file, packed)
            refuse_another(wanted, self.description)
            self.fmi = "2.0" if self.description.fmiVersion == "2.0" else "3.0"
            self.variables = {v.name: v for v in self.description.modelVariables}
            self.said = ""  # the last trouble that it told of in the request under way
            refuse_without_binary(wanted.file, packed.namelist(), self.fmi, self.description)
            may_have_bus = wanted.bus_outputs is not None and self.fmi == "3.0"
            self.bus = bus_of(packed, self.variables) if may_have_bus else {}
            self._find_ports(wanted)
            archive.unpack(packed, folder)
        self.folder = folder
        self.slave: Any = None
        self.time_s = 0.0
        self.steps = 0
        self.log: list[bytes] = []
        self.seen = hashlib.blake2b()

    def _find_ports(self, wanted: Wanted) -> None:
        inputs, outputs = wanted.inputs, wanted.outputs
        if self.bus:
            inputs, outputs = [], wanted.bus_outputs or []
        self.inputs = Ports(self._ports(inputs, "input"), self.fmi)
        self.outputs = Ports(self._ports(outputs, "output"), self.fmi)
        for name, value in wanted.start.items():
            self._check_parameter(name, value)

    def opened(self) -> Opened:
        """What there is."""
        (real_in, whole_in), (real_out, whole_out) = self.inputs.names, self.outputs.names
        return Opened(
            *(self.fmi, real_in, whole_in, real_out, whole_out, bool(self.bus)),
            bool(self.description.coSimulation.needsExecutionTool),
        )

    def _ports(self, ports: Sequence[Port], causality: str) -> list[Any]:
        found = []
        for port in ports:
            at = f"key {port.key}: "
            if not port.key:
                at = f"{self.description.modelName!r}, expected the FMU of a {self.wanted.part}: "
            variable = self.variables.get(port.name)
            if variable is None:
                if port.needed:
                    raise FmuError(f"{at}there is no variable {port.name}")
                continue
            if variable.type not in (*REALS, *WHOLES) or variable.dimensions:
                raise FmuError(f"{at}{port.name} is no number")
            if variable.type not in KINDS[port.kind]:
                raise FmuError(
                    f"{at}{port.name} is of type {variable.type}, expected a {port.kind} number"
                )
            allowed = ("output", "local") if causality == "output" else (causality,)
            if variable.causality not in allowed:
                raise FmuError(
                    f"{at}{port.name} is of causality {variable.causality}, expected {causality}"
                )
            self._check_unit(at, port, variable)
            found.append(variable)
        return found

    def _check_unit(self, at: str, port: Port, variable: Any) -> None:
        declared = variable.declaredType
        unit = variable.unit or (declared.unit if declared is not None else None)
        if not port.unit or not unit:
            return
        exponents, names = UNITS[port.unit]
        for known in self.description.unitDefinitions:
            base = known.baseUnit
            if known.name == unit and base is not None:
                bases = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")
                has = {b: getattr(base, b) for b in bases if getattr(base, b, 0)}
                if has == exponents and (base.factor, base.offset) in ((1.0, 0.0), (None, None)):
                    return
                break
        else:
            if unit == port.unit or unit in names:
                return
        raise FmuError(f"{at}{port.name} is in {unit}, expected {port.unit}")

    def _check_parameter(self, name: str, value: float) -> None:
        variable = self.variables.get(name)
        if variable is None:
            raise FmuError(f"there is no parameter {name}")
        if variable.causality not in ("parameter", "input"):
            raise FmuError(f"{name} is of causality {variable.causality}, expected parameter")
        if variable.type not in (*REALS, *WHOLES) or variable.dimensions:
            raise FmuError(f"parameter {name} is no number")
        if variable.type == "Boolean" and value not in (0, 1):
            raise FmuError(f"parameter {name} is {value:g}, expected 0 or 1")
        if variable.type in WHOLES and value != int(value):
            raise FmuError(f"parameter {name} is {value:g}, expected a whole number")

    def start(self) -> None:
        """A new instance at the start."""
        from fmpy.fmi2 import FMU2Slave
        from fmpy.fmi3 import FMU3Slave

        arguments = {
            "guid": self.description.guid,
            "unzipDirectory": self.folder,
            "modelIdentifier": self.description.coSimulation.modelIdentifier,
            "instanceName": "ato_hil",
        }
        if self.slave is not None:
            self.slave.terminate()
            self.slave.freeInstance()
        slave = FMU2Slave(**arguments) if self.fmi == "2.0" else FMU3Slave(**arguments)
        self.slave = slave
        if self.fmi == "2.0":
            slave.instantiate(callbacks=self._callbacks())
            slave.setupExperiment(startTime=0.0)
            self._set_start()
            slave.enterInitializationMode()
            slave.exitInitializationMode()
        else:
            slave.instantiate(eventModeUsed=bool(self.bus), logMessage=self._hear)
            self._set_start()
            slave.enterInitializationMode()
            slave.exitInitializationMode()
        self.time_s, self.steps = 0.0, 0

    def _callbacks(self) -> Any:
        """Of FMI 2.0, with `_hear` as the logger."""
        import ctypes

        from fmpy import calloc, fmi2, free

        made = fmi2.fmi2CallbackFunctions()
        made.logger = fmi2.fmi2CallbackLoggerTYPE(self._hear)
        made.allocateMemory = fmi2.fmi2CallbackAllocateMemoryTYPE(calloc)
        made.freeMemory = fmi2.fmi2CallbackFreeMemoryTYPE(free)
        with suppress(ImportError, OSError):  # FMPy has it for some machines alone
            from fmpy.logging import addLoggerProxy  # puts numbers into the text

            addLoggerProxy(ctypes.byref(made))
        return made

    def _hear(self, *message: Any) -> None:
        """A message of the FMU: in the end its status, category and text."""
        status, _category, text = message[-3:]
        if status in TROUBLE and text:
            self.said = text.decode(errors="replace")

    def _set_start(self) -> None:
        for name, value in self.wanted.start.items():
            variable = self.variables[name]
            group = Group(variable.type, [variable.valueReference], self.fmi)
            group.set(self.slave, [value if variable.type in REALS else int(value)])

    def step(self, content: bytes) -> bytes:
        """A step for each row of inputs; the outputs after the last."""
        import struct

        for row in struct.iter_unpack(self.inputs.struct, content):
            self.inputs.set(self.slave, row)
            self._do_step()
        return struct.pack(self.outputs.struct, *self.outputs.get(self.slave))

    def _do_step(self) -> bool:
        """One step; whether an event has to be handled."""
        self.steps += 1
        end_s = self.steps * self.wanted.step_s
        if self.fmi == "2.0":
            self.slave.doStep(self.time_s, self.wanted.step_s)
            self.time_s = end_s
            return False
        event, terminated, _early, _last = self.slave.doStep(self.time_s, self.wanted.step_s)
        if terminated:
            raise FmuError("asks to end the simulation")
        self.time_s = end_s
        return bool(event)

    def turn(self, operations: bytes) -> bytes:
        """An event in which operations come from the bus, then a step: what is sent at once, what
        is sent after the step, and the outputs."""
        import struct

        at_once = self._event(operations) if operations or self.steps == 0 else b""
        self.slave.enterStepMode()
        later = b""
        event = self._do_step()
        self.slave.enterEventMode()
        if event:
            later = self._event(b"")
        sent = b"".join(COUNT.pack(len(part)) + part for part in (at_once, later))
        return sent + struct.pack(self.outputs.struct, *self.outputs.get(self.slave))

    def _event(self, operations: bytes) -> bytes:
        """What is sent in an event, which takes as many rounds as the FMU asks for."""
        slave, bus = self.slave, self.bus
        sent = b""
        if operations:
            slave.setClock([bus["Rx_Clock"]], [True])
            slave.setBinary([bus["Rx_Data"]], [operations])
        for _ in range(ITERATIONS_MAX):
            if slave.getClock([bus["Tx_Clock"]])[0]:
                sent += slave.getBinary([bus["Tx_Data"]])[0] or b""  # None: no bytes
            if not slave.updateDiscreteStates()[0]:
                return sent
        raise FmuError(f"an event does not end within {ITERATIONS_MAX} rounds")

    def answer(self, kind: bytes, content: bytes) -> bytes:
        """The answer to a request."""
        if kind == RESET:
            self.log, self.seen = [], hashlib.blake2b()
            self.start()
            return b""
        if kind == VERIFY:
            return b"1" if self._repeats() else b"0"
        given = self._given(kind, content)
        if self.wanted.keeps:
            self.log.append(kind + content)
            self.seen.update(given)
        return given

    def _given(self, kind: bytes, content: bytes) -> bytes:
        if kind == STEP:
            return self.step(content)
        return self._event(content) if kind == EVENT else self.turn(content)

    def _repeats(self) -> bool:
        """Whether a new instance gives the same on all requests since the last reset."""
        self.start()
        again = hashlib.blake2b()
        for request in self.log:
            kind, content = request[:1], request[1:]
            again.update(self._given(kind, content))
        return again.digest() == self.seen.digest()


def described(file: str, packed: zipfile.ZipFile) -> Any:
    """The model description. Raises FmuError."""
    try:
        from fmpy import read_model_description
    except ImportError:
        raise FmuError("FMPy is not installed, try: pip install 'ato-hil[fmi]'") from None
    root = xml_of(packed, "modelDescription.xml")
    if root is None:
        raise FmuError("no FMU: there is no modelDescription.xml in it")
    if root.tag != "fmiModelDescription":
        raise FmuError(f"no FMU: modelDescription.xml has {root.tag}, expected fmiModelDescription")
    version = root.get("fmiVersion", "without a version")
    if version != "2.0" and not version.startswith("3.0"):
        raise FmuError(f"is of FMI {version}, expected 2.0 or 3.0")
    try:
        description = read_model_description(file, validate=False)
    except Exception as error:  # of a foreign file, whatever it is
        raise FmuError(f"no FMU: {error or type(error).__name__}") from None
    if description.coSimulation is None:
        raise FmuError("is not for Co-Simulation")
    if not description.coSimulation.modelIdentifier:
        raise FmuError("no FMU: CoSimulation has no modelIdentifier")
    return description


def xml_of(packed: zipfile.ZipFile, name: str) -> Any:
    """The root of a description, None if there is none. Raises FmuError."""
    from xml.etree import ElementTree

    text = archive.text(packed, name)
    try:
        return None if text is None else ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise FmuError(f"no FMU: {name}: {error}") from None


def refuse_another(wanted: Wanted, description: Any) -> None:
    """Raises FmuError for an FMU of ours that was made for something else."""
    found = MADE_FOR.match(description.version or "")
    if found is None:
        return
    part, scenario, law = found.groups()
    if wanted.part and part != wanted.part:
        raise FmuError(
            f"{description.modelName!r}, the FMU of a {part}, expected that of a {wanted.part}"
        )
    if wanted.scenario and scenario != wanted.scenario:
        raise FmuError(f"made for scenario {scenario}, expected {wanted.scenario}")
    if wanted.law and law and law != wanted.law:
        raise FmuError(f"made for law {law}, expected {wanted.law}")


def refuse_without_binary(file: str, names: list[str], fmi: str, description: Any) -> None:
    """Raises FmuError if among the members there is no binary for this machine."""
    import fmpy

    platform = fmpy.platform if fmi == "2.0" else fmpy.platform_tuple
    has = {name.split("/")[1] for name in names if name.startswith("binaries/")} - {""}
    library = f"{description.coSimulation.modelIdentifier}{fmpy.sharedLibraryExtension}"
    if f"binaries/{platform}/{library}" in names:
        return
    if platform in has:
        raise FmuError(f"binaries/{platform} has no {library}")
    if not has and any(name.startswith("sources/") for name in names):
        raise FmuError(f"has no binary but sources, try: fmpy compile {file}")
    raise FmuError(
        f"has binaries for {', '.join(sorted(has)) or 'no machine'}, expected {platform}"
    )


def bus_of(packed: zipfile.ZipFile, variables: dict[str, Any]) -> dict[str, int]:
    """Value references of the members of its CAN terminal; empty if it has none."""
    root = xml_of(packed, "terminalsAndIcons/terminalsAndIcons.xml")
    if root is None:
        return {}
    buses = [t for t in root.iter("Terminal") if t.get("matchingRule") == TRANSCEIVER]
    if len(buses) > 1:
        raise FmuError(f"has {len(buses)} buses, expected one")
    members: dict[str, Any] = {
        member.get("memberName", ""): variables.get(member.get("variableName", ""))
        for terminal in buses
        for member in terminal.findall("TerminalMemberVariable")
    }
    if not buses:
        return {}
    names = ("Rx_Data", "Rx_Clock", "Tx_Data", "Tx_Clock")
    for name in names:
        if members.get(name) is None:
            raise FmuError(f"its bus has no {name}")
    if members["Tx_Clock"].causality != "output":
        raise FmuError("Tx_Clock is not a triggered clock, as this importer needs it")
    return {name: members[name].valueReference for name in names}


def one_line(text: str) -> str:
    """A text as one line, and not longer than TEXT_MOST."""
    text = " ".join(text.split())
    return text if len(text) <= TEXT_MOST else f"{text[:TEXT_MOST]} …"


def serve(line: socket.socket, folder: Path) -> None:
    """Answers requests until the other side is gone."""
    fmu: Fmu | None = None
    while True:
        head = line.recv(HEAD.size, socket.MSG_WAITALL)
        if len(head) < HEAD.size:
            return
        kind, length = HEAD.unpack(head)
        content = line.recv(length, socket.MSG_WAITALL) if length else b""
        if fmu is not None:
            fmu.said = ""
        try:
            if kind == OPEN:
                fmu = Fmu(msgspec.json.decode(content, type=Wanted), folder)
                given = msgspec.json.encode(fmu.opened())
            else:
                assert fmu is not None
                given = fmu.answer(kind, content)
        except Exception as error:  # ours, of FMPy, or of the FMU through it
            text = str(error).rstrip(".") or type(error).__name__
            if fmu is not None and kind in (STEP, EVENT, TURN):
                text += f" at {fmu.time_s:.6g} s"
            if fmu is not None and fmu.said:
                text += f"; it says: {fmu.said}"
            kind, given = ERROR, one_line(text.replace(f"{folder}{os.sep}", "")).encode()
        line.sendall(HEAD.pack(kind, len(given)) + given)


def main() -> int:
    """Exit status 0 when the other side is gone."""
    parser = argparse.ArgumentParser(
        prog="python -m ato_hil.plant_sim.fmi.child", description=__doc__
    )
    parser.add_argument("descriptor", type=int, help="of the socket")
    parser.add_argument("folder", type=Path, help="for what is unpacked")
    arguments = parser.parse_args()
    with socket.socket(fileno=arguments.descriptor) as line:
        serve(line, arguments.folder)
    # Without the destructors of the foreign library.
    sys.stdout.flush()
    os._exit(0)


if __name__ == "__main__":
    sys.exit(main())
