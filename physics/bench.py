"""The simulated bench: from the settings of the instruments to the frames of the camera."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray

from holography.arrays import Array, ComplexArray, Float32Array
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
from physics.reed.cane.viscoelastic import (
    Components,
    Series,
    ViscoelasticCane,
    Zener,
    require_physical,
    viscoelastic_cane,
)
from physics.reed.elements.fem import Symmetry
from physics.reed.elements.whole import WholeReed
from physics.reed.reduction.basis import ReducedReed
from physics.reed.reduction.response import forced_response
from physics.reed.surface import on_reed, surface_shapes
from physics.sensor import Sensor, read_out

Complex64 = NDArray[np.complex64]

# Degrees of the polynomials of a pressure distortion: along the window, across it, and in ln f.
# Chosen: smooth over the window and over the band.
_DISTORTION_DEGREES = (2, 2, 3)
# Frequency band of a pressure distortion: about that of the paper's sweeps.
_BAND_HZ = (1e3, 20e3)


@dataclass(frozen=True)
class PressureDistortion:
    """A smooth random error of the pressure on the reed: the factor 1 + a complex random field.

    Attributes
    ----------
    rms : float
        Root mean square of the complex field, over the chamber's window and over 1 to 20 kHz with
        equal weight per octave; 0 for no error.
    seed : int
        Seed of the random field.
    """

    rms: float = 0.0
    seed: int = 0


@dataclass(frozen=True)
class TwinSettings:
    """All parameters of one simulated bench with one reed.

    Attributes
    ----------
    components : Components
        Components e1 … e4 of the reed's cane.
    series : Series
        Moisture of the reed: A as bought, B dried.
    E_L_factor, G_LT_factor : float
        Factors on the moduli E_L and G_LT that follow from the components.
    loss_factor : float
        Loss factor of the cane, the same for all modes (decision 0004).
    chamber : Chamber
    distortion : PressureDistortion
    line : CavityLine
    tweeter : Tweeter
    illumination : Illumination
    layout : Layout
    sensor : Sensor
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
    """Settings of the instruments, as they act on light and air.

    Attributes
    ----------
    difference_hz : Fraction
        Frequency difference f_AOM1 − f_AOM2.
    drive_hz : Fraction
        Drive frequency.
    drive_v : float
        Peak volts at the tweeter; 0 if it is off.
    rf_on : bool
        Whether the modulators get RF; without it no light reaches the sensor.
    """

    difference_hz: Fraction
    drive_hz: Fraction
    drive_v: float
    rf_on: bool = True


@dataclass(frozen=True)
class Scene:
    """Light that reaches the sensor.

    Attributes
    ----------
    local_oscillator, object_beam : bool
        Whether the beam is open.
    lamp_e_s : float
        Uniform light of a lamp, in electrons per pixel and second.
    """

    local_oscillator: bool = True
    object_beam: bool = True
    lamp_e_s: float = 0.0


@dataclass(frozen=True)
class Segment:
    """Part of one exposure during which the state was constant; times on the bench's clock."""

    start_s: float
    end_s: float
    state: BenchState


def bench_cane(settings: TwinSettings) -> ViscoelasticCane:
    """Return the Zener moduli of the cane on a bench.

    Raises
    ------
    ValueError
        If the moduli are physically impossible (see `require_physical`).
    """
    cane = viscoelastic_cane(settings.components, settings.series)
    require_physical(cane)
    return ViscoelasticCane(
        _scaled(cane.young_L, settings.E_L_factor), _scaled(cane.shear_LT, settings.G_LT_factor)
    )


def _scaled(zener: Zener, factor: float) -> Zener:
    # The same factor for all three multiplies the storage modulus at every frequency by it.
    return Zener(
        factor * zener.spring_mpa, factor * zener.arm_spring_mpa, factor * zener.arm_dashpot_mpa_s
    )


def distortion_factor(
    distortion: PressureDistortion, chamber: Chamber, frequency_hz: float, x_m: Array, y_m: Array
) -> ComplexArray:
    """Return the factor by which a distortion changes the pressure, at points of the flat side.

    It is 1 plus a sum of products of Legendre polynomials in x, y and ln f with random complex
    weights. Products that are constant over the window are left out, because they would be a gain.
    Outside the window and the band, the values at their edges are used.

    Parameters
    ----------
    distortion : PressureDistortion
    chamber : Chamber
    frequency_hz : float
    x_m, y_m : float arrays of one shape
        Points in coordinates of the reed, in m.

    Returns
    -------
    complex array of the same shape
    """
    rng = np.random.default_rng(distortion.seed)
    shape = [degree + 1 for degree in _DISTORTION_DEGREES]
    real, imaginary = rng.standard_normal((2, *shape))
    weights = real + 1j * imaginary
    weights[0, 0] = 0.0
    weights *= distortion.rms / np.linalg.norm(weights)
    low, high = np.log(_BAND_HZ)
    along, across, in_frequency = (
        _legendre(coordinate, degree)
        for coordinate, degree in zip(
            (
                2 * x_m / chamber.length_m - 1,
                y_m / chamber.half_width_m,
                np.array([2 * (np.log(frequency_hz) - low) / (high - low) - 1]),
            ),
            _DISTORTION_DEGREES,
            strict=True,
        )
    )
    factor: ComplexArray = 1 + np.einsum(
        "lm,...l,...m->...", weights @ in_frequency[0], along, across
    )
    return factor


