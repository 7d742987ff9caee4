"""The simulated bench: from the settings of the instruments to the frames of the camera."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray

from holography.arrays import Array, Float32Array
from holography.fresnel import FresnelTransform
from holography.fringes import phase_amplitude
from holography.region import Region
from physics.air import pressure_on_reed
from physics.conditions import Condition, change_of_cane, condition_at, hardened
from physics.drive import pressure_at_tip_pa
from physics.motion import Coordinates, ReedMotion
from physics.object_light import renewed, smooth_shapes, smoothly_changed
from physics.optics import (
    beat_integral,
    decorrelated,
    kept_orders,
    lamp_profile,
    local_oscillator_profile,
    log_laser_power,
    sidebands,
    speckle,
    vignette_profile,
)
from physics.parameters.optics import Interference
from physics.parameters.tree import BenchParameters
from physics.reed.elements.fem import Symmetry
from physics.reed.reduced.response import PressureForce, pressure_force
from physics.reed.surface import surface_shapes
from physics.scatterers import Scatterers
from physics.sensor import pixel_maps, read_out

Complex64 = NDArray[np.complex64]

# Seed of the maps of a sensor's pixels: the same camera in every run of a campaign.
_SENSOR_SEED = 20120608
# A reed that stiffens with amplitude: most iterations, their damping, and the relative change of
# the largest amplitude at which they end.
_MOST_TURNS, _DAMPING, _SETTLED = 60, 0.5, 1e-4


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


class BenchModel:
    """Render the frames of a simulated bench.

    The object holds what is fixed during a run: the reed, the transform, and, unless the
    parameters let it change, the light on the reed. A frame is a function of these, of the segments
    of its exposure and of the random generator; of the frame before it, too, if the sensor lags.

    Two approximations: the reed follows a change of the drive at once (its ring-down, Q/πf, takes
    a few ms), and the intensity of the object light, ``|E|²``, is that of the reed at rest (it is
    equal in all frames of a step, so demodulation cancels it).

    Parameters
    ----------
    parameters : BenchParameters
    motion : ReedMotion
        The reed, as it can be moved; its cane is that of the parameters.
    rng : numpy.random.Generator
        Source of the speckle.
    """

    def __init__(
        self, parameters: BenchParameters, motion: ReedMotion, rng: np.random.Generator
    ) -> None:
        self.parameters = parameters
        sensor, layout = parameters.sensor, parameters.optics.layout
        self.transform = FresnelTransform(
            sensor.shape,
            sensor.pixel_m,
            layout.wavelength_m,
            layout.distance_m - layout.defocus_m,
        )
        light, changes = parameters.optics.illumination, parameters.optics.interference
        points = Scatterers.of(layout, self.transform, motion.reed.geometry.outline, light.lattices)
        self._points = points
        self._motion, self._force = motion, _force_of(parameters, motion)
        shapes = surface_shapes(motion.reed, points.x_m, points.y_m, loose=motion.loose)
        scattered, self._envelope = self._scattered_light(rng)
        # Their cost is spared where nothing changes smoothly.
        self._smooth = smooth_shapes(points.x_m, points.y_m) if changes.field_change else None
        oscillator = local_oscillator_profile(light, sensor)
        self._lo_e_s, self._twice_lo = oscillator * oscillator, 2 * oscillator
        self._vignette = vignette_profile(light, sensor)
        self._lamp = lamp_profile(light, sensor)
        self._maps = pixel_maps(sensor, np.random.default_rng(_SENSOR_SEED))
        self._left_behind: Float32Array | None = None
        # Cached, because the four frames of a step differ in their beat integrals only. Functions
        # instead of methods, because a cache that refers to this object would keep its memory until
        # the next garbage collection.
        self._displacement = lru_cache(maxsize=4)(
            partial(_displacement, parameters, motion, self._force, shapes)
        )
        self._illuminate(scattered)

    def _illuminate(self, scattered: Complex64) -> None:
        """Take the light amplitude of each point of the reed (n,), in √(electrons/s)."""
        self._object = scattered
        self._at_rest = np.abs(self._points.to_sensor(scattered)) ** 2
        self._light = lru_cache(maxsize=2)(
            partial(_light_of_sidebands, scattered, self._displacement, self.parameters)
        )

    def next_acquisition(self, rng: np.random.Generator) -> None:
        """Change the light on the reed as it changes from one acquisition to the next.

        Parameters
        ----------
        rng : numpy.random.Generator
            Nothing is drawn from it if the parameters let nothing change.
        """
        changes, light = self.parameters.optics.interference, self._object
        if changes.speckle_renewal:
            light = renewed(light, self._envelope, changes.speckle_renewal, rng)
        if self._smooth is not None:
            light = smoothly_changed(light, self._smooth, changes.field_change, rng)
        if light is not self._object:
            self._illuminate(light)

    def _scattered_light(self, rng: np.random.Generator) -> tuple[Complex64, Float32Array]:
        """Return the light amplitude of each point of the reed (n,), in √(electrons/s).

        The second is its root mean square over all speckle.
        """
        optics, points = self.parameters.optics, self._points
        light = optics.illumination
        rough = points.drawn([speckle(each.lit.shape, rng) for each in points.lattices])
        middle = 0.5 * optics.layout.reed_size_m[1]
        r2 = (points.x_m - middle) ** 2 + points.y_m**2
        profile = np.exp(-r2 / light.object_waist_m**2)
        amplitude = rough * profile
        power = light.object_e_s * self._pixels / np.sum(np.abs(amplitude) ** 2)
        scattered: Complex64 = (amplitude * np.sqrt(power)).astype(np.complex64)
        return scattered, (profile * np.sqrt(power)).astype(np.float32)

    @property
    def _pixels(self) -> int:
        return int(np.prod(self.parameters.sensor.shape))

    @property
    def region(self) -> Region:
        """Return the region of the object image that holds the reed."""
        return self._points.region

    def displacement_m(self, drive_hz: Fraction, drive_v: float, time_s: float = 0.0) -> Complex64:
        """Return the complex displacement (height, width) of the reed along z, in m; 0 outside.

        Raises
        ------
        ValueError
            If points lie between pixels (see `Illumination.lattices`).
        """
        if self.parameters.optics.illumination.lattices != 1:
            raise ValueError(
                "BenchModel: points scatter between pixels, and pixels have no displacement of "
                "their own; ask for displacement_at_m"
            )
        (lattice,) = self._points.lattices
        patch = np.zeros(lattice.lit.shape, dtype=np.complex64)
        patch[lattice.lit] = self._displacement(drive_hz, drive_v, self._moment_s(time_s))
        return patch

    def displacement_at_m(
        self, x_m: Array, y_m: Array, drives: Sequence[tuple[Fraction, float]]
    ) -> Complex64:
        """Return what frames are rendered from, at any points of the bark side.

        Parameters
        ----------
        x_m, y_m : (n,) float
            Points on the reed: distances from the tip and from the axis.
        drives : sequence of (Fraction, float)
            Frequency in Hz and peak volts of k drives.

        Returns
        -------
        (k, n) complex64
            Complex displacement along z in m.
        """
        shapes = surface_shapes(self._motion.reed, x_m, y_m, loose=self._motion.loose)
        moved = [
            _displacement(self.parameters, self._motion, self._force, shapes, hz, volts, 0.0)
            for hz, volts in drives
        ]
        return np.array(moved)

    def coordinates_m(self, drive_hz: float, drive_v: float) -> Coordinates:
        """Return the reed's motion in its reduced coordinates at the start, without hardening.

        Parameters
        ----------
        drive_hz, drive_v : float
            Drive frequency, and peak volts at the tweeter.
        """
        parameters = self.parameters
        environment, cane = parameters.environment, parameters.reed.cane
        change = change_of_cane(cane, environment, condition_at(environment, 0.0), drive_hz)
        moved = self._motion.coordinates(parameters.reed, change, drive_hz, 0.0, self._force)
        at_tip_pa = pressure_at_tip_pa(parameters.drive, drive_hz, drive_v)
        return {part: at_tip_pa * q for part, q in moved.items()}

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
            Amplitude of the light on the object relative to its nominal value: changes of
            modulator and optical path.
        scene : Scene, optional
            Light that reaches the sensor. Default: both beams, and no lamp.

        Returns
        -------
        (ny, nx) uint16
            Frame in dn.
        """
        mean_e = self._expected_e(segments, rng, object_gain, scene)
        lag = np.float32(self.parameters.sensor.lag)
        if lag:
            before, self._left_behind = self._left_behind, mean_e
            mean_e = (1 - lag) * mean_e
            if before is not None:
                mean_e += lag * before
        return read_out(self.parameters.sensor, mean_e, rng, self._maps)

    def expose_unread(
        self,
        segments: Sequence[Segment],
        rng: np.random.Generator,
        object_gain: complex = 1.0,
        scene: Scene = Scene(),
    ) -> None:
        """Expose a frame that is not read, so that the next one has its lag.

        Parameters
        ----------
        segments, rng, object_gain, scene
            See `frame`.
        """
        if self.parameters.sensor.lag:
            self._left_behind = self._expected_e(segments, rng, object_gain, scene)

    def _expected_e(
        self,
        segments: Sequence[Segment],
        rng: np.random.Generator,
        object_gain: complex,
        scene: Scene,
    ) -> Float32Array:
        """Return the expected electrons (ny, nx) of an exposure."""
        lit = [s for s in segments if s.state.rf_on]
        duration = float(sum(s.end_s - s.start_s for s in lit))
        power = self._power(segments, rng)
        leak = self.parameters.optics.illumination.reference_leak
        if scene == Scene():
            mean_e = self._interfering_light(lit, power, duration, object_gain)
        elif leak and scene == Scene(object_beam=False):
            mean_e = self._interfering_light(lit, power, duration, object_gain * leak**0.5)
        else:
            exposure_s = sum(s.end_s - s.start_s for s in segments)
            mean_e = self._plain_light(scene, power * duration, exposure_s)
        if self._vignette is not None:
            mean_e *= self._vignette
        return mean_e

    def _power(self, segments: Sequence[Segment], rng: np.random.Generator) -> float:
        """Return the power of the laser relative to that at the start of the campaign."""
        changes = self.parameters.optics.interference
        start_s = np.array(segments[0].start_s if segments else 0.0)
        power = float(np.exp(log_laser_power(changes, start_s)))
        if changes.power_noise:
            power *= max(1 + changes.power_noise * rng.standard_normal(), 0.0)
        return power

    def _interfering_light(
        self, lit: Sequence[Segment], power: float, duration_s: float, object_gain: complex
    ) -> Float32Array:
        """Return the expected electrons (ny, nx) of an exposure to both beams."""
        field = np.zeros(len(self._object), dtype=np.complex64)
        for segment in lit:
            field += self._integrated_field(segment)
        mean_e = np.float32(abs(object_gain) ** 2) * self._at_rest
        mean_e += self._lo_e_s
        mean_e *= np.float32(power * duration_s)
        field *= np.complex64(power * object_gain)
        mean_e += self._points.to_sensor(field).real * self._twice_lo
        return mean_e

    def _plain_light(self, scene: Scene, duration_s: float, exposure_s: float) -> Float32Array:
        """Return the expected electrons (ny, nx) of an exposure without interference.

        The beams are on for `duration_s` at full power, a lamp for the whole exposure.
        """
        mean_e = np.full(
            self.parameters.sensor.shape, scene.lamp_e_s * exposure_s, dtype=np.float32
        )
        if self._lamp is not None:
            mean_e *= self._lamp
        if scene.local_oscillator:
            mean_e += np.float32(duration_s) * self._lo_e_s
        if scene.object_beam:
            mean_e += np.float32(duration_s) * self._at_rest
        return mean_e

    def _integrated_field(self, segment: Segment) -> Complex64:
        """Return ∫ E(t)·exp(−2πi·difference·t) dt over a segment, at the reed's points (n,)."""
        state, clocks = segment.state, self.parameters.clocks
        total = np.zeros(len(self._object), dtype=np.complex64)
        moment_s = self._moment_s(segment.start_s)
        middle_h = 0.5 * (segment.start_s + segment.end_s) / 3600
        detuning_hz = clocks.detuning_hz + clocks.detuning_hz_h * middle_h
        ahead_hz = 1e-6 * clocks.generator_ppm * float(state.drive_hz)
        lights = self._light(state.difference_hz, state.drive_hz, state.drive_v, moment_s)
        for order, light in lights:
            # Exact as far as it can be: differences of settings are small, settings are not.
            offset_hz = float(order * state.drive_hz - state.difference_hz)
            offset_hz += order * ahead_hz - detuning_hz
            total += light * np.complex64(beat_integral(offset_hz, segment.start_s, segment.end_s))
        if segment.start_s > 3600 * self.parameters.optics.interference.hop_after_h:
            total *= np.float32(1 - self.parameters.optics.interference.hop)
        # A phase is the integral of the frequency: half of what a drift has at the middle, times
        # the time until then.
        drifted = 0.5 * clocks.detuning_hz_h * middle_h * 3600 * middle_h
        return total * np.complex64(np.exp(2j * np.pi * drifted)) if drifted else total

    def _moment_s(self, time_s: float) -> float:
        """Return the time at which the reed's condition is taken; 0 if it never changes."""
        environment = self.parameters.environment
        return time_s if environment.drying or environment.warming_c_h else 0.0


