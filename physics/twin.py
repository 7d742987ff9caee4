"""Parameters of the model of a bench with a reed, as the diagnosis uses them.

The defaults are those of the nominal model. An effect changes a few of them.
"""

from dataclasses import dataclass, field, replace
from typing import Any

from physics.mechanics import Alteration, Mechanics


@dataclass(frozen=True)
class DriveChain:
    """Drive chain: from volts to the pressure on the reed.

    Attributes
    ----------
    compression : float
        Fraction of the pressure that is lost at 16 V and low frequency, where the coil moves most.
    compression_hz : float
        Frequency above which the coil moves less.
    roll_off : float
        10 kHz divided by the corner frequency of the amplifier's second-order low-pass.
    resonance_excess : float
        Relative change of the strength of the known acoustic resonance of the excitation device.
    resonance_quality, resonance_shift : float
        Natural logarithms of the factors on its quality and on its frequency.
    bypass : (float, float)
        Real and imaginary part of the pressure that reaches the reed on another path, relative to
        the direct one.
    second_strength, second_hz, second_quality : float
        Strength, frequency and quality of a second acoustic resonance.
    open_right : float
        Fraction of the pressure that reaches the half of the chamber that clay should fill.
    """

    compression: float = 0.0
    compression_hz: float = 5e3
    roll_off: float = 0.0
    resonance_excess: float = 0.0
    resonance_quality: float = 0.0
    resonance_shift: float = 0.0
    bypass: tuple[float, float] = (0.0, 0.0)
    second_strength: float = 0.0
    second_hz: float = 7e3
    second_quality: float = 30.0
    open_right: float = 0.0


@dataclass(frozen=True)
class Clocks:
    """Errors of frequencies and clocks.

    Attributes
    ----------
    detuning_hz : float
        Error of the difference frequency of the two modulators.
    detuning_hz_h : float
        Growth of this error per hour.
    generator_ppm : float
        Relative error of the generator's clock compared with the synthesizers' clock, in ppm.
    lost_fraction : float
        Fraction of acquisitions with a lost or repeated frame.
    """

    detuning_hz: float = 0.0
    detuning_hz_h: float = 0.0
    generator_ppm: float = 0.0
    lost_fraction: float = 0.0


@dataclass(frozen=True)
class OpticsParameters:
    """Parameters of both beams, from the laser to the sensor.

    Attributes
    ----------
    walk_rad_s : float
        Random walk of the phase between the beams, in rad per square root of a second.
    jitter_rad : float
        Standard deviation of additional random changes of this phase from frame to frame.
    quarter_error_rad : float
        Phase error of every second phase step.
    fade_per_h : float
        Relative loss of the laser's power per hour.
    hop, hop_time_fraction : float
        Relative loss of fringe contrast by a laser mode hop, and its time as a fraction of the
        campaign.
    decorrelation_per_rad2 : float
        Loss of contrast per square of the phase amplitude.
    leak, crosstalk : float
        Relative amplitude of the carrier, and of the next sideband, in the image of each sideband.
    shift_m : (float, float)
        Displacement of the local oscillator's centre on the sensor, along rows and columns (y, x).
    waist_m : float
        1/e² radius of the local oscillator on the sensor.
    vignette : float
        Fraction of the light that is lost in the corners.
    defocus_m : float
        Error of the distance at which images are focused.
    """

    walk_rad_s: float = 0.05
    jitter_rad: float = 0.0
    quarter_error_rad: float = 0.0
    fade_per_h: float = 0.0
    hop: float = 0.0
    hop_time_fraction: float = 0.5
    decorrelation_per_rad2: float = 0.0
    leak: float = 0.0
    crosstalk: float = 0.0
    shift_m: tuple[float, float] = (0.0, 0.0)
    waist_m: float = 15e-3
    vignette: float = 0.0
    defocus_m: float = 0.0


