"""The ``twin:`` section of a bench file: which reed, which light, which faults, how fast."""

import hashlib
from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Annotated, Any, Final, Literal

import numpy as np
from pydantic import Field

from drivers.emulators.faults import GeneratorFaults, SynthesizerFaults
from drivers.emulators.serving import WireFaults
from drivers.errors import BenchSetupError
from drivers.options import Options, read_options
from physics.air import Filling, chamber_of
from physics.bench import PressureDistortion, TwinSettings
from physics.drive import Tweeter
from physics.optics import (
    Illumination,
    Layout,
    visible_size_m,
)
from physics.reed.basis import BasisSettings
from physics.reed.cache import STANDARD
from physics.reed.geometry import ReedGeometry, ThicknessMap
from physics.reed.material import Cane
from physics.reed.mesh import MeshLevel
from physics.reed.viscoelastic import (
    Components,
    Series,
    require_physical,
    viscoelastic_cane,
)
from physics.sensor import Sensor
from protocols.bench import BenchFile, CameraSensor
from protocols.preparation import Preparation

_NOMINAL: Final = TwinSettings()

# Frequencies some tens of cents off, in a fraction of a second: for tours and tests.
_COARSE: Final = (
    MeshLevel(orders=(2, 2, 2)),
    BasisSettings(E_L_pa=(8e9, 20e9), G_LT_pa=(0.5e9, 1.8e9)),
)
_MESHES: Final = {"standard": (STANDARD, BasisSettings()), "coarse": _COARSE}

_Numbers = Annotated[tuple[float, ...], Field(strict=False)]
_Factor = Annotated[float, Field(gt=0, le=10)]


class ReedComponents(Options):
    """The four components of the cane, in standard deviations of the population."""

    e1: Annotated[float, Field(ge=-6, le=6)] = 0.0
    e2: Annotated[float, Field(ge=-6, le=6)] = 0.0
    e3: Annotated[float, Field(ge=-6, le=6)] = 0.0
    e4: Annotated[float, Field(ge=-6, le=6)] = 0.0


class ThicknessDeviations(Options):
    """Deviations of the vamp from the drawing, see `physics.reed.geometry.ThicknessMap`.

    Attributes
    ----------
    x_mm, y_mm : tuple of float
        Abscissae and ordinates, ascending; y of either sign.
    deviation_um : tuple of tuple of float
        A row for each x, in it a value for each y.
    """

    x_mm: _Numbers
    y_mm: _Numbers
    deviation_um: Annotated[tuple[_Numbers, ...], Field(strict=False)]

    def thickness_map(self) -> ThicknessMap:
        """Return the map as physics knows it.

        Raises
        ------
        ValueError
            If it says nothing of one side, or has rows of another length.
        """
        if not min(self.y_mm, default=0.0) < 0 < max(self.y_mm, default=0.0):
            # What was measured on one side might be meant for both, or for one.
            raise ValueError("y_mm of the thickness map lies on one side of the axis only")
        for number, row in enumerate(self.deviation_um, 1):
            if len(row) != len(self.y_mm):
                raise ValueError(
                    f"row {number} of deviation_um has {len(row)} values for {len(self.y_mm)} "
                    "ordinates y_mm"
                )
        return ThicknessMap(
            _scaled(1e-3, self.x_mm),
            _scaled(1e-3, self.y_mm),
            tuple(_scaled(1e-6, row) for row in self.deviation_um),
        )


class Shape(Options):
    """How the reed on the bench differs from the protocol's, even in y or not.

    Attributes
    ----------
    thickness_map : ThicknessDeviations or None
        In place of that of the protocol's reed, if it has one.
    thickness_offset_um : float
        Added all over the vamp.
    """

    thickness_map: ThicknessDeviations | None = None
    thickness_offset_um: Annotated[float, Field(ge=-1000, le=1000)] = 0.0


class CaneFactors(Options):
    """Constants of the cane on the bench over those of the protocol's reed.

    Those of E_L and G_LT multiply the moduli that follow from the reed's components, at every
    frequency.
    """

    E_L: _Factor = 1.0
    E_T: _Factor = 1.0
    E_R: _Factor = 1.0
    G_LT: _Factor = 1.0
    G_LR: _Factor = 1.0
    G_TR: _Factor = 1.0
    nu_LT: _Factor = 1.0
    nu_LR: _Factor = 1.0
    nu_TR: _Factor = 1.0
    density: _Factor = 1.0


class Pressure(Options):
    """How the pressure on the reed differs from the model's, see `PressureDistortion`.

    Attributes
    ----------
    distortion : float
        Rms of a smooth random complex field; the pressure is the model's times 1 + this field.
    seed : int
        The field is always the same for one seed.
    """

    distortion: Annotated[float, Field(ge=0, le=10)] = 0.0
    seed: Annotated[int, Field(ge=0)] = 0


