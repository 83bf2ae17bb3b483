"""Fields of scenarios written before missions had phases, and what to write in their stead."""

from typing import Any

import yaml

from swarmsim.config.allowed import item
from swarmsim.config.documents import Document, Place, beginning
from swarmsim.config.errors import Problem

# The former section -> the phase's name, who follows it, its policy, when it starts.
_SECTIONS: dict[str, tuple[str, str, str, dict[str, Any] | None]] = {
    "aerial": ("survey", "multirotor", "parallel_lines", None),
    "ground": ("search", "skid_steer", "approach_and_orbit", {"after": "survey"}),
}
_MOVED: dict[Place, str] = {
    ("aerial", "separation_m"): "traffic.separation_m",
    ("ground", "spectrum_radius_m"): "identification.spectrum_radius_m",
    ("ground", "confidence_min"): "identification.confidence_min",
    ("time_step_s",): "timing.physics_steps",
    ("localisation", "presumed_nuclide"): "knowledge.nuclides",
}
_CONTROL_PERIOD_S = 0.01


def former_problems(document: Document) -> list[Problem]:
    """A problem for each former field of a mission's document; each says how to write it now."""
    data = document.data
    problems = []
    for section in _SECTIONS:
        if section not in data:
            continue
        message = "is a phase now" if not item(data, "phases") else "stands in the phases now"
        problems.append(document.problem((section,), message, suggestion=_phase_text(document, section)))
    for place, now in _MOVED.items():
        value: Any = data
        for step in place:
            value = item(value, step)
        if value is not None:
            problems.append(document.problem(place, f"is now {now}", suggestion=f"write {_moved_text(place, value)}"))
    return problems


def former_override(steps: tuple[str, ...], value: Any, data: Any) -> tuple[str, str] | None:
    """Where the former path ``steps`` of an override stands now, and ``path=value`` as it is written now.

    None for a path that is no former one.
    """
    if steps == ("time_step_s",):
        return _MOVED[steps], f"{_MOVED[steps]}={_physics_steps(value)}"
    if steps in _MOVED:
        now = _MOVED[steps]
    elif steps[0] in _SECTIONS:
        now = f"phases.{_phase_name(data, steps[0])}"
        if len(steps) > 1:
            inner = () if steps[1] in ("policy", "time_limit_s") else ("settings",)
            now = ".".join([now, *inner, *steps[1:]])
    else:
        return None
    text = "" if value is None else _flow(value) if isinstance(value, dict | list) else value
    return now, f"{now}={text}"


def _phase_name(data: Any, section: str) -> str:
    """Name of the document's phase that does what a former section did."""
    usual, _, policy, _ = _SECTIONS[section]
    phases = item(data, "phases")
    for phase in phases if isinstance(phases, list) else ():
        if item(phase, "policy") == policy and isinstance(item(phase, "name"), str):
            return str(phase["name"])
    return usual


def _phase_text(document: Document, section: str) -> str:
    """The former section written as a phase; as a change of the phase where the document has phases already."""
    name, who, policy, start = _SECTIONS[section]
    values = document.data[section] if isinstance(document.data[section], dict) else {}
    settings = {
        key: value
        for key, value in values.items()
        if key not in ("policy", "time_limit_s") and (section, key) not in _MOVED and value is not None
    }
    limits = {key: values[key] for key in ("time_limit_s",) if key in values}
    if item(document.data, "phases"):
        change = ({"settings": settings} if settings else {}) | limits
        return f"write phases: {_flow({_phase_name(document.data, section): change})}"
    phase: dict[str, Any] = {"name": name, "who": who, "policy": values.get("policy", policy)}
    phase["settings"] = settings or {"speed_m_s": "…"}
    if start is not None:
        phase["start"] = start
    return f"write a phase: phases: {_flow([phase | (limits or {'time_limit_s': '…'})])}"


def _moved_text(place: Place, value: Any) -> str:
    if place == ("time_step_s",):
        return f"timing: {_flow({'control_period_s': _CONTROL_PERIOD_S, 'physics_steps': _physics_steps(value)})}"
    section, field = _MOVED[place].split(".")
    if place == ("localisation", "presumed_nuclide"):
        value = [value]
    return f"{section}: {_flow({field: value})}"


def _physics_steps(time_step_s: Any) -> int:
    """Time steps in a control period of `_CONTROL_PERIOD_S`, at least one; the default for what is no time step."""
    known = isinstance(time_step_s, int | float) and time_step_s > 0.01 * _CONTROL_PERIOD_S
    return max(1, round(_CONTROL_PERIOD_S / time_step_s)) if known else 2


def _flow(value: Any) -> str:
    """``value`` as YAML on one line."""
    text: str = yaml.safe_dump(
        beginning(value), default_flow_style=True, sort_keys=False, allow_unicode=True, width=10**6
    )
    return text.strip()
