"""The records around a law, and the names of the fault bits."""

import numpy as np
import pytest

from ato_hil.can_dbc.codec import (
    ATO_STATUS,
    database,
)
from ato_hil.controller import firmware
from ato_hil.controller.interface import FAULTS
from ato_hil.controller.registry import law_names, load_law


def test_the_dbc_names_the_fault_bits():
    comment = database().get_message_by_name("ATO_STATUS").get_signal_by_name("Faults").comment
    assert comment == "Fault bits, lowest first: " + ", ".join(FAULTS.values())
    assert list(FAULTS) == [1 << bit for bit in range(ATO_STATUS.Faults.length)]


def fields_bytes(dtype):
    """Bytes of all fields of a record, without what lies between them."""
    if dtype.subdtype:
        return fields_bytes(dtype.subdtype[0]) * int(np.prod(dtype.subdtype[1]))
    if dtype.names is None:
        return dtype.itemsize
    return sum(fields_bytes(dtype[name]) for name in dtype.names)


@pytest.mark.parametrize("law", law_names())
def test_the_records_around_a_law_have_no_hidden_padding(law):
    module = load_law(law)
    for dtype in (firmware.params_dtype(module.PARAMS), firmware.state_dtype(module.STATE)):
        assert fields_bytes(dtype) == dtype.itemsize
