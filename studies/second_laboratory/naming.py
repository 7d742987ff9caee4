"""Names of modes by the paper's nomenclature, from nodal lines of their shapes."""

import numpy as np
from numpy.typing import NDArray

from studies.second_laboratory.shape import STRIP_FRONT

# (nodal lines along the reed's axis, nodal lines across it) of the paper's figure: F(n+1) = (0, n),
# Tk = (k, 0); X1 … X3 after `reed-model.md`. X4 … X6 by increasing frequency of the drawing, which
# the paper's text does not settle: do not compare them.
_GENERIC = {(1, 1): "X1", (2, 1): "X2", (1, 2): "X3", (1, 3): "X4", (2, 2): "X5", (3, 1): "X6"}
_ORDERS = 6
# A sign that lasts over less than this share of the profile's peak is no change of sign.
_SMALL = 0.08
# Shares of the kinetic energy across, and of the motion of the heel over that of the vamp, above
# which a mode is lateral, and a mode of the heel (`reed-model.md`).
_LATERAL, _HEEL = 0.5, 0.3


def mode_names(
    shapes: NDArray[np.float64],
    along_mm: NDArray[np.float64],
    across: NDArray[np.float64],
    lateral: NDArray[np.float64],
) -> list[str]:
    """Name modes.

    Parameters
    ----------
    shapes : (nx, ny, m) float64
        Displacements along z on even lines x = const from tip to butt.
    along_mm : (nx,) float64
        x of these lines.
    across : (ny,) float64
        y over the half width, −1 … 1.
    lateral : (m,) float64
        Share of the kinetic energy of motion along y.

    Returns
    -------
    list of str
        ``"(k,n)"`` with a number for what the paper has no name for; no name twice.
    """
    legendre = np.polynomial.legendre.legvander(across, _ORDERS - 1)
    legendre /= np.linalg.norm(legendre, axis=0)
    vamp = along_mm < STRIP_FRONT
    profiles = np.einsum("xym,yk->kxm", shapes[vamp], np.linalg.qr(legendre)[0])
    heel = np.sum(shapes[~vamp] ** 2, (0, 1)) / np.sum(shapes[vamp] ** 2, (0, 1))
    names: list[str] = []
    for m in range(shapes.shape[2]):
        energy = np.sum(profiles[:, :, m] ** 2, 1)
        k = int(np.argmax(energy))
        n = _sign_changes(profiles[k, :, m])
        if lateral[m] > _LATERAL:
            name = "L1"
        elif heel[m] > _HEEL and k == 0:
            name = "H1"
        elif k == 0:
            name = f"F{n + 1}"
        elif n == 0:
            name = f"T{k}"
        else:
            name = _GENERIC.get((k, n), f"({k},{n})")
        names.append(name)
    kept = {name: _bearer(name, names, heel) for name in names}
    return [name if kept[name] == m else f"{name}?{m}" for m, name in enumerate(names)]


def _bearer(name: str, names: list[str], heel: NDArray[np.float64]) -> int:
    """Return which of the modes with a name keeps it.

    Flexure of the vamp and of the heel mix where they are close: F(n+1) is the mode whose heel
    moves less. Other names count from low frequencies on.
    """
    bearers = [m for m, each in enumerate(names) if each == name]
    return min(bearers, key=lambda m: heel[m]) if name.startswith("F") else bearers[0]


def _sign_changes(profile: NDArray[np.float64]) -> int:
    large = profile[np.abs(profile) > _SMALL * np.abs(profile).max()]
    return int(np.count_nonzero(np.diff(np.sign(large))))
