"""The page of a run: one HTML file that holds everything it shows and loads nothing."""

import base64
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from numbers import Integral, Real
from pathlib import Path
from typing import Any

import jinja2

from codesign.errors import DomainError, FileFormatError, ShapeError
from codesign.report import prose

TEMPLATE = Path(__file__).with_name("page.html.jinja")
SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
MEDIA = {
    ".png": "image/png",
    ".gif": "image/gif",
    ".webp": "image/webp",
    ".mp4": "video/mp4",
}


@dataclass(frozen=True)
class Card:
    """A headline figure: what it is, its value with unit as text, and a remark below."""

    label: str
    value: str
    note: str = ""


@dataclass(frozen=True)
class Picture:
    """A captioned PNG, GIF or MP4, inlined in the page: media type and base64 text."""

    media: str
    data: str
    caption: str


@dataclass(frozen=True)
class Table:
    """Columns of numbers (right-aligned) or text, with cells as they are shown."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    numeric: tuple[bool, ...]
    caption: str


@dataclass
class Section:
    """A heading and what stands below it, in order: ("prose", HTML), ("picture", Picture) or
    ("table", Table)."""

    title: str
    blocks: list[tuple[str, Any]] = field(default_factory=list)


def picture(path: str | Path, caption: str) -> Picture:
    """Inline the image or video at ``path``.

    Raises: FileFormatError when it is missing or not PNG, GIF, WebP or MP4.
    """
    path = Path(path)
    media = MEDIA.get(path.suffix.lower())
    if media is None:
        raise FileFormatError(
            f"'{path}' cannot be shown on the page; give one of {', '.join(MEDIA)}."
        )
    try:
        return Picture(media, base64.b64encode(path.read_bytes()).decode(), caption)
    except OSError as error:
        raise FileFormatError(
            f"'{path}' cannot be read for the page ({error.strerror}); write it before it is shown."
        ) from error


def table(
    title: str,
    columns: Iterable[str],
    rows: Iterable[Iterable[Any]],
    caption: str = "",
) -> Table:
    """Table of numbers, text and None (shown as a dash). A column of numbers is right-aligned;
    floats show four digits.

    Raises: ShapeError when a row has not one cell per column.
    """
    columns = tuple(map(str, columns))
    rows = [tuple(row) for row in rows]
    for index, row in enumerate(rows):
        if len(row) != len(columns):
            raise ShapeError(
                f"table '{title}': row {index} has {len(row)} cells for {len(columns)} columns; give one "
                "cell per column."
            )
    given = [[row[k] for row in rows if row[k] is not None] for k in range(len(columns))]
    numeric = tuple(bool(column) and all(map(_is_number, column)) for column in given)
    return Table(title, columns, tuple(tuple(map(cell, row)) for row in rows), numeric, caption)


def cell(value: Any) -> str:
    """Text of a table cell: four digits of a float, all of an integer, yes or no, a dash for
    None."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if not _is_number(value):
        return str(value)
    whole = isinstance(value, Integral) or 1e3 <= abs(value) < 1e6
    mantissa, _, exponent = (
        (f"{value:.0f}" if whole else f"{float(value):.4g}").replace("-", "−").partition("e")
    )
    return mantissa + (
        f"·10{str(int(exponent.replace('−', '-'))).translate(SUPERSCRIPT)}" if exponent else ""
    )


def render_page(
    title: str,
    lead: str,
    cards: Sequence[Card],
    sections: Sequence[Section],
    facts: Mapping[str, Mapping[str, object]],
) -> str:
    """HTML text of the page.

    Args:
      title: heading. lead: one paragraph that says what was done and what came out
        (see prose.to_html).
      cards: list of Card, the headline figures.
      sections: list of Section.
      facts: dictionary of folded tables at the end, heading -> {name: value} (configuration,
        versions, hardware).
    Returns: text of a self-contained HTML file.
    Raises: DomainError when the title is empty.
    """
    if not title.strip():
        raise DomainError("a page needs a title; an empty one was given.")
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    template = environment.from_string(TEMPLATE.read_text(encoding="utf-8"))
    shown = [section for section in sections if section.blocks]
    return template.render(
        title=title,
        lead=prose.to_html(lead),
        cards=cards,
        sections=shown,
        facts=facts,
        inline=prose.inline,
        plain=prose.plain,
    )


def _is_number(value):
    return isinstance(value, Real) and not isinstance(value, bool)
