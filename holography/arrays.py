"""Types of arrays that all packages use."""

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

# Real numbers of any precision.
Array: TypeAlias = NDArray[np.floating[Any]]
Float32Array: TypeAlias = NDArray[np.float32]
# Complex numbers of any precision.
ComplexArray: TypeAlias = NDArray[np.complexfloating[Any, Any]]
Complex64Array: TypeAlias = NDArray[np.complex64]
Mask: TypeAlias = NDArray[np.bool_]
IndexArray: TypeAlias = NDArray[np.intp]
