"""Scenarios: the packaged ones load, a base is inherited table by table, mistakes give one line."""

import re
import tomllib

import pytest

from ato_hil.plant_sim.scenario import (
    FOLDER,
    ScenarioError,
    case_names,
    find,
    load,
    overlaid,
    scenario_names,
)
from ato_hil.plant_sim.track import Track
from ato_hil.plant_sim.trains import couplers, lumped


@pytest.fixture
def write(tmp_path):
    """Writes a scenario file and gives its path as text."""

    def write(text, name="mine.toml"):
        path = tmp_path / name
        path.write_text(text)
        return str(path)

    return write


@pytest.mark.parametrize("name", scenario_names())
def test_a_packaged_scenario_loads(name):
    loaded = load(name)
    assert loaded.name == name
    plan = loaded.scenario.profile
    stops_s = sum((stop.run_s or 0.0) + stop.dwell_s for stop in plan.stops)
    assert loaded.ticks == round((plan.duration_s or stops_s) / loaded.scenario.period_s) + 1
    assert loaded.scenario.title


def test_the_subway_scenarios_are_there():
    wanted = {"subway", "subway-paper", "subway-fast", "subway-disturbed", "subway-stress"}
    assert wanted <= set(scenario_names())


def test_the_default_has_everything_on():
    scenario = load("subway").scenario
    assert isinstance(scenario.train, couplers.Train)
    assert scenario.track.application == "smeared"
    assert scenario.sensors.location == "mean"
    actuators = scenario.actuator
    lag_and_delay = actuators.lag_traction_s / scenario.period_s + actuators.delay_ticks
    assert scenario.control.preview_ticks == round(lag_and_delay)
    assert scenario.control.memory["lead_ticks"] == scenario.control.preview_ticks
    assert scenario.laws["cailc"]["alpha"] == 2.0
    assert scenario.laws["cailc"]["Gamma"] == [1e5, 1.0, 0.001]


# Inheritance.


def test_a_base_is_inherited_table_by_table_and_lists_are_replaced(write):
    path = write('base = "subway-paper"\n[laws.cailc]\nalpha = 2.0\nGamma = [1.0, 2.0, 3.0]\n')
    laws, paper = load(path).scenario.laws, load("subway-paper").scenario.laws
    assert laws["cailc"] == paper["cailc"] | {"alpha": 2.0, "Gamma": [1.0, 2.0, 3.0]}
    assert laws["pid"] == paper["pid"]


def test_a_base_can_be_a_file_with_a_base(write):
    write('base = "subway"\nruns = 3\n', "below.toml")
    scenario = load(write('base = "below.toml"\ntitle = "above"\n')).scenario  # beside it
    assert (scenario.title, scenario.runs) == ("above", 3)
    assert isinstance(scenario.train, couplers.Train)


def test_the_same_cars_serve_both_models(write):
    path = write('base = "subway"\n[train]\nmodel = "lumped"\n')
    train = load(path).scenario.train
    assert isinstance(train, lumped.Train)
    assert train.masses_kg == load("subway").scenario.train.masses_kg


def test_the_digest_is_of_the_values(write):
    plain = write('base = "subway-paper"\nruns = 3\nlaw = "ailc"\n', "plain.toml")
    other = write('# a comment\nlaw = "ailc"\nbase   = "subway-paper"\nruns = 3\n', "other.toml")
    changed = write('base = "subway-paper"\nruns = 4\nlaw = "ailc"\n', "changed.toml")
    assert load(plain).digest == load(other).digest
    assert load(plain).digest != load(changed).digest


def test_the_digest_covers_what_is_inherited(write):
    digests = set()
    for runs in (3, 4):
        below = write(f'base = "subway-paper"\nruns = {runs}\n', f"below{runs}.toml")
        above = write(f'base = "{below}"\ntitle = "above"\n', f"above{runs}.toml")
        digests.add(load(above).digest)
    assert len(digests) == 2


# Mistakes.

