"""Scenarios: one TOML file holds every number of a run; validated on loading, with one clear line
for what is wrong.

A scenario may stand on another: `base = "subway-paper"` takes that one's values and replaces what
this file states. Found by name among the packaged scenarios, or as the path of a file (a base's is
relative to the file that names it). `unset = ["control.guard.jerk_max_m_s3"]` takes keys of the
base away, so that their defaults count.

One file may hold named cases: `[cases.VI]` states what that case replaces, its own `unset` what it
takes away, and `gradient:VI` (or `my.toml:VI`) is the scenario with it. `yizhuang@3-6` is the part
of a service from its third stop to its sixth.
"""

from __future__ import annotations

import copy
import hashlib
import re
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any

import msgspec
import numpy as np

from ato_hil.can_dbc import settings
from ato_hil.can_dbc.errors import InputError, expected, validation
from ato_hil.plant_sim import fits, service
from ato_hil.plant_sim.actuator import Actuator
from ato_hil.plant_sim.atp import Atp
from ato_hil.plant_sim.atp_tables import braking_fault
from ato_hil.plant_sim.line import Line
from ato_hil.plant_sim.planner import PlanError, ProfilePlan, plan_profile
from ato_hil.plant_sim.profile import (
    Profile,
    between,
    displaced,
    evaluate,
    rate_of,
    stretched,
)
from ato_hil.plant_sim.running import plan_running, road
from ato_hil.plant_sim.track import Track, known, sections
from ato_hil.plant_sim.trains import couplers, foreign, lumped, point

FOLDER = Path(__file__).with_name("scenarios")
# The train models; key `train.model` chooses. Each file has a Train, PARAMS, STATE, calibrate, and
# the steps reset, command, advance.
MODELS: dict[type, ModuleType] = {
    lumped.Train: lumped,
    couplers.Train: couplers,
    point.Train: point,
    foreign.Train: foreign,
}
AnyTrain = lumped.Train | couplers.Train | point.Train | foreign.Train

RUNS_MAX = 4095  # numbers that RUN_CTRL carries
Positive = Annotated[float, msgspec.Meta(gt=0, le=1e6)]
NotNegative = Annotated[float, msgspec.Meta(ge=0, le=1e6)]
Ticks = Annotated[int, msgspec.Meta(ge=0, le=10_000)]
Share = Annotated[float, msgspec.Meta(ge=0, le=2)]
StartOffset = Annotated[float, msgspec.Meta(ge=-1e3, le=1e3)]
StartSpread = Annotated[float, msgspec.Meta(ge=0, le=1e3)]
MassError = Annotated[float, msgspec.Meta(ge=-0.5, le=1)]


class ScenarioError(InputError):
    """The scenario is unknown or wrong; the message names file, key and what was expected."""


