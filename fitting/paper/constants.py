"""Numbers printed in the paper that a fit can be asked to use (`--model paper`)."""

import numpy as np

from physics.reed.reduction.metamodel import Equation1

# Table 9: coefficients a_{m,0} … a_{m,5} of Eq. 1 in cents above F6, moduli in MPa.
TABLE_9: dict[str, tuple[float, float, float, float, float, float]] = {
    "F1": (2334.56, -1165877, 0.2763, -21.99, 145883795, -0.000324),
    "T1": (1481.7, -642027, 5.0725, 569.69, 83451520, -0.005886),
    "F2": (3651.79, -1060625, 0.7082, -123.77, 130061359, -0.000786),
    "T2": (2403.82, -493591, 3.813, 501.7, 64716271, -0.003741),
    "X1": (3153.73, -822597, 3.1425, 604.29, 105032670, -0.003785),
    "F3": (4669.87, -1009348, 0.7623, -101.18, 122741172, -0.000877),
    "T3": (3015.77, -275531, 3.5285, 250.0, 29933670, -0.003016),
    "X2": (3874.44, -633268, 2.0921, 589.25, 83462866, -0.001958),
    "X3": (4381.85, -926543, 1.9907, 730.31, 122925338, -0.002593),
    "T4": (2659.08, 588457, 6.6088, -1269.38, -120493740, -0.005269),
    "F4": (6450.01, -1689363, -2.5544, 1282.75, 247738162, 0.001631),
}

# Hypothesis H4: adjustment of a_{m,0} in cents (see decision 0003 for the order of F3 and T3).
H4_ADJUSTMENT_CENTS: dict[str, float] = {
    "F1": -26.27,
    "T1": 32.24,
    "F2": -50.05,
    "T2": 4.80,
    "X1": -26.87,
    "F3": -65.28,
    "T3": -48.64,
    "X2": 0.07,
    "X3": -52.98,
    "T4": -76.61,
    "F4": -111.55,
}

# Table 1, series A and B: where the paper's iteration over frequency starts.
MEAN_HZ: dict[str, tuple[float, float]] = {
    "F1": (1996, 1960),
    "T1": (3377, 3436),
    "F2": (5130, 4856),
    "T2": (6108, 6193),
    "X1": (6869, 6801),
    "F3": (10146, 9213),
    "T3": (9571, 9590),
    "X2": (11521, 11688),
    "X3": (12294, 12290),
    "T4": (14011, 14111),
    "F4": (16784, 15363),
}

# Root mean square deviation of hypothesis H4 on the paper's 55 reeds.
H4_MISFIT_CENTS = 30.4


def adjusted_metamodel(modes: tuple[str, ...]) -> Equation1:
    """Eq. 1 with Table 9 and the adjustments of hypothesis H4."""
    coefficients = np.array([TABLE_9[name] for name in modes])
    coefficients[:, 0] += [H4_ADJUSTMENT_CENTS[name] for name in modes]
    return Equation1(modes, coefficients)
