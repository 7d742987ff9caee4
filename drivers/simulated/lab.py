"""The laboratory of all simulated instruments: its time, its settings, its light."""

import cmath
import math
import threading
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from fractions import Fraction
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from drivers.context import BenchContext, WallClock
from drivers.errors import BenchSetupError
from drivers.roles import Arrangement, Clock
from drivers.simulated.settings import (
    Faults,
    Light,
    Simulation,
    bench_constants,
    bench_disorder,
    bench_geometry,
    bench_parameters,
    read_simulation,
)
from physics.bench import (
    BenchModel,
    BenchState,
    Scene,
    Segment,
)
from physics.errors import ImpossibleReedError
from physics.mechanics import Mechanics, ReedSolver
from physics.motion import AlteredMotion, PlainMotion, ReedMotion
from physics.parameters.sensor import Sensor
from physics.reed.geometry import is_even
from physics.reed.reduced.stored import reduced_reed

# A lamp that fills half a pixel of the paper's camera in a frame of the paper's length.
_LAMP_E_S: Final = 1e5
_SCENES: Final = {
    Arrangement.HOLOGRAMS: Scene(),
    Arrangement.DARK: Scene(local_oscillator=False, object_beam=False),
    Arrangement.FLAT: Scene(local_oscillator=False, object_beam=False, lamp_e_s=_LAMP_E_S),
    Arrangement.LO_ONLY: Scene(object_beam=False),
    Arrangement.OBJECT_ONLY: Scene(local_oscillator=False),
}


class VirtualClock:
    """A time that passes only during waits."""

    def __init__(self) -> None:
        self._now_s, self._begun = 0.0, datetime.now(UTC)
        # Devices at the far end of a wire wait on threads of their own.
        self._waiting = threading.Lock()

    def now_s(self) -> float:
        """Return the seconds waited for so far."""
        return self._now_s

    def date(self) -> datetime:
        """Return when this clock was made, later by the time that has passed since on it."""
        return self._begun + timedelta(seconds=self._now_s)

    def wait(self, seconds: float) -> None:
        """Let time pass."""
        if seconds > 0:
            with self._waiting:
                self._now_s += seconds


