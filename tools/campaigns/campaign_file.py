"""A campaign as its file states it: a scenario, laws, seeds, what varies, faults; and the jobs that
follow, each from its number alone, so that a million of them takes no memory.

    scenario = "subway"
    laws = ["cailc", "pid"]
    runs = 5
    seeds = 20
    samples = 50
    sampling = "latin-hypercube"
    bounds = ["|stop_error_m| < 0.3", "faults == 0"]

    [[vary]]
    key = "train.mass_kg"
    normal = [194e3, 10e3]
    within = [170e3, 220e3]

docs/campaigns.md says what each key is. Listed values and grids are crossed with each other, with
the samples of what is drawn, with faults, laws and seeds.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from ato_hil.can_dbc import settings
from ato_hil.can_dbc.errors import InputError, validation
from ato_hil.controller.registry import is_file, law_label
from ato_hil.plant_sim import scenario as scenarios
from ato_hil.tools.campaigns import distributions
from ato_hil.tools.campaigns.sweep import CASE, put
from ato_hil.tools.campaigns.varied import WAYS, Grid, Varied
from ato_hil.tools.runs import expect, toml
from ato_hil.tools.session.job import Job
from ato_hil.tools.session.options import RUNS_MAX

NONE = "none"  # in place of a file of faults
OWN = "own"  # seeds: another one for each point
OURS = ("session", "run", "runs", "law", "laws", "seed", "faults", "faults_file", "base", "cases")
SEED_MAX = 2**63 - 1

Count = Annotated[int, msgspec.Meta(ge=1, le=10_000_000)]
Seed = Annotated[int, msgspec.Meta(ge=0, le=SEED_MAX)]


class CampaignError(InputError):
    """The campaign is wrong, or cannot be made; one line that names file and key."""


class File(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The file's keys."""

    scenario: str
    title: str = ""
    laws: list[str] = []
    runs: Annotated[int, msgspec.Meta(ge=1, le=RUNS_MAX)] | None = None
    seeds: Count | list[Seed] | Literal["own"] = 1
    faults: tuple[str, ...] = (NONE,)
    vary: list[Varied] = []
    samples: Count = 1
    sampling: Literal["random", "latin-hypercube", "sobol"] = "random"
    sampling_seed: Seed = 1
    # What the statistics are of; rows that are there serve others as well.
    from_run: Annotated[int, msgspec.Meta(ge=1, le=RUNS_MAX)] = 1
    bounds: list[str] = []
    worst: Annotated[int, msgspec.Meta(ge=0, le=1000)] = 10
    worst_by: str = "max_position_error_m"


STATISTICS = ("title", "from_run", "bounds", "worst", "worst_by")


@dataclass(frozen=True)
class Session:
    """One job of a campaign, and what tells it from the others."""

    number: int
    values: dict[str, Any]  # of what varies, by key
    law: str
    seed: int
    faults: str  # the file, NONE for none
    job: Job  # names of files as in `Campaign.files`


