"""Holograms of a sweep as phasors: one complex number for each block of the image and hologram.

A hologram of the first sideband is ``H(x) = c a(x) F(u(x))`` plus noise: a(x) is the light that the
rough surface sends to the camera, the same in all holograms; u(x) the complex phase amplitude of
the vibration, and ``F(u) = u J₁(|u|)/|u|``. Within a block of a few pixels u hardly changes while
a(x) is random. The holograms of a block, one row each, are then a matrix of rank one, whose left
singular vector holds ``c F(u)`` of all holograms with the noise of all pixels averaged, and whose
right singular vector says how much light each pixel has, and so which place in the block it is
that the phasors are those of.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitting.errors import FitError
from fitting.fringes.pictures import good_steps
from fitting.parallel.threads import map_threads
from physics.reed.geometry import half_width_m
from runs.reader import Run
from runs.records import StepRecord

Array = NDArray[np.floating[Any]]
Complex = NDArray[np.complex64]

# Side of a block. Ten of the finest speckles that a full sensor resolves are enough to average, and
# displacements may still grow by a radian or two from one side to the other.
_BLOCK_M = 0.38e-3
# Margin inside the contour: blocks on the edge hold less reed than others.
_EDGE_M = 0.25e-3
# The image fades behind the vamp: the clamp begins, nothing moves.
_BEHIND_VAMP_M = 1e-3
# Blocks whose holograms still lie in the processor's cache.
_TOGETHER = 16


@dataclass(frozen=True)
class OtherPhasors:
    """What every block shows in another sideband of the same vibrations.

    Attributes
    ----------
    order : int
        Of the sideband.
    value : (n, k) complex64
        ``A c F_n(u)`` with the same light A and vibrations u, c of its own; 0 where there is none.
    present : (k,) bool
        For which vibrations there is a good hologram.
    """

    order: int
    value: Complex
    present: NDArray[np.bool_]


@dataclass(frozen=True)
class Unshifted:
    """Light that no vibration has shifted and that leaks into holograms of a run.

    Attributes
    ----------
    light : (height, width) complex64
        Of the reed at rest, as `Run.field` has it.
    share : dict of complex
        How much of it each hologram has, by its position in the run.
    """

    light: Complex
    share: Mapping[int, complex]


@dataclass(frozen=True)
class Phasors:
    """What every block shows in every good hologram of a run.

    Attributes
    ----------
    value : (n, k) complex64
        ``A c F(u)`` in units of the noise's standard deviation; A is one unknown complex number
        for each block.
    x_m, y_m : (n,) float
        Places on the reed that they are those of.
    step_index : (k,) int
        Index of each hologram in the protocol.
    drive_hz : (k,) float
        Realised drive frequencies, ascending.
    volts : (k,) float
        Peak volts at the load.
    others : tuple of OtherPhasors
        Of other sidebands, if the protocol asks for them.
    taken_off : (n, k) complex64, optional
        What `value` would have more if no unshifted light had been taken off the holograms.
    """

    value: Complex
    x_m: Array
    y_m: Array
    step_index: NDArray[np.intp]
    drive_hz: Array
    volts: Array
    others: tuple[OtherPhasors, ...] = ()
    taken_off: Complex | None = None

    @property
    def recorded(self) -> Complex:
        """Value (n, k) with what has been taken off."""
        return self.value if self.taken_off is None else self.value + self.taken_off


def read_phasors(run: Run, unshifted: Unshifted | None = None) -> Phasors:
    """Compress the good holograms of a run, of all its sidebands, in order of frequency.

    Parameters
    ----------
    run : Run
    unshifted : Unshifted, optional
        To be taken off the holograms.

    Raises
    ------
    FitError
        If too few steps are good; says what the others suffer from.
    RunFileError
        If a step cannot be read.
    """
    steps = good_steps(run)
    blocks = _blocks(run)
    others = _others(run, steps)
    together = [*steps, *(step for found in others.values() for step in found.values())]
    value, right = _leading(_holograms(run, together, blocks, unshifted))
    light = np.abs(right) ** 2
    return Phasors(
        value=np.ascontiguousarray(value[:, : len(steps)]),
        x_m=np.sum(light * blocks.x_m, axis=1),
        y_m=np.sum(light * blocks.y_m, axis=1),
        step_index=np.array([step.index for step in steps]),
        drive_hz=np.array([float(step.read_drive_hz or step.drive_hz) for step in steps]),
        volts=np.array([step.volts for step in steps]),
        others=_split(others, value[:, len(steps) :], len(steps)),
        taken_off=None if unshifted is None else _taken_off(unshifted, steps, blocks, right),
    )


def _others(run: Run, steps: Sequence[StepRecord]) -> dict[int, dict[int, StepRecord]]:
    """Good steps of other sidebands by order, and by which of the steps (k,) they belong to."""
    place = {step.index: k for k, step in enumerate(steps)}
    found: dict[int, dict[int, StepRecord]] = {}
    for step in run.steps:
        if step.order != run.sideband_order and step.verdict == "ok" and step.index in place:
            found.setdefault(step.order, {})[place[step.index]] = step
    return found


def _split(
    others: dict[int, dict[int, StepRecord]], value: Complex, count: int
) -> tuple[OtherPhasors, ...]:
    """Put the columns (n, …) of other sidebands beside those of the k steps that they belong to."""
    split, first = [], 0
    for order, found in others.items():
        places = np.array(list(found))
        beside = np.zeros((len(value), count), np.complex64)
        beside[:, places] = value[:, first : first + len(found)]
        split.append(OtherPhasors(order, beside, np.isin(np.arange(count), places)))
        first += len(found)
    return tuple(split)


def _in_blocks(axis_m: Array, factor: int) -> Array:
    """Coordinates (blocks, factor) of the whole blocks along an axis."""
    return axis_m[: len(axis_m) // factor * factor].reshape(-1, factor)


@dataclass(frozen=True)
class _Blocks:
    """Blocks of so many pixels high and wide that lie inside (rows, columns).

    Places (n, p) are those of all pixels of each, row by row.
    """

    inside: NDArray[np.bool_]
    high: int
    wide: int
    x_m: Array
    y_m: Array

    def of(self, field: Complex) -> Complex:
        """Blocks (n, p) of a field."""
        (rows, columns), high, wide = self.inside.shape, self.high, self.wide
        whole = field[: rows * high, : columns * wide].reshape(rows, high, columns, wide)
        chosen = whole.transpose(0, 2, 1, 3)[self.inside]
        return chosen.reshape(len(chosen), -1)


def _blocks(run: Run) -> _Blocks:
    """Blocks of a run's image that lie on the vamp."""
    high, wide = (max(1, round(_BLOCK_M / abs(a[1] - a[0]))) for a in (run.y_m, run.x_m))
    y_m, x_m = _in_blocks(run.y_m, high), _in_blocks(run.x_m, wide)
    Y, X = np.meshgrid(y_m.mean(axis=1), x_m.mean(axis=1), indexing="ij")
    reed = run.reed_file().geometry()
    beside = half_width_m(reed.outline, X) - np.abs(Y)
    visible_m = reed.vamp_x_m[-1] + _BEHIND_VAMP_M
    inside = (beside > _EDGE_M) & (X > 2 * _EDGE_M) & (visible_m > X)
    rows, columns = np.nonzero(inside)
    return _Blocks(
        inside=inside,
        high=high,
        wide=wide,
        x_m=np.tile(x_m[columns], (1, high)),
        y_m=np.repeat(y_m[rows], wide, axis=1),
    )


