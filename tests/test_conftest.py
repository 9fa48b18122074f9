"""What every test relies on."""

import subprocess
import sys

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
