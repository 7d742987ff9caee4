"""Parameters of one reed and one bench, and the ranges of disorder that they are drawn from."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from studies.second_laboratory.cane import Cane

# "issue" stands for the list of disorder of real benches that this laboratory was asked for; where
# no other source is given, the range is that list's or this author's judgement of such benches.


@dataclass(frozen=True)
class Range:
    """A range that a parameter, or the standard deviation of one, is drawn from."""

    low: float
    high: float
    unit: str
    source: str

    def draw(self, rng: np.random.Generator) -> float:
        """Return a value from the range, all equally likely."""
        return float(rng.uniform(self.low, self.high))


class Ranges:
    """A table of ranges, each a field of a frozen dataclass."""

    def scaled(self, amounts: Mapping[str, float]) -> Self:
        """Return ranges multiplied by amounts; ``{"all": 0}`` switches off what is not named.

        Raises
        ------
        KeyError
            If a name is not that of a field.
        """
        table = {name: value for name, value in vars(self).items() if isinstance(value, Range)}
        for name in amounts:
            if name not in (*table, "all"):
                raise KeyError(f"no disorder {name!r}; known are all, {', '.join(table)}")
        changed = {}
        for name, old in table.items():
            amount = amounts.get(name, amounts.get("all", 1.0))
            changed[name] = replace(old, low=old.low * amount, high=old.high * amount)
        return type(self)(**changed)


@dataclass(frozen=True)
class Disorder(Ranges):
    """Ranges of everything in which reeds and benches differ from the drawing.

    Scaling a field by 0 switches it off: `Disorder.scaled`.
    """

    # Reed
    components: Range = Range(1, 1, "sd", "H4: e1 … e4 have mean 0 and standard deviation 1")
    thickness_map: Range = Range(3, 8, "µm rms", "issue; drawing ±5 µm (paper, appendix shape)")
    thickness_slope: Range = Range(-0.6, 0.6, "µm/mm", "±4 µm at the sides; issue, no figure")
    vamp_offset: Range = Range(-10, 10, "µm", "accuracy of the drawing, ±10 µm (paper)")
    clamp_front: Range = Range(-0.3, 0.3, "mm", "issue: tenths of a millimetre")
    clamp_tilt: Range = Range(-0.02, 0.02, "mm/mm", "±0.13 mm at the sides; issue, no figure")
    clamp_bed: Range = Range(0.1, 0.5, "mm", "hard plastic under the strips, E = 2 GPa (issue)")
    constants: Range = Range(
        0.1,
        0.1,
        "relative sd",
        "coefficients of variation of wood: 10–20 %, Wood Handbook (FPL-GTR-282), ch. 5",
    )
    density: Range = Range(0.05, 0.05, "relative sd", "issue; wood 10 %, reeds are sorted")
    losses: Range = Range(
        -0.01,
        0.01,
        "",
        "about 0.02 for E and 0.03 for G: tan δ of spruce 0.007 "
        "along, 0.02 across the grain and in shear (Obataya et al. 2000; Brémaud "
        "et al. 2011), of cane 0.01–0.03 (Obataya 1999, dry to 60 % humidity)",
    )
    temperature: Range = Range(
        0.5,
        0.5,
        "K sd",
        "issue: room of one sweep; moduli of wood fall by "
        "0.2–0.5 % per kelvin (Gerhards 1982, Wood Fiber 14:4)",
    )
    air: Range = Range(-0.03, 0.03, "relative", "density of air, 960–1030 hPa and 18–25 °C")
    # Drive
    loudness: Range = Range(-0.3, 0.3, "ln", "sensitivity of tweeters, ±2.6 dB")
    breakup: Range = Range(0.2, 0.6, "", "heights of three resonances above 8 kHz, Q 3–20 (issue)")
    travelling: Range = Range(0.1, 0.4, "", "part of the pressure that travels (issue, no figure)")
    lateral: Range = Range(-0.3, 0.3, "mm", "placing of the reed on the mouthpiece (paper, fig. 3)")
    leakage: Range = Range(0.0, 0.05, "", "pressure that gets past the rails to the bark side")
    gain: Range = Range(0.005, 0.005, "relative sd per step", "issue")
    # Light
    renewal: Range = Range(
        0.01,
        0.025,
        "of the field per step",
        "issue: rms of what is new over rms of the field; correlation 0.97–0.94 over a sweep",
    )
    drift: Range = Range(
        0.003, 0.006, "relative sd per step", "smooth changes of the field (issue)"
    )
    path: Range = Range(0.4, 0.4, "rad sd per step", "issue")
    path_frames: Range = Range(0.1, 0.1, "rad sd within four frames", "issue")
    laser: Range = Range(0.002, 0.002, "relative sd per frame", "issue")
    illumination: Range = Range(-8, 8, "mm", "centre of the illuminating beam (issue, no figure)")
    reference: Range = Range(-1.5, 1.5, "mm", "centre of the reference on the sensor (issue)")
    reference_tilt: Range = Range(-1e-4, 1e-4, "rad", "0.1 mm of the image at 1 m")
    # Camera
    jitter: Range = Range(5e-6, 2e-5, "s sd", "start of exposures of free-running cameras")
    uniformity: Range = Range(0.005, 0.01, "relative sd", "PRNU (issue; EMVA 1288 data sheets)")
    read_noise: Range = Range(6, 10, "e", "CCD cameras of 12 bits (EMVA 1288 data sheets)")
    row_noise: Range = Range(1, 2, "e", "issue")
    lag: Range = Range(0.0005, 0.002, "of the frame before", "CCD and CMOS sensors, < 0.2 %")
    bend: Range = Range(0.002, 0.002, "of full well", "issue: non-linearity of 0.2 %")


@dataclass(frozen=True)
class Clamp:
    """Strips of the ligature.

    Attributes
    ----------
    front_mm, tilt_mm_per_mm : float
        Shift of the front edge to the butt, and its slope across the reed.
    bed_n_per_mm3 : float
        Stiffness of the bed under the strips per area; 0 for strips on which nothing moves.
    sides : (float, float)
        Stiffness of the bed under the left strip, y > 0, and the right one, over `bed_n_per_mm3`.
    """

    front_mm: float = 0.0
    tilt_mm_per_mm: float = 0.0
    bed_n_per_mm3: float = 0.0
    sides: tuple[float, float] = (1.0, 1.0)


@dataclass(frozen=True)
class Thickness:
    """Deviations of the vamp from the drawing.

    Attributes
    ----------
    offset_um, slope_um_per_mm : float
        Everywhere; and growing to the left side, y > 0.
    map_um : tuple of rows, or None
        Deviations on an even grid of 0 ≤ x ≤ 36 mm (rows) and |y| ≤ 7 mm.
    """

    offset_um: float = 0.0
    slope_um_per_mm: float = 0.0
    map_um: tuple[tuple[float, ...], ...] | None = None


@dataclass(frozen=True)
class Patch:
    """A small spot of the vamp that carries a mass or touches something.

    Attributes
    ----------
    x_mm, y_mm, radius_mm : float
        The spot has a Gaussian profile of this standard deviation.
    mass_t : float
        Mass that moves along, in tonnes.
    spring_n_per_mm, loss : float
        Stiffness and loss factor of what it leans on.
    """

    x_mm: float
    y_mm: float
    radius_mm: float
    mass_t: float = 0.0
    spring_n_per_mm: float = 0.0
    loss: float = 0.0


@dataclass(frozen=True)
class Crack:
    """A crack along the grain, as a narrow band that carries less stress across the grain.

    Attributes
    ----------
    x_mm, y_mm : float
        Its end on the side of the tip.
    length_mm, width_mm : float
        Of the band; across the grain it has a Gaussian profile.
    lost : float
        Part of the stiffness across the grain that is lost in the middle of the band.
    """

    x_mm: float
    y_mm: float
    length_mm: float
    width_mm: float
    lost: float

    def keeps(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the square root of the stiffness across the grain that is left at points."""
        across = np.exp(-0.5 * ((y - self.y_mm) / (0.5 * self.width_mm)) ** 2)
        along = (x > self.x_mm) & (x < self.x_mm + self.length_mm)
        return np.asarray(np.sqrt(1 - self.lost * across * along))


