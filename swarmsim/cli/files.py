"""What ``swarmsim check``, ``schema``, ``list``, ``init`` and ``import-site`` do."""

import json
import shlex
import shutil
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from swarmsim.atomic_folder import atomic_folder
from swarmsim.cli.run import value_text
from swarmsim.config import files
from swarmsim.config.allowed import shape_of
from swarmsim.config.catalogue import MODELS
from swarmsim.config.documents import read_file, shown_path
from swarmsim.config.errors import InputError, Problem, file_errors_told, raise_if_any
from swarmsim.config.load import load_all, load_named
from swarmsim.config.names import one_of
from swarmsim.config.references import load_detector, load_vehicle
from swarmsim.config.sensors import SENSOR_KINDS

_TOLD_BY_KIND = ("vehicles", "sensors")  # unions of models, which the field ``kind`` tells apart
AUTOPILOTS = "autopilots"  # folder of what is known of real ones and their stand-ins


def check_files(paths: Sequence[Path]) -> None:
    """Validate every file, say which are right, and raise one `InputError` with the problems of all the others."""
    if not paths:
        raise InputError.of("name at least one file or folder to check")
    problems: list[Problem] = []
    for path in paths:
        try:
            found = list(_yaml_files(path))
        except InputError as error:
            problems += error.problems
            continue
        for file in found:
            try:
                kind, warnings = check_file(file)
            except InputError as error:
                problems += [problem for problem in error.problems if problem not in problems]
            else:
                sys.stdout.write(f"ok  {shown_path(file)} ({kind})\n")
                sys.stdout.writelines(f"    warning: {warning}\n" for warning in warnings)
    raise_if_any(problems)


def check_file(path: Path) -> tuple[str, list[str]]:
    """Validate one file with all that it refers to; what it is, and warnings of it. Raises `InputError`."""
    if path.absolute().parent.name == AUTOPILOTS:
        return _check_autopilot(path), []
    kind = kind_of_file(path)
    warnings: list[str] = []
    if kind == "missions":
        from swarmsim.config.scenario import load_scenario
        from swarmsim.config.site_checks import check_site

        scenario = load_scenario(path)
        warnings = scenario.changes()
        if scenario.family:
            from swarmsim.runtime.run import build

            _check_policies(scenario, build(scenario))
            varied = ", ".join(dict.fromkeys(v.key for v in scenario.family))
            return f"mission, a family that varies {varied}", warnings
        raise_if_any(check_site(scenario))
        _check_policies(scenario)
    elif kind == "sites":
        load_named(kind, path)
        from swarmsim.site import load_site

        warnings = load_site(path, tuple(load_all("materials", path))).report["warnings"]
    elif kind == "vehicles":
        load_vehicle(path)
    elif kind == "detectors":
        load_detector(path)
    else:
        load_named(kind, path)
    return kind.removesuffix("s"), warnings


def _check_policies(scenario: Any, built: Any = None) -> None:
    """Begin the mission of users' policies without computing anything. Raises `InputError` where one of them fails.

    ``built`` is the simulation, where there is one already.
    """
    from swarmsim.policies.registry import is_shipped

    if all(is_shipped(phase.policy) for phase in scenario.mission.phases):
        return
    import jax

    from swarmsim.missions.begin import begin_mission
    from swarmsim.runtime.run import build

    simulation = build(scenario) if built is None else built
    jax.eval_shape(begin_mission, jax.random.key(0), simulation.world, simulation.plan)


def _check_autopilot(path: Path) -> str:
    """Validate a file of `configs/autopilots`, whose name tells what it is; what that is."""
    from swarmsim.autopilot.ardrone.settings import ArdroneSettings
    from swarmsim.autopilot.mavlink.profile import Autopilot
    from swarmsim.autopilot.pelican.settings import PelicanSettings
    from swarmsim.autopilot.simulated import SimulatedManners
    from swarmsim.autopilot.standin.ardrone import ArdroneStandinSettings
    from swarmsim.autopilot.standin.pelican import PelicanStandinSettings
    from swarmsim.autopilot.standin.settings import Settings
    from swarmsim.config.load import load_model
    from swarmsim.config.manual import GamepadMap
    from swarmsim.sitl.settings import SitlSettings

    by_name = {
        "ardrone2": ("autopilot", ArdroneSettings),
        "pelican": ("autopilot", PelicanSettings),
        "simulated": ("simulated vehicle", SimulatedManners),
        "standin_ardrone2": ("stand-in autopilot", ArdroneStandinSettings),
        "standin_pelican": ("stand-in autopilot", PelicanStandinSettings),
    }
    by_prefix = {
        "sitl_": ("firmware in the loop", SitlSettings),
        "standin_": ("stand-in autopilot", Settings),
        "gamepad_": ("gamepad", GamepadMap),
        "": ("autopilot", Autopilot),
    }
    prefix = next(prefix for prefix in by_prefix if path.stem.startswith(prefix))
    what, model = by_name.get(path.stem, by_prefix[prefix])
    load_model(path, model)
    return what


