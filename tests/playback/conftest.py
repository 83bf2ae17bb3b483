"""A mission and a site to show, made once."""

from collections.abc import Iterator

import pytest

from swarmsim.playback import plan
from swarmsim.results.record import MissionRecord
from swarmsim.site.model import SiteModel
from tests import synthetic


@pytest.fixture(scope="session")
def site() -> SiteModel:
    return synthetic.site_model()


@pytest.fixture(scope="session")
def found() -> MissionRecord:
    """A mission that found its source."""
    return synthetic.mission()


@pytest.fixture(scope="session")
def nothing() -> MissionRecord:
    """A mission over a site without a source, which found none."""
    return synthetic.mission(found=False)


@pytest.fixture(scope="session")
def swarm() -> MissionRecord:
    """A mission of 200 quadrotors that sought nothing."""
    return synthetic.swarm()


@pytest.fixture
def print_style() -> Iterator[None]:
    """Settings for print while a test runs."""
    with plan.print_style():
        yield
