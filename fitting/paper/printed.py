"""The numbers that the paper prints, as data: `printed.yaml`."""

from functools import cache
from importlib.resources import files
from typing import Final

import yaml
from pydantic import BaseModel, ConfigDict

Pair = tuple[float, float]
# Names of the elastic constants in Table 3, and what they are called elsewhere in this software.
TABLE_3_CONSTANTS: Final = {
    "EL": "E_L",
    "GLT": "G_LT",
    "ET": "E_T",
    "GLR": "G_LR",
    "ER": "E_R",
    "GTR": "G_TR",
    "nuTR": "nu_TR",
    "nuLT": "nu_LT",
    "nuLR": "nu_LR",
}


class _Numbers(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class PrintedModeStatistics(_Numbers):
    """A mode in a series (Table 1)."""

    identified: int
    mean_hz: float | None = None
    sd_hz: float | None = None
    min_hz: float | None = None
    max_hz: float | None = None


class VampNetwork(_Numbers):
    """Network of points of the vamp (Table 8), mm."""

    columns: tuple[str, ...]
    rows: tuple[tuple[float, float, float, float], ...]


class MetamodelMode(_Numbers):
    """A mode in Eq. 1: number, coefficients, and largest deviations (Table 9)."""

    m: int
    a: tuple[float, ...]
    deviation_cents: Pair


class PrintedMetamodel(_Numbers):
    """Eq. 1."""

    reference_hz: float
    exponent_EL: float
    exponent_GLT: float
    modes: dict[str, MetamodelMode]


class H4(_Numbers):
    """Coefficients of hypothesis H4, and adjustments of a_m0."""

    c10: float
    c20: float
    c30: float
    d10: float
    d12: float
    d20: float
    d30: float
    d41: float
    d60: float
    a_m0_adjustment_cents: dict[str, float]


class Hypothesis(_Numbers):
    """A row of Table 4a."""

    K: int
    model: str
    active: int | None
    other: int
    rmsd_cents: float


class Increase(_Numbers):
    """Increase of a storage modulus from F1 to F4 (tabH4), %."""

    mean: float
    sd: float
    min: float
    max: float


class StorageIncrease(_Numbers):
    """Table tabH4, by series."""

    E_L: dict[str, Increase]
    G_LT: dict[str, Increase]
    correlation_A_B: dict[str, float]


class Shares(_Numbers):
    """Shares of variance of the factors kept, and of the next."""

    variance_percent: tuple[float, ...]
    sum: float
    fourth: float | None = None
    fifth: float | None = None


class BackwardShares(_Numbers):
    """Shares of variance of simulated populations."""

    variance_percent: tuple[float, ...]
    sum: float
    sd: float


class PrincipalComponents(_Numbers):
    """Results of the principal component analyses."""

    both: Shares
    A: Shares
    B: Shares
    variables: int
    reconstruction_rmsd_cents_4_factors: float
    backward_validation: BackwardShares


class ReferenceMaterial(_Numbers):
    """Of the finite elements; MPa and kg/m³."""

    E_L: float
    E_T: float
    E_R: float
    nu_LT: float
    nu_LR: float
    nu_TR: float
    G_LT: float
    G_LR: float
    G_TR: float
    density_kg_m3: float
    units: str


class PrintedSweep(_Numbers):
    """The sweep."""

    reference_hz: float
    step_cents: float
    first_index: int
    last_index: int
    ramp_last_index: int
    volts_start: float
    volts_end: float
    cavity_resonance_index: int
    cavity_resonance_hz: float
    quasi_static_picture_hz: float


class PrintedOptics(_Numbers):
    """The light; bright fringes by order."""

    wavelength_m: float
    aom_hz: float
    bright_fringe_nm: dict[int, float]


class ReedSample(_Numbers):
    """The reeds."""

    model: str
    reeds: int
    by_strength: dict[str, int]


class Printed(_Numbers):
    """All of it; see the comments of the file for where in the paper each part stands."""

    observed_resonances: dict[str, dict[str, PrintedModeStatistics]]
    rotated_loadings: dict[str, tuple[float, float, float, float]]
    sensitivity_oat_10_percent: dict[str, dict[str, float]]
    vamp_thickness_mm: VampNetwork
    metamodel: PrintedMetamodel
    h4: H4
    hypotheses: dict[str, Hypothesis]
    flexural_correlations: dict[str, dict[str, float]]
    young_modulus_mean_sd: dict[str, dict[str, Pair]]
    shear_modulus_mean_sd: dict[str, dict[str, Pair]]
    storage_increase_F1_to_F4_percent: StorageIncrease
    pca: PrincipalComponents
    correlations_A_vs_B: dict[str, float]
    reference_material: ReferenceMaterial
    sweep: PrintedSweep
    optics: PrintedOptics
    reed_sample: ReedSample
    figure_2: dict[str, tuple[int, int]]
    notes_hz: tuple[float, ...]
    storage_moduli_mpa: dict[str, dict[str, Pair]]
    lord: tuple[float, float, float, float]
    increase_of_a2_percent: dict[str, float]
    increase_of_a1_percent: dict[str, float]
    correlations_with_F1: dict[str, float]
    residual_loadings: tuple[dict[str, float], ...]
    text: dict[str, float]


@cache
def printed() -> Printed:
    """Read the numbers."""
    text = (files("fitting.paper") / "printed.yaml").read_text(encoding="utf-8")
    return Printed.model_validate(yaml.safe_load(text))
