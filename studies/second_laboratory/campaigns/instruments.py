"""Drivers of a bench with campaigns, as a bench file names them: ``package.module:Class``.

What the bench is like is no part of the bench file, of which every run file keeps the text. It is
in a key, a file that the environment variable `KEY_VARIABLE` names while the bench is open; see
`recording.record`.
"""

import json
import os
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.context import BenchContext
from drivers.errors import BenchSetupError
from drivers.options import Options, read_options
from drivers.roles import Arrangement
from protocols.bench import CameraSensor
from studies.second_laboratory.campaigns.case import case_from_json, setup_of
from studies.second_laboratory.campaigns.drawing import SHEET
from studies.second_laboratory.campaigns.world import World
from studies.second_laboratory.instruments import FreeRunningCamera, Shared
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


class CampaignCamera(FreeRunningCamera):
    """The camera of campaigns, which sees the world of its hall."""

    def __init__(self, entry: CameraSensor, context: BenchContext) -> None:
        read_options(
            CampaignOptions, entry.options, context.description.name, "instruments.camera.options"
        )
        hall = context.share(Hall)
        super().__init__(entry, hall.clock)
        self._world = hall.world
        context.surroundings = CampaignSurroundings(hall)

    @property
    def saturation_dn(self) -> int:
        """Number at which a pixel stops growing with light, by the data sheet."""
        return min(4095, round(SHEET.offset_dn + SHEET.full_well_e / SHEET.electrons_per_dn))

    def _prepare(self, shape: tuple[int, int]) -> None:
        self._world.read(shape)

    def _expose(self, starts_s: list[float], exposure_s: float) -> list[NDArray[np.uint16]]:
        return self._world.expose(starts_s, exposure_s)