class Light(Options):
    """Both beams, see `physics.optics.Illumination`.

    Attributes
    ----------
    local_oscillator_e_s, object_e_s : float
        Electrons per pixel and second.
    gain_scatter : float
        Standard deviation of the logarithm of the object light's amplitude from one acquisition
        to the next: power of the laser, efficiency of the modulators.
    phase_scatter : bool
        Whether every acquisition has a phase of the object light of its own, as paths drift.
    path_drift_rad, path_jitter_rad : float
        By how much the optical path turns the object light from each frame to the next, and
        standard deviation of a further turn of each frame, at random.
    """

    local_oscillator_e_s: Annotated[float, Field(gt=0)] = _NOMINAL.illumination.local_oscillator_e_s
    object_e_s: Annotated[float, Field(gt=0)] = _NOMINAL.illumination.object_e_s
    gain_scatter: Annotated[float, Field(ge=0, lt=1)] = 0.0
    phase_scatter: bool = False
    path_drift_rad: Annotated[float, Field(ge=-3, le=3)] = 0.0
    path_jitter_rad: Annotated[float, Field(ge=0, le=3)] = 0.0


class Faults(Options):
    """What is wrong with the bench, for tests and for training.

    Attributes
    ----------
    tweeter_unplugged : bool
        The generator drives a cable that ends nowhere.
    local_oscillator_factor : float
        The local oscillator is this much too bright; 4 saturates the camera.
    drop_frame_at : tuple of int
        Acquisitions, counted from 1, whose third frame is lost between camera and computer.
    stale_frame_at : tuple of int
        Acquisitions, counted from 1, in which frames come out of a buffer, older than asked for.
    duplicate_frame_at, reorder_frames_at, partial_frame_at, late_frame_at : tuple of int
        Acquisitions whose third frame is the second once more; comes before the second; ends in
        rows of the second; begins most of a period late.
    dark_frame_at, blink_at, advance_frames_at, sag_at : tuple of int
        Acquisitions whose third frame is dark; has 90 % of its light; shows, like the fourth, what
        came one period later; is the first of two during which the loudspeaker has half its volts.
    modulators_exchanged : bool
        Each synthesizer feeds the other's modulator.
    no_frame_from : int or None
        From this acquisition on no frame comes: the trigger's cable is out.
    clock_jump_at : int or None
        During this acquisition the camera's clock jumps by `clock_jump_s`.
    frame_rate_error_ppm : float
        The camera is this much faster than it was told.
    synthesizers_wire, generator_wire : WireFaults
        What goes wrong on the wires of a bench whose instruments have some.
    synthesizers_device : SynthesizerFaults
    generator_device : GeneratorFaults
        What is wrong with the instruments at the far ends of these wires.
    """

    tweeter_unplugged: bool = False
    local_oscillator_factor: Annotated[float, Field(gt=0, le=1000)] = 1.0
    drop_frame_at: Annotated[tuple[int, ...], Field(strict=False)] = ()
    stale_frame_at: Annotated[tuple[int, ...], Field(strict=False)] = ()
    duplicate_frame_at: Annotated[tuple[int, ...], Field(strict=False)] = ()
    reorder_frames_at: Annotated[tuple[int, ...], Field(strict=False)] = ()
    partial_frame_at: Annotated[tuple[int, ...], Field(strict=False)] = ()
    late_frame_at: Annotated[tuple[int, ...], Field(strict=False)] = ()
    dark_frame_at: Annotated[tuple[int, ...], Field(strict=False)] = ()
    blink_at: Annotated[tuple[int, ...], Field(strict=False)] = ()
    advance_frames_at: Annotated[tuple[int, ...], Field(strict=False)] = ()
    sag_at: Annotated[tuple[int, ...], Field(strict=False)] = ()
    modulators_exchanged: bool = False
    no_frame_from: int | None = None
    clock_jump_at: int | None = None
    clock_jump_s: Annotated[float, Field(ge=-3600, le=3600)] = 0.5
    frame_rate_error_ppm: Annotated[float, Field(ge=-1e5, le=1e5)] = 0.0
    synthesizers_wire: WireFaults = WireFaults()
    generator_wire: WireFaults = WireFaults()
    synthesizers_device: SynthesizerFaults = SynthesizerFaults()
    generator_device: GeneratorFaults = GeneratorFaults()


class Twin(Options):
    """The whole section. What is not said is nominal.

    Attributes
    ----------
    reed : ReedComponents or None
        The cane; without it, that of the reed's name (`cane_of`).
    shape : Shape
        What of the reed's shape plan and fit do not know.
    cane_factors : CaneFactors
        What of its cane they do not know.
    pressure : Pressure
        What of the pressure on it they do not know.
    loss_factor : float
        Of the cane.
    mesh : {'standard', 'coarse'}
        How finely the reed is computed.
    pace : {'fast', 'realtime'}
        Whether time passes as fast as frames can be computed, or as on the wall.
    """

    reed: ReedComponents | None = None
    shape: Shape = Shape()
    cane_factors: CaneFactors = CaneFactors()
    pressure: Pressure = Pressure()
    loss_factor: Annotated[float, Field(gt=0, lt=1)] = _NOMINAL.loss_factor
    light: Light = Light()
    mesh: Literal["standard", "coarse"] = "standard"
    pace: Literal["fast", "realtime"] = "fast"
    faults: Faults = Faults()

    @property
    def finite_elements(self) -> tuple[MeshLevel, BasisSettings]:
        """Mesh and basis of the reed."""
        return _MESHES[self.mesh]