@dataclass(frozen=True)
class Campaign:
    """A campaign that is good as far as its file goes."""

    path: Path
    text: str
    file: File
    scenario: str  # a packaged one, or its name in `files`
    laws: tuple[str, ...]  # built-in ones, or their names in `files`
    plans: tuple[str, ...]  # of faults: their names in `files`, or NONE
    files: dict[str, str]  # what is not packaged: content by name
    listed: tuple[tuple[Any, ...], ...]  # values of each key that is not drawn
    drawn: np.ndarray  # [samples, drawn keys]
    bounds: tuple[expect.Expectation, ...]
    identity: str  # of all that the rows depend on, but for the program

    @property
    def title(self) -> str:
        """What it is called."""
        return self.file.title or self.path.stem

    @property
    def varied(self) -> list[str]:
        """Keys of what varies."""
        return [each.key for each in self.file.vary]

    @property
    def points(self) -> int:
        """Combinations of what varies."""
        return len(self.drawn) * int(np.prod([len(v) for v in self.listed], dtype=np.int64))

    @property
    def seeds(self) -> int:
        """How many each point is run with."""
        seeds = self.file.seeds
        return 1 if seeds == OWN else seeds if isinstance(seeds, int) else len(seeds)

    @property
    def sessions(self) -> int:
        """How many there are."""
        return self.points * len(self.plans) * len(self.laws) * self.seeds

    def session(self, number: int) -> Session:
        """One of them, from 0 on; seeds change fastest, then laws, faults, points."""
        rest, seed_at = divmod(number, self.seeds)
        rest, law_at = divmod(rest, len(self.laws))
        point, plan_at = divmod(rest, len(self.plans))
        seeds = self.file.seeds
        seed = 1 + point if seeds == OWN else seed_at + 1 if isinstance(seeds, int) else 0
        if isinstance(seeds, list):
            seed = seeds[seed_at]
        values, law, plan = self.values(point), self.laws[law_at], self.plans[plan_at]
        overlay: dict[str, Any] = {}
        for key, value in values.items():
            if key != CASE:
                put(overlay, key, law, value)
        job = Job(
            scenario=f"{self.scenario}:{values[CASE]}" if CASE in values else self.scenario,
            overlay=overlay,
            law=law,
            runs=self.file.runs,
            seed=seed,
            faults=None if plan == NONE else plan,
        )
        return Session(number, values, law_label(law), seed, plan, job)

    def values(self, point: int) -> dict[str, Any]:
        """Of what varies, by key, at a point."""
        rest, sample = divmod(point, len(self.drawn))
        at = {}
        for number in reversed(range(len(self.listed))):
            rest, at[number] = divmod(rest, len(self.listed[number]))
        listed = (values[at[number]] for number, values in enumerate(self.listed))
        drawn = iter(self.drawn[sample].tolist())
        return {
            each.key: _whole(each, next(drawn)) if each.drawn else next(listed)
            for each in self.file.vary
        }

    def extremes(self) -> Iterator[int]:
        """A point for the least and the largest of each drawn value, and for every listed one."""
        yield 0
        for column in self.drawn.T:
            yield int(np.argmin(column))
            yield int(np.argmax(column))
        stride = len(self.drawn)
        for values in reversed(self.listed):
            yield from range(0, stride * len(values), stride)
            stride *= len(values)


def read(path: Path) -> Campaign:
    """The campaign of a file. Raises CampaignError, ScenarioError, LawError, ExpectError."""
    try:
        content = settings.read_toml(path)
    except ValueError as error:
        raise CampaignError(f"{path}: {error}") from None
    if strange := settings.strange_number(content):
        raise CampaignError(f"{path}: key {strange.key}: {strange.text}")
    try:
        file = msgspec.convert(content, File)
    except msgspec.ValidationError as error:
        key, text = validation(error, File)
        where = f"key {key}: " if key else ""
        raise CampaignError(f"{path}: {where}{text}") from None
    _check(path, file)
    files: dict[str, str] = {}
    scenario = _scenario(path, file.scenario, files)
    laws = tuple(_kept(path, "laws", name, files) if is_file(name) else name for name in file.laws)
    plans = tuple(
        NONE if name == NONE else _kept(path, "faults", name, files) for name in file.faults
    )
    if not laws:
        laws = (scenarios.load(_found(path, file.scenario)).scenario.law,)
    for what, names in (("laws", laws), ("faults", plans)):
        if twice := {name for name in names if names.count(name) > 1}:
            raise CampaignError(f"{path}: key {what}: {min(twice)} is there twice")
    listed = tuple(
        tuple(each.values or np.linspace(*_ends(each.grid)).round(12).tolist())
        for each in file.vary
        if not each.drawn
    )
    drawn = _samples(path, file)
    bounds = tuple(expect.parse(text, f"{path}: key bounds:") for text in file.bounds)
    rest = {k: v for k, v in msgspec.to_builtins(file).items() if k not in STATISTICS}
    stated = json.dumps([rest, files, drawn.tolist()], sort_keys=True)
    identity = hashlib.blake2b(stated.encode(), digest_size=16).hexdigest()
    text = path.read_text(encoding="utf-8-sig")
    return Campaign(
        path, text, file, scenario, laws, plans, files, listed, drawn, bounds, identity
    )  # fmt: skip


def _ends(grid: Grid | None) -> tuple[float, float, int]:
    assert grid is not None
    return grid.from_, grid.to, grid.count


