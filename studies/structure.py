"""Size and shape of the code, and the words that a reader has to read twice.

Counts lines, files in a folder, the longest file and function, the most parameters, and old words
(`OLD_WORDS`) in everything that a person reads: docs, docstrings, comments and strings.

    python -m studies.structure [--words] [--json] [FOLDER]
"""

import argparse
import ast
import io
import json
import re
import tokenize
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

PACKAGES = (
    "holography", "physics", "protocols", "drivers", "runs", "fitting", "diagnosis", "reports",
    "reproduction", "acquire", "blind", "benchmarks", "studies",
)  # fmt: skip
# Words that mark the translated style which the project has left.
OLD_WORDS = (
    r"told", r"tells? of", r"beside", r"anew", r"alike", r"calm", r"livel(?:y|ier|iest)",
    r"so many", r"nobody", r"somebody", r"at last", r"stands? in\b(?! for)", r"taken up by",
    r"made of", r"house", r"room", r"seam",
)  # fmt: skip
_OLD = re.compile(r"\b(?:" + "|".join(OLD_WORDS) + r")\b", re.IGNORECASE)


@dataclass(frozen=True)
class Function:
    """A function that is longer, or takes more parameters, than others.

    Attributes
    ----------
    place : str
        ``file:name``.
    lines, parameters : int
    """

    place: str
    lines: int
    parameters: int


@dataclass(frozen=True)
class Structure:
    """Size and shape of a checkout.

    Attributes
    ----------
    lines : dict
        Lines of Python by package.
    files_per_folder : dict
        Number of Python files by folder, `__init__.py` not counted, the fullest first.
    longest_files : dict
        Lines by file, the longest first.
    longest, most_parameters : list of Function
    """

    lines: dict[str, int]
    files_per_folder: dict[str, int]
    longest_files: dict[str, int]
    longest: list[Function]
    most_parameters: list[Function]


def structure(root: Path, kept: int = 5) -> Structure:
    """Measure the packages of a checkout; keep the `kept` largest of each list."""
    files = [path for name in (*PACKAGES, "tests") for path in sorted((root / name).rglob("*.py"))]
    lines: Counter[str] = Counter()
    folders: Counter[str] = Counter()
    lengths: dict[str, int] = {}
    functions: list[Function] = []
    for path in files:
        text, place = path.read_text(encoding="utf-8"), path.relative_to(root)
        count = len(text.splitlines())
        lines[place.parts[0]] += count
        if place.parts[0] == "tests":
            continue
        lengths[str(place)] = count
        folders[str(place.parent)] += path.name != "__init__.py"
        functions += _functions(ast.parse(text), str(place))
    return Structure(
        dict(lines),
        dict(folders.most_common(kept)),
        dict(Counter(lengths).most_common(kept)),
        sorted(functions, key=lambda each: -each.lines)[:kept],
        sorted(functions, key=lambda each: -each.parameters)[:kept],
    )


def _functions(tree: ast.AST, place: str) -> Iterator[Function]:
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            arguments = node.args
            named = [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]
            own = [each for each in named if each.arg not in ("self", "cls")]
            length = (node.end_lineno or node.lineno) - node.lineno + 1
            yield Function(f"{place}:{node.name}", length, len(own))


def old_words(root: Path) -> dict[str, Counter[str]]:
    """Count old words in what a person reads, by file."""
    found: dict[str, Counter[str]] = {}
    pages = [*root.glob("*.md"), *root.glob("docs/**/*.md"), *root.glob("protocols/**/*.yaml")]
    for path in pages:
        found[str(path.relative_to(root))] = _count(path.read_text(encoding="utf-8"))
    for name in (*PACKAGES, "tests"):
        for path in sorted((root / name).rglob("*.py")):
            text = "\n".join(_readable(path.read_text(encoding="utf-8")))
            found[str(path.relative_to(root))] = _count(text)
    return {place: words for place, words in found.items() if words}


def _count(text: str) -> Counter[str]:
    return Counter(word.lower() for word in _OLD.findall(text))


def _readable(source: str) -> Iterator[str]:
    """Yield comments and strings, docstrings among them."""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type in (tokenize.COMMENT, tokenize.STRING) or token.type == getattr(
            tokenize, "FSTRING_MIDDLE", -1
        ):
            yield token.string


def main() -> None:
    """Print the structure of a checkout, or its old words."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", nargs="?", type=Path, default=Path(__file__).parents[1])
    parser.add_argument("--words", action="store_true", help="count old words, by file")
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    answer: dict[str, object] = (
        dict(old_words(asked.folder)) if asked.words else asdict(structure(asked.folder))
    )
    if asked.json:
        print(json.dumps(answer, indent=2))
        return
    if asked.words:
        total: Counter[str] = sum(old_words(asked.folder).values(), Counter())
        print(f"{sum(total.values())} old words:", dict(total.most_common()))
    for key, value in answer.items():
        print(f"{key}: {value}")


if __name__ == "__main__":
    main()
