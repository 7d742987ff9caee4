"""A diagnosis as one self-contained HTML page, and as words for the command line."""

import base64
import math
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Final

from diagnosis.how_far import Shrinkage
from diagnosis.verdict import Verdict
from diagnosis.where import Map
from physics.effects.catalogue import BY_ID
from physics.effects.form import Tap
from reports.drawing import png_of
from reports.gap_map import draw_map
from reports.own_output import (
    Output,
    page_kind,
    write_output,
)
from reports.plain_text import escaped

TAP_WORDS: Final[Mapping[Tap, str]] = {
    Tap.LOG: "logs",
    Tap.DRIVE: "drive",
    Tap.SENSOR: "sensor",
    Tap.HOLOGRAM: "holograms",
    Tap.FIELD: "field of the reed at rest",
    Tap.MAPS: "sideband maps",
    Tap.RESPONSE: "response",
    Tap.MODES: "modes",
    Tap.MATERIAL: "material",
}
_NOT_PROOF: Final = "Closing a gap does not prove its cause: a wrong effect may close it as well."
_SHOWN = 12
_RATHER_THAN_NOT = 0.5
_PAGE: Final = page_kind("diagnosis")
_STYLE: Final = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1c1c1c; max-width: 1100px;
       margin: 2rem auto; padding: 0 1.5rem; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.15rem; margin-top: 2.4rem; }
