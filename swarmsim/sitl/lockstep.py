"""Our physics and the firmware of all vehicles in lockstep: a period of the world for each exchange with everybody."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from swarmsim.sitl.link import FirmwareError, FirmwareLink
from swarmsim.sitl.plant import ACTUATORS, Plant
from swarmsim.sitl.settings import SitlSettings

LOGGED_S = 0.05
AHEAD_S = 0.001  # sleeping takes about as long: less ahead than that is not slept off


@dataclass
class Waits:
    """How long the firmware of one vehicle took to answer, wall clock."""

    answers: int = 0
    stalls: int = 0  # answers that took more than ``stall_s``
    missed: int = 0  # periods that went on without an answer
    longest_s: float = 0.0
    total_s: float = 0.0


@dataclass
class Tracks:
    """What happened, every `LOGGED_S`: true states of all vehicles and what the firmware commanded."""

    time_s: list[float] = field(default_factory=list)
    rows: list[NDArray[np.float64]] = field(default_factory=list)  # each [K, 11 + actuators]


class Lockstep:
    """Steps the plant with what the firmware commands; `run` goes on until its time or an error."""

    def __init__(self, plant: Plant, links: Sequence[FirmwareLink], settings: SitlSettings, speed: float):
        """``speed`` is simulated over real time; 0 for as fast as it goes."""
        self.plant, self.links, self.settings, self.speed = plant, links, settings, speed
        self.waits = [Waits() for _ in links]
        self.tracks = Tracks()
        self.began_s: float | None = None  # wall clock
        self.wall_s = 0.0
        self._start_s = 0.0
        self._silent_s = [0.0 for _ in links]  # since when each has not answered, wall clock
        self._every = max(1, round(LOGGED_S / plant.period_s))

    @property
    def time_s(self) -> float:
        """Simulated time."""
        return self.plant.truth.time_s

    @property
    def factor(self) -> float:
        """Simulated over real time since the first exchange."""
        return (self.time_s - self._start_s) / self.wall_s if self.wall_s else 0.0

    def connect(self, alive: Callable[[], None]) -> None:
        """Wait until every firmware has come; ``alive`` is asked meanwhile and may raise. Raises `FirmwareError`."""
        end = time.monotonic() + self.settings.start_s
        while missing := [link for link in self.links if not link.connected()]:
            alive()
            if time.monotonic() > end:
                names = ", ".join(f"{link.seat.name} at {link.address}" for link in missing)
                raise FirmwareError(
                    f"no firmware came within {self.settings.start_s:g} s for {names}: start it, or give its start "
                    "command with --start"
                )
            time.sleep(0.02)

    def run(self, until_s: float, told: Callable[[], None], every_s: float = 5.0) -> None:
        """Go on until the simulated time ``until_s``; ``told`` is called every ``every_s`` of real time."""
        plant = self.plant
        self.began_s, self._start_s = time.monotonic(), self.time_s
        self._silent_s = [self.began_s for _ in self.links]
        next_s = self.began_s + every_s
        actuators = np.zeros((len(self.links), ACTUATORS))
        while self.time_s < until_s:
            for link in self.links:
                link.tell(plant.truth, plant.sensed, plant.tick)
            for number, link in enumerate(self.links):
                self._hear(number, link)
                actuators[number] = link.actuators
            plant.step(actuators)
            now = time.monotonic()
            self.wall_s = now - self.began_s
            if plant.tick % self._every == 0 or self.time_s >= until_s:
                self._log(actuators)
            if now > next_s:
                told()
                next_s = now + every_s
            if self.speed:
                ahead = (self.time_s - self._start_s) / self.speed - self.wall_s
                if ahead > AHEAD_S:
                    time.sleep(ahead)

    def _hear(self, number: int, link: FirmwareLink) -> None:
        """Wait for an answer as long as one may be expected."""
        waits, s = self.waits[number], self.settings
        waited_for = link.seat.flies or s.rover_answers
        patience = (s.wait_s if waits.answers else s.first_wait_s) if waited_for else 0.0
        begin = time.monotonic()
        heard = link.hear(patience)
        now = time.monotonic()
        if heard:
            waits.stalls += bool(waits.answers) and now - begin > s.stall_s
            waits.answers += 1
            waits.total_s += now - begin
            waits.longest_s = max(waits.longest_s, now - begin)
            self._silent_s[number] = now
        elif waited_for and waits.answers:
            waits.missed += 1
        if waited_for and now - self._silent_s[number] > s.lost_s:
            raise FirmwareError(
                f"the firmware of {link.seat.name} has not answered for {s.lost_s:g} s: see what it printed, and start "
                "both again"
            )

    def _log(self, actuators: NDArray[np.float64]) -> None:
        t = self.plant.truth
        self.tracks.time_s.append(t.time_s)
        row = [t.position_m, t.velocity_m_s, t.quaternion, t.charge[:, None], actuators]
        self.tracks.rows.append(np.concatenate(row, axis=1))
