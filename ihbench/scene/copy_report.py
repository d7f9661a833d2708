"""What `ihbench data check` says of a folder: one report of the copy, with one of each of its subjects."""

from __future__ import annotations

from dataclasses import dataclass, field, fields


@dataclass
class SubjectReport:
    """What one subject holds and lacks, in the order in which it is printed; None and {} are not printed.

    Filled while the subject is looked at: what was read before an error stands in it.
    """

    subject: str
    problems: list[str] = field(default_factory=list)  # what no sound copy has; each line once
    warnings: list[str] = field(default_factory=list)  # what a sound one may have and somebody should look at
    standin: str | None = None  # "" for real data
    body: str | None = None  # whose poses these are: "smpl", "procedural" or "own"
    gender: str | None = None
    variant: str | None = None
    cameras: int | None = None
    frames: int | None = None
    views: int | None = None
    files: dict[str, int] = field(default_factory=dict)  # by kind
    missing: dict[str, int] = field(default_factory=dict)  # by kind
    alignment: dict[str, str | float | None] | None = None  # which of surplus poses were taken, and the two overlaps
    numbered: bool | None = None  # frames are the numbers in the files' names
    consensus_betas: float | None = None  # largest difference of consensus.pkl's from the poses'
    body_used: str | None = None
    sampled_images: int | None = None  # how many were decoded
    image_size: list[list[int]] | None = None  # every [width, height] px among them
    vertices_in_mask: float | None = None  # share of the body's vertices, see `plausibility.Overlap`
    mask_on_body: float | None = None  # share of the silhouette
    protocols: dict[str, str] | None = None  # name -> "complete", or what it lacks
    overlay: str | None = None  # the picture's path, or why there is none

    def problem(self, text: str) -> None:
        if text not in self.problems:
            self.problems.append(text)

    def warn(self, text: str) -> None:
        if text not in self.warnings:
            self.warnings.append(text)

    def as_json(self) -> dict[str, object]:
        values = ((entry.name, getattr(self, entry.name)) for entry in fields(self))
        return {name: value for name, value in values if value not in (None, {})}


@dataclass(frozen=True)
class CopyReport:
    """What a copy of a data set is and what it lacks."""

    dataset: str
    layout: str
    root: str
    subjects: tuple[SubjectReport, ...]
    body_mesh: str = ""  # what is to be said of the surface of the body file that was given
    warnings: tuple[str, ...] = ()  # of the copy as a whole

    @property
    def standin(self) -> str:
        """What made the copy; "" for real data."""
        return next((subject.standin for subject in self.subjects if subject.standin), "")

    @property
    def ok(self) -> bool:
        return not any(subject.problems for subject in self.subjects)

    def as_json(self) -> dict[str, object]:
        """Plain data, without what has nothing to say."""
        of_body = {"body_mesh": self.body_mesh} | ({"warnings": list(self.warnings)} if self.warnings else {})
        return {
            "dataset": self.dataset,
            "layout": self.layout,
            "root": self.root,
            "standin": self.standin,
            **(of_body if self.body_mesh else {}),
            "subjects": [subject.as_json() for subject in self.subjects],
            "ok": self.ok,
        }
