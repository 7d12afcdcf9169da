"""Self-contained HTML page: sections with tables, figures and lists; it loads nothing from elsewhere."""

import base64
from collections.abc import Iterable, Sequence
from html import escape

PNG = b"\x89PNG\r\n\x1a\n"
_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #222; max-width: 75rem; margin: 0 auto; padding: 0 1rem 4rem }
h1 { line-height: 1.2; overflow-wrap: anywhere } h2 { margin-top: 2.5rem; border-bottom: 1px solid #ccc }
.wide { overflow-x: auto } table { border-collapse: collapse; margin: 1rem 0; font-size: .9rem }
caption { caption-side: bottom; text-align: left; color: #555; padding-top: .3rem;
  position: sticky; left: 0; max-width: min(calc(100vw - 2rem), 73rem) }
th, td { padding: .25rem .7rem; text-align: right; white-space: nowrap; border-bottom: 1px solid #ddd }
th { cursor: pointer; border-bottom: 2px solid #888; vertical-align: bottom }
th:first-child, td:first-child { text-align: left; position: sticky; left: 0; background: #fff } b { color: #005a9c }
img { max-width: 100%; height: auto } pre { overflow-x: auto; background: #f5f5f5; padding: .7rem; font-size: .85rem }
summary { cursor: pointer; font-weight: 600; margin: .6rem 0 } code { overflow-wrap: anywhere }
dt { font-weight: 600 } dd { margin: 0 0 .5rem 1.5rem } .synthetic { background: #fff3cd; padding: .3rem .7rem }
"""
_SCRIPT = """
for (const head of document.querySelectorAll("th")) head.addEventListener("click", () => {
  const body = head.closest("table").tBodies[0], column = head.cellIndex
  const up = head.dataset.up = head.dataset.up === "1" ? "" : "1"
  const key = row => row.cells[column].dataset.value
  const order = (a, b) => key(a) !== undefined && key(b) !== undefined ? key(a) - key(b)
    : (key(a) === undefined) - (key(b) === undefined) || row(a).localeCompare(row(b))
  const row = line => line.cells[column].textContent
  body.append(...[...body.rows].sort((a, b) => (up ? 1 : -1) * order(a, b)))
})
"""


def page(title: str, sections: Iterable[tuple[str, str]], *, introduction: str = "") -> str:
    """Return a page as HTML.

    The page's content security policy forbids a browser to load anything, so that the page shows the same wherever it
    is opened.

    Args:
        title: title, as plain text.
        sections: heading (plain text) and content (HTML) of each section; sections without content are left out.
        introduction: HTML below the title.
    """
    policy = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
    body = "".join(f"<h2>{escape(heading)}</h2>\n{content}\n" for heading, content in sections if content)
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n"
        f"<h1>{escape(title)}</h1>\n{introduction}\n{body}<script>{_SCRIPT}</script>\n</body>\n</html>\n"
    )


def wide(table: str) -> str:
    """Return a table, as HTML, that scrolls sideways where the window is narrower."""
    return f'<div class="wide">{table}</div>'


def plain_table(heads: Sequence[str], rows: Iterable[Sequence[str]], caption: str = "") -> str:
    """Return a table of plain texts as HTML.

    Args:
        heads: headings of the columns.
        rows: cells of each row.
        caption: text below the table; "" for none.
    """
    head = "".join(f"<th>{escape(text)}</th>" for text in heads)
    body = "".join(f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>\n" for row in rows)
    note = f"<caption>{escape(caption)}</caption>" if caption else ""
    return wide(f"<table>{note}<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>")


def picture(png: bytes, description: str) -> str:
    """Return HTML that contains a PNG image, with the text `description` for readers who cannot see the image."""
    return f'<img alt="{escape(description)}" src="data:image/png;base64,{base64.b64encode(png).decode()}">'


def paragraph(text: str) -> str:
    """Return a paragraph of plain text as HTML."""
    return f"<p>{escape(text)}</p>"


def preformatted(text: str) -> str:
    """Return a block of plain text, such as commands, as HTML."""
    return f"<pre>{escape(text)}</pre>"


def folded(summary: str, content: str, *, opened: bool = False) -> str:
    """Return HTML that shows the plain text `summary`, and after a click on it also the HTML `content`.

    If `opened` is True, `content` is shown from the beginning.
    """
    return f"<details{' open' if opened else ''}><summary>{escape(summary)}</summary>\n{content}</details>\n"
