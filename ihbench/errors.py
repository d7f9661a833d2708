"""The two ways a command ends early on purpose."""

from __future__ import annotations


class BadInput(Exception):
    """A file, folder, name, shape or unit the user gave is wrong, or something needed is missing.

    The message is one line: what, where, what was expected, what to do. The command line prints it and ends
    with status 2.
    """


class Diverged(Exception):
    """A fit stopped because its loss or its parameters stopped being finite. A recorded outcome, not a crash.

    `step` is the first bad step, `reason` says what was seen there.
    """

    def __init__(self, step: int, reason: str):
        super().__init__(f"diverged at step {step}: {reason}")
        self.step = step
        self.reason = reason
