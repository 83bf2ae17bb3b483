"""Policies by name, from files, modules and entry points."""

import hashlib
import sys
from pathlib import Path

import pytest

from swarmsim.cli import main
from swarmsim.config.errors import InputError
from swarmsim.config.policies import SETTINGS, PolicySettings
from swarmsim.config.scenario import load_scenario
from swarmsim.policies import find, names, register, registry
from tests.config.project import make_project

CLIMB = """\
from swarmsim.config.policies import PolicySettings


class ClimbSettings(PolicySettings):
    gain_m: float = 3.0
    altitude_m: float


class Climb:
    Settings = ClimbSettings
    vehicles = ("multirotor",)
    period_s = 0.5

    def start(self, task, key):
        return 0.0

    def act(self, task, memory, view, key):
        return memory, None


climb = Climb()


class Plan:
    def plan(self, task, site, situation):
        return None


class Needy(Plan):
    def __init__(self, gain):
        self.gain = gain


class Broken:
    def act(self, task, memory, view, key):
        return memory, None


def function(task, memory, view, key):
    return memory, None
"""


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with a project and climb.py; the path of its recon.yaml."""
    mission = make_project(tmp_path)
    (tmp_path / "climb.py").write_text(CLIMB)
    monkeypatch.chdir(tmp_path)
    return mission


def message_of(reference: str, near: Path | None = None) -> str:
    with pytest.raises(InputError) as caught:
        find(reference, near)
    return str(caught.value)


def test_shipped_policies_are_found_by_name() -> None:
    assert set(SETTINGS) <= set(names())
    for name, model in SETTINGS.items():
        policy = find(name)
        assert callable(getattr(policy, "plan", None)) or callable(policy.act)
        assert registry.settings_model(name) is model
        assert registry.vehicle_kinds(name) == model.vehicles
        assert registry.digest(name) == ""


def test_a_misspelt_name_lists_the_known_ones() -> None:
    message = message_of("paralel_lines")
    assert "there is no policy 'paralel_lines'" in message
    assert "one of approach_and_orbit, hold" in message
    assert "did you mean 'parallel_lines'" in message


def test_a_policy_registered_in_python_is_found_by_its_name() -> None:
    @register("mine")
    class Mine:
        def plan(self, task, site, situation):
            return None

    try:
        assert isinstance(find("mine"), Mine)
        assert "mine" in names()
        assert registry.settings_model("mine") is PolicySettings
        assert registry.vehicle_kinds("mine") == ("multirotor", "skid_steer")
        assert registry.digest("mine") == hashlib.sha256(Path(__file__).read_bytes()).hexdigest()
        register("mine")(Mine)
        with pytest.raises(ValueError, match="'mine' is already"):
            register("mine")(type("Other", (Mine,), {}))
    finally:
        del registry._registered["mine"]
    with pytest.raises(TypeError, match="without act and without plan"):
        register("other")(object())
    with pytest.raises(ValueError, match="no ':'"):
        register("a:b")


def test_a_file_gives_the_same_object_until_it_changes(project: Path) -> None:
    climb, again = find("climb.py:climb"), find("./climb.py:climb")
    assert climb is again
    assert climb.period_s == 0.5
    made = find("climb.py:Plan")
    assert made is find("climb.py:Plan")
    assert type(made).__name__ == "Plan"
    file = project.parents[2] / "climb.py"
    assert registry.digest("climb.py:climb") == hashlib.sha256(CLIMB.encode()).hexdigest()
    file.write_text(CLIMB.replace("0.5", "0.25"))
    assert find("climb.py:climb").period_s == 0.25
    assert climb.period_s == 0.5


def test_a_file_beside_the_mission_comes_before_one_in_the_working_folder(project: Path) -> None:
    (project.parent / "climb.py").write_text(CLIMB.replace("0.5", "2.0"))
    assert find("climb.py:climb", project).period_s == 2.0
    assert find("climb.py:climb").period_s == 0.5


def test_a_file_may_import_its_neighbour(project: Path) -> None:
    (project.parent / "helper_of_climb.py").write_text("PERIOD_S = 7.0\n")
    (project.parent / "two.py").write_text(
        "from helper_of_climb import PERIOD_S\n" + CLIMB.replace("= 0.5", "= PERIOD_S")
    )
    assert find("two.py:climb", project).period_s == 7.0
    assert str(project.parent) not in sys.path


@pytest.mark.parametrize(
    ("reference", "fragments"),
    [
        ("clim.py:climb", ["there is no file 'clim.py'", "did you mean 'climb.py'"]),
        ("no/such.py:climb", ["there is no file 'no/such.py'"]),
        ("climb.py:clim", ["'climb.py' holds no object 'clim'", "one of", "did you mean 'climb'"]),
        ("climb.py:", ["is not a reference to a policy", "'file.py:object'"]),
        (":climb", ["is not a reference to a policy"]),
        ("climb.py:function", ["is no policy: it is a function without act and without plan", "start(task, key)"]),
        ("climb.py:Broken", ["has act and no start"]),
        ("climb.py:Needy", ["cannot be made without arguments", "gain", "defaults"]),
        ("climb.py:PolicySettings", ["is no policy"]),
        ("no_such_package.policies:climb", ["there is no module 'no_such_package'", "'policies.py:climb'"]),
        ("math:sqrt", ["'math:sqrt' is no policy"]),
    ],
)
def test_a_reference_that_leads_to_no_policy(project: Path, reference: str, fragments: list[str]) -> None:
    message = message_of(reference, project)
    for fragment in fragments:
        assert fragment in message


@pytest.mark.parametrize(
    ("text", "fragment"),
    [
        ("import math\n\nx = 1 / 0\n", "bad.py:3: ZeroDivisionError: division by zero"),
        ("x = (1,\ny = 2\n", "SyntaxError"),
        ("import sys\nsys.exit(3)\n", "bad.py:2: SystemExit: 3"),
        ("import no_such_module_at_all\n", "bad.py:1: ModuleNotFoundError: No module named 'no_such_module_at_all'"),
    ],
)
def test_a_file_that_cannot_be_imported_is_told_with_its_line(project: Path, text: str, fragment: str) -> None:
    Path("bad.py").write_text(text)
    message = message_of("bad.py:climb")
    assert "cannot be imported: bad.py:" in message
    assert fragment in message


def test_modules_and_entry_points(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = project.parents[2]
    (folder / "installed_policies.py").write_text(CLIMB)
    (folder / "installed.dist-info").mkdir()
    (folder / "installed.dist-info" / "METADATA").write_text("Name: installed\nVersion: 1\n")
    points = "[swarmsim.policies]\nuphill = installed_policies:climb\nlost = installed_policies:nothing\n"
    (folder / "installed.dist-info" / "entry_points.txt").write_text(points)
    monkeypatch.syspath_prepend(folder)
    module = find("installed_policies:climb")
    assert find("uphill") is module
    assert {"uphill", "lost"} <= set(names())
    assert registry.settings_model("uphill").__name__ == "ClimbSettings"
    assert registry.digest("uphill") == hashlib.sha256(CLIMB.encode()).hexdigest()
    assert "the entry point 'installed_policies:nothing' of the policy 'lost' cannot be loaded" in message_of("lost")


def phase_of(settings: str, policy: str = "climb.py:climb", who: str = "uav1") -> str:
    return f"phases.0={{name: survey, who: {who}, policy: '{policy}', settings: {settings}, time_limit_s: 60}}"


def test_a_scenario_with_a_policy_of_the_users(project: Path) -> None:
    scenario = load_scenario(project, [phase_of("{altitude_m: 12}")])
    settings = scenario.settings[0]
    assert (settings.gain_m, settings.altitude_m) == (3.0, 12.0)
    assert find(scenario.mission.phases[0].policy, scenario.mission_file).Settings is type(settings)
    assert scenario.versions()["policy_sha256.climb.py:climb"] == hashlib.sha256(CLIMB.encode()).hexdigest()
    assert load_scenario(project, [phase_of("{}", "climb.py:Plan")]).settings[0] == PolicySettings()


def test_a_scenario_says_that_what_it_was_written_with_has_changed(
    project: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenario = load_scenario(project, [phase_of("{altitude_m: 12}")])
    assert scenario.changes() == []
    written = project.parent / "written.yaml"
    written.write_text(scenario.to_yaml())
    assert load_scenario(written).changes() == []
    file = Path("climb.py")
    file.write_text(CLIMB.replace("period_s = 0.5", "period_s = 0.25"))
    (told,) = load_scenario(written).changes()
    assert "the file of the policy climb.py:climb is no longer what it was" in told
    beside = file.absolute().with_name("written.yaml")
    beside.write_text(written.read_text())
    monkeypatch.chdir("/")  # from elsewhere the policy is found beside the scenario, by its absolute path
    assert any("climb.py:climb is no longer what it was" in told for told in load_scenario(beside).changes())


def test_a_written_scenario_whose_body_file_is_missing_or_changed(project: Path) -> None:
    vehicle = project.parent.parent / "vehicles" / "orpheus.yaml"
    body = vehicle.with_name("body.urdf")
    body.write_text("<robot name='r'/>")
    vehicle.write_text(vehicle.read_text() + "\nbody: {file: body.urdf}\n")
    written = project.parent / "written.yaml"
    written.write_text(load_scenario(project).to_yaml())
    assert load_scenario(written).changes() == []
    body.write_text("<robot name='other'/>")
    (told,) = load_scenario(written).changes()
    assert "the body file of orpheus is no longer what it was" in told
    body.unlink()  # which is told where the body is read
    assert load_scenario(written).changes() == []


@pytest.mark.parametrize(
    ("override", "fragment"),
    [
        (phase_of("{}"), "phases.0.settings.altitude_m: this field is missing"),
        (phase_of("{altitude_m: 3, gian_m: 3}"), "phases.0.settings.gian_m: there is no field 'gian_m' here"),
        (phase_of("{altitude_m: high}"), "phases.0.settings.altitude_m: is not a number"),
        (phase_of("{altitude_m: 3}", who="all"), "the policy 'climb.py:climb' cannot command 'orpheus', a skid_steer"),
        (phase_of("{}", "clim.py:climb"), "phases.0.policy: there is no file 'clim.py'"),
        (phase_of("{gain_m: 3}", "climb.py:Plan"), "phases.0.settings.gain_m: there is no field 'gain_m' here"),
    ],
)
def test_a_policy_of_the_users_with_wrong_settings(project: Path, override: str, fragment: str) -> None:
    with pytest.raises(InputError) as caught:
        load_scenario(project, [override])
    assert fragment in str(caught.value)


def test_settings_that_are_no_model_are_refused(project: Path) -> None:
    Path("wrong.py").write_text(CLIMB.replace("Settings = ClimbSettings", "Settings = dict"))
    with pytest.raises(InputError, match="an attribute Settings that is no settings model"):
        registry.settings_model("wrong.py:climb")


def test_a_written_scenario_finds_the_policy_from_anywhere(
    project: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    (project.parent / "beside.py").write_text(CLIMB)
    near, here = phase_of("{altitude_m: 12}", "beside.py:climb"), phase_of("{altitude_m: 12}")
    assert "policy: climb.py:climb" in load_scenario(project, [here]).to_yaml()
    scenario = load_scenario(project, [near])
    written = tmp_path_factory.mktemp("run") / "scenario.yaml"
    written.write_text(scenario.to_yaml())
    monkeypatch.chdir(written.parent)
    again = load_scenario(written)
    assert again.mission.phases[0].policy == f"{(project.parent / 'beside.py').resolve()}:climb"
    assert again.settings == scenario.settings


@pytest.mark.parametrize("line", ["vehicles = 5", "senses = 5", "senses = (1, 2)"])
def test_names_that_are_none_are_refused(project: Path, line: str) -> None:
    Path("wrong.py").write_text(CLIMB.replace('vehicles = ("multirotor",)', line))
    asked = registry.senses if line.startswith("senses") else registry.vehicle_kinds
    with pytest.raises(InputError, match="must be a name or a tuple of names"):
        asked("wrong.py:climb")


OF_SETTINGS = {
    "needs = 5": "'needs' of the policy 'wrong.py:climb' must be a name or a tuple of names",
    "needs = ('sorce',)": "the policy 'wrong.py:climb' needs 'sorce', which is no thing that a mission finds",
    "needs = property(lambda self: 1 / 0)": "needed() of the policy 'wrong.py:climb' fails: wrong.py:7: ZeroDivision",
    "def needed(self): return None": "'needs' of the policy 'wrong.py:climb' must be a name or a tuple of names",
    "partners = ['altitude_m']": "'partners' of the policy 'wrong.py:climb' must be a mapping",
    "partners = {'altitud_m': 'skid_steer'}": "must name settings that are names",
    "partners = {'altitude_m': 'skid_steer'}": "must name settings that are names",
    "partners = {'mate': 'rover'}; mate: str = 'uav2'": "'partners' of the policy 'wrong.py:climb' names no kind",
    "def faults(self, kinds): return None": "faults() of the policy 'wrong.py:climb' must give pairs",
    "def faults(self, kinds): yield 'gain_m'": "faults() of the policy 'wrong.py:climb' must give pairs",
    "def faults(self, kinds): yield 1, 2": "faults() of the policy 'wrong.py:climb' must give pairs",
    "def faults(self, kinds): yield 1 / 0": "faults() of the policy 'wrong.py:climb' fails: wrong.py:7: ZeroDivision",
    "def faults(self): return []": "faults() of the policy 'wrong.py:climb' fails",
    "def faults(self, kinds): raise SystemExit(3)": "faults() of the policy 'wrong.py:climb' fails: wrong.py:7: System",
    "def faults(self, kinds): yield 'gain_m', 'is wrong'": "phases.0.settings.gain_m: is wrong",
    "vehicles = ('drone',)": "",
    "def model_post_init(self, context): return {}['x']": "a validator of the settings of the policy",
}


@pytest.mark.parametrize(("line", "fragment"), OF_SETTINGS.items())
def test_settings_that_answer_with_what_is_none(project: Path, line: str, fragment: str) -> None:
    Path("wrong.py").write_text(CLIMB.replace("    altitude_m: float", f"    altitude_m: float\n    {line}"))
    override = phase_of("{altitude_m: 12}", "wrong.py:climb")
    if not fragment:  # the policy's own vehicles come before those of its settings
        assert load_scenario(project, [override]).settings[0].altitude_m == 12
        return
    with pytest.raises(InputError) as caught:
        load_scenario(project, [override])
    message = str(caught.value)
    assert fragment in message
    assert "--set phases.0." in message


OF_POLICY = {
    "vehicles = ()": "'vehicles' of the policy 'wrong.py:climb' is empty",
    "vehicles = 'drone'": "the policy 'wrong.py:climb' commands 'drone', which is no kind of vehicle",
    "vehicles = property(lambda self: 1 / 0)": "vehicles of the policy 'wrong.py:climb' fails: wrong.py:11: Zero",
    "senses = property(lambda self: 1 / 0)": "senses of the policy 'wrong.py:climb' fails: wrong.py:11: Zero",
    "senses = 'imo'": "did you mean 'imu'?",
    "period_s = 'x'": "'period_s' of the policy 'wrong.py:climb' must be a number of seconds",
    "period_s = float('nan')": "'period_s' of the policy 'wrong.py:climb' must be a number of seconds",
    "task = 5": "'task' of the policy 'wrong.py:climb' must be a method",
    "done = 5": "'done' of the policy 'wrong.py:climb' must be a method",
}


@pytest.mark.parametrize(("line", "fragment"), OF_POLICY.items())
def test_a_policy_whose_attributes_are_none(project: Path, line: str, fragment: str) -> None:
    text = CLIMB.replace('    vehicles = ("multirotor",)\n    period_s = 0.5', f"    {line}")
    Path("wrong.py").write_text(text)
    with pytest.raises(InputError) as caught:
        load_scenario(project, [phase_of("{altitude_m: 12}", "wrong.py:climb")])
    message = str(caught.value)
    assert fragment in message
    assert message.startswith("--set phases.0.policy: ")


MEETS = {
    "the module": "raise KeyboardInterrupt",
    "a class being made": "class Meets:\n    def __set_name__(self, *of):\n        raise KeyboardInterrupt\n\n\n"
    "class Owner:\n    meets = Meets()",
    "what makes the policy": "class Climb(Climb):\n    def __init__(self):\n        raise KeyboardInterrupt",
}


@pytest.mark.parametrize("text", MEETS.values(), ids=MEETS)
def test_ctrl_c_in_the_file_of_a_policy_is_ctrl_c(project: Path, capsys: pytest.CaptureFixture[str], text: str) -> None:
    Path("slow.py").write_text(f"{CLIMB}\n\n{text}\n")
    for find_it in (find, registry.settings_model):
        with pytest.raises(KeyboardInterrupt):
            find_it("slow.py:Climb")
    mission = project.with_name("mine.yaml")
    phase = "{name: a, who: uav1, policy: 'slow.py:Climb', settings: {altitude_m: 9}, time_limit_s: 9}"
    mission.write_text(f"extends: recon\nname: mine\nphases: [{phase}]\n")
    assert main(["check", str(mission)]) == 130
    assert capsys.readouterr().err.strip() == "stopped with Ctrl-C: nothing unfinished was left behind"


@pytest.mark.parametrize("line", ["sys.path.clear()", "del sys.modules[__name__]", "del sys.modules[__name__]; 1 / 0"])
def test_a_file_may_do_to_the_interpreter_what_it_likes(
    project: Path, monkeypatch: pytest.MonkeyPatch, line: str
) -> None:
    monkeypatch.setattr(sys, "path", list(sys.path))
    Path("rude.py").write_text(f"import sys\n\n{CLIMB}\n{line}\n")
    if "1 / 0" in line:
        assert "ZeroDivisionError" in message_of("rude.py:climb")
    else:
        assert find("rude.py:climb").period_s == 0.5


def test_names_may_be_given_as_a_set(project: Path) -> None:
    Path("set.py").write_text(CLIMB.replace('vehicles = ("multirotor",)', 'vehicles = {"multirotor"}'))
    assert registry.vehicle_kinds("set.py:climb") == ("multirotor",)
