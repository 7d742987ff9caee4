"""A sound card as the generator of the loudspeaker's voltage: handy, quiet, and not locked.

The samples are made by `Oscillator` on the audio thread of PortAudio (through ``sounddevice``);
`SoundCardGenerator` tells it what to play, and watches that it was played without a gap.
"""

import importlib
import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from fractions import Fraction
from numbers import Real
from typing import Annotated, Any, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from drivers.context import BenchContext, WallClock
from drivers.errors import (
    BenchSetupError,
    InstrumentError,
    LimitError,
)
from drivers.generators.oscillator import Oscillator, Progress
from drivers.options import Options, read_options
from drivers.roles import Clock
from protocols.bench import Generator

_SECTION: Final = "instruments.generator.options"
# Shorter ramps of a loudspeaker's voltage are heard as clicks.
_SHORTEST_RAMP_S: Final = 0.05
# A card that has asked for no samples for so long will ask for none.
_STALL_S: Final = 2.0
# How far PortAudio may round a sample rate: well below what the crystal of a card is off.
_SAMPLE_RATE_TOLERANCE: Final = 1e-6
_BLOCKS_AHEAD: Final = 2

# Codes of PortAudio for what only a change of the bench file can mend.
_WRONG_KEYS: Final = {-9998: "channel", -9997: "sample_rate_hz", -9996: "device"}


class SoundCardOptions(Options):
    """Options of a sound card."""

    device: int | Annotated[str, Field(min_length=1)] | None = None
    """Index, or part of the name, of PortAudio's output device. Without this key, the default
    device of the system."""
    sample_rate_hz: Annotated[int, Field(gt=0)] = 48_000
    """Sample rate in Hz, more than twice the highest drive frequency; choose one that the card has
    without resampling."""
    volts_per_full_scale: Annotated[float, Field(gt=0)]
    """Peak volts of a full-scale sine at the line output, with the amplifier connected and all
    volume controls at their final position. It has to be measured: there is no usual value."""
    channel: Annotated[int, Field(ge=1)] = 1
    """Channel that drives the amplifier, from 1, the left one. The others are silent."""
    block_frames: Annotated[int, Field(ge=16, le=65_536)] = 1024
    """Samples per call of the audio thread; raise it on a busy computer."""


