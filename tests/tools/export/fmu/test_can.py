"""An FMU as a CAN node of FMI-LS-BUS: operations in, operations out."""

import shutil
import struct
import subprocess
import sys
import zipfile
from xml.etree import ElementTree

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ato_hil.can_dbc import e2e
from ato_hil.can_dbc.codec import ATO_STATUS, RUN_CTRL, bytes_of, get, put, word_of
from ato_hil.can_dbc.step import dbc_path
from ato_hil.plant_sim.scenario import load
from ato_hil.tools.export.fmu import archive, controller, plant

SCENARIO = "subway-fast"
FORMAT_ERROR, TRANSMIT, CONFIRM, LOST, BUS_ERROR = 0x01, 0x10, 0x20, 0x30, 0x31
CONFIGURATION, STATUS, WAKEUP = 0x40, 0x41, 0x42
BUS = "CanChannel"


@pytest.fixture(scope="module")
def fmu(gcc, tmp_path_factory):
    path = tmp_path_factory.mktemp("fmu") / "ato.fmu"
    archive.write(controller.unpacked(load(SCENARIO), None), path)
    return path


def operation(code, content=b""):
    return struct.pack("<II", code, 8 + len(content)) + content


def frame(message, word, counter=0):
    data = bytes_of(int(e2e.protect(word, counter, message.data_id)))
    return operation(TRANSMIT, struct.pack("<IBBH", message.frame_id, 0, 0, 8) + data)


def armed(run=1, counter=0):
    word = put(RUN_CTRL.RunState, 1) + put(RUN_CTRL.Iteration, run)
    return frame(RUN_CTRL, word, counter)


def split(content):
    """(code, content) of each operation."""
    found, at = [], 0
    while at < len(content):
        code, length = struct.unpack_from("<II", content, at)
        found.append((code, content[at + 8 : at + length]))
        at += length
    return found


class Node:
    """An FMU in Event Mode, with what it sends."""

    def __init__(self, instance):
        self.instance, self.slave = instance, instance.slave
        name = instance.variables
        self.at = {
            n: name[f"{BUS}.{n}"].valueReference
            for n in ("Rx_Data", "Rx_Clock", "Tx_Data", "Tx_Clock")
        }
        self.first = self.event()

    def event(self, content=b""):
        sent = b""
        if content:
            self.slave.setClock([self.at["Rx_Clock"]], [True])
            self.slave.setBinary([self.at["Rx_Data"]], [content])
        for _ in range(20):
            if self.slave.getClock([self.at["Tx_Clock"]])[0]:
                sent += bytes(self.slave.getBinary([self.at["Tx_Data"]])[0])
            if not self.slave.updateDiscreteStates()[0]:
                return split(sent)
        raise AssertionError("the event does not end")

    def period(self):
        self.slave.enterStepMode()
        self.instance.step()
        self.slave.enterEventMode()
        return self.event()


def statuses(sent):
    return [content[0] for code, content in sent if code == STATUS]


def test_it_configures_the_bus_before_anything_else(fmu, opened):
    node = Node(opened(fmu, **{f"{BUS}.BitRate": 250_000}))
    assert node.first == [
        (CONFIGURATION, b"\x01" + struct.pack("<I", 250_000)),
        (CONFIGURATION, b"\x04\x01"),
    ]


def test_a_frame_is_answered_in_the_same_event(fmu, opened):
    node = Node(opened(fmu))
    [(code, content)] = node.event(armed(run=7))
    frame_id, extended, remote, length = struct.unpack_from("<IBBH", content)
    assert (code, frame_id, extended, remote, length) == (TRANSMIT, ATO_STATUS.frame_id, 0, 0, 8)
    assert get(word_of(content[8:]), ATO_STATUS.Iteration) == 7
    assert node.instance["ATO_STATUS.Iteration"] == 7
    assert node.period() == []


