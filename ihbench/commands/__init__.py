"""One module per command: its options as a frozen dataclass, and `main(argv) -> exit status`."""

COMMANDS = {
    "run": "fit a method under a protocol, score it, print the table (the main job)",
    "list": "what is registered: methods, datasets, protocols, reports, metrics",
    "protocol": "show every choice of a protocol, or where two differ",
    "plan": "what a run would do, what it leaves out and why; runs nothing",
    "data": "check a data folder, or write a stand-in capture",
    "score": "score a folder of images that somebody else's code rendered",
    "prepare": "hand out the occluded training set for other people's code",
    "ablate": "what each component of a method is worth, in quality and in seconds",
    "report": "tables of finished runs, and error against run time",
    "figures": "figures as papers have them, from finished runs: PNG, PDF and the caption",
    "site": "an offline page of finished runs: tables, frames, curves, avatars that move",
    "view": "the same on 127.0.0.1, following runs that are not done",
    "runs": "list the runs in a folder, one line each; remove some",
    "metrics": "check every metric against oracles, other libraries and stored values",
    "weights": "learned weights the bench may not ship: list, where, fetch",
    "render": "an avatar turned around, moved, beside others: WebP, GIF, WebM, MP4 or PNG frames",
    "export": "an avatar for other programs: splat PLY, glTF with skin or splats, texture, motion",
    "stress": "stiff and extreme cases with known answers, case by case",
    "kernels": "error against milliseconds for the bench's own kernels",
    "train-mini": "train the small diffusion backbone on procedural people; goes on where it stopped",
}
SHOWING = ("render", "export", "figures", "site", "view")  # their modules lie in `pages`


def module_of(command: str) -> str:
    """The dotted name of a command's module."""
    room = "pages." if command in SHOWING else ""
    return f"ihbench.commands.{room}{command.replace('-', '_')}"
