"""The controller as an FMU: the exported firmware behind the functions of FMI."""

from __future__ import annotations

import importlib.metadata

from ato_hil.controller import library
from ato_hil.controller.process import CATCH_UP_MAX
from ato_hil.controller.registry import law_label
from ato_hil.plant_sim.scenario import Loaded, members
from ato_hil.tools.export import firmware
from ato_hil.tools.export.firmware import Firmware, Translated
from ato_hil.tools.export.fmu import can, sources, variables
from ato_hil.tools.export.fmu.archive import Unpacked
from ato_hil.tools.export.fmu.description import About
from ato_hil.tools.export.fmu.variables import Interface, Variable
from ato_hil.tools.runs import onboard


def unpacked(loaded: Loaded, law: str | None, bus: str = "can") -> Unpacked:
    """The controller of a scenario. Raises ExportError, or what loading the law raises."""
    law = law or loaded.scenario.law
    firmware.refuse(law)
    made = Firmware(loaded.name, [onboard.calibration_for(train, law) for train in members(loaded)])
    about = About(
        identifier="ato",
        title=f"ATO {law_label(law)}, {loaded.name}",
        text=f"Automatic train operation: law {law_label(law)}, scenario {loaded.name}",
        version=importlib.metadata.version("ato-hil"),
        content=f"controller, scenario {loaded.digest}, law {law_label(law)},"
        f" sources {library.source_digest(law)}, bus {bus}",
        period_s=loaded.scenario.period_s,
        stop_s=round((loaded.ticks + 2) * loaded.scenario.period_s, 9),
    )
    interface = variables.begun()
    macros = {}
    if loaded.trains > 1:
        interface.add(
            Variable(
                *("train", "Int64", "parameter", "Place in the line, 0 leads", 0),
                low=0,
                high=loaded.trains - 1,
            )
        )
        macros["FMU_TRAIN"] = "train"
    received, sent = onboard.frames(loaded)
    if bus == "can":
        macros |= can.add(interface, received, sent)
    else:
        variables.add_plain(interface, received, sent)
    return Unpacked(about, interface, _files(made, about, interface, macros))


def _files(
    made: Firmware, about: About, interface: Interface, macros: dict[str, str]
) -> dict[str, str]:
    translated = Translated(made)
    ato = firmware.source_file(translated)  # names the records that the header defines
    model = sources.text("controller.c").replace("@CATCH_UP_MAX@", str(CATCH_UP_MAX))
    return {
        "ato.h": firmware.header_file(translated),
        "ato.c": ato,
        "ato_can.h": firmware.can_file(made),
        "ato_config.c": firmware.config_file(translated),
        "fmu_model.h": sources.text("controller_model.h"),
        "fmu_model.c": model,
        **sources.shared(about, interface, macros),
    }
