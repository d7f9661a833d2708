"""The options `--format` and `--json` of every command that prints a table, and the printing itself."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from ihbench.clock import streams

if TYPE_CHECKING:
    from ihbench.document.document import Block

Format = Literal["terminal", "md", "tex", "html", "csv", "json"]


@dataclass(frozen=True, kw_only=True)
class Printing:
    format: Format = "terminal"
    """How it is printed: aligned text, Markdown, LaTeX (booktabs, for pdflatex), one HTML page, the tables as CSV, or
    JSON."""
    json: bool = False
    """Print one JSON object on stdout and nothing else there; as --format json."""

    def show(self, data: Any, blocks: Sequence[Block], text: str | None = None) -> None:
        """Print the document, or `data` as JSON (NaN and infinities as in `atomic`). `text` is what a terminal shows
        in the document's place."""
        if self.json or self.format == "json":
            from ihbench.files import atomic

            print(json.dumps(atomic.encode(data), allow_nan=False))
        elif self.format == "terminal" and text is not None:
            print(text, end="\n" if text else "")
        else:
            from ihbench.document import document, terminal

            with streams.styled():
                if self.format == "terminal":
                    print(terminal.write(blocks, styled=sys.stdout.isatty()), end="")
                else:
                    print(document.write(blocks, self.format), end="")


@dataclass(frozen=True, kw_only=True)
class Report(Printing):
    """Of a command whose text is more often kept than looked at."""

    format: Format = "md"
    """How it is printed: Markdown, aligned text for a terminal, LaTeX (booktabs, for pdflatex), one HTML page, the
    tables as CSV, or JSON."""
