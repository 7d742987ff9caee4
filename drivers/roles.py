"""Roles: the methods that every instrument of a role has.

A driver is any class that satisfies one of these protocols; nothing has to be inherited. Every
method may raise `InstrumentError` when the instrument does not answer or does not confirm; what it
may raise in addition, and what it promises, is in its docstring. When the program calls what is on
the page ``docs/reference/driver-interface.md``.
"""

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from fractions import Fraction
from types import TracebackType
from typing import Literal, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from protocols.preparation import Preparation


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One exposure of the camera.

    Attributes
    ----------
    id : int
        Number of the frame since `Camera.start`, from 0, counting those that were never fetched.
    timestamp_s : float
        Start of the exposure on the camera's own clock, see `Camera.now_s`.
    image : (ny, nx) uint16
    """

    id: int
    timestamp_s: float
    image: NDArray[np.uint16]


class Instrument(Protocol):
    """Common part of all instruments."""

    @property
    def identity(self) -> str:
        """Maker, model, serial number and firmware, as the instrument says it, on one line.

        It is known as soon as the instrument is open. Each run file keeps it as it was when the
        run began. It may be read at any time and any number of times, so return a stored text
        and ask the instrument only once.
        """
        ...

    def close(self) -> None:
        """Release the instrument. May be called twice; raises nothing."""
        ...


@runtime_checkable
class SynthesizerPair(Instrument, Protocol):
    """Two channels on one clock: AOM1 shifts the local oscillator, AOM2 the object beam.

    The sign matters. The program sets ``f_AOM1 - f_AOM2 = n f + f_CCD / 4`` to measure sideband n
    of the drive f. If the two outputs are exchanged, every step has the verdict ``lock``.

    A driver may have one more property, ``echoes_registers: bool``. True says that `read_pair`
    returns what was written to the instrument, whether or not the outputs followed; False, that it
    returns what the outputs play. A driver without it counts as True: then only the light can prove
    the lock, and steps with too little light are ``unproven``.
    """

    @property
    def step_hz(self) -> Fraction:
        """Spacing of the frequencies that both channels can play."""
        ...

    def set_pair(self, aom1_hz: Fraction, aom2_hz: Fraction) -> None:
        """Change both channels in one update; returns when the update has been made.

        A frequency off the grid is played at the nearest frequency on it; `read_pair` tells.

        Raises
        ------
        LimitError
            If a frequency lies outside the window; neither channel has changed then.
        InstrumentError
            If the update is not confirmed; the channels are then in an unknown state.
        """
        ...

    def read_pair(self) -> tuple[Fraction, Fraction]:
        """Return the frequencies that both channels play, exactly, as the instrument says.

        Raises
        ------
        InstrumentError
            If the instrument does not answer.
        """
        ...

    def rf_on(self) -> None:
        """Let both modulators diffract; raises `InstrumentError` if that is not confirmed.

        Called at the beginning of every run, also of dark and flat frames.
        """
        ...

    def rf_off(self) -> None:
        """Take the power off both modulators; raises `InstrumentError` if not confirmed.

        May be called from any thread, at any time and more than once.
        """
        ...


@runtime_checkable
class SignalGenerator(Instrument, Protocol):
    """The source of the loudspeaker's voltage. All volts are peak volts at the load."""

    def set_sine(self, frequency_hz: Fraction, volts: float) -> None:
        """Play a sine, and switch the output on if it is off.

        Raises
        ------
        LimitError
            If frequency or volts lie outside the limits or are no finite number; nothing has
            changed then. 0 V is always allowed.
        InstrumentError
            If what is read back is not what was set.
        """
        ...

    def ramp_to(self, volts: float, duration_s: float) -> None:
        """Change the volts gradually, without a click; returns when they are reached.

        On an output that is off, a ramp to 0 V does nothing. It may return before its end is
        confirmed where answers are slow: nothing may hold up `output_off`.

        Raises
        ------
        LimitError
            As for `set_sine`, and for a duration that is negative or not finite.
        InstrumentError
            If the output is off and `volts` is not 0, or the end is not confirmed.
        """
        ...

    def output_off(self) -> None:
        """Disconnect the output at once; raises `InstrumentError` if that is not confirmed.

        May be called from any thread, at any time and more than once.
        """
        ...

    def read(self) -> tuple[Fraction, float, bool]:
        """Return frequency in Hz, volts, and whether the output is on, as the instrument says.

        Raises
        ------
        InstrumentError
            If the instrument does not answer.
        """
        ...


