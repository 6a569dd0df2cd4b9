"""Where a result comes from: versions, machine and configuration, as summary.json holds them."""

from __future__ import annotations

import importlib.metadata
import math
import os
import platform
import re
import subprocess
from pathlib import Path
from typing import Any

import msgspec

from ato_hil.plant_sim.scenario import Loaded

ROOT = Path(__file__).resolve().parents[2]
DISTRIBUTION = "ato-hil"
GIT_TIMEOUT_S = 5.0


def versions() -> dict[str, Any]:
    """Of ato-hil, its commit (None outside a git tree), Python and the packages that it needs."""
    return {
        "ato_hil": _version(DISTRIBUTION),
        "commit": _commit(),
        "python": platform.python_version(),
        "packages": {name: _version(name) for name in _needed()},
    }


def machine() -> dict[str, Any]:
    """System, kernel and processor; nothing that names the user or the host."""
    return {
        "system": platform.system(),
        "kernel": platform.release(),
        "architecture": platform.machine(),
        "processor": _processor(),
        "cores": os.cpu_count(),
    }


def configuration(loaded: Loaded) -> dict[str, Any]:
    """The scenario with everything that it inherits, as msgspec converts it back.

    Infinite values are left out, they are defaults: JSON has none.
    """
    content: dict[str, Any] = _finite(msgspec.to_builtins(loaded.scenario))
    return content


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {
            key: _finite(item)
            for key, item in value.items()
            if not (isinstance(item, float) and math.isinf(item))
        }
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return value


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _needed() -> list[str]:
    """Names of the packages that ato-hil depends on, extras left out."""
    try:
        lines = importlib.metadata.requires(DISTRIBUTION) or []
    except importlib.metadata.PackageNotFoundError:
        return []
    names = [re.split(r"[^\w.-]", line, maxsplit=1)[0] for line in lines if "extra ==" not in line]
    return sorted(names)


def _commit() -> str | None:
    """What git says of the tree that this file is in, if it is a tree of its own."""
    if not (ROOT / ".git").exists():  # an installation inside the tree of something else
        return None
    command = ["git", "-C", str(ROOT), "describe", "--always", "--dirty", "--abbrev=12"]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=GIT_TIMEOUT_S, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip() or None


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()
