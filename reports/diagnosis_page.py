"""A diagnosis as an HTML page, and as sentences for the command line."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from diagnosis.campaign_diagnosis import Diagnosis
from diagnosis.effect_notes import notes_of
from diagnosis.experiment_design import LEAST_NATS
from diagnosis.explained_fraction import ExplainedFraction, GapInUnits, KnownGap
from diagnosis.floor_certificate import Floor
from diagnosis.gap_map import GapMap
from diagnosis.observable_groups import Observable
from physics.effects.catalogue import BY_ID
from protocols.yaml_files.insertion import Entry
from reports.effects import size_words
from reports.figures.drawing import png_of
from reports.figures.gap_map import draw_map
from reports.own_output import Output, page_kind, write_output
from reports.pages import Picture, render
from reports.tables import Column, Table

GROUP_WORDS: Final[Mapping[Observable, str]] = {
    Observable.LOG: "logs",
    Observable.DRIVE: "drive",
    Observable.SENSOR: "sensor",
    Observable.HOLOGRAM: "holograms",
    Observable.FIELD: "field of the reed at rest",
    Observable.MAPS: "sideband maps",
    Observable.RESPONSE: "response",
    Observable.MODES: "modes",
    Observable.MATERIAL: "material",
}
_NOT_PROOF: Final = (
    "This does not prove the cause: a wrong effect may explain the difference as well."
)
# The most probable candidates that the page lists; the others have next to no probability.
_LISTED = 12
# An effect is called the cause if it is more probable than not.
_PROBABLE = 0.5
_PAGE: Final = page_kind("diagnosis")


def words(verdict: Diagnosis) -> list[str]:
    """Return what the diagnosis says, in sentences: the cause, what to do next, and the rest."""
    said = [_headline(verdict), _action(verdict), _where(verdict.gap)]
    if verdict.kind != "not converged":
        said.append(f"Candidates that together have 90 % probability: {_likely_words(verdict)}.")
        low, high = verdict.likeliest_range
        said.append(
            f"If no effect, one effect, two effects, or an unknown cause is given three times more "
            "or less prior probability, that of the first candidate stays between "
            f"{low:.0%} and {high:.0%}. What would not show in these runs counts as no effect."
        )
    if verdict.explained is not None and verdict.effects:
        said.append(f"{_closed_words(verdict)} {_NOT_PROOF}")
    if verdict.known is not None:
        said.append(_known_words(verdict.known))
    said += [f"Not measured: {what}." for what in verdict.missing]
    said += [f"Not used: {why}." for why in verdict.refused]
    return said


def _headline(verdict: Diagnosis) -> str:
    if verdict.kind == "none":
        p = verdict.probability_of_what_shows["none"]
        return (
            "No cause of a difference between measurement and simulation was found that these runs "
            f"could show ({p:.0%})."
        )
    if verdict.kind == "unknown":
        p = verdict.probability_of_what_shows.get("unknown", 0.0)
        other = verdict.unknown_with
        known = "" if other == "none" else f", in addition to {_title(other)}"
        return (
            f"Cause of the difference: something that is not in the catalogue ({p:.0%}){known}. "
            f"It shows in: {verdict.unknown_in}."
        )
    if verdict.kind == "not converged":
        return "The fits have not converged, so no cause is named."
    name = "+".join(verdict.effects)
    p = verdict.probability_of_what_shows.get(name, 0.0)
    # Confusable effects count together: the data cannot say which of them it is.
    group = next((group for group in verdict.shown if name in group), (name,))
    sure = sum(verdict.probability_of_what_shows.get(other, 0.0) for other in group) >= _PROBABLE
    what = "Cause of the difference" if sure else "Most likely cause, which is not certain"
    # Second sizes say little without the page.
    sizes = size_words(verdict.selection.candidate(name), strengths_only=True)
    own = f"{_title(name)} ({p:.0%})" + (f", {sizes}" if sizes else "")
    if len(group) == 1:
        return f"{what}: {own}."
    return (
        f"{what}: {_class_words(group, verdict)}, which these runs cannot separate. "
        f"The likeliest: {own}."
    )


def _where(where: GapMap) -> str:
    tap = where.first_failing
    if tap is None:
        return "No single observable differs by more than chance explains."
    worst = where.observables[tap]
    at = f"{worst.group}, {worst.label}" if worst.label != worst.group else worst.group
    return (
        f"First observables that differ: {GROUP_WORDS[tap]}, by {worst.gap:.1f} times "
        f"their standard error, in {at}."
    )


def _likely_words(verdict: Diagnosis) -> str:
    """Return the likeliest classes of candidates."""
    return "; ".join(_class_words(group, verdict) for group in verdict.shown)


def _class_words(group: tuple[str, ...], verdict: Diagnosis) -> str:
    p = sum(verdict.probability_of_what_shows.get(name, 0.0) for name in group)
    titles = " or ".join(_title(name) for name in group)
    return f"{titles} ({p:.0%})"


def _title(name: str) -> str:
    parts = [BY_ID[part].title if part in BY_ID else part for part in name.split("+")]
    return " + ".join(parts) if name != "none" else "no effect"


def _closed_words(verdict: Diagnosis) -> str:
    own = _fraction(verdict.explained)
    said = f"It explains {own} of the difference in numbers left out of the fit"
    if verdict.explained_other_sweep is not None:
        other = _fraction(verdict.explained_other_sweep)
        said += f", and {other} in sweep '{verdict.condition}', left out whole"
    return said + "."


def _known_words(known: KnownGap) -> str:
    names = " and ".join(sized.effect.title for sized in known.effects)
    used = (
        "which were measured after these effects were written into the bench file"
        if known.foreseen
        else "which may have been used to find them"
    )
    return (
        f"Known effects of this bench ({names}) explain {_fraction(known.explained)} of the "
        f"difference in these runs, {used}."
    )


def _action(verdict: Diagnosis) -> str:
    """Return the one thing to do next."""
    if verdict.effects and len(verdict.shown) == 1:
        checks = "; ".join(notes_of(BY_ID[name]).check for name in verdict.effects)
        return (
            f"What to do next: {checks}. If that agrees, write the cause into the bench file "
            "(acquire diagnose … --adopt BENCH.yaml), and measure a campaign with it."
        )
    if verdict.kind == "none" and len(verdict.shown) == 1 and not verdict.missing:
        return "What to do next: nothing."
    best = next(iter(verdict.next_experiments), None)
    if best is not None and best.expected_nats >= LEAST_NATS:
        one, other = verdict.compared
        return (
            f"What to do next: {best.experiment.description} ({best.experiment.minutes:g} min), to "
            f"decide between {_title(one)} and {_title(other)} (about {best.expected_nats:.1f} "
            "nats)."
        )
    if verdict.missing:
        return f"What to do next: measure what is missing: {verdict.missing[0]}."
    return "What to do next: nothing. No further measurement would help to decide."


def _fraction(closed: ExplainedFraction | None) -> str:
    if closed is None or math.isnan(closed.fraction):
        return "no resolvable part"
    # A residual below its standard error would give more than 100 %.
    kappa, low, high = (min(share, 1.0) for share in (closed.fraction, closed.low, closed.high))
    return f"{kappa:.0%}" if math.isnan(low) else f"{kappa:.0%} [{low:.0%}, {high:.0%}]"


def adopted_words(adopted: Mapping[str, Entry], bench: Path) -> str:
    """Return what was written into a bench file, as a sentence."""
    if not adopted:
        return f"Nothing was written into {bench}, because no cause is named."
    written = "; ".join(
        f"{_title(name)}: " + ", ".join(f"{size} {text}" for size, text in entry.items())
        for name, entry in adopted.items()
    )
    return (
        f"Written into {bench} under known: {written}. Measure the next campaign with this file: "
        "its diagnosis says how much of the difference this explains in runs that were not used "
        "to find it."
    )


def page_output(page: Path) -> Output:
    """Return the page as an output, for `reports.own_output.require_writable`."""
    return Output(page, _PAGE)


def write_page(verdict: Diagnosis, title: str, page: Path, runs: Sequence[str] = ()) -> None:
    """Write the page.

    Parameters
    ----------
    verdict : Diagnosis
    title : str
    page : Path
        An older page of a diagnosis there is replaced, and nothing else.
    runs : sequence of str
        Names of the files that were diagnosed.

    Raises
    ------
    OutputRefusedError, OutputFailedError
        If it must not or cannot be written.
    """
    write_output(page_output(page), document(verdict, title, runs))


@dataclass(frozen=True)
class _Section:
    """A part of the page."""

    title: str
    tables: tuple[Table, ...] = ()
    text: str = ""


def document(verdict: Diagnosis, title: str, runs: Sequence[str] = ()) -> str:
    """Return the whole page: a sentence, an action and a picture; everything else is folded."""
    between = "no two candidates"
    if verdict.compared[0]:
        between = f"{_title(verdict.compared[0])} and {_title(verdict.compared[1])}"
    sections = (
        _stages(verdict.gap),
        _Section("Likeliest causes", (_causes(verdict), _triggers(verdict))),
        *_refuted_section(verdict),
        _Section("How much of the difference is explained", (_plain(verdict),), _NOT_PROOF),
        *_known_section(verdict.known),
        _Section(
            "What to measure next",
            (_actions(verdict),),
            f"How much each measurement is expected to help to decide between {between}.",
        ),
        _Section("What these runs could have shown", (_detectability(verdict),)),
        _unseen(verdict),
        _Section("How far the errors can be trusted", (_floor(verdict),), _floor_words(verdict)),
    )
    return render(
        "diagnosis.html",
        _PAGE,
        title,
        sentences=words(verdict),
        picture=_map(verdict.gap),
        sections=sections,
        runs=runs,
    )


def _map(where: GapMap) -> Picture:
    """Return the map of the gap."""
    return Picture(
        png_of(draw_map(where), dpi=110),
        "Gap of every group of observables by frequency band, mode, time, level and region",
        "Gap: difference between measurement and simulation, divided by its standard error (of "
        "data, numerics and inputs). Grey: a difference that chance explains, which does not mean "
        "that they agree. Coloured: chance makes such a cell in fewer than one of 100 campaigns. "
        "A group of observables differs if chance makes none of its cells as large. White: no "
        "such observables.",
        wide=True,
    )


def _stages(where: GapMap) -> _Section:
    """Return how the gap is shared among the stages of the measurement."""
    title = "How the difference is shared among the stages of the measurement"
    if not where.ladder:
        text = (
            "All observables together do not differ by more than chance explains, so the gap is "
            "not divided among stages."
        )
        return _Section(title, (), text)
    columns = (
        Column("stage", "stage"),
        Column("forward", "share of the gap, from the front", "", ".0%",
               "what the stage adds to the gap if all earlier stages are as measured"),
        Column("backward", "from the back", "", ".0%",
               "what it adds if all later stages are as measured"),
        Column("error", "±", "", ".0%", "standard deviation of either by chance"),
    )  # fmt: skip
    rows = tuple((GROUP_WORDS[r.observable], r.forward, r.backward, r.error)
                 for r in where.ladder)  # fmt: skip
    return _Section(title, (Table(columns, rows),))


def _causes(verdict: Diagnosis) -> Table:
    columns = (
        Column("cause", "cause"),
        Column("probability", "probability", "", ".1%"),
        Column("size", "size", meaning="fitted size ± standard error"),
        Column("action", "how to check it", meaning="what separates this cause from similar ones"),
    )
    listed = sorted(verdict.probability_of_what_shows.items(), key=lambda item: -item[1])[:_LISTED]
    rows = []
    for name, p in listed:
        action = "; ".join(notes_of(BY_ID[part]).check for part in name.split("+") if part in BY_ID)
        sizes = size_words(verdict.selection.candidate(name))
        rows.append((_title(name), p, sizes, action))
    return Table(columns, tuple(rows))


def _triggers(verdict: Diagnosis) -> Table:
    columns = (
        Column("sign", "sign of a cause that is not in the catalogue"),
        Column("value", "value", "", ".3g"),
        Column("chance", "by chance", "", ".1%", "probability of so large a value by chance"),
        Column("significant", "significant", meaning="chance makes as much in less than 1 of 100"),
    )
    rows = tuple(
        (t.description, t.value, t.chance, "yes" if t.significant else "no") for t in verdict.checks
    )
    return Table(columns, rows)


def _refuted_section(verdict: Diagnosis) -> tuple[_Section, ...]:
    """Return the causes that would explain more than nothing does, if nothing refuted them."""
    columns = (
        Column("cause", "cause"),
        Column("group", "group of observables"),
        Column("share", "share", "", ".0%",
               "of what the cause would change in this group, the part that was measured"),
        Column("error", "±", "", ".0%", "standard error of the share"),
    )  # fmt: skip
    rows = tuple(
        (_title(each.effect), each.group, each.share, each.error)
        for name, against in verdict.selection.refuted.items()
        if "+" not in name
        for each in against
    )
    text = (
        "These would explain a part of the difference, but would also change a group of "
        "observables that has not changed so. They are not named."
    )
    return (_Section("Causes that are refuted", (Table(columns, rows),), text),) if rows else ()


def _plain(verdict: Diagnosis) -> Table:
    name = "+".join(verdict.effects)
    effect = _title(name) if name else "the effect that explains most"
    return _gaps_table(verdict.gaps_in_units, "without an effect", f"with {effect}")


def _known_section(known: KnownGap | None) -> tuple[_Section, ...]:
    """Return the gap without and with the known effects of the bench; nothing if it has none."""
    if known is None:
        return ()
    table = _gaps_table(known.in_units, "without known effects", "with known effects")
    return (_Section("What the known effects explain", (table,), _known_words(known)),)


def _gaps_table(gaps: Sequence[GapInUnits], before: str, after: str) -> Table:
    columns = (
        Column("quantity", "residual", meaning="measurement less simulation, root mean square; "
               "of shapes the sum"),
        Column("before", before, "", ".3g"),
        Column("after", after, "", ".3g"),
        Column("error", "standard error", "", ".2g"),
    )  # fmt: skip
    return Table(columns, tuple((g.quantity, g.before, g.after, g.error) for g in gaps))


def _actions(verdict: Diagnosis) -> Table:
    columns = (
        Column("action", "measurement"),
        Column("minutes", "time", "min", "g"),
        Column("nats", "expected log odds", "nats", ".1f",
               "natural logarithm of the odds; 3 nats are odds of 20 to 1"),
        Column("nats_per_minute", "per minute", "nats/min", ".2f"),
    )  # fmt: skip
    rows = tuple(
        (w.experiment.description, w.experiment.minutes, w.expected_nats, w.nats_per_minute)
        for w in verdict.next_experiments
    )
    return Table(columns, rows)


def _floor_words(verdict: Diagnosis) -> str:
    doubtful = [floor for floor in verdict.floor if not floor.trusted]
    repeated = sum(floor.replicates > 0 for floor in verdict.floor)
    others = len(verdict.floor) - repeated
    unchecked = f" {others} groups without repeated numbers could not be checked." if others else ""
    wrong = [f"{number} ({floor.group})" for floor in verdict.floor for number in floor.wrong]
    if wrong:
        unchecked += f" Results of fits that are taken to be wrong: {'; '.join(wrong)}."
    if not doubtful:
        return f"{repeated} groups of observables scatter as their errors say.{unchecked}"
    said = "; ".join(f"{floor.group} ({_doubt(floor)})" for floor in doubtful)
    return (
        f"Groups that scatter more than their errors say, and count less for that: {said}."
        + unchecked
    )


def _doubt(floor: Floor) -> str:
    """Return why a group is not trusted: what is worst of errors, repeated numbers, and the fit."""
    if floor.inflated > 1:
        return (
            f"repeated numbers scattered {floor.inflated:.1f} times as much, without a trend; "
            "errors were increased by that factor before any cause was tried"
        )
    if floor.scatter > floor.factor:
        return f"repeated numbers scatter {floor.scatter:.1f} times as much"
    return f"noise {floor.factor:.1f} times as large"


def _floor(verdict: Diagnosis) -> Table:
    columns = (
        Column("group", "group of observables"),
        Column("count", "numbers", "", "d"),
        Column("replicates", "repeated", "", "d", "differences between repeated numbers"),
        Column("scatter", "scatter", "", ".2f",
               "of repeated numbers around what is named, divided by what their errors predict"),
        Column("chance", "by chance", "", ".1%", "probability of so much scatter by chance"),
        Column("order_chance", "p of order", "", ".0%",
               "fraction of permutations in time in which repeated numbers are as smooth; it is "
               "small where they drift"),
        Column("inflated", "factor before", "", ".2f",
               "by which errors were increased before any cause was tried"),
        Column("factor", "factor in fit", "", ".2f", "by which the fit increased the noise"),
    )  # fmt: skip
    rows = tuple(
        (f.group, f.count, f.replicates, f.scatter, f.chance, f.order_chance, f.inflated, f.factor)
        for f in verdict.floor
    )
    return Table(columns, rows)


def _unseen(verdict: Diagnosis) -> _Section:
    """Return the effects that would not show at any size, and what would show them."""
    title = "What it would take to see what these runs cannot show"
    if not verdict.unseen:
        return _Section(title, (), "Every effect would show in these runs at its largest size.")
    columns = (
        Column("effect", "effect"),
        Column("deviations", "shows here by", "standard errors", ".1f",
               "at the largest size that a bench can have; five would show"),
        Column("action", "measurement that shows it soonest"),
        Column("times", "times", "", "d"),
        Column("minutes", "time", "min", ".0f"),
    )  # fmt: skip
    none = "what is missing from these runs" if verdict.missing else "none that is known here"
    rows = tuple(
        (
            _title(each.effect),
            each.deviations,
            each.experiment.description if each.experiment else none,
            each.times,
            each.minutes,
        )
        for each in verdict.unseen
    )
    return _Section(title, (Table(columns, rows),))


def _detectability(verdict: Diagnosis) -> Table:
    """Return the smallest size of each effect that would show, and what it is confused with."""
    columns = (
        Column("effect", "effect"),
        Column("least", "minimum detectable size",
               meaning="size at which the effect exceeds its standard error five times"),
        Column("absorbed", "absorbed by nuisance parameters", "", ".0%",
               "part of its signature that parameters which differ from bench to bench explain"),
        Column("confusable", "confusable with"),
    )  # fmt: skip
    rows = []
    for entry in verdict.detectability:
        effect = BY_ID[entry.effect]
        least = "; ".join(
            f"{p.name} {entry.detectable[p.name]:.2g} {p.unit}".strip()
            if math.isfinite(entry.detectable[p.name])
            else f"{p.name}: no size"
            for p in effect.sizes
        )
        others = ", ".join(_title(other) for other in entry.confusable)
        rows.append((effect.title, least, entry.absorbed, others))
    return Table(columns, tuple(rows))
