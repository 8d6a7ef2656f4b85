"""A small markdown for the page of a run: paragraphs, lists, **bold**, *emphasis*, `code`.
Everything else is text."""

import re

from markupsafe import Markup, escape

_MARKS = (
    (r"`([^`]+)`", r"<code>\1</code>"),
    (r"\*\*([^*]+)\*\*", r"<strong>\1</strong>"),
    (r"(?<![\w*])\*([^*\s][^*]*)\*(?![\w*])", r"<em>\1</em>"),
)


def to_html(text: str) -> Markup:
    """HTML of ``text``; blank lines separate paragraphs, and a block whose lines all start with "-
    " is a list. Markup in it is shown, not used."""
    return Markup(
        "\n".join(
            _block(block.strip()) for block in re.split(r"\n\s*\n", text.strip()) if block.strip()
        )
    )


def inline(text: object) -> Markup:
    """HTML of one run of text, without a paragraph around it."""
    html = str(escape(str(text)))
    for pattern, replacement in _MARKS:
        html = re.sub(pattern, replacement, html)
    return Markup(html)


def plain(text: str) -> str:
    """The text without its marks, for places that hold no markup."""
    for pattern, _ in _MARKS:
        text = re.sub(pattern, r"\1", str(text))
    return text


def counted(count: int, noun: str) -> str:
    """Counts in a sentence: "1 start", "3 starts". noun: one that takes an s."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def _block(block):
    lines = [line.strip() for line in block.splitlines()]
    if all(line.startswith("- ") for line in lines):
        return "<ul>" + "".join(f"<li>{inline(line[2:])}</li>" for line in lines) + "</ul>"
    return f"<p>{inline(' '.join(lines))}</p>"
