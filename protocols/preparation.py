"""Preparation of the bench: the reed, its state and the excitation chamber."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from physics.reed.cane.material import Cane
    from physics.reed.geometry import ReedGeometry


@dataclass(frozen=True, slots=True)
class Preparation:
    """The reed on the bench and how it is excited.

    Attributes
    ----------
    reed : str
        Unique name of this reed.
    series : str
        Series of measurements; the reed of series B is dried.
    chamber : {'asymmetric', 'symmetric'}
        Whether the right half of the mouthpiece's chamber is filled.
    geometry : ReedGeometry or None
        Shape and clamp of reeds of this kind; the paper's clarinet reed if None.
    constants : Cane or None
        Elastic constants and density that all reeds of this kind share, all but E_L and G_LT; the
        paper's reference material if None.
    """

    reed: str
    series: str
    chamber: Literal["asymmetric", "symmetric"]
    geometry: "ReedGeometry | None" = None
    constants: "Cane | None" = None
