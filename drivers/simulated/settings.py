"""The ``twin:`` section of a bench file: reed, light, faults, and the pace of time."""

import hashlib
from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Annotated, Any, Final, Literal

import numpy as np
from pydantic import BeforeValidator, Field

from drivers.emulators.faults import GeneratorFaults, SynthesizerFaults
from drivers.emulators.serving import WireFaults
from drivers.errors import BenchSetupError
from drivers.options import Options, read_options
from drivers.simulated.disorder import RealisedDisorder, as_section, realised
from physics.errors import ImpossibleReedError
from physics.parameters.chamber import PressureDistortion
from physics.parameters.drive import Tweeter
from physics.parameters.optics import Layout, visible_size_m
from physics.parameters.tree import BenchParameters
from physics.reed.cane.material import Cane
from physics.reed.cane.viscoelastic import (
    Components,
    Series,
    ViscoelasticCane,
    require_physical,
    viscoelastic_cane,
)
from physics.reed.elements.mesh import STANDARD, MeshLevel
from physics.reed.geometry import ReedGeometry, ThicknessMap
from physics.reed.reduced.reed import BasisSettings, ReedBox
from protocols.bench import BenchFile
from protocols.bench_parameters import (
    known_effects,
    nominal_parameters,
    sensor_of_camera,
    with_effects,
)
from protocols.preparation import Preparation

_NOMINAL: Final = BenchParameters()

# Frequencies some tens of cents off, within a second or two: for tours and tests. The box has one
# value of all constants but two.
_COARSE: Final = (
    MeshLevel(orders=(2, 2, 2)),
    BasisSettings(
        ReedBox(E_L_pa=(8e9, 20e9), G_LT_pa=(0.5e9, 1.8e9), modulus_factor=1.0, poisson_spread=0.0),
        snapshots=0,
    ),
)
_MESHES: Final = {"standard": (STANDARD, BasisSettings()), "coarse": _COARSE}

_Numbers = Annotated[tuple[float, ...], Field(strict=False)]
_Factor = Annotated[float, Field(gt=0, le=10)]


class ReedComponents(Options):
    """The four components of the cane, in standard deviations of the paper's population."""

    e1: Annotated[float, Field(ge=-6, le=6)] = 0.0
    """Component e1."""
    e2: Annotated[float, Field(ge=-6, le=6)] = 0.0
    """Component e2."""
    e3: Annotated[float, Field(ge=-6, le=6)] = 0.0
    """Component e3."""
    e4: Annotated[float, Field(ge=-6, le=6)] = 0.0
    """Component e4."""


class ThicknessDeviations(Options):
    """Deviations of the vamp from the drawing, see `physics.reed.geometry.ThicknessMap`."""

    x_mm: _Numbers
    """Distances from the tip in mm, ascending."""
    y_mm: _Numbers
    """Distances from the axis in mm, ascending, with both signs."""
    deviation_um: Annotated[tuple[_Numbers, ...], Field(strict=False)]
    """Deviations in µm: a row for each x, in it a value for each y."""

    def thickness_map(self) -> ThicknessMap:
        """Return the map as physics knows it.

        Raises
        ------
        ImpossibleReedError
            If it says nothing of one side, or has rows of another length.
        """
        if not min(self.y_mm, default=0.0) < 0 < max(self.y_mm, default=0.0):
            raise ImpossibleReedError("y_mm of the thickness map lies on one side of the axis only")
        for number, row in enumerate(self.deviation_um, 1):
            if len(row) != len(self.y_mm):
                raise ImpossibleReedError(
                    f"row {number} of deviation_um has {len(row)} values for {len(self.y_mm)} "
                    "ordinates y_mm"
                )
        return ThicknessMap(
            _scaled(1e-3, self.x_mm),
            _scaled(1e-3, self.y_mm),
            tuple(_scaled(1e-6, row) for row in self.deviation_um),
        )


class Shape(Options):
    """Differences of the simulated reed from the reed of the protocol."""

    thickness_map: ThicknessDeviations | None = None
    """Deviations from the drawing, in place of those of the protocol's reed."""
    thickness_offset_um: Annotated[float, Field(ge=-1000, le=1000)] = 0.0
    """Thickness in µm added to the whole vamp."""