class SoundCardGenerator:
    """A `SignalGenerator` on a sound card. It is unlocked, and its identity says so.

    No card takes the 10 MHz of the synthesizers. Its own crystal may be off by 50 ppm: at 2 kHz
    these are 0.1 Hz, and the reed's phase runs away by 0.2 rad within 4 frames at 12.5 Hz, at
    20 kHz by 2 rad. Pictures of amplitudes at low drives suffer little, maps of phase are not to be
    had. The ``step`` of the bench file cannot tell this: the card plays every multiple of its
    sample rate over 2^64 by its own clock, so any step is as good as another, and `read` returns
    what was commanded. What really sounds is known to within that error only.

    The volts change over at least 50 ms, also in `set_sine` and `output_off`, and the phase never
    jumps, so the loudspeaker is not made to click. While the output is off, the stream is stopped.

    Parameters
    ----------
    entry : Generator
        With `output`, and `SoundCardOptions` as its options.
    context : BenchContext
    clock : Clock, optional
        Clock that waits for the card. The card plays in real time, so that is the default, whatever
        the clock of the bench.

    Raises
    ------
    BenchSetupError
        If the bench file is incomplete or allows volts that the card clips, or PortAudio or the
        device is missing or cannot play so.
    InstrumentError
        If the device cannot be opened, because it is in use, say.
    """

    OPTIONS = SoundCardOptions

    def __init__(self, entry: Generator, context: BenchContext, clock: Clock | None = None) -> None:
        bench = context.description
        options = read_options(self.OPTIONS, entry.options, bench.name, _SECTION)
        if entry.output is None:
            raise BenchSetupError(
                f"bench {bench.name!r}: instruments.generator.output: is missing; add "
                "amplifier_gain and load, from which the volts at the loudspeaker follow"
            )
        self._limits, self._clock = bench.limits, clock or WallClock()
        self._sample_rate_hz, self._column = options.sample_rate_hz, options.channel - 1
        self._full_scale_v = options.volts_per_full_scale * entry.output.amplifier_gain
        self._require_within_range(bench.name)
        self._oscillator = self._silence_at(self._limits.drive_min_hz)
        self._on = False
        # Written by the audio thread while the stream runs, and only by it.
        self._failure: Exception | None = None
        self._dropouts = 0
        self._dropouts_told = 0
        self._sounddevice = load_sounddevice()
        device = _find_output(self._sounddevice, options, bench.name)
        self._name: str = device["name"]
        self._stream = _open_stream(
            self._sounddevice, options, bench.name, device, self._on_audio_thread
        )
        host = self._sounddevice.query_hostapis(device["hostapi"])["name"]
        portaudio = self._sounddevice.get_portaudio_version()[1]
        identity = (
            f"sound card {self._name!r} on {host}, {self._sample_rate_hz} Hz, unlocked; {portaudio}"
        )
        self._identity = " ".join(identity.split())

    @property
    def identity(self) -> str:
        """Device, host interface, sample rate, the word "unlocked", and PortAudio's version."""
        return self._identity

    def set_sine(self, frequency_hz: Fraction, volts: float) -> None:
        """Play a sine; see `SignalGenerator.set_sine`.

        The frequency changes at once, the volts over 50 ms; returns when that has reached the
        output.

        Raises
        ------
        LimitError
        InstrumentError
            If samples were dropped since the card was last asked: the frames that were taken
            since then saw no sine. Also if the card plays no more, or the audio thread failed.
        """
        self._require_frequency(frequency_hz)
        self._require_volts(volts)
        if self._on:
            self._require_no_dropouts()
        else:
            self._switch_on(frequency_hz)
        self._play(Fraction(frequency_hz), float(volts), _SHORTEST_RAMP_S)
        self._require_no_dropouts()

    def ramp_to(self, volts: float, duration_s: float) -> None:
        """Change the volts evenly over `duration_s`, but no faster than in 50 ms.

        See `SignalGenerator.ramp_to`. Also raises `InstrumentError`, when the volts are reached, if
        samples were dropped since the card was last asked.
        """
        self._require_volts(volts)
        if not (_is_number(duration_s) and 0 <= duration_s < math.inf):
            raise LimitError(f"{self._label}: was asked to ramp over {duration_s!r} s; give a time")
        if not self._on:
            if volts == 0:
                return
            raise InstrumentError(
                f"{self._label}: its output is off, but was asked to ramp to {volts:g} V; call "
                "set_sine first"
            )
        frequency_hz = self._oscillator.progress.tone.frequency_hz
        self._play(frequency_hz, float(volts), max(duration_s, _SHORTEST_RAMP_S))
        self._require_no_dropouts()

    def output_off(self) -> None:
        """Fade to silence within 50 ms and stop the stream.

        A card that can no longer fade is stopped all the same. Raises `InstrumentError` if the
        stream does not stop.
        """
        if not self._on:
            return
        try:
            self._play(self._oscillator.progress.tone.frequency_hz, 0.0, _SHORTEST_RAMP_S)
            stop = self._stream.stop
        except InstrumentError:
            stop = self._stream.abort
        try:
            stop(ignore_errors=False)
            active = self._stream.active
        except self._sounddevice.PortAudioError as error:
            raise self._not_stopped(str(error)) from error
        if active:
            raise self._not_stopped("its stream is still active")
        self._on = False

    def read(self) -> tuple[Fraction, float, bool]:
        """Return what the audio thread plays; see `SignalGenerator.read`.

        Returns
        -------
        frequency_hz : Fraction
            As commanded; the card's crystal makes it up to 50 ppm more or less.
        volts : float
        on : bool

        Raises
        ------
        InstrumentError
            If the output is on and samples were dropped since the card was last asked, the card
            plays no more, or the audio thread failed.
        """
        if self._on:
            before = self._oscillator.progress.samples
            self._wait_until(lambda progress: progress.samples > before)
            self._require_no_dropouts()
        progress = self._oscillator.progress
        return progress.tone.frequency_hz, progress.volts if self._on else 0.0, self._on

    def close(self) -> None:
        """Fade, stop and release the card. May be called twice; raises nothing."""
        with suppress(Exception):
            self.output_off()
        with suppress(Exception):
            self._stream.close()
        self._on = False

    # --- On the audio thread -------------------------------------------------------------------

    def _on_audio_thread(
        self, blocks: NDArray[np.float32], _frames: int, _time: object, status: Any
    ) -> None:
        """Fill a block of ``(frames, channels)``; neither waits nor prints."""
        try:
            # A gap in silence is no gap.
            if status.output_underflow and self._oscillator.progress.volts:
                self._dropouts += 1
            blocks.fill(0)
            self._oscillator.fill(blocks[:, self._column])
        except Exception as error:
            # Raised again on the thread that asks next.
            self._failure = error
            blocks.fill(0)
            raise self._sounddevice.CallbackAbort from error

    # --- On the thread that asks ---------------------------------------------------------------

    @property
    def _label(self) -> str:
        return f"generator (sound card {self._name!r})"

    def _silence_at(self, frequency_hz: Fraction) -> Oscillator:
        return Oscillator(self._sample_rate_hz, self._full_scale_v, frequency_hz)

    def _switch_on(self, frequency_hz: Fraction) -> None:
        # A stream that broke off left its oscillator at full volts.
        self._oscillator = self._silence_at(frequency_hz)
        self._failure, self._dropouts_told = None, self._dropouts
        self._on = True
        try:
            self._stream.start()
        except self._sounddevice.PortAudioError as error:
            self._on = False
            raise InstrumentError(
                f"{self._label}: was asked to start playing, but PortAudio says: {error}; see that "
                "the card is plugged in and not in use, then open the bench again"
            ) from error

    def _play(self, frequency_hz: Fraction, volts: float, ramp_s: float) -> None:
        """Play a tone; returns when its volts are reached and have left the card."""
        tone = self._oscillator.play(frequency_hz, volts, round(ramp_s * self._sample_rate_hz))
        self._wait_until(lambda progress: progress.tone is tone and not progress.ramp_left)
        self._clock.wait(self._stream.latency)

    def _wait_until(self, reached: Callable[[Progress], bool]) -> None:
        poll_s = self._stream.blocksize / self._sample_rate_hz / 2
        samples, moved_s = -1, self._clock.now_s()
        while True:
            self._require_active()
            progress, now_s = self._oscillator.progress, self._clock.now_s()
            if reached(progress):
                return
            if progress.samples > samples:
                samples, moved_s = progress.samples, now_s
            elif now_s - moved_s > _STALL_S:
                raise InstrumentError(
                    f"{self._label}: has asked for no samples for {_STALL_S:g} s; see that it is "
                    "plugged in, then open the bench again"
                )
            self._clock.wait(poll_s)

    def _require_active(self) -> None:
        try:
            active, reason = self._stream.active, "its stream has ended"
        except self._sounddevice.PortAudioError as error:
            active, reason = False, f"PortAudio says: {error}"
        if self._failure is not None:
            raise InstrumentError(
                f"{self._label}: its audio thread failed ({self._failure!r}), so it is silent; "
                "report this error"
            ) from self._failure
        if not active:
            raise InstrumentError(
                f"{self._label}: plays no more, {reason}; see that it is plugged in, then open the "
                "bench again"
            )

    def _require_no_dropouts(self) -> None:
        dropouts = self._dropouts
        fresh, self._dropouts_told = dropouts - self._dropouts_told, dropouts
        if fresh:
            raise InstrumentError(
                f"{self._label}: dropped samples {fresh} time(s) since it was last asked, so "
                "frames taken since then saw no sine; leave the computer alone, or raise "
                f"{_SECTION}.block_frames above {self._stream.blocksize}"
            )

    def _not_stopped(self, reason: str) -> InstrumentError:
        return InstrumentError(
            f"{self._label}: was asked to switch its output off, but {reason}; pull the "
            "loudspeaker's cable"
        )

    def _require_within_range(self, bench: str) -> None:
        """Refuse a bench file that allows what the card would clip or fold back."""
        most_v, highest_hz = float(self._limits.volts_max_v), self._limits.drive_max_hz
        if most_v >= self._full_scale_v:
            raise BenchSetupError(
                f"bench {bench!r}: limits.volts_max: {most_v:g} V peak are not below the "
                f"{self._full_scale_v:g} V of the card's full scale at the load, where it clips; "
                "lower it, or amplify more and correct instruments.generator.output.amplifier_gain"
            )
        if 2 * highest_hz >= self._sample_rate_hz:
            raise BenchSetupError(
                f"bench {bench!r}: {_SECTION}.sample_rate_hz: {self._sample_rate_hz} is not above "
                f"twice the {float(highest_hz):.10g} Hz of limits.drive_max; raise it or lower the "
                "limit"
            )

    def _require_frequency(self, frequency_hz: Fraction) -> None:
        low_hz, high_hz = self._limits.drive_min_hz, self._limits.drive_max_hz
        if not (_is_number(frequency_hz) and low_hz <= frequency_hz <= high_hz):
            raise LimitError(
                f"{self._label}: was asked for {_shown(frequency_hz)} Hz, outside "
                f"{_shown(low_hz)} to {_shown(high_hz)} Hz; change the sweep or the limits"
            )

    def _require_volts(self, volts: float) -> None:
        least, most = float(self._limits.volts_min_v), float(self._limits.volts_max_v)
        if not (_is_number(volts) and (volts == 0 or least <= volts <= most)):
            raise LimitError(
                f"{self._label}: was asked for {_shown(volts)} V, outside {least:g} to {most:g} V; "
                "change the protocol's drive or the limits of the bench file"
            )


