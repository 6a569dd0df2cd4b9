"""The folder that `ato-hil export c` writes, whole or not at all."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

from ato_hil.plant_sim.scenario import load, members
from ato_hil.tools.export import ExportError, firmware, misra, vectors
from ato_hil.tools.export.firmware import Firmware, Translated
from ato_hil.tools.runs import onboard

HERE = Path(__file__).parent
FILES = (
    "ato.h",
    "ato.c",
    "ato_config.c",
    "ato_can.h",
    "ato_vectors.h",
    "ato_selftest.c",
    "CMakeLists.txt",
    "MISRA.md",
)


def files(scenario: str, law: str | None) -> dict[str, str]:
    """Text of each file, by name. Raises ExportError, or what loading the scenario and the law
    raises."""
    loaded = load(scenario)
    law = law or loaded.scenario.law
    firmware.refuse(law)
    trains = members(loaded)
    fw = Firmware(loaded.name, [onboard.calibration_for(train, law) for train in trains])
    made = Translated(fw)
    source = firmware.source_file(made)  # names the records that the header defines
    sources = {
        "ato.h": firmware.header_file(made),
        "ato.c": source,
        "ato_config.c": firmware.config_file(made),
    }
    recorded = vectors.record(trains[0], law)
    first = ["The first ticks of two runs: frames in, frames out, digest."]
    return {
        **sources,
        "ato_can.h": firmware.can_file(fw),
        "ato_vectors.h": firmware.text_of(
            [*firmware.top(fw, first[0]), '#include "ato.h"', "", *vectors.header(recorded)]
        ),
        "ato_selftest.c": firmware.text_of(
            [
                *firmware.top(fw, "The golden vectors, for the host and for the target."),
                (HERE / "selftest.c").read_text(encoding="utf-8"),
            ]
        ),
        "CMakeLists.txt": firmware.cmake_file(fw),
        "MISRA.md": firmware.text_of(misra.page(sources, firmware.banner(fw))),
    }


def write(made: dict[str, str], out: Path) -> None:
    """Writes the folder. One that is there is replaced, if it holds nothing but an export.

    Raises ExportError.
    """
    known = {*FILES, "build"}
    try:
        if out.exists():
            strange = sorted(path.name for path in out.iterdir() if path.name not in known)
            if strange:
                raise ExportError(f"{out}: has {strange[0]}, expected a new folder or an export")
        out.parent.mkdir(parents=True, exist_ok=True)
        fresh = Path(tempfile.mkdtemp(prefix=f".{out.name}.", dir=out.parent))
        try:
            for name, text in made.items():
                (fresh / name).write_text(text, encoding="utf-8")
            fresh.chmod(0o755)
            if out.exists():
                shutil.rmtree(out)
            fresh.replace(out)
        except BaseException:
            shutil.rmtree(fresh, ignore_errors=True)
            raise
    except OSError as error:
        raise ExportError(f"{out}: {error.strerror}") from None
