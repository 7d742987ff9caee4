"""What a camera's driver delivers is checked once, before anything else looks at it."""

import math
from collections.abc import Sequence

import numpy as np

from drivers.errors import InstrumentError
from drivers.roles import Frame

_REMEDY = "correct the driver, or name another one in the bench file"


def received(
    frames: Sequence[Frame], changed_s: float, shape: tuple[int, int]
) -> tuple[Frame, ...]:
    """Return the frames of one acquisition as the rest of the program presumes them.

    Parameters
    ----------
    frames : sequence of Frame
        As the driver returned them.
    changed_s : float
        The time that the camera's clock said when the last setting was changed.
    shape : (int, int)
        Rows and columns that were asked for.

    Returns
    -------
    tuple of Frame
        With whole numbers, finite time stamps, and contiguous images of uint16.

    Raises
    ------
    InstrumentError
        If a time is not finite, a number is not whole, or an image has another shape or numbers
        that do not fit into uint16 as they are.
    """
    if not math.isfinite(changed_s):
        raise InstrumentError(f"camera: its clock says {changed_s}, which is no time; {_REMEDY}")
    return tuple(_received(frame, shape) for frame in frames)


def _received(frame: Frame, shape: tuple[int, int]) -> Frame:
    # A driver may be anybody's: nothing is presumed of the types.
    number: object = frame.id
    stamp_s: object = frame.timestamp_s
    image = np.asarray(frame.image)
    if not isinstance(number, int | np.integer):
        raise InstrumentError(
            f"camera: delivered a frame of number {number!r}, which is not whole; {_REMEDY}"
        )
    if not (isinstance(stamp_s, int | float | np.number) and math.isfinite(float(stamp_s.real))):
        raise InstrumentError(
            f"camera: frame {number} has the time stamp {stamp_s!r}, which is no time; {_REMEDY}"
        )
    if image.shape != shape:
        raise InstrumentError(
            f"camera: frame {number} has the shape {image.shape}, but {shape} was asked for; "
            f"{_REMEDY}"
        )
    # Unsigned bytes fit; signed or real numbers might not, and would change without a word.
    if not (image.dtype.kind == "u" and np.can_cast(image.dtype, np.uint16)):
        raise InstrumentError(
            f"camera: frame {number} holds {image.dtype} instead of uint16; {_REMEDY}"
        )
    return Frame(int(number), float(stamp_s.real), np.ascontiguousarray(image, dtype=np.uint16))
