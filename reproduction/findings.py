"""What the comparison comes to, in sentences with the numbers of its rows."""

from collections.abc import Iterable, Mapping

from reproduction.rows import Row


def findings(rows: Iterable[Row]) -> tuple[str, ...]:
    """Sentences on what was found, most important first.

    Parameters
    ----------
    rows : iterable of Row
        Of all groups.
    """
    by_quantity = {row.quantity: row for row in rows}
    sentences = (
        _mesh,
        _sensitivities,
        _misprints,
        _names,
        _curves,
        _divisor,
        _validation,
        _misfit,
    )
    return tuple(sentence(by_quantity) for sentence in sentences)


def _off(row: Row) -> str:
    return f"{row.difference or 0.0:+.0f}".replace("-", "−")


def _ours(row: Row) -> float:
    return row.ours if row.ours is not None else float("nan")


def _mesh(rows: Mapping[str, Row]) -> str:
    off = {name: _off(rows[f"{name}: reference material"]) for name in ("T3", "X3", "T4")}
    best = _ours(rows["rms distance from Table 9, tetrahedra of 1.5 mm"])
    converged = _ours(rows["rms distance from Table 9, converged hexahedra"])
    correlation = _ours(
        rows["correlation of the adjustments of a_m0 with the error of the paper's mesh"]
    )
    return (
        "The finite elements of the paper were stiff: converged ones lie "
        f"{off['T3']}, {off['X3']} and {off['T4']} cents from Table 9 in T3, X3 and T4. "
        f"Tetrahedra of 1.5 mm come, but for a common shift, to within {best:.0f} cents rms of "
        f"Table 9 (converged: {converged:.0f}), and the adjustments of a_m0 correlate with that "
        f"error at {correlation:.2f}."
    )


def _sensitivities(rows: Mapping[str, Row]) -> str:
    shear, false, radial = (rows[f"transversal: {name}"] for name in ("G_LT", "G_TR", "E_R"))
    times = (radial.printed or 0.0) / _ours(radial)
    return (
        f"The same shows in Table 3: transversal modes follow G_LT with {_ours(shear):.3f} "
        f"(printed {shear.printed}), and G_TR with {_ours(false):.4f} (printed {false.printed}). "
        f"The printed sensitivity of that class to E_R, {radial.printed}, is {times:.0f} times "
        "ours, and unexplained."
    )


def _misprints(rows: Mapping[str, Row]) -> str:
    signal = _ours(rows["signal of the first sideband with (f + f_CCD)/4, as printed"])
    return (
        "Misprints: the sideband condition, which as printed leaves "
        f"{100 * signal:.1f} % of the signal; the last identity of Eq. H4b, a sign; 181 pictures "
        "in the caption of Fig. 2, for 184; and the unit of p in the fit to Lord's data."
    )


def _names(rows: Mapping[str, Row]) -> str:
    observed = rows["BX6: mean, by converged finite elements"]
    fractions = observed.remark.partition("; ")[2].partition(", so that")[0]
    return (
        "The paper holds the name of its X6 for uncertain, and rightly. In series B, where it has "
        f"X6 at {observed.printed:.0f} Hz and T5 far above, {fractions}: either name fits either."
    )


def _curves(rows: Mapping[str, Row]) -> str:
    shear = rows["G_LT at F4, series A"]
    return (
        "The storage moduli quoted with the paper's figure are means over the reeds, not those of "
        f"the mean reed: G_LT at F4 of series A is printed {shear.printed:.0f} MPa, populations "
        f"give {_ours(shear):.0f}, {shear.remark.rpartition('; ')[2]}."
    )


def _divisor(rows: Mapping[str, Row]) -> str:
    plain = rows["H1: RMSD over what was observed, from Table 1 alone"]
    divided = rows["H1: RMSD with the divisor of Eq. eq5d, from Table 1 alone"]
    return (
        "The printed RMSD seem to divide by all N·S·M resonances, observed or not: of H1, "
        f"{plain.printed} cents, Table 1 alone leaves {_ours(plain):.1f} cents over what was "
        f"observed, and {_ours(divided):.1f} with that divisor."
    )


def _validation(rows: Mapping[str, Row]) -> str:
    exact = _ours(rows["sum of four fractions, as described"])
    printed = rows["sum of four fractions, as described"].printed
    return (
        "The backward random validation is hardly as described: four components without noise "
        f"leave {exact:.1f} % to four factors, not {printed} %. With noise, and fractions taken "
        "after rotation, its numbers come out."
    )


def _misfit(rows: Mapping[str, Row]) -> str:
    left = rows["RMSD of reconstruction from four factors"]
    h4 = rows["H4: RMSD"]
    return (
        f"Of the {h4.printed} cents that H4 leaves, some {left.printed:.0f} are noise that no "
        "four factors describe; the rest is structure that H4 lacks. It shows in H8, H10 and H11, "
        "in the spread of the generic modes, and in F4 of series B."
    )
