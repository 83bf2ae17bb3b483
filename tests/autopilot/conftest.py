"""A small autopilot on loopback and the link to it, for every test of that link."""

import pytest

from swarmsim.autopilot.mavlink import MavlinkVehicle
from tests.autopilot.ports import free_port
from tests.autopilot.test_mavlink_peer import Peer, eventually


@pytest.fixture
def linked():
    """Makes a peer and the link to it; closes both."""
    opened = []

    def link(how=None, wanted=None) -> tuple[Peer, MavlinkVehicle]:
        port = free_port()
        peer = Peer(port, **(how or {}))
        opened.append(peer)
        vehicle = MavlinkVehicle(f"udpin:127.0.0.1:{port}", **{"system": 7, "timeout_s": 5.0, **(wanted or {})})
        opened.insert(0, vehicle)
        assert eventually(lambda: vehicle.telemetry().pose_s is not None)
        return peer, vehicle

    yield link
    for one in opened:
        one.close()
