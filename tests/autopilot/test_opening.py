"""Link strings: which link each means, and what is said of wrong ones."""

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarmsim.autopilot.opening import ArdroneAddress, PelicanAddress, SimulatedAddress, log_suffix, open_vehicle, parse
from swarmsim.config.errors import InputError


@pytest.mark.parametrize(
    ("link", "meant"),
    [
        ("ardrone:192.168.1.1", ArdroneAddress("192.168.1.1")),
        ("ardrone:127.0.0.1:15556:15554", ArdroneAddress("127.0.0.1", 15556, 15554)),
        ("pelican:/dev/ttyUSB0", PelicanAddress("/dev/ttyUSB0", 57_600)),
        (" pelican:COM3:115200 ", PelicanAddress("COM3", 115_200)),
        ("sim:", SimulatedAddress()),
        ("udpin:127.0.0.1:14540", "udpin:127.0.0.1:14540"),
        ("serial:/dev/ttyUSB0:57600", "serial:/dev/ttyUSB0:57600"),
    ],
)
def test_a_link_string_means_one_link(link, meant):
    assert parse(link) == meant
    assert log_suffix(link) == (".tlog" if isinstance(meant, str) else ".log")


@pytest.mark.parametrize(
    "link",
    [
        "", "ardrone", "ardrone:", "ardrone:h:1", "ardrone:h:1:0", "ardrone:h:1:2:3", "ardrone:h:1:x", "ardrone:a b",
        "pelican:", "pelican:/dev/x:0", "pelican:/dev/x:fast", "pelican:/dev/x:99999999999", "udpin:x", "pigeon:home",
        "sim", "sim:x",
    ],
)  # fmt: skip
def test_a_wrong_one_is_told_with_every_form_that_is_allowed(link):
    with pytest.raises(InputError) as found:
        parse(link)
    for form in ("udpin", "tcp:", "serial:", "ardrone:HOST", "pelican:DEVICE", "sim:"):
        assert form in str(found.value)


@given(st.text(max_size=60))
def test_no_text_breaks_it(text):
    with contextlib.suppress(InputError):
        parse(text)


@pytest.mark.parametrize(
    ("link", "arguments", "word"),
    [
        ("ardrone:127.0.0.1", {"profile": "px4"}, "ardrone2 or auto"),
        ("pelican:/dev/x", {"profile": "ardrone2"}, "pelican or auto"),
        ("udpin:14540", {"profile": "pelican"}, "px4, ardupilot or auto"),
        ("ardrone:127.0.0.1", {"system": 3}, "--system"),
    ],
)
def test_what_does_not_go_with_a_link_is_refused(link, arguments, word):
    with pytest.raises(InputError, match=word):
        open_vehicle(link, **arguments)


def test_a_simulated_vehicle_is_that_of_a_mission():
    with pytest.raises(InputError, match="none to be found"):
        open_vehicle("sim:")
    with pytest.raises(InputError, match="no such profile"):
        open_vehicle("sim:", profile="px4")