@dataclass(frozen=True)
class Flaws:
    """What a reed may have that its drawing does not show.

    Attributes
    ----------
    crack : Crack or None
    patches : tuple of Patch
    air_inertia : float
        Air that moves along with the reed, over that of a plate in free air.
    """

    crack: Crack | None = None
    patches: tuple[Patch, ...] = ()
    air_inertia: float = 1.0


@dataclass(frozen=True)
class ReedParameters:
    """One reed in its clamp, in one sweep."""

    cane: Cane = Cane()
    thickness: Thickness = Thickness()
    clamp: Clamp = Clamp()
    air: float = 1.0
    """Density of the air over that at 20 °C and 1013 hPa."""
    flaws: Flaws = Flaws()


@dataclass(frozen=True)
class DriveParameters:
    """Loudspeaker and chamber."""

    # Chosen: on the ramp of series A, F1 of the mean reed then moves by 0.6 µm and T1 by 1.4 µm;
    # the paper speaks of the fifth bright fringe (0.77 µm) and the tenth (1.6 µm).
    pascal_per_volt: float = 0.2
    highpass_hz: float = 900.0
    lowpass_hz: float = 17_000.0
    breakup: tuple[tuple[float, float, float], ...] = ()
    """Frequency in Hz, Q and height at resonance of each resonance of the membrane."""
    # The line that the paper found with all reeds, and a Q and height at which it is seen.
    cavity: tuple[float, float, float] = (4308.6, 20.0, 0.35)
    travelling: float = 0.0
    leakage: complex = 0.0
    lateral_mm: float = 0.0
    # Width of the chamber at the window of a clarinet mouthpiece, and how much pressure is left on
    # the rails ("probably lower than the pressure acting on the rest of the vamp", paper).
    chamber_half_mm: float = 5.6
    on_rails: float = 0.3
    # What gets through the clay of series A.
    through_clay: float = 0.1
    gain_sd: float = 0.0