# --- Opening ---------------------------------------------------------------------------------


def load_sounddevice() -> Any:
    """Return the module sounddevice.

    Raises
    ------
    BenchSetupError
        If it, or PortAudio, is not installed.
    """
    # Only now: importing it already loads, and initialises, the library.
    try:
        return importlib.import_module("sounddevice")
    except OSError as error:
        raise BenchSetupError(
            f"instruments.generator.driver: a sound card needs the library PortAudio ({error}); "
            "install the Debian package libportaudio2"
        ) from error
    except ImportError as error:
        raise BenchSetupError(
            f"instruments.generator.driver: a sound card needs sounddevice ({error}); install it "
            "with: pip install sounddevice"
        ) from error


def _find_output(sounddevice: Any, options: SoundCardOptions, bench: str) -> Mapping[str, Any]:
    """Return PortAudio's description of the one output device that is meant."""
    asked = "the default one" if options.device is None else repr(options.device)
    try:
        device: Mapping[str, Any] = sounddevice.query_devices(options.device, "output")
    except (ValueError, sounddevice.PortAudioError):
        names = [
            f"{known['index']} {known['name']!r}"
            for known in sounddevice.query_devices()
            if known["max_output_channels"] > 0
        ]
        raise BenchSetupError(
            f"bench {bench!r}: {_SECTION}.device: {asked} is not one output device; there are "
            f"{', '.join(names) or 'none'}; write one of these, or plug the card in"
        ) from None
    if options.channel > device["max_output_channels"]:
        raise BenchSetupError(
            f"bench {bench!r}: {_SECTION}.channel: {options.channel} is more than the "
            f"{device['max_output_channels']} channels of {device['name']!r}; lower it"
        )
    return device


