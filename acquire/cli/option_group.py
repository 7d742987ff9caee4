"""Options that belong together: a verb takes them as one frozen dataclass.

Typer reads the options of a verb from the parameters of its function. A verb with many options
would be a function with as many parameters. With `takes_options`, the fields of a dataclass become
options, and the verb gets one object.
"""

import functools
import inspect
from collections.abc import Callable
from dataclasses import MISSING, fields, is_dataclass
from typing import Any, get_type_hints


def takes_options(verb: Callable[..., None]) -> Callable[..., None]:
    """Turn each field of a verb's dataclass parameters into an option.

    Parameters
    ----------
    verb : callable
        A function with annotated parameters. The fields of a dataclass are annotated as Typer
        wants: ``Annotated[TYPE, typer.Option(…)]``, with a default.

    Returns
    -------
    callable
        With the fields of each dataclass in place of the parameter.
    """
    hints = get_type_hints(verb, include_extras=True)
    groups: dict[str, Any] = {name: hint for name, hint in hints.items() if is_dataclass(hint)}
    parameters: list[inspect.Parameter] = []
    for parameter in inspect.signature(verb).parameters.values():
        group = groups.get(parameter.name)
        if group is None:
            annotated = parameter.replace(annotation=hints[parameter.name])
            parameters.append(annotated.replace(kind=inspect.Parameter.KEYWORD_ONLY))
        else:
            parameters += _options_of(group)

    @functools.wraps(verb)
    def expanded(**values: Any) -> None:
        for name, group in groups.items():
            own = {field.name: values.pop(field.name) for field in fields(group)}
            values[name] = group(**own)
        verb(**values)

    expanded.__dict__["__signature__"] = inspect.Signature(parameters)
    expanded.__annotations__ = {each.name: each.annotation for each in parameters}
    return expanded


def _options_of(group: Any) -> list[inspect.Parameter]:
    hints = get_type_hints(group, include_extras=True)
    return [
        inspect.Parameter(
            field.name,
            inspect.Parameter.KEYWORD_ONLY,
            default=inspect.Parameter.empty if field.default is MISSING else field.default,
            annotation=hints[field.name],
        )
        for field in fields(group)
    ]
