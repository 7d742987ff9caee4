"""The parameter tree: every number has unit, range and source, and changes where it should."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from physics.alterations import TipMass
from physics.effects.catalogue import CATALOGUE
from physics.parameters.quantity import Quantity, leaves, quantity
from physics.parameters.tree import BenchParameters, more, part_at, with_alteration, with_part

UNITS = {
    "", "Hz", "Hz/h", "m", "m/s", "s", "h", "rad", "rad/s^0.5", "1/rad2", "1/h", "1/degC", "degC/h",
    "Pa/V", "ppm", "dn", "electrons", "electrons/s", "electrons/dn", "kg/m3", "MPa", "MPa s",
}  # fmt: skip


def test_every_number_of_the_tree_has_a_unit_a_range_and_a_source() -> None:
    for leaf in leaves(BenchParameters()):
        assert leaf.quantity is not None, leaf.path
        assert leaf.quantity.source, leaf.path
        assert leaf.quantity.unit in UNITS, leaf.path
        assert leaf.plausible, leaf.path


@pytest.mark.parametrize("effect", CATALOGUE, ids=lambda effect: effect.id)
def test_an_effect_of_the_usual_size_leaves_all_numbers_plausible(effect) -> None:
    values = {p.name: p.grid[0] if p.grid else p.spread for p in effect.parameters}
    changed = effect.change(BenchParameters(), values)
    assert [leaf.path for leaf in leaves(changed) if not leaf.plausible] == []


def test_a_number_outside_its_own_range_cannot_be_declared() -> None:
    with pytest.raises(ValueError, match="range"):
        quantity(2.0, "m", 0.0, 1.0, "a source")
    with pytest.raises(ValueError, match="source"):
        quantity(0.5, "m", 0.0, 1.0, "")


def test_moments_of_a_range_are_those_of_numbers_spread_evenly_over_it() -> None:
    known = Quantity("m", -1.0, 4.0, "a source")
    even = np.linspace(-1.0, 4.0, 100_001)
    assert known.deviation == pytest.approx(even.std(), rel=1e-4)
    assert known.root_mean_square == pytest.approx(np.sqrt(np.mean(even**2)), rel=1e-4)


def test_a_leaf_knows_whether_it_is_plausible() -> None:
    @dataclass(frozen=True)
    class Box:
        length_m: float = quantity(1.0, "m", 0.5, 2.0, "a ruler")
        name: str = "box"

    (leaf,) = leaves(Box())
    assert (leaf.path, leaf.value, leaf.plausible) == ("length_m", 1.0, True)
    (long,) = leaves(Box(length_m=3.0))
    assert not long.plausible


def test_parts_are_changed_at_any_depth_and_nothing_else() -> None:
    nominal = BenchParameters()
    changed = with_part(nominal, "optics.illumination", vignette=0.1)
    assert part_at(changed, "optics.illumination").vignette == 0.1
    back = replace(changed.optics.illumination, vignette=0.0)
    assert with_part(changed, "optics", illumination=back) == nominal
    assert more(nominal, "clocks", detuning_hz=0.0) is nominal
    assert more(more(nominal, "clocks", detuning_hz=0.1), "clocks", detuning_hz=0.2).clocks == (
        replace(nominal.clocks, detuning_hz=pytest.approx(0.3))
    )
    heavy = with_alteration(nominal, TipMass(), 1e-6)
    assert with_alteration(heavy, TipMass(), 0.0) is heavy
    assert heavy.reed.alterations == ((TipMass(), 1e-6),)
