"""What all reports share: one style for a wide screen, a phone, light and dark, and the plain pieces of a page."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from typing import Any

STYLE = """
:root{color-scheme:light dark;--ink:#1b1f24;--soft:#5b6672;--paper:#fff;--card:#f5f7f9;--line:#d5dae1;
--good:#0a7d33;--bad:#b3261e}
@media(prefers-color-scheme:dark){:root{--ink:#e6e9ed;--soft:#9aa5b1;--paper:#15181c;--card:#1e2329;--line:#39414a;
--good:#4cc38a;--bad:#ff8a80}}
body{font:16px/1.45 system-ui,sans-serif;margin:2rem auto;max-width:70rem;padding:0 1rem;color:var(--ink);
background:var(--paper)}
h1{font-size:1.5rem}h2{font-size:1.2rem;margin-top:2.2rem}h3{font-size:1rem;margin-bottom:.3rem}
table{border-collapse:collapse;margin:.4rem 0}.wide{overflow-x:auto}
td,th{padding:.2rem 1rem .2rem 0;border-bottom:1px solid var(--line);text-align:left;vertical-align:top}
td{font-variant-numeric:tabular-nums}.matrix td,.matrix th{padding:.2rem .7rem;text-align:right}
.good{color:var(--good)}.bad{color:var(--bad)}svg{max-width:100%;height:auto;display:block;margin:.8rem 0}
figure{margin:1.5rem 0}figure img{width:100%;border-radius:6px}
.failure{border-top:1px solid var(--line);padding:.6rem 0}
.failure img{max-width:48%;border-radius:4px;margin-right:1%}
code{background:var(--card);padding:.1rem .35rem;border-radius:3px}
"""


def head(title: str, style: str = "") -> str:
    """Beginning of a page.

    Args:
        title: Its title.
        style: Rules of its own beside `STYLE`.
    """
    name = html.escape(title)
    return (
        '<!doctype html><html lang="en"><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<title>{name}</title><style>{STYLE}{style}</style><h1>{name}</h1>"
    )


def table(
    lines: Sequence[Sequence[str]], bad: set[str] | frozenset[str] = frozenset(), heading: Sequence[str] = ()
) -> str:
    """Rows of text; those whose first cell is in `bad` are marked. Scrolls sideways where the screen is narrow."""
    top = "".join(f"<th>{html.escape(name)}</th>" for name in heading)
    cells = "".join(
        f"<tr{' class=bad' if line[0] in bad else ''}>{''.join(f'<td>{html.escape(cell)}</td>' for cell in line)}</tr>"
        for line in lines
    )
    return f'<div class="wide"><table>{f"<tr>{top}</tr>" if top else ""}{cells}</table></div>'


def text(value: Any) -> str:
    """A figure for people."""
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {text(part)}" for key, part in value.items())
    if value is None:
        return "-"
    return f"{value:g}" if isinstance(value, float) else str(value)
