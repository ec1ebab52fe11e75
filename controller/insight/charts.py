"""Small charts as inline SVG: what a report needs, without a plotting library."""

from __future__ import annotations

import html
import math
from collections.abc import Mapping, Sequence

PALETTE = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#f0e442", "#999999")
"""Okabe and Ito's colours, which colour-blind people can tell apart."""

GRID = 'stroke="currentColor" stroke-opacity=".18"'
"""Lines that lie behind, on light pages and dark ones; text has the page's own colour."""


def svg(width: float, height: float, body: Sequence[str], title: str) -> str:
    """A drawing of so many px, smaller where there is less room."""
    return (
        f'<svg viewBox="0 0 {width:.0f} {height:.0f}" width="{width:.0f}" role="img" font-size="12" '
        'font-family="system-ui,sans-serif" fill="currentColor">'
        f"<title>{html.escape(title)}</title>{''.join(body)}</svg>"
    )


def caption(x: float, y: float, text: str, anchor: str = "start", size: float = 12) -> str:
    """A line of text; `anchor` is `start`, `middle` or `end`."""
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" font-size="{size:g}">{html.escape(text)}</text>'


def ticks(low: float, high: float, about: int = 6) -> list[float]:
    """Round numbers from `low` to `high`, about so many; a step is 1, 2 or 5 times a power of ten."""
    if not high > low:
        return [low]
    rough = (high - low) / about
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(power * factor for factor in (1, 2, 5, 10) if power * factor >= rough * (1 - 1e-9))
    first = math.ceil(low / step - 1e-9)
    return [step * k for k in range(first, math.floor(high / step + 1e-9) + 1)]


def histogram(values: Sequence[float], title: str, unit: str, bins: int = 40, width: float = 640.0) -> str:
    """How often values occur; the uppermost thousandth is gathered in the last bar."""
    height, left, bottom = 220.0, 44.0, 36.0
    if not values:
        return svg(width, 40, [caption(left, 24, f"{title}: no values")], title)
    ordered = sorted(values)
    low, high = ordered[0], ordered[min(len(ordered) - 1, int(0.999 * len(ordered)))]
    high = high if high > low else low + 1.0
    counts = [0] * bins
    for value in values:
        counts[min(bins - 1, max(0, int((value - low) / (high - low) * bins)))] += 1
    top = max(counts)
    across, up = (width - left - 10) / bins, height - bottom - 28
    body = [caption(left, 16, title, size=13)]
    for value in (value for value in ticks(0, top, 4) if value.is_integer()):
        y = height - bottom - up * value / top
        body.append(f'<path d="M{left:.1f} {y:.1f}H{width - 10:.1f}" {GRID}/>')
        body.append(caption(left - 6, y + 4, f"{value:g}", "end", 11))
    for index, count in enumerate(counts):
        tall = up * count / top
        x, y = left + index * across, height - bottom - tall
        wide = max(across - 1, 0.5)
        body.append(f'<rect x="{x:.2f}" y="{y:.2f}" width="{wide:.2f}" height="{tall:.2f}" fill="{PALETTE[0]}"/>')
    for value in ticks(low, high):
        x = left + (value - low) / (high - low) * bins * across
        body.append(caption(x, height - bottom + 16, f"{value:g}", "middle", 11))
    body.append(caption(width - 10, height - 4, unit, "end", 11))
    return svg(width, height, body, title)


def gantt(rows: Mapping[str, Sequence[tuple[str, float, float]]], title: str) -> str:
    """Bars over time.

    Args:
        rows: (name, begin, end) of the bars of each row, s.
        title: Above.
    """
    width, left, tall = 980.0, 90.0, 34.0
    end = max((bar[2] for bars in rows.values() for bar in bars), default=1.0) or 1.0
    scale = (width - left - 10) / end
    names = list(dict.fromkeys(bar[0] for bars in rows.values() for bar in bars))
    shade = {name: PALETTE[index % len(PALETTE)] for index, name in enumerate(names)}
    height = 30 + tall * len(rows) + 30
    body = [caption(left, 16, title, size=13)]
    for value in ticks(0, end, 10):
        x = left + value * scale
        body.append(f'<path d="M{x:.1f} 26V{height - 26:.1f}" {GRID}/>')
        body.append(caption(x, height - 10, f"{value:g} s", "middle", 11))
    for index, (row, bars) in enumerate(rows.items()):
        y = 30 + tall * index
        body.append(caption(left - 8, y + tall / 2 + 2, row, "end"))
        for name, begin, until in bars:
            x, wide = left + begin * scale, max((until - begin) * scale, 1.0)
            label = f"{name} {until - begin:.3f} s"
            body.append(
                f'<rect x="{x:.1f}" y="{y:.1f}" width="{wide:.1f}" height="{tall - 8:.1f}" fill="{shade[name]}" '
                f'fill-opacity=".75"><title>{html.escape(label)}</title></rect>'
            )
            if wide > 7.0 * len(name):
                body.append(caption(x + wide / 2, y + tall / 2, name, "middle", 11))
    return svg(width, height, body, title)


