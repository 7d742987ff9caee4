"""Drivers of a bench with campaigns, as a bench file names them: ``package.module:Class``.

What the bench is like is no part of the bench file, of which every run file keeps the text. It is
in a key, a file that the environment variable `KEY_VARIABLE` names while the bench is open; see
`recording.record`.
"""

import json
import os
from datetime import UTC, datetime, timedelta
from fractions import Fraction
from pathlib import Path

import numpy as np

from drivers.context import BenchContext
from drivers.errors import BenchSetupError, InstrumentError, LimitError
from drivers.options import Options, read_options
from drivers.roles import Arrangement, Frame
from protocols.bench import CameraSensor
from studies.second_laboratory.campaigns.case import case_from_json, setup_of
from studies.second_laboratory.campaigns.drawing import SHEET
from studies.second_laboratory.campaigns.world import World
from studies.second_laboratory.instruments import Shared
from studies.second_laboratory.light import Geometry
from studies.second_laboratory.shape import Fineness

KEY_VARIABLE = "SECOND_LABORATORY_KEY"
# The first campaign of every case is dated as if it was measured then, each further one two days
# later: the date of the computer would show in which order cases were made.
_BEGUN, _BETWEEN = datetime(2025, 3, 3, 8, 30, tzinfo=UTC), timedelta(days=2)


class CampaignOptions(Options):
    """Options of the camera: none, because they would show in run files."""


class Hall:
    """The laboratory that all instruments of one bench share; lives as long as the bench."""

    def __init__(self, context: BenchContext) -> None:
        key = os.environ.get(KEY_VARIABLE)
        if key is None:
            raise BenchSetupError(f"{KEY_VARIABLE} names no key; record cases with `record`")
        content = json.loads(Path(key).read_text("utf-8"))
        setup = setup_of(case_from_json(content["case"]), content["repeat"])
        shared, description = context.share(Shared), context.description
        optics, camera = description.optics, description.instruments.camera
        geometry = Geometry(
            (camera.height, camera.width),
            float(camera.pixel_m),
            float(optics.wavelength_m),
            float(optics.distance_m),
        )
        centre_m = float(optics.reed_centre.y_m), float(optics.reed_centre.x_m)
        fine = content.get("fineness")
        fineness = Fineness(**{**fine, "layers": tuple(fine["layers"])}) if fine else None
        self.clock = shared.clock
        self.clock.begin(_BEGUN + setup.repeat * _BETWEEN)
        self.world = World(setup, geometry, centre_m, shared.settings, fineness)


class CampaignSurroundings:
    """Shutters, lamp and clamp, operated by hands that need time."""

    def __init__(self, hall: Hall) -> None:
        self._hall = hall

    def arrange(self, arrangement: Arrangement) -> None:
        """Change the light on the sensor."""
        self._hall.clock.wait(self._hall.world.arrange(arrangement.value))

    def clamp_again(self) -> None:
        """Take the reed out of its clamp, and put it back."""
        self._hall.clock.wait(self._hall.world.clamp_again(self._hall.clock.now_s()))


class CampaignCamera:
    """A camera that runs freely on the laboratory's clock."""

    identity = "second laboratory, camera of 12 bits"

    def __init__(self, entry: CameraSensor, context: BenchContext) -> None:
        self._entry = entry
        read_options(
            CampaignOptions, entry.options, context.description.name, "instruments.camera.options"
        )
        self._hall = context.share(Hall)
        context.surroundings = CampaignSurroundings(self._hall)
        self._period_s, self._exposure_s = Fraction(1), Fraction(1)
        self._configured = False
        self._started_s: float | None = None
        self._next = 0

    @property
    def saturation_dn(self) -> int:
        """Number at which a pixel stops growing with light, by the data sheet."""
        return min(4095, round(SHEET.offset_dn + SHEET.full_well_e / SHEET.electrons_per_dn))

    def configure(
        self, frame_rate_hz: Fraction, exposure_s: Fraction, shape: tuple[int, int]
    ) -> None:
        """Set up the camera."""
        if self._started_s is not None:
            raise InstrumentError("the camera is running; stop it first")
        large = shape[0] > self._entry.height or shape[1] > self._entry.width
        if exposure_s * frame_rate_hz > 1 or large:
            raise LimitError("the camera has no such exposure or sensor")
        self._period_s, self._exposure_s = 1 / frame_rate_hz, exposure_s
        self._hall.world.read(shape)
        self._configured = True

    def start(self) -> None:
        """Begin to take frames."""
        if not self._configured:
            raise InstrumentError("the camera is not configured; configure it first")
        self._started_s, self._next = self._hall.clock.now_s(), 0

    def stop(self) -> None:
        """Take no more frames."""
        self._started_s = None

    def grab(self, count: int, not_before_s: float) -> list[Frame]:
        """Return the next frames whose exposures begin at a time or later."""
        if self._started_s is None:
            raise InstrumentError("the camera is stopped; start it first")
        period_s, clock = float(self._period_s), self._hall.clock
        # Rounding of times does not cost a frame.
        earliest = int(np.ceil((not_before_s - self._started_s) / period_s - 1e-9))
        first = max(self._next, earliest)
        starts = [self._started_s + k * period_s for k in range(first, first + count)]
        images = self._hall.world.expose(starts, float(self._exposure_s))
        self._next = first + count
        clock.wait(starts[-1] + float(self._exposure_s) - clock.now_s())
        return [Frame(first + k, starts[k], image) for k, image in enumerate(images)]

    def now_s(self) -> float:
        """Return the time of the laboratory."""
        return self._hall.clock.now_s()

    def close(self) -> None:
        """Stop."""
        self._started_s = None
