from __future__ import annotations

from experiments.report.page import Row, Table
from experiments.report.typeset import latex, markdown

TABLE = Table(
    ("Robot", "IAE [m s]"), (Row((("KH_1", "khepera4"), "1 ± 2")), Row(("mean", "−3"), sum=True)), title="a|b"
)


def test_latex_is_a_booktabs_table_with_signs_escaped():
    assert latex([TABLE, Table(("empty",), ())]).splitlines() == [
        "% a|b",
        r"\begin{tabular}{lr}",
        r"\toprule",
        r"Robot & IAE [m s] \\",
        r"\midrule",
        r"KH\_1 khepera4 & 1 $\pm$ 2 \\",
        r"\midrule",
        r"mean & $-$3 \\",
        r"\bottomrule",
        r"\end{tabular}",
    ]


def test_markdown_is_a_pipe_table():
    assert markdown([TABLE]).splitlines() == [
        "**a|b**",
        "",
        "| Robot | IAE [m s] |",
        "|---|---:|",
        r"| KH\_1 khepera4 | 1 ± 2 |",
        "| mean | −3 |",
    ]
