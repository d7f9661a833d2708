"""The two ways a command ends early on purpose."""

from __future__ import annotations

from ihbench.visible_text import visible


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
    """A fit stopped because its loss or its parameters stopped being finite. A recorded outcome, not a crash.

    `step` is the first bad step, `reason` says what was seen there.
    """

    def __init__(self, step: int, reason: str):
        super().__init__(visible(f"diverged at step {step}: {reason}"))
        self.step = step
        self.reason = reason