@dataclass(frozen=True)
class LightParameters:
    """Beams and paths."""

    renewal: float = 0.0
    drift_sd: float = 0.0
    path_sd_rad: float = 0.0
    path_frames_rad: float = 0.0
    laser_sd: float = 0.0
    illumination_mm: tuple[float, float] = (0.0, 0.0)
    # Beams of 1/e² radius that light the 38 mm of the vamp, and the sensor of 8.6 mm, unevenly.
    illumination_radius_mm: float = 32.0
    reference_mm: tuple[float, float] = (0.0, 0.0)
    reference_tilt_rad: tuple[float, float] = (0.0, 0.0)
    reference_radius_mm: float = 9.0
    # Mean of the reference at its peak, and of the object's light over that.
    reference_e: float = 9000.0
    object_share: float = 0.01
    # Cells of the image that one scatterer stands for: speckle of points is Gaussian from about 4.
    scatterers_per_cell: float = 4.0


@dataclass(frozen=True)
class CameraParameters:
    """Sensor; an ideal one by default, but for shot noise, read noise and 12 bits."""

    electrons_per_dn: float = 5.0
    full_well_e: float = 20_000.0
    offset_dn: float = 60.0
    read_noise_e: float = 6.0
    row_noise_e: float = 0.0
    uniformity: float = 0.0
    lag: float = 0.0
    bend: float = 0.0
    jitter_s: float = 0.0


@dataclass(frozen=True)
class BenchParameters:
    """One bench in one sweep."""

    drive: DriveParameters = DriveParameters()
    light: LightParameters = LightParameters()
    camera: CameraParameters = CameraParameters()


def draw_reed(disorder: Disorder, series: str, seed: int) -> ReedParameters:
    """Draw a reed: what differs between its series A and B is temperature, dryness and clamping."""
    rng = np.random.default_rng([seed, 1])
    components = disorder.components.draw(rng) * _physical_components(rng)
    relative = disorder.constants.draw(rng) * rng.standard_normal(7)
    E_T, E_R, G_LR, G_TR, nu_LT, nu_LR, nu_TR = (float(each) for each in np.exp(relative))
    density = float(np.exp(disorder.density.draw(rng) * rng.standard_normal()))
    losses = disorder.losses.draw(rng), disorder.losses.draw(rng)
    thickness = Thickness(
        disorder.vamp_offset.draw(rng),
        disorder.thickness_slope.draw(rng),
        _smooth_map(rng, disorder.thickness_map.draw(rng)),
    )
    per_kelvin = -float(rng.uniform(0.002, 0.005))
    rng = np.random.default_rng([seed, 2, ord(series[0])])
    base = Cane()
    cane = Cane(
        components=_four(components),
        dryness=1.0 if series == "B" else 0.0,
        E_T=base.E_T * E_T,
        E_R=base.E_R * E_R,
        G_LR=base.G_LR * G_LR,
        G_TR=base.G_TR * G_TR,
        nu_LT=base.nu_LT * nu_LT,
        nu_LR=base.nu_LR * nu_LR,
        nu_TR=base.nu_TR * nu_TR,
        density=base.density * density,
        loss_E=base.loss_E + losses[0],
        loss_G=base.loss_G + losses[1],
        temperature_c=base.temperature_c
        + disorder.temperature.draw(rng) * float(rng.standard_normal()),
        per_kelvin=per_kelvin,
    )
    bed_mm = disorder.clamp_bed.draw(rng)
    clamp = Clamp(
        disorder.clamp_front.draw(rng),
        disorder.clamp_tilt.draw(rng),
        _PLASTIC_MPA / bed_mm if bed_mm else 0.0,
    )
    return ReedParameters(cane, thickness, clamp, 1 + disorder.air.draw(rng))