def print_draws(name: str, seed: int | None, missions: int, overrides: Sequence[str]) -> None:
    """Print what missions of a family draw, one column each."""
    from swarmsim.config.scenario import load_scenario
    from swarmsim.runtime.run import build

    scenario = load_scenario(name, overrides, seed)
    if not scenario.family:
        hint = "add vary to it, e.g. --set 'vary.wind.speed_m_s={uniform: [0, 5]}'"
        raise InputError.of("is a single mission: nothing is drawn for it", path="vary", given=name, suggestion=hint)
    first = scenario.mission.seed
    draws = build(scenario).draw(range(first, first + missions))
    told = [draws.told(index) for index in range(missions)]
    table = Table("what", *(f"seed {each}" for each in draws.seeds), title=name, title_justify="left")
    for path in dict.fromkeys(path for row in told for path in row):
        table.add_row(path, *(value_text(row[path]) if path in row else "" for row in told))
    Console(width=None if sys.stdout.isatty() else 40 + 24 * missions).print(table)


def kind_of_file(path: Path) -> str:
    """Kind of a configuration file, from the folder that it lies in or else from its fields."""
    for folder in path.absolute().parents[:2]:
        if folder.name in files.KINDS:
            return folder.name
    fields = read_file(path).data
    if "kind" in fields:
        return "sensors" if fields["kind"] in SENSOR_KINDS else "vehicles"
    extended = [kind for kind in files.KINDS if str(fields.get("extends", "")) in files.available(kind, path)]
    if len(extended) == 1:
        return extended[0]
    own = {kind: set(shape_of(MODELS[kind]).fields((), None)) for kind in files.KINDS if kind not in _TOLD_BY_KIND}
    shared = {kind: len(names & set(fields)) for kind, names in own.items()}
    best = max(shared, key=lambda kind: shared[kind])
    if shared[best] < 2 or sum(count == shared[best] for count in shared.values()) > 1:
        hint = f"put it in a folder named {one_of(files.KINDS).removeprefix('one of ')}"
        raise InputError.of(
            "cannot tell what this file describes", file=shown_path(path), given=", ".join(fields), suggestion=hint
        )
    return best


def _yaml_files(path: Path) -> Iterator[Path]:
    if not (files.exists(path) and path.is_dir()):
        yield files.find("missions", path)
        return
    found = sorted(file for suffix in ("*.yaml", "*.yml") for file in path.rglob(suffix))
    if not found:
        raise InputError.of("holds no YAML file", file=str(path))
    yield from found


def print_schema(kind: str) -> None:
    """Print the JSON schema of a kind (in the singular)."""
    schema = TypeAdapter(MODELS[f"{kind}s"]).json_schema()
    sys.stdout.write(json.dumps({"$schema": "https://json-schema.org/draft/2020-12/schema"} | schema, indent=2) + "\n")


def list_available(kind: str | None) -> None:
    """Print the names of a kind, or of all kinds, with what they are and where they stand."""
    console = Console(width=None if sys.stdout.isatty() else 160)
    for one in (*files.KINDS, "policies") if kind is None else (kind,):
        table = Table("name", "what", "file", title=one, title_justify="left", title_style="bold")
        for row in _policy_rows() if one == "policies" else _file_rows(one):
            table.add_row(*map(escape, row))
        console.print(table)


def _policy_rows() -> Iterator[tuple[str, str, str]]:
    from swarmsim.policies import find, names
    from swarmsim.policies.registry import vehicle_kinds

    for name in names():
        policy = find(name)
        summary = (policy.__doc__ or "").strip().split("\n")[0]
        yield name, f"{', '.join(vehicle_kinds(name))}: {summary}", type(policy).__module__


def _file_rows(kind: str) -> Iterator[tuple[str, str, str]]:
    for name, path in files.available(kind).items():
        try:
            yield name, _describe(kind, load_named(kind, path)), shown_path(path)
        except InputError as error:
            count = len(error.problems)
            yield name, f"not valid: {count} problem{'s' * (count > 1)}, see swarmsim check", shown_path(path)


def _describe(kind: str, model: Any) -> str:
    match kind:
        case "detectors":
            return f"{model.crystal or 'counter'}, {model.diameter_mm:g} mm x {model.length_mm:g} mm"
        case "nuclides":
            strongest = sorted(model.lines, key=lambda line: -line.yield_percent)[:3]
            return ", ".join(f"{line.energy_kev:g} keV ({line.yield_percent:g} %)" for line in strongest)
        case "materials":
            return f"{model.density_kg_m3:g} kg/m3"
    return str(model.description)


def copy_configurations(folder: Path) -> None:
    """Copy the packaged configurations to ``folder/configs``, completely or not at all."""
    target = folder / "configs"
    told = file_errors_told("the configurations cannot be copied there", file=str(target))
    with told, atomic_folder(target, _check_new) as copy:
        # Scripts that generate shipped data are not configuration. The temporary folder may lie within the source.
        leave_out = shutil.ignore_patterns("*.py", "elements", "__pycache__", ".*")
        shutil.copytree(files.packaged_dir(), copy, ignore=leave_out, dirs_exist_ok=True)
    count = sum(1 for path in target.rglob("*") if path.is_file())
    go = "" if folder.resolve() == Path.cwd() else f"cd {shlex.quote(str(folder))} && "
    sys.stdout.write(f"{count} files copied to {target}\nFly the first mission: {go}swarmsim run recon\n")


def _check_new(target: Path) -> None:
    if target.exists():
        raise InputError.of(
            "is there already and is not overwritten", file=str(target), suggestion="choose another folder"
        )
    if target.parent.exists() and not target.parent.is_dir():
        raise InputError.of("is a file, not a folder", file=str(target.parent))
