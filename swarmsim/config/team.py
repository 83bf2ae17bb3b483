"""The team of a mission: formations expanded to single vehicles, and the vehicles that a phase's ``who`` names."""

from collections.abc import Iterable, Sequence

from swarmsim.config.mission import Mission, TeamMember
from swarmsim.config.vehicles import VEHICLE_KINDS, Multirotor, SkidSteer

ALL = "all"
RESERVED = (ALL, *VEHICLE_KINDS)
"""Names that no member may have, because ``who`` has a meaning for them."""


def team_size(mission: Mission) -> int:
    """How many vehicles a mission has, formations expanded."""
    return sum(1 if member.formation is None else member.formation.count for member in mission.vehicles)


def expand(member: TeamMember) -> tuple[TeamMember, ...]:
    """The vehicles that one entry of ``vehicles`` stands for."""
    formation = member.formation
    if formation is None:
        return (member,)
    (x, y), spacing = member.position_m, formation.spacing_m
    return tuple(
        member.model_copy(
            update={
                "name": f"{member.name}{k + 1}",
                "position_m": (x + spacing * (k % formation.columns), y + spacing * (k // formation.columns)),
                "formation": None,
            }
        )
        for k in range(formation.count)
    )


def expand_team(mission: Mission) -> tuple[tuple[TeamMember, ...], tuple[int, ...]]:
    """Every vehicle of a mission, and the index of its entry in ``mission.vehicles``."""
    pairs = [(vehicle, i) for i, member in enumerate(mission.vehicles) for vehicle in expand(member)]
    return tuple(vehicle for vehicle, _ in pairs), tuple(i for _, i in pairs)


def groups(
    mission: Mission,
    members: Sequence[TeamMember],
    entries: Sequence[int],
    vehicles: Sequence[Multirotor | SkidSteer],
) -> dict[str, tuple[int, ...]]:
    """What ``who`` may name, and the indices of the members that it means.

    A name with several meanings is that of a member, else of a formation, a vehicle type, a kind, or ``all``.
    """
    found: dict[str, list[int]] = {ALL: list(range(len(members)))}
    for kind in VEHICLE_KINDS:
        found[kind] = [i for i, vehicle in enumerate(vehicles) if vehicle.kind == kind]
    for name in dict.fromkeys(member.type for member in members):
        found[name] = []
    for i, member in enumerate(members):
        found[member.type].append(i)
    for k, entry in enumerate(mission.vehicles):
        if entry.formation is not None:
            found[entry.name] = [i for i, origin in enumerate(entries) if origin == k]
    found |= {member.name: [i] for i, member in enumerate(members)}
    return {name: tuple(indices) for name, indices in found.items() if indices}


def chosen(who: Iterable[str], known: dict[str, tuple[int, ...]]) -> tuple[int, ...]:
    """Indices of the members that ``who`` names, in the order of the team; names that mean nobody add none."""
    return tuple(sorted({index for name in who for index in known.get(name, ())}))
