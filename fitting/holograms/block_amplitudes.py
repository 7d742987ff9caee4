"""Compress the holograms of a sweep to one complex number for each block of pixels.

A hologram of the first sideband is ``H(x) = c a(x) F(u(x))`` plus noise. The speckle field a(x) of
the rough surface is the same in all holograms; u(x) is the complex phase amplitude of the
vibration, and ``F(u) = u J₁(|u|)/|u|``. Within a block of a few pixels u is nearly constant while
a(x) is random. The holograms of a block, one in each row, therefore form a matrix of rank one. Its
left singular vector is ``c F(u)`` of all holograms, averaged over the noise of the pixels. Its
right singular vector is the speckle field of the pixels, which weights their coordinates.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import toeplitz

from fitting.errors import FitError
from fitting.fringes.pictures import good_steps
from fitting.parallel.threads import map_threads
from fitting.reed_place import ReedPlace, nominal_place, reed_place
from holography.apodisation import Taper, apodised, least_taper
from holography.arrays import Array, Complex64Array
from physics.reed.geometry import half_width_m
from protocols.errors import ProtocolError
from protocols.plan import planned_sequence
from protocols.protocol import Protocol
from runs.reader import Run
from runs.records import StepRecord

# Side of a block: ten of the finest speckles that a full sensor resolves are enough to average, and
# the displacement may still change by 1 to 2 rad across the block.
_BLOCK_M = 0.38e-3
# ... and pixels along it, however coarse they are. The place of a block is the centre of its light,
# which a single pixel, one speckle that it resolves, does not have.
_LEAST_PIXELS = 2
# Fraction of a pixel's light that may come from farther than a side of its block, along an axis.
# Chosen: of a block it is then a per cent at most, along both axes together. If this light cancels,
# the block amplitude is half a per cent smaller, as much as brightness scatters on ordinary benches
# (`gain_scatter` of `physics.parameters.disorder`). The edges of the sensor are darkened for that
# (decision 0074).
_FROM_BEYOND = 0.0025
# Margin inside the contour: blocks on the edge contain less reed than others.
_EDGE_M = 0.25e-3
# Behind the vamp the clamp begins: the reed is dark there and does not move.
_BEHIND_VAMP_M = 1e-3
# Number of blocks whose holograms fit into the processor's cache.
_BLOCKS_AT_ONCE = 16
# A pause counts for at most this share of the holograms of a sweep. Chosen: what drifts is known at
# nodes that are evenly spaced in ranks, and longer pauses would leave few for the holograms. And
# from how many usual steps on a gap is a pause.
_LONGEST, _PAUSE = 4, 3.0


@dataclass(frozen=True)
class SidebandAmplitudes:
    """Block amplitudes of another sideband of the same vibrations.

    Attributes
    ----------
    order : int
        Order of the sideband.
    value : (n, k) complex64
        ``A c F_n(u)`` with the same object field A and vibrations u, but other factors c; 0 where
        there is no hologram.
    present : (k,) bool
        True where there is a good hologram.
    """

    order: int
    value: Complex64Array
    present: NDArray[np.bool_]


@dataclass(frozen=True)
class UnshiftedLight:
    """Light of sideband 0 that leaks into the holograms of a run.

    Attributes
    ----------
    light : (height, width) complex64
        Field of the reed at rest, in the units of `Run.field`.
    fraction : dict of complex
        Fraction of it in each hologram, by the hologram's position in the run.
    """

    light: Complex64Array
    fraction: Mapping[int, complex]


@dataclass(frozen=True)
class BlockAmplitudes:
    """Block amplitudes of all good holograms of a run.

    Attributes
    ----------
    value : (n, k) complex64
        ``A c F(u)`` in units of the noise's standard deviation. A is one unknown complex number
        for each block.
    x_m, y_m : (n,) float
        Coordinates of the blocks on the reed.
    size_m : tuple of float
        Sides of a block along x and y.
    spread : (2, n) float
        Standard deviation, along x and y, of where the light of each block comes from, in its
        sides.
    independent_fraction : float
        Number of independent block amplitudes over that of all: neighbours share noise.
    noise_variance : (n,) float
        Variance of the noise of each, over that of a pixel of the image.
    step_index : (k,) int
        Index of each hologram in the protocol.
    recording_rank : (k,) int
        Rank of each hologram in the order of recording.
    drive_hz : (k,) float
        Realised drive frequencies, ascending.
    volts : (k,) float
        Peak volts at the load.
    others : tuple of SidebandAmplitudes
        Block amplitudes of the other sidebands of the protocol.
    place : ReedPlace
        Where the reed lies in the image; `x_m` and `y_m` are coordinates on the reed.
    subtracted : (n, k) complex64, optional
        Unshifted light that was subtracted from `value`.
    """

    value: Complex64Array
    x_m: Array
    y_m: Array
    size_m: tuple[float, float]
    spread: Array
    independent_fraction: float
    noise_variance: Array
    step_index: NDArray[np.intp]
    recording_rank: NDArray[np.intp]
    drive_hz: Array
    volts: Array
    others: tuple[SidebandAmplitudes, ...] = ()
    place: ReedPlace = field(default_factory=nominal_place)
    subtracted: Complex64Array | None = None

    @property
    def recorded(self) -> Complex64Array:
        """Block amplitudes (n, k) before unshifted light was subtracted."""
        return self.value if self.subtracted is None else self.value + self.subtracted


def read_block_amplitudes(run: Run, unshifted: UnshiftedLight | None = None) -> BlockAmplitudes:
    """Read the block amplitudes of all good holograms of a run, in order of drive frequency.

    Parameters
    ----------
    run : Run
    unshifted : UnshiftedLight, optional
        Subtracted from the holograms.

    Raises
    ------
    FitError
        If too few steps are good (the message lists the verdicts of the others), or if the protocol
        of a run that was interrupted cannot be read.
    RunFileError
        If a step cannot be read.
    """
    steps = good_steps(run)
    place = reed_place(run, steps)
    blocks = _blocks(run, place)
    others = _others(run, steps)
    all_steps = [*steps, *(step for found in others.values() for step in found.values())]
    value, right = _leading(_holograms(run, all_steps, blocks, unshifted))
    noise = blocks.noise(right)
    unit = np.sqrt(noise).astype(np.float32)[:, None]
    value /= unit
    down, across = blocks.tapers
    middle_m, spread = blocks.light(right)
    x_m, y_m = place.on_reed(*middle_m)
    return BlockAmplitudes(
        value=np.ascontiguousarray(value[:, : len(steps)]),
        x_m=x_m,
        y_m=y_m,
        # On the reed, as all places are.
        size_m=(
            blocks.wide * _pixel_m(run.x_m) / (1 + place.larger),
            blocks.high * _pixel_m(run.y_m) / (1 + place.larger),
        ),
        spread=spread,
        independent_fraction=across.independent_fraction(blocks.wide)
        * down.independent_fraction(blocks.high),
        noise_variance=noise,
        step_index=np.array([step.index for step in steps]),
        recording_rank=_recording_rank(run, steps),
        drive_hz=np.array([float(step.read_drive_hz or step.drive_hz) for step in steps]),
        volts=np.array([step.volts for step in steps]),
        others=_split(others, value[:, len(steps) :], len(steps)),
        place=place,
        subtracted=None
        if unshifted is None
        else _unshifted_amplitudes(run, unshifted, steps, blocks, right) / unit,
    )


def _recording_rank(run: Run, steps: Sequence[StepRecord]) -> NDArray[np.intp]:
    """Return the rank (k,) of steps in the order of recording.

    Light changes with time: between two steps, ranks grow by as many as would have been recorded
    in the usual time of a step, up to a share of all. That is 1, but for bad steps and pauses.
    """
    order, begun_s = _recorded(run, steps), np.array([step.timestamps_s[0] for step in steps])
    apart_s = np.diff(begun_s[order])
    usual_s = float(np.median(apart_s[apart_s > 0])) if np.any(apart_s > 0) else 1.0
    longest = max(len(steps) // _LONGEST, 1)
    # A clock that has begun again does not tell how long it stood still.
    gaps = np.where(apart_s > 0, np.round(apart_s / usual_s), longest)
    if run.interruptions:
        # In the planned order, a step that was measured again is out of its time, and no pause.
        steady = np.pad((apart_s > 0) & (gaps < _PAUSE), 1, constant_values=True)
        gaps = np.where(steady[:-2] & steady[2:], gaps, 1.0)
    ranks = np.zeros(len(steps), dtype=np.intp)
    ranks[order[1:]] = np.cumsum(np.clip(gaps, 1, longest)).astype(np.intp)
    return ranks


def _recorded(run: Run, steps: Sequence[StepRecord]) -> NDArray[np.intp]:
    """Return the numbers (k,) of steps in the order of recording.

    The camera's clock tells it, unless the camera was started again during the run: its clock may
    then have begun again, and the planned order is taken.
    """
    if not run.interruptions:
        return np.argsort([step.timestamps_s[0] for step in steps])
    try:
        protocol = Protocol.from_text(run.protocol_text, "its protocol")
    except ProtocolError as error:
        raise FitError(
            f"{run.path}: was interrupted, and only its protocol says in which order its steps "
            f"were measured; measure it again ({error})"
        ) from error
    place = np.argsort(planned_sequence(protocol, len(run.steps)))
    return np.argsort(place[[step.position for step in steps]])


def _others(run: Run, steps: Sequence[StepRecord]) -> dict[int, dict[int, StepRecord]]:
    """Return the good steps of other sidebands: by order, then by the number of the step (k,)."""
    place = {step.index: k for k, step in enumerate(steps)}
    found: dict[int, dict[int, StepRecord]] = {}
    for step in run.steps:
        if step.order != run.sideband_order and step.verdict == "ok" and step.index in place:
            found.setdefault(step.order, {})[place[step.index]] = step
    return found


def _split(
    others: dict[int, dict[int, StepRecord]], value: Complex64Array, count: int
) -> tuple[SidebandAmplitudes, ...]:
    """Assign the columns (n, …) of other sidebands to the k steps that they belong to."""
    split, first = [], 0
    for order, found in others.items():
        places = np.array(list(found))
        assigned = np.zeros((len(value), count), np.complex64)
        assigned[:, places] = value[:, first : first + len(found)]
        split.append(SidebandAmplitudes(order, assigned, np.isin(np.arange(count), places)))
        first += len(found)
    return tuple(split)


def _pixel_m(axis_m: Array) -> float:
    return float(abs(axis_m[1] - axis_m[0]))


def _in_blocks(axis_m: Array, factor: int) -> Array:
    """Return the coordinates (blocks, factor) of all whole blocks along an axis."""
    return axis_m[: len(axis_m) // factor * factor].reshape(-1, factor)


@dataclass(frozen=True)
class _Blocks:
    """Blocks of pixels on the vamp.

    Attributes
    ----------
    inside : (rows, columns) bool
        Which blocks of the image are used.
    high, wide : int
        Pixels in a block.
    x_m, y_m : (n, p) float
        Coordinates in the image of the pixels of each used block, row by row.
    """

    inside: NDArray[np.bool_]
    high: int
    wide: int
    x_m: Array
    y_m: Array

    @property
    def tapers(self) -> tuple[Taper, Taper]:
        """Window of the sensor along rows and columns."""
        return least_taper(self.high, _FROM_BEYOND), least_taper(self.wide, _FROM_BEYOND)

    def noise(self, weights: Complex64Array) -> Array:
        """Return the noise variance (n,) of sums with weights (n, p), over that of a pixel."""
        down, across = (
            toeplitz(taper.noise_correlation(count))
            for taper, count in zip(self.tapers, (self.high, self.wide), strict=True)
        )
        shared = np.einsum("np,pq,nq->n", weights, np.kron(down, across), weights.conj())
        return np.asarray(shared.real)

    def light(self, weights: Complex64Array) -> tuple[Array, Array]:
        """Return where the light of sums with weights (n, p) comes from.

        Returns
        -------
        middle_m : (2, n) float
            Mean x and y, in the image.
        spread : (2, n) float
            Standard deviation along x and y, in sides of a block.
        """
        shape = -1, self.high, self.wide
        image, x_m, y_m = (each.reshape(shape) for each in (weights, self.x_m, self.y_m))
        down, across = self.tapers
        middle_m, spread = [], []
        for taper, at_m, values in (
            (across, x_m, image),
            (down, y_m.swapaxes(1, 2), image.swapaxes(1, 2)),
        ):
            pixels = values.shape[2]
            mean, square = (
                np.einsum("nip,pq,niq->n", values.conj(), each, values, optimize=True).real
                for each in taper.light_moments(pixels)
            )
            pixel_m = (at_m[:, 0, -1] - at_m[:, 0, 0]) / (pixels - 1)
            middle_m.append(at_m.mean(axis=(1, 2)) + pixel_m * mean)
            # The weights of the likeliest scatterers may be negative.
            spread.append(np.sqrt(np.maximum(square - mean**2, 0.0)) / pixels)
        return np.stack(middle_m), np.stack(spread)

    def of(self, field: Complex64Array) -> Complex64Array:
        """Return the pixels (n, p) of a field, sorted into blocks."""
        (rows, columns), high, wide = self.inside.shape, self.high, self.wide
        whole = field[: rows * high, : columns * wide].reshape(rows, high, columns, wide)
        chosen = whole.transpose(0, 2, 1, 3)[self.inside]
        return chosen.reshape(len(chosen), -1)


def _blocks(run: Run, place: ReedPlace) -> _Blocks:
    """Find the blocks of a run's image that lie on the vamp."""
    high, wide = (
        max(_LEAST_PIXELS, round(_BLOCK_M / _pixel_m(axis_m))) for axis_m in (run.y_m, run.x_m)
    )
    y_m, x_m = _in_blocks(run.y_m, high), _in_blocks(run.x_m, wide)
    in_image = np.meshgrid(y_m.mean(axis=1), x_m.mean(axis=1), indexing="ij")
    X, Y = place.on_reed(*reversed(in_image))
    reed = run.reed_file().geometry()
    inside_edge_m = half_width_m(reed.outline, X) - np.abs(Y)
    visible_m = reed.vamp_x_m[-1] + _BEHIND_VAMP_M
    inside = (inside_edge_m > _EDGE_M) & (X > 2 * _EDGE_M) & (visible_m > X)
    rows, columns = np.nonzero(inside)
    return _Blocks(
        inside=inside,
        high=high,
        wide=wide,
        x_m=np.tile(x_m[columns], (1, high)),
        y_m=np.repeat(y_m[rows], wide, axis=1),
    )


