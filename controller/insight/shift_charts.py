"""Charts of the shift report: parts over time, what the time went to, and what was lost to what."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence

from controller.insight.charts import GRID, PALETTE, caption, svg, ticks

WIDTH = 480.0
"""Width of a chart: two beside each other on a screen; on a phone one, with its text still large enough."""

Colours = Mapping[str, str]


def legend(colours: Colours) -> str:
    """Names and their colours."""
    pieces = [
        f'<span><i style="background:{colour}"></i>{html.escape(name)}</span>' for name, colour in colours.items()
    ]
    return f'<p class="legend">{"".join(pieces)}</p>'


def columns(labels: Sequence[str], series: Mapping[str, Sequence[float]], colours: Colours, title: str) -> str:
    """Stacked columns.

    Args:
        labels: Below each column; only as many are written as there is room for.
        series: Heights by name, from below upwards.
        colours: By the same names.
        title: Above.
    """
    height, left, bottom = 230.0, 40.0, 26.0
    top = max((sum(heights) for heights in zip(*series.values(), strict=True)), default=0.0)
    if top <= 0:
        return svg(WIDTH, 44, [caption(0, 16, title, size=14), caption(0, 38, "nothing")], title)
    across, up = (WIDTH - left) / len(labels), height - bottom - 30
    body = [caption(0, 16, title, size=14)]
    for value in ticks(0, top, 4):
        y = height - bottom - up * value / top
        body.append(f'<path d="M{left:.1f} {y:.1f}H{WIDTH:.0f}" {GRID}/>')
        body.append(caption(left - 6, y + 4, f"{value:g}", "end"))
    every = -(-len(labels) // max(int((WIDTH - left) / 58), 1))
    for index, name in enumerate(labels):
        x, y = left + index * across, height - bottom
        for kind, heights in series.items():
            tall = up * heights[index] / top
            y -= tall
            if tall > 0:
                said = html.escape(f"{name}: {heights[index]:g} {kind}")
                body.append(
                    f'<rect x="{x + 0.08 * across:.1f}" y="{y:.1f}" width="{0.84 * across:.1f}" height="{tall:.1f}" '
                    f'fill="{colours[kind]}"><title>{said}</title></rect>'
                )
        if index % every == 0:
            body.append(caption(x + across / 2, height - 8, name, "middle"))
    return svg(WIDTH, height, body, title)


def bars(rows: Sequence[tuple[str, Mapping[str, float], str]], colours: Colours, title: str) -> str:
    """Horizontal bars, each of one or several pieces.

    Args:
        rows: (name, lengths by kind, text behind the bar).
        colours: By kind.
        title: Above.
    """
    tall, left = 40.0, 0.0
    if not rows:
        return svg(WIDTH, 44, [caption(0, 16, title, size=14), caption(0, 38, "nothing")], title)
    longest = max(sum(lengths.values()) for _, lengths, _ in rows) or 1.0
    body = [caption(0, 16, title, size=14)]
    for index, (name, lengths, text) in enumerate(rows):
        x, y = left, 34 + index * tall
        body.append(caption(0, y + 8, name))
        body.append(caption(WIDTH, y + 8, text, "end"))
        for kind, length in lengths.items():
            wide = WIDTH * length / longest
            said = html.escape(f"{name}: {kind}")
            body.append(
                f'<rect x="{x:.1f}" y="{y + 13:.1f}" width="{wide:.1f}" height="12" fill="{colours[kind]}">'
                f"<title>{said}</title></rect>"
            )
            x += wide
    return svg(WIDTH, 34 + tall * len(rows), body, title)


def strip(spans: Sequence[tuple[str, float, float, str]], marks: Sequence[tuple[float, str]], colours: Colours) -> str:
    """One bar over time, as wide as there is room.

    Args:
        spans: (kind, begin, end, what a pointer above it is told), s.
        marks: (s, text) below.
        colours: By kind; one without is left open.
    """
    end = max((span[2] for span in spans), default=1.0) or 1.0
    body = []
    for kind, begin, until, said in spans:
        if kind in colours:
            body.append(
                f'<rect x="{1000 * begin / end:.2f}" y="0" width="{1000 * (until - begin) / end:.2f}" height="1" '
                f'fill="{colours[kind]}"><title>{html.escape(said)}</title></rect>'
            )
    bar = f'<svg viewBox="0 0 1000 1" preserveAspectRatio="none" role="img">{"".join(body)}</svg>'
    places = "".join(f'<span style="left:{100 * at / end:.2f}%">{html.escape(text)}</span>' for at, text in marks)
    return f'<div class="strip">{bar}<div>{places}</div></div>'


GREEN, BLUE, ORANGE, YELLOW, RED, GRAY = (PALETTE[index] for index in (2, 4, 1, 6, 5, 7))