class CaneFactors(Options):
    """Constants of the simulated cane divided by those of the protocol's reed.

    The factors of E_L and G_LT multiply the moduli that follow from the reed's components, at every
    frequency.
    """

    E_L: _Factor = 1.0
    """Factor of E_L."""
    E_T: _Factor = 1.0
    """Factor of E_T."""
    E_R: _Factor = 1.0
    """Factor of E_R."""
    G_LT: _Factor = 1.0
    """Factor of G_LT."""
    G_LR: _Factor = 1.0
    """Factor of G_LR."""
    G_TR: _Factor = 1.0
    """Factor of G_TR."""
    nu_LT: _Factor = 1.0
    """Factor of nu_LT."""
    nu_LR: _Factor = 1.0
    """Factor of nu_LR."""
    nu_TR: _Factor = 1.0
    """Factor of nu_TR."""
    density: _Factor = 1.0
    """Factor of the density."""


class Pressure(Options):
    """Differences of the pressure on the reed from the model, see `PressureDistortion`."""

    distortion: Annotated[float, Field(ge=0, le=10)] = 0.0
    """Rms of a smooth random complex field F; the pressure is that of the model times 1 + F."""
    seed: Annotated[int, Field(ge=0)] = 0
    """Seed of the field."""


class Light(Options):
    """Both beams, see `physics.optics.Illumination`."""

    local_oscillator_e_s: Annotated[float, Field(gt=0)] = (
        _NOMINAL.optics.illumination.local_oscillator_e_s
    )
    """Local oscillator, in electrons per pixel and second."""
    object_e_s: Annotated[float, Field(gt=0)] = _NOMINAL.optics.illumination.object_e_s
    """Object beam, in electrons per pixel and second."""
    gain_scatter: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """Standard deviation of the logarithm of the object light's amplitude from one acquisition to
    the next, as from the power of the laser and the efficiency of the modulators."""
    phase_scatter: bool = False
    """Whether the phase of the object light is random in every acquisition, as when paths drift."""
    path_drift_rad: Annotated[float, Field(ge=-3, le=3)] = 0.0
    """Phase in rad by which the optical path turns the object light from each frame to the next."""
    path_walk_rad_s: Annotated[float, Field(ge=0, le=10)] = _NOMINAL.optics.interference.walk_rad_s
    """Random walk of the optical path's phase, in rad per square root of a second."""
    path_jitter_rad: Annotated[float, Field(ge=0, le=3)] = 0.0
    """Standard deviation in rad of a further random phase of each frame."""


_Acquisitions = Annotated[tuple[int, ...], Field(strict=False)]


class Faults(Options):
    """Faults of the bench, for tests and for training. Acquisitions count from 1."""

    tweeter_unplugged: bool = False
    """Disconnect the loudspeaker from the generator."""
    local_oscillator_factor: Annotated[float, Field(gt=0, le=1000)] = 1.0
    """Factor of the local oscillator's power; 4 saturates the camera."""
    drop_frame_at: _Acquisitions = ()
    """Acquisitions whose third frame is lost between camera and computer."""
    stale_frame_at: _Acquisitions = ()
    """Acquisitions whose frames come out of a buffer, older than the setting."""
    duplicate_frame_at: _Acquisitions = ()
    """Acquisitions whose third frame is a copy of the second."""
    reorder_frames_at: _Acquisitions = ()
    """Acquisitions whose third frame comes before the second."""
    partial_frame_at: _Acquisitions = ()
    """Acquisitions whose third frame ends in rows of the second."""
    late_frame_at: _Acquisitions = ()
    """Acquisitions whose third frame begins most of a period late."""
    dark_frame_at: _Acquisitions = ()
    """Acquisitions whose third frame is dark."""
    blink_at: _Acquisitions = ()
    """Acquisitions whose third frame has 90 % of its light."""
    advance_frames_at: _Acquisitions = ()
    """Acquisitions whose third and fourth frames show light of one period later."""
    sag_at: _Acquisitions = ()
    """Acquisitions in whose last two frames the loudspeaker has half its volts."""
    modulators_exchanged: bool = False
    """Connect each synthesizer to the other modulator."""
    no_frame_from: int | None = None
    """Acquisition from which on no frame comes, as when the trigger cable is unplugged."""
    clock_jump_at: int | None = None
    """Acquisition during which the clock of the camera jumps by `clock_jump_s`."""
    clock_jump_s: Annotated[float, Field(ge=-3600, le=3600)] = 0.5
    """Jump of the camera's clock, in s."""
    frame_rate_error_ppm: Annotated[float, Field(ge=-1e5, le=1e5)] = 0.0
    """Error of the camera's frame rate in parts per million; positive is too fast."""
    synthesizers_wire: WireFaults = WireFaults()
    """Faults of the connection to the emulated synthesizers."""
    generator_wire: WireFaults = WireFaults()
    """Faults of the connection to the emulated generator."""
    synthesizers_device: SynthesizerFaults = SynthesizerFaults()
    """Faults of the emulated synthesizers."""
    generator_device: GeneratorFaults = GeneratorFaults()
    """Faults of the emulated generator."""


