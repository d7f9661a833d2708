"""A hash of the source that numbers come from: an edited renderer, metric or loader makes another run.

Of a Python file the syntax tree is hashed, without docstrings and other bare strings: a comment, a docstring or a
line break changes nothing, everything else does. The tree is written out by this module and not by `ast.dump` or
`ast.unparse`, whose words differ between versions of Python. Other files of a package (weights, tables, compiled
modules) are hashed as they are. Nothing is imported.

Which source: all of the bench but what `NOT_IN_NUMBERS` names, and the packages that register the method, the data
set, the occlusion rules and the metric presets of a run, whole; where another distribution's package imports one of
the bench's rooms, that too. A new file is in by default.
"""

from __future__ import annotations

import ast
import gc
import hashlib
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from fnmatch import fnmatch
from pathlib import Path
from typing import TYPE_CHECKING

from ihbench import registry
from ihbench.errors import BadInput
from ihbench.version import __version__

if TYPE_CHECKING:
    from ihbench.scene.protocol import Protocol

BENCH = Path(__file__).resolve().parents[1]
# of the bench: commands, what only shows or checks numbers, and the rooms, which are asked for one by one
NOT_IN_NUMBERS = (
    *(f"{room}/*" for room in registry.ROOMS),
    "commands/*", "kernels/*", "stress/*", "show/*", "export/*",
    "__main__.py", "cli.py", "clock/progress.py", "errors.py", "registry.py",
    "runner/ablation.py", "runner/executor.py", "record/index.py", "record/quality_time.py",
    "record/frame.py", "record/notebook.py", "record/scene_means.py", "record/row_choice.py", "record/row_labels.py",
    "scoring/contact_sheet.py", "document/*", "files/splat_ply.py",
    "api.py", "runner/repeat.py", "clock/gpu_slots.py", "clock/failures.py", "clock/streams.py",
    "clock/machine.py", "record/provenance.py", "clock/threads.py",
    "metrics/oracles/*",
)  # fmt: skip
DESCRIPTIONS = ("*.md", "*.rst", "*.typed", "*~", ".*")
ROOM_NAME = re.compile(rb"ihbench\.(methods|datasets|protocols)\.(\w+)")
LARGE = 64 * 2**20  # bytes; of larger files, which are weights, only the ends are read
ENDS = 2**16  # bytes
LENGTH = 8  # hex digits

_known: dict[str, tuple[tuple[int, int, int], bytes]] = {}  # path -> state of the file, digest


def code_of(protocol: Protocol, method: str) -> str:
    """What a run's identity says of its code: version, hash of the method's package, hash of the bench."""
    own = _digest_of([("method", method)])
    return f"{__version__}+{own}+{bench_code(protocol)}"


def bench_code(protocol: Protocol, presets: Sequence[str] | None = None) -> str:
    """Hash of everything but the method that moves a number under a protocol, or under other metric presets than the
    protocol's. Raises `BadInput` when a file that was hashed before in this process has other code now."""
    rules = dict.fromkeys((protocol.occlusion.rule, protocol.occlusion.unlisted))
    parts = [("dataset", protocol.dataset), *(("occlusion", rule) for rule in rules)]
    parts += [("metric preset", name) for name in (protocol.metrics.presets if presets is None else presets)]
    return hashlib.sha256(f"{tree_digest(BENCH, NOT_IN_NUMBERS)} {_digest_of(parts)}".encode()).hexdigest()[:LENGTH]


def _digest_of(parts: Iterable[tuple[str, str]]) -> str:
    """Hash of the packages that register these names, and of those of the bench's rooms that they name."""
    roots: dict[Path, None] = {}
    for kind, name in parts:
        root = registry.source(kind, name).resolve()
        if root != BENCH and root not in roots:
            roots |= dict.fromkeys([root, *_rooms_named(root)])
    digests = sorted({tree_digest(root) for root in roots})
    return digests[0] if len(digests) == 1 else hashlib.sha256(" ".join(digests).encode()).hexdigest()[:LENGTH]


def _rooms_named(root: Path) -> list[Path]:
    """Packages of the bench's rooms that other people's source imports: their method may be built on ours."""
    rooms = {room: registry.room(room).resolve() for room in registry.ROOMS}
    if any(root == room or room in root.parents for room in rooms.values()):
        return []  # of the bench itself: rooms do not import each other
    named = set()
    for name, path in _files(root, ()):
        if name.endswith(".py"):
            named |= {match.groups() for match in ROOM_NAME.finditer(path.read_bytes())}
    paths = [rooms[room.decode()] / inner.decode() for room, inner in named]
    return sorted({path if path.is_dir() else path.parent for path in paths})


