"""Check frames once when they come from the driver of a camera, before they are used."""

import math
from collections.abc import Sequence

import numpy as np

from drivers.errors import InstrumentError
from drivers.roles import Frame

_REMEDY = "correct the driver, or name another one in the bench file"


def received(
    frames: Sequence[Frame], changed_s: float, shape: tuple[int, int]
) -> tuple[Frame, ...]:
    """Check the frames of one acquisition, and convert them to the types that `Frame` promises.

    Parameters
    ----------
    frames : sequence of Frame
        Frames as the driver returned them.
    changed_s : float
        Time of the last change of a setting on the camera's clock, in s.
    shape : (int, int)
        Requested rows and columns.

    Returns
    -------
    tuple of Frame
        Frames with integer numbers, finite time stamps and C-contiguous uint16 images.

    Raises
    ------
    InstrumentError
        If a time is not finite, a frame number is not an integer, or an image has another shape or
        values that uint16 cannot hold exactly.
    """
    if not math.isfinite(changed_s):
        raise InstrumentError(
            f"camera: its clock returned {changed_s}, which is not a time; {_REMEDY}"
        )
    return tuple(_received(frame, shape) for frame in frames)


def _received(frame: Frame, shape: tuple[int, int]) -> Frame:
    # Drivers may come from other people, so no type is taken for granted.
    number: object = frame.id
    stamp_s: object = frame.timestamp_s
    image = np.asarray(frame.image)
    if not isinstance(number, int | np.integer):
        raise InstrumentError(
            f"camera: delivered a frame of number {number!r}, which is no integer; {_REMEDY}"
        )
    if not (isinstance(stamp_s, int | float | np.number) and math.isfinite(float(stamp_s.real))):
        raise InstrumentError(
            f"camera: frame {number} has the time stamp {stamp_s!r}, which is not a time; {_REMEDY}"
        )
    if image.shape != shape:
        raise InstrumentError(
            f"camera: frame {number} has the shape {image.shape}, but {shape} was asked for; "
            f"{_REMEDY}"
        )
    # Unsigned bytes fit into uint16. Signed or real numbers may not, and numpy would change them
    # without an error.
    if not (image.dtype.kind == "u" and np.can_cast(image.dtype, np.uint16)):
        raise InstrumentError(
            f"camera: frame {number} holds {image.dtype} instead of uint16; {_REMEDY}"
        )
    return Frame(int(number), float(stamp_s.real), np.ascontiguousarray(image, dtype=np.uint16))
