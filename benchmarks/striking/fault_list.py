"""The faults that strike a run on the emulated bench, and what each is to end in."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from drivers.roles import Bench, Frame

Ending = Literal["complete", "stopped"]
Spoil = Callable[[Sequence[Frame]], Sequence[Frame]]


@dataclass(frozen=True)
class Fault:
    """One thing that goes wrong, and what is to become of the run.

    Attributes
    ----------
    name : str
    ending : {'complete', 'stopped'}
        Whether the sweep is to be completed, or to stop and say why.
    said : str
        Words of the reason of a run that stopped, or of the verdict of a step that was mended.
    faults : mapping
        Of the twin, see `drivers.simulated.settings.Faults`.
    protocol, bench, twin : mapping
        Changes of the protocol and the bench by key path, and other settings of the twin.
    unconfirmed : bool
        Whether switching off cannot be confirmed, and has to say so.
    all_good : bool
        Whether all steps of a complete sweep are to be good.
    strike, amid : callable, optional
        Done to the open bench before the run, and after its fourth step.
    """

    name: str
    ending: Ending
    said: str
    faults: Mapping[str, Any] = field(default_factory=dict)
    protocol: Mapping[str, Any] = field(default_factory=dict)
    bench: Mapping[str, Any] = field(default_factory=dict)
    twin: Mapping[str, Any] = field(default_factory=dict)
    unconfirmed: bool = False
    all_good: bool = True
    strike: Callable[[Bench], None] | None = None
    amid: Callable[[Bench], None] | None = None


def _wire(name: str, **faults: Any) -> dict[str, Any]:
    return {f"{name}_wire": faults}


def _device(name: str, **faults: Any) -> dict[str, Any]:
    return {f"{name}_device": faults}


def _clamp(bench: Bench) -> None:
    """Let the simulated generator clamp where the sweep has not come to yet, without a word."""
    generator: Any = bench.generator
    generator.device.clamp_at(0.6)


def _trip(bench: Bench) -> None:
    """Let the generator's protection take its output off."""
    generator: Any = bench.generator
    generator.device.trip()


def _turning_knob(command: str, acquisition: int = 4) -> Callable[[Bench], None]:
    """Use the generator's front panel just before frames are taken."""

    def strike(bench: Bench) -> None:
        generator: Any = bench.generator
        camera: Any = bench.camera
        grab, grabbed = camera.grab, []

        def disturbed(count: int, not_before_s: float) -> list[Frame]:
            grabbed.append(count)
            if len(grabbed) == acquisition:
                generator.device.turn_knob(command)
            frames: list[Frame] = grab(count, not_before_s)
            return frames

        camera.grab = disturbed

    return strike


def _losing(role: str, command: bytes, at: int = 4) -> Callable[[Bench], None]:
    """Let a command get lost on its way, the n-th of those that begin like this."""

    def strike(bench: Bench) -> None:
        device: Any = getattr(bench, role).device
        receive, heard = device.receive, []

        def losing(data: bytes) -> bytes:
            if data.startswith(command):
                heard.append(data)
            answer: bytes = b"" if heard[at - 1 :] == [data] else receive(data)
            return answer

        device.receive = losing

    return strike


def _delivering(spoil: Spoil, acquisition: int = 4) -> Callable[[Bench], None]:
    """Let the camera's driver deliver something else at one acquisition."""

    def strike(bench: Bench) -> None:
        grab, grabbed = bench.camera.grab, []

        def spoilt(count: int, not_before_s: float) -> list[Frame]:
            grabbed.append(count)
            frames = grab(count, not_before_s)
            return list(spoil(frames)) if len(grabbed) == acquisition else frames

        camera: Any = bench.camera
        camera.grab = spoilt

    return strike


def _as_type(dtype: Any) -> Spoil:
    return lambda frames: [replace(f, image=f.image.astype(dtype)) for f in frames]


def _without_times(frames: Sequence[Frame]) -> Sequence[Frame]:
    return [replace(f, timestamp_s=np.nan) for f in frames]


def _cropped(frames: Sequence[Frame]) -> Sequence[Frame]:
    return [replace(f, image=f.image[:-1]) for f in frames]


