"""What must hold before a vehicle is armed, stage by stage, each with the reason why it does not."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from swarmsim.autopilot.link import LinkError
from swarmsim.autopilot.mavlink.decode import Heard
from swarmsim.autopilot.mavlink.profile import Profile

FRESH_S = 2.0
_FLAGS = ("attitude", "horizontal velocity", "vertical velocity", "", "absolute position", "absolute height")
_PARAMETERS_S = 6.0
_AGAIN_S = 5.0


@dataclass(frozen=True)
class Stage:
    """A check: ``reason`` says why it does not pass, empty where it passes; ``note`` what it saw."""

    name: str
    reason: str = ""
    note: str = ""


def stages(heard: Heard, profile: Profile, now: float) -> list[Stage]:
    """Every check of what the vehicle tells, in the order in which they usually pass."""
    return [check(heard, profile, now) for check in (_link, _gnss, _estimate, _pose, _home, _battery, _state, _ready)]


def _link(heard: Heard, profile: Profile, now: float) -> Stage:
    if heard.heard_s is None or now - heard.heard_s > FRESH_S:
        silent = "has come" if heard.heard_s is None else f"comes any more, for over {FRESH_S:g} s"
        return Stage("link", f"no heartbeat {silent}: check cable, radio, port and power")
    return Stage("link", note=f"{profile.autopilot.name} {profile.vehicle}, mode {heard.mode_name}")


def _gnss(heard: Heard, profile: Profile, now: float) -> Stage:
    least = profile.autopilot.gnss_fix_min
    if heard.gnss_fix is None:
        return Stage("GNSS", "the vehicle tells nothing of a receiver (GPS_RAW_INT)")
    seen = f"fix type {heard.gnss_fix}, {'?' if heard.satellites is None else heard.satellites} satellites"
    if heard.gnss_fix < least:
        return Stage("GNSS", f"{seen}: needs fix type {least} or better, so open sky, and time")
    return Stage("GNSS", note=seen)


def _estimate(heard: Heard, profile: Profile, now: float) -> Stage:
    rules = profile.autopilot.estimator
    if heard.estimator_flags is None:
        return Stage("estimate", f"{rules.message} has not come")
    flags = heard.estimator_flags
    if heard.estimate_ok:
        return Stage("estimate", note=f"flags {flags:#x}")
    lacks = [name for i, name in enumerate(_FLAGS) if name and rules.needed & ~flags & 1 << i]
    told = [f"lacks {', '.join(lacks)}"] if lacks else []
    told += ["reports an error"] if flags & rules.forbidden else []
    return Stage("estimate", f"the state estimate {' and '.join(told)} (flags {flags:#x}): keep still and wait")


def _pose(heard: Heard, profile: Profile, now: float) -> Stage:
    if heard.pose_s is None or now - heard.pose_s > 1.0:
        return Stage("position", "no local position comes (LOCAL_POSITION_NED)")
    if heard.quaternion_ned is None:
        return Stage("position", "no attitude comes (ATTITUDE_QUATERNION)")
    x, y, z = heard.position_ned_m or (0.0, 0.0, 0.0)
    return Stage("position", note=f"north {x:.1f} m, east {y:.1f} m, down {z:.1f} m of its origin")


def _home(heard: Heard, profile: Profile, now: float) -> Stage:
    if heard.home_s is None:
        return Stage("home", "it has no home position to return to: wait for the position, or set home")
    return Stage("home")


def _battery(heard: Heard, profile: Profile, now: float) -> Stage:
    least = profile.autopilot.battery_min
    if heard.battery is None:
        return Stage("battery", note="not told")
    seen = f"{heard.battery:.0%}"
    return Stage("battery", f"{seen} left, needs {least:.0%}: charge it" if heard.battery < least else "", seen)


def _state(heard: Heard, profile: Profile, now: float) -> Stage:
    if heard.failsafe:
        return Stage("failsafe", f"a failsafe is active in mode {heard.mode_name}: mend its cause")
    return Stage("failsafe")


def _ready(heard: Heard, profile: Profile, now: float) -> Stage:
    if heard.armed:
        return Stage("pre-arm", note="armed already")
    if heard.ready_to_arm:
        return Stage("pre-arm")
    ill = f"; not healthy: {', '.join(heard.unhealthy)}" if heard.unhealthy else ""
    told = "its own pre-arm checks fail" if heard.ready_to_arm is False else "it tells nothing of its pre-arm checks"
    return Stage("pre-arm", told + ill)


def parameter_stages(values: Mapping[str, float], profile: Profile, own_system: int) -> tuple[list[str], list[str]]:
    """What the parameters say: reasons to refuse, and statements to tell (warnings marked as such)."""
    refused: list[str] = []
    told: list[str] = []
    for rule in profile.kind.rules:
        if rule.parameter not in values:
            if rule.severity != "tell":
                told.append(f"{rule.parameter} was not told by the vehicle")
            continue
        value = values[rule.parameter]
        statement = f"{rule.parameter} = {value:g}: {rule.say}"
        if rule.severity == "tell":
            told.append(statement)
        elif rule.broken_by(value):
            (refused if rule.severity == "refuse" else told).append(
                statement if rule.severity == "refuse" else f"warning: {statement}"
            )
    if values.get("FS_GCS_ENABLE") and values.get("SYSID_MYGCS") != own_system:
        told.append(f"warning: FS_GCS_ENABLE does not watch this link: SYSID_MYGCS is not {own_system}")
    return refused, told


def preflight(
    heard: Callable[[], Heard],
    profile: Profile,
    read: Callable[[list[str], float], Mapping[str, float]],
    check_now: Callable[[], None],
    warnings: Callable[[float], list[str]],
    own_system: int,
    tell: Callable[[str], None],
    timeout_s: float,
) -> None:
    """Wait until every stage passes; raises `LinkError` with every reason why not when the time is up.

    ``read`` reads parameters within a time, ``check_now`` asks the vehicle for its pre-arm checks in words, and
    ``warnings`` are the words since a time. ``tell`` is called as stages pass or change their reason.
    """
    begin = time.monotonic()
    names = [rule.parameter for rule in profile.kind.rules]
    values = read(names, min(_PARAMETERS_S, timeout_s)) if names else {}
    refused, told = parameter_stages(values, profile, own_system)
    for statement in told:
        tell(statement)
    said: dict[str, Stage] = {}
    asked_s = begin
    while True:
        now = time.monotonic()
        found = stages(heard(), profile, now)
        for stage in found:
            known = said.get(stage.name)
            if known is None or known.reason != stage.reason:
                tell(
                    f"{stage.name}: {stage.reason or 'ok'}"
                    + (f" ({stage.note})" if stage.note and not stage.reason else "")
                )
                said[stage.name] = stage
        missing = [f"{stage.name}: {stage.reason}" for stage in found if stage.reason]
        if not missing and not refused:
            return
        if now - begin > timeout_s or (refused and not missing):
            break
        if now - asked_s > _AGAIN_S:
            asked_s = now
            check_now()
        time.sleep(0.1)
    reasons = [*missing, *refused, *(f"it says: {text}" for text in warnings(begin))]
    raise LinkError("the vehicle cannot be armed:\n  " + "\n  ".join(reasons))
