"""Detectors of both kinds, built once for the radiation tests."""

import pytest

from swarmsim.config.load import load_named
from swarmsim.radiation import KINDS, Detector, Library, build_detector, load_library
from tests.radiation.points import MOUNT


@pytest.fixture(scope="session")
def library() -> Library:
    return load_library()


@pytest.fixture(scope="session")
def detectors(library: Library) -> dict[tuple[str, str], Detector]:
    return {
        (name, kind): build_detector(load_named("detectors", name), MOUNT, library, kind)
        for name in ("nai_1p5x1p5", "nai_2x2")
        for kind in KINDS
    }