class SimulatedLab:
    """One laboratory with one reed, shared by the simulated instruments of a bench.

    It remembers every change of a setting with its time, so that an exposure is rendered with the
    settings that really were there while it lasted, however many they were.

    Raises
    ------
    BenchSetupError
        If the simulation's section of the bench file is wrong.
    """

    def __init__(self, context: BenchContext) -> None:
        bench_file = context.description
        simulation = read_simulation(bench_file.twin, bench_file.name)
        self.faults: Faults = simulation.faults
        self.clock: Clock = WallClock() if simulation.pace == "realtime" else VirtualClock()
        context.clock = self.clock
        self._scene = Scene()
        self._parameters = bench_parameters(simulation, bench_file, context.preparation)
        disorder = bench_disorder(simulation, bench_file.name, context.preparation)
        context.simulated_disorder = disorder.record
        self._motion = _motion_of(context, simulation, self._parameters.reed)
        self._light: Light = simulation.light
        self._rng = context.rng
        self._clampings = 0
        self._walk_rad, self._walked_until_s = 0.0, 0.0
        self._model: BenchModel | None = None
        # When each frame that was delivered really began, by its number and time stamp: what a
        # camera says of its time may be wrong.
        self.exposed_s: dict[tuple[int, float], float] = {}
        self._changing = threading.Lock()
        self._times_s = [-math.inf]
        self._states = [BenchState(Fraction(0), Fraction(0), 0.0, rf_on=False)]

    @property
    def sensor(self) -> Sensor:
        """The sensor, of the part that was last prepared."""
        return self._parameters.sensor

    @property
    def model(self) -> BenchModel:
        """The model that renders frames: studies compare its vibration with what a fit states.

        Raises
        ------
        ValueError
            If no sensor was prepared.
        """
        if self._model is None:
            raise ValueError("the simulated laboratory has no sensor; call prepare_sensor first")
        return self._model

    @property
    def state(self) -> BenchState:
        """The settings at present."""
        return self._states[-1]

    @property
    def changes(self) -> list[tuple[float, BenchState]]:
        """When the settings became what, in order."""
        with self._changing:
            return list(zip(self._times_s, self._states, strict=True))

    def change(self, **settings: Any) -> None:
        """Change fields of `BenchState` now, all at the same moment."""
        if self.faults.modulators_exchanged and "difference_hz" in settings:
            settings["difference_hz"] = -settings["difference_hz"]
        # Devices at the far end of a wire change theirs on threads of their own.
        with self._changing:
            self._times_s.append(self.clock.now_s())
            self._states.append(replace(self.state, **settings))

    def segments(self, start_s: float, end_s: float) -> list[Segment]:
        """Return the stretches of constant settings between two times, in order."""
        with self._changing:
            first = bisect_right(self._times_s, start_s) - 1
            begins, states = self._times_s[first:], self._states[first:]
        ends = [*begins[1:], math.inf]
        return [
            Segment(max(begin, start_s), min(end, end_s), state)
            for begin, end, state in zip(begins, ends, states, strict=True)
            if max(begin, start_s) < min(end, end_s)
        ]

    def prepare_sensor(self, shape: tuple[int, int]) -> None:
        """Build the light on the middle part of the sensor, unless that is there already."""
        if self._model is None or shape != self._parameters.sensor.shape:
            sensor = replace(self._parameters.sensor, shape=shape)
            self._parameters = replace(self._parameters, sensor=sensor)
            self._model = BenchModel(self._parameters, self._motion, self._speckle_rng())

    def expose(
        self,
        exposures_s: Sequence[tuple[float, float]],
        dark: int | None = None,
        sagging_from: int | None = None,
    ) -> list[NDArray[np.uint16]]:
        """Read out exposures of one acquisition, each from a start to an end.

        The sensor is that which was prepared.

        Parameters
        ----------
        exposures_s : sequence of (float, float)
        dark : int, optional
            Number of an exposure that gets no light.
        sagging_from : int, optional
            Number of the exposure from which on the loudspeaker has half its volts.

        Raises
        ------
        ValueError
            If no sensor was prepared.
        """
        model = self.model
        gain = self._next_acquisition(model, exposures_s)
        images = []
        for number, nominal_s in enumerate(exposures_s):
            times_s = self._jittered(nominal_s)
            segments = self.segments(*times_s)
            if sagging_from is not None and number >= sagging_from:
                segments = [_with_half_the_volts(segment) for segment in segments]
            scene = _SCENES[Arrangement.DARK] if number == dark else self._scene
            turned = gain * self._path(number, times_s[0])
            images.append(model.frame(segments, self._rng, turned, scene))
        return images

    def _next_acquisition(
        self, model: BenchModel, exposures_s: Sequence[tuple[float, float]]
    ) -> complex:
        """Change what is different in each acquisition; return the object light's gain."""
        changes = self._parameters.optics.interference
        gain = self._object_gain()
        # What does not walk draws nothing: the noise is then that of a bench without walk.
        if changes.step_walk_rad:
            self._walk_rad += changes.step_walk_rad * self._rng.standard_normal()
        model.next_acquisition(self._rng)
        if self.sensor.lag:
            # The camera runs freely: a frame of the same length ended when the first one begins.
            start_s, end_s = exposures_s[0]
            before = self.segments(2 * start_s - end_s, start_s)
            turned = gain * cmath.rect(1.0, self._walk_rad)
            model.expose_unread(before, self._rng, turned, self._scene)
        return gain

    def _jittered(self, times_s: tuple[float, float]) -> tuple[float, float]:
        """Return when an exposure really begins and ends."""
        spread_s = self._parameters.clocks.frame_jitter_s
        if not spread_s:
            return times_s
        late_s = spread_s * float(self._rng.standard_normal())
        return times_s[0] + late_s, times_s[1] + late_s

    def _path(self, number: int, time_s: float) -> complex:
        """Turn of the object light in a frame of an acquisition."""
        light, interference = self._light, self._parameters.optics.interference
        # What does not jitter draws nothing: the noise is then that of a bench without jitter.
        turn_rad = light.path_drift_rad * number + self._walked(time_s)
        turn_rad += interference.quarter_error_rad * (number % 2)
        if interference.jitter_rad:
            turn_rad += interference.jitter_rad * self._rng.standard_normal()
        return cmath.rect(1.0, turn_rad)

    def _walked(self, time_s: float) -> float:
        """Phase in rad to which the optical path has walked at a time, later than all before."""
        speed = self._parameters.optics.interference.walk_rad_s
        if speed:
            passed_s = max(time_s - self._walked_until_s, 0.0)
            self._walk_rad += speed * math.sqrt(passed_s) * self._rng.standard_normal()
        self._walked_until_s = max(time_s, self._walked_until_s)
        return self._walk_rad

    def loses_frame(self) -> bool:
        """Whether a frame of the next acquisition is lost on its way to the computer."""
        fraction = self._parameters.clocks.lost_fraction
        return bool(fraction and self._rng.random() < fraction)

    def arrange(self, arrangement: Arrangement) -> None:
        """Open and close shutters, and light the lamp; see `Surroundings`."""
        self._scene = _SCENES[arrangement]

    def clamp_again(self) -> None:
        """Put the reed back with another speckle: light no longer falls as it did."""
        self._model = None
        self._clampings += 1

    def _speckle_rng(self) -> np.random.Generator:
        """Chance that decides the speckle of this clamping, whatever was measured before it.

        So a campaign that another process goes on with finds the speckle that it had.
        """
        source = self._rng.bit_generator.seed_seq
        if not self._clampings or not isinstance(source, np.random.SeedSequence):
            return self._rng
        own = np.random.SeedSequence(source.entropy, spawn_key=(self._clampings,))
        return np.random.default_rng(own)

    def _object_gain(self) -> complex:
        """Amplitude of the object's light over the nominal, another for each acquisition."""
        size, phase = 1.0, 0.0
        scatter = self._parameters.optics.interference.gain_scatter
        # What does not scatter draws nothing: the noise is then that of a bench without scatter.
        if scatter:
            size = math.exp(scatter * self._rng.standard_normal())
        if self._light.phase_scatter:
            phase = self._rng.uniform(0.0, 2 * math.pi)
        return cmath.rect(size, phase)