def _open_stream(
    sounddevice: Any,
    options: SoundCardOptions,
    bench: str,
    device: Mapping[str, Any],
    callback: Callable[..., None],
) -> Any:
    """Open a stopped stream with the sample rate that was asked for."""
    try:
        stream = sounddevice.OutputStream(
            device=device["index"],
            samplerate=options.sample_rate_hz,
            blocksize=options.block_frames,
            # One channel alone would be sent to the left and to the right.
            channels=max(options.channel, min(2, device["max_output_channels"])),
            dtype="float32",
            latency=_BLOCKS_AHEAD * options.block_frames / options.sample_rate_hz,
            callback=callback,
        )
    except sounddevice.PortAudioError as error:
        key = _WRONG_KEYS.get(error.args[1] if len(error.args) > 1 else 0)
        if key is not None:
            raise BenchSetupError(
                f"bench {bench!r}: {_SECTION}.{key}: {getattr(options, key)!r} is refused by "
                f"{device['name']!r} ({error}); write one that it has"
            ) from error
        raise InstrumentError(
            f"generator (sound card {device['name']!r}): cannot be opened, PortAudio says: "
            f"{error}; see that it is plugged in and that no other program plays on it"
        ) from error
    if abs(stream.samplerate / options.sample_rate_hz - 1) > _SAMPLE_RATE_TOLERANCE:
        stream.close()
        raise BenchSetupError(
            f"bench {bench!r}: {_SECTION}.sample_rate_hz: {options.sample_rate_hz} was asked for, "
            f"but {device['name']!r} plays at {stream.samplerate:.10g}; write a rate that it has"
        )
    return stream


def _is_number(value: object) -> bool:
    return not isinstance(value, bool) and isinstance(value, Real)


def _shown(value: Any) -> str:
    try:
        return f"{float(value):.10g}"
    except (TypeError, ValueError, OverflowError):
        return repr(value)
