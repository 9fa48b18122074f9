"""Laws of notebook cells fly, with what they use of the notebook."""

import linecache
import sys
from types import ModuleType

import pytest

from agents.plugins.cells import law_file, module_text
from experiments.file.document import load
from experiments.file.problems import DocumentError
from experiments.run import simulate

CELLS = (
    "import math\nimport numpy as np\nfrom zenpark import Gradient, Law, norm\nSHARE = 0.5\nweights = np.ones(3)\n",
    "def strength(length, wanted):\n    return SHARE * (wanted - length) / max(length, 1e-6)\n",
    '''
class Spring(Gradient, frozen=True):
    """A spring on each link."""

    constant: float = 0.1

    def pull(self, apart, link):
        k = self.constant * strength(norm(apart), link.distance)
        return tuple(k * each for each in apart)

    def error(self, apart, link):
        return math.fabs(link.distance - norm(apart))


class Heavy(Spring, frozen=True):
    def pull(self, apart, link):
        return tuple(weights)
''',
)


@pytest.fixture
def notebook(monkeypatch):
    book = ModuleType("book")
    monkeypatch.setitem(sys.modules, "book", book)
    for number, text in enumerate(CELLS):
        name = f"<cell {number}>"
        monkeypatch.setitem(linecache.cache, name, (len(text), None, text.splitlines(keepends=True), name))
        exec(compile(text, name, "exec"), vars(book))
    return book


def test_law_of_a_cell_flies(notebook, tmp_path):
    read = load("triangle", "duration_s=2.0", law=notebook.Spring(constant=0.4))
    assert read.experiment.formation.law["constant"] == 0.4
    found = simulate(read, cases=["event"]).metrics["event"]
    named = law_file(notebook.Spring, tmp_path)
    assert named == "spring.py:Spring"
    (tmp_path / "own.toml").write_text(read.text.replace('law = "distance"', ""), "utf-8")
    again = load(tmp_path / "own.toml", "duration_s=2.0", f'formation.law={{ kind = "{named}", constant = 0.4 }}')
    assert simulate(again, cases=["event"]).metrics["event"].mean["iae"] == found.mean["iae"]


def test_module_has_what_the_class_uses_alone(notebook):
    text = module_text(notebook.Spring)
    assert [part in text for part in ("import math as math", "SHARE = ", "def strength", "numpy")] == [True] * 3 + [
        False
    ]


def test_values_that_no_file_holds_are_refused(notebook):
    with pytest.raises(DocumentError, match="weights, a ndarray, cannot be written"):
        load("triangle", law=notebook.Heavy)
