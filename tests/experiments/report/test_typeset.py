from __future__ import annotations

from experiments.report.page import Table, TableRow
from experiments.report.typeset import latex, markdown

TABLE = Table(
    ("Robot", "IAE [m s]"), (TableRow((("KH_1", "khepera4"), "1 ± 2")), TableRow(("mean", "−3"), sum=True)), title="a|b"
)


def test_latex_is_a_booktabs_table_with_signs_escaped():
    assert latex([TABLE, Table(("empty",), ())]).splitlines() == [
        r"\begin{table}",
        r"\centering\footnotesize\setlength{\tabcolsep}{3pt}",
        r"\caption{Robots, a|b.}",
        r"\label{tab:robots-a-b}",
        r"\begin{adjustbox}{max width=\linewidth, max totalheight=0.85\textheight}",
        r"\begin{tabular}{lr}",
        r"\toprule",
        r"Robot & IAE [m s] \\",
        r"\midrule",
        r"KH\_1 khepera4 & 1 $\pm$ 2 \\",
        r"\midrule",
        r"mean & $-$3 \\",
        r"\bottomrule",
        r"\end{tabular}",
        r"\end{adjustbox}",
        r"\end{table}",
    ]


def test_a_wide_float_spans_both_columns():
    assert latex([TABLE], width=7.16).count("{table*}") == 2


def test_signs_of_users_are_safe_in_latex():
    table = Table(
        ("[m] a_b", "minimum_interval_s"), (TableRow(("50 % & #1_~^\\", "0.1")),), title="{σ} $λ → x", note="α ± β"
    )
    text = latex([table])
    assert r"{}[m] a\_b & minimum\_interval\_s \\" in text.splitlines()
    assert r"50 \% \& \#1\_\textasciitilde{}\textasciicircum{}\textbackslash{} & 0.1 \\" in text.splitlines()
    assert r"\caption{{}[m] a\_bs, \{$\sigma$\} \$$\lambda$ $\to$ x. $\alpha$ $\pm$ $\beta$}" in text.splitlines()
    assert text.isascii()


def test_markdown_is_a_pipe_table():
    assert markdown([TABLE]).splitlines() == [
        "**a|b**",
        "",
        "| Robot | IAE [m s] |",
        "|---|---:|",
        r"| KH\_1 khepera4 | 1 ± 2 |",
        "| mean | −3 |",
    ]