def tree_digest(root: Path, leave_out: Sequence[str] = ()) -> str:
    """Hash of a package's folder, or of a module's one file, without what the patterns (relative paths) name."""
    digest = hashlib.sha256()
    for name, path in sorted(_files(root, leave_out)):
        digest.update(name.encode(errors="surrogateescape") + b"\0" + _file_digest(path))
    return digest.hexdigest()[:LENGTH]


def shipped_digest(path: Path) -> bytes:
    """Hash of a file as it is: whole, or both ends and the size of a large one, which would take minutes."""
    size = path.stat().st_size
    with path.open("rb") as file:
        if size <= LARGE:
            return hashlib.file_digest(file, "sha256").digest()
        ends = file.read(ENDS)
        file.seek(size - ENDS)
        return hashlib.sha256(b"%d\0" % size + ends + file.read(ENDS)).digest()


def _files(root: Path, leave_out: Sequence[str]) -> Iterator[tuple[str, Path]]:
    """Name inside the root and path of every file to hash. Follows links, each folder once."""
    if root.is_file():
        yield root.name, root
        return
    protocols = {registry.entry_point("protocol", name).attr for name in registry.names("protocol")}  # by content
    skipped, seen = (*DESCRIPTIONS, *protocols), set()
    for folder, folders, files in os.walk(root, followlinks=True):
        real = os.path.realpath(folder)
        inside = Path(folder).relative_to(root)
        folders[:] = [
            name
            for name in folders
            if name != "__pycache__"
            and not name.startswith(".")
            and not any(fnmatch(f"{(inside / name).as_posix()}/", pattern) for pattern in leave_out)
        ]
        if real in seen:
            folders.clear()
            continue
        seen.add(real)
        for name in files:
            relative = (inside / name).as_posix()
            if not any(fnmatch(name, p) for p in skipped) and not any(fnmatch(relative, p) for p in leave_out):
                yield relative, Path(folder, name)


def _file_digest(path: Path) -> bytes:
    """Hash of one file, taken again only when the file has changed.

    A module stays in memory as it was imported. Raises `BadInput` when its file has other code by now: what would be
    recorded is not what would run.
    """
    try:
        about = path.stat()
        state = about.st_mtime_ns, about.st_size, about.st_ino
        before = _known.get(str(path))
        if before is not None and before[0] == state:
            return before[1]
        digest = _code_digest(path.read_bytes()) if path.suffix == ".py" else shipped_digest(path)
    except OSError as error:
        raise BadInput(f"{path}: cannot be read ({error.strerror}); a run records its code") from error
    if before is not None and before[1] != digest:
        raise BadInput(
            f"{path}: has changed since this process first used it; start Python anew, so that what is recorded is "
            "what runs"
        )
    _known[str(path)] = state, digest
    return digest


def _code_digest(source: bytes) -> bytes:
    """Hash of the syntax tree; of the bytes where they are no Python of this version."""
    collecting = gc.isenabled()
    gc.disable()  # a tree is many new objects and no cycle: searching them for one takes longer than parsing
    try:
        words: list[str] = []
        _write(ast.parse(source), words)
        return hashlib.sha256("\n".join(words).encode(errors="surrogatepass")).digest()
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return hashlib.sha256(source).digest()
    finally:
        if collecting:
            gc.enable()


def _write(node: ast.AST, words: list[str]) -> None:
    """Append a node's canonical form. Empty and default fields are left out: newer versions of Python have more."""
    words.append(type(node).__name__)
    for name in node._fields:
        value = getattr(node, name, None)
        if (value is None and not isinstance(node, ast.Constant)) or name in ("ctx", "kind", "type_comment"):
            continue
        if isinstance(value, list):
            items = [item for item in value if not _says_nothing(item, node)]
            if items:
                words.append(f"{name}[")
                for item in items:
                    if isinstance(item, ast.AST):
                        _write(item, words)
                    else:
                        words.append(ascii(item))
                words.append("]")
        elif isinstance(value, ast.AST):
            words.append(name)
            _write(value, words)
        else:
            words.append(f"{name}={type(value).__name__} {value!a}")
    words.append(")")


def _says_nothing(item: object, parent: ast.AST) -> bool:
    """A docstring or another bare string; in an f-string, the empty constant that Python 3.12 puts there."""
    if isinstance(item, ast.Expr):
        return isinstance(item.value, ast.Constant) and isinstance(item.value.value, str)
    return isinstance(parent, ast.JoinedStr) and isinstance(item, ast.Constant) and item.value == ""