def _legendre(coordinate: Array, degree: int) -> Array:
    """Return Legendre polynomials (…, degree + 1) of mean square 1 over −1 … 1, constant beyond."""
    table = np.polynomial.legendre.legvander(np.clip(coordinate, -1, 1), degree)
    normalised: Array = table * np.sqrt(2 * np.arange(degree + 1) + 1)
    return normalised


class BenchModel:
    """Render the frames of a simulated bench.

    The object holds what is fixed during a run: the reed, its speckle and the transform. A frame
    is a pure function of the segments of its exposure and of the random generator.

    Two approximations: the reed follows a change of the drive at once (its ring-down, Q/πf, takes
    a few ms), and the intensity of the object light, ``|E|²``, is that of the reed at rest (it is
    equal in all frames of a step, so demodulation cancels it).

    Parameters
    ----------
    settings : TwinSettings
    reed : ReducedReed or WholeReed
    rng : numpy.random.Generator
        Source of the speckle.
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
        # Cached, because the four frames of a step differ in their beat integrals only. Functions
        # instead of methods, because a cache that refers to this object would keep its memory until
        # the next garbage collection.
        self._response = lru_cache(maxsize=4)(
            partial(_unit_response, settings, reed, self._cane, self._shapes)
        )
        self._light = lru_cache(maxsize=2)(
            partial(_light_of_sidebands, self._object, self._response, layout.wavelength_m)
        )

    def _scattered_light(self, x: Array, y: Array, rng: np.random.Generator) -> Complex64:
        """Return the light amplitude of each pixel on the reed (n,), in √(electrons/s)."""
        light, height_width = self.settings.illumination, x.shape
        rough = speckle(height_width, rng)[self._lit]
        middle = 0.5 * self.settings.layout.reed_size_m[1]
        r2 = (x[self._lit] - middle) ** 2 + y[self._lit] ** 2
        amplitude = rough * np.exp(-r2 / light.object_waist_m**2)
        power = light.object_e_s * self._pixels / np.sum(np.abs(amplitude) ** 2)
        scattered: Complex64 = (amplitude * np.sqrt(power)).astype(np.complex64)
        return scattered

    def _local_oscillator(self) -> Float32Array:
        """Return the amplitude of the local oscillator on the sensor (ny, nx), √(electrons/s)."""
        light, sensor = self.settings.illumination, self.settings.sensor
        r2 = np.add.outer(*[(sensor.pixel_m * (np.arange(n) - n // 2)) ** 2 for n in sensor.shape])
        profile = np.exp(-r2 / light.local_oscillator_waist_m**2)
        amplitude: Float32Array = (np.sqrt(light.local_oscillator_e_s) * profile).astype(np.float32)
        return amplitude

    @property
    def _pixels(self) -> int:
        return int(np.prod(self.settings.sensor.shape))

    def _pasted(self, lit: Complex64) -> Complex64:
        """Return the object plane (ny, nx) with values on the reed's pixels and 0 elsewhere."""
        patch = np.zeros(self._lit.shape, dtype=np.complex64)
        patch[self._lit] = lit
        return self.region.paste(patch, self.settings.sensor.shape)

    def displacement_m(self, drive_hz: Fraction, drive_v: float) -> Complex64:
        """Return the complex displacement (height, width) of the reed along z, in m; 0 outside."""
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
            Parts of the exposure, in order.
        rng : numpy.random.Generator
            Source of shot noise and read noise.
        object_gain : complex, optional
            Amplitude of the light on the object relative to its nominal value: changes of laser,
            modulator and optical path.
        scene : Scene, optional
            Light that reaches the sensor. Default: both beams, and no lamp.

        Returns
        -------
        (ny, nx) uint16
            Frame in dn.
        """
        lit = [s for s in segments if s.state.rf_on]
        duration = np.float32(sum(s.end_s - s.start_s for s in lit))
        if scene != Scene():
            exposure_s = sum(s.end_s - s.start_s for s in segments)
            return self._plain_frame(scene, float(duration), exposure_s, rng)
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
        self, scene: Scene, duration_s: float, exposure_s: float, rng: np.random.Generator
    ) -> NDArray[np.uint16]:
        """Read out one exposure without interference.

        The beams are on for `duration_s`, a lamp for the whole exposure.
        """
        mean_e = np.full(self.settings.sensor.shape, scene.lamp_e_s * exposure_s, dtype=np.float32)
        if scene.local_oscillator:
            mean_e += np.float32(duration_s) * self._lo * self._lo
        if scene.object_beam:
            mean_e += np.float32(duration_s) * self._at_rest.astype(np.float32)
        return read_out(self.settings.sensor, mean_e, rng)

    def _integrated_field(self, segment: Segment) -> Complex64:
        """Return ∫ E(t)·exp(−2πi·difference·t) dt over a segment, on the reed's pixels (n,)."""
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
    shapes: Mapping[Symmetry | None, Float32Array],
    drive_hz: Fraction,
) -> Complex64:
    """Return the complex displacement of the reed's pixels (n,) per volt, in m/V."""

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
    """Return the sideband orders and their light on the reed's pixels (n,), √(electrons/s)."""
    if drive_v == 0 or drive_hz == 0:
        return [(0, scattered)]
    orders = kept_orders(difference_hz, drive_hz)
    parts = sidebands(orders, drive_v * response(drive_hz), wavelength_m)
    return [(order, scattered * part) for order, part in zip(orders, parts, strict=True)]
