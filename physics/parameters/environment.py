"""Parameters of the surroundings: what changes the reed while it is measured."""

from dataclasses import dataclass

from physics.parameters.quantity import quantity

_SORPTION = (
    "Bremaud and Gril, Holzforschung 75 (2021): tan delta is three times as sensitive to moisture "
    "as E'; Obataya and Norimoto, Mokuzai Gakkaishi 41 (1995): in cane it has a maximum at 7 %"
)
_DRY_E = (
    "decision 0023: cane dried to 2 to 4 % less mass is 4 to 25 % softer (paper, series B), wood "
    "about 5 % stiffer (Wood Handbook, chapter 5)"
)
_DRY_G = "decision 0023: 11 to 15 % stiffer (paper, series B), wood about 10 % (Wood Handbook)"
_DRY_ACROSS = (
    "decision 0098: by hypothesis H4 none; wood is some 10 % stiffer across the grain for 3 % less "
    "water (Gerhards, Wood Fiber 14, 4 (1982))"
)
_WARM_ACROSS = (
    "decision 0098: wood of 12 % moisture -7e-3 (Wood Handbook, Table 5-15), dry wood less"
)
_WARM = (
    "decision 0023: the paper's example of an activation energy gives a mean of -3e-3 from 1 to 16 "
    "kHz; wood of 12 % moisture -2.3e-3 (Wood Handbook, Table 5-15)"
)


@dataclass(frozen=True)
class Environment:
    """Influences that change the reed while it is measured.

    Attributes
    ----------
    warming_c_h : float
        Increase of the temperature, in °C per hour.
    warm_E_L, warm_G_LT : float
        Change of the logarithm of a modulus per °C, in addition to the Arrhenius shift.
    warm_as_wood : float
        0 if cane follows the Arrhenius shift, 1 if it follows the law of wood, in which moduli
        along the grain change equally at all frequencies; see `physics.conditions`.
    warm_others : float
        Change of the logarithm of E_T, E_R, G_LR and G_TR per °C.
    warm_loss : float
        Relative change of the loss factor per °C.
    drying : float
        Dryness in the end: 0 as at the start, 1 as much drier as series B is than series A.
    drying_s : float
        Time constant of drying.
    dry_E_L, dry_G_LT : float
        Change of the logarithm of a modulus at dryness 1, in addition to that of hypothesis H4.
    dry_as_wood : float
        The same for the change of E_L by drying: 0 by hypothesis H4, 1 as of wood.
    dry_others : float
        Change of the logarithm of E_T, E_R, G_LR and G_TR at dryness 1.
    dry_loss : float
        Relative change of the loss factor at dryness 1.
    hardening : float
        Relative increase of stiffness at a phase amplitude of 10 rad.
    begun_h : float
        Time from the beginning of these changes to the start of the campaign, in hours.
    """

    warming_c_h: float = quantity(
        0.0, "degC/h", -30.0, 30.0, "laboratories, and reeds next to lamps and lasers"
    )
    warm_E_L: float = quantity(0.0, "1/degC", -5e-3, 5e-3, _WARM)
    warm_G_LT: float = quantity(0.0, "1/degC", -1e-2, 1e-2, _WARM)
    warm_as_wood: float = quantity(0.0, "", -2.0, 3.0, _WARM)
    warm_others: float = quantity(0.0, "1/degC", -2e-2, 2e-2, _WARM_ACROSS)
    warm_loss: float = quantity(
        0.01, "1/degC", -0.05, 0.05, "Weidenfeller et al., Mater. Res. 21, e20170795 (2018)"
    )
    drying: float = quantity(0.0, "", -1.0, 1.0, "paper, series A and B")
    drying_s: float = quantity(
        1500.0, "s", 200.0, 5e4, "diffusion through half a millimetre of cane"
    )
    dry_E_L: float = quantity(0.0, "", -0.5, 0.5, _DRY_E)
    dry_G_LT: float = quantity(0.0, "", -0.5, 0.5, _DRY_G)
    dry_as_wood: float = quantity(0.0, "", -2.0, 3.0, _DRY_E)
    dry_others: float = quantity(0.0, "", -0.5, 0.5, _DRY_ACROSS)
    dry_loss: float = quantity(-0.15, "", -0.6, 0.4, _SORPTION)
    hardening: float = quantity(
        0.0, "", 0.0, 0.1, "clamped plates harden by some per cent at a deflection of a thickness"
    )
    begun_h: float = quantity(0.0, "h", 0.0, 24.0, "before the first run of the campaign")
