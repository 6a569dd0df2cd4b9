"""The rules of the house: imports point one way, steps stay integer, no machine is named."""

import ast
import importlib
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent

MAY_IMPORT = {
    "can_dbc": set(),
    "controller": {"can_dbc"},
    "plant_sim": {"can_dbc"},
    "tools": {"can_dbc", "controller", "plant_sim"},
}
ROOMS = (
    {"runs"},
    {"trace"},
    {"session"},
    {"campaigns", "papers", "export", "lines"},
    {"verify", "reports", "bench"},
    {"cli"},
)
MODULES = sorted(path for package in MAY_IMPORT for path in (ROOT / package).rglob("*.py"))

FLOAT_NAMES = {"float", "round", "float16", "float32", "float64", "double", "math"}

REGISTRY_HOST = re.compile(r"\b(pypi|pythonhosted|debian|ubuntu|npmjs)\.(org|com)\b")
MACHINE_PATH = re.compile(r"(?<![\w.~$}/-])/(work|root|home|Users)/[\w.]")


def relative(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


# Imports point one way.


def imported_packages(source: str) -> set[str]:
    """Our packages that `source` imports, and other top-level names."""
    names = [name.split(".") for name in imported(source)]
    return {parts[1] if parts[0] == "ato_hil" else parts[0] for parts in names}


def imported(source: str) -> set[str]:
    """Dotted names that `source` imports, wherever in the module the import stands."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            names.update(f"{node.module}.{alias.name}" for alias in node.names)
    return names


@pytest.mark.parametrize("package", MAY_IMPORT)
def test_imports_point_one_way(package):
    forbidden = {*MAY_IMPORT, "tests"} - MAY_IMPORT[package] - {package}
    found = {
        f"{relative(path)} imports {name}"
        for path in MODULES
        if path.is_relative_to(ROOT / package)
        for name in imported_packages(path.read_text(encoding="utf-8")) & forbidden
    }
    assert not found


def test_an_import_is_seen_in_every_form():
    source = (
        "import a.b\nfrom c.d import x\ndef f():\n    import e as g\nfrom . import h\n"
        "from ato_hil.p.q import y\nfrom ato_hil import r\nimport ato_hil.s\n"
    )
    assert imported_packages(source) == {"a", "c", "e", "p", "r", "s"}


def room(path: Path) -> str:
    """The room of a module in tools/."""
    return path.relative_to(ROOT / "tools").parts[0]


def test_no_room_of_tools_imports_from_beside_or_above():
    paths = [path for path in MODULES if path.is_relative_to(ROOT / "tools")]
    modules = [path for path in paths if path.parent != ROOT / "tools"]
    level = {name: number for number, names in enumerate(ROOMS) for name in names}
    assert {room(path) for path in modules} == set(level)
    found = {
        f"{relative(path)} imports {name}"
        for path in modules
        for name in imported(path.read_text(encoding="utf-8"))
        if name.startswith("ato_hil.tools.")
        and (there := name.split(".")[2]) != room(path)
        and level[there] >= level[room(path)]
    }
    assert not found


@pytest.mark.parametrize("package", MAY_IMPORT)
def test_no_circle(package):
    names = {module_name(path): path for path in MODULES if path.is_relative_to(ROOT / package)}
    needs = {
        name: {
            owner
            for each in imported(path.read_text(encoding="utf-8"))
            if (owner := each if each in names else each.rpartition(".")[0]) in names
        }
        - {name}
        for name, path in names.items()
    }
    assert not circle(needs)


def circle(needs: dict[str, set[str]]) -> list[str]:
    """Modules that need each other; none if there is an order in which all can be loaded."""
    left = dict(needs)
    while ready := [name for name, what in left.items() if not what & left.keys()]:
        for name in ready:
            del left[name]
    return sorted(left)


def test_a_circle_is_seen():
    assert circle({"a": {"b"}, "b": set(), "c": {"a"}}) == []
    assert circle({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == ["a", "b", "c"]


# Steps stay integer.


def steps(tree: ast.Module) -> Iterator[ast.FunctionDef]:
    """Functions that carry `@step`, nested ones as well."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            decorators = [d.func if isinstance(d, ast.Call) else d for d in node.decorator_list]
            if any(isinstance(d, ast.Name) and d.id == "step" for d in decorators):
                yield node


def float_uses(function: ast.FunctionDef) -> list[str]:
    """Whatever in a step would bring in a float: one entry a finding, "line: what"."""
    found = []
    for node in ast.walk(function):
        match node:
            case ast.Constant(value=float() | complex() as value):
                found.append(f"{node.lineno}: constant {value}")
            case ast.BinOp(op=ast.Div()) | ast.AugAssign(op=ast.Div()):
                found.append(f"{node.lineno}: true division")
            case ast.BinOp(op=ast.Pow()) | ast.AugAssign(op=ast.Pow()):
                found.append(f"{node.lineno}: power")
            case ast.Name(id=name) | ast.Attribute(attr=name) if name in FLOAT_NAMES:
                found.append(f"{node.lineno}: {name}")
    return found


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(("ato_hil", *(parts[:-1] if parts[-1] == "__init__" else parts)))


CONTROLLER_MODULES = [path for path in MODULES if path.is_relative_to(ROOT / "controller")]


@pytest.mark.parametrize("path", CONTROLLER_MODULES, ids=relative)
def test_steps_of_the_controller_use_no_float(path):
    functions = list(steps(ast.parse(path.read_text(encoding="utf-8"))))
    found = [f"{relative(path)}:{use}" for function in functions for use in float_uses(function)]

    # A constant is compiled into the step by its value, so the value is what counts.
    names = {node.id for f in functions for node in ast.walk(f) if isinstance(node, ast.Name)}
    values = vars(importlib.import_module(module_name(path))) if names else {}
    found += [
        f"{relative(path)}: {name} is a float"
        for name in sorted(names)
        if isinstance(values.get(name), float | complex)
    ]
    assert not found


@pytest.mark.parametrize(
    ("body", "what"),
    [
        ("return 0.5", "constant 0.5"),
        ("return x / 2", "true division"),
        ("x /= 2", "true division"),
        ("return x ** 2", "power"),
        ("return float(x)", "float"),
        ("return round(x)", "round"),
        ("return np.float64(x)", "float64"),
        ("return math.isqrt(x)", "math"),
    ],
)
def test_a_float_in_a_step_is_seen(body, what):
    tree = ast.parse(f"@step\ndef f(x):\n    {body}\n")
    assert [use for function in steps(tree) for use in float_uses(function)] == [f"3: {what}"]


def test_an_integer_step_and_float_calibration_pass():
    tree = ast.parse(
        "def calibrate(x):\n    return x / 0.5\n"
        "@step\ndef f(x):\n    return (x * 3 + 1) // 2 >> 4\n"
    )
    assert [f.name for f in steps(tree)] == ["f"]
    assert not [use for function in steps(tree) for use in float_uses(function)]


# What is written is what an installation has.

BARE_IMPORT = re.compile(
    rf"\bfrom ({'|'.join(MAY_IMPORT)})(\.\w+)* import\b|\bimport ({'|'.join(MAY_IMPORT)})\.\w"
    rf"|-m ({'|'.join(MAY_IMPORT)})\."
)


def test_nothing_imports_a_folder_by_its_own_name():
    """Not in scripts within tests and in pages, either: installed, there is ato_hil alone."""
    found = [
        f"{relative(path)}:{number}: {line.strip()}"
        for path in repository_files()
        for number, line in enumerate(
            path.read_text(encoding="utf-8", errors="ignore").splitlines(), start=1
        )
        if BARE_IMPORT.search(line)
    ]
    assert not found


@pytest.mark.parametrize("folder", MAY_IMPORT)
@pytest.mark.parametrize(
    ("form", "is_bare"),
    [
        ("x = 'from {} import e2e'", True),
        ("from {}.runs import can_logs", True),
        ("import {}.atp", True),
        ("python -m {}.cli.docs", True),
        ("from ato_hil.{} import e2e", False),
        ("python -P -m ato_hil.{}.cli.docs", False),
        ("import {}, link", False),  # as in a folder of examples
    ],
)
def test_a_bare_import_is_seen(form, is_bare, folder):
    assert bool(BARE_IMPORT.search(form.format(folder))) == is_bare


# No machine is named in the repository.


def repository_files() -> list[Path]:
    """Files of the repository and those about to join it; without git, what an archive holds."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listing = None
    if shutil.which("git"):
        listing = subprocess.run(command, cwd=ROOT, capture_output=True, check=False, text=True)
    if listing and listing.returncode == 0:
        paths = [ROOT / name for name in listing.stdout.split("\0") if name]
    else:
        paths = [path for path in ROOT.iterdir() if path.suffix in {".toml", ".lock", ".md"}]
        paths += [path for name in (*MAY_IMPORT, "tests") for path in (ROOT / name).rglob("*")]
    return sorted(path for path in paths if path.is_file() and "__pycache__" not in path.parts)


def machine_names(text: str) -> list[str]:
    """Registry hosts and absolute paths of one machine: one entry a finding, "line: match"."""
    return [
        f"{number}: {match.group()}"
        for number, line in enumerate(text.splitlines(), start=1)
        for pattern in (REGISTRY_HOST, MACHINE_PATH)
        for match in pattern.finditer(line)
    ]


def test_no_registry_host_and_no_machine_path():
    files = repository_files()
    assert ROOT / "pyproject.toml" in files
    found = [
        f"{relative(path)}:{name}"
        for path in files
        for name in machine_names(path.read_text(encoding="utf-8", errors="ignore"))
    ]
    assert not found


def test_locks_hold_hashes_and_no_address():
    for path in (ROOT / "requirements.lock", ROOT / "requirements-dev.lock"):
        text = path.read_text(encoding="utf-8")
        requirements = text.replace("\\\n", "").splitlines()
        assert requirements
        assert "://" not in text
        assert [line for line in requirements if not re.match(r"\S+==\S+.* --hash=", line)] == []


@pytest.mark.parametrize("folder", ["work", "root", "home", "Users"])
@pytest.mark.parametrize("form", ["/{}/x", "a = '/{}/main'", "(/{}/y)", "file:/{}/z"])
def test_a_machine_path_is_seen(form, folder):
    assert machine_names(form.format(folder)) == [f"1: /{folder}/{form[form.index('}') + 2]}"]


@pytest.mark.parametrize("form", ["https://{}.org/simple", "host: files.{}.org", "{}.com"])
def test_a_registry_host_is_seen(form):
    assert len(machine_names(form.format("pypi"))) == 1


@pytest.mark.parametrize("folder", ["work", "root", "home"])
@pytest.mark.parametrize("form", ["tests/{}/x", "$HOME/{}/x", "~/{}/x", "./{}/x", "/ {}"])
def test_a_relative_path_is_no_machine_path(form, folder):
    assert machine_names(form.format(folder)) == []