def error_map(
    points: Sequence[tuple[float, float, float, float]], outline: Sequence[tuple[float, float]], title: str
) -> str:
    """Mean errors over the table: an arrow for each square of 20 mm, its colour by the mean length.

    Args:
        points: (x, y, dx, dy), mm of `table`: where a part was and how far beside it was located.
        outline: Of the work area, mm of `table`.
        title: Above.
    """
    cell, scale, pad = 20.0, 1.6, 50.0
    above = 30.0  # for the captions: a square may reach beyond the outline
    xs, ys = [p[0] for p in outline], [p[1] for p in outline]
    low_x, high_x, low_y, high_y = min(xs), max(xs), min(ys), max(ys)
    # The picture is as the camera has it: y of the table to the left, x up.
    width, height = (high_y - low_y) * scale + 2 * pad, (high_x - low_x) * scale + 2 * pad + above

    def at(x: float, y: float) -> tuple[float, float]:
        return pad + (high_y - y) * scale, pad + above + (high_x - x) * scale

    squares: dict[tuple[int, int], list[tuple[float, float]]] = {}
    for x, y, dx, dy in points:
        squares.setdefault((math.floor(x / cell), math.floor(y / cell)), []).append((dx, dy))
    means = {
        key: (
            sum(math.hypot(*e) for e in errors) / len(errors),
            sum(e[0] for e in errors) / len(errors),
            sum(e[1] for e in errors) / len(errors),
            len(errors),
        )
        for key, errors in squares.items()
    }
    top = max((mean[0] for mean in means.values()), default=1.0) or 1.0
    body = [caption(pad, 18, title, size=13)]
    body.append(
        caption(pad, 36, f"darkest square: {top:.3f} mm; arrows: mean error, {cell:g} mm = {top:.3f} mm", size=11)
    )
    ring = " ".join(f"{u:.1f},{v:.1f}" for u, v in (at(*p) for p in outline))
    body.append(f'<polygon points="{ring}" fill="none" {GRID} stroke-width="2"/>')
    for (i, j), (length, dx, dy, count) in sorted(means.items()):
        u, v = at((i + 1) * cell, (j + 1) * cell)
        label = f"{length:.3f} mm over {count} looks"
        body.append(
            f'<rect x="{u:.1f}" y="{v:.1f}" width="{cell * scale:.1f}" height="{cell * scale:.1f}" fill="{PALETTE[0]}" '
            f'fill-opacity="{0.1 + 0.75 * length / top:.2f}"><title>{html.escape(label)}</title></rect>'
        )
        x, y = (i + 0.5) * cell, (j + 0.5) * cell
        (u, v), (s, t) = at(x, y), at(x + dx / top * cell, y + dy / top * cell)
        body.append(f'<path d="M{u:.1f} {v:.1f}L{s:.1f} {t:.1f}" stroke="{PALETTE[5]}" stroke-width="1.5"/>')
        body.append(f'<circle cx="{u:.1f}" cy="{v:.1f}" r="1.6" fill="{PALETTE[5]}"/>')
    return svg(width, height, body, title)


def matrix(table: Mapping[str, Mapping[str, int]], title: str, corner: str, *, diagonal: bool = True) -> str:
    """A table of counts as HTML.

    Args:
        table: Counts by row and column.
        title: Above.
        corner: What rows and columns are.
        diagonal: Rows and columns are the same names: what lies off the diagonal is an error.
    """
    names = sorted({name for row in table.values() for name in row})
    head = "".join(f"<th>{html.escape(name)}</th>" for name in names)
    lines = [f"<h3>{html.escape(title)}</h3><table class=matrix><tr><th>{html.escape(corner)}</th>{head}</tr>"]
    for true, row in table.items():
        most = max(sum(row.values()), 1)
        lines.append(f"<tr><th>{html.escape(true)}</th>")
        for name in names:
            count = row.get(name, 0)
            colour = "0,114,178" if not diagonal else "0,158,115" if name == true else "213,94,0"
            strength = 0.15 + 0.6 * count / most if count else 0.0
            lines.append(f'<td style="background:rgba({colour},{strength:.2f})">{count or ""}</td>')
        lines.append("</tr>")
    return "".join(lines) + "</table>"
