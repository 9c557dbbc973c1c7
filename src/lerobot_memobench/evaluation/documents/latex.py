"""Reports as LaTeX tables in the style of booktabs."""

from __future__ import annotations

import re

from lerobot_memobench.evaluation.documents.tables import Cell, Name, Report, Table, bounds, figure, plain
from lerobot_memobench.evaluation.metrics.rates import Rate

_LATEX = {
    "\\": r"\textbackslash{}",
    "{": r"\{",
    "}": r"\}",
    "$": r"\$",
    "&": r"\&",
    "#": r"\#",
    "%": r"\%",
    "_": r"\_",
    "^": r"\textasciicircum{}",
    "~": r"\textasciitilde{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    '"': r"\textquotedbl{}",
    "[": "{[}",  # after the end of a row it would be taken as an option, as would a star
    "*": "{*}",
    "–": "--",
    "κ": r"$\kappa$",
    "π": r"$\pi$",
    "−": r"$-$",
    "×": r"$\times$",
    "±": r"$\pm$",
    "≥": r"$\geq$",
    "≤": r"$\leq$",
    "…": r"\ldots{}",
    "→": r"$\rightarrow$",
    "’": "'",
}


def latex_text(words: str) -> str:
    """Return text with every character that LaTeX would take as a command escaped."""
    words = re.sub(r"π(\d(?:\.\d)?)", "\0\\1\0", words)  # the models π0 and π0.5, set with an index
    escaped = "".join(_LATEX.get(character, character) for character in words)
    return re.sub("\0(.*?)\0", r"$\\pi_{\1}$", escaped)


def latex(report: Report) -> str:
    """Return the report's tables as LaTeX, to be read by ``\\input``; the head says which packages they need."""
    lines = [
        f"% {' '.join(report.title.split())}, written by `memobench report`.",
        r"% Needs \usepackage[T1]{fontenc}, \usepackage{booktabs} and \usepackage{graphicx}.",
    ]
    for section in report.sections:
        if section.title:
            lines += ["", f"% {' '.join(section.title.split())}"]
        for table in section.tables:
            lines += ["", *latex_table(table)]
    return "\n".join(lines) + "\n"


def latex_table(table: Table) -> list[str]:
    """Return the lines of a table in the style of booktabs."""
    columns = "".join("l" if table.is_text(column) else "r" for column in range(len(table.header)))
    caption = ". ".join(part.rstrip(".") for part in (table.title, table.note) if part)
    return [
        r"\begin{table}",
        r"\centering",
        r"\small",
        r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%",
        rf"\begin{{tabular}}{{@{{}}{columns}@{{}}}}",
        r"\toprule",
        *(_groups(table) if table.groups else []),
        " & ".join(latex_text(name) for name in table.header) + r" \\",
        r"\midrule",
        *(line for index in range(len(table.rows)) for line in _row(table, index)),
        r"\bottomrule",
        r"\end{tabular}}",
        rf"\caption{{{latex_text(caption)}.}}",
        rf"\label{{tab:{table.key}}}",
        r"\end{table}",
    ]


def _groups(table: Table) -> list[str]:
    """Return the lines over the header: the groups' titles, and a rule under each."""
    cells, rules, column = [], [], 1
    for title, span in table.groups:
        cells.append(rf"\multicolumn{{{span}}}{{c}}{{{latex_text(title)}}}" if title else " & " * (span - 1))
        if title:
            rules.append(rf"\cmidrule(lr){{{column}-{column + span - 1}}}")
        column += span
    return [" & ".join(cells) + r" \\", " ".join(rules)]


def _row(table: Table, index: int) -> list[str]:
    """Return the line of a row, after a rule where one is drawn."""
    cells = []
    for column, cell in enumerate(table.rows[index]):
        words = _cell(cell, table.intervals)
        strong = index in table.strong or (index, column) in table.best
        cells.append(rf"\textbf{{{words}}}" if strong and words else words)
    rule = [r"\midrule"] if index in table.rules else []
    return [*rule, " & ".join(cells) + r" \\"]


def _cell(cell: Cell, intervals: bool) -> str:
    if isinstance(cell, Rate):
        interval = bounds(cell) if intervals else None
        value = latex_text(figure(cell.value))
        return value + ("" if interval is None else rf" {{\scriptsize [{interval[0]}, {interval[1]}]}}")
    if isinstance(cell, Name):
        return rf"\texttt{{{latex_text(cell)}}}"
    return latex_text(plain(cell))