class Sensors(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Sensors; 0 turns a property off."""

    location: str = "front"  # front | mean (of front and rear)
    position_step_m: NotNegative = 0.0  # quantisation on top of the DBC's
    speed_step_m_s: NotNegative = 0.0  # likewise, of the speed
    speed_noise_m_s: NotNegative = 0.0  # standard deviation, white

    def __post_init__(self) -> None:
        if self.location not in ("front", "mean"):
            raise ValueError(f"location is {self.location!r}, expected front or mean")


class Disturbance(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Load disturbance, uniform, new in each run."""

    amplitude_m_s2: NotNegative = 0.0  # largest specific force, either way
    hold_ticks: Annotated[int, msgspec.Meta(ge=1, le=10_000)] = 1  # a value stays for so many ticks


class RunLength(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Runs of random length, uniform, new in each run.

    `cut`: each ends after that time, while the train may still be moving; one that would last
    beyond the profile ends with it. `stretched`: an early or late run, whose timetable goes through
    the profile in that time.
    """

    shortest_s: Positive  # least length of a run
    longest_s: Positive  # largest
    first_s: Positive | None = None  # length of run 1, as a paper may give it
    reading: str = "cut"  # cut | stretched

    def __post_init__(self) -> None:
        if self.reading not in ("cut", "stretched"):
            raise ValueError(f"reading is {self.reading!r}, expected cut or stretched")
        if self.longest_s < self.shortest_s:
            raise ValueError(
                f"longest_s is {self.longest_s:g}, expected shortest_s or more, {self.shortest_s:g}"
            )


class Start(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Where a train stands when a run begins, off its mark: the sum of both keys; the reference
    stays where it is."""

    offsets_m: list[StartOffset] = []  # of run 1, 2, …, and from the first again; of every train
    spread_m: StartSpread = 0.0  # uniform up to this, either way; new in each run, for each train

    @property
    def most_m(self) -> float:
        """The furthest that a train stands off its mark."""
        return max(map(abs, self.offsets_m), default=0.0) + self.spread_m


class Change(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What plant and sensors are from a run on: tables on top of the scenario's, and of a line's
    members. The controller, its gradient map and the reference stay as they are."""

    from_run: Annotated[int, msgspec.Meta(ge=1, le=RUNS_MAX)]  # the first run with it
    train: dict[str, Any] = {}  # keys of [train] to replace, but for model and the number of cars
    sensors: dict[str, Any] = {}  # keys of [sensors] to replace
    actuator: dict[str, Any] = {}  # keys of [actuator] to replace
    track: dict[str, Any] = {}  # keys of [track] to replace; ATP knows the new track


class Metrics(
    msgspec.Struct,
    frozen=True,
    forbid_unknown_fields=True,
    kw_only=True,
    rename={"from_s": "from", "to_s": "to"},
):
    """Window of the errors in the summary; the whole run by default."""

    from_s: NotNegative = 0.0  # time of a run from which on errors count
    to_s: Annotated[float, msgspec.Meta(gt=0)] = float("inf")  # and up to which

    def __post_init__(self) -> None:
        if self.to_s <= self.from_s:
            raise ValueError(f"to is {self.to_s:g}, expected more than from, {self.from_s:g}")


class Control(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The controller's settings that do not belong to one law; checked by the controller's
    calibration."""

    preview_ticks: Ticks = 0  # the reference acceleration is read this far ahead
    distribute: bool = False  # give each car a force of its own
    mass_error: MassError = 0.0  # the controller works with (1 + mass_error) times the true mass
    map_share: Share = 0.0  # part of the resistance of the track that the onboard map has
    memory: dict[str, Any] = {}  # of a law that learns: the grid of what it learns
    guard: dict[str, Any] = {}  # what the guard tolerates and how it brakes
    neighbours: dict[str, Any] = {}  # of a line
    rebasing: dict[str, Any] | None = None  # of a line; none: its trains keep their timetables
    yielding: dict[str, Any] | None = None  # none: the timetable keeps its pace, whatever ATP says


class Scenario(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """All of a scenario, as validated."""

    title: str  # what it is, for tables and pages
    law: str  # default law
    runs: Annotated[int, msgspec.Meta(le=RUNS_MAX)]  # default number of runs
    period_s: Positive  # control period
    train: AnyTrain  # the plant; `model` says which: lumped, couplers or point
    profile: ProfilePlan  # the reference that the train is to follow, and the limits over time
    actuator: Actuator  # from the force that is commanded to the one that acts
    laws: dict[str, dict[str, Any]]  # gains of each law that the scenario supports
    track: Track = Track()  # resistance by position
    sensors: Sensors = Sensors()  # what the controller is told of position and speed
    disturbance: Disturbance = Disturbance()  # a random load
    atp: Atp = Atp()  # what supervises the train, and its safety brakes
    run_length: RunLength | None = None  # none: every run lasts as long as the profile
    start: Start = Start()  # where the train stands when a run begins; by default on its mark
    changes: list[Change] = []  # plant and sensors from a run on, in the order of their runs
    control: Control = Control()  # settings of the controller besides the gains
    metrics: Metrics = Metrics()  # from when to when errors count
    line: Line | None = None  # several trains; none: one
    tuning: dict[str, str] = {}  # how the gains of each law were found, for who compares them
    base: str = ""  # name or file of the scenario whose values count where this one states none


class Loaded(msgspec.Struct, frozen=True):
    """A scenario with what follows from it: that of the line's first train, or of another one
    where `member` made it."""

    name: str  # with its case, as `load` takes it
    path: Path
    case: str  # "" for none
    cases: tuple[str, ...]  # names of those that the scenario has
    digest: str  # of the merged content
    scenario: Scenario
    segments: np.ndarray  # profile.SEGMENT
    profile: Profile  # of this train, as planned or at `timetable_rate`
    train: int = 0  # place on the line, 0 leads
    timetable_rate: int = 0  # of a run against the planned one, less 1, 2^-24
    calls: tuple[service.Call, ...] = ()  # of a service, the first is its departure
    part: str = ""  # of a service, as its name has it: @3-6

    @property
    def folder_name(self) -> str:
        """The name as part of a folder's."""
        return self.name.replace(":", "-").replace("@", "-")

    @property
    def source(self) -> str:
        """What loads this scenario in another process."""
        path = str(self.path.absolute())
        return (f"{path}:{self.case}" if self.case else path) + self.part

    @property
    def ticks(self) -> int:
        """Control periods of a whole run, as planned or at `timetable_rate`."""
        return len(self.profile.x)

    @property
    def trains(self) -> int:
        """How many trains the scenario has."""
        return self.scenario.line.trains if self.scenario.line else 1

    @property
    def start_m(self) -> float:
        """Where this train's reference starts."""
        if self.calls:
            return self.calls[0].position_m
        return -self.train * self.scenario.line.spacing_m if self.scenario.line else 0.0


def scenario_names() -> list[str]:
    """Names of the packaged scenarios, sorted."""
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def case_names() -> list[str]:
    """Names of the packaged scenarios, each followed by those of its cases."""
    return [
        name
        for scenario in scenario_names()
        for name in (scenario, *(f"{scenario}:{case}" for case in load(scenario).cases))
    ]


PART = re.compile(r"@([0-9]+)-([0-9]+)$")


def part_of(name: str) -> str:
    """What a name says of the part of a service, as @3-6; "" if nothing."""
    found = PART.search(name)
    return found.group() if found and not Path(name).is_file() else ""


def with_part(name: str, first: str | None, last: str | None) -> str:
    """The name of a part of a service, from a stop to another, each by name or number, None: the
    scenario's own. Raises ScenarioError."""
    if part_of(name):
        raise ScenarioError(f"{name}: names a part already")
    path, case = find(name)
    profile = _in_case(path, case, _content(path)).get("profile", {})
    stops = profile.get("stops", []) if isinstance(profile, dict) else []
    if not isinstance(stops, list) or not all(isinstance(stop, dict) for stop in stops):
        stops = []
    if not stops:
        raise ScenarioError(f"{_place(path, case)}: no service, expected profile.stops")
    names = [str(stop.get("name", "")) for stop in stops]

    def number(text: str) -> int:
        if text.isdecimal() and 1 <= int(text) <= len(names):
            return int(text)
        if text and names.count(text) == 1:
            return names.index(text) + 1
        known = expected(text, [each for each in names if each])
        raise ScenarioError(
            f"{_place(path, case)}: stop {text!r} is unknown, expected 1 to {len(names)} or the"
            f" name of one, {known}"
        )

    a = profile.get("from_stop", 1) if first is None else number(first)
    b = profile.get("to_stop", len(stops)) if last is None else number(last)
    return f"{name}@{a}-{b}"


def find(name: str) -> tuple[Path, str]:
    """File of a scenario, by name or path, and its case, "" for none. Raises ScenarioError if there
    is no such file."""
    name = name.removesuffix(part_of(name))
    file, separator, case = name.rpartition(":")
    if not separator or Path(name).is_file():
        file, case = name, ""
    elif not case:
        raise ScenarioError(f"{name}: expected the name of a case after the colon")
    if file.lower().endswith(".toml"):
        path = Path(file)
        if not path.is_file():
            raise ScenarioError(f"{file}: no such scenario file")
        return path, case
    path = FOLDER / f"{file}.toml"
    if not path.is_file():
        raise ScenarioError(
            f"scenario {file!r} is unknown, {expected(file, scenario_names())}, or a .toml file"
        )
    return path, case


def _read(path: Path) -> dict[str, Any]:
    try:
        return settings.read_toml(path)
    except ValueError as error:
        raise ScenarioError(f"{path}: {error}") from None


def _merged(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    """`over` on top of `base`, table by table; lists are replaced whole."""
    result = dict(base)
    for key, value in over.items():
        both_tables = isinstance(value, dict) and isinstance(result.get(key), dict)
        result[key] = _merged(result[key], value) if both_tables else value
    return result


def _content(path: Path, seen: tuple[Path, ...] = ()) -> dict[str, Any]:
    if path in seen:
        raise ScenarioError(f"{path}: key `base` leads back to itself")
    content = _read(path)
    base = content.get("base", "")
    if not isinstance(base, str):
        raise ScenarioError(f"{path}: key `base`: expected the name of a scenario")
    if base:
        try:
            below, case = find(str(path.parent / base) if _is_file_name(base) else base)
        except ScenarioError as error:
            raise ScenarioError(f"{path}: key `base`: {error}") from None
        inherited = _in_case(below, case, _content(below, (*seen, path)))
        content = _merged(_without(str(path), inherited, content), content)
    elif "unset" in content:
        raise ScenarioError(f"{path}: key unset: there is no base of which to unset keys")
    content.pop("unset", None)
    return content


def whole(path: Path) -> dict[str, Any]:
    """What a scenario file states with all that it inherits, and with its cases, so that it stands
    on no other. Raises ScenarioError."""
    content = _content(path)
    content.pop("base", None)
    return content


def _without(place: str, inherited: dict[str, Any], content: dict[str, Any]) -> dict[str, Any]:
    """What a base gives, or a scenario its case, without the keys that `unset` of `content`
    names."""
    keys = content.get("unset", [])
    if not isinstance(keys, list) or not all(isinstance(key, str) for key in keys):
        raise ScenarioError(f"{place}: key unset: expected a list of keys, as train.start_m")
    if not keys:
        return inherited
    result = copy.deepcopy(inherited)
    for key in keys:
        *tables, last = key.split(".")
        table: Any = result
        for step in tables:
            table = table.get(step) if isinstance(table, dict) else None
        if not isinstance(table, dict) or last not in table:
            raise ScenarioError(f"{place}: key unset: there is no {key} to unset")
        del table[last]
    return result


def layers(name: str) -> list[tuple[str, dict[str, Any]]]:
    """What a scenario is made of, the lowest base first: the name of each file, with its case, and
    what it states. Raises ScenarioError."""
    path, case = find(name)
    _content(path)  # so that a loop is refused
    found: list[tuple[str, dict[str, Any]]] = []
    while True:
        content = _read(path)
        own = [(path.name, content)]
        below = content.get("base", "")
        if case:
            inherited = _content(path)["cases"][case]
            own.append((f"{path.name}:{case}", inherited))
        found = own + found
        if not below:
            return found
        path, case = find(str(path.parent / below) if _is_file_name(below) else below)


def _is_file_name(name: str) -> bool:
    return name.lower().endswith(".toml") or ".toml:" in name.lower()


def _in_case(path: Path, case: str, content: dict[str, Any]) -> dict[str, Any]:
    """`content` with what its case `case` replaces."""
    cases = _cases(path, content)
    if not case:
        return content
    if case not in cases:
        known = expected(case, cases) if cases else "the scenario has none"
        raise ScenarioError(f"{path}: case {case!r} is unknown, {known}")
    whole = _merged(_without(_place(path, case), content, cases[case]), cases[case])
    whole.pop("unset", None)
    return whole


def _cases(path: Path, content: dict[str, Any]) -> dict[str, dict[str, Any]]:
    cases = content.get("cases", {})
    if not isinstance(cases, dict) or not all(isinstance(c, dict) for c in cases.values()):
        raise ScenarioError(f"{path}: key cases: expected tables, [cases.NAME]")
    return cases


def load(name: str) -> Loaded:
    """A scenario by name or path, or a case of one, validated and planned: once for as long as its
    files say the same.

    Raises ScenarioError with one line.
    """
    return overlaid(name, {})


def overlaid(name: str, overlay: dict[str, Any]) -> Loaded:
    """The scenario that `load` gives with the tables of `overlay` on top, as a file would state
    them."""
    path, case = find(name)
    content = _content(path)
    cases = tuple(_cases(path, content))
    content = _merged(_in_case(path, case, content), overlay)
    content.pop("cases", None)
    part = part_of(name)
    if part:
        content = _in_part(_place(path, case), content, part)
    return _loaded(path, case, cases, part, _Content(content))


class _Content(dict[str, Any]):
    """What a scenario states, as a key: it is not changed any more."""

    def __hash__(self) -> int:  # type: ignore[override]
        return hash(repr(self))


@lru_cache(maxsize=64)
def _loaded(path: Path, case: str, cases: tuple[str, ...], part: str, content: _Content) -> Loaded:
    try:
        scenario = msgspec.convert(content, Scenario)
    except msgspec.ValidationError as error:
        raise ScenarioError(f"{_place(path, case)}: {_wrong(error)}") from None
    strange = settings.strange_number(content)
    if strange:
        raise ScenarioError(f"{_place(path, case)}: key {strange.key}: {strange.text}")
    _check(_place(path, case), scenario)
    digest = hashlib.blake2b(msgspec.json.encode(content, order="deterministic"), digest_size=16)
    full = (f"{path.stem}:{case}" if case else path.stem) + part
    try:
        loaded = assembled(full, path, case, cases, digest.hexdigest(), scenario)
    except (PlanError, ValueError) as error:
        raise ScenarioError(f"{_place(path, case)}: [profile]: {error}") from None
    place = _place(path, case)
    for change in (0, *(change.from_run for change in scenario.changes)):
        for each in members(loaded):  # so that a wrong one is refused here
            own = in_run(each, change)
            try:
                fits.check(own.scenario, own.profile)
            except ValueError as error:
                since = f" (from run {change})" if change else ""
                raise ScenarioError(f"{place}: key {error}{since}") from None
    duration_s = (loaded.ticks - 1) * scenario.period_s
    if scenario.metrics.from_s >= duration_s:
        raise ScenarioError(
            f"{place}: key metrics.from: {scenario.metrics.from_s:g}, expected less than"
            f" profile.duration_s, {duration_s:g}"
        )
    if scenario.run_length and scenario.run_length.reading == "stretched":
        try:
            _check_stretch(loaded, scenario.run_length)
        except ValueError as error:
            raise ScenarioError(f"{_place(path, case)}: [run_length]: {error}") from None
    return loaded


def assembled(
    name: str, path: Path, case: str, cases: tuple[str, ...], digest: str, scenario: Scenario
) -> Loaded:
    """A validated scenario, planned. Raises PlanError, ValueError."""
    segments, profile, calls = _reference(scenario)
    return Loaded(
        name, path, case, cases, digest, scenario, segments, profile,
        calls=calls, part=part_of(name),
    )  # fmt: skip


def planned(scenario: Scenario) -> np.ndarray:
    """The reference's table, as the plan states it or as its objective asks."""
    return _reference(scenario)[0]


def _reference(scenario: Scenario) -> tuple[np.ndarray, Profile, tuple[service.Call, ...]]:
    """The reference's table, the table at every tick, and the stops of a service."""
    plan, period_s = scenario.profile, scenario.period_s
    if plan.objective is None:
        return *_ramps(plan, period_s), ()
    assert isinstance(scenario.train, point.Train)
    line = road(scenario.track, scenario.atp)
    if not plan.stops:
        segments = plan_running(plan, period_s, scenario.train, line)
        return segments, evaluate(segments, period_s), ()
    segments, calls = service.plan_service(plan, period_s, scenario.train, line)
    return segments, displaced(evaluate(segments, period_s), calls[0].position_m), calls


@lru_cache(maxsize=16)
def _ramps(plan: ProfilePlan, period_s: float) -> tuple[np.ndarray, Profile]:
    """A plan that depends on nothing else, once for all scenarios that have it: to place its ramps
    takes longer than a run."""
    segments = plan_profile(plan, period_s)
    return segments, evaluate(segments, period_s)


def _in_part(place: str, content: dict[str, Any], part: str) -> dict[str, Any]:
    """`content` of a service, of which `part` is run."""
    if not content.get("profile", {}).get("stops"):
        raise ScenarioError(f"{place}{part}: expected a service, with profile.stops")
    first, last = PART.fullmatch(part).groups()  # type: ignore[union-attr]
    return _merged(content, {"profile": {"from_stop": int(first), "to_stop": int(last)}})


def at_rate(loaded: Loaded, rate: int) -> Loaded:
    """A planned scenario with the reference of a run whose timetable goes at 1 + rate * 2^-24."""
    if rate == 0:
        return loaded
    period_s = loaded.scenario.period_s
    profile = stretched(loaded.profile, loaded.segments, period_s, rate)
    return msgspec.structs.replace(loaded, profile=profile, timetable_rate=rate)


def _check_stretch(loaded: Loaded, lengths: RunLength) -> None:
    """Raises ValueError if the earliest or the latest run cannot be."""
    for length_s in (lengths.shortest_s, lengths.longest_s, lengths.first_s):
        if length_s is not None:
            at_rate(loaded, rate_of(loaded.ticks - 1, round(length_s / loaded.scenario.period_s)))


def _place(path: Path, case: str) -> str:
    """Where a scenario's content is from, for messages."""
    return f"{path}, case {case}" if case else str(path)


def members(loaded: Loaded) -> list[Loaded]:
    """The scenario of each train of the line, the leader's first; of a single train, its own."""
    return [member(loaded, train) for train in range(loaded.trains)]


def member(loaded: Loaded, train: int) -> Loaded:
    """The scenario of train `train` (0 leads) of a loaded line: its own numbers, its reference.

    Raises ScenarioError if what the line says of the train is wrong.
    """
    line = loaded.scenario.line
    if line is None:
        return loaded
    assert loaded.train == 0
    scenario = _own_numbers(loaded, line, train) if line.members else loaded.scenario
    assert isinstance(scenario.train, point.Train)
    start_m = -train * line.spacing_m
    own_train = msgspec.structs.replace(scenario.train, start_m=scenario.train.start_m + start_m)
    return msgspec.structs.replace(
        loaded,
        scenario=msgspec.structs.replace(scenario, train=own_train),
        profile=displaced(loaded.profile, start_m),
        train=train,
    )


def _own_numbers(loaded: Loaded, line: Line, train: int) -> Scenario:
    """The scenario with what the line says of one train on top."""
    which = train % len(line.members)
    own = line.members[which]
    where = f"{_place(loaded.path, loaded.case)}: key line.members[{which}]"
    unknown = set(own.laws) - set(loaded.scenario.laws)
    if unknown:
        name = unknown.pop()
        raise ScenarioError(f"{where}.laws.{name}: {expected(name, loaded.scenario.laws)}")
    content = _merged(msgspec.to_builtins(loaded.scenario), msgspec.to_builtins(own))
    try:
        return msgspec.convert(content, Scenario)
    except msgspec.ValidationError as error:
        raise ScenarioError(f"{where}: {_wrong(error)}") from None


def in_run(loaded: Loaded, run: int) -> Loaded:
    """A train's scenario with what has changed by run `run`, and the temporary speeds of that run.
    Raises ScenarioError if a change is wrong."""
    scenario, place = loaded.scenario, _place(loaded.path, loaded.case)
    for number, change in enumerate(loaded.scenario.changes):
        if change.from_run > run:
            break
        where = f"{place}: key changes[{number}]"
        tables = msgspec.to_builtins(change)
        del tables["from_run"]
        if "start_m" in change.train:
            raise ScenarioError(f"{where}.train.start_m: expected start.offsets_m instead")
        content = _merged(msgspec.to_builtins(scenario), tables)
        try:
            changed = msgspec.convert(content, Scenario)
        except msgspec.ValidationError as error:
            raise ScenarioError(f"{where}: {_wrong(error)}") from None
        if type(changed.train) is not type(scenario.train):
            raise ScenarioError(f"{where}.train.model: expected the train model of the scenario")
        cars = len(scenario.train.effectiveness)
        if len(changed.train.effectiveness) != cars:
            raise ScenarioError(f"{where}.train: expected {cars} cars, as the controller knows")
        _check(place, changed, f"changes[{number}].")
        scenario = changed
    temporary = [lower for lower in scenario.atp.temporary if lower.holds_in(run)]
    if temporary != scenario.atp.temporary:
        supervision = msgspec.structs.replace(scenario.atp, temporary=temporary)
        scenario = msgspec.structs.replace(scenario, atp=supervision)
    return (
        loaded
        if scenario is loaded.scenario
        else msgspec.structs.replace(loaded, scenario=scenario)
    )


def _wrong(error: msgspec.ValidationError) -> str:
    """The validator's message with the key first: `train.masses_kg: Expected ...`."""
    key, text = validation(error, Scenario)
    return f"key {key}: {text}" if key else text


def _check(path: str, scenario: Scenario, under: str = "") -> None:
    """Checks what types cannot say; `under` is put before each key that is named."""
    if scenario.law not in scenario.laws:
        raise ScenarioError(
            f"{path}: key {under}law: {scenario.law!r} has no gains,"
            f" expected a table [laws.{scenario.law}]"
        )
    if scenario.runs < 1:
        raise ScenarioError(f"{path}: key {under}runs: {scenario.runs}, expected 1 or more")
    if isinstance(scenario.train, couplers.Train):
        model = "train model 'couplers' takes each car by itself"
        if not scenario.control.distribute:
            raise ScenarioError(f"{path}: key {under}control.distribute: {model}, expected true")
        if scenario.track.application != "smeared":
            raise ScenarioError(
                f"{path}: key {under}track.application: {model}, expected 'smeared'"
            )
    if isinstance(scenario.train, point.Train):
        model = "train model 'point' has no cars"
        if scenario.control.distribute:
            raise ScenarioError(f"{path}: key {under}control.distribute: {model}, expected false")
        if scenario.track.application == "smeared":
            raise ScenarioError(f"{path}: key {under}track.application: {model}, expected 'point'")
    elif scenario.track.sloped:
        key = "interpolation" if scenario.track.interpolation != "hold" else "averaged_over_m"
        model = "only train model 'point' takes such a track"
        raise ScenarioError(f"{path}: key {under}track.{key}: {model}")
    if isinstance(scenario.train, foreign.Train):
        by_car = isinstance(scenario.train.force, list)
        for key, wrong in (
            ("control.distribute", by_car and not scenario.control.distribute),
            ("disturbance", scenario.disturbance.amplitude_m_s2 > 0),
            ("changes", bool(scenario.changes)),
            ("start", scenario.start != Start()),
        ):
            if wrong:
                expected_ = "true" if key.endswith("distribute") else "none"
                raise ScenarioError(
                    f"{path}: key {under}{key}: with train model 'fmu', expected {expected_}"
                )
    if scenario.line and not isinstance(scenario.train, point.Train):
        raise ScenarioError(f"{path}: key {under}train.model: a line has trains of model 'point'")
    if any(b.from_run <= a.from_run for a, b in pairwise(scenario.changes)):
        raise ScenarioError(f"{path}: key changes: expected from_run to rise")
    if scenario.profile.objective and not isinstance(scenario.train, point.Train):
        raise ScenarioError(f"{path}: key {under}profile.objective: expected train model 'point'")
    if scenario.profile.stops:
        if getattr(scenario.train, "start_m", 0.0):
            raise ScenarioError(
                f"{path}: key {under}train.start_m: a service starts at its first stop,"
                " expected start.offsets_m instead"
            )
        for key, value in (("line", scenario.line), ("run_length", scenario.run_length)):
            if value is not None:
                raise ScenarioError(f"{path}: key {under}{key}: a service, profile.stops, has none")
    has_limits = scenario.profile.limits or scenario.profile.limit_above_m_s is not None
    if not has_limits and not scenario.atp.speeds:
        raise ScenarioError(f"{path}: key {under}profile.limits: expected at least one limit")
    if scenario.atp.temporary and scenario.atp.supervision == "none":
        raise ScenarioError(
            f"{path}: key {under}atp.temporary: supervision is none, expected margin or etcs"
        )
    if scenario.control.yielding is not None:
        for key, value in (("line", scenario.line), ("run_length", scenario.run_length)):
            if value is not None:
                raise ScenarioError(
                    f"{path}: key {under}control.yielding: with {key}, expected none"
                )
    fault = braking_fault(scenario.atp, sections(known(scenario.track)))
    if fault:
        raise ScenarioError(f"{path}: key {under}{fault}")


def shortened(loaded: Loaded, ticks: int) -> Loaded:
    """The scenario's first `ticks` control periods; 0 or more than it has: all."""
    if not 0 < ticks < loaded.ticks:
        return loaded
    return msgspec.structs.replace(loaded, profile=between(loaded.profile, 0, ticks - 1))