MISTAKES = [
    ("runs = [", r"not valid TOML: .*"),
    ("base = 3", r"key `base`: expected the name of a scenario"),
    ('base = "nowhere"', r"key `base`: scenario 'nowhere' is unknown, expected one of .*subway.*"),
    ('base = "missing.toml"', r"key `base`: .*/missing\.toml: no such scenario file"),
    ('title = "x"', r"Object missing required field `law`"),
    (
        'base = "crh3-learning"\n[run_length]\nreading = "early"',
        r"key run_length: reading is 'early', expected cut or stretched",
    ),
    (
        'base = "crh3-learning"\n[run_length]\nreading = "stretched"\nshortest_s = 1200.0',
        r"\[run_length\]: 120000 ticks are not 2/3 to 2 times the planned 250000",
    ),
    ('base = "subway"\nrun = 3', r"Object contains unknown field `run`, did you mean runs\?"),
    (
        'base = "subway"\n[metrics]\nfrom = 500.0',
        r"key metrics\.from: 500, expected less than profile\.duration_s, 190",
    ),
    (
        'base = "crh3"\n[train]\nmass_kg = 2e6\ncharacteristic = { force_n = 1e6 }',
        r"key actuator\.force_max_m_s2: times the mass of the train it is 1e\+06 N, expected at"
        r" most 524288 N, which FORCE_CMD\.Force carries",
    ),
    (
        'base = "subway"\n[train]\nbrake_max_n = [6e5, 1.0, 1.0, 1.0, 1.0, 1.0]',
        r"key train\.brake_max_n\[0\]: it is 600000 N, .* 524288 N, which CAR_FORCE carries",
    ),
    (
        'base = "crh3"\n[train]\nstart_m = 1000.0',
        r"key train\.start_m: the distance to the start of the profile is 1000 m, expected at most"
        r" 256 m, which ATO_TRACKING\.PositionError carries",
    ),
    ('base = "crh3"\n[actuator]\nlag_brake_s = 400', r"key actuator\.lag_brake_s: .* <= 60.*"),
    (
        'base = "crh3"\n[profile]\nlimits = [{ until_s = 1021.6, speed_m_s = 170.0 }]',
        r"key profile\.limits\[0\]\.speed_m_s: it is 170 m/s, expected at most 163\.83 m/s, .*",
    ),
    (
        'base = "line"\n[line.radio]\nperiod_ticks = 1000\ndelay_ticks = 4000',
        r"key line\.radio\.delay_ticks: the age of a packet is 50 s, expected at most 40\.95 s, .*",
    ),
    (
        'base = "subway"\n[disturbance]\namplitude_m_s2 = 15.0',
        r"key actuator\.force_max_m_s2: with track and disturbance it is 16\.\d+ m/s\^2, .*",
    ),
    (
        'base = "line"\n[line]\nfaults = [{ train = 1, from = 9.0, brake_m_s2 = 2.0 }]',
        r"key line\.faults\[0\]\.brake_m_s2: 2, expected at most 1\.5, what the actuators give",
    ),
    (
        'base = "subway"\n[train]\npich_m = 3.0',
        r"key train: Object contains unknown field `pich_m`, did you mean pitch_m\?",
    ),
    ('base = "subway"\nruns = 4096', r"key runs: Expected `int` <= 4095"),
    ('base = "subway"\n[metrics]\nfrom = -1.0', r"key metrics.from: Expected `float` >= 0.0"),
    (
        'base = "subway"\n[metrics]\nfrom = 20.0\nto = 10.0',
        r"key metrics: to is 10, expected more than from, 20",
    ),
    ('base = "subway"\n[metrics]\nto = nan', r"key metrics.to: Expected `float` > 0.0"),
    ('base = "subway"\n[metrics]\nto = inf', r"key metrics\.to: inf, expected a finite number"),
    (
        'base = "line"\n[line.radio]\noutages = [{ from = 9.0, to = 9.0 }]',
        r"key line\.radio\.outages\[0\]: to is 9, expected more than from, 9",
    ),
    (
        'base = "line"\n[line]\nfaults = [{ train = 1, from = 9, to = 8, brake_m_s2 = 1.0 }]',
        r"key line\.faults\[0\]: to is 8, expected more than from, 9",
    ),
    (
        'base = "subway"\n[laws.cailc]\nGamma = [1.0, nan, 1.0]',
        r"key laws\.cailc\.Gamma\[1\]: nan, expected a finite number",
    ),
    (
        'base = "subway"\n[train]\nmotor_cars = [9223372036854775808]',
        r"key train: motor_cars: expected numbers from 1 to 6",
    ),
    (
        'base = "subway"\n[laws.cailc]\nalpha = 9223372036854775808',
        r"key laws\.cailc\.alpha: expected a whole number of at most 64 bits",
    ),
    ('base = "subway"\nruns = 0', r"key runs: 0, expected 1 or more"),
    (
        'base = "subway"\nlaw = "bang-bang"',
        r"key law: 'bang-bang' has no gains, expected a table .*",
    ),
    ('base = "subway"\nperiod_s = 0.0', r"key period_s: Expected `float` > 0\.0"),
    ('base = "subway"\nperiod_s = 0.03', r"\[profile\]: .*0\.03.*"),
    ('base = "subway"\n[train]\nmodel = "maglev"', r"key train\.model: Invalid value 'maglev'"),
    ('base = "subway"\n[train]\npitch_m = "long"', r"key train\.pitch_m: Expected `float`, got .*"),
    ('base = "subway"\n[train]\nmotor_cars = [7]', r"key train: motor_cars: expected numbers .*"),
    ('base = "subway-paper"\n[train]\nmodel = "couplers"', r"key train: coupler_stiffness_n_m.*"),
    ('base = "subway"\n[control]\ndistribute = false', r"key control\.distribute: .*expected true"),
    ('base = "subway"\n[track]\napplication = "point"', r"key track\.application: .*'smeared'"),
    ('base = "subway"\n[track]\nfrom_m = [1.0]', r"key track: from_m and resistance_n_per_kn .*"),
    ('base = "subway"\n[sensors]\nlocation = "rear"', r"key sensors: location is 'rear', .*"),
    (
        'base = "subway"\n[sensors]\nspeed_noise_m_s = -1.0',
        r"key sensors\.speed_noise_m_s: .*>= 0.*",
    ),
    ('base = "subway"\n[sensors]\nspeed_step_m_s = nan', r"key sensors\.speed_step_m_s: .*>= 0.*"),
    ('base = "subway"\n[disturbance]\nhold_ticks = 0', r"key disturbance\.hold_ticks: .*>= 1"),
    ('base = "subway"\n[actuator]\ndelay_ticks = 16', r"key actuator: delay_ticks is 16, .*"),
    ('base = "subway"\n[control]\nmass_error = 1.5', r"key control\.mass_error: .*<= 1.*"),
    ('base = "subway"\n[control]\npreview_ticks = -1', r"key control\.preview_ticks: .*>= 0"),
    (
        'base = "subway"\n[profile]\nlimits = []',
        r"key profile\.limits: expected at least one limit",
    ),
    (
        'base = "subway"\n[profile]\nlimit_above_m_s = 0.5',
        r"key profile: a plan takes only one of limits and limit_above_m_s",
    ),
    (
        'base = "subway"\n[run_length]\nshortest_s = 9.0\nlongest_s = 8.0',
        r"key run_length: longest_s is 8, expected shortest_s or more, 9",
    ),
    ('base = "subway"\n[profile]\ndistance_m = 9e3', r"\[profile\]: distance_m = 9000 is out .*"),
]


