"""Ordinary disorder of a campaign: what a single sweep does not show, and how levels scale it."""

from dataclasses import dataclass

from studies.second_laboratory.parameters import Disorder, Range, Ranges


@dataclass(frozen=True)
class CampaignDisorder(Ranges):
    """Ranges of everything that a campaign has and the table `Disorder` lacks.

    "Chosen" means this author's judgement of such benches.
    """

    # Hands
    haste: Range = Range(-0.25, 0.25, "ln", "time that hands need: chosen, 13 to 18 min in all")
    place: Range = Range(-0.2, 0.2, "mm", "reed in the image: a scale and a stop (chosen)")
    turn: Range = Range(-8e-3, 8e-3, "rad", "0.2 mm over 25 mm of the table's edge (chosen)")
    again_front: Range = Range(0.05, 0.15, "mm sd", "a mark on the ligature, seen by eye (chosen)")
    again_tilt: Range = Range(0.002, 0.008, "mm/mm sd", "0.05 mm over the strips' 7 mm (chosen)")
    again_bed: Range = Range(0.03, 0.12, "ln sd", "screws turned by hand, torque ±20 % (chosen)")
    again_lateral: Range = Range(0.04, 0.12, "mm sd", "reed on the rails, by eye (chosen)")
    # Air
    day: Range = Range(-1.5, 1.5, "K", "air-conditioned laboratories, 20 ± 1.5 °C (chosen)")
    temperature_time: Range = Range(
        600, 2400, "s", "cycles of air conditioning and of doors, 10 to 40 min (chosen)"
    )
    moisture: Range = Range(
        0.01,
        0.04,
        "% of the mass, sd",
        "0.15 % per 1 % of relative humidity (Wood Handbook, FPL-GTR-282, ch. 4), of which thin "
        "cane takes a part within minutes",
    )
    # Drive
    gain_wander: Range = Range(
        0.001, 0.004, "relative sd", "copper 0.39 %/K: a voice coil that warms by about 1 K"
    )
    cavity: Range = Range(
        -0.2, 0.2, "ln", "height and Q of the known resonance: seal of the chamber (chosen)"
    )
    # Light
    level: Range = Range(-0.1, 0.1, "ln", "local oscillator, set by a histogram (chosen)")
    object_level: Range = Range(-0.35, 0.35, "ln", "object's light, from reed to reed (chosen)")
    power_wander: Range = Range(
        0.002, 0.008, "relative sd", "drift of diode and He-Ne lasers, 0.5–2 % in 8 h (data sheets)"
    )
    split_wander: Range = Range(
        0.003, 0.012, "relative sd", "efficiency of both modulators with temperature (chosen)"
    )
    power_time: Range = Range(120, 900, "s", "warming of a laser's housing (chosen)")
    contrast: Range = Range(0.02, 0.15, "lost", "polarisation and path difference (chosen)")
    dust: Range = Range(0.004, 0.012, "relative rms", "dust and fringes of a cover glass (chosen)")
    stray: Range = Range(0, 40, "e in a frame period", "screens and lamps of instruments (chosen)")
    # Lamp of the flat frames
    lamp: Range = Range(0.5, 0.7, "of full well at 80 ms", "chosen below any saturation")
    lamp_slope: Range = Range(0.01, 0.04, "relative, middle to edge", "a lamp at 0.5 m (chosen)")
    lamp_flicker: Range = Range(
        0.001, 0.004, "relative sd per frame", "lamps on stabilised supplies, 0.1–0.5 % (chosen)"
    )
    # Camera
    offset: Range = Range(-6, 6, "dn", "black level, adjusted once (EMVA 1288 data sheets)")
    offset_wander: Range = Range(0.05, 0.2, "dn sd", "black level of a warming camera (chosen)")
    conversion: Range = Range(-0.05, 0.05, "ln", "gain from camera to camera (EMVA 1288: ±5 %)")
    full_well: Range = Range(-0.06, 0.06, "ln", "saturation capacity, typical to ±6 % (chosen)")
    dark_pattern: Range = Range(0.5, 2.0, "e sd", "DSNU of CCD cameras (EMVA 1288 data sheets)")
    dark_current: Range = Range(1, 8, "e/s", "CCD sensors at 20–30 °C (EMVA 1288 data sheets)")
    hot: Range = Range(
        1e-5, 1e-4, "of all pixels", "ten in a million of good sensors, more with age (chosen)"
    )


# Exponents of the amount, by field. What nature or the maker of the reed decides does not follow
# the care of a laboratory (0); what is adjusted once grows slowly (0.5), as does what a technician
# would notice at once: speckle that ages, phase and power that jitter within a hologram. The rest
# grows in proportion (1): air, slow changes of powers and gains.
_FIXED = (
    "components", "constants", "density", "losses", "clamp_bed", "air", "loudness", "breakup",
    "travelling", "read_noise", "haste", "temperature_time", "day", "cavity", "power_time", "lamp",
)  # fmt: skip
_PROPORTIONAL = (
    "temperature", "gain", "path", "jitter", "moisture", "gain_wander", "power_wander",
    "split_wander", "lamp_flicker", "offset_wander",
)  # fmt: skip
_SLOW = 0.5

LEVELS = {"quiet": 0.5, "ordinary": 1.0, "rough": 2.0}
"""Amounts of disorder by the name of the level; ordinary is the tables as they are."""


def exponent(name: str) -> float:
    """Return the exponent of the amount by which a field of either table is multiplied."""
    return 0.0 if name in _FIXED else 1.0 if name in _PROPORTIONAL else _SLOW


def disorder_at(amount: float) -> tuple[Disorder, CampaignDisorder]:
    """Return both tables for an amount of disorder, 1 for the tables as they are.

    Amounts from 0.3 to 5 are of use: at 5 a bench is far from any that has published.
    """
    tables = Disorder(), CampaignDisorder()
    scaled = [{name: amount ** exponent(name) for name in vars(table)} for table in tables]
    return tables[0].scaled(scaled[0]), tables[1].scaled(scaled[1])
