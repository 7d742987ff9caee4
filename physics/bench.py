"""The whole twin: from what the instruments are set to, to what the camera reads."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from holography.fresnel import FresnelTransform
from physics.air import (
    CavityLine,
    Chamber,
    cavity_gain,
    pressure_shape,
)
from physics.drive import Tweeter, tweeter_pressure_pa
from physics.optics import (
    Illumination,
    Layout,
    beat_integral,
    kept_orders,
    reed_axes_m,
    reed_region,
    sidebands,
    speckle,
)
from physics.reed.basis import ReducedReed
from physics.reed.fem import Symmetry
from physics.reed.response import forced_response
from physics.reed.surface import on_reed, surface_shapes
from physics.reed.viscoelastic import (
    Components,
    Series,
    ViscoelasticCane,
    Zener,
    require_physical,
    viscoelastic_cane,
)
from physics.reed.whole import WholeReed
from physics.sensor import Sensor, read_out

Array = NDArray[np.floating[Any]]
Float = NDArray[np.float32]
Complex = NDArray[np.complexfloating[Any, Any]]
Complex64 = NDArray[np.complex64]

# Degrees along the window, across it and in ln f of what distorts a pressure, and the band.
_DISTORTION_DEGREES = (2, 2, 3)
_BAND_HZ = (1e3, 20e3)


@dataclass(frozen=True)
class PressureDistortion:
    """A pressure on the reed that is not the model's: that times 1 + a smooth random field.

    Attributes
    ----------
    rms : float
        Of the complex field, over the chamber's window and 1 to 20 kHz in octaves; 0 is the model.
    seed : int
        Tells fields of one rms apart.
    """

    rms: float = 0.0
    seed: int = 0


@dataclass(frozen=True)
class TwinSettings:
    """Everything that makes one simulated bench with one reed on it.

    Attributes
    ----------
    components : Components
        The reed's cane.
    series : Series
        Moisture: A as bought, B dried.
    E_L_factor, G_LT_factor : float
        Of this cane's moduli, over those that its components say.
    loss_factor : float
        Of the cane, the same for all modes (see decision 0004).
    """

    components: Components = Components()
    series: Series = Series.A
    E_L_factor: float = 1.0
    G_LT_factor: float = 1.0
    loss_factor: float = 0.03
    chamber: Chamber = Chamber()
    distortion: PressureDistortion = PressureDistortion()
    line: CavityLine = CavityLine()
    tweeter: Tweeter = Tweeter()
    illumination: Illumination = Illumination()
    layout: Layout = Layout()
    sensor: Sensor = field(default_factory=Sensor)


@dataclass(frozen=True)
class BenchState:
    """What the instruments impose on light and air.

    Attributes
    ----------
    difference_hz : Fraction
        f_AOM1 − f_AOM2.
    drive_hz : Fraction
    drive_v : float
        Peak volts at the tweeter; 0 is off.
    rf_on : bool
        Whether the modulators diffract: without radio frequency no light reaches the sensor.
    """

    difference_hz: Fraction
    drive_hz: Fraction
    drive_v: float
    rf_on: bool = True


@dataclass(frozen=True)
class Scene:
    """Which light reaches the sensor.

    Attributes
    ----------
    local_oscillator, object_beam : bool
    lamp_e_s : float
        Electrons per pixel and second of even light.
    """

    local_oscillator: bool = True
    object_beam: bool = True
    lamp_e_s: float = 0.0


@dataclass(frozen=True)
class Segment:
    """A stretch of one exposure during which the state was constant, on the bench's clock."""

    start_s: float
    end_s: float
    state: BenchState


def bench_cane(settings: TwinSettings) -> ViscoelasticCane:
    """Zener moduli of the cane on a bench.

    Raises
    ------
    ValueError
        If its components are outside physics (see `require_physical`).
    """
    cane = viscoelastic_cane(settings.components, settings.series)
    require_physical(cane)
    return ViscoelasticCane(
        _scaled(cane.young_L, settings.E_L_factor), _scaled(cane.shear_LT, settings.G_LT_factor)
    )


def _scaled(zener: Zener, factor: float) -> Zener:
    # All three alike: the storage modulus is that much greater at every frequency.
    return Zener(
        factor * zener.spring_mpa, factor * zener.arm_spring_mpa, factor * zener.arm_dashpot_mpa_s
    )