def _holograms(
    run: Run, steps: Sequence[StepRecord], blocks: _Blocks, unshifted: UnshiftedLight | None
) -> Complex64Array:
    """Read the fields (n, k, p) of all blocks in units of the noise, less unshifted light."""
    chosen = np.empty((len(blocks.x_m), len(steps), blocks.high * blocks.wide), np.complex64)
    for k, step in enumerate(steps):
        field = run.field(step.position)
        if not (
            np.isfinite(field).all() and step.noise_level > 0 and np.isfinite(step.noise_level)
        ):
            raise FitError(
                f"{run.path}: step {step.index} has verdict ok, but its field or its noise level "
                "is not a number: the file is damaged; measure the run again"
            )
        if unshifted is not None:
            field = field - unshifted.fraction.get(step.position, 0.0) * unshifted.light
        image = _apodised(run, field, blocks)
        chosen[:, k] = blocks.of(image) / np.float32(np.sqrt(step.noise_level))
    return chosen


def _apodised(run: Run, field: Complex64Array, blocks: _Blocks) -> Complex64Array:
    """Return a field without the side lobes that the edges of the sensor cause."""
    return apodised(field, run.reconstruction.transform, run.region, blocks.tapers)


def _unshifted_amplitudes(
    run: Run,
    unshifted: UnshiftedLight,
    steps: Sequence[StepRecord],
    blocks: _Blocks,
    right: Complex64Array,
) -> Complex64Array:
    """Return the block amplitudes (n, k) of unshifted light, for right singular vectors (n, p)."""
    fractions = [
        unshifted.fraction.get(step.position, 0.0) / np.sqrt(step.noise_level) for step in steps
    ]
    light = np.sum(blocks.of(_apodised(run, unshifted.light, blocks)) * right, axis=1)
    off: Complex64Array = np.multiply.outer(light, fractions).astype(np.complex64)
    return off


def _leading(holograms: Complex64Array) -> tuple[Complex64Array, Complex64Array]:
    """Return leading left singular vectors (n, k) times singular values, and right ones (n, p)."""
    blocks, count, pixels = holograms.shape
    value, right = np.empty((blocks, count), np.complex64), np.empty((blocks, pixels), np.complex64)

    def fill(some: slice) -> None:
        here = holograms[some]
        vectors = np.linalg.eigh(here.conj().transpose(0, 2, 1) @ here)[1][:, :, -1:]
        value[some], right[some] = (here @ vectors)[..., 0], vectors[..., 0]

    map_threads(fill, blocks, _BLOCKS_AT_ONCE)
    return value, right