class Simulation(Options):
    """Settings of the simulated bench."""

    reed: ReedComponents | None = None
    """Cane of the reed. Without this key, it follows from the name of the reed (`cane_of`)."""
    shape: Shape = Shape()
    """Differences of shape that plan and fit do not know."""
    cane_factors: CaneFactors = CaneFactors()
    """Differences of the cane that plan and fit do not know."""
    pressure: Pressure = Pressure()
    """Differences of the pressure that plan and fit do not know."""
    loss_factor: Annotated[float, Field(gt=0, lt=1)] = _NOMINAL.reed.loss_factor
    """Loss factor of the cane."""
    light: Light = Light()
    """Local oscillator and object beam."""
    mesh: Literal["standard", "coarse"] = "standard"
    """Mesh of the finite elements."""
    pace: Literal["fast", "realtime"] = "fast"
    """Whether simulated time passes as fast as frames can be computed, or in real time."""
    faults: Faults = Faults()
    """Faults, for tests and for training."""
    effects: dict[str, dict[str, float | str]] = Field(default_factory=dict)
    """Effects that the bench has and that plan and fit do not know, by name, each with its sizes:
    `{clamp_compliance: {compliance: 2e-13 m/Pa}}`. `acquire effects` lists them."""
    disorder: Annotated[dict[str, Any], BeforeValidator(as_section)] = Field(default_factory=dict)
    """Differences that ordinary benches and reeds have, and that plan and fit do not know, by name:
    `{speckle_renewal: 0.02, thickness_map: 5 um}`. The word `ordinary`, or `{ordinary: true,
    seed: 3}`, draws all that are not named from their ordinary ranges. They replace the values that
    `light` sets."""

    @property
    def finite_elements(self) -> tuple[MeshLevel, BasisSettings]:
        """Mesh and basis of the reed."""
        return _MESHES[self.mesh]


def _scaled(factor: float, values: tuple[float, ...]) -> tuple[float, ...]:
    return tuple(factor * value for value in values)


def read_simulation(content: Mapping[str, Any], bench_name: str) -> Simulation:
    """Check the ``twin:`` section of a bench file.

    Raises
    ------
    BenchSetupError
        With the key path of the first thing that is wrong.
    """
    return read_options(Simulation, content, bench_name, "twin")


def cane_of(reed: str) -> Components:
    """Return the cane of a reed: components drawn from N(0, 1), always the same for one name.

    Draws outside physics in either series (2 % of them) are drawn again.
    """
    # Not the bench's generator: a reed stays the same cane whatever else is random.
    rng = np.random.default_rng(list(hashlib.sha256(reed.encode()).digest()))
    while True:
        cane = Components(*(float(e) for e in rng.standard_normal(4)))
        if _physical(cane):
            return cane


def _physical(cane: Components) -> bool:
    try:
        for series in Series:
            require_physical(viscoelastic_cane(cane, series))
    except ImpossibleReedError:
        return False
    return True


def bench_geometry(simulation: Simulation, preparation: Preparation) -> ReedGeometry | None:
    """Return the shape of the reed on the bench; None is the paper's.

    That is the preparation's, unless the simulation says how it differs.

    Raises
    ------
    ImpossibleReedError
        If the thickness map is none; whether it makes a reed is for the mesh to say.
    """
    shape = simulation.shape
    if shape == Shape():
        return preparation.geometry
    drawn = preparation.geometry or ReedGeometry()
    measured = shape.thickness_map
    return replace(
        drawn,
        thickness_offset_m=drawn.thickness_offset_m + 1e-6 * shape.thickness_offset_um,
        thickness_map=measured.thickness_map() if measured else drawn.thickness_map,
    )


def bench_constants(simulation: Simulation, preparation: Preparation) -> Cane:
    """Return the constants, other than E_L and G_LT, of the cane on the bench."""
    known, factors = preparation.constants or Cane(), simulation.cane_factors
    changed = {
        field.name: getattr(known, field.name)
        * getattr(factors, field.name.removesuffix("_pa").removesuffix("_kg_m3"))
        for field in fields(Cane)
        if field.name not in ("E_L_pa", "G_LT_pa")
    }
    return replace(known, **changed)