def distortion_factor(
    distortion: PressureDistortion, chamber: Chamber, frequency_hz: float, x_m: Array, y_m: Array
) -> Complex:
    """Pressure over that of the model, at points of the flat side (any shape).

    1 + a sum of products of Legendre polynomials in x, y and ln f, of random complex weights. None
    is constant over the window: such a one would be a gain. Beyond window and band the field goes
    on as at their edges.
    """
    rng = np.random.default_rng(distortion.seed)
    shape = [degree + 1 for degree in _DISTORTION_DEGREES]
    real, imaginary = rng.standard_normal((2, *shape))
    weights = real + 1j * imaginary
    weights[0, 0] = 0.0
    weights *= distortion.rms / np.linalg.norm(weights)
    low, high = np.log(_BAND_HZ)
    along, across, pitch = (
        _legendre(place, degree)
        for place, degree in zip(
            (
                2 * x_m / chamber.length_m - 1,
                y_m / chamber.half_width_m,
                np.array([2 * (np.log(frequency_hz) - low) / (high - low) - 1]),
            ),
            _DISTORTION_DEGREES,
            strict=True,
        )
    )
    factor: Complex = 1 + np.einsum("lm,...l,...m->...", weights @ pitch[0], along, across)
    return factor


def _legendre(place: Array, degree: int) -> Array:
    """Legendre polynomials (…, degree + 1) of mean square 1 over −1 … 1, constant beyond."""
    table = np.polynomial.legendre.legvander(np.clip(place, -1, 1), degree)
    normalised: Array = table * np.sqrt(2 * np.arange(degree + 1) + 1)
    return normalised


