"""Record campaigns of cases with the shipped campaign file, and write down what is true of them."""

import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from acquire.campaigns import load_campaign, run_campaign
from protocols.bench import BenchFile
from protocols.campaign import CampaignFile
from studies.second_laboratory.bench import SENSORS
from studies.second_laboratory.campaigns.case import Case
from studies.second_laboratory.campaigns.drawing import SHEET
from studies.second_laboratory.campaigns.instruments import KEY_VARIABLE
from studies.second_laboratory.shape import Fineness

_OWN = "studies.second_laboratory.campaigns.instruments"
_SWEEPS = "studies.second_laboratory.instruments"
# The same in every run file, whatever the case.
_NAME, _REED, _SEED = "second laboratory", "R1", 0


def bench_file() -> BenchFile:
    """Return the bench file of all cases: the shipped simulated bench, with other instruments."""
    return BenchFile.from_file("simulated").replace(
        {
            "name": _NAME,
            "instruments.synthesizers.driver": f"{_SWEEPS}:SecondSynthesizers",
            "instruments.generator.driver": f"{_SWEEPS}:SecondGenerator",
            "instruments.camera.driver": f"{_OWN}:CampaignCamera",
            "instruments.camera.data_sheet": {
                "offset_dn": SHEET.offset_dn,
                "gain_e_dn": SHEET.electrons_per_dn,
                "read_noise_e": SHEET.read_noise_e,
                "full_well_e": SHEET.full_well_e,
            },
        }
    )


def campaign_file(series: str, sensor: str = "small") -> CampaignFile:
    """Return the shipped campaign for a series, on a part of the sensor.

    Parameters
    ----------
    series : {'A', 'B'}
    sensor : {'small', 'quarter', 'full'}
    """
    rows, columns = SENSORS[sensor]
    shipped = load_campaign("campaign")
    always = {
        "camera.width": columns,
        "camera.height": rows,
        # A technician looks at a run that ends early, and goes on; eight weak holograms in a row
        # are no reason to stop.
        "policy.give_up_after": 184,
    }
    parts = []
    for part in shipped.content()["parts"]:
        parts.append({**part, "change": {**part["change"], **always}})
    return shipped.replace({"protocol": f"series{series}", "parts": parts})


def record(
    case: Case,
    folder: Path,
    repeat: int = 0,
    *,
    sensor: str = "small",
    campaign: CampaignFile | None = None,
    bench: BenchFile | None = None,
    fineness: Fineness | None = None,
) -> tuple[Path, ...]:
    """Measure a campaign of a case into a folder, which must be new or empty.

    Run files hold nothing of the case but its frames: they are made in another folder, whose name
    they keep, with one bench file, one reed's name and one seed for all cases.

    Parameters
    ----------
    case : Case
    folder : Path
    repeat : int
        0 for the first campaign; others are of the same reed and bench on other days.
    sensor : {'small', 'quarter', 'full'}
    campaign : CampaignFile, optional
        In place of the shipped one.
    bench : BenchFile, optional
        In place of `bench_file`, such as one that knows an effect of this bench.
    fineness : Fineness, optional
        Of the finite elements, for tests.

    Returns
    -------
    tuple of Path
        Run files of all parts, in the order of measurement.

    Raises
    ------
    RuntimeError
        If the campaign ended early; what was measured is in the folder.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    if any(folder.iterdir()):
        raise FileExistsError(f"{folder}: is not empty; choose another folder")
    measured = campaign or campaign_file(case.series, sensor)
    with tempfile.TemporaryDirectory() as scratch, _key(case, repeat, fineness):
        made = Path(scratch) / "campaign"
        result = run_campaign(measured, made, bench or bench_file(), reed=_REED, seed=_SEED)
        for path in sorted(made.iterdir()):
            shutil.move(path, folder / path.name)
    if len(result.parts) < len(measured.parts) or result.exit_status:
        raise RuntimeError(f"{folder}: the campaign ended early: {result.title}")
    return tuple(folder / part.path.name for part in result.parts)


@contextmanager
def _key(case: Case, repeat: int, fineness: Fineness | None) -> Iterator[None]:
    """Let the drivers read a case, while the context lasts."""
    before = os.environ.get(KEY_VARIABLE)
    content: dict[str, Any] = {"case": case.to_json(), "repeat": repeat}
    if fineness is not None:
        content["fineness"] = asdict(fineness)
    with tempfile.NamedTemporaryFile("w", suffix=".json", encoding="utf-8") as file:
        json.dump(content, file)
        file.flush()
        os.environ[KEY_VARIABLE] = file.name
        try:
            yield
        finally:
            del os.environ[KEY_VARIABLE]
            if before is not None:
                os.environ[KEY_VARIABLE] = before