@dataclass(frozen=True)
class SensorParameters:
    """Errors of the camera's sensor.

    Attributes
    ----------
    read_factor : float
        Natural logarithm of the read noise divided by that of the data sheet.
    pattern : float
        Standard deviation of the pixels' relative sensitivity, in addition to that of any sensor.
    hot : float
        Fraction of hot pixels.
    nonlinearity : float
        Sensor nonlinearity: relative error of a full pixel, which reads too low.
    """

    read_factor: float = 0.0
    pattern: float = 0.0
    hot: float = 0.0
    nonlinearity: float = 0.0


@dataclass(frozen=True)
class Environment:
    """Influences that change the reed while it is measured.

    Attributes
    ----------
    warming_c_h : float
        Increase of the temperature, in °C per hour.
    loss_per_c : float
        Relative change of the loss factor per °C.
    drying, drying_s : float
        Final dryness (0 as at the start, 1 dry), and the time constant of drying.
    hardening : float
        Relative increase of stiffness at a phase amplitude of 10 rad.
    begun_h : float
        Time from the beginning of these changes to the start of the campaign, in hours.
    """

    warming_c_h: float = 0.0
    loss_per_c: float = 0.01
    drying: float = 0.0
    drying_s: float = 1500.0
    hardening: float = 0.0
    begun_h: float = 0.0


@dataclass(frozen=True)
class FitBias:
    """Errors of the fit of a sweep that confuses the response of a mode with that of the drive.

    A mode at another frequency gives almost the same motion if the frequency response of the drive
    changes around it.

    Attributes
    ----------
    exchanged : tuple of (str, float, float)
        Name of a mode, error of its fitted frequency in cents, and natural logarithm of the factor
        on its fitted loss.
    """

    exchanged: tuple[tuple[str, float, float], ...] = ()

    def of(self, mode: str) -> tuple[float, float]:
        """Return the errors of a mode: frequency in cents, and logarithm of the loss factor."""
        own = [(cents, log) for name, cents, log in self.exchanged if name == mode]
        return sum(cents for cents, _ in own), sum(log for _, log in own)


@dataclass(frozen=True)
class Twin:
    """All parameters of the model of a bench with a reed.

    Attributes
    ----------
    reed : Mechanics
    drive : DriveChain
    clocks : Clocks
    optics : OpticsParameters
    sensor : SensorParameters
    environment : Environment
    fit_bias : FitBias
    """

    reed: Mechanics = field(default_factory=Mechanics)
    drive: DriveChain = DriveChain()
    clocks: Clocks = Clocks()
    optics: OpticsParameters = OpticsParameters()
    sensor: SensorParameters = SensorParameters()
    environment: Environment = Environment()
    fit_bias: FitBias = FitBias()


def more(twin: Twin, part: str, **amounts: float) -> Twin:
    """Return a copy of the parameters with amounts added to some fields.

    Parameters
    ----------
    twin : Twin
    part : str
        Name of an attribute of `Twin`, such as ``beams``.
    **amounts : float
        Amounts to add, by the names of fields of that part.
    """
    if not any(amounts.values()):
        return twin
    old = getattr(twin, part)
    fields: dict[str, Any] = {name: getattr(old, name) + by for name, by in amounts.items()}
    changed: dict[str, Any] = {part: replace(old, **fields)}
    return replace(twin, **changed)


def with_reed(twin: Twin, **changes: Any) -> Twin:
    """Return a copy of the parameters with other values of some fields of the reed."""
    return replace(twin, reed=replace(twin.reed, **changes))


def with_cane(twin: Twin, **more: float) -> Twin:
    """Return a copy of the parameters with amounts added to fields of the reed's `CaneShift`."""
    shift = twin.reed.shift
    changed = {name: getattr(shift, name) + value for name, value in more.items()}
    return with_reed(twin, shift=replace(shift, **changed))


def with_alteration(twin: Twin, kind: Alteration, amount: float) -> Twin:
    """Return a copy of the parameters with one more alteration of the reed."""
    if not amount:
        return twin
    return with_reed(twin, alterations=(*twin.reed.alterations, (kind, amount)))
