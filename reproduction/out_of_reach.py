"""Printed numbers that nothing in the text leads to."""

from collections.abc import Iterator
from typing import Final

from fitting.paper.printed import Printed
from reproduction.rows import (
    Group,
    Row,
    not_reproducible,
)

_REEDS: Final = "the frequencies of the 55 reeds are not printed one by one"
_H5: Final = "of H5, whose coefficients are not printed"


def list_out_of_reach(numbers: Printed) -> Group:
    """List what cannot be had, with the reason."""
    return Group(
        "out_of_reach",
        "What the text does not suffice for",
        "Numbers that need what is not printed: the 55 reeds one by one, their nominal strengths, "
        "the coefficients of hypothesis H5, the paper's computer.",
        (
            *_h5_rows(numbers),
            *_residual_rows(numbers),
            *_observation_rows(numbers),
        ),
    )


def _h5_rows(numbers: Printed) -> Iterator[Row]:
    for table, printed in (
        ("Table 6", numbers.young_modulus_mean_sd),
        ("Table 7", numbers.shear_modulus_mean_sd),
    ):
        for case, by_key in printed.items():
            if not case.startswith("H5"):
                continue
            for key, pair in by_key.items():
                name, _, unit = key.rpartition("_")
                for words, value in zip(("mean", "SD"), pair, strict=True):
                    quantity = f"{name.replace('_4kHz', ' at 4 kHz')}, H5, series {case[-1]}: "
                    yield not_reproducible(table, quantity + words, value, unit, _H5)
    for pair_of_modes, value in numbers.flexural_correlations["H5"].items():
        yield not_reproducible("TableCorr", f"{pair_of_modes}, H5", value, "", _H5)


def _residual_rows(numbers: Printed) -> Iterator[Row]:
    """What the paper found in the residuals of H5."""
    text, where = numbers.text, "Results"
    for n, loadings in enumerate(numbers.residual_loadings, 1):
        fraction = text[f"residual_factor_{n}_percent"]
        yield not_reproducible(where, f"residual factor {n}: fraction", fraction, "%", _H5)
        for name, value in loadings.items():
            yield not_reproducible(where, f"residual factor {n} with {name}", value, "", _H5)
    for coefficient, increases in (
        ("a_m2", numbers.increase_of_a2_percent),
        ("a_m1", numbers.increase_of_a1_percent),
    ):
        for mode, value in increases.items():
            yield not_reproducible(where, f"adjustment of {coefficient}, {mode}", value, "%", _H5)
    for words, key in (
        ("H5, a_m2 of T1 to T4 adjusted", "a2_rmsd_cents"),
        ("H5, a_m1 and a_m2 adjusted", "a1_a2_rmsd_cents"),
        ("H4, a_m1 and a_m2 adjusted", "h4_a1_a2_rmsd_cents"),
    ):
        yield not_reproducible(where, f"RMSD of {words}", text[key], "cents", _REEDS)


def _observation_rows(numbers: Printed) -> Iterator[Row]:
    text = numbers.text
    for words, key in (
        ("above 0.9", "pairs_above_0_9"),
        ("from 0.8 to 0.9", "pairs_above_0_8"),
        ("from 0.7 to 0.8", "pairs_above_0_7"),
        ("below 0.7", "pairs_below_0_7"),
    ):
        yield not_reproducible(
            "appendix on statistics", f"pairs of variables that correlate {words}", text[key], "",
            "of 28 variables, of which Eq. 1 has 22",
        )  # fmt: skip
    for words, key in (("least", "mass_loss_least_percent"), ("most", "mass_loss_most_percent")):
        yield not_reproducible(
            "Experimental protocol", f"loss of mass of the reeds, {words}", text[key], "%",
            "measured; density is held constant in the model",
        )  # fmt: skip
    two_series = 2 * numbers.reed_sample.reeds * text["holograms"]
    yield not_reproducible(
        "Mode identification", "holograms of the study, more than", text["holograms_total"], "",
        f"two series make {two_series:.0f}; those of preliminary studies are not counted",
    )  # fmt: skip
    yield not_reproducible(
        "Holographic setup", "time of a series", text["minutes"], "min",
        "the frame rate of the camera is not printed",
    )  # fmt: skip
    yield not_reproducible(
        "Modeling the reed", "points of the mesh", text["mesh_points"], "",
        "the mesher of a commercial program; see the paper's mesh for others of that size",
    )  # fmt: skip
    yield not_reproducible(
        "Modeling the reed", "time of a finite-element solution", text["mesh_seconds"], "s",
        "another computer",
    )  # fmt: skip
    yield not_reproducible(
        "Metamodel", "finite elements cost more than Eq. 1, times", text["cost_ratio"], "",
        "another computer",
    )  # fmt: skip
    yield not_reproducible(
        "Experimental protocol", "quasi-static picture", numbers.sweep.quasi_static_picture_hz,
        "Hz", "chosen by hand",
    )  # fmt: skip
