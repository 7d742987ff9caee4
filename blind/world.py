"""All that is true of a case, with what is wrong with it: the ground truth that is sealed."""

from dataclasses import dataclass, field

from blind.reed import Build


@dataclass(frozen=True)
class Cane:
    """How the cane depends on frequency, time and level; zeros are a plain reed.

    Attributes
    ----------
    E, G : (float, float, float)
        Rubbery modulus, spring and dashpot of the arm, MPa and MPa·s (paper, hypothesis H4).
    powers : (float, float)
        Exponents of frequency by which E_L and G_LT grow beyond that.
    loss, loss_scatter, loss_power : float
        Loss factor, its relative scatter from mode to mode, and its exponent of frequency.
    tip_kg, side_kg : float
        Spread over the last 2 mm of the tip; stuck to the left side 10 mm from the tip.
    air : float
        Air that moves along, relative to that around a free plate.
    crack_depth_m, crack_m : float, (float, float)
    warming_c_h, drying, drying_s : float
        Temperature's slope; how dry the reed gets, and how fast.
    step_c : float
        Temperature's step at the new clamping.
    hardening : float
        Relative stiffening per square of the phase amplitude of 10 rad.
    lossier : float
        The same of the loss.
    stop_n_m, stop_m : float, (float, float)
        A spring that touches the reed, and where.
    """

    E: tuple[float, float, float] = (10300.0, 7309.0, 0.2822)
    G: tuple[float, float, float] = (694.2, 694.2, 0.02038)
    powers: tuple[float, float] = (0.0, 0.0)
    loss: float = 0.03
    loss_scatter: float = 0.05
    loss_power: float = 0.0
    tip_kg: float = 0.0
    side_kg: float = 0.0
    air: float = 1.0
    crack_depth_m: float = 0.0
    crack_m: tuple[float, float] = (15e-3, 3e-3)
    warming_c_h: float = 0.0
    drying: float = 0.0
    drying_s: float = 1500.0
    step_c: float = 0.0
    hardening: float = 0.0
    lossier: float = 0.0
    stop_n_m: float = 0.0
    stop_m: tuple[float, float] = (25e-3, 0.0)


@dataclass(frozen=True)
class Air:
    """What drives the reed.

    Attributes
    ----------
    pa_v : float
    resonance_hz, resonance_q, corner_hz : float
        Of the loudspeaker.
    ripple, ripple_seed : float, int
        Of its response, nepers, smooth.
    line_hz, line_q, line : float
        The device's own resonance.
    second_hz, second_q, second : float
        Another one.
    field, field_seed : float, int
        Rms of what the pressure differs by from a standing wave, smooth in space and frequency.
    open_right : float
        Share of the pressure on the covered half.
    compression : float
        Share lost at full volts.
    roll_hz : float
        Corner of the amplifier; infinite if good.
    shake : float
        Motion of the clamp, as a share of the tip's at rest, per pressure.
    """

    pa_v: float = 0.45
    resonance_hz: float = 1100.0
    resonance_q: float = 0.7
    corner_hz: float = 14e3
    ripple: float = 0.06
    ripple_seed: int = 0
    line_hz: float = 4308.6
    line_q: float = 25.0
    line: float = 0.12
    second_hz: float = 7000.0
    second_q: float = 40.0
    second: float = 0.0
    field: float = 0.08
    field_seed: int = 0
    open_right: float = 0.0
    compression: float = 0.0
    roll_hz: float = float("inf")
    shake: float = 0.0


@dataclass(frozen=True)
class Clockwork:
    """Frequencies and times.

    Attributes
    ----------
    detuning_hz : float
        Of the modulators' difference.
    scale_ppm : float
        The loudspeaker's generator runs so much faster than the modulators'.
    drift_hz_h : float
        Of the modulators' difference.
    repeats : float
        Share of the acquisitions in which a frame is the one before.
    """

    detuning_hz: float = 0.0
    scale_ppm: float = 0.0
    drift_hz_h: float = 0.0
    repeats: float = 0.0


@dataclass(frozen=True)
class Light:
    """Both beams, from the laser to the sensor.

    Attributes
    ----------
    lo_e_s, object_e_s : float
        Electrons per pixel and second.
    lo_waist_m, lo_shift_m : float, (float, float)
    object_waist_m : float
    gain_scatter, gain_memory : float
        Of the object's light from one acquisition to the next, nepers, and its correlation.
    walk_rad_s : float
        Root of how fast the phase between the beams walks: rad per root second.
    fade_per_h : float
        Share of the laser's power lost per hour.
    hop_at, hop : float
        Share of the campaign after which the fringes' contrast drops, and by how much.
    blur : float
        Loss of contrast per square of the phase amplitude.
    leak : float
        Amplitude of the carrier that leaks into every sideband.
    mixing : float
        Amplitude of the next sideband that leaks in.
    jitter_rad : float
        Of the phase from frame to frame.
    quarter_error_rad : float
        Of the second and fourth frame's phase.
    defocus_m : float
        Error of the distance that images are focused at.
    vignette : float
        Light lost at the sensor's corners.
    flicker : float
        Share by which every other frame is brighter.
    shift_m_h : float
        By which the image moves per hour.
    """

    lo_e_s: float = 80e3
    object_e_s: float = 6000.0
    lo_waist_m: float = 15e-3
    lo_shift_m: tuple[float, float] = (0.0, 0.0)
    object_waist_m: float = 35e-3
    gain_scatter: float = 0.02
    gain_memory: float = 0.5
    walk_rad_s: float = 0.05
    fade_per_h: float = 0.0
    hop_at: float = 2.0
    hop: float = 0.0
    blur: float = 0.0
    leak: float = 0.0
    mixing: float = 0.0
    jitter_rad: float = 0.0
    quarter_error_rad: float = 0.0
    defocus_m: float = 0.0
    vignette: float = 0.0
    flicker: float = 0.0
    shift_m_h: float = 0.0


@dataclass(frozen=True)
class Chip:
    """The camera's sensor.

    Attributes
    ----------
    rows : int
        And columns.
    pixel_m : float
        Side of a pixel.
    gain_e_dn, offset_dn, bits : float, float, int
        Electrons per number, the number of no light, and how many bits numbers have.
    read_e, full_e : float
        Electrons: noise of reading, and what a pixel holds.
    pattern : float
        Relative scatter of the pixels' sensitivity.
    hot, hot_e_s : float
        Share of hot pixels and their dark current.
    bend : float
        Share by which a full pixel reads low.
    banding_e : float
        Noise that a row has in common.
    """

    rows: int = 224
    pixel_m: float = 6.7e-6
    gain_e_dn: float = 4.0
    read_e: float = 12.0
    offset_dn: float = 50.0
    full_e: float = 16000.0
    bits: int = 12
    pattern: float = 0.0
    hot: float = 0.0
    hot_e_s: float = 3000.0
    bend: float = 0.0
    banding_e: float = 0.0


@dataclass(frozen=True)
class World:
    """One laboratory with one reed.

    Attributes
    ----------
    build : Build
    cane : Cane
    air : Air
    clockwork : Clockwork
    light : Light
    chip : Chip
    seed : int
        Of what is random in it.
    """

    build: Build = field(default_factory=Build)
    cane: Cane = field(default_factory=Cane)
    air: Air = field(default_factory=Air)
    clockwork: Clockwork = field(default_factory=Clockwork)
    light: Light = field(default_factory=Light)
    chip: Chip = field(default_factory=Chip)
    seed: int = 0