class BenchModel:
    """Renders the frames of a simulated bench.

    Holds what is fixed for a run: the reed, its speckle, the transform. Frames are pure functions
    of the segments of their exposure and of the noise drawn from the generator handed in.

    The reed is taken to follow a change of drive at once (its ring-down, Q/πf, is a few ms) and
    the light of the object alone, ``|E|²``, to be that of the reed at rest: it is the same in all
    frames of a step, so demodulation cancels it.
    """

    def __init__(
        self, settings: TwinSettings, reed: ReducedReed | WholeReed, rng: np.random.Generator
    ) -> None:
        self.settings = settings
        sensor, layout = settings.sensor, settings.layout
        self.transform = FresnelTransform(
            sensor.shape, sensor.pixel_m, layout.wavelength_m, layout.distance_m
        )
        self.region = reed_region(layout, self.transform)
        y, x = np.meshgrid(*reed_axes_m(layout, self.region, self.transform), indexing="ij")
        self._lit = on_reed(reed.geometry.outline, x, y)
        self._shapes = surface_shapes(reed, x[self._lit], y[self._lit])
        self._cane = bench_cane(settings)
        self._object = self._scattered_light(x, y, rng)
        self._lo = self._local_oscillator()
        self._at_rest = np.abs(self.transform.to_sensor(self._pasted(self._object))) ** 2
        # The four frames of a step share all but their beat integrals. Functions, not methods: a
        # cache that holds the bench would keep its memory until the garbage is next collected.
        self._response = lru_cache(maxsize=4)(
            partial(_unit_response, settings, reed, self._cane, self._shapes)
        )
        self._light = lru_cache(maxsize=2)(
            partial(_light_of_sidebands, self._object, self._response, layout.wavelength_m)
        )

    def _scattered_light(self, x: Array, y: Array, rng: np.random.Generator) -> Complex64:
        """Amplitude of the light of each lit pixel (n,), in √(electrons/s)."""
        light, height_width = self.settings.illumination, x.shape
        rough = speckle(height_width, rng)[self._lit]
        middle = 0.5 * self.settings.layout.reed_size_m[1]
        r2 = (x[self._lit] - middle) ** 2 + y[self._lit] ** 2
        amplitude = rough * np.exp(-r2 / light.object_waist_m**2)
        power = light.object_e_s * self._pixels / np.sum(np.abs(amplitude) ** 2)
        scattered: Complex64 = (amplitude * np.sqrt(power)).astype(np.complex64)
        return scattered

    def _local_oscillator(self) -> Float:
        """Amplitude of the local oscillator on the sensor (ny, nx), in √(electrons/s)."""
        light, sensor = self.settings.illumination, self.settings.sensor
        r2 = np.add.outer(*[(sensor.pixel_m * (np.arange(n) - n // 2)) ** 2 for n in sensor.shape])
        profile = np.exp(-r2 / light.local_oscillator_waist_m**2)
        amplitude: Float = (np.sqrt(light.local_oscillator_e_s) * profile).astype(np.float32)
        return amplitude

    @property
    def _pixels(self) -> int:
        return int(np.prod(self.settings.sensor.shape))

    def _pasted(self, lit: Complex64) -> Complex64:
        """Object plane (ny, nx) with values on the lit pixels and darkness elsewhere."""
        patch = np.zeros(self._lit.shape, dtype=np.complex64)
        patch[self._lit] = lit
        return self.region.paste(patch, self.settings.sensor.shape)

    def displacement_m(self, drive_hz: Fraction, drive_v: float) -> Complex64:
        """Complex displacement (height, width) of the visible reed along z; 0 beside it."""
        patch = np.zeros(self._lit.shape, dtype=np.complex64)
        patch[self._lit] = drive_v * self._response(drive_hz)
        return patch

    def frame(
        self,
        segments: Sequence[Segment],
        rng: np.random.Generator,
        object_gain: complex = 1.0,
        scene: Scene = Scene(),
    ) -> NDArray[np.uint16]:
        """Read out one exposure.

        Parameters
        ----------
        segments : sequence of Segment
            Stretches of the exposure, in order.
        rng : numpy.random.Generator
            Source of shot and read noise.
        object_gain : complex, optional
            Amplitude of the light on the object over the nominal: laser, modulator, path.
        scene : Scene, optional
            Both beams, and no lamp.

        Returns
        -------
        (ny, nx) uint16
        """
        lit = [s for s in segments if s.state.rf_on]
        duration = np.float32(sum(s.end_s - s.start_s for s in lit))
        if scene != Scene():
            whole_s = sum(s.end_s - s.start_s for s in segments)
            return self._plain_frame(scene, float(duration), whole_s, rng)
        field = np.zeros(len(self._object), dtype=np.complex64)
        for segment in lit:
            field += self._integrated_field(segment)
        mean_e = self._lo * self._lo
        mean_e += np.float32(abs(object_gain) ** 2) * self._at_rest
        mean_e *= duration
        field *= np.complex64(object_gain)
        on_sensor = self.transform.to_sensor(self._pasted(field)).real
        on_sensor *= 2 * self._lo
        mean_e += on_sensor
        return read_out(self.settings.sensor, mean_e, rng)

    def _plain_frame(
        self, scene: Scene, duration_s: float, whole_s: float, rng: np.random.Generator
    ) -> NDArray[np.uint16]:
        """Read out one exposure without interference: beams for a time, a lamp for the whole."""
        mean_e = np.full(self.settings.sensor.shape, scene.lamp_e_s * whole_s, dtype=np.float32)
        if scene.local_oscillator:
            mean_e += np.float32(duration_s) * self._lo * self._lo
        if scene.object_beam:
            mean_e += np.float32(duration_s) * self._at_rest.astype(np.float32)
        return read_out(self.settings.sensor, mean_e, rng)

    def _integrated_field(self, segment: Segment) -> Complex64:
        """∫ E(t)·exp(−2πi·difference·t) dt over a segment, on the lit pixels (n,)."""
        state = segment.state
        total = np.zeros(len(self._object), dtype=np.complex64)
        for order, light in self._light(state.difference_hz, state.drive_hz, state.drive_v):
            offset_hz = order * state.drive_hz - state.difference_hz
            total += light * np.complex64(beat_integral(offset_hz, segment.start_s, segment.end_s))
        return total


def _unit_response(
    settings: TwinSettings,
    reed: ReducedReed | WholeReed,
    cane: ViscoelasticCane,
    shapes: Mapping[Symmetry | None, Float],
    drive_hz: Fraction,
) -> Complex64:
    """Displacement (n,) of the lit pixels per volt, in m."""

    def pressure(hz: float, x: Array, y: Array) -> NDArray[np.complex128]:
        at_tip = tweeter_pressure_pa(settings.tweeter, hz, 1.0)
        at_tip *= cavity_gain(settings.line, hz)
        shape = pressure_shape(settings.chamber, hz, x, y).astype(complex)
        if settings.distortion.rms:
            shape *= distortion_factor(settings.distortion, settings.chamber, hz, x, y)
        return at_tip * shape

    frequency_hz = np.array([float(drive_hz)])
    response = forced_response(reed, cane, settings.loss_factor, frequency_hz, pressure)
    moved = [
        shapes[symmetry] @ np.stack([q[0].real, q[0].imag], axis=1).astype(np.float32)
        for symmetry, q in response.items()
    ]
    total = sum(moved[1:], start=moved[0])
    displacement: Complex64 = total[:, 0] + 1j * total[:, 1]
    return displacement


def _light_of_sidebands(
    scattered: Complex64,
    response: Callable[[Fraction], Complex64],
    wavelength_m: float,
    difference_hz: Fraction,
    drive_hz: Fraction,
    drive_v: float,
) -> list[tuple[int, Complex64]]:
    """Sideband orders and their light on the lit pixels (n,), in √(electrons/s)."""
    if drive_v == 0 or drive_hz == 0:
        return [(0, scattered)]
    orders = kept_orders(difference_hz, drive_hz)
    parts = sidebands(orders, drive_v * response(drive_hz), wavelength_m)
    return [(order, scattered * part) for order, part in zip(orders, parts, strict=True)]
