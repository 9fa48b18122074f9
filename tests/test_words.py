"""Texts are plain technical English: no phrase that hides its subject, a noun first, short sentences."""

from __future__ import annotations

import ast
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
LONGEST = 30  # words of a sentence
PLACES = ("agents", "bridges", "experiments", "face", "tools", "twins", "docs")
PLACES += ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")
# clauses in the place of a noun or of a number, and words that few readers know
PHRASES = re.compile(
    r"\b(so (long|much|many|often)|(that|how) much|but for|as often as|com(e|es|ing) to|came to|whose|who(m|so)?ever|"
    r"(some|no)body|told|anew|alike|lest|heed\w*|hear[sd]?(?! =)|hearing|speaks?|spoken|nothing else|those who)\b",
    re.IGNORECASE,
)
FIRST = re.compile(r"\A(?:It|Its|They|Their|Who|What|Which|Whose|This|That|These|Those|He|She|We|You|There|How|Why)\b")
# words that a noun, which is not there, would have to precede
DEPENDENT = re.compile(
    r"# ?(?:\[[^\]]*\] ?)?(of|in|on|at|by|for|from|with|without|within|to|towards?|into|onto|over|under|above|below|"
    r"between|among|behind|before|after|until|since|while|when|where|if|unless|because|though|although|as|than|that|"
    r"which|who|and|or|but|nor|so|then|via|per|against|along|around|about|beyond|except|inside|outside|near|through|"
    r"during)\b",
    re.IGNORECASE,
)
# names of values that are pronouns or participles
PRONOUNS = {"mine", "ours", "theirs", "its", "whose", "those", "there", "told", "waiting", "waits", "unknown"}
FENCE = re.compile(r"^ *(```|~~~).*?^ *\1|^(?: {4,}[^\n]*\n)+", re.MULTILINE | re.DOTALL)
COMMENT = re.compile(r"(?:^|(?<=\s))#.*")  # in a text of several lines, what looks like one as well
ITEM = re.compile(r"\n\s*\n|\n(?=\s*(?:[-*|>#]|\d+\.|`?\w[\w., ]*`?:) )")
ASIDE = re.compile(r" ?\([^()]*\)|(?<=\])\([^()]*\)")
WORD = re.compile(r"\b(?:[^\W\d_]{2,}|a)\b")


def texts(file: Path) -> Iterator[tuple[int, str, bool]]:
    """Line, text, and whether it is a docstring or a page; else a comment or a message."""
    source = file.read_text("utf-8")
    if file.suffix == ".md":
        yield 1, FENCE.sub("", source), True
        return
    docs = set()
    for node in ast.walk(ast.parse(source)):
        documented = isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
        if documented and (doc := ast.get_docstring(node)):
            docs.add(id(node.body[0].value))
            yield getattr(node, "lineno", 1), doc, True
        elif (
            isinstance(node, ast.Constant)
            and isinstance(node.value, str)
            and id(node) not in docs
            and " " in node.value
        ):
            yield node.lineno, node.value, False
    for number, line in enumerate(source.splitlines(), 1):
        if comment := COMMENT.search(line):
            yield number, comment[0], False


def sentences(text: str) -> Iterator[str]:
    """Sentences outside of tables, without parentheses, quotes and code."""
    for item in ITEM.split(text):
        if item.lstrip().startswith("|"):
            continue
        plain = re.sub(r'"[^"]*"|`[^`]*`', "it", re.sub(r"\s+", " ", item))
        yield from re.split(r"(?<=[.!?])[*_”]*\s+", ASIDE.sub("", ASIDE.sub("", plain)))


def files(place: str) -> list[Path]:
    return [file for end in ("py", "md") for file in sorted((ROOT / place).rglob(f"*.{end}"))] or [ROOT / place]


def listed(found: list[str], why: str) -> str:
    return "\n".join([f"{why} (CONTRIBUTING.md, rule 6)", *found])


@pytest.mark.parametrize("place", PLACES)
def test_texts_are_plain(place):
    found = []
    for file in files(place):
        for line, text, long in texts(file):
            said = [match[0] for match in PHRASES.finditer(re.sub(r"`[^`]*`|\s+", " ", text))]
            if long:
                said += FIRST.findall(text)
                said += [each for each in sentences(text) if len(WORD.findall(each)) > LONGEST]
            found += [f"{file.relative_to(ROOT)}:{line}: {each}" for each in said]
    assert not found, listed(found, "a phrase of PHRASES, a sentence too long or without a subject: name what is meant")


def trailing_comments(file: Path) -> Iterator[tuple[int, str]]:
    """Line and text of comments behind code, of a file in which a comment may be wrong."""
    if not DEPENDENT.search(file.read_text("utf-8")):
        return
    with file.open("rb") as source:
        for token in tokenize.tokenize(source.readline):
            if token.type == tokenize.COMMENT and token.line[: token.start[1]].strip():
                yield token.start[0], token.string


def form(value: ast.expr) -> str:
    """Form of an expression, without its names and numbers."""
    return re.sub(r"(id|attr|value)='?[^,()']*'?", r"\1", ast.dump(value))


def crowded(node: ast.AST) -> bool:
    """Whether an assignment names more than two things that are no components of one."""
    if not isinstance(node, ast.Assign) or not isinstance(node.value, ast.Tuple):
        return False
    target = node.targets[0]
    return isinstance(target, ast.Tuple) and len(target.elts) > 2 and len({*map(form, node.value.elts)}) > 1


def names(node: ast.AST) -> str:
    """Name that a node gives to a value, a function or a class, without underscores around it; empty for others."""
    match node:
        case ast.Name(id=name, ctx=ast.Store()) | ast.Attribute(attr=name, ctx=ast.Store()) | ast.arg(arg=name):
            return name.strip("_")
        case ast.FunctionDef(name=name) | ast.ClassDef(name=name):
            return name.strip("_")
    return ""


CODE = pytest.mark.parametrize("place", [place for place in PLACES if (ROOT / place / "__init__.py").exists()])


@CODE
def test_names_are_nouns(place):
    found = [
        f"{file}:{node.lineno}: {names(node)}"
        for file in sorted((ROOT / place).rglob("*.py"))
        for node in ast.walk(ast.parse(file.read_text("utf-8")))
        if names(node) in PRONOUNS
    ]
    assert not found, listed(found, "a pronoun or participle as a name: take a noun of the field")


@CODE
def test_lines_are_read_at_one_glance(place):
    found = []
    for file in sorted((ROOT / place).rglob("*.py")):
        found += [f"{file}:{line}: {text}" for line, text in trailing_comments(file) if DEPENDENT.match(text)]
        found += [
            f"{file}:{node.lineno}: {ast.unparse(node)}"
            for node in ast.walk(ast.parse(file.read_text("utf-8")))
            if crowded(node)
        ]
    assert not found, listed(
        found, "a comment begins with a noun, a verb or a unit; at most two targets in an assignment"
    )