@pytest.mark.parametrize(("text", "says"), MISTAKES, ids=[text for text, _ in MISTAKES])
def test_a_mistake_gives_one_line_with_file_and_key(write, text, says):
    path = write(text)
    with pytest.raises(ScenarioError) as error:
        load(path)
    assert re.fullmatch(f"{re.escape(path)}: {says}", str(error.value))


def test_a_key_of_the_base_is_unset(write):
    write('base = "crh3-learning"\nunset = ["run_length", "sensors.speed_noise_m_s"]', "less.toml")
    less, whole = load(write('base = "less.toml"')).scenario, load("crh3-learning").scenario
    assert whole.run_length is not None
    assert less.run_length is None
    assert less.sensors.speed_noise_m_s == 0.0
    assert less.sensors.position_step_m == whole.sensors.position_step_m
    # What this file states itself counts.
    again = write(
        'base = "less.toml"\nunset = ["sensors"]\n[sensors]\nlocation = "front"', "a.toml"
    )
    assert load(again).scenario.sensors.position_step_m == 0.0
    assert load("crh3-learning").scenario == whole


def test_a_case_unsets_keys_of_its_scenario(write):
    path = write(
        'base = "crh3-learning"\n[cases.whole]\nunset = ["run_length"]\n'
        '[cases.other]\nunset = ["track"]\ntrack.application = "point"\n'
    )
    assert load(path).scenario.run_length is not None
    assert load(f"{path}:whole").scenario.run_length is None
    assert load(f"{path}:other").scenario.track == Track()
    again = write(f'base = "{path}:whole"\nruns = 1', "again.toml")
    assert load(again).scenario.run_length is None


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('base = "subway"\nunset = ["run_length"]', "key unset: there is no run_length to unset"),
        ('base = "subway"\nunset = ["law.x"]', "key unset: there is no law.x to unset"),
        ('base = "subway"\nunset = "atp"', "key unset: expected a list of keys"),
        ('unset = ["atp"]', "key unset: there is no base"),
        (
            'base = "subway"\n[cases.a]\nunset = ["nothing"]',
            "case a: key unset: there is no nothing to unset",
        ),
        ('base = "subway"\nunset = ["period_s"]', "Object missing required field `period_s`"),
    ],
)
def test_what_cannot_be_unset_is_named(write, text, says):
    with pytest.raises(ScenarioError, match=re.escape(says)):
        load(write(text) + ":a" * ("cases.a" in text))


