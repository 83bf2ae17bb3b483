"""One compiled program of the localisation for all tests of a process: it takes half a minute to compile."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import pytest

from swarmsim.estimation import concatenate, localisation_params, localise
from swarmsim.estimation.localise import problem_of
from swarmsim.estimation.state import no_sources
from tests.estimation.survey import NUCLIDES, counted, orbit, place, presumed, spec, spectrometer, survey

DETECTORS = (spectrometer(), spectrometer("nai_2x2"))
FLIGHT, DRIVE = survey(count=300), orbit((12.0, 4.0), 7.0, 60)
BOTH = concatenate(FLIGHT, DRIVE)
AERIAL = replace(BOTH, valid=BOTH.detector == 0)
SPANS = ((0, 300, 0, 1), (300, 360, 1, 1))


class Localiser:
    """`localise` with settings of the size that all tests share."""

    def __init__(self):
        self.detectors, self.site = DETECTORS, place()
        self.presumed = presumed(self.site, DETECTORS)
        self.params = localisation_params(spec())
        empty = counted(AERIAL, jnp.zeros((360, DETECTORS[0].background_rois.shape[0])))
        self.nothing = no_sources(problem_of(self.presumed, empty, SPANS), spec().sources_max, len(NUCLIDES))
        program = jax.jit(localise, static_argnames="spans")
        self.program = program.lower(self.presumed, empty, SPANS, self.params, self.nothing).compile()

    def __call__(self, m, presumed=None, known=None):
        """What the counts of ``m`` tell, going on from the state ``known``."""
        return self.program(
            self.presumed if presumed is None else presumed, m, self.params, self.nothing if known is None else known
        )


@pytest.fixture(scope="session")
def localiser():
    return Localiser()
