"""Patterns of file names with placeholders, as in {camera}/{frame:06d}.png."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath

from ihbench import registry
from ihbench.errors import BadInput
from ihbench.files.paths import user_path

WIDEST = 32  # digits that a number may be padded to
PART = re.compile(r"\{\{|\}\}|\{(?P<name>[^{}:]*)(?P<format>:[^{}]*)?\}|[{}]")
PADDED = re.compile(r":0?([0-9]{1,2})d?|:d")


@dataclass(frozen=True)
class NamePattern:
    """A pattern taken apart: literal texts, and (placeholder, digits it is padded to) between them."""

    text: str
    parts: tuple[str | tuple[str, int], ...]

    @classmethod
    def parse(cls, text: str, numbers: Sequence[str], words: Sequence[str]) -> NamePattern:
        """Take a pattern apart. `numbers` are placeholders that may be padded, `words` those that may not.

        Raises `BadInput` for an empty pattern, another placeholder or format, and a brace alone.
        """
        parts: list[str | tuple[str, int]] = []
        at = 0
        for match in PART.finditer(text):
            parts.append(text[at : match.start()])
            at, name = match.end(), match["name"]
            if name is None:
                if len(match[0]) == 1:
                    raise BadInput(f"--pattern {text!r}: a {match[0]} alone; expected {{{words[0]}}}, or two of them")
                parts.append(match[0][0])
                continue
            if name not in (*numbers, *words):
                known = registry.nearest(name, [*words, *numbers])
                raise BadInput(f"--pattern {text!r}: no placeholder {{{name}}}; {known}")
            parts.append((name, _width(text, name, match["format"] or "", name in numbers)))
        if not text:
            raise BadInput("--pattern '': expected a pattern such as {camera}/{frame:06d}.png")
        return cls(text, (*parts, text[at:]))

    def name(self, values: Mapping[str, object]) -> str:
        """The relative path for these values. Raises `BadInput` for one outside of the folder, or none."""
        filled = (part if isinstance(part, str) else str(values[part[0]]).zfill(part[1]) for part in self.parts)
        path = "".join(filled)
        parts = PurePosixPath(path)
        if parts.is_absolute() or ".." in parts.parts or path.startswith("~"):
            raise BadInput(f"--pattern {self.text!r}: leads out of the folder; expected a path below it")
        user_path(path, "--pattern")
        return path


def _width(text: str, name: str, written: str, number: bool) -> int:
    if not written:
        return 0
    padded = PADDED.fullmatch(written) if number else None
    width = int(padded[1] or 0) if padded else WIDEST + 1
    if width > WIDEST:
        example = f"a number may be padded to {WIDEST} digits, as in {{{name}:06d}}" if number else "it is no number"
        raise BadInput(f"--pattern {text!r}: {{{name}{written[:40]}}} cannot be filled in; {example}")
    return width
