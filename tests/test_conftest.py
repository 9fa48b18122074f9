"""What every test relies on."""

import subprocess
import sys

import pytest

from tests.cases import for_each
from tests.conftest import ROOT

CHILD = """
import subprocess, sys
import tests.conftest
shows = "import signal; print(signal.getsignal(signal.SIGINT) is signal.default_int_handler)"
subprocess.run([sys.executable, "-c", shows], check=True)
"""


def test_ctrl_c_reaches_children_of_background_tests():
    in_background = ["sh", "-c", "trap '' INT; exec \"$@\"", "sh", sys.executable, "-c", CHILD]
    done = subprocess.run(in_background, cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == "True\n"


@pytest.mark.slow
def test_a_path_that_is_not_there_is_named():
    words = [sys.executable, "-m", "pytest", "-n", "2", "tests/nope.py::test_x"]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.returncode, "tests/nope.py::test_x: there is no such file" in done.stderr) == (4, True)


@for_each("number, wanted", [(2, 4), (3, 8), (4, 16), (0, 1)])
def squares(number, wanted, asked):
    asked.append(number)
    assert number**2 == wanted


def test_every_case_is_tried_and_every_failure_told():
    asked = []
    with pytest.raises(ExceptionGroup, match="2 of 4 cases fail") as caught:
        squares(asked=asked)
    assert asked == [2, 3, 4, 0]
    assert [error.__notes__ for error in caught.value.exceptions] == [["case (3, 8)"], ["case (0, 1)"]]
