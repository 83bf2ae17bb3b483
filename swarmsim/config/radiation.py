"""Nuclides, materials and detectors as a user writes them."""

from itertools import pairwise
from typing import Literal

from pydantic import Field, model_validator

from swarmsim.config.base import Fraction, Model, Name, NonNegative, Positive, Vec3


class Line(Model):
    """One gamma or X-ray line: photon energy and photons per hundred decays."""

    energy_kev: float = Field(ge=30, lt=10_000)
    yield_percent: float = Field(gt=0, le=400)


class Nuclide(Model):
    """A gamma emitter (``configs/nuclides/<name>.yaml``).

    A nuclide whose daughters emit the photons (Cs-137) lists the daughters' lines per decay of the parent.
    """

    name: Name
    half_life_s: Positive
    lines: tuple[Line, ...] = Field(min_length=1, max_length=64)
    source: str


class BuildUp(Model):
    """Number build-up (photons above 30 keV) of one material at one energy, t mean free paths deep.

    B = 1 + C t (1 + t / 0.2)^P exp(D t): Berger's form with one factor more; leave P out for Berger's own.
    """

    energy_kev: Positive
    c: NonNegative
    d: float = Field(gt=-1, lt=0.9)
    p: float = Field(default=0.0, gt=-3, lt=3)


class NamedAs(Model):
    """Words in the names of a mesh by which `swarmsim import-site` guesses a material, and its usual thickness.

    A word is compared with each word of a name, as its beginning if it has four letters or more. ``wall_m`` is the
    thickness of the shell or sheet that such a name stands for; a thing without it is solid.
    """

    words: tuple[str, ...] = Field(min_length=1)
    wall_m: Positive | None = None


class Material(Model):
    """A material (``configs/materials/<name>.yaml``): bulk density and mass attenuation against energy.

    An energy written twice is an absorption edge: the first value holds below it, the second above.
    ``mass_energy_absorption_cm2_g`` and ``electrons_mol_g`` are only needed to derive ``build_up`` with
    ``configs/materials/generate_build_up.py`` of the repository.
    """

    name: Name
    density_kg_m3: Positive
    energy_kev: tuple[Positive, ...] = Field(min_length=2)
    mass_attenuation_cm2_g: tuple[Positive, ...] = Field(min_length=2)
    build_up: tuple[BuildUp, ...] = Field(min_length=1)
    source: str
    mass_energy_absorption_cm2_g: tuple[Positive, ...] | None = None
    electrons_mol_g: float | None = Field(default=None, gt=0, le=1)
    named_as: tuple[NamedAs, ...] = ()

    @model_validator(mode="after")
    def _aligned(self) -> "Material":
        energies = self.energy_kev
        for name in ("mass_attenuation_cm2_g", "mass_energy_absorption_cm2_g"):
            values = getattr(self, name)
            if values is not None and len(values) != len(energies):
                raise ValueError(f"energy_kev has {len(energies)} values and {name} has {len(values)}: make them equal")
        if any(b < a for a, b in pairwise(energies)):
            raise ValueError("energy_kev must increase (an energy written twice is an absorption edge)")
        if any(energies.count(e) > 2 for e in energies):
            raise ValueError("energy_kev may hold an energy at most twice (below and above an absorption edge)")
        if any(b.energy_kev <= a.energy_kev for a, b in pairwise(self.build_up)):
            raise ValueError("the energies of build_up must increase")
        return self


class DeadTime(Model):
    """Dead-time law applied to everything the crystal sees, background included."""

    model: Literal["none", "paralyzable", "non_paralyzable", "hybrid"] = "none"
    paralyzable_us: NonNegative = 0.0
    non_paralyzable_us: NonNegative = 0.0

    @model_validator(mode="after")
    def _consistent(self) -> "DeadTime":
        if self.model in ("none", "non_paralyzable") and self.paralyzable_us > 0:
            raise ValueError(f"the {self.model} model has no paralyzable_us: set it to 0 or choose hybrid")
        if self.model in ("none", "paralyzable") and self.non_paralyzable_us > 0:
            raise ValueError(f"the {self.model} model has no non_paralyzable_us: set it to 0 or choose hybrid")
        return self


class EfficiencyPoint(Model):
    """Parallel-beam end-on efficiency of the bare crystal at one energy, all pulses > 30 keV and full-energy ones."""

    energy_kev: Positive
    total: float = Field(gt=0, le=1)
    photopeak: float = Field(gt=0, le=1)

    @model_validator(mode="after")
    def _peak_within_total(self) -> "EfficiencyPoint":
        if self.photopeak > self.total:
            raise ValueError("photopeak must not exceed total")
        return self


class Housing(Model):
    """What a photon crosses before the crystal."""

    material: Name
    thickness_mm: NonNegative


class BackgroundLine(Model):
    """One natural gamma line and its share of the background counts."""

    energy_kev: Positive
    share: Fraction


class Background(Model):
    """Natural background: counts per second, and its spectrum (lines on a continuum exp(-E / continuum_kev))."""

    rate_cps: NonNegative
    continuum_kev: Positive
    lines: tuple[BackgroundLine, ...] = ()

    @model_validator(mode="after")
    def _shares(self) -> "Background":
        if sum(line.share for line in self.lines) > 1:
            raise ValueError("the shares of the background's lines must not exceed 1 together")
        return self


class Spectrometer(Model):
    """Multichannel analyser of a detector."""

    channels: int = Field(ge=64, le=16_384)
    energy_max_kev: Positive
    threshold_kev: Positive
    resolution_percent_at_662_kev: float = Field(gt=0, le=50)

    @model_validator(mode="after")
    def _threshold_below_end(self) -> "Spectrometer":
        if self.threshold_kev >= self.energy_max_kev:
            raise ValueError("threshold_kev must lie below energy_max_kev")
        return self


class Detector(Model):
    """A cylindrical scintillator (``configs/detectors/<name>.yaml``)."""

    name: Name
    crystal: Name
    diameter_mm: Positive
    length_mm: Positive
    efficiency: tuple[EfficiencyPoint, ...] = Field(min_length=2)
    housing: Housing
    background: Background
    dead_time: DeadTime
    sample_period_s: Positive
    spectrometer: Spectrometer
    sources: dict[str, str]

    @model_validator(mode="after")
    def _complete(self) -> "Detector":
        if any(b.energy_kev <= a.energy_kev for a, b in pairwise(self.efficiency)):
            raise ValueError("the energies of efficiency must increase")
        return self


class DetectorMount(Model):
    """Which detector a vehicle carries, where (body FLU) and along which axis."""

    model: Name
    position_m: Vec3
    axis: Vec3

    @model_validator(mode="after")
    def _axis_has_a_direction(self) -> "DetectorMount":
        if not any(self.axis):
            raise ValueError("axis must not be (0, 0, 0)")
        return self