@pytest.mark.parametrize(
    "wrong",
    [
        b"\x10\x00\x00",
        operation(0x99, b"abc"),
        struct.pack("<II", TRANSMIT, 4000),
        struct.pack("<II", TRANSMIT, 3),
        operation(TRANSMIT, struct.pack("<IBBH", 1, 0, 0, 8) + b"1234567"),
        operation(CONFIRM, b"12345"),
        operation(BUS_ERROR, b"123456"),
        operation(STATUS),
        operation(WAKEUP, b"1"),
    ],
)
def test_what_is_malformed_goes_back_as_a_format_error(fmu, opened, wrong):
    node = Node(opened(fmu))
    [(code, content)] = node.event(wrong)
    assert code == FORMAT_ERROR
    assert content == struct.pack("<H", len(wrong)) + wrong
    assert [code for code, _ in node.event(armed())] == [TRANSMIT]


def test_what_is_for_others_is_passed_over(fmu, opened):
    node = Node(opened(fmu))
    of_others = b"".join(
        [
            operation(TRANSMIT, struct.pack("<IBBH", 0x7FF, 0, 0, 8) + bytes(8)),
            operation(TRANSMIT, struct.pack("<IBBH", RUN_CTRL.frame_id, 1, 0, 8) + bytes(8)),
            operation(TRANSMIT, struct.pack("<IBBH", RUN_CTRL.frame_id, 0, 1, 0)),
            operation(0x11, struct.pack("<IBBBH", RUN_CTRL.frame_id, 0, 0, 0, 2) + b"ab"),
            operation(0x12, struct.pack("<IBBBBIH", 1, 0, 0, 0, 0, 0, 1) + b"a"),
            operation(CONFIGURATION, b"\x01" + bytes(4)),
            operation(STATUS, b"\x03"),
            operation(WAKEUP),
            operation(FORMAT_ERROR, struct.pack("<H", 2) + b"ab"),
        ]
    )
    assert node.event(of_others) == []


def test_what_lost_the_arbitration_is_sent_again_until_it_is_confirmed(fmu, opened):
    node = Node(opened(fmu, **{f"{BUS}.BusNotifications": 1}))
    sent = node.event(armed())
    identifier = struct.pack("<I", ATO_STATUS.frame_id)
    assert node.event(operation(LOST, identifier)) == sent
    assert node.event(operation(LOST, identifier)) == sent
    assert node.event(operation(CONFIRM, identifier)) == []
    assert node.event(operation(LOST, identifier)) == []


def test_errors_lead_to_bus_off_and_back(fmu, opened):
    node = Node(opened(fmu, **{f"{BUS}.BusNotifications": 1}))
    sent = node.event(armed())
    as_sender = operation(BUS_ERROR, struct.pack("<IBBB", ATO_STATUS.frame_id, 4, 1, 1))
    told = []
    for count in range(1, 33):
        answer = node.event(as_sender)
        told += statuses(answer)
        if count < 32:
            assert answer[-1] == sent[0]
        assert node.instance[f"{BUS}.TransmitErrors"] == min(8 * count, 256)
    assert told == [2, 3]
    assert node.instance[f"{BUS}.NodeState"] == 3
    assert node.event(armed(counter=1)) == []  # it is silent, and hears nothing
    assert statuses(node.period()) == [1]
    assert [code for code, _ in node.event(armed(counter=2))] == [TRANSMIT]


def test_errors_of_others_count_by_who_saw_them_first(fmu, opened):
    node = Node(opened(fmu, **{f"{BUS}.BusNotifications": 1}))
    for flag, expected in ((1, 8), (2, 9)):
        node.event(operation(BUS_ERROR, struct.pack("<IBBB", 0x100, 1, flag, 0)))
        assert node.instance[f"{BUS}.ReceiveErrors"] == expected


