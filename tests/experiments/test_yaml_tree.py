import pytest

from experiments.authoring.robotic_park.yaml_reader import Tree
from experiments.file.problems import DocumentError

TEXT = """a:
  number: 1.5e-1
  words: "two words"
  truth: on
  list: [1, 2.5]
  text: 1, -2 3
  nothing:
"""


@pytest.fixture
def tree():
    return Tree("some.yaml", TEXT)


def test_values(tree):
    table = tree.get(tree.root(), "a")
    assert [each.name for each in tree.entries(table)] == [f"a.{key}" for key in
        ("number", "words", "truth", "list", "text", "nothing")]  # fmt: skip
    assert tree.number(tree.get(table, "number"), 0.0) == 0.15
    assert tree.words(tree.get(table, "words")) == "two words"
    assert tree.truth(tree.get(table, "truth"), False) is True
    assert tree.numbers(tree.get(table, "list")) == [1.0, 2.5]
    assert tree.numbers(tree.get(table, "text")) == [1.0, -2.0, 3.0]
    assert not tree.get(table, "nothing").there
    assert tree.number(tree.get(table, "nothing"), 7.0) == 7.0
    assert tree.number(tree.get(table, "missing"), 8.0) == 8.0
    tree.refuse()


def test_everything_that_does_not_fit_is_told_in_the_order_of_the_text(tree):
    table = tree.get(tree.root(), "a")
    tree.truth(tree.get(table, "list"), False)
    tree.number(tree.get(table, "words"), 0.0)
    list(tree.entries(tree.get(table, "number")))
    tree.need(table, "more", "add it")
    with pytest.raises(DocumentError) as raised:
        tree.refuse()
    assert [(each.line, each.message) for each in raised.value.problems] == [
        (2, "'more' is missing in 'a'"),
        (2, "'a.number' must be a table, not '1.5e-1'"),
        (3, "'a.words' must be a number, not 'two words'"),
        (5, "'a.list' must be True or False, not a list"),
    ]
