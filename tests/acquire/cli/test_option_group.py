"""Options that a verb takes as one dataclass."""

import inspect
from dataclasses import dataclass
from typing import Annotated

import pytest
import typer
from typer.testing import CliRunner

from acquire.cli.option_group import takes_options


@dataclass(frozen=True)
class Colours:
    """Two options."""

    wall: Annotated[str, typer.Option(help="Of the wall.")] = "white"
    floors: Annotated[int, typer.Option("--floors", "--storeys")] = 1


@pytest.fixture
def app():
    heard = []

    @takes_options
    def paint(
        house: Annotated[str, typer.Argument()], colours: Colours, fast: bool = False
    ) -> None:
        heard.append((house, colours, fast))

    application = typer.Typer()
    application.command()(paint)
    return application, paint, heard


def test_fields_become_options_in_place_of_the_group(app):
    _, paint, _ = app
    assert list(inspect.signature(paint).parameters) == ["house", "wall", "floors", "fast"]


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["mine"], ("mine", Colours(), False)),
        (["mine", "--wall", "red", "--fast"], ("mine", Colours("red", 1), True)),
        (["--storeys", "3", "mine"], ("mine", Colours("white", 3), False)),
    ],
)
def test_the_verb_gets_one_object(app, arguments, expected):
    application, _, heard = app
    assert CliRunner().invoke(application, arguments).exit_code == 0
    assert heard == [expected]


def test_a_wrong_value_is_a_usage_error(app):
    application, _, heard = app
    assert CliRunner().invoke(application, ["mine", "--floors", "many"]).exit_code == 2
    assert heard == []