def _with_half_the_volts(segment: Segment) -> Segment:
    return replace(segment, state=replace(segment.state, drive_v=0.5 * segment.state.drive_v))


def _motion_of(context: BenchContext, simulation: Simulation, mechanics: Mechanics) -> ReedMotion:
    """Return the reed on the bench; one that is not its own mirror image is solved whole.

    Raises
    ------
    BenchSetupError
        If the simulation's changes of shape or cane leave nothing that could be a reed, or the
        bench cannot play an effect on a reed of this shape.
    """
    level, basis = simulation.finite_elements
    box = replace(basis.box, cane=bench_constants(simulation, context.preparation))
    settings = replace(basis, box=box)
    name = context.description.name
    try:
        geometry = bench_geometry(simulation, context.preparation)
        plain = PlainMotion.plays(mechanics)
        if plain or geometry is None or is_even(geometry):
            reed = reduced_reed(geometry, level, settings, context.announce)
            return PlainMotion(reed) if plain else AlteredMotion(ReedSolver(reed, context.announce))
    except ImpossibleReedError as error:
        raise BenchSetupError(
            f"bench {name!r}: twin.shape and twin.cane_factors "
            f"make no reed: {error}; correct them, or leave them out for the reed of the protocol"
        ) from None
    raise BenchSetupError(
        f"bench {name!r}: twin.shape makes a reed that is not its own mirror image, and the bench "
        "cannot change such a reed by twin.disorder, twin.effects or known; leave out either"
    )