.lead { font-size: 1.15rem; }
table { border-collapse: collapse; margin: 0.6rem 0; }
th, td { padding: 0.15rem 0.7rem; text-align: left; border-bottom: 1px solid #ddd; }
td.number { text-align: right; }
img { max-width: 100%; display: block; } .facts { color: #555; }
"""


def words(verdict: Verdict) -> list[str]:
    """What the diagnosis says, in sentences."""
    said = [_headline(verdict), _where(verdict.where)]
    if verdict.kind != "not converged":
        said.append(f"Likely, 90 % together: {_likely_words(verdict)}.")
    if verdict.closed is not None and verdict.effects:
        said.append(_closed_words(verdict))
        said.append(_NOT_PROOF)
    if verdict.next_actions:
        best = verdict.next_actions[0]
        one, other = verdict.rivals
        said.append(
            f"To tell {_title(one)} from {_title(other)}: {best.action.words} "
            f"({best.action.minutes:g} min, about {best.nats:.1f} nats)."
        )
    said += [f"Not measured: {what}." for what in verdict.missing]
    said += [f"Not used: {why}." for why in verdict.refused]
    return said


def _headline(verdict: Verdict) -> str:
    if verdict.kind == "none":
        p = verdict.probability.get("none", 0.0)
        return f"Nothing is seen to be wrong with the twin ({p:.0%})."
    if verdict.kind == "unknown":
        p = verdict.probability.get("unknown", 0.0)
        beside = verdict.unknown_beside
        known = "" if beside == "none" else f", beside {_title(beside)}"
        seen = f"seen in: {verdict.unknown_in}"
        return f"Something that the catalogue does not have ({p:.0%}){known}, {seen}."
    if verdict.kind == "not converged":
        return "Not converged: no fit can be trusted, so no effect is named."
    name = "+".join(verdict.effects)
    p = verdict.probability.get(name, 0.0)
    # What is alike speaks for the same.
    group = next((group for group in verdict.likely if name in group), (name,))
    sure = sum(verdict.probability.get(other, 0.0) for other in group) >= _RATHER_THAN_NOT
    leaves_out = "leaves out" if sure else "most likely, but not surely, leaves out"
    return f"The twin {leaves_out}: {_title(name)} ({p:.0%})."


def _where(where: Map) -> str:
    tap = where.first_failing
    if tap is None:
        return "No observable differs by more than chance."
    worst = where.taps[tap]
    at = f"{worst.block}, {worst.label}" if worst.label != worst.block else worst.block
    gap = f"{worst.gap:.1f} times its floor"
    return f"First tap that differs: {tap} ({TAP_WORDS[tap]}), {gap} in {at}."


def _likely_words(verdict: Verdict) -> str:
    """Classes, and at last what may be beside the likeliest effect and need not show."""
    unseen = [g for g in verdict.likely if all(_is_unseen(name, verdict) for name in g)]
    said = [_class_words(group, verdict) for group in verdict.likely if group not in unseen]
    if unseen:
        names = [name for group in unseen for name in group]
        first = verdict.contest.unseen[names[0]][0]
        others = ", ".join(_title(name.removeprefix(f"{first}+")) for name in names)
        p = sum(verdict.probability.get(name, 0.0) for name in names)
        said.append(f"{_title(first)} beside what need not show ({p:.0%}): {others}")
    return "; ".join(said)


def _is_unseen(name: str, verdict: Verdict) -> bool:
    return "+" in name and name in verdict.contest.unseen


def _class_words(group: tuple[str, ...], verdict: Verdict) -> str:
    p = sum(verdict.probability.get(name, 0.0) for name in group)
    titles = " or ".join(_title(name) for name in group)
    return f"{titles} ({p:.0%})"


def _title(name: str) -> str:
    parts = [BY_ID[part].title if part in BY_ID else part for part in name.split("+")]
    return " and ".join(parts) if name != "none" else "no effect"


def _closed_words(verdict: Verdict) -> str:
    said = f"It closes {_share(verdict.closed)} of the gap on numbers left out"
    if verdict.transferred is not None:
        said += f", {_share(verdict.transferred)} in sweep '{verdict.condition}', left out whole"
    return said + "."


def _share(closed: Shrinkage | None) -> str:
    if closed is None or math.isnan(closed.kappa):
        return "no resolvable part"
    # What is left may be less than its floor: that closes no more than all.
    kappa, low, high = (min(share, 1.0) for share in (closed.kappa, closed.low, closed.high))
    return f"{kappa:.0%}" if math.isnan(low) else f"{kappa:.0%} [{low:.0%}, {high:.0%}]"


def page_output(page: Path) -> Output:
    """Page as an output, for `reports.own_output.require_writable`."""
    return Output(page, _PAGE)


def write_page(verdict: Verdict, title: str, page: Path, runs: Sequence[str] = ()) -> None:
    """Write the page.

    Parameters
    ----------
    verdict : Verdict
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


def document(verdict: Verdict, title: str, runs: Sequence[str] = ()) -> str:
    """The whole page."""
    said = words(verdict)
    by = f"{', '.join(runs)}; by reedbench {version('reedbench')}" if runs else ""
    picture = base64.b64encode(png_of(draw_map(verdict.where), dpi=110)).decode()
    body = [
        f"<h1>{escaped(title)}</h1>",
        f'<p class="lead">{escaped(said[0])}</p>',
        *(f"<p>{escaped(sentence)}</p>" for sentence in said[1:]),
        "<h2>Where</h2>",
        f'<img alt="Gap of every cell" src="data:image/png;base64,{picture}">',
        '<p class="facts">Gap in units of its floor: errors of data, numerics and inputs. Below 1 '
        "it is not resolvable, which does not mean that twin and bench agree. Coloured cells are "
        "such as chance makes in fewer than one of a hundred campaigns, each by itself; a tap "
        "differs if chance makes as much of none of all its cells. White: no such numbers.</p>",
        _ladder(verdict.where),
        "<h2>Which</h2>",
        _effects(verdict),
        _triggers(verdict),
        "<h2>How far</h2>",
        _plain(verdict),
        "<h2>What to measure next</h2>",
        _actions(verdict),
        "<h2>What these runs could have shown</h2>",
        _reach(verdict),
        f'<p class="facts">{escaped(by)}</p>',
    ]
    return (
        f"{_PAGE.mark}<title>{escaped(title)}</title><style>{_STYLE}</style></head>"
        f"<body>{''.join(body)}</body></html>"
    )


def _table(headings: Sequence[str], rows: Sequence[Sequence[str]], numbers: Sequence[int]) -> str:
    """Table of texts; columns of these numbers, from 0, are set flush right."""
    top = "".join(f"<th>{escaped(heading)}</th>" for heading in headings)
    lines = []
    for row in rows:
        cells = (
            f'<td class="number">{escaped(text)}</td>'
            if column in numbers
            else f"<td>{escaped(text)}</td>"
            for column, text in enumerate(row)
        )
        lines.append(f"<tr>{''.join(cells)}</tr>")
    return f"<table><tr>{top}</tr>{''.join(lines)}</table>"


def _ladder(where: Map) -> str:
    """Shares of the gap by tap."""
    if not where.ladder:
        return (
            '<p class="facts">Of all numbers together the gap is not resolvable, so that no stage '
            "is given a share of it.</p>"
        )
    rows = [
        (f"{rung.tap} {TAP_WORDS[rung.tap]}", f"{rung.forward:.0%}", f"{rung.backward:.0%}",
         f"{rung.error:.0%}")
        for rung in where.ladder
    ]  # fmt: skip
    headings = (
        "stage",
        "share, earlier stages as measured",
        "later stages as measured",
        "± by chance",
    )
    return _table(headings, rows, (1, 2, 3))


def _effects(verdict: Verdict) -> str:
    shown = sorted(verdict.probability.items(), key=lambda item: -item[1])[:_SHOWN]
    rows = []
    for name, p in shown:
        action = "; ".join(BY_ID[part].action for part in name.split("+") if part in BY_ID)
        rows.append((_title(name), f"{p:.1%}", _size_words(verdict, name), action))
    return _table(("effect", "probability", "size", "what tells it apart"), rows, (1,))


def _size_words(verdict: Verdict, name: str) -> str:
    """Sizes of an effect, or of two, each with its own, as fitted, with errors."""
    rival = verdict.contest.rival(name)
    told = []
    for effect, sizes in (rival.told if rival else {}).items():
        own = "; ".join(
            f"{p.name} {p.spread * z:.2g} ± {p.spread * error:.1g} {p.unit}".strip()
            for p, z, error in sizes
        )
        told.append(own if effect == name else f"{_title(effect)}: {own}")
    return "; ".join(told)


def _triggers(verdict: Verdict) -> str:
    rows = [
        (trigger.words, f"{trigger.value:.3g}", f"{trigger.chance:.1%}",
         "yes" if trigger.fired else "no")
        for trigger in verdict.triggers
    ]  # fmt: skip
    headings = "sign of something that the catalogue lacks", "value", "by chance", "counts"
    return _table(headings, rows, (1, 2))


def _plain(verdict: Verdict) -> str:
    rows = [
        (gap.quantity, f"{gap.before:.3g}", f"{gap.after:.3g}", f"{gap.error:.2g}")
        for gap in verdict.plain
    ]
    name = "+".join(verdict.effects) or "what explains most"
    told = _title(name) if verdict.effects else name
    headings = "what is left (shapes: sum; others: rms)", "without", f"with {told}", "uncertain"
    return f"{_table(headings, rows, (1, 2, 3))}<p>{escaped(_NOT_PROOF)}</p>"


def _actions(verdict: Verdict) -> str:
    rows = [
        (w.action.words, f"{w.action.minutes:g}", f"{w.nats:.1f}", f"{w.nats_per_minute:.2f}")
        for w in verdict.next_actions
    ]
    one, other = verdict.rivals
    between = f"to tell {_title(one)} from {_title(other)}" if one else ""
    facts = f'<p class="facts">Expected log odds {escaped(between)}.</p>'
    return facts + _table(("action", "minutes", "nats", "nats per minute"), rows, (1, 2, 3))


def _reach(verdict: Verdict) -> str:
    """Least sizes that would have been seen, and what each effect would be taken for."""
    rows = []
    for entry in verdict.reach:
        effect = BY_ID[entry.effect]
        least = "; ".join(
            f"{p.name} {entry.detectable[p.name]:.2g} {p.unit}".strip()
            if math.isfinite(entry.detectable[p.name])
            else f"{p.name}: no size"
            for p in effect.sizes
        )
        absorbed = "" if math.isnan(entry.absorbed) else f"{entry.absorbed:.0%}"
        rows.append((effect.title, least, absorbed, ", ".join(_title(o) for o in entry.alike)))
    headings = "effect", "least size to be seen", "absorbed by nuisance parameters", "not told from"
    return _table(headings, rows, (2,))
