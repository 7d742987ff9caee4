"""Disorder of ordinary benches and reeds: which parameters it changes, and by how much.

Disorder is what differs from the nominal bench although nothing is wrong. Each kind of it is a
change of a parameter in the part of the tree where it belongs, next to those that
effects change: a part of its own would hold many of them twice. This module lists the kinds with
their ordinary ranges, from which a bench can be drawn.
"""

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields

import numpy as np

from physics.alterations import Alteration, Layer, MovedClamp, RandomLayer
from physics.parameters.quantity import Quantity, quantity_of
from physics.parameters.tree import BenchParameters, part_at, with_alteration, with_part

Change = Callable[[BenchParameters, float, int], BenchParameters]
"""``change(parameters, amount, seed)`` returns the parameters with an amount of a disorder."""

_PAPER_10_UM = "paper, section III.A: thickness is known to 10 µm"
_CHOSEN_MAP = f"{_PAPER_10_UM}; chosen: random deviations within it"
_BY_HAND = "reeds are put under the ligature by hand: some tenths of a millimetre"
_HANDBOOK = (
    "spread of small clear specimens of one wood (Wood Handbook, chapter 5): 0.1 to 0.12 in the "
    "logarithm, here as the limits of an equal distribution"
)
_POISSON = "chosen: as the moduli"
_SHEET = "data sheets of CCD cameras of 1.3 megapixels, 12 bit"


@dataclass(frozen=True)
class Disorder:
    """One kind of disorder.

    Attributes
    ----------
    name : str
    meaning : str
    ordinary : Quantity
        Unit, range on a bench on which nothing is wrong, and the source of this range.
    limits : (float, float)
        Least and largest amount that the model can play.
    of_reed : bool
        Whether the amount belongs to the reed, and not to the bench.
    change : callable
        See `Change`.
    """

    name: str
    meaning: str
    ordinary: Quantity
    limits: tuple[float, float]
    of_reed: bool
    change: Change


def _field(
    name: str, meaning: str, place: str, ordinary: tuple[float, float], source: str
) -> Disorder:
    """Return the disorder whose amount is the value of a field, such as ``sensor.lag``."""
    part, _, field = place.rpartition(".")
    (declared,) = (f for f in fields(part_at(BenchParameters(), part)) if f.name == field)
    known = quantity_of(declared)

    def change(parameters: BenchParameters, amount: float, _seed: int) -> BenchParameters:
        return with_part(parameters, part, **{field: amount})

    return Disorder(
        name=name,
        meaning=meaning,
        ordinary=Quantity(known.unit, *ordinary, source),
        limits=(known.low, known.high),
        of_reed=part.startswith("reed"),
        change=change,
    )


def _alteration(
    name: str,
    meaning: str,
    kind: Callable[[int], Alteration],
    ordinary: Quantity,
    limits: tuple[float, float],
) -> Disorder:
    """Return the disorder that alters a reed; `kind` gives the alteration that a seed selects."""

    def change(parameters: BenchParameters, amount: float, seed: int) -> BenchParameters:
        return with_alteration(parameters, kind(seed), amount)

    return Disorder(name, meaning, ordinary, limits, of_reed=True, change=change)


# Limits of the shape: first order in the thickness is some 10 cents wrong beyond (see
# `RandomLayer`), and of a clamp edge beyond 0.3 mm (decision 0024).
_SHAPE = (
    _alteration(
        "thickness_map",
        "rms of a random thickness map, correlated over 8 mm along and 4 mm across",
        RandomLayer, Quantity("m", 3e-6, 8e-6, _CHOSEN_MAP), (0.0, 10e-6),
    ),
    _alteration(
        "thickness_slope", "thickness of the left edge, less that of the middle",
        lambda _: Layer(0, 1), Quantity("m", -5e-6, 5e-6, _PAPER_10_UM), (-15e-6, 15e-6),
    ),
    _alteration(
        "clamp_shift", "distance by which the clamp begins farther from the tip",
        lambda _: MovedClamp(), Quantity("m", -0.2e-3, 0.2e-3, _BY_HAND), (-0.3e-3, 0.3e-3),
    ),
    _alteration(
        "clamp_tilt", "distance by which the left strip of the clamp begins farther from the tip, "
        "and the right one nearer to it",
        lambda _: MovedClamp(tilted=True), Quantity("m", -0.2e-3, 0.2e-3, _BY_HAND),
        (-0.3e-3, 0.3e-3),
    ),
)  # fmt: skip

_CANE = (
    *(
        _field(name, f"logarithm of a factor on {name}", f"reed.shift.{name}", (-0.2, 0.2), source)
        for names, source in (
            (("E_T", "E_R", "G_LR", "G_TR", "density"), _HANDBOOK),
            (("nu_LT", "nu_LR", "nu_TR"), _POISSON),
        )
        for name in names
    ),
    _field(
        "shear_loss", "logarithm of the loss factor of shear over that of bending",
        "reed.shear_loss_log", (0.0, 0.7),
        "shear loses more: Labonnote et al., Wood Sci. Technol. 47, 1033 (2013); chosen: to twice",
    ),
)  # fmt: skip

_SOUND = (
    _field(
        "travelling", "wave that travels along the chamber, relative to the standing wave",
        "chamber.travelling", (0.0, 0.3), "chosen: a chamber that reflects most sound",
    ),
    _field(
        "rail_leak", "part of the pressure that passes between reed and rails",
        "chamber.rail_leak", (0.0, 0.1), "chosen: a reed that nearly closes the window",
    ),
)  # fmt: skip