def bench_parameters(
    simulation: Simulation, bench_file: BenchFile, preparation: Preparation
) -> BenchParameters:
    """Return the parameters of a simulated bench, with the whole sensor.

    The bench gets the disorder of ``twin:``, then the effects that the bench file lists under
    ``known:``, and then those of ``twin:``. An effect that is under both has the sizes of
    ``twin:``: these are what the bench has, and the others what is known of it.

    Parameters
    ----------
    simulation : Simulation
    bench_file : BenchFile
        Supplies optics and sensor.
    preparation : Preparation
        Supplies the reed, its moisture (series B is dried), its shape and the chamber.

    Raises
    ------
    BenchSetupError
        If the components given for the reed lie outside physics, or the disorder is wrong.
    ProtocolError
        If there is no such effect or size, or a size has another unit.
    """
    optics, size = bench_file.optics, bench_file.optics.reed_size
    geometry = preparation.geometry or ReedGeometry()
    nominal = nominal_parameters(
        Layout(
            wavelength_m=float(optics.wavelength_m),
            distance_m=float(optics.distance_m),
            reed_centre_m=(float(optics.reed_centre.y_m), float(optics.reed_centre.x_m)),
            reed_size_m=(float(size.y_m), float(size.x_m)) if size else visible_size_m(geometry),
        ),
        sensor_of_camera(bench_file.instruments.camera),
        geometry=geometry,
        chamber=preparation.chamber,
        series=preparation.series,
        resonances_hz=tuple(float(hz) for hz in bench_file.acoustic_resonances_hz),
    )
    drawn = _as_drawn(nominal, simulation, _cane(simulation, bench_file, preparation))
    drawn = bench_disorder(simulation, bench_file.name, preparation).applied(drawn)
    effects = {k: v for k, v in known_effects(bench_file).items() if k not in simulation.effects}
    known = with_effects(drawn, effects, f"{bench_file.source}: known")
    return with_effects(known, simulation.effects, f"{bench_file.source}: twin.effects")


def bench_disorder(
    simulation: Simulation, bench_name: str, preparation: Preparation
) -> RealisedDisorder:
    """Return the disorder of a simulated bench with the reed of a preparation.

    Raises
    ------
    BenchSetupError
        If the section is wrong.
    """
    source = f"bench {bench_name!r}: twin.disorder"
    return realised(simulation.disorder, preparation.reed, source)


def _as_drawn(
    nominal: BenchParameters, simulation: Simulation, cane: ViscoelasticCane
) -> BenchParameters:
    """Return parameters with everything that the simulation's section says but effects."""
    light, optics = simulation.light, nominal.optics
    distortion = PressureDistortion(simulation.pressure.distortion, simulation.pressure.seed)
    tweeter = Tweeter(connected=not simulation.faults.tweeter_unplugged)
    return replace(
        nominal,
        drive=replace(nominal.drive, tweeter=tweeter),
        chamber=replace(nominal.chamber, distortion=distortion),
        reed=replace(nominal.reed, cane=cane, loss_factor=simulation.loss_factor),
        optics=replace(
            optics,
            illumination=replace(
                optics.illumination,
                local_oscillator_e_s=(
                    light.local_oscillator_e_s * simulation.faults.local_oscillator_factor
                ),
                object_e_s=light.object_e_s,
                # A rough surface scatters everywhere, and not in the middles of pixels only.
                lattices=2,
            ),
            interference=replace(
                optics.interference,
                walk_rad_s=light.path_walk_rad_s,
                jitter_rad=light.path_jitter_rad,
                gain_scatter=light.gain_scatter,
            ),
        ),
    )


def _cane(
    simulation: Simulation, bench_file: BenchFile, preparation: Preparation
) -> ViscoelasticCane:
    """Return the moduli E_L and G_LT of the cane on the bench."""
    series = Series.B if preparation.series == "B" else Series.A
    components = (
        Components(**simulation.reed.model_dump()) if simulation.reed else cane_of(preparation.reed)
    )
    cane = viscoelastic_cane(components, series)
    try:
        require_physical(cane)
    except ImpossibleReedError as error:
        raise BenchSetupError(
            f"bench {bench_file.name!r}: twin.reed: {error} ({components}, series {series}); "
            "choose components nearer to 0"
        ) from None
    factors = simulation.cane_factors
    return ViscoelasticCane(cane.young_L.scaled(factors.E_L), cane.shear_LT.scaled(factors.G_LT))
