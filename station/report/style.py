"""The style sheet of a report: for paper first, readable on a screen."""

from __future__ import annotations

import re

_SHEET = """
:root { color-scheme: light; --ink: #1a1a1a; --soft: #555; --line: #bbb; --band: #f3f4f5; }
* { box-sizing: border-box; }
html { font: 10pt/1.42 "Helvetica Neue", Helvetica, Arial, "Liberation Sans", sans-serif; color: var(--ink);
  background: #e9eaec; }
body { margin: 0; }
main { max-width: 210mm; margin: 1.5rem auto; padding: 16mm 18mm; background: #fff; box-shadow: 0 1px 6px #0003; }
header { border-bottom: 1.5pt solid var(--ink); margin-bottom: 5mm; padding-bottom: 3mm; }
.laboratory { margin: 0; color: var(--soft); }
h1 { font-size: 20pt; line-height: 1.15; margin: 1mm 0 2mm; font-weight: 600; }
.number { margin: 0; font-size: 11pt; }
.outcome { margin: 3mm 0 0; }
.caution, .warning { border-left: 3pt solid #D55E00; padding: 1mm 0 1mm 3mm; font-weight: 600; }
section:last-child { break-inside: avoid; }
h2 { font-size: 12.5pt; font-weight: 600; margin: 6mm 0 1.5mm; break-after: avoid; }
h3 { font-size: 10.5pt; margin: 5mm 0 1.5mm; break-after: avoid; }
p { margin: 0 0 2mm; max-width: 75em; orphans: 3; widows: 3; }
ul { margin: 0 0 2mm; padding-left: 5mm; }
table { border-collapse: collapse; width: 100%; margin: 2mm 0 3mm; font-size: 8.5pt;
  font-variant-numeric: tabular-nums; break-inside: avoid; }
table.long { break-inside: auto; }
caption { text-align: left; font-weight: 600; padding: 0 0 1mm; break-after: avoid; }
thead { display: table-header-group; }
tr, tbody.group { break-inside: avoid; }
/* Else the heading of a long table may stand alone at the foot of a page. */
table.long tbody.group:first-of-type { break-inside: auto; }
th, td { padding: .45mm 1.6mm; text-align: left; vertical-align: top; border-bottom: .4pt solid #ddd;
  overflow-wrap: break-word; }
thead th { border-bottom: .8pt solid var(--ink); vertical-align: bottom; font-weight: 600; }
tbody th { font-weight: 400; }
tbody.group { border-bottom: .6pt solid var(--line); }
tbody.group th[scope=rowgroup] { font-weight: 600; }
th.n, td.n { text-align: right; }
.facts th { width: 34%; color: var(--soft); }
.note { font-size: 8pt; color: var(--soft); }
table + .note { margin-top: -2mm; break-before: avoid; }
figure { margin: 2mm 0 4mm; break-inside: avoid; }
img { display: block; max-width: 100%; height: auto; }
figcaption { font-size: 8pt; color: var(--soft); }
.badge { display: inline-block; font-size: 7.5pt; line-height: 1.3; letter-spacing: .04em; padding: 0 1.6mm;
  border: .8pt solid; border-radius: 1mm; }
.outcome .badge { font-size: 12pt; padding: .4mm 3mm; margin-right: 2mm; }
.pass { color: #00654a; } .fail, .fault { color: #a63d00; } .aborted { color: #7a5200; }
.formula { font-size: 11.5pt; margin: 2mm 0 3mm; font-family: "Times New Roman", "Liberation Serif", serif; }
sub, sup { line-height: 0; }
var { font-family: "Times New Roman", "Liberation Serif", serif; }
code { font-family: "SFMono-Regular", Consolas, "Liberation Mono", monospace; }
.hash { font-size: 7.5pt; overflow-wrap: anywhere; }
pre.code { font-size: 6.8pt; line-height: 1.3; background: var(--band); padding: 2.5mm 3mm; margin: 2mm 0 4mm;
  white-space: pre-wrap; overflow-wrap: anywhere; }
.blank { display: inline-block; min-width: 42mm; height: 1em; border-bottom: .6pt solid var(--ink); }
.watermark { position: fixed; inset: 0; display: flex; align-items: center; justify-content: center;
  pointer-events: none; font-size: 88pt; font-weight: 700; letter-spacing: .1em; color: #00000010;
  transform: rotate(-38deg); }
@media screen and (max-width: 800px) {
  main { padding: 6mm 4mm; margin: 0; } table { display: block; overflow-x: auto; } }
@media print {
  html { background: none; font-size: 9.5pt; }
  main { max-width: none; margin: 0; padding: 0; box-shadow: none; }
  pre.code { break-inside: avoid; }
  * { print-color-adjust: exact; -webkit-print-color-adjust: exact; }
}
@page {
  size: A4; margin: 19mm 18mm 18mm; font: 8pt Arial, "Liberation Sans", sans-serif; color: #555;
  @top-left { content: HEAD; }
  @top-right { content: NUMBER; }
  @bottom-left { content: FOOT; }
  @bottom-right { content: "Page " counter(page) " of " counter(pages); }
}
@page :first { @top-left { content: ""; } @top-right { content: ""; } }
"""


def sheet(head: str, number: str, foot: str) -> str:
    """Return the style sheet with what stands at the head and the foot of every printed page."""
    shown = {"HEAD": head, "NUMBER": number, "FOOT": foot}
    return re.sub(r"\b(HEAD|NUMBER|FOOT)\b", lambda found: _quoted(shown[found.group()]), _SHEET)


def _quoted(text: str) -> str:
    """Return a text as CSS has it: whatever is in it, it ends neither the string nor the sheet."""
    return '"' + "".join(c if c.isalnum() or c in " .,:-" else f"\\{ord(c):x} " for c in text) + '"'