def _displacement(
    parameters: BenchParameters,
    motion: ReedMotion,
    force: PressureForce,
    shapes: Mapping[Symmetry | None, Float32Array],
    drive_hz: Fraction,
    drive_v: float,
    time_s: float,
) -> Complex64:
    """Return the complex displacement of the reed's points (n,), in m."""
    environment, wavelength_m = parameters.environment, parameters.optics.layout.wavelength_m
    condition, hz = condition_at(environment, time_s), float(drive_hz)
    moved_m = _moved(parameters, motion, force, shapes, hz, drive_v, condition, 0.0)
    if not environment.hardening:
        return moved_m
    largest_rad = 0.0
    for _ in range(_MOST_TURNS):
        found_rad = float(phase_amplitude(np.abs(moved_m), wavelength_m).max(initial=0.0))
        if abs(found_rad - largest_rad) <= _SETTLED * found_rad:
            break
        largest_rad += _DAMPING * (found_rad - largest_rad)
        stiffer = float(hardened(environment, largest_rad))
        moved_m = _moved(parameters, motion, force, shapes, hz, drive_v, condition, stiffer)
    return moved_m


def _moved(
    parameters: BenchParameters,
    motion: ReedMotion,
    force: PressureForce,
    shapes: Mapping[Symmetry | None, Float32Array],
    hz: float,
    drive_v: float,
    condition: Condition,
    stiffer: float,
) -> Complex64:
    """Return the displacement (n,) in m of a reed whose stiffness is larger by a log factor."""
    environment = parameters.environment
    # A generator that runs ahead drives the reed at another frequency than it says.
    hz *= 1 + 1e-6 * parameters.clocks.generator_ppm

    change = change_of_cane(parameters.reed.cane, environment, condition, hz)
    coordinates = motion.coordinates(parameters.reed, change, hz, stiffer, force)
    moved = [
        shapes[part] @ np.stack([q.real, q.imag], axis=1).astype(np.float32)
        for part, q in coordinates.items()
    ]
    total = sum(moved[1:], start=moved[0])
    at_tip = np.complex64(pressure_at_tip_pa(parameters.drive, hz, drive_v))
    displacement: Complex64 = at_tip * (total[:, 0] + 1j * total[:, 1])
    return displacement


