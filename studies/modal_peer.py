"""Modes of a sweep by a public library of modal analysis, as a peer of `fitting.modal.fit`.

sdypy-EMA (`pip install "reedbench[bench]"`, MIT) finds poles by the least-squares complex frequency
method (LSCF) for rising orders of the model, calls those stable that stay where they were an order
before, and finds shapes by least squares (LSFD). Its stability chart is for the eye; here stable
poles are taken by rules that know where modes are expected, but not where they are. The rules were
chosen so that the library does well on synthetic sweeps and on simulated reeds, of whose modes it
misses some 8 %:

* It takes frequencies in equal steps, a sweep has equal ratios: real and imaginary parts are
  interpolated over log frequency by quintic splines, at half the finest step of a band.
* Bands of an octave, one every quarter of an octave: wider ones miss more of the modes that
  overlap at high frequencies (11 % in bands of 1.5 octaves), narrower ones scatter more.
* The frequencies of a band are moved down until what is empty below it is a quarter of its width
  (the zoom of LSCF's authors), and poles are moved back. Unmoved, the normal equations are ill
  conditioned beyond order 12, and 32 % are missed.
* Receptance, up to 24 pairs of poles: with 16, 13 % are missed.
* Stable is what moves by less than 0.2 % in frequency and 10 % in damping: with the library's
  defaults, half of that, 11 % are missed; with 0.5 % there are poles where no modes are.
* A pole counts if its loss factor is credible and its shape not too complex (by the library's
  modal complexity factor), a mode if three such poles are near it, of whatever orders and bands.
  It is their median.

LSCF knows no weights: holograms that tell little count as much as all others. Its normal equations
are so ill conditioned at high orders that rounding moves a mode by some tenths of a cent.
"""

import contextlib
import importlib
import importlib.metadata
import io
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.optimize import linear_sum_assignment

from holography.arrays import Array, ComplexArray

LIBRARY = "sdypy-EMA"
_OCTAVES, _OCTAVES_APART = 1.0, 0.25
_SPLINE_DEGREE = 5
# Of the finest step of the sweep in a band.
_STEP_SHARE = 0.5
# What is left empty below a band, as a share of its width.
_GAP = 0.25
_PAIRS_OF_POLES = 24
# Relative changes of frequency and damping from order to order.
_STABLE_HZ, _STABLE_DAMPING = 0.002, 0.1
_MOST_COMPLEXITY = 0.7
_MOST_LOSS = 0.12
_WITHIN_CENTS = 100.0
_LEAST_POLES = 3


@dataclass(frozen=True)
class PeerMode:
    """Eigenfrequency and loss factor of ``1 / (1 + iη − (f/f_m)²)``."""

    hz: float
    loss_factor: float


@dataclass(frozen=True)
class _Band:
    """A band as the library has it: `model` is its ``Model``, whose frequencies are lower."""

    lowest_hz: float
    highest_hz: float
    lower_by_hz: float
    model: Any


@dataclass(frozen=True)
class _Poles:
    """Stable poles of one order of the model in one band: (n,) each."""

    hz: Array
    loss_factor: Array


def peer_version() -> str | None:
    """Version of the library, or None where it is not installed."""
    try:
        return importlib.metadata.version(LIBRARY)
    except importlib.metadata.PackageNotFoundError:
        return None


def peer_modes(
    drive_hz: Array, response: ComplexArray, expected_hz: Mapping[str, float]
) -> dict[str, PeerMode]:
    """Find the modes of a sweep that are expected.

    Parameters
    ----------
    drive_hz : (k,) float
        Ascending, in about equal ratios, two or more to the width of a resonance.
    response : (k, p) complex
        Displacement at p points per unit of drive, time factor exp(+iωt); its phase must be
        consistent from drive to drive.
    expected_hz : mapping
        About where modes are, by name. Of several within 100 cents of a pole one gets it.

    Returns
    -------
    dict
        Modes for which stable poles were found within 100 cents, in the order expected.

    Raises
    ------
    ImportError
        If the library is not installed.
    numpy.linalg.LinAlgError
        If the response is zero throughout a band.
    """
    ema = _library()
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in expected_hz}
    wanted_hz = np.array(list(expected_hz.values()), dtype=float)
    spline = make_interp_spline(np.log(drive_hz), response, k=_SPLINE_DEGREE)
    for lowest_hz, highest_hz in _bands(float(drive_hz[0]), float(drive_hz[-1])):
        inside = drive_hz[(drive_hz >= lowest_hz) & (drive_hz <= highest_hz)]
        step_hz = _STEP_SHARE * float(np.diff(inside).min())
        for poles in _stable_poles(ema, _band(ema, spline, lowest_hz, highest_hz, step_hz)):
            for mode, pole in _nearest(wanted_hz, poles.hz):
                name = list(found)[mode]
                found[name].append((float(poles.hz[pole]), float(poles.loss_factor[pole])))
    return {
        name: PeerMode(*(float(value) for value in np.median(poles, axis=0)))
        for name, poles in found.items()
        if len(poles) >= _LEAST_POLES
    }


