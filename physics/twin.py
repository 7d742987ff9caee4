"""The twin's description of a bench and of the reed on it: what it takes for true.

Every field's default is what the nominal twin assumes. An effect replaces a few of them.
"""

from dataclasses import dataclass, field, replace
from typing import Any

from physics.mechanics import Alteration, Mechanics


@dataclass(frozen=True)
class DriveChain:
    """From volts to the pressure on the reed.

    Attributes
    ----------
    compression : float
        Share of the pressure that is lost at 16 V where the coil moves most.
    compression_hz : float
        Above this the coil moves less.
    roll_off : float
        10 kHz over the corner of the amplifier's second-order low-pass.
    line_excess, line_quality, line_shift : float
        What the device's known line is stronger by, a share; of higher quality and higher, as
        logarithms.
    beside : (float, float)
        Real and imaginary part of the share of the pressure that takes another way.
    second_line, second_hz, second_quality : float
        Strength of another resonance of the air, and where.
    open_right : float
        Share of the pressure that reaches the half which clay should cover.
    """

    compression: float = 0.0
    compression_hz: float = 5e3
    roll_off: float = 0.0
    line_excess: float = 0.0
    line_quality: float = 0.0
    line_shift: float = 0.0
    beside: tuple[float, float] = (0.0, 0.0)
    second_line: float = 0.0
    second_hz: float = 7e3
    second_quality: float = 30.0
    open_right: float = 0.0


@dataclass(frozen=True)
class Clocks:
    """What frequencies are beside what they are set to.

    Attributes
    ----------
    detuning_hz : float
        Of the difference of the modulators.
    detuning_hz_h : float
        What that grows by.
    generator_ppm : float
        The drive's clock over the modulators'.
    lost_share : float
        Acquisitions with a frame lost or doubled.
    """

    detuning_hz: float = 0.0
    detuning_hz_h: float = 0.0
    generator_ppm: float = 0.0
    lost_share: float = 0.0


@dataclass(frozen=True)
class OpticsParameters:
    """Both beams, from the laser to the sensor.

    Attributes
    ----------
    walk_rad_s : float
        How fast the phase between the beams walks, rad per root second.
    jitter_rad : float
        Of that phase, from frame to frame.
    quarter_error_rad : float
        Of every other phase step.
    fade_per_h : float
        Share of the laser's power lost.
    hop, hop_share : float
        What fringes lose of their contrast, and at which share of the campaign.
    blur : float
        Contrast lost per square of the phase amplitude.
    leak, mixing : float
        Amplitude of the carrier, and of the next sideband, in every sideband.
    shift_m : (float, float)
        Of the local oscillator's middle, along rows' and columns' numbers.
    waist_m : float
        Of the local oscillator on the sensor.
    vignette : float
        Share of the light lost in the corners.
    defocus_m : float
        Error of the distance that images are focused at.
    """

    walk_rad_s: float = 0.05
    jitter_rad: float = 0.0
    quarter_error_rad: float = 0.0
    fade_per_h: float = 0.0
    hop: float = 0.0
    hop_share: float = 0.5
    blur: float = 0.0
    leak: float = 0.0
    mixing: float = 0.0
    shift_m: tuple[float, float] = (0.0, 0.0)
    waist_m: float = 15e-3
    vignette: float = 0.0
    defocus_m: float = 0.0


@dataclass(frozen=True)
class SensorParameters:
    """The camera's sensor.

    Attributes
    ----------
    read_factor : float
        Read noise over that of the data sheet, log.
    pattern : float
        Rms of the pixels' sensitivity beyond what every sensor has.
    hot : float
        Share of hot pixels.
    bend : float
        Share by which a full pixel reads low.
    """

    read_factor: float = 0.0
    pattern: float = 0.0
    hot: float = 0.0
    bend: float = 0.0


@dataclass(frozen=True)
class Environment:
    """What changes the reed while it is measured.

    Attributes
    ----------
    warming_c_h : float
        Degrees per hour.
    loss_per_c : float
        Relative change of the loss per degree.
    drying, drying_s : float
        Share of the way to a dry reed, and how long that takes.
    hardening : float
        Relative stiffening at a phase amplitude of 10 rad.
    begun_h : float
        How long all this has gone on when a campaign begins.
    """

    warming_c_h: float = 0.0
    loss_per_c: float = 0.01
    drying: float = 0.0
    drying_s: float = 1500.0
    hardening: float = 0.0
    begun_h: float = 0.0


@dataclass(frozen=True)
class FitBias:
    """What fits of sweeps take the drive for a mode by, and the other way round.

    A mode at another frequency, with the drive bent around it to match, moves a reed almost alike.

    Attributes
    ----------
    exchanged : tuple of (str, float, float)
        Mode, cents by which its frequency is told too high, and how much its loss is, a logarithm.
    """

    exchanged: tuple[tuple[str, float, float], ...] = ()

    def of(self, mode: str) -> tuple[float, float]:
        """Cents and logarithm of a mode."""
        own = [(cents, log) for name, cents, log in self.exchanged if name == mode]
        return sum(cents for cents, _ in own), sum(log for _, log in own)


@dataclass(frozen=True)
class Twin:
    """A bench as the twin sees it.

    Attributes
    ----------
    reed : Mechanics
    drive : DriveChain
    clocks : Clocks
    beams : OpticsParameters
    chip : SensorParameters
    surroundings : Environment
    fits : FitBias
    """

    reed: Mechanics = field(default_factory=Mechanics)
    drive: DriveChain = DriveChain()
    clocks: Clocks = Clocks()
    beams: OpticsParameters = OpticsParameters()
    chip: SensorParameters = SensorParameters()
    surroundings: Environment = Environment()
    fits: FitBias = FitBias()


def more(twin: Twin, part: str, **amounts: float) -> Twin:
    """Twin with more of some fields of a part.

    Parameters
    ----------
    twin : Twin
    part : str
        Name of the part.
    **amounts : float
        Added to the fields of these names.
    """
    if not any(amounts.values()):
        return twin
    there = getattr(twin, part)
    fields: dict[str, Any] = {name: getattr(there, name) + by for name, by in amounts.items()}
    changed: dict[str, Any] = {part: replace(there, **fields)}
    return replace(twin, **changed)


def with_reed(twin: Twin, **changes: Any) -> Twin:
    """Twin with other fields of its reed."""
    return replace(twin, reed=replace(twin.reed, **changes))


def with_cane(twin: Twin, **more: float) -> Twin:
    """Twin whose cane's shifts are that much greater."""
    shift = twin.reed.shift
    changed = {name: getattr(shift, name) + value for name, value in more.items()}
    return with_reed(twin, shift=replace(shift, **changed))


def with_alteration(twin: Twin, kind: Alteration, amount: float) -> Twin:
    """Twin whose reed has been altered besides."""
    if not amount:
        return twin
    return with_reed(twin, alterations=(*twin.reed.alterations, (kind, amount)))
