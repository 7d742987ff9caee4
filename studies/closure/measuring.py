"""Small campaigns on the simulated bench, with one effect or none, and what they read."""

import json
import pickle
import tempfile
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import acquire
from acquire.runner.summary import RunState
from diagnosis.campaign import Campaign
from diagnosis.observe import read
from diagnosis.readings.campaign_readings import Readings, read_unfitted
from drivers.simulated.settings import bench_parameters, read_simulation
from fitting.known_bench import bench_of
from physics.effects.effect import Effect
from physics.parameters.tree import BenchParameters
from protocols.bench import BenchFile
from protocols.campaign import CampaignFile
from protocols.plan import Plan
from runs.reader import Run

REED: Final = "R07"
SEED: Final = 1
# Values of parameters that have no size: where this campaign can show them. Others are in the
# middle of their grid. A sweep of `REPEATED` takes 130 s, so that the hop is in the middle of the
# second one.
_PLACES: Final[Mapping[str, Mapping[str, float]]] = {"laser_mode_hop": {"after": 195 / 3600}}
_FRAMES: Final = {"keep": "frames"}
_FLAT: Final = {"count": 1, "exposures": ["20 ms", "40 ms", "60 ms", "80 ms"]}
_PARTS: Final[Mapping[str, dict[str, Any]]] = {
    "dark": _FRAMES | {"calibration": {"kind": "dark"}},
    "flat": _FRAMES | {"calibration": {"kind": "flat"} | _FLAT},
    "lo": _FRAMES | {"calibration": {"kind": "lo_only"} | _FLAT},
    "rest1": _FRAMES | {"calibration": {"kind": "order0"}},
    "up": {},
    "down": {"sweep.direction": "down"},
    "quiet": {"drive.from": "0.125 V", "drive.to": "4 V"},
    "rest2": _FRAMES | {"calibration": {"kind": "order0"}},
}


@dataclass(frozen=True)
class SmallCampaign:
    """A campaign that is as small as it can be and still determines the observables.

    Attributes
    ----------
    name : str
        Also of the folder that keeps its readings.
    parts : tuple of str
        Names of runs in `_PARTS`, in the order of measurement.
    width, height : int
        Pixels of the sensor.
    stride : int
        Of the steps of series A.
    settle : str
        Wait after each setting of a sweep. It is longer than on a bench, so that a campaign takes
        several minutes of simulated time, as drifts need.
    fitted : bool
        Whether sweeps are fitted.
    mesh : {'standard', 'coarse'}
        Of the simulated reed.
    """

    name: str
    parts: tuple[str, ...]
    width: int
    height: int
    stride: int
    settle: str
    fitted: bool
    mesh: str = "standard"

    def file(self) -> CampaignFile:
        """Return the campaign file."""
        small = {
            "camera.width": self.width,
            "camera.height": self.height,
            "sweep.stride": self.stride,
        }
        # The phase of light at rest is followed from one acquisition to the next: no long waits.
        waits = {"settle": self.settle}
        parts = [
            {
                "name": name,
                "change": {**small, **_PARTS[name], **({} if _PARTS[name].get("keep") else waits)},
            }
            for name in self.parts
        ]
        content = {"name": "Closure", "protocol": "seriesA", "parts": parts}
        return CampaignFile.from_text(json.dumps(content), f"closure, {self.name}")


# No fit: what frames, light at rest and the steps' locks show.
UNFITTED: Final = SmallCampaign(
    "unfitted",
    ("dark", "flat", "lo", "rest1", "up", "down", "rest2"),
    width=320,
    height=256,
    stride=2,
    settle="2 s",
    fitted=False,
)
# Chosen: steps and sensor of the protocol `quick`, which shows all modes up to 16 kHz.
FITTED: Final = SmallCampaign(
    "fitted",
    ("rest1", "up", "quiet", "rest2"),
    width=640,
    height=512,
    stride=2,
    settle="1 s",
    fitted=True,
)
# Sweeps of one level are compared with each other: what differs between them depends on time.
REPEATED: Final = replace(FITTED, name="repeated", parts=("rest1", "up", "down", "quiet", "rest2"))


@dataclass(frozen=True)
class Measured:
    """One campaign, read.

    Attributes
    ----------
    parameters : BenchParameters
        All that the simulated bench played.
    readings : Readings
    """

    parameters: BenchParameters
    readings: Readings


def sizes_of(effect: Effect, multiple: float = 1.0) -> dict[str, float]:
    """Return the typical sizes of an effect: standard deviations of their priors.

    Parameters
    ----------
    effect : Effect
    multiple : float
        Of these standard deviations.
    """
    places = _PLACES.get(effect.id, {})
    values = {p.name: places.get(p.name, p.grid[len(p.grid) // 2]) for p in effect.gridded}
    return values | {p.name: multiple * p.spread for p in effect.sizes}


def bench_with(small: SmallCampaign, effect: Effect | None, multiple: float = 1.0) -> BenchFile:
    """Return the simulated bench with an effect of its typical size; None is no effect."""
    twin: dict[str, Any] = {"mesh": small.mesh}
    if effect is not None:
        units = {parameter.name: parameter.unit for parameter in effect.parameters}
        written = {
            name: f"{value!r} {units[name]}" if units[name] else value
            for name, value in sizes_of(effect, multiple).items()
        }
        twin["effects"] = {effect.id: written}
    return BenchFile.from_file().replace({"twin": twin})


def measured(small: SmallCampaign, bench: BenchFile, kept: Path | None = None) -> Measured:
    """Measure and read a campaign, or return what was read before.

    Parameters
    ----------
    small : SmallCampaign
    bench : BenchFile
    kept : Path, optional
        File that keeps the readings. It is used again if it is of the same campaign and bench; what
        has changed in the code of the bench or the readings since is not noticed.

    Raises
    ------
    KeyboardInterrupt
        If the measurement was interrupted.
    """
    campaign = small.file()
    parameters = _played(acquire.plan_campaign(campaign, bench).plans[0])
    fingerprint = (repr(campaign.content()), repr(bench.content()))
    if kept is not None and kept.exists():
        before, readings = pickle.loads(kept.read_bytes())
        if before == fingerprint:
            return Measured(parameters, readings)
    with tempfile.TemporaryDirectory() as place:
        readings = _read(small, campaign, bench, Path(place) / "closure")
    if kept is not None:
        kept.parent.mkdir(parents=True, exist_ok=True)
        kept.write_bytes(pickle.dumps((fingerprint, readings)))
    return Measured(parameters, readings)


def _read(small: SmallCampaign, campaign: CampaignFile, bench: BenchFile, folder: Path) -> Readings:
    result = acquire.run_campaign(campaign, folder, bench, reed=REED, seed=SEED)
    if any(part.status is not RunState.COMPLETE for part in result.parts):
        raise KeyboardInterrupt
    with ExitStack() as opened:
        runs = [opened.enter_context(Run.open(file)) for file in sorted(folder.glob("*.h5"))]
        together = Campaign.of(runs)
        known = bench_of(together.sweeps[0].run)
        return read(together, known) if small.fitted else read_unfitted(together, known)


def _played(plan: Plan) -> BenchParameters:
    """Return the parameters of the simulated bench, with the part of the sensor that is used."""
    simulation = read_simulation(plan.bench.twin, plan.bench.name)
    whole = bench_parameters(simulation, plan.bench, plan.preparation(REED))
    camera = plan.protocol.camera
    shape = (camera.height or whole.sensor.shape[0], camera.width or whole.sensor.shape[1])
    return replace(whole, sensor=replace(whole.sensor, shape=shape))
