"""Each code of a finding stands in docs/check.md, and in a test."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[3]
NAMED = {"not-random", "centralised", "hybrid"}  # by a name in place of a literal


def codes_of_findings():
    for file in (ROOT / "experiments" / "check").glob("*.py"):
        for node in ast.walk(ast.parse(file.read_text("utf-8"))):
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "Finding":
                code = node.args[1]
                assert isinstance(code, ast.Constant) or ast.unparse(code) in {"what", "NOT_RANDOM"}, file
                yield from {code.value} if isinstance(code, ast.Constant) else NAMED


def test_codes_stand_in_docs_and_tests():
    codes = {*codes_of_findings()}
    rows = re.findall(r"^\| (`.*?) \|", (ROOT / "docs" / "check.md").read_text("utf-8"), re.MULTILINE)
    assert codes == {code for row in rows for code in re.findall(r"`([\w-]+)`", row)}
    tests = "".join(file.read_text("utf-8") for file in (ROOT / "tests").rglob("test_*.py"))
    assert {code for code in codes if f'"{code}"' not in tests} == set()
