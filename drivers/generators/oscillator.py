"""A sine with exact phase for a sound card, sample by sample."""

import math
from dataclasses import dataclass
from fractions import Fraction
from typing import Final

import numpy as np
from numpy.typing import NDArray

_CHUNK: Final = 4096

_COUNTS_PER_TURN: Final = 1 << 64

_RAD_PER_COUNT: Final = 2 * math.pi / _COUNTS_PER_TURN


@dataclass(frozen=True, slots=True)
class Tone:
    """A sine that an `Oscillator` is asked to play.

    Attributes
    ----------
    frequency_hz : Fraction
        As asked; the oscillator plays the nearest multiple of its sample rate over 2^64.
    volts : float
        Peak volts at the load once the ramp has ended.
    ramp_samples : int
        Over which the volts change from what they were; 0 is a jump.
    phase_counts : int
        Phase from one sample to the next, in turns over 2^64.
    """

    frequency_hz: Fraction
    volts: float
    ramp_samples: int
    phase_counts: int


@dataclass(frozen=True, slots=True)
class Progress:
    """Progress of an `Oscillator` after its last block.

    Attributes
    ----------
    samples : int
        Made so far.
    tone : Tone
        That is being played, perhaps no longer the one that was asked for last.
    volts : float
        Peak volts of the last sample.
    ramp_left : int
        Samples until `volts` are those of the tone.
    """

    samples: int
    tone: Tone
    volts: float
    ramp_left: int


class Oscillator:
    """A sine whose phase never jumps and whose volts change sample by sample.

    The phase is a whole number of 2^-64 turns, so it is exact however long the sine lasts and
    however its samples are cut into blocks; the frequency is played to half of 2^-64 of the sample
    rate. One thread calls `play`, one other thread calls `fill`: each hands its results over in
    one assignment of an immutable object, and neither ever waits.

    Parameters
    ----------
    sample_rate_hz : int
    full_scale_v : float
        Peak volts at the load of samples from -1 to 1.
    frequency_hz : Fraction
        That stands by, at 0 V, until `play` is called.
    """

    def __init__(self, sample_rate_hz: int, full_scale_v: float, frequency_hz: Fraction) -> None:
        self._sample_rate_hz, self._full_scale_v = sample_rate_hz, full_scale_v
        self._asked = self._tone = self._tone_at(frequency_hz, 0.0, 0)
        self._samples, self._phase = 0, 0
        self._ramp_left, self._volts_per_sample = 0, 0.0
        self._progress = Progress(0, self._tone, 0.0, 0)
        # The audio thread must not wait for memory.
        self._index = np.arange(_CHUNK, dtype=np.uint64)
        self._phases = np.empty(_CHUNK, np.uint64)
        self._sine, self._ramp = np.empty(_CHUNK), np.empty(_CHUNK)

    @property
    def progress(self) -> Progress:
        """Progress of the sine. May be read from any thread."""
        return self._progress

    def play(self, frequency_hz: Fraction, volts: float, ramp_samples: int) -> Tone:
        """Ask for another tone from the next block on.

        Parameters
        ----------
        frequency_hz : Fraction
            Below half of the sample rate; it changes at once.
        volts : float
            Peak volts at the load, at most full scale.
        ramp_samples : int
            Not negative. The volts change evenly; the last of these samples has `volts`.

        Returns
        -------
        Tone
            By which `progress` tells that it is being played.
        """
        self._asked = self._tone_at(frequency_hz, volts, ramp_samples)
        return self._asked

    def fill(self, samples: NDArray[np.float32]) -> None:
        """Write the next samples of the sine.

        Parameters
        ----------
        samples : (n,) float32
            Overwritten with fractions of full scale. May be a column of a larger array.
        """
        asked = self._asked
        if asked is not self._tone:
            self._adopt(asked)
        for start in range(0, samples.size, _CHUNK):
            self._fill_chunk(samples[start : start + _CHUNK])
        self._progress = Progress(self._samples, self._tone, self._volts(), self._ramp_left)

    def _tone_at(self, frequency_hz: Fraction, volts: float, ramp_samples: int) -> Tone:
        counts = round(frequency_hz / self._sample_rate_hz * _COUNTS_PER_TURN)
        return Tone(frequency_hz, volts, ramp_samples, counts)

    def _volts(self) -> float:
        return self._tone.volts - self._volts_per_sample * self._ramp_left

    def _adopt(self, tone: Tone) -> None:
        change_v = tone.volts - self._volts()
        self._tone = tone
        self._ramp_left = tone.ramp_samples if change_v else 0
        self._volts_per_sample = change_v / self._ramp_left if self._ramp_left else 0.0

    def _fill_chunk(self, samples: NDArray[np.float32]) -> None:
        count, counts = samples.size, self._tone.phase_counts
        if self._tone.volts == 0 and not self._ramp_left:
            samples.fill(0)
        else:
            phases, sine = self._phases[:count], self._sine[:count]
            np.multiply(self._index[:count], np.uint64(counts), out=phases)
            np.add(phases, np.uint64(self._phase), out=phases)
            np.multiply(phases, _RAD_PER_COUNT, out=sine)
            np.sin(sine, out=sine)
            np.multiply(sine, self._volts_of_each(count), out=sine)
            np.divide(sine, self._full_scale_v, out=samples)
        self._phase = (self._phase + count * counts) % _COUNTS_PER_TURN
        self._ramp_left = max(self._ramp_left - count, 0)
        self._samples += count

    def _volts_of_each(self, count: int) -> NDArray[np.float64] | float:
        if not self._ramp_left:
            return self._tone.volts
        # Counted from the end of the ramp, so that it ends on the very number that was asked.
        volts = self._ramp[:count]
        np.subtract(self._ramp_left - 1, self._index[:count], out=volts, dtype=np.float64)
        np.maximum(volts, 0, out=volts)
        np.multiply(volts, -self._volts_per_sample, out=volts)
        return np.add(volts, self._tone.volts, out=volts)
