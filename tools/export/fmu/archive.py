"""The file of an FMU: always the same bytes of the same content, and a binary for this machine."""

from __future__ import annotations

import platform
import shutil
import subprocess
import sys
import tempfile
import zipfile
from dataclasses import dataclass
from pathlib import Path

from ato_hil.can_dbc.step import dbc_path
from ato_hil.tools.export import ExportError
from ato_hil.tools.export.fmu import description
from ato_hil.tools.export.fmu.description import About
from ato_hil.tools.export.fmu.variables import TERMINAL, Interface

# A float is what the source says on every machine: no multiply-add in one.
FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-fPIC", "-shared", "-fvisibility=hidden")
STRICT = ("-pedantic", "-Wall", "-Wextra", "-Wconversion", "-Wsign-conversion", "-Werror")
SYSTEMS = {"linux": ("linux", "so"), "darwin": ("darwin", "dylib")}
MACHINES = {"x86_64": "x86_64", "AMD64": "x86_64", "aarch64": "aarch64", "arm64": "aarch64"}
EPOCH = (1980, 1, 1, 0, 0, 0)  # the earliest date of an archive


@dataclass(frozen=True)
class Unpacked:
    """An FMU before it is packed; `sources` the text of each C file by name."""

    about: About
    interface: Interface
    sources: dict[str, str]

    @property
    def files(self) -> dict[str, str]:
        """All but the binary, by path."""
        compiled = [name for name in self.sources if name.endswith(".c")]
        made = {
            "modelDescription.xml": description.model(self.about, self.interface),
            "sources/buildDescription.xml": description.build(self.about, compiled),
            **{f"sources/{name}": text for name, text in self.sources.items()},
        }
        if self.interface.has_bus:
            extra = f"extra/{description.LS_BUS}"
            made["terminalsAndIcons/terminalsAndIcons.xml"] = description.terminals(self.interface)
            made[f"{extra}/fmi-ls-manifest.xml"] = description.manifest()
            made[f"{extra}/{TERMINAL}.dbc"] = dbc_path().read_text(encoding="utf-8")
        return made


def platform_tuple() -> tuple[str, str] | None:
    """Name of this machine as FMI has it, and the ending of a library; None for an unknown one."""
    system, machine = SYSTEMS.get(sys.platform), MACHINES.get(platform.machine())
    return None if system is None or machine is None else (f"{machine}-{system[0]}", system[1])


def write(unpacked: Unpacked, out: Path) -> str:
    """Writes the FMU, whole or not at all. What to know about its binary, "" if it has one.

    Raises ExportError.
    """
    if out.suffix != ".fmu":
        raise ExportError(f"{out}: expected a name that ends in .fmu")
    content = {path: text.encode() for path, text in unpacked.files.items()}
    binary, missing = _binary(unpacked)
    content |= binary
    fresh = out.with_name(f".{out.name}.new")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with zipfile.ZipFile(fresh, "w", zipfile.ZIP_DEFLATED) as archive:
            for path in sorted(content):
                entry = zipfile.ZipInfo(path, EPOCH)
                entry.compress_type = zipfile.ZIP_DEFLATED
                entry.external_attr = (0o755 if path.startswith("binaries/") else 0o644) << 16
                archive.writestr(entry, content[path])
        fresh.replace(out)
    except OSError as error:
        fresh.unlink(missing_ok=True)
        raise ExportError(f"{out}: {error.strerror}") from None
    return missing


def _binary(unpacked: Unpacked) -> tuple[dict[str, bytes], str]:
    """The binary for this machine by its path, or why there is none."""
    place = platform_tuple()
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if place is None:
        return {}, f"no binary: {platform.machine()} on {sys.platform} is unknown"
    if compiler is None:
        return {}, "no binary: no C compiler is installed; the sources are in the FMU"
    name = unpacked.about.identifier
    with tempfile.TemporaryDirectory(prefix="ato-hil-") as scratch:
        folder = Path(scratch)
        for file, text in unpacked.sources.items():
            (folder / file).write_text(text, encoding="utf-8")
        # In that folder and without a path of its own: the same bytes wherever it is made.
        compiled = sorted(file for file in unpacked.sources if file.endswith(".c"))
        command = [compiler, *FLAGS, *STRICT, *compiled, "-o", f"{name}.{place[1]}", "-lm"]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            lines = [line for line in done.stderr.splitlines() if "error" in line]
            raise ExportError(f"{name}: {(lines or ['not compiled'])[0]}")
        library = (folder / f"{name}.{place[1]}").read_bytes()
    return {f"binaries/{place[0]}/{name}.{place[1]}": library}, ""