def _holograms(
    run: Run, steps: Sequence[StepRecord], blocks: _Blocks, unshifted: Unshifted | None
) -> Complex:
    """Fields (n, k, p) of the blocks inside, of noise 1, less unshifted light."""
    chosen = np.empty((len(blocks.x_m), len(steps), blocks.high * blocks.wide), np.complex64)
    for k, step in enumerate(steps):
        field = run.field(step.position)
        if not (
            np.isfinite(field).all() and step.noise_level > 0 and np.isfinite(step.noise_level)
        ):
            raise FitError(
                f"{run.path}: step {step.index} is said to be ok, but its field or its noise level "
                "is no number; give it another verdict"
            )
        if unshifted is not None:
            field = field - unshifted.share.get(step.position, 0.0) * unshifted.light
        chosen[:, k] = blocks.of(field) / np.float32(np.sqrt(step.noise_level))
    return chosen


def _taken_off(
    unshifted: Unshifted, steps: Sequence[StepRecord], blocks: _Blocks, right: Complex
) -> Complex:
    """What phasors (n, k) lose by it, by right singular vectors (n, p)."""
    share = [unshifted.share.get(step.position, 0.0) / np.sqrt(step.noise_level) for step in steps]
    light = np.sum(blocks.of(unshifted.light) * right, axis=1)
    off: Complex = np.multiply.outer(light, share).astype(np.complex64)
    return off


def _leading(holograms: Complex) -> tuple[Complex, Complex]:
    """Leading left singular vectors (n, k) times singular values, and right ones (n, p)."""
    blocks, count, pixels = holograms.shape
    value, right = np.empty((blocks, count), np.complex64), np.empty((blocks, pixels), np.complex64)

    def fill(some: slice) -> None:
        here = holograms[some]
        vectors = np.linalg.eigh(here.conj().transpose(0, 2, 1) @ here)[1][:, :, -1:]
        value[some], right[some] = (here @ vectors)[..., 0], vectors[..., 0]

    map_threads(fill, blocks, _TOGETHER)
    return value, right
