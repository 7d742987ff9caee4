"""The reference of all keys: complete, with a description and a unit for each."""

import importlib.util
import re
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
SHIPPED = {
    "protocol": ("protocols/seriesA.yaml", "protocols/quick.yaml"),
    "bench": ("protocols/benches/simulated.yaml", "protocols/benches/emulated.yaml"),
    "reed": ("protocols/reeds/clarinet.yaml", "protocols/reeds/alto-saxophone.yaml"),
    "campaign": ("protocols/campaign.yaml",),
}
# Sections whose keys are names of their own: key paths of a protocol, options of a driver.
FREE = re.compile(r"parts\[\]\.change\.|instruments\.\w+\.options\.|known\.")


@pytest.fixture(scope="module")
def tables():
    spec = importlib.util.spec_from_file_location("reference_keys", ROOT / "docs/reference_keys.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return {table.name: table for table in module.tables()}


def paths_in(content, prefix=""):
    """Yield the key paths of a file, lists as ``[]``."""
    if isinstance(content, dict):
        for key, value in content.items():
            yield f"{prefix}{key}"
            yield from paths_in(value, f"{prefix}{key}.")
    elif isinstance(content, list):
        for each in content:
            yield from paths_in(each, f"{prefix.removesuffix('.')}[].")


def test_every_key_has_a_type_and_a_description(tables):
    assert {"protocol", "bench", "reed", "campaign", "basler", "novatech-409b"} <= set(tables)
    for table in tables.values():
        assert table.description
        assert table.keys
        for key in table.keys:
            assert key.kind, key.path
            assert key.description.endswith((".", ")")), key.path


@pytest.mark.parametrize("kind", SHIPPED)
def test_all_keys_of_the_shipped_files_are_in_the_reference(tables, kind):
    known = {key.path for key in tables[kind].keys}
    for file in SHIPPED[kind]:
        for path in paths_in(yaml.safe_load((ROOT / file).read_text(encoding="utf-8"))):
            assert path in known or FREE.match(path), path


def test_a_key_has_unit_range_default_and_condition(tables):
    keys = {(key.path, key.when): key for key in tables["protocol"].keys}
    interval = keys["sweep.interval", "law: geometric"]
    assert (interval.kind, interval.unit, interval.default) == ("interval", "cents", "required")
    assert interval.allowed == "above 0, at most 1200"
    laws = keys["sweep.law", ""]
    assert laws.allowed.startswith("`geometric`, `linear`, `list`")
    assert keys["sweep.frequencies", "law: list"].kind == "list of frequency"
    assert keys["tolerance.lock_phase", ""].default == "0.01 rad"
    assert keys["policy.bad_step.then", ""].allowed == "`skip`, `stop`"
    assert keys["camera.exposure", ""].default == "none"
    assert keys["policy.bad_step", ""].default == '{"retries": 1, "then": "skip"}'