def _force_of(parameters: BenchParameters, motion: ReedMotion) -> PressureForce:
    """Return the forces of the pressure on the reed, relative to the pressure at its tip."""
    return pressure_force(motion.reed, partial(pressure_on_reed, parameters.chamber))


def _light_of_sidebands(
    scattered: Complex64,
    displacement: Callable[[Fraction, float, float], Complex64],
    parameters: BenchParameters,
    difference_hz: Fraction,
    drive_hz: Fraction,
    drive_v: float,
    time_s: float,
) -> list[tuple[int, Complex64]]:
    """Return the sideband orders and their light at the reed's points (n,), √(electrons/s)."""
    if drive_v == 0 or drive_hz == 0:
        return [(0, scattered)]
    layout, interference = parameters.optics.layout, parameters.optics.interference
    orders = kept_orders(difference_hz, drive_hz)
    moved_m = displacement(drive_hz, drive_v, time_s)
    parts = dict(zip(orders, sidebands(orders, moved_m, layout.wavelength_m), strict=True))
    phi = phase_amplitude(np.abs(moved_m), layout.wavelength_m)
    kept = decorrelated(interference, phi)
    selected = round(difference_hz / drive_hz)
    mixed = _mixed(interference, parts, selected)
    return [(order, scattered * part * kept) for order, part in mixed.items()]


def _mixed(
    interference: Interference, parts: Mapping[int, Complex64], selected: int
) -> dict[int, Complex64]:
    """Return sidebands with the light that leaks into the image of the selected one."""
    mixed = dict(parts)
    for amplitude, source in ((interference.leak, 0), (interference.crosstalk, selected + 1)):
        if amplitude and source != selected:
            mixed[selected] = mixed[selected] + np.float32(amplitude) * parts[source]
    return mixed
