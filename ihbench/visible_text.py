"""Text from elsewhere (names of scenes, files and rows, reasons) as it may be shown on a terminal or in a report."""

from __future__ import annotations

from unicodedata import category

# what moves the cursor, hides or reorders other text, or ends a line: control and format characters (escape
# sequences, bidirectional and zero-width marks, tags), lone surrogates, line and paragraph separators
UNSEEN = {"Cc", "Cf", "Cs", "Zl", "Zp"}


def visible(text: str, keep: str = "") -> str:
    r"""The text with every unseen character, but those in `keep`, as its escape: `\x1b`, `\u202e`, `\U000e0041`."""
    if text.isprintable():
        return text
    return "".join(_escape(c) if c not in keep and category(c) in UNSEEN else c for c in text)


def _escape(character: str) -> str:
    code = ord(character)
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"
