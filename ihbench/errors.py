"""The two ways a command ends early on purpose, and text from elsewhere as such a line may show it."""

from __future__ import annotations

from unicodedata import category

# what moves the cursor, hides or reorders other text, or ends a line: control and format characters (escape
# sequences, bidirectional and zero-width marks, tags), lone surrogates, line and paragraph separators
UNSEEN = {"Cc", "Cf", "Cs", "Zl", "Zp"}


class BadInput(Exception):
    """A file, folder, name, shape or unit the user gave is wrong, or something needed is missing.

    The message is one line: what, where, what was expected, what to do. The command line prints it and ends
    with status 2. It may quote names from anywhere: as text it is safe to print.
    """

    def __str__(self) -> str:
        return visible(super().__str__())


class BadValue(BadInput, ValueError):
    """An argument of a Python call is wrong. Many of them were read from a file, and then it is bad input as well."""


class MissingPrerequisite(BadInput, RuntimeError, ImportError):
    """Something that a Python call needs is not installed, not of a version that will do, or not on this machine."""


class Diverged(Exception):
    """A fit stopped because its loss or its parameters stopped being finite, or because nothing was left of the
    avatar. A recorded outcome, not a crash.

    `step` is the first bad step, `reason` says what was seen there.
    """

    def __init__(self, step: int, reason: str):
        super().__init__(visible(f"diverged at step {step}: {reason}"))
        self.step = step
        self.reason = reason


def visible(text: str, keep: str = "") -> str:
    r"""The text with every unseen character, but those in `keep`, as its escape: `\x1b`, `\u202e`, `\U000e0041`."""
    if text.isprintable():
        return text
    return "".join(_escape(c) if c not in keep and category(c) in UNSEEN else c for c in text)


def _escape(character: str) -> str:
    code = ord(character)
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"