def test_a_byte_order_mark_and_a_name_in_capitals_are_read(tmp_path):
    below = tmp_path / "BELOW.TOML"
    below.write_bytes(b'\xef\xbb\xbfbase = "subway-fast"\r\ntitle = "Tr\xc3\xa4ge Bremse"\r\n')
    above = tmp_path / "above.Toml"
    above.write_text('base = "BELOW.TOML"\nruns = 2\n')
    assert load(str(below)).scenario.title == load(str(above)).scenario.title == "Träge Bremse"


def test_a_base_that_leads_back_to_itself_is_refused(write):
    path = write("", "loop.toml")
    write(f'base = "{path}"', "loop.toml")
    with pytest.raises(ScenarioError, match="key `base` leads back to itself"):
        load(path)


def test_an_unknown_name_lists_the_known_ones():
    with pytest.raises(ScenarioError, match=r"'metro' is unknown, expected one of .*subway-paper"):
        find("metro")


def test_a_file_that_cannot_be_read_is_named(tmp_path):
    (tmp_path / "folder.toml").mkdir()
    with pytest.raises(ScenarioError, match=r"folder\.toml: no such scenario file"):
        load(str(tmp_path / "folder.toml"))


def test_a_file_that_is_no_text_is_named(tmp_path):
    path = tmp_path / "binary.toml"
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(ScenarioError, match=r"binary\.toml: not valid TOML"):
        load(str(path))


def test_every_packaged_scenario_says_what_it_is():
    for path in FOLDER.glob("*.toml"):
        assert "title" in tomllib.loads(path.read_text()), path


# Named cases.

CASES = """
base = "subway-paper"
runs = 3
[cases.slow]
title = "Slow learning"
laws.cailc = { alpha = 2.0 }
[cases.noisy]
sensors.speed_noise_m_s = 0.01
"""


@pytest.mark.parametrize("name", case_names())
def test_a_packaged_case_loads_and_says_what_it_is(name):
    loaded = load(name)
    assert loaded.name == name
    assert loaded.scenario.title


def test_the_paper_s_cases_are_cases_of_both_gradients():
    paper = ("I", "II", "III", "IV", "V", "VI", "VII", "VIII")
    assert load("gradient").cases == load("gradient-paper").cases == paper
    titles = {load(f"gradient:{case}").scenario.title for case in paper}
    assert len(titles) == 8
    assert load("gradient-paper:VI").scenario.actuator.delay_ticks == 0
    assert load("gradient:VI").scenario.actuator.delay_ticks == 1