def _scaled(factor: float, values: tuple[float, ...]) -> tuple[float, ...]:
    return tuple(factor * value for value in values)


def read_twin(content: Mapping[str, Any], bench_name: str) -> Twin:
    """Check the ``twin:`` section of a bench file.

    Raises
    ------
    BenchSetupError
        With the key path of the first thing that is wrong.
    """
    return read_options(Twin, content, bench_name, "twin")


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
    except ValueError:
        return False
    return True


def bench_geometry(twin: Twin, preparation: Preparation) -> ReedGeometry | None:
    """Return the shape of the reed on the bench; None is the paper's.

    That is the preparation's, unless the twin says how it differs.

    Raises
    ------
    ValueError
        If the thickness map is none; whether it makes a reed is for the mesh to say.
    """
    shape = twin.shape
    if shape == Shape():
        return preparation.geometry
    drawn = preparation.geometry or ReedGeometry()
    measured = shape.thickness_map
    return replace(
        drawn,
        thickness_offset_m=drawn.thickness_offset_m + 1e-6 * shape.thickness_offset_um,
        thickness_map=measured.thickness_map() if measured else drawn.thickness_map,
    )


def bench_constants(twin: Twin, preparation: Preparation) -> Cane:
    """Return the constants, other than E_L and G_LT, of the cane on the bench."""
    known, factors = preparation.constants or Cane(), twin.cane_factors
    changed = {
        field.name: getattr(known, field.name)
        * getattr(factors, field.name.removesuffix("_pa").removesuffix("_kg_m3"))
        for field in fields(Cane)
        if field.name not in ("E_L_pa", "G_LT_pa")
    }
    return replace(known, **changed)


def twin_settings(twin: Twin, bench_file: BenchFile, preparation: Preparation) -> TwinSettings:
    """Return the settings of `physics` for a bench, with the whole sensor.

    Parameters
    ----------
    twin : Twin
    bench_file : BenchFile
        Supplies optics and sensor.
    preparation : Preparation
        Supplies the reed, its moisture (series B is dried), its shape and the chamber.

    Raises
    ------
    BenchSetupError
        If the components given for the reed lie outside physics.
    """
    camera, optics = bench_file.instruments.camera, bench_file.optics
    geometry, size = preparation.geometry or ReedGeometry(), optics.reed_size
    series = Series.B if preparation.series == "B" else Series.A
    cane = Components(**twin.reed.model_dump()) if twin.reed else cane_of(preparation.reed)
    try:
        require_physical(viscoelastic_cane(cane, series))
    except ValueError as error:
        raise BenchSetupError(
            f"bench {bench_file.name!r}: twin.reed: {error} ({cane}, series {series}); choose "
            "components nearer to 0"
        ) from None
    factor = twin.faults.local_oscillator_factor
    return TwinSettings(
        components=cane,
        series=series,
        E_L_factor=twin.cane_factors.E_L,
        G_LT_factor=twin.cane_factors.G_LT,
        loss_factor=twin.loss_factor,
        chamber=chamber_of(geometry, Filling(preparation.chamber)),
        distortion=PressureDistortion(twin.pressure.distortion, twin.pressure.seed),
        tweeter=Tweeter(connected=not twin.faults.tweeter_unplugged),
        illumination=Illumination(
            local_oscillator_e_s=twin.light.local_oscillator_e_s * factor,
            object_e_s=twin.light.object_e_s,
        ),
        layout=Layout(
            wavelength_m=float(optics.wavelength_m),
            distance_m=float(optics.distance_m),
            reed_centre_m=(float(optics.reed_centre.y_m), float(optics.reed_centre.x_m)),
            reed_size_m=(float(size.y_m), float(size.x_m)) if size else visible_size_m(geometry),
        ),
        sensor=_sensor(camera),
    )


def _sensor(camera: CameraSensor) -> Sensor:
    """The sensor of a camera, nominal in what its data sheet does not say."""
    shape, pixel_m, sheet = (camera.height, camera.width), float(camera.pixel_m), camera.data_sheet
    if sheet is None:
        return Sensor(shape=shape, pixel_m=pixel_m, bits=camera.bits)
    return Sensor(
        shape=shape,
        pixel_m=pixel_m,
        bits=camera.bits,
        offset_dn=sheet.offset_dn,
        gain_e_dn=sheet.gain_e_dn,
        read_noise_e=sheet.read_noise_e,
        full_well_e=sheet.full_well_e,
    )
