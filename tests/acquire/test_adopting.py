"""Effects that a diagnosis has found are written into the bench file, and nothing else changes."""

import os
import stat
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acquire.adopting import require_adoptable, size_text, write_known
from acquire.errors import UsageError
from diagnosis.inference.problem import LocatedEffect
from holography.errors import BenchError
from physics.effects.catalogue import BY_ID
from protocols.bench import BenchFile, find_bench
from protocols.bench_parameters import known_effects, number_with_error_in, sized_effects
from protocols.errors import ProtocolError
from reports.diagnosis_page import adopted_words

SHIPPED = Path(str(find_bench("simulated")))
TEXT = SHIPPED.read_text(encoding="utf-8")


def verdict_of(*names: str, **location: float) -> SimpleNamespace:
    """A verdict that names effects, each with sizes of half their scale and a tenth of error."""
    effects = [LocatedEffect(BY_ID[name], location) for name in names]
    sizes = {e.effect.id: [(p, 0.5, 0.1) for p in e.effect.sizes] for e in effects}
    candidate = SimpleNamespace(effects=effects, size_estimates=sizes)
    name = "+".join(names)
    return SimpleNamespace(
        effects=names,
        selection=SimpleNamespace(candidate=lambda asked: candidate if asked == name else None),
        probability_of_what_shows={name: 0.934},
    )


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    path = tmp_path / "lab.yaml"
    path.write_text(TEXT.replace("simulated bench", "lab"), encoding="utf-8")
    return path


def test_what_is_named_is_known_afterwards_with_its_errors(lab: Path) -> None:
    before = lab.read_text("utf-8")
    written = write_known(verdict_of("laser_power_drift", "air_load"), lab, "R07")
    (power, air) = sized_effects(known_effects(BenchFile.from_file(lab)), "lab")
    for sized in (power, air):
        assert set(written[sized.effect.id]) == {p.name for p in sized.effect.sizes}
        for size in sized.effect.sizes:
            assert sized.values[size.name] == pytest.approx(0.5 * size.scale, rel=0.02)
            assert sized.errors[size.name] == pytest.approx(0.1 * size.scale, rel=0.06)
    after = lab.read_text("utf-8")
    assert after.startswith(before)
    assert "reed R07 (probability 93%)" in after


def test_a_place_has_no_error(lab: Path) -> None:
    crack = BY_ID["crack"]
    place = {p.name: p.grid[1] for p in crack.gridded}
    write_known(verdict_of("crack", **place), lab, "R07")
    (sized,) = sized_effects(known_effects(BenchFile.from_file(lab)), "lab")
    assert set(sized.errors) == {p.name for p in crack.sizes}
    assert {name: sized.values[name] for name in place} == pytest.approx(place, rel=1e-5)


def test_every_place_of_every_effect_can_be_read_again(lab: Path) -> None:
    before = lab.read_bytes()
    for effect in [each for each in BY_ID.values() if each.gridded]:
        for end in (0, -1):
            at = {p.name: p.grid[end] for p in effect.gridded}
            write_known(verdict_of(effect.id, **at), lab, "R07")
            (sized,) = sized_effects(known_effects(BenchFile.from_file(lab)), "lab")
            assert {each: sized.values[each] for each in at} == at
            lab.write_bytes(before)


@pytest.mark.parametrize("reed", ["R\n07", "R\x1b[31m", "known: {x: 1}\r\n# y"])
def test_no_name_of_a_reed_leaves_its_comment(lab: Path, reed: str) -> None:
    write_known(verdict_of("defocus"), lab, reed)
    assert set(known_effects(BenchFile.from_file(lab))) == {"defocus"}


def test_a_verdict_that_names_nothing_writes_nothing(lab: Path) -> None:
    before = lab.read_bytes()
    assert write_known(verdict_of(), lab, "R07") == {}
    assert lab.read_bytes() == before
    assert str(lab) in adopted_words({}, lab)


def test_an_effect_is_not_written_twice(lab: Path) -> None:
    write_known(verdict_of("air_load"), lab, "R07")
    before = lab.read_bytes()
    with pytest.raises(ProtocolError, match=r"lab.yaml: known.air_load is there already"):
        write_known(verdict_of("defocus", "air_load"), lab, "R07")
    assert lab.read_bytes() == before
    write_known(verdict_of("defocus"), lab, "R07")
    assert set(known_effects(BenchFile.from_file(lab))) == {"air_load", "defocus"}


def test_rights_and_line_ends_of_the_file_stay(lab: Path) -> None:
    lab.write_bytes(lab.read_bytes().replace(b"\n", b"\r\n"))
    lab.chmod(0o640)
    write_known(verdict_of("defocus"), lab, "R07")
    assert stat.S_IMODE(lab.stat().st_mode) == 0o640
    assert b"\n" not in lab.read_bytes().replace(b"\r\n", b"")


def test_a_link_is_refused_and_its_target_stays(lab: Path, tmp_path: Path) -> None:
    link = tmp_path / "link.yaml"
    link.symlink_to(lab)
    before = lab.read_bytes()
    with pytest.raises(BenchError, match="link"):
        write_known(verdict_of("defocus"), link, "R07")
    assert lab.read_bytes() == before


def test_files_of_the_program_and_of_other_benches_are_refused(lab: Path) -> None:
    described = BenchFile.from_file(lab)
    require_adoptable(lab, described, described)
    require_adoptable(lab, None, None)
    for shipped in ("simulated", str(SHIPPED), os.path.relpath(SHIPPED)):
        with pytest.raises(UsageError, match="copy it"):
            require_adoptable(Path(shipped), None, None)
    with pytest.raises(UsageError, match="'simulated bench'"):
        require_adoptable(lab, described, BenchFile.from_file("simulated"))
    lab.chmod(0o444)
    if not os.access(lab, os.W_OK):
        with pytest.raises(BenchError, match="permission denied"):
            require_adoptable(lab, described, described)
    lab.chmod(0o644)
    link = lab.with_name("link.yaml")
    link.symlink_to(lab)
    with pytest.raises(BenchError, match="--adopt"):
        require_adoptable(link, described, described)
    known = described.replace({"known": {"air_load": {"fraction": 0.3}}})
    with pytest.raises(UsageError, match="--bench"):
        require_adoptable(lab, known, described)


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (0.31, 0.04, "0.310 ± 0.040"),
        (5.04e-6, 1.2e-6, "5.0e-06 ± 1.2e-06"),
        (4308.61, 0.42, "4308.61 ± 0.42"),
        (-12346.0, 230.0, "-12350 ± 230"),
        (0.0, 1e-6, "0.0e+00 ± 1.0e-06"),
        (0.5, float("nan"), "0.5"),
        (0.5, 0.0, "0.5"),
    ],
)
def test_a_size_has_two_digits_of_its_error(value: float, error: float, text: str) -> None:
    size = BY_ID["air_load"].sizes[0]
    assert size_text(size, value, error) == text


@given(st.floats(-1e6, 1e6), st.floats(1e-9, 1e6))
def test_a_written_size_is_read_as_it_was(value: float, error: float) -> None:
    size = BY_ID["defocus"].sizes[0]
    read, spread = number_with_error_in(size.unit, size_text(size, value, error))
    assert abs(read - value) <= 0.06 * error
    assert spread == pytest.approx(error, rel=0.06)