def test_a_case_replaces_what_it_states(write):
    path = write(CASES)
    plain, slow, noisy = load(path), load(f"{path}:slow"), load(f"{path}:noisy")
    assert plain.cases == slow.cases == ("slow", "noisy")
    assert (slow.name, slow.folder_name, slow.scenario.title) == (
        "mine:slow",
        "mine-slow",
        "Slow learning",
    )
    assert slow.scenario.laws["cailc"] == plain.scenario.laws["cailc"] | {"alpha": 2.0}
    assert noisy.scenario.laws == plain.scenario.laws
    assert noisy.scenario.sensors.speed_noise_m_s == 0.01
    assert slow.scenario.runs == 3
    assert len({plain.digest, slow.digest, noisy.digest}) == 3


def test_a_case_loads_again_from_its_source(write):
    slow = load(f"{write(CASES)}:slow")
    assert load(slow.source).digest == slow.digest
    assert load(load("subway").source).digest == load("subway").digest


def test_a_memory_outlives_a_change_of_the_cases(write):
    digest = load(write(CASES)).digest
    assert load(write(CASES.replace("alpha = 2.0", "alpha = 3.0"), "other.toml")).digest == digest


def test_a_base_can_be_a_case_and_hands_the_cases_on(write):
    write(CASES)
    path = write('base = "mine.toml:slow"\nruns = 5\n', "upon.toml")
    assert load(path).scenario.laws["cailc"]["alpha"] == 2.0
    assert load(f"{path}:noisy").scenario.sensors.speed_noise_m_s == 0.01
    assert load(f"{path}:noisy").scenario.runs == 5


@pytest.mark.parametrize(
    ("name", "says"),
    [
        (":fast", r"mine\.toml: case 'fast' is unknown, expected one of slow, noisy"),
        (":", r"mine\.toml:: expected the name of a case after the colon"),
    ],
)
def test_an_unknown_case_lists_the_known_ones(name, says, write):
    with pytest.raises(ScenarioError, match=says):
        load(write(CASES) + name)


def test_a_scenario_without_cases_says_so():
    with pytest.raises(ScenarioError, match="case 'I' is unknown, the scenario has none"):
        load("subway:I")


def test_a_mistake_in_a_case_names_the_case(write):
    path = write(CASES.replace("speed_noise_m_s", "speed_nose_m_s"))
    assert load(f"{path}:slow").scenario.runs == 3
    with pytest.raises(ScenarioError, match=r"mine\.toml, case noisy: key sensors: .*speed_nose"):
        load(f"{path}:noisy")


def test_cases_are_tables(write):
    with pytest.raises(ScenarioError, match=r"key cases: expected tables, \[cases\.NAME\]"):
        load(write('base = "subway-paper"\ncases.I = 3\n'))


def test_an_overlay_is_what_a_file_would_state():
    loaded = overlaid("gradient:VI", {"laws": {"iplc": {"S": 1.0}}, "runs": 2})
    assert loaded.scenario.laws["iplc"] == load("gradient:VII").scenario.laws["iplc"]
    assert loaded.scenario.runs == 2
    assert load("gradient:VI").scenario.laws["iplc"]["S"] == 0.0


def test_scenarios_with_one_plan_share_it_and_others_do_not():
    one = overlaid("subway", {"control": {"mass_error": 0.01}})
    other = overlaid("subway", {"control": {"mass_error": 0.02}})
    assert one.segments is other.segments
    assert one.profile is other.profile
    shorter = overlaid("subway", {"profile": {"distance_m": 3500.0}})
    assert shorter.profile.position_m[-1] < one.profile.position_m[-1]
    finer = overlaid("subway", {"period_s": 0.005})
    assert len(finer.profile.x) > len(one.profile.x)


def test_a_file_that_was_edited_is_read_again_and_so_is_its_base(write):
    write('base = "subway"\nruns = 3\n', "base.toml")
    mine = write('base = "base.toml"\nlaw = "pdilc"\n')
    loaded = load(mine)
    assert (loaded.scenario.runs, loaded.scenario.law) == (3, "pdilc")
    assert load(mine) is loaded
    write('base = "base.toml"\nlaw = "adaptive"\n')
    assert load(mine).scenario.law == "adaptive"
    write('base = "subway"\nruns = 4\n', "base.toml")
    assert load(mine).scenario.runs == 4
    write('base = "base.toml"\nlaw = "pdilc"\n')
    write('base = "subway"\nruns = 3\n', "base.toml")
    assert load(mine) is loaded
