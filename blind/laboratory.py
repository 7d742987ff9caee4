"""A day in a case's laboratory: what is recorded, in which order, and what it looks like."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from blind.optics import (
    WAVELENGTH_M,
    Camera,
    Stage,
    make_stage,
)
from blind.reed import ModalReed, make_reed
from blind.vibration import Answerer, answerer
from blind.world import World

Array = NDArray[np.floating[Any]]
Complex = NDArray[np.complexfloating[Any, Any]]
Frames = NDArray[np.uint16]

Kind = Literal["sweep", "dark", "flat", "lo_only", "object_only", "order0"]

# The paper's sweep.
REFERENCE_HZ, STEPS, RAMP_END = 1396.9, 184, 73
FRAME_S = 1 / 12.4
# From the end of one acquisition to the begin of the next.
_PAUSE_S, _SETTLE_S = 0.25, 0.04
# To clamp the reed again, and to change what lies before the camera.
_CLAMP_S, _HANDS_S = 240.0, 30.0
_FLAT_E = 6000.0
_QUIET = 0.25
_UNIT_LEVEL = 10.0


@dataclass(frozen=True)
class Shot:
    """One acquisition of four frames.

    Attributes
    ----------
    index : int
        k of the sweep; number of the shot in others.
    hz, volts : float
        0 if the loudspeaker is off.
    order : int
    exposure_s : float
    began_s : float
        Since the campaign began.
    frames : (4, n, n) uint16, optional
        Of what is kept as frames.
    image : (h, w) complex64, optional
        Of what is kept as a hologram.
    noise : float
        Outside the image.
    signal : float
        Mean square of the image.
    lock_hz, lock_se_hz : float
        By which the lock seemed to be missed, from the light itself, and its standard error.
    repeated : bool
        Whether a frame is the one before.
    """

    index: int
    hz: float
    volts: float
    order: int
    exposure_s: float
    began_s: float
    frames: Frames | None
    image: NDArray[np.complex64] | None
    noise: float
    signal: float
    lock_hz: float
    lock_se_hz: float
    repeated: bool


@dataclass(frozen=True)
class Recording:
    """One run file's worth.

    Attributes
    ----------
    name : str
    kind : Kind
    clamping : int
        How often the reed had been clamped again before.
    shots : tuple of Shot
        In the order of their index.
    """

    name: str
    kind: Kind
    clamping: int
    shots: tuple[Shot, ...]


def step_hz(k: int) -> float:
    """Frequency of step k, to a tenth of a hertz."""
    return round(REFERENCE_HZ * 2 ** (25 * k / 1200), 1)


def step_volts(k: int) -> float:
    """Peak volts of step k."""
    return float(0.5 * 32 ** (min(k - 1, RAMP_END - 1) / (RAMP_END - 1)))


class Laboratory:
    """A world in which time passes.

    Parameters
    ----------
    world : World
    """

    def __init__(self, world: World) -> None:
        self.world = world
        self.reed: ModalReed = make_reed(world.build)
        self.stage: Stage = make_stage(world, self.reed)
        self.camera = Camera(world, self.stage)
        self._answerer: Answerer = answerer(world, self.reed)
        self._rng = np.random.default_rng([world.seed, 13])
        self._now_s, self._clamping = 0.0, 0
        self._gain = self._phase = 0.0
        self._length_s = 1.0
        self._resting: Array | None = None

    def campaign(self, names: Sequence[str] = ()) -> Iterator[Recording]:
        """Yield all recordings of a campaign, one after the other.

        Parameters
        ----------
        names : sequence of str
            Only these; all if empty.
        """
        up = list(range(1, STEPS + 1))
        mixed = [int(k) for k in np.random.default_rng([self.world.seed, 14]).permutation(up)]
        # For what happens at a share of the campaign.
        self._length_s = 5 * STEPS * (4 * FRAME_S + _PAUSE_S) + _CLAMP_S + 4 * _HANDS_S
        for name, kind, steps, level in (
            ("dark", "dark", [], 0.0),
            ("flat", "flat", [], 0.0),
            ("lo", "lo_only", [], 0.0),
            ("object", "object_only", [], 0.0),
            ("rest1", "order0", [], 0.0),
            ("up", "sweep", up, 1.0),
            ("down", "sweep", up[::-1], 1.0),
            ("rest2", "order0", [], 0.0),
            ("quiet", "sweep", up, _QUIET),
            ("shuffled", "sweep", mixed, 1.0),
            ("again", "sweep", up, 1.0),
            ("rest3", "order0", [], 0.0),
        ):
            if name == "again":
                self._now_s += _CLAMP_S
                self._clamping += 1
                self._reclamp()
            if kind in ("flat", "lo_only"):
                self._now_s += _HANDS_S
            recording = self._recording(name, kind, steps, level)
            if not names or name in names:
                yield recording

    def _reclamp(self) -> None:
        """Put the reed back, not quite where it was: its speckle is another one."""
        rng = np.random.default_rng([self.world.seed, 15])
        # Up to a few cents in modes that bend at the clamp.
        shift = 1 + 2e-3 * rng.standard_normal() / (1 + np.arange(len(self.reed.square)) / 4)
        moved = replace(self.reed, square=self.reed.square * shift)
        self._answerer = answerer(self.world, moved)
        self.stage = make_stage(replace(self.world, seed=self.world.seed + 1), moved)
        self.camera = Camera(self.world, self.stage)
        self._resting = None

    def _recording(self, name: str, kind: Any, steps: Sequence[int], level: float) -> Recording:
        if kind == "sweep":
            shots = [self._swept(k, level) for k in steps]
            return Recording(
                name, kind, self._clamping, tuple(sorted(shots, key=lambda s: s.index))
            )
        ladder = (0.25, 0.5, 0.75, 1.0) if kind in ("flat", "lo_only") else (1.0,) * 4
        shots = [self._still(number, kind, share * FRAME_S) for number, share in enumerate(ladder)]
        return Recording(name, kind, self._clamping, tuple(shots))

    def _swept(self, k: int, level: float) -> Shot:
        hz, volts = step_hz(k), level * step_volts(k)
        began_s = self._begin()
        modal = self._settled(hz, volts, began_s)
        base_m = self._answerer.base_m(hz, volts)
        frames = self._frames(hz, modal, 1, FRAME_S, began_s, base_m)
        return self._recorded(k, hz, volts, 1, began_s, frames, keep=False)

    def _settled(self, hz: float, volts: float, began_s: float) -> Complex:
        """Vibration of a reed whose stiffness may depend on how it vibrates."""
        cane, level = self.world.cane, 0.0
        modal = self._answerer.deflection(hz, volts, began_s, level, self._clamping)
        for _ in range(4 if cane.hardening or cane.lossier else 0):
            deepest = float(np.abs(self.stage.shapes @ modal).max()) * 4 * np.pi / WAVELENGTH_M
            level = 0.5 * (level + deepest / _UNIT_LEVEL) if level else deepest / _UNIT_LEVEL
            modal = self._answerer.deflection(hz, volts, began_s, level, self._clamping)
        return modal

    def _still(self, number: int, kind: Any, exposure_s: float) -> Shot:
        began_s = self._begin()
        if kind == "order0":
            frames = self._frames(0.0, None, 0, exposure_s, began_s)
        else:
            frames = self._plain(kind, exposure_s)
        return self._recorded(
            number + 1, 0.0, 0.0, 0, began_s, frames, keep=True, exposure_s=exposure_s
        )

    def _plain(self, kind: Any, exposure_s: float) -> Frames:
        """Frames without interference."""
        camera, chip = self.camera, self.world.chip
        nothing = np.zeros((chip.rows, chip.rows))
        light = {
            "dark": nothing,
            "lo_only": nothing,
            "flat": np.full_like(nothing, _FLAT_E / FRAME_S),
            "object_only": self._at_rest() * np.exp(2 * self._gain),
        }[kind]
        lo = float(kind == "lo_only")
        shots = [camera.expose(None, light, lo, exposure_s, self._rng) for _ in range(4)]
        return np.stack(shots)

    def _at_rest(self) -> Array:
        """Light of the object alone on the sensor."""
        if self._resting is None:
            image = self.camera.sidebands(None)[0]
            self._resting = np.asarray(np.abs(self.camera.on_sensor(image)) ** 2)
        return self._resting

    def _begin(self) -> float:
        """Let time pass to the begin of the next acquisition; light goes its own way."""
        light = self.world.light
        self._now_s += _PAUSE_S + _SETTLE_S
        began_s, memory = self._now_s, light.gain_memory
        own = light.gain_scatter * np.sqrt(1 - memory**2) * self._rng.standard_normal()
        self._gain = memory * self._gain + float(own)
        self._phase += light.walk_rad_s * np.sqrt(_PAUSE_S) * float(self._rng.standard_normal())
        self._now_s += 4 * FRAME_S
        return began_s

    def _frames(
        self,
        hz: float,
        modal: Complex | None,
        order: int,
        exposure_s: float,
        began_s: float,
        base_m: complex = 0.0,
    ) -> Frames:
        """Four frames of the beating light."""
        light, clock = self.world.light, self.world.clockwork
        images = self.camera.sidebands(modal, light.shift_m_h * began_s / 3600, base_m)
        images = {n: image for n, image in images.items() if n == 0 or modal is not None}
        played_hz = hz * (1 + 1e-6 * clock.scale_ppm)
        hours = began_s / 3600
        difference_hz = (
            order * hz + 1 / (4 * FRAME_S) + clock.detuning_hz + clock.drift_hz_h * hours
        )
        # A laser that fades takes both beams along; one that hops, what they have in common.
        laser = np.exp(-0.5 * light.fade_per_h * hours)
        gain = laser * np.exp(self._gain)
        at_rest = self._at_rest() * gain**2
        fringes = 1 - light.hop if began_s > light.hop_at * self._length_s else 1.0
        frames: list[Frames] = []
        for number in range(4):
            start_s = began_s + number * FRAME_S
            self._phase += light.walk_rad_s * np.sqrt(FRAME_S) * float(self._rng.standard_normal())
            turn = self._phase + light.jitter_rad * float(self._rng.standard_normal())
            turn += light.quarter_error_rad * (number % 2)
            # A synthesizer that drifts has turned by half of what it would at its rate of now.
            turn += np.pi * clock.drift_hz_h * hours * began_s
            beats = {
                n: _integral(n * played_hz - difference_hz, start_s, exposure_s) for n in images
            }
            image = sum(beats[n] * picture for n, picture in images.items())
            if order in images:
                image = image + light.leak * beats[order] * images[0] * (order != 0)
                image = image + light.mixing * beats[order] * images.get(order + 1, 0.0)
            bright = 1 + light.flicker * (number % 2)
            on_sensor = self.camera.on_sensor(fringes * gain * np.exp(1j * turn) * image)
            # Half of the brightness is either beam's.
            both = np.sqrt(bright)
            frames.append(
                self.camera.expose(
                    both * on_sensor, bright * at_rest, both * laser, exposure_s, self._rng
                )
            )
        if clock.repeats and self._rng.random() < clock.repeats:
            again = int(self._rng.integers(1, 4))
            frames[again] = frames[again - 1]
        return np.stack(frames)

    def _recorded(
        self,
        index: int,
        hz: float,
        volts: float,
        order: int,
        began_s: float,
        frames: Frames,
        *,
        keep: bool,
        exposure_s: float = FRAME_S,
    ) -> Shot:
        camera = self.camera
        image, noise = camera.reconstructed(frames)
        each = np.stack(
            [camera.focused(frame.astype(np.float64))[self.stage.rows, self.stage.columns]
             for frame in frames]
        )  # fmt: skip
        turn, bright = _steadiest_turn(each)
        # Noise of one frame is a quarter of a hologram's; a fit of four has 3 for its stiffness.
        spread = np.sqrt(0.25 * noise / (2 * max(bright, 1e-9) * 3))
        lock_hz = turn / (2 * np.pi * FRAME_S)
        return Shot(
            index=index,
            hz=hz,
            volts=volts,
            order=order,
            exposure_s=exposure_s,
            began_s=began_s,
            frames=frames if keep else None,
            image=None if keep else image,
            noise=noise,
            signal=float(np.mean(np.abs(image) ** 2)),
            lock_hz=lock_hz,
            lock_se_hz=float(spread / (2 * np.pi * FRAME_S)),
            repeated=any(np.array_equal(a, b) for a, b in pairwise(frames)),
        )


def _steadiest_turn(each: NDArray[np.complexfloating]) -> tuple[float, float]:
    """Fit ``A + c exp(-imδ)`` to four images; return δ less a quarter of a turn, and Σ|c|².

    Gauss's method, from the turn that two differences of frames show.
    """
    even, odd = each[0] - each[2], each[1] - each[3]
    delta = -float(np.angle(np.sum(odd * even.conj())))
    number, flat = np.arange(4), each.reshape(4, -1)
    for _ in range(30):
        beat = np.exp(-1j * delta * number)
        both = np.stack([np.ones(4), beat], axis=1)
        found = np.linalg.lstsq(both, flat, rcond=None)[0]
        slope = -1j * number * beat
        slope = slope - both @ np.linalg.lstsq(both, slope, rcond=None)[0]
        power = float(np.sum(np.abs(found[1]) ** 2))
        along = np.sum(slope.conj() @ (flat - both @ found) * found[1].conj())
        step = float(along.real) / max(power * float(np.sum(np.abs(slope) ** 2)), 1e-30)
        delta += step
        if abs(step) < 1e-9:
            break
    return (delta - 0.5 * np.pi + np.pi) % (2 * np.pi) - np.pi, power


def _integral(offset_hz: float, start_s: float, length_s: float) -> complex:
    """∫ exp(2πi·offset·t) dt over an exposure."""
    middle = start_s + 0.5 * length_s
    return complex(
        length_s * np.sinc(offset_hz * length_s) * np.exp(2j * np.pi * offset_hz * middle)
    )