def draw_bench(disorder: Disorder, seed: int) -> BenchParameters:
    """Draw loudspeaker, chamber, beams and camera."""
    rng = np.random.default_rng([seed, 3])
    d = disorder
    drive, light, camera = DriveParameters(), LightParameters(), CameraParameters()
    residue = d.breakup.draw(rng)
    breakup = tuple(
        (float(hz), float(rng.uniform(3, 20)), residue * float(rng.choice([-1.0, 1.0])))
        for hz in rng.uniform(8000, 20_000, 3)
    )
    return BenchParameters(
        replace(
            drive,
            pascal_per_volt=drive.pascal_per_volt * float(np.exp(d.loudness.draw(rng))),
            breakup=breakup if residue else (),
            travelling=d.travelling.draw(rng),
            leakage=d.leakage.draw(rng) * complex(np.exp(1j * rng.uniform(0, 2 * np.pi))),
            lateral_mm=d.lateral.draw(rng),
            gain_sd=d.gain.draw(rng),
        ),
        replace(
            light,
            renewal=d.renewal.draw(rng),
            drift_sd=d.drift.draw(rng),
            path_sd_rad=d.path.draw(rng),
            path_frames_rad=d.path_frames.draw(rng),
            laser_sd=d.laser.draw(rng),
            illumination_mm=(d.illumination.draw(rng), d.illumination.draw(rng) / 2),
            reference_mm=(d.reference.draw(rng), d.reference.draw(rng)),
            reference_tilt_rad=(d.reference_tilt.draw(rng), d.reference_tilt.draw(rng)),
        ),
        replace(
            camera,
            read_noise_e=d.read_noise.draw(rng),
            row_noise_e=d.row_noise.draw(rng),
            uniformity=d.uniformity.draw(rng),
            lag=d.lag.draw(rng),
            bend=d.bend.draw(rng),
            jitter_s=d.jitter.draw(rng),
        ),
    )


# Young's modulus of hard plastics (ABS, polycarbonate: 2.0–2.4 GPa, data sheets).
_PLASTIC_MPA = 2000.0
# Correlation lengths of the thickness along and across the reed, mm (issue).
_CORRELATION_MM = (8.0, 4.0)
# Beyond this, H4's springs of some reeds turn negative (1.7 % of draws, READING.md); 2.2 standard
# deviations keep 97 % of each component.
_LARGEST_COMPONENT = 2.2


def _physical_components(rng: np.random.Generator) -> NDArray[np.float64]:
    while True:
        drawn = rng.standard_normal(4)
        springs = [z.arm > 0.2 * z.relaxed for z in Cane(components=_four(drawn)).zener()]
        dry = [z.arm > 0.1 * z.relaxed for z in Cane(components=_four(drawn), dryness=1).zener()]
        if np.abs(drawn).max() < _LARGEST_COMPONENT and all([*springs, *dry]):
            return drawn


def _four(values: Sequence[float] | NDArray[np.float64]) -> tuple[float, float, float, float]:
    e1, e2, e3, e4 = (float(value) for value in values)
    return e1, e2, e3, e4


def _smooth_map(rng: np.random.Generator, rms_um: float) -> tuple[tuple[float, ...], ...] | None:
    """Draw a smooth random map with Gaussian correlation."""
    axes = [
        (np.linspace(0, 36, 37), _CORRELATION_MM[0]),
        (np.linspace(-7, 7, 29), _CORRELATION_MM[1]),
    ]
    roots = []
    for points, length in axes:
        covariance = np.exp(-0.5 * ((points[:, None] - points) / length) ** 2)
        values, vectors = np.linalg.eigh(covariance)
        roots.append(vectors * np.sqrt(np.maximum(values, 0)))
    noise = rng.standard_normal((37, 29))
    if not rms_um:
        return None
    return tuple(map(tuple, rms_um * roots[0] @ noise @ roots[1].T))
