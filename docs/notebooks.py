"""Tutorials as notebooks: run them, and write what they print into their pages.

    python docs/notebooks.py docs/tutorials/table.md

A tutorial is a Markdown file. Its blocks of `bash` and `python` are the cells of a notebook, which jupytext reads. The
command runs the cells in an empty folder and writes their outputs behind them, between two comments: text as a block,
figures as PNG files beside the page. Without a file, the command runs all tutorials. The site offers each tutorial as a
notebook without outputs.
"""

import base64
import datetime
import itertools
import os
import re
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).resolve().parent / "tutorials"
BEGIN, END = "<!-- output -->", "<!-- end of output -->"
HEADER = "---\njupyter:\n  kernelspec: {name: python3, display_name: Python 3, language: python}\n---\n\n"
"""Beginning of a notebook in Markdown; without it jupytext takes the most frequent language, often bash."""
WITHOUT_COLOURS = (
    "import os\nfor name in ('FORCE_COLOR', 'CLICOLOR_FORCE', 'CLICOLOR'):\n    os.environ.pop(name, None)"
)
"""First cell of a run: ipykernel sets variables that make commands write colours and progress bars."""
LIMIT = 300
"""Longest time of a cell, s."""
MOST_LINES = 44
"""Largest number of lines of an output that a page shows; the lines in the middle are left out."""
MOST_EPOCHS = 12
"""Largest number of epochs of a training that a page shows; of a longer training it shows the first and last two."""


def without_outputs(text: str) -> str:
    """Return a tutorial without its outputs."""
    return re.sub(rf"(?s)\n*{BEGIN}.*?{END}\n*", "\n\n", text)


def notebook(text: str) -> str:
    """Return a tutorial as a notebook without outputs, JSON of nbformat 4."""
    import jupytext

    book = jupytext.reads(HEADER + without_outputs(text), fmt="md")
    for number, cell in enumerate(book.cells):
        cell["id"] = f"cell-{number}"
    return jupytext.writes(book, fmt="ipynb")


def run(text: str, folder: Path) -> Any:
    """Return a tutorial as a notebook whose cells have run in a folder.

    Raises:
        nbclient.exceptions.CellExecutionError: A cell failed.
        nbclient.exceptions.CellTimeoutError: A cell took longer than five minutes.
    """
    import nbformat
    from nbclient import NotebookClient

    os.environ |= {"COLUMNS": "100", "NO_COLOR": "1", "MLFLOW_DISABLE_TELEMETRY": "true"}
    os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    book = nbformat.reads(notebook(text), as_version=4)
    book.cells.insert(0, nbformat.v4.new_code_cell(WITHOUT_COLOURS))
    NotebookClient(
        book, timeout=LIMIT, kernel_name="python3", resources={"metadata": {"path": str(folder)}}
    ).execute()
    del book.cells[0]
    return book


def with_outputs(text: str, book: Any, name: str, seconds: float, folder: str) -> str:
    """Return a tutorial with the outputs of its cells, and write their figures beside the tutorials.

    Args:
        text: Tutorial, with or without outputs.
        book: The same tutorial as a notebook that has run.
        name: Name of the tutorial, with which the names of figures begin.
        seconds: Run time of the notebook, which the last line of the page says.
        folder: Folder in which the notebook has run; outputs show the paths below it.
    """
    for old in FOLDER.glob(f"{name}_*.png"):
        old.unlink()
    cells = iter([cell for cell in book.cells if cell.cell_type == "code"])
    figures = 0

    def shown(match: re.Match[str]) -> str:
        nonlocal figures
        parts, printed = [], ""
        for output in next(cells).outputs:
            data = output.get("data", {})
            if "image/png" in data:
                figures += 1
                file = FOLDER / f"{name}_{figures}.png"
                file.write_bytes(base64.b64decode(data["image/png"]))
                parts.append(f"![{described(match[0])}]({file.name})")
            elif output.output_type == "stream" and output.name == "stdout":
                printed += output.text
            elif "text/plain" in data:
                printed += data["text/plain"] + "\n"
        if printed.strip():
            parts.insert(0, f"```text\n{shortened(printed.replace(f'{folder}/', ''))}\n```")
        return "\n\n".join([match[0], BEGIN, *parts, END]) if parts else match[0]

    text = re.sub(r"\n*<!-- run -->.*\Z", "\n", without_outputs(text), flags=re.S)
    text = re.sub(r"(?ms)^```(?:bash|python)\n.*?^```$", shown, text).rstrip()
    today = datetime.datetime.now(datetime.UTC).date()
    cores = len(os.sched_getaffinity(0))
    return (
        f"{text}\n\n<!-- run -->\n*The outputs on this page are those of a run on {cores} cores on {today}, which took "
        f"{seconds:.0f} s.*\n"
    )


def described(cell: str) -> str:
    """Return a description of the figure that a cell shows, from the name of its file where the cell names one."""
    name = re.search(r"(\w+)\.(?:png|gif)\b", cell)
    return f"Figure: {name[1].replace('_', ' ')}" if name else "Images that the cell above draws"


def shortened(output: str) -> str:
    """Return an output without trailing blanks, most epochs of a training, and the middle of a long output."""
    lines = [line.rpartition("\r")[2].rstrip() for line in output.strip("\n").split("\n")]
    groups = itertools.groupby(lines, key=lambda line: re.match(r"epoch \d+ of \d+: ", line) is not None)
    lines = [
        line
        for is_training, group in groups
        for line in (_without_epochs([*group]) if is_training else group)
    ]
    return "\n".join(_without_middle(lines, MOST_LINES))


def _without_epochs(lines: list[str]) -> list[str]:
    """Return the lines of a training, without the middle of a long one."""
    return lines if len(lines) <= MOST_EPOCHS else _without_middle(lines, 4)


def _without_middle(lines: list[str], most: int) -> list[str]:
    """Return at most `most` lines and, in place of the others, a line that says how many are left out."""
    if len(lines) <= most + 1:
        return lines
    half = most // 2
    return [*lines[:half], f"[… {len(lines) - 2 * half} lines …]", *lines[-half:]]


def main() -> None:
    """Run the tutorials that the command names, and write their outputs."""
    paths = [Path(argument) for argument in sys.argv[1:]] or sorted(FOLDER.glob("[!i]*.md"))
    for path in paths:
        text = path.read_text(encoding="utf-8")
        with tempfile.TemporaryDirectory() as folder:
            start = time.perf_counter()
            book = run(text, Path(folder))
            seconds = time.perf_counter() - start
        path.write_text(with_outputs(text, book, path.stem, seconds, folder), encoding="utf-8")
        sys.stdout.write(f"{path}: {seconds:.0f} s\n")


if __name__ == "__main__":
    main()