@runtime_checkable
class Camera(Instrument, Protocol):
    """A camera that runs freely on its own clock from `start` to `stop`."""

    @property
    def saturation_dn(self) -> int:
        """Number at which a pixel stops growing with light: the lesser of full well and ADC.

        State what this camera really does, which may be less than its data sheet says: if the
        number is too high, saturated pixels are not recognised. It is known as soon as the camera
        is open, before `configure`, and does not change during a run.
        """
        ...

    def configure(
        self, frame_rate_hz: Fraction, exposure_s: Fraction, shape: tuple[int, int]
    ) -> None:
        """Set the camera up for a run, while it is stopped.

        Called at the beginning of a run, after a pause or a failure, and in the middle of a run
        before each step with another exposure; always followed by `start`.

        Parameters
        ----------
        frame_rate_hz : Fraction
        exposure_s : Fraction
            At most the frame period.
        shape : (int, int)
            Rows and columns ``(ny, nx)`` of the middle part of the sensor to be read out.

        Raises
        ------
        LimitError
            If the camera cannot do this; nothing has changed then.
        InstrumentError
            If the camera is running.
        """
        ...

    def start(self) -> None:
        """Begin to take frames; raises `InstrumentError` if the camera is not configured.

        Frame numbers begin again at 0, the clock of the camera does not.
        """
        ...

    def stop(self) -> None:
        """Take no more frames. Does nothing to a stopped camera.

        May be called from any thread, at any time and more than once.
        """
        ...

    def grab(self, count: int, not_before_s: float) -> list[Frame]:
        """Return the next `count` frames, and wait for those that have not come yet.

        The camera keeps unread frames for at least a second: instruments may
        be read while it exposes.

        Parameters
        ----------
        count : int
        not_before_s : float
            On the camera's clock, see `now_s`. Exposures that began earlier are passed over.

        Returns
        -------
        list of Frame
            In the order of their exposures. The frames are consecutive unless one was lost on
            its way, which is no error here: their ids show it.

        Raises
        ------
        InstrumentError
            If the camera is stopped or no frame arrives.
        """
        ...

    def now_s(self) -> float:
        """Return the present time on the clock of `Frame.timestamp_s`.

        The zero is arbitrary. It must not change while the camera is open, because a diagnosis
        computes drifts from the time stamps of a whole run.
        """
        ...


@runtime_checkable
class Clock(Protocol):
    """The time that passes on a bench: that of the wall, or of a simulation.

    Real instruments need none: the program takes that of the wall. A simulator may put a clock of
    its own into `drivers.context.BenchContext.clock`. Then simulated time passes only in `wait`,
    which the program calls while a setting settles, and drivers call for all that takes time.
    """

    def now_s(self) -> float:
        """Return the time since some moment before the bench was opened."""
        ...

    def date(self) -> datetime:
        """Return date and time in UTC, by which runs of one bench are put in order.

        They pass as `now_s` does, so that drifts from run to run have their true rates. They must
        not go back when the bench is opened again, or the parts of a resumed campaign are put
        into the wrong order.
        """
        ...

    def wait(self, seconds: float) -> None:
        """Return `seconds` later; at once if that is not positive.

        May be called from several threads at once: outputs are switched off on threads.
        """
        ...


class Arrangement(StrEnum):
    """Light on the sensor."""

    HOLOGRAMS = "holograms"
    DARK = "dark"
    FLAT = "flat"
    LO_ONLY = "lo_only"
    OBJECT_ONLY = "object_only"


class Surroundings(Protocol):
    """Shutters, lamp and clamp of a bench that a program can operate.

    Both methods are called while all outputs are off and the camera is stopped. They may take any
    time; a second Ctrl-C raises KeyboardInterrupt in them. They may raise `InstrumentError`: the
    run, or the rest of a campaign, is then not measured and can be resumed.

    An object may have one more property, ``stays_clamped: bool``. True says that the reed stays in
    its clamp when the program ends, as on a real bench. Without it, or with False, a resumed
    campaign calls `clamp_again` once more for each part that was begun after a new clamping:
    this is how a simulated reed gets back to where it was.
    """

    def arrange(self, arrangement: Arrangement) -> None:
        """Change the light on the sensor until the next call.

        A bench that was just opened is arranged for holograms.
        """
        ...

    def clamp_again(self) -> None:
        """Take the reed out of its clamp, and put it back."""
        ...


RoleName = Literal["synthesizers", "generator", "camera"]


@dataclass
class Bench:
    """Three open instruments, a clock, and what they stand for.

    Attributes
    ----------
    name, fingerprint : str
        Of the bench file.
    preparation : Preparation
    seed : int
        From which everything random on this bench is drawn.
    surroundings : Surroundings or None
        None where a person has to change them.
    simulated_disorder : str
        What a simulated bench is really like, as JSON, for the run file; empty without disorder.
    reopen : callable or None
        Given a role, opens its instrument once more; None where that is not possible.
    release : callable or None
        Frees, after the instruments are closed, what was used to open them.
    """

    name: str
    fingerprint: str
    preparation: Preparation
    seed: int
    synthesizers: SynthesizerPair
    generator: SignalGenerator
    camera: Camera
    clock: Clock
    surroundings: Surroundings | None = None
    simulated_disorder: str = ""
    reopen: Callable[[RoleName], Instrument] | None = None
    release: Callable[[], None] | None = None

    @property
    def identities(self) -> Mapping[str, str]:
        """Identity of each instrument, by role, as one line that a run file can hold."""
        return {
            "synthesizers": _one_line(self.synthesizers.identity),
            "generator": _one_line(self.generator.identity),
            "camera": _one_line(self.camera.identity),
        }

    def reconnect(self, role: RoleName) -> bool:
        """Close an instrument and open it again; return False where that is not possible.

        Raises
        ------
        InstrumentError
            If the instrument cannot be opened; its role is then filled by the closed one.
        """
        if self.reopen is None:
            return False
        getattr(self, role).close()
        setattr(self, role, self.reopen(role))
        return True

    def close(self) -> None:
        """Release all instruments. May be called twice."""
        release, self.release = self.release, None
        with ExitStack() as closing:
            if release is not None:
                closing.callback(release)
            # Whatever becomes of one, the others are closed; the generator first.
            for instrument in (self.camera, self.synthesizers, self.generator):
                closing.callback(instrument.close)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def _one_line(identity: object) -> str:
    """Return a text without what HDF5 refuses: a serial line may return a null character."""
    text = "".join(c if c.isprintable() else " " for c in str(identity))
    return " ".join(text.split())
