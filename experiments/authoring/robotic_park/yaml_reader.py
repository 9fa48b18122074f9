"""Reads YAML as a tree of scalars, tables and lists that know where they stand; nothing in it is ever executed.

PyYAML only composes the tree, with its safe loader. No tag is constructed: what is a number or a truth value is for
the reader to ask, and what does not fit is said with its place.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final

import yaml

from experiments.file.problems import DocumentError, Problem, at_offset
from experiments.file.structure import LARGEST

CORE: Final = "tag:yaml.org,2002:"
PLAIN: Final = frozenset(CORE + kind for kind in ("str", "int", "float", "bool", "null", "map", "seq", "timestamp"))
TRUTH: Final = {"true": True, "yes": True, "on": True, "false": False, "no": False, "off": False}


@dataclass(frozen=True)
class Item:
    """A value of the tree, and what it is called there; its node is None where there is none."""

    node: yaml.Node | None
    path: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """As the user knows it."""
        return ".".join(self.path)

    @property
    def there(self) -> bool:
        """Whether there is a value at all."""
        return self.node is not None and not (isinstance(self.node, yaml.ScalarNode) and self.node.tag == CORE + "null")


@dataclass
class Tree:
    """A YAML text, and everything that is found wrong in it."""

    label: str
    text: str
    problems: list[Problem] = field(default_factory=list)

    def root(self) -> Item:
        """The table that a file is.

        Raises:
            DocumentError: If it is no YAML, or no table.
        """
        try:
            node = yaml.compose(self.text, Loader=yaml.SafeLoader)
        except yaml.MarkedYAMLError as error:
            mark = error.problem_mark or error.context_mark
            words = " ".join(part for part in (error.context, error.problem) if part)
            hint = "check the indentation, the colons and the quotes there"
            raise DocumentError([at_offset(self.label, self.text, mark.index if mark else 0, words, hint)]) from None
        except yaml.reader.ReaderError as error:
            found = error.character  # of text a character, of what it could not decode a number
            code = found if isinstance(found, int) else ord(str(found)[:1] or "?")
            message = f"the character U+{code:04X} cannot stand in YAML"
            raise DocumentError([at_offset(self.label, self.text, error.position, message, "remove it")]) from None
        except RecursionError:
            raise DocumentError([Problem(self.label, 0, 0, "is nested too deeply", "flatten it")]) from None
        if not isinstance(node, yaml.MappingNode):
            hint = "an experiment of Robotic Park has sections such as Operation and Robots"
            raise DocumentError([at_offset(self.label, self.text, 0, "is no table of sections", hint)])
        self._scan(node)
        return Item(node)

    def refuse(self) -> None:
        """Raises DocumentError if anything was wrong so far, in the order of the text."""
        if self.problems:
            raise DocumentError(sorted(dict.fromkeys(self.problems), key=lambda each: (each.line, each.column)))

    def fault(self, item: Item, message: str, hint: str = "") -> None:
        """Something is wrong with a value."""
        offset = 0 if item.node is None else item.node.start_mark.index
        self.problems.append(at_offset(self.label, self.text, offset, message, hint))

    def entries(self, item: Item) -> Iterator[Item]:
        """What stands in a table, in the order of the text; nothing if there is no table."""
        if not item.there:
            return
        if not isinstance(item.node, yaml.MappingNode):
            self.fault(item, f"'{item.name}' must be a table, not {self._shown(item)}", "indent its keys below it")
            return
        for key, value in item.node.value:
            yield Item(value, (*item.path, str(key.value) if isinstance(key, yaml.ScalarNode) else "?"))

    def is_table(self, item: Item) -> bool:
        """Whether a value is a table."""
        return isinstance(item.node, yaml.MappingNode)

    def tables(self, item: Item) -> Iterator[Item]:
        """The values of a table that are tables themselves, in the order of the text."""
        return (each for each in self.entries(item) if self.is_table(each))

    def get(self, item: Item, key: str) -> Item:
        """The value of a key."""
        if isinstance(item.node, yaml.MappingNode):
            for name, value in item.node.value:
                if isinstance(name, yaml.ScalarNode) and name.value == key:
                    return Item(value, (*item.path, key))
        return Item(None, (*item.path, key))

    def need(self, item: Item, key: str, hint: str) -> Item:
        """The value of a key that must be there."""
        found = self.get(item, key)
        if not found.there:
            where = f" in '{item.name}'" if item.path else ""
            self.fault(found if found.node else item, f"'{key}' is missing{where}", hint)
        return found

    def words(self, item: Item, default: str = "") -> str:
        """A text."""
        if not item.there:
            return default
        if isinstance(item.node, yaml.ScalarNode):
            return str(item.node.value).strip()
        self.fault(item, f"'{item.name}' must be text, not {self._shown(item)}")
        return default

    def number(self, item: Item, default: float) -> float:
        """A finite number."""
        if not item.there:
            return default
        try:
            value = float(self._written(item))
        except ValueError:
            value = math.nan
        if not abs(value) <= LARGEST:  # NaN is not smaller either
            self.fault(item, f"'{item.name}' must be a number, not {self._shown(item)}")
            return default
        return value

    def numbers(self, item: Item) -> list[float]:
        """Numbers in a text, separated by commas or blanks, or in a list."""
        if not item.there:
            return []
        if isinstance(item.node, yaml.SequenceNode):
            return [self.number(Item(each, item.path), 0.0) for each in item.node.value]
        parts = [part for part in re.split(r"[,\s]+", self.words(item)) if part]
        try:
            found = [float(part) for part in parts]
        except ValueError:
            found = [math.nan]
        if not all(abs(value) <= LARGEST for value in found):
            self.fault(item, f"'{item.name}' must be numbers, not {self._shown(item)}", "such as 1.2, -0.5, 0.7")
            return []
        return found

    def truth(self, item: Item, default: bool) -> bool:
        """True or false."""
        if not item.there:
            return default
        found = TRUTH.get(self._written(item).lower())
        if found is None:
            self.fault(item, f"'{item.name}' must be True or False, not {self._shown(item)}")
        return default if found is None else found

    def one_of(self, item: Item, known: tuple[str, ...], default: str) -> str:
        """One of some words."""
        found = self.words(item, default)
        if found not in known:
            self.fault(item, f"'{item.name}' cannot be {found!r}", f"known: {', '.join(known)}")
            return default
        return found

    def _written(self, item: Item) -> str:
        """The text of a scalar, empty for anything else."""
        return str(item.node.value).strip() if isinstance(item.node, yaml.ScalarNode) else ""

    def _shown(self, item: Item) -> str:
        if isinstance(item.node, yaml.ScalarNode):
            value = str(item.node.value)
            return repr(value if len(value) <= 40 else f"{value[:37]}...")
        return "a list" if isinstance(item.node, yaml.SequenceNode) else "a table"

    def _scan(self, root: yaml.Node) -> None:
        """Keys that stand twice, and tags that ask a loader for more than text, numbers, tables and lists."""
        waiting, seen = [root], set()
        while waiting:
            node = waiting.pop()
            if id(node) in seen:
                continue
            seen.add(id(node))
            if node.tag == CORE + "merge":
                self.fault(Item(node), "'<<' puts one table into another, which is not understood here", "write it out")
            elif node.tag not in PLAIN:
                self.fault(Item(node), f"the tag {node.tag!r} asks for something to be made of the value", "remove it")
            if isinstance(node, yaml.MappingNode):
                waiting += [each for pair in node.value for each in pair]
                self._once([key for key, _ in node.value if isinstance(key, yaml.ScalarNode)])
            elif isinstance(node, yaml.SequenceNode):
                waiting += node.value
        self.refuse()

    def _once(self, keys: Sequence[yaml.ScalarNode]) -> None:
        seen = set()
        for key in keys:
            if key.value in seen:
                self.fault(Item(key), f"'{key.value}' stands twice in its table", "keep one of the two")
            seen.add(key.value)
