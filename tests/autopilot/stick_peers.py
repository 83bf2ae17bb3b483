"""Peers that run, and links to them, for tests of the vehicles that are flown by sticks."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from swarmsim.autopilot.ardrone import ArdroneSettings, ArdroneVehicle
from swarmsim.autopilot.pelican import PelicanSettings, PelicanVehicle
from swarmsim.autopilot.settings import load_settings
from swarmsim.autopilot.standin.ardrone import ArdroneStandin, ArdroneStandinSettings
from swarmsim.autopilot.standin.kinematic import KinematicBody
from swarmsim.autopilot.standin.pelican import PelicanStandin, PelicanStandinSettings
from tests.autopilot.ports import free_port

PATIENCE_S = 20.0  # a loaded machine's


@contextmanager
def ardrone_peer(**changed) -> Iterator[ArdroneStandin]:
    """An AR.Drone that runs in real time."""
    settings = load_settings("standin_ardrone2", ArdroneStandinSettings).model_copy(update=changed)
    body = KinematicBody(speed_max_m_s=4.0)
    peer = ArdroneStandin(body, settings, ports=(free_port(), free_port()))
    try:
        with peer:
            yield peer
    finally:
        peer.close()


@contextmanager
def ardrone_link(peer: ArdroneStandin, **arguments) -> Iterator[ArdroneVehicle]:
    """A link to it."""
    commands, navdata = (int(port) for port in peer.address.split(":")[2:])
    settings = load_settings("ardrone2", ArdroneSettings)
    settings = settings.model_copy(update={"command_port": commands, "navdata_port": navdata, "gap_s": 2.0})
    link = ArdroneVehicle("127.0.0.1", settings, **{"timeout_s": 5.0, **arguments})
    try:
        yield link
    finally:
        link.close()


@contextmanager
def pelican_peer(switch: str = "gps", **changed) -> Iterator[PelicanStandin]:
    """A Pelican that runs in real time."""
    settings = load_settings("standin_pelican", PelicanStandinSettings).model_copy(update={"motors_s": 0.3, **changed})
    peer = PelicanStandin(KinematicBody(), settings, switch)
    try:
        with peer:
            yield peer
    finally:
        peer.close()


@contextmanager
def pelican_link(peer: PelicanStandin, **arguments) -> Iterator[PelicanVehicle]:
    """A link to it."""
    settings = load_settings("pelican", PelicanSettings).model_copy(update={"land_m_s": 0.8, "landed_s": 0.6})
    device = peer.address.partition(":")[2]
    link = PelicanVehicle(device, settings, **{"timeout_s": 5.0, **arguments})
    try:
        yield link
    finally:
        link.close()


def until(reached: Callable[[], bool]) -> None:
    """Wait until it is so."""
    deadline = time.monotonic() + PATIENCE_S
    while not reached():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def airborne(link: ArdroneVehicle | PelicanVehicle, height_m: float = 1.2) -> None:
    """Bring it into the air, following setpoints."""
    link.preflight(lambda _: None, 10.0)
    link.align((10.0, 20.0, 5.0))
    link.follow(3.0)
    link.arm(5.0)
    link.take_off(height_m, PATIENCE_S)