def test_without_notifications_they_are_ignored(fmu, opened):
    node = Node(opened(fmu))
    node.event(armed())
    identifier = struct.pack("<I", ATO_STATUS.frame_id)
    assert node.event(operation(LOST, identifier)) == []
    assert node.event(operation(BUS_ERROR, identifier + b"\x04\x01\x01")) == []
    assert node.instance[f"{BUS}.TransmitErrors"] == 0


@given(st.lists(st.binary(max_size=400), max_size=5))
@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_bytes_are_taken_without_harm(node, content):
    for part in content:
        for code, _content in node.event(part):
            assert code in (FORMAT_ERROR, TRANSMIT)
    node.event(operation(WAKEUP))


@pytest.fixture
def node(fmu, opened):
    return Node(opened(fmu))


def test_too_much_at_once_is_refused(node):
    with pytest.raises(Exception, match="status 3"):
        node.event(bytes(5000))


def test_a_frame_that_nobody_fetches_is_offered_after_the_next_step(fmu, opened):
    node = Node(opened(fmu))
    slave = node.slave
    slave.setClock([node.at["Rx_Clock"]], [True])
    slave.setBinary([node.at["Rx_Data"]], [armed()])
    assert slave.updateDiscreteStates()[0]  # and the importer does not iterate
    slave.enterStepMode()
    assert slave.doStep(0.0, 0.001)[0]
    slave.enterEventMode()
    assert [code for code, _ in node.event()] == [TRANSMIT]


def test_a_long_step_ends_early_where_there_is_something_to_send(gcc, tmp_path, opened):
    path = tmp_path / "train.fmu"
    archive.write(plant.unpacked(load(SCENARIO), None), path)
    node = Node(opened(path))
    assert [code for code, _ in node.first] == [CONFIGURATION, CONFIGURATION, TRANSMIT]
    node.slave.enterStepMode()
    event, _ended, early, reached = node.slave.doStep(0.0, 0.05)
    assert (event, early, reached) == (True, False, 0.05)  # nobody has allowed it
    node.slave.enterEventMode()
    assert len(node.event()) == 5


def test_terminal_manifest_and_dbc_are_inside(fmu):
    with zipfile.ZipFile(fmu) as content:
        extra = "extra/org.fmi-standard.fmi-ls-bus"
        assert content.read(f"{extra}/{BUS}.dbc") == dbc_path().read_bytes()
        manifest = ElementTree.fromstring(content.read(f"{extra}/fmi-ls-manifest.xml"))
        root = ElementTree.fromstring(content.read("terminalsAndIcons/terminalsAndIcons.xml"))
        names = ElementTree.fromstring(content.read("modelDescription.xml"))
    prefix = "{http://fmi-standard.org/fmi-ls-manifest}"
    assert manifest.get(f"{prefix}fmi-ls-version") == "1.0.0"
    assert manifest.get("isBusSimulationFMU") == "false"
    variables = {v.get("name") for v in names.iter() if v.get("valueReference")}
    for member in root.iter("TerminalMemberVariable"):
        assert member.get("variableName") in variables


@pytest.mark.parametrize("part", [controller, plant])
def test_it_is_valid(part, gcc, tmp_path):
    validation = pytest.importorskip("fmpy.validation")
    archive.write(part.unpacked(load(SCENARIO), None), tmp_path / "it.fmu")
    assert validation.validate_fmu(str(tmp_path / "it.fmu")) == []


@pytest.mark.long
@pytest.mark.parametrize("bus", ["can", "none"])
@pytest.mark.parametrize("part", [controller, plant])
def test_fmpy_compiles_it_without_a_word(part, bus, tmp_path):
    pytest.importorskip("fmpy")
    if shutil.which("cmake") is None:
        pytest.skip("cmake is not installed")
    path = tmp_path / "it.fmu"
    archive.write(part.unpacked(load(SCENARIO), None, bus), path)
    done = subprocess.run(
        [
            *(sys.executable, "-m", "fmpy.cli", "compile", "--all-warnings"),
            *("--warning-as-error", str(path)),
        ],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "warning" not in done.stdout + done.stderr