def _library() -> Any:
    try:
        return importlib.import_module("sdypy.EMA")
    except ImportError as error:
        raise ImportError(
            f"the peer of the modal fit needs {LIBRARY} ({error}); install it: "
            "pip install 'reedbench[bench]'"
        ) from error


def _bands(first_hz: float, last_hz: float) -> list[tuple[float, float]]:
    """Lowest and highest frequencies of bands that overlap evenly and reach both ends."""
    rest = max(np.log2(last_hz / first_hz) - _OCTAVES, 0.0)
    lowest_hz = first_hz * 2.0 ** np.linspace(0, rest, int(np.ceil(rest / _OCTAVES_APART)) + 1)
    return [(float(hz), float(min(hz * 2**_OCTAVES, last_hz))) for hz in lowest_hz]


def _band(
    ema: Any,
    response: Callable[[Array], ComplexArray],
    lowest_hz: float,
    highest_hz: float,
    step_hz: float,
) -> _Band:
    """Give a band to the library, moved down, and let it find its poles.

    The `response` (k, p) is a function of log frequency (k,).
    """
    steps = np.arange(np.ceil(lowest_hz / step_hz), np.floor(highest_hz / step_hz) + 1)
    sampled = response(np.log(steps * step_hz)).T
    gap = int(min(np.ceil(_GAP * len(steps)), steps[0]))
    # The library leaves out what is below `lower`, and the last line of all.
    padded = np.pad(sampled, ((0, 0), (gap, 1)))
    hz = np.arange(padded.shape[1]) * step_hz
    model = ema.Model(
        padded,
        hz,
        lower=hz[gap],
        upper=hz[-1],
        pol_order_high=_PAIRS_OF_POLES,
        frf_form="receptance",
    )
    model.get_poles(method="lscf", show_progress=False)
    # Whichever poles it selects: it works out on the way which are stable, with a progress bar, and
    # may select one without vibration.
    with contextlib.redirect_stderr(io.StringIO()), np.errstate(invalid="ignore"):
        model.select_closest_poles([0.5 * hz[-1]], fn_temp=_STABLE_HZ, xi_temp=_STABLE_DAMPING)
    return _Band(lowest_hz, highest_hz, float((steps[0] - gap) * step_hz), model)


def _stable_poles(ema: Any, band: _Band) -> Iterator[_Poles]:
    """Poles that are stable and belong to nearly real shapes, order by order."""
    model = band.model
    stable_hz = model.f_stable[model.f_stable > 0]
    for order, (poles, moved_hz) in enumerate(zip(model.all_poles, model.pole_freq, strict=True)):
        hz, loss = _hysteretic(poles, band.lower_by_hz)
        credible = (moved_hz > 0) & (loss > 0) & (loss < _MOST_LOSS)
        number = np.flatnonzero(credible & (hz > band.lowest_hz) & (hz < band.highest_hz))
        if not np.isin(moved_hz[number], stable_hz).any():
            continue
        model.pole_ind = np.stack([np.full_like(number, order), number], axis=1)
        _, shapes = model.get_constants(f_upper=model.freq[-1])
        counts = np.isin(moved_hz[number], stable_hz) & (ema.MCF(shapes) < _MOST_COMPLEXITY)
        yield _Poles(hz[number[counts]], loss[number[counts]])


def _hysteretic(poles_rad_s: ComplexArray, lower_by_hz: float) -> tuple[Array, Array]:
    """Eigenfrequencies and loss factors of ``1 / (1 + iη − (f/f_m)²)`` with these poles.

    A pole of it is at the complex frequency f with ``f² = f_m² (1 + iη)``; NaN where there is none.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        square = (poles_rad_s / (2j * np.pi) + lower_by_hz) ** 2
        return np.sqrt(square.real), square.imag / square.real


def _nearest(wanted_hz: Array, found_hz: Array) -> list[tuple[int, int]]:
    """Pairs of numbers of modes and of their poles: no pole twice, as near as can be together."""
    cents = np.abs(1200 * np.log2(wanted_hz[:, None] / found_hz))
    pairs = zip(*linear_sum_assignment(np.minimum(cents, 2 * _WITHIN_CENTS)), strict=True)
    return [(int(m), int(p)) for m, p in pairs if cents[m, p] < _WITHIN_CENTS]