_FROM_STEP_TO_STEP = (
    _field(
        "gain_scatter", "scatter of the logarithm of the object light's amplitude, per step",
        "optics.interference.gain_scatter", (0.003, 0.007),
        "chosen: about 0.5 % in the efficiency of two modulators whose frequency changes",
    ),
    _field(
        "speckle_renewal", "rms of the speckle that is new in a step, relative to all of it",
        "optics.interference.speckle_renewal", (0.01, 0.025),
        "chosen: the surface of a reed that dries and creeps in its clamp",
    ),
    _field(
        "field_change", "rms of a smooth relative change of the object light, per step",
        "optics.interference.field_change", (0.003, 0.01),
        "chosen: below the renewal of speckle; beams that wander, air in layers",
    ),
    _field(
        "path_step", "random step of the optical path's phase, per step of the sweep",
        "optics.interference.step_walk_rad", (0.3, 0.5),
        "chosen: about 0.4 rad, a sixteenth of a wavelength of path, without an isolated table",
    ),
)  # fmt: skip

_FROM_FRAME_TO_FRAME = (
    _field(
        "path_walk", "random walk of the optical path's phase; 0.2 is 0.1 rad within four frames",
        "optics.interference.walk_rad_s", (0.1, 0.3),
        "an interferometer on a table: up to 1 to 2 rad in a minute",
    ),
    _field(
        "path_jitter", "random phase of each frame", "optics.interference.jitter_rad", (0.0, 0.05),
        "chosen: 3 nm of a surface at most, as sound moves a mirror",
    ),
    _field(
        "frame_jitter", "time by which frames begin early or late", "clocks.frame_jitter_s",
        (1e-6, 20e-6), "hardware triggers of machine-vision cameras",
    ),
    _field(
        "laser_power", "scatter of the laser's relative power", "optics.interference.power_noise",
        (0.001, 0.003), "laser diodes with regulated power: about 0.2 %",
    ),
)  # fmt: skip

_CAMERA = (
    _field(
        "pixel_pattern", "rms of the pixels' relative sensitivity (PRNU)", "sensor.pattern",
        (0.002, 0.01), "EMVA 1288 sheets: 0.2 to 2 %, the better half",
    ),
    _field(
        "read_noise", "read noise of a pixel", "sensor.read_noise_e", (8.0, 16.0), _SHEET,
    ),
    _field(
        "row_noise", "noise that the pixels of a row share", "sensor.row_noise_e", (0.5, 3.0),
        "EMVA 1288 sheets with row spectra: a tenth of the read noise or less; chosen: to a fifth",
    ),
    _field(
        "lag", "part of the light that a frame leaves to the next one", "sensor.lag",
        (0.0005, 0.003), "chosen: charge that an interline CCD leaves behind, tenths of a per cent",
    ),
    _field(
        "nonlinearity", "relative error of a full pixel", "sensor.nonlinearity", (0.001, 0.004),
        "EMVA 1288 sheets: 0.1 to 2 %, the better end; about 0.2 %",
    ),
    _field(
        "lamp", "relative rms by which the lamp of flat frames is uneven",
        "optics.illumination.lamp_unevenness", (0.01, 0.05),
        "EMVA 1288 asks for 3 % from maximum to minimum; chosen: lamps without a sphere",
    ),
    _field(
        "reference_leak", "power of object light that is left when its shutter is closed",
        "optics.illumination.reference_leak", (1e-5, 1e-3),
        "chosen: light that is scattered around a shutter; its beat has 0.3 to 3 % of the contrast",
    ),
)  # fmt: skip

CATALOGUE: tuple[Disorder, ...] = (
    *_SHAPE, *_CANE, *_SOUND, *_FROM_STEP_TO_STEP, *_FROM_FRAME_TO_FRAME, *_CAMERA,
)  # fmt: skip
"""All kinds of disorder."""

BY_NAME: Mapping[str, Disorder] = {kind.name: kind for kind in CATALOGUE}
"""Kinds of disorder by name."""


def ordinary_amounts(seed: int, reed: str) -> dict[str, float]:
    """Draw an ordinary bench: an amount of each kind, equally distributed over its range.

    Parameters
    ----------
    seed : int
        Selects the bench.
    reed : str
        Name of the reed: what belongs to a reed is drawn for each one, from this seed.

    Returns
    -------
    dict of float
        Amounts by name.

    Examples
    --------
    >>> ordinary_amounts(1, "R07") == ordinary_amounts(1, "R07")
    True
    >>> ordinary_amounts(1, "R07")["lag"] == ordinary_amounts(1, "R08")["lag"]
    True
    """
    return {
        kind.name: float(_rng_of(kind, seed, reed).uniform(kind.ordinary.low, kind.ordinary.high))
        for kind in CATALOGUE
    }


def with_disorder(
    parameters: BenchParameters, amounts: Mapping[str, float], seed: int, reed: str
) -> BenchParameters:
    """Return the parameters of a bench with disorder.

    Parameters
    ----------
    parameters : BenchParameters
    amounts : mapping of float
        Amounts by name; those of fields take the place of the values that they had.
    seed : int
        Selects what is random in space: the thickness map of each reed.
    reed : str
        Name of the reed.

    Raises
    ------
    KeyError
        If a name is not of the catalogue. Limits are for whoever reads amounts from a file.
    """
    for name, amount in amounts.items():
        kind = BY_NAME[name]
        seed_of_field = int(_rng_of(kind, seed, f"{reed}/field").integers(2**32))
        parameters = kind.change(parameters, amount, seed_of_field)
    return parameters


def _rng_of(kind: Disorder, seed: int, reed: str) -> np.random.Generator:
    """Return a generator that depends on nothing else, so that kinds can be added."""
    name = f"{kind.name}/{reed}" if kind.of_reed else kind.name
    return np.random.default_rng([seed, *hashlib.sha256(name.encode()).digest()])