RETRY = {"policy.instrument_error": {"retries": 2, "then": "stop"}}
SKIP = {"policy.instrument_error": {"retries": 0, "then": "skip"}}
GIVE_UP = {"policy.give_up_after": 4}
# Commands and answers are counted from the opening on; these lie amid the sweep, behind the ramp.
AMID, AMID_GENERATOR = 40, 100
# Disturbances of an ordinary optical table: issue and docs/explanation/reliability.md.
TABLE = {"light": {"path_drift_rad": 0.02, "path_jitter_rad": 0.1, "phase_scatter": True}}

SYNTHESIZERS = (
    Fault("synthesizers: reply lost", "complete", "", _wire("synthesizers", lose_answer_at=[AMID])),
    Fault(
        "synthesizers: frequency lost",
        "stopped",
        "reads",
        strike=_losing("synthesizers", b"F0"),
    ),
    Fault(
        "synthesizers: frequency lost, policy retry",
        "complete",
        "",
        protocol=RETRY,
        strike=_losing("synthesizers", b"F0"),
    ),
    Fault(
        "synthesizers: update lost",
        "complete",
        "",
        strike=_losing("synthesizers", b"I p"),
    ),
    Fault(
        "synthesizers: replies garbled",
        "complete",
        "",
        _wire("synthesizers", garble_answer_at=[AMID, AMID + 7]),
    ),
    Fault(
        "synthesizers: reply late",
        "complete",
        "",
        _wire("synthesizers", late_answer_at=[AMID], late_s=0.8),
    ),
    Fault("synthesizers: echo on", "complete", "", _wire("synthesizers", echo=True)),
    Fault(
        "synthesizers: wrong baud",
        "stopped",
        "baud",
        _wire("synthesizers", wrong_baud=True),
        unconfirmed=True,
    ),
    Fault(
        "synthesizers: every reply 0.3 s late",
        "complete",
        "",
        _wire("synthesizers", slow_s=0.3),
    ),
    Fault(
        "synthesizers: cable out for a second",
        "stopped",
        "synthesizers",
        _wire("synthesizers", unplug_at=AMID, replug_after_s=0.5),
    ),
    Fault(
        "synthesizers: cable out for a second, policy retry",
        "complete",
        "",
        _wire("synthesizers", unplug_at=AMID, replug_after_s=0.5),
        RETRY,
    ),
    Fault(
        "synthesizers: one update acknowledged, not made",
        "complete",
        "",
        _device("synthesizers", skips_update_at=[9]),
    ),
    Fault(
        "synthesizers: no update made from the sweep on",
        "stopped",
        "check",
        _device("synthesizers", skips_updates_from=9),
        GIVE_UP,
    ),
    Fault(
        "synthesizers: no update ever made",
        "stopped",
        "check",
        _device("synthesizers", skips_updates_from=1),
        GIVE_UP,
    ),
    Fault(
        "synthesizers: cable out for good",
        "stopped",
        "synthesizers",
        _wire("synthesizers", unplug_at=AMID),
        unconfirmed=True,
    ),
)
NO_FAULT = Fault("nothing", "complete", "")
GENERATOR = (
    Fault(
        "generator: reply lost", "complete", "", _wire("generator", lose_answer_at=[AMID_GENERATOR])
    ),
    Fault(
        "generator: reply garbled",
        "complete",
        "",
        _wire("generator", garble_answer_at=[AMID_GENERATOR]),
    ),
    Fault(
        "generator: reply late",
        "complete",
        "",
        _wire("generator", late_answer_at=[AMID_GENERATOR], late_s=1.2),
    ),
    Fault("generator: every reply 0.3 s late", "complete", "", _wire("generator", slow_s=0.3)),
    Fault(
        "generator: command lost",
        "stopped",
        "says",
        strike=_losing("generator", b"C1:BSWV FRQ"),
    ),
    Fault(
        "generator: command lost, policy retry",
        "complete",
        "",
        protocol=RETRY,
        strike=_losing("generator", b"C1:BSWV FRQ"),
    ),
    Fault(
        "generator: cable out for a second",
        "stopped",
        "generator",
        _wire("generator", unplug_at=AMID_GENERATOR, replug_after_s=0.5),
    ),
    Fault(
        "generator: cable out for a second, policy retry",
        "complete",
        "",
        _wire("generator", unplug_at=AMID_GENERATOR, replug_after_s=0.5),
        RETRY,
    ),
    Fault(
        "generator: cable out for good",
        "stopped",
        "generator",
        _wire("generator", unplug_at=AMID_GENERATOR),
        unconfirmed=True,
    ),
    Fault("generator: silent clamp", "stopped", "limit itself", strike=_clamp),
    Fault("generator: output trips", "stopped", "output is off", amid=_trip),
    Fault("generator: output trips, policy retry", "complete", "", protocol=RETRY, amid=_trip),
    Fault(
        "generator: output trips before a ramp",
        "stopped",
        "output is off",
        protocol={"drive.to": "16 V", "drive.first": 15, "drive.last": 25},
        amid=_trip,
    ),
    Fault(
        "generator: volts turned up by hand",
        "complete",
        "settings",
        strike=_turning_knob("C1:BSWV AMP,1"),
    ),
    Fault(
        "generator: frequency changed by hand",
        "complete",
        "settings",
        strike=_turning_knob("C1:BSWV FRQ,1700"),
    ),
    Fault(
        "generator: output switched off by hand",
        "stopped",
        "output is off",
        strike=_turning_knob("C1:OUTP OFF"),
    ),
    Fault(
        "generator: load switched by hand",
        "stopped",
        "front panel",
        strike=_turning_knob("C1:OUTP LOAD,50"),
    ),
)
CAMERA = (
    Fault("frame dropped", "complete", "dropped", {"drop_frame_at": [4]}),
    Fault("frame duplicated", "complete", "dropped", {"duplicate_frame_at": [4]}),
    Fault("frames reordered", "complete", "disordered", {"reorder_frames_at": [4]}),
    Fault("frame half filled", "complete", "partial", {"partial_frame_at": [4]}),
    Fault("frame late", "complete", "disordered", {"late_frame_at": [4]}),
    Fault("frames stale", "complete", "stale", {"stale_frame_at": [4]}),
    Fault("camera's clock jumps ahead", "complete", "disordered", {"clock_jump_at": 4}),
    Fault(
        "camera's clock jumps back",
        "complete",
        "disordered",
        {"clock_jump_at": 4, "clock_jump_s": -0.5},
    ),
    Fault("trigger missing", "stopped", "trigger", {"no_frame_from": 4}),
    Fault(
        "trigger missing, policy skip",
        "complete",
        "skipped",
        {"no_frame_from": 9},
        SKIP,
        all_good=False,
    ),
    Fault("trigger missing, gives up", "stopped", "check", {"no_frame_from": 3}, SKIP | GIVE_UP),
    Fault("frames without times", "stopped", "time stamp", strike=_delivering(_without_times)),
    Fault("frames of int32", "stopped", "int32", strike=_delivering(_as_type(np.int32))),
    Fault("frames of float64", "stopped", "float64", strike=_delivering(_as_type(np.float64))),
    Fault("frames of another size", "stopped", "shape", strike=_delivering(_cropped)),
    Fault(
        "frame rate off by half a per cent",
        "stopped",
        "frames per second",
        {"frame_rate_error_ppm": 5000.0},
        GIVE_UP,
    ),
)
LIGHT = (
    Fault("one frame of four dark", "complete", "light", {"dark_frame_at": [4]}),
    Fault("light blinks by 10 %", "complete", "light", {"blink_at": [4]}),
    Fault("an exposure missing, numbers whole", "complete", "unsteady", {"advance_frames_at": [5]}),
    Fault(
        "volts halve during the frames",
        "complete",
        "unsteady",
        {"sag_at": [9]},
        {"sweep.first": 12, "sweep.last": 36},
    ),
    Fault("an ordinary table: drift and jitter", "complete", "", twin=TABLE),
    Fault("modulators exchanged", "stopped", "exchanged", {"modulators_exchanged": True}, GIVE_UP),
    Fault("loudspeaker unplugged", "stopped", "cable", {"tweeter_unplugged": True}, GIVE_UP),
    Fault("too much light", "stopped", "saturated", {"local_oscillator_factor": 4}, GIVE_UP),
)
FAULTS = (NO_FAULT, *SYNTHESIZERS, *GENERATOR, *CAMERA, *LIGHT)
