"""`ihbench site`: from finished runs to one offline page, in a folder or as a single file."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path

from ihbench.clock.progress import Progress
from ihbench.errors import BadInput
from ihbench.record import outputs
from ihbench.record.results import RunResult
from ihbench.record.shareable import shareable, without_places
from ihbench.reports.site.frames import Files, OpenScenes, scene_frames
from ihbench.reports.site.moving import avatars
from ihbench.reports.site.page import Site
from ihbench.reports.site.tables import site_tables
from ihbench.version import __version__

LARGEST_FILE = 25 * 2**20  # bytes of a single file: browsers open 32 MB by double click, and mail takes 25
PICTURE = re.compile(r"[0-9a-f]{16}\.(webp|png)")  # what `frames.Files` calls them
TITLE = "ihbench: occluded people, rebuilt"


def build(
    results: Sequence[RunResult],
    left_out: Sequence[str] = (),
    *,
    views: int = 12,
    title: str = TITLE,
    data: Path | None = None,
    body: Path | None = None,
    share: bool = False,
    progress: Progress | None = None,
    scenes: OpenScenes | None = None,
    pictures: bool = True,
) -> Site:
    """The site of these runs, with pictures of about `views` test views of a scene.

    `data` and `body` are the user's copies, where runs used any; without them there are no truths beside the
    predictions. `share` leaves out what a body model's licence does not let pass on. Raises `BadInput`
    where there is no run. `scenes` keeps what was opened for the next site; without `pictures` there are numbers
    alone.
    """
    if not results:
        raise BadInput("there is no run to show")
    progress = progress or Progress()
    files, scenes = Files(), scenes or OpenScenes(data, body)
    results = shareable(results)
    content = site_tables(results, [without_places(line) for line in left_out])
    frames = scene_frames(results, files, scenes, views, progress) if pictures else []
    moving, carried = avatars(results if pictures else (), frames, files, scenes, progress, share)
    content |= {"frames": [f.as_json for f in frames], **moving}
    content["made"] = f"Made by ihbench {__version__} from {len(results)} run{'s' * (len(results) != 1)}."
    content["notes"] = []
    return Site(title, content, files.content, carried)


def write_folder(site: Site, folder: Path) -> Path:
    """`index.html` and the pictures beside it; pictures of an earlier site there go. Returns the page's path. Raises
    `BadInput` where somebody else's file of such a name is there."""
    outputs.check(folder, ["index.html"])
    for name, content in site.files.items():
        outputs.write_bytes(folder / "files" / name, content, durable=False)
    index = folder / "index.html"
    outputs.write_text(index, site.html())
    if (folder / "files").is_dir():
        outputs.remove_old(folder / "files", lambda name: bool(PICTURE.fullmatch(name)) and name not in site.files)
    return index


def write_single(site: Site, file: Path) -> int:
    """Everything in one file. Returns its size. Raises `BadInput` where it would be too large to open by double
    click."""
    text = site.html(single=True).encode("utf-8")
    if len(text) > LARGEST_FILE:
        raise BadInput(
            f"{file}: would have {len(text) / 2**20:.0f} MB, more than {LARGEST_FILE / 2**20:.0f}; take fewer "
            "--views, or leave --single-file out"
        )
    from ihbench.files import atomic

    atomic.write_bytes(file, text)
    return len(text)


def serve(
    read: Callable[[], tuple[list[RunResult], list[str]]],
    port: int,
    *,
    views: int = 12,
    title: str = TITLE,
    data: Path | None = None,
    body: Path | None = None,
) -> None:
    """Serve the site of what `read` gives on 127.0.0.1, made anew whenever a run has finished, until interrupted.
    Raises `BadInput` for a port that cannot be had."""
    from ihbench.reports.site.server import Followed, serve_followed

    scenes, progress = OpenScenes(data, body), Progress()

    def make(results: Sequence[RunResult], left_out: Sequence[str], pictures: bool) -> Site:
        return build(results, left_out, views=views, title=title, progress=progress, scenes=scenes, pictures=pictures)

    serve_followed(Followed(read, make), port, progress.say)


def need_viser() -> None:
    """Raise `BadInput` where viser, which `serve_live` needs, is not installed."""
    from ihbench.reports.site.live_view import viser_or_why

    viser_or_why()


def serve_live(
    places: Sequence[Path],
    port: int,
    *,
    data: Path | None = None,
    body: Path | None = None,
    goes_on: Callable[[], bool] = lambda: True,
) -> None:
    """See `live_view.serve_live`."""
    from ihbench.reports.site import live_view

    live_view.serve_live(places, port, Progress().say, data, body, goes_on)
