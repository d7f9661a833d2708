"""A data folder in one layout: how its subjects are found, opened and checked. Layouts say what is their own."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Mapping
from pathlib import Path
from typing import Generic, TypeVar

from ihbench.body import Body
from ihbench.datasets.reading.capture_folder import CaptureFolder
from ihbench.datasets.reading.plausibility import Outline, examine
from ihbench.errors import BadInput
from ihbench.files.paths import user_path
from ihbench.registry import nearest
from ihbench.scene.copy_report import CopyReport, SubjectReport

Capture = TypeVar("Capture", bound=CaptureFolder)
Key = TypeVar("Key", bound=Hashable)
View = tuple[int, int]  # camera, frame


class SubjectFolders(ABC, Generic[Capture]):
    """A folder that holds subjects' folders, or one of those folders itself; see `scene.contracts.Dataset`."""

    dataset: str  # its registered name
    layout: str
    content: str  # what the folder is expected to hold, for messages
    whole: bool | None = True  # see `plausibility.examine`
    samples = 3  # images of a camera that `check` decodes

    def __init__(self, root: Path):
        """Raises `BadInput` when there is no such folder, nothing of this layout in it, or one name twice."""
        self.root = user_path(root)
        itself = self.root.absolute()  # "." may be a subject's folder
        try:
            inside = [itself] if self.holds(itself) else sorted(itself.iterdir())
            folders = [path for path in inside if path.is_dir() and path.name[:1] != "." and self.holds(path)]
            below = None if folders else next(filter(self.holds, sorted(itself.glob("*/*/"))), None)
        except OSError as error:
            raise BadInput(f"{self.root}: cannot be listed ({error.strerror}); expected a readable folder") from error
        nothing = f"{self.root}: no subject of this layout in it"
        if below is not None:
            raise BadInput(f"{nothing}; there is one in {below.parent}, give that folder")
        if not folders:
            raise BadInput(f"{nothing}; expected {self.content}")
        self._folders: dict[str, Path] = {}
        for folder in folders:
            name = self.name_of(folder)
            if name in self._folders:
                raise BadInput(f"{folder}: named {name!r}, as {self._folders[name].name} is; rename one of them")
            self._folders[name] = folder

    @staticmethod
    @abstractmethod
    def holds(folder: Path) -> bool:
        """Whether a folder is a subject of this layout, perhaps with something missing."""

    def name_of(self, folder: Path) -> str:
        return folder.name

    @abstractmethod
    def capture(self, subject: str, body: Body | None) -> Capture:
        """One of the subjects."""

    def subjects(self) -> list[str]:
        """Names, sorted. Raises `BadInput` for an index that cannot be read."""
        return sorted(self._folders)

    def open(self, subject: str, body: Body | None = None) -> Capture:
        """One subject; decodes no picture.

        `body` is the SMPL model that the poses belong to; without it a real capture opens, but what needs the model
        raises. Stand-ins take the bench's own body by themselves. Raises `BadInput` for an unknown subject or a
        damaged one.
        """
        if subject not in self.subjects():
            raise BadInput(f"{self.root}: no subject {subject!r}: {nearest(subject, self.subjects())}")
        return self.capture(subject, body)

    # ------------------------------------------------------------------------------------------- check

    @classmethod
    def check(cls, root: Path, body: Body | None = None) -> CopyReport:
        """What a copy is and what it lacks, for `ihbench data check`.

        Lists folders and decodes `samples` images of a few cameras; `plausibility.examine` holds poses against masks
        where a body is at hand: a stand-in's own, for real data `body`, the SMPL model. Raises `BadInput` when the
        root is not of this layout at all; what is wrong with a subject is in its problems.
        """
        folders = cls(root)
        try:
            names = folders.subjects()
        except BadInput as error:  # an index that cannot be read names no subject
            subjects = [SubjectReport("", [str(error)])]
        else:
            subjects = [folders._subject_report(name, body) for name in names]
        return CopyReport(cls.dataset, cls.layout, str(folders.root), tuple(subjects))

    def _subject_report(self, name: str, body: Body | None) -> SubjectReport:
        report = SubjectReport(name)
        try:
            capture = self.open(name)
            if body is not None and capture.body == "smpl":
                capture = self.open(name, body)
            report.standin, report.body = capture.standin, capture.body
            report.cameras, report.frames = len(capture.camera_ids), capture.n_frames
            report.variant = capture.variant
            views = self.inspect(capture, report)
            outline, exact = self.bodies(capture, report)
            if views or self.whole is None:
                examine(capture, views, report, whole=self.whole, outline=outline, exact=exact, samples=self.samples)
            if not views:
                report.problem("no image with its mask and pose found")
        except BadInput as error:
            report.problem(str(error))
        return report

    @abstractmethod
    def inspect(self, capture: Capture, report: SubjectReport) -> list[View]:
        """Report the files that are there and that are missing; the views that have image, mask and pose."""

    def bodies(self, capture: Capture, report: SubjectReport) -> tuple[Callable[[int], Outline] | None, bool]:
        """The body of a frame, None without a model, and whether the model is the one that the poses belong to."""
        if not capture.has_model:
            return None, True
        model = capture.model
        return lambda frame: Outline(model.pose(capture.body_pose(frame)), model.faces), True


def count_files(
    report: SubjectReport, kinds: Mapping[str, Mapping[Key, Path]], may_lack: tuple[str, ...] = ()
) -> dict[str, set[Key]]:
    """Kind -> the keys whose files are there, each folder listed once; counts them in the report's files and missing.

    What is missing is a problem, but for a stand-in's, which holds only what it was asked for, and for `may_lack`.
    """
    folders = {path.parent for paths in kinds.values() for path in paths.values()}
    listed = {path for folder in folders if folder.is_dir() for path in folder.iterdir()}
    there = {kind: {key for key, path in paths.items() if path in listed} for kind, paths in kinds.items()}
    report.files = {kind: len(keys) for kind, keys in there.items()}
    report.missing = {kind: len(kinds[kind]) - len(keys) for kind, keys in there.items()}
    if not report.standin:
        for kind, count in report.missing.items():
            if count and kind not in may_lack:
                report.problem(f"{count} of {kind} missing")
    return there
