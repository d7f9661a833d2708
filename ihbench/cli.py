"""The command line. Commands are looked up by name and imported only when called, so `--help` stays fast."""

from __future__ import annotations

import json
import sys
from contextlib import suppress
from importlib import import_module

from ihbench import registry
from ihbench.clock import streams
from ihbench.clock.failures import Failure, explained, one_line
from ihbench.clock.interruption import interruptible
from ihbench.commands import COMMANDS, module_of
from ihbench.errors import BadInput
from ihbench.record.provenance import description, note_command
from ihbench.scene.method_spec import usable_specs
from ihbench.version import __version__


def usage() -> str:
    lines = [
        f"ihbench {__version__}: how well does a method rebuild an occluded person as an animatable 3D avatar?",
        "",
        "usage: ihbench COMMAND [options]        ihbench COMMAND --help shows its options",
        "",
    ]
    lines += [f"  {name:<11}{what}" for name, what in COMMANDS.items()]
    added = [item for spec in usable_specs() for item in spec.commands.items() if item[0] not in COMMANDS]
    lines += [f"  {name:<11}{command.summary}" for name, command in added]
    lines += [
        "",
        "start here: ihbench run --protocol zju_occ --scene standin-1",
        "exit status: 0 done, 1 a check failed or a run diverged, 2 bad input or a missing prerequisite,",
        "             3 a fault of ihbench itself (IHBENCH_DEBUG=1 prints its traceback), 130 interrupted,",
        "             128 and the number of another signal that ended it: 143 for SIGTERM, 129 for SIGHUP",
    ]
    return "\n".join(lines)


def main(argv: list[str] | None = None) -> int:
    """Run one command and return its exit status. Raises nothing: whatever goes wrong becomes one line on stderr, and
    with `--json` one object on stdout."""
    argv = sys.argv[1:] if argv is None else argv
    streams.settle()
    with streams.shown():
        return _guarded(argv)


def _guarded(argv: list[str]) -> int:
    try:
        with interruptible():
            status = _run(argv)
        sys.stdout.flush()
        return status
    except SystemExit as end:  # --help, and what registered commands make of bad words
        if end.code is None or isinstance(end.code, int):
            return end.code or 0
        return _tell(argv, Failure(2, "bad input", one_line(str(end.code))))
    except BaseException as error:
        failure = explained(error)
        if failure is None:  # the reader of our output went away (`ihbench list | head`): not an error of ours
            streams.drop(sys.stdout)
            return 0
        return _tell(argv, failure)


def _run(argv: list[str]) -> int:
    if not argv or argv[0] in ("-h", "--help", "help"):
        print(usage())
        return 0
    if argv[0] in ("-V", "--version"):
        print(description())
        return 0
    note_command(argv)
    if argv[0] in COMMANDS:
        return import_module(module_of(argv[0])).main(argv[1:])
    specs = usable_specs()
    owners = [spec for spec in specs if argv[0] in spec.commands]
    if len(owners) > 1:
        raise BadInput(f"command {argv[0]!r} is one of the methods {' and '.join(spec.name for spec in owners)}")
    if not owners:
        known = [*COMMANDS, *(name for spec in specs for name in spec.commands)]
        raise BadInput(f"unknown command {argv[0]!r}: {registry.nearest(argv[0], known)}")
    return owners[0].load(owners[0].commands[argv[0]].main)(argv[1:])


def _tell(argv: list[str], failure: Failure) -> int:
    """Say what went wrong, wherever it can still be said."""
    streams.say(f"ihbench: {failure.text}", sys.stderr)
    with suppress(OSError, ValueError):
        if "--json" in argv and streams.failure() is None and not streams.used():  # the result itself may be out
            print(json.dumps({"status": failure.status, "error": failure.text}))
        sys.stdout.flush()
    if streams.failure() is not None:
        streams.drop(sys.stdout)
    return failure.code


if __name__ == "__main__":
    sys.exit(main())
