"""Pages of HTML that need nothing beside them: style, tables, embedded pictures."""

import base64
import re
from collections.abc import Iterable
from dataclasses import dataclass
from html import escape

import numpy as np

NOTHING = "–"
SHORT_TABLE = 16
"""Tables up to so many rows are not parted between two printed pages."""
STYLE_SHEET = """
:root { --ink: #1d2327; --soft: #5c666d; --line: #d5dadd; --pale: #f4f6f7; --accent: #0b5a8a; }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 2.2rem 1.4rem 4rem; max-width: 1000px; color: var(--ink); background: #fff;
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", "DejaVu Sans", Arial, sans-serif; }
h1 { font-size: 1.75rem; line-height: 1.25; margin: 0 0 .2rem; overflow-wrap: anywhere; }
h2 { font-size: 1.25rem; margin: 2.6rem 0 .8rem; padding-bottom: .25rem; border-bottom: 2px solid var(--accent); }
h3 { font-size: 1rem; margin: 1.6rem 0 .4rem; overflow-wrap: anywhere; }
p { margin: .4rem 0; }
.soft, .note, figcaption { color: var(--soft); font-size: .88rem; }
.keys { display: grid; grid-template-columns: repeat(auto-fit, minmax(260px, 1fr)); gap: .7rem; margin: 1.3rem 0; }
.key { border: 1px solid var(--line); border-radius: 4px; padding: .6rem .8rem; }
.key b { display: block; font-size: 1.35rem; line-height: 1.3; font-weight: 600; }
.key span { color: var(--soft); font-size: .85rem; display: block; }
.verdict { border: 1px solid var(--line); border-left: 5px solid var(--accent); background: var(--pale);
  padding: .9rem 1.1rem; margin: 1.2rem 0; border-radius: 4px; }
.verdict h2 { border: 0; margin: 0 0 .5rem; padding: 0; font-size: 1.12rem; }
.verdict ul { list-style: none; margin: 0; padding: 0; }
.verdict li { display: grid; grid-template-columns: 8.6rem 1fr; gap: .8rem; padding: .25rem 0;
  overflow-wrap: anywhere; }
.weight { font-weight: 600; font-size: .86rem; padding-top: .1rem; }
.limits { color: #a33b00; } .watch { color: #7a5600; } .good { color: #00694b; } .remark { color: var(--soft); }
figure { margin: 1.4rem 0 2rem; break-inside: avoid; }
figure img { max-width: 100%; height: auto; display: block; margin: 0 auto; }
figcaption { margin-top: .35rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-size: .86rem; font-variant-numeric: tabular-nums; }
th, td { padding: .28rem .5rem; border-bottom: 1px solid var(--line); text-align: right; vertical-align: top;
  white-space: nowrap; }
thead th { border-bottom: 1.5px solid var(--ink); font-weight: 600; vertical-align: bottom; }
th:first-child, td.text { text-align: left; }
td.text, th { white-space: normal; }
td.text, tbody th { overflow-wrap: anywhere; min-width: 6rem; }
tbody th { font-weight: 400; }
.wide table { font-size: .74rem; } .wide th, .wide td { padding: .2rem .3rem; } .wide tbody th { min-width: 4.5rem; }
details { margin: 1rem 0; } summary { cursor: pointer; font-weight: 600; padding: .2rem 0; }
@page { margin: 16mm 14mm; }
@media print { body { padding: 0; font-size: 10pt; max-width: none; } h2, h3 { break-after: avoid; }
  figure img { max-width: 90%; max-height: 205mm; width: auto !important; } th, td { padding: .18rem .5rem; }
  tr, .verdict li, .key, .short { break-inside: avoid; }
  .scroll { overflow: visible; } thead { display: table-header-group; }
  details::details-content { content-visibility: visible; block-size: auto; } .wide table { font-size: 6.4pt; }
  .weight, .key, h2, .verdict { print-color-adjust: exact; -webkit-print-color-adjust: exact; } }
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """Rows of texts under a heading; the first column names the row."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""
    folded: bool = False
    """Shown closed, with its title only, until it is opened."""

    def __post_init__(self) -> None:
        if any(len(row) != len(self.header) for row in self.rows):
            raise ValueError(f"table {self.title!r}: a row has not {len(self.header)} cells")


def number(value: float, decimals: int = 1) -> str:
    """Return a number as text, a dash where there is none."""
    if not np.isfinite(value):
        return NOTHING
    text = f"{value:.{decimals}f}"
    return text[1:] if text.startswith("-") and float(text) == 0.0 else text


def document(title: str, body: Iterable[str]) -> str:
    """Return a whole page of parts in HTML; the title is escaped."""
    content = "\n".join(part for part in body if part)
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{STYLE_SHEET}</style>\n</head>\n<body>\n{content}\n</body>\n"
        "</html>\n"
    )


def section(title: str, *parts: str) -> str:
    """Return parts in HTML under a heading; empty parts are left out."""
    return f"<section><h2>{escape(title)}</h2>\n" + "\n".join(part for part in parts if part) + "\n</section>"


def figure_html(title: str, caption: str, png: bytes) -> str:
    """Return a picture with its title and caption, the PNG embedded."""
    width = int.from_bytes(png[16:20], "big")
    data = base64.b64encode(png).decode("ascii")
    return (
        f"<figure><h3>{escape(title)}</h3>"
        f'<img alt="{escape(title)}" style="width:{round(width * 0.81)}px" src="data:image/png;base64,{data}">'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )


def table_html(table: Table) -> str:
    """Return a table as HTML; texts are escaped, columns of words are set to the left."""
    words = [_is_text(row[column] for row in table.rows) for column in range(len(table.header))]
    head = "".join(_head_cell(text, word) for text, word in zip(table.header, words, strict=True))
    body = "\n".join(
        f'<tr><th scope="row">{escape(row[0])}</th>'
        + "".join(_cell(text, word) for text, word in zip(row[1:], words[1:], strict=True))
        + "</tr>"
        for row in table.rows
    )
    wide = " wide" if len(table.header) > 12 else ""
    wide += " short" if len(table.rows) <= SHORT_TABLE else ""
    note = f'<p class="note">{escape(table.note)}</p>' if table.note else ""
    inner = (
        f'<div class="scroll{wide}"><table><thead><tr>{head}</tr></thead><tbody>\n{body}\n</tbody></table></div>{note}'
    )
    if table.folded:
        return f"<details><summary>{escape(table.title)} ({len(table.rows)} rows)</summary>{inner}</details>"
    return f"<h3>{escape(table.title)}</h3>{inner}"


def _is_text(cells: Iterable[str]) -> bool:
    return any(re.search(r"[^\W\d_]{3}", cell) for cell in cells)


def _head_cell(text: str, is_text: bool) -> str:
    return f'<th scope="col" style="text-align:left">{escape(text)}</th>' if is_text else f"<th>{escape(text)}</th>"


def _cell(text: str, is_text: bool) -> str:
    return f'<td class="text">{escape(text)}</td>' if is_text else f"<td>{escape(text)}</td>"
