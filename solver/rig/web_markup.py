"""Small pieces of the certificate's page."""

from __future__ import annotations

from html import escape

WORDS = {"good": "Good", "usable": "Usable", "bad": "Look at it"}

_SHAPES = {  # told apart by shape, not by colour alone
    "good": '<circle cx="8" cy="8" r="7.2"/><path d="M4.6 8.3l2.3 2.4 4.5-5"/>',
    "usable": '<path d="M8 1.2L15.3 14.5H.7z"/><path d="M8 6v4.2M8 11.9v.8"/>',
    "bad": '<circle cx="8" cy="8" r="7.2"/><path d="M5.3 5.3l5.4 5.4M10.7 5.3l-5.4 5.4"/>',
}


def tag(verdict: str) -> str:
    """Return a verdict as a sign and a word."""
    return (
        f'<span class="tag {verdict}"><svg viewBox="0 0 16 16" fill="none" stroke="currentColor" '
        f'stroke-width="1.6" aria-hidden="true">{_SHAPES[verdict]}</svg>{WORDS[verdict]}</span>'
    )


def figure(value: float | None, decimals: int | None = None) -> str:
    """Return a figure in words, with three digits or so many decimals; None is ``not known``."""
    if value is None:
        return "not known"
    if decimals is not None:
        return f"{value:,.{decimals}f}"
    if value != 0.0 and abs(value) < 1e-3:
        return f"{value:.0e}".replace("e-0", "e-")
    return f"{value:,.3g}"


def tile(words: str, value: str, unit: str) -> str:
    """Return a big figure with its words."""
    return (
        f'<div class="tile"><strong>{value} <em>{escape(unit)}</em></strong>{escape(words)}</div>'
    )


def row(heading: str, *cells: tuple[str, str]) -> str:
    """Return a table's row from markup: its heading and cells of (class, content)."""
    inside = "".join(
        f"<td class='{kind}'>{content}</td>" if kind else f"<td>{content}</td>"
        for kind, content in cells
    )
    return f"<tr><th scope='row'>{heading}</th>{inside}</tr>"