def _check(path: Path, file: File) -> None:
    """Raises CampaignError for what the types of the keys do not say."""
    for at, each in enumerate(file.vary):
        where = f"{path}: key vary[{at}]"
        ways = [name for name in WAYS if getattr(each, name) is not None]
        if len(ways) != 1:
            given = " and ".join(ways) or "none"
            raise CampaignError(f"{where}: {given}, expected one of {', '.join(WAYS)}")
        name = each.key
        if not name or name in OURS:
            raise CampaignError(
                f"{where}.key: {name!r}, expected a key of the scenario, such as train.mass_kg"
            )
        if [other.key for other in file.vary].count(name) > 1:
            raise CampaignError(f"{where}.key: {name} is varied twice")
        if each.values is not None and not each.values:
            raise CampaignError(f"{where}.values: empty, expected at least one value")
        if name == CASE and not all(isinstance(value, str) for value in each.values or [0]):
            raise CampaignError(f"{where}.values: expected names of cases")
        _check_distribution(where, each)
    for key in ("seeds", "faults"):
        if getattr(file, key) in ([], ()):
            raise CampaignError(f"{path}: key {key}: empty, expected at least one")
    if file.samples > 1 and not any(each.drawn for each in file.vary):
        raise CampaignError(f"{path}: key samples: nothing is drawn, see [[vary]]")
    if isinstance(file.seeds, list) and len(set(file.seeds)) < len(file.seeds):
        raise CampaignError(f"{path}: key seeds: one is there twice")
    if file.runs is not None and file.from_run > file.runs:
        raise CampaignError(f"{path}: key from_run: {file.from_run}, expected at most runs")


def _check_distribution(where: str, each: Varied) -> None:
    """Raises CampaignError for parameters that no distribution has."""
    for way in ("uniform", "log_uniform", "within"):
        pair = getattr(each, way)
        if pair is not None and not pair[0] < pair[1]:
            raise CampaignError(f"{where}.{way}: {list(pair)}, expected [less, more]")
    if each.log_uniform is not None and each.log_uniform[0] <= 0:
        raise CampaignError(f"{where}.log_uniform: {list(each.log_uniform)}, expected more than 0")
    if each.normal is not None and each.normal[1] <= 0:
        raise CampaignError(
            f"{where}.normal: {list(each.normal)}, expected [mean, standard deviation above 0]"
        )
    if each.within is not None and each.normal is None:
        raise CampaignError(f"{where}.within: is of `normal`, which is not there")
    if each.whole and not each.drawn:
        raise CampaignError(f"{where}.whole: is of values that are drawn")


def _found(path: Path, name: str) -> str:
    """The scenario as `load` takes it: a file is relative to the campaign's."""
    return str(path.parent / name) if ".toml" in name.lower() else name


def _scenario(path: Path, name: str, files: dict[str, str]) -> str:
    """The scenario as workers load it; one that is not packaged goes with all that it inherits."""
    try:
        scenarios.load(_found(path, name))
    except scenarios.ScenarioError as error:
        raise CampaignError(f"{path}: key scenario: {error}") from None
    if ".toml" not in name.lower():
        return name
    file, case = scenarios.find(_found(path, name))
    files[file.name] = toml.dumps(scenarios.whole(file))
    return f"{file.name}:{case}" if case else file.name


def _kept(path: Path, key: str, name: str, files: dict[str, str]) -> str:
    """The name of a file among those that go to the workers."""
    file = path.parent / name
    try:
        text = file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise CampaignError(f"{path}: key {key}: {file}: {reason}") from None
    if files.get(file.name, text) != text:
        raise CampaignError(f"{path}: key {key}: two files are called {file.name}")
    files[file.name] = text
    return file.name


def _whole(each: Varied, value: float) -> float | int:
    return int(value) if each.whole else value


def _samples(path: Path, file: File) -> np.ndarray:
    """[samples, drawn keys]; one empty sample where nothing is drawn."""
    drawn = [each for each in file.vary if each.drawn]
    if not drawn:
        return np.zeros((1, 0))
    try:
        return distributions.samples(drawn, file.samples, file.sampling, file.sampling_seed)
    except ValueError as error:
        raise CampaignError(f"{path}: [[vary]]: {error}") from None


def unpack(files: dict[str, str], folder: Path) -> None:
    """Writes the files of a campaign."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        (folder / name).write_text(text, encoding="utf-8")


def here(job: Job, folder: Path, files: dict[str, str]) -> Job:
    """The job with the names of files as paths in the folder where they are."""

    def placed(name: str | None) -> Any:
        file = (name or "").rpartition(":")[0] or name or ""
        return str(folder / str(name)) if name in files or file in files else name

    return msgspec.structs.replace(
        job, scenario=placed(job.scenario), law=placed(job.law), faults=placed(job.faults)
    )
