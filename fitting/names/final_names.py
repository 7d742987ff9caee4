"""One name for each mode of a fit."""

from collections.abc import Collection, Mapping, Sequence

from fitting.names.naming import SURE, ModeNaming


def final_names(
    labels: Sequence[str], naming: Mapping[str, ModeNaming], doubtful: Collection[str]
) -> tuple[str, ...]:
    """Return the name of each mode of a fit; no two are the same.

    Modes that are measured have the names that they were given, with a question mark if these are
    not sure. A mode that is not identified keeps the name that it had, if no other mode has it now;
    else it takes one that is left.

    Parameters
    ----------
    labels : sequence of str
        Names of the shapes that the fit started from.
    naming : mapping
        See `JointFit`.
    doubtful : collection of str
        Labels of the modes that are not identified.
    """
    given = {
        label: naming[label].name for label in labels if label in naming and label not in doubtful
    }
    taken = set(given.values())
    rest = [label for label in labels if label not in given]
    kept = {label: label for label in rest if label not in taken}
    left = [label for label in labels if label not in taken | set(kept)]
    others = [label for label in rest if label not in kept]
    spare = dict(zip(others, left, strict=False))
    return tuple(
        given[label] + ("" if naming[label].probability >= SURE else "?")
        if label in given
        else kept.get(label) or spare.get(label) or f"{label} again"
        for label in labels
    )
