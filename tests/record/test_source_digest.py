"""The code in a run's identity: whatever moves a number is in it, and words about it are not."""

from __future__ import annotations

import ast
import os
import shutil
import sys
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest

from ihbench import registry
from ihbench.clock.ledger import Ledger
from ihbench.errors import BadInput
from ihbench.files import atomic
from ihbench.record import source_digest
from ihbench.record.source_digest import bench_code, code_of, tree_digest
from ihbench.record.store import RunFolder, RunIdentity
from ihbench.runner.shared_states import reusable_run
from ihbench.scene.protocol import load_protocol
from ihbench.scoring.calibration import Calibration
from tests.bench.test_house import imports

ROOT = Path(__file__).resolve().parents[2]
ROOMS = ("ihbench", *registry.ROOMS)
# of what is left out, the modules that code with numbers may use: they say, find, measure or show
HARMLESS = {
    *("api", "errors", "registry", "record.notebook", "record.provenance", "scoring.contact_sheet"),
    *(f"clock.{name}" for name in ("failures", "streams", "progress", "machine", "threads")),
}

OF_THE_BENCH = [
    *("ihbench/render/splat.py", "ihbench/render/splat_numba.py", "ihbench/render/zbuffer.py"),
    *("ihbench/body/uv.py", "ihbench/body/skinning_numpy.py", "ihbench/body/smpl_file.py"),
    *(
        "ihbench/scene/views.py",
        "ihbench/scene/occlusion.py",
        "ihbench/scene/regions.py",
        "ihbench/scene/visibility.py",
    ),
    *("ihbench/metrics/ssim.py", "ihbench/metrics/flip.py", "ihbench/metrics/presets.py"),
    *(
        "ihbench/scoring/scoring.py",
        "ihbench/runner/score_stage.py",
        "ihbench/scoring/calibration.py",
        "ihbench/scoring/predictions.py",
    ),
    *(
        "ihbench/scene/plan.py",
        "ihbench/scene/protocol.py",
        "ihbench/camera.py",
        "ihbench/runner/run_loop.py",
        "ihbench/clock/ledger.py",
    ),
    *("protocols/occlusion.py", "datasets/zju_mocap/original.py", "datasets/reading/capture_folder.py"),
]
OF_THE_METHOD = ["methods/inpainthuman/stages/stage1.py", "methods/inpainthuman/inpainting/shown_view.py"]
OF_NO_NUMBER = [
    *("ihbench/cli.py", "ihbench/commands/run.py", "ihbench/kernels/splats.py", "ihbench/stress/splat.py"),
    *(
        "ihbench/metrics/oracles/check.py",
        "ihbench/document/diagram.py",
        "ihbench/record/row_labels.py",
        "protocols/zju_occ.toml",
    ),
    "methods/inpainthuman/METHOD.md",
]


@pytest.fixture(scope="module")
def whole_copy(tmp_path_factory):
    folder = tmp_path_factory.mktemp("checkout")
    for room in ROOMS:
        shutil.copytree(ROOT / room, folder / room, ignore=shutil.ignore_patterns("__pycache__"))
    return folder


@pytest.fixture(scope="module")
def hashes_of_copy():
    """What `source_digest` remembers of the copy as it is: the first test to need it hashes it."""
    return {}


@pytest.fixture
def checkout(whole_copy, hashes_of_copy, monkeypatch):
    """A copy of the source, hashed in the place of the installed one."""
    source = registry.source
    monkeypatch.setattr(source_digest, "BENCH", whole_copy / "ihbench")
    monkeypatch.setattr(source_digest, "_known", source_digest._known | hashes_of_copy)
    monkeypatch.setattr(registry, "room", lambda name: whole_copy / name)

    def moved(kind, name):
        path = source(kind, name).resolve()
        return path if path.is_relative_to(whole_copy) else whole_copy / path.relative_to(ROOT)

    monkeypatch.setattr(registry, "source", moved)
    if not hashes_of_copy:
        codes()
        hashes_of_copy |= {path: known for path, known in source_digest._known.items() if str(whole_copy) in path}
    return whole_copy


def with_another_constant(text):
    """The module's text with the first number in it changed."""
    node = next(
        node
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Constant) and type(node.value) in (int, float)
    )
    lines = text.splitlines(keepends=True)
    line = lines[node.lineno - 1].encode()
    lines[node.lineno - 1] = (line[: node.col_offset] + b"7" + line[node.col_offset :]).decode()
    return "".join(lines)


def with_other_words(text):
    """The module's text with other docstrings, comments and line breaks."""
    lines = ["# a comment", *text.splitlines()]
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and ast.get_docstring(node) is not None:
            at = node.body[0].lineno  # one line below, because of the comment
            lines[at] = lines[at].replace('"""', '"""Otherwise: ', 1)
    return "\n\n".join(["\n".join(lines), '"""A last word."""\n'])


def codes():
    """What the identities of a method's run and of scored predictions, and the key of calibration rows, take."""
    protocol = load_protocol("zju_occ")
    return code_of(protocol, "inpainthuman"), bench_code(protocol)


def after_changing(path, change):
    before = path.read_text(encoding="utf-8")
    try:
        path.write_text(change(before), encoding="utf-8")
        assert path.read_text(encoding="utf-8") != before
        source_digest._known.pop(str(path), None)  # as a new process would see it
        return codes()
    finally:
        path.write_text(before, encoding="utf-8")
        source_digest._known.pop(str(path), None)


@pytest.mark.parametrize("file", [*OF_THE_BENCH, *OF_THE_METHOD])
def test_a_constant_makes_another_run_and_a_docstring_does_not(checkout, file):
    run, rows = codes()
    other_run, other_rows = after_changing(checkout / file, with_another_constant)
    assert other_run != run
    assert (other_rows != rows) == (file in OF_THE_BENCH)  # a method has no part in calibration rows
    assert after_changing(checkout / file, with_other_words) == (run, rows)


@pytest.mark.parametrize("file", OF_NO_NUMBER)
def test_what_only_shows_or_checks_numbers_makes_no_other_run(checkout, file):
    change = with_another_constant if file.endswith(".py") else lambda text: text + "\n# more\n"
    assert after_changing(checkout / file, change) == codes()


def test_shipped_weights_and_new_files_count(checkout):
    run, rows = codes()
    for name, both in (
        ("ihbench/body/more.npz", True),
        ("ihbench/new.py", True),
        ("methods/inpainthuman/x.bin", False),
    ):
        path = checkout / name
        path.write_bytes(b"x = 1\n")
        other_run, other_rows = codes()
        path.unlink()
        assert other_run != run
        assert (other_rows != rows) == both


def test_code_with_numbers_uses_nothing_that_is_left_out():
    """The list of what is left out is right: no hashed module imports one of those, harmless ones apart."""
    files = source_digest._files
    hashed = {name for name, _ in files(source_digest.BENCH, source_digest.NOT_IN_NUMBERS) if name.endswith(".py")}
    whole = {name for name, _ in files(source_digest.BENCH, ()) if name.endswith(".py")}
    left_out = {"ihbench." + name.removesuffix(".py").replace("/", ".") for name in whole - hashed}
    assert hashed
    used = {name for file in hashed for name in imports(source_digest.BENCH / file)} & left_out
    assert used <= {f"ihbench.{name}" for name in HARMLESS}


def same(*texts):
    return len({source_digest._code_digest(text.encode()) for text in texts}) == 1


def test_the_tree_counts_and_not_its_layout():
    assert same("x = {'a': 1}", 'x = {\n  "a": 1,\n}  # no matter')
    assert same('def f():\n    "doc"\n    return 1', "def f(): return 1")
    assert same('class A:\n    a: int = 1\n    """Of a field."""\n    b = 2', "class A:\n    a: int = 1\n    b = 2")
    for other in ("x = 1.0", "x = True", "x = '1'", "x = -1", "y = 1", "x = 1; y = 2", "x = None", "x: int = 1"):
        assert not same("x = 1", other)
    assert not same("x = None", "x = ...")
    assert not same("f(a, *b)", "f(*a, b)")
    assert not same("x = 'é'", "x = 'e\u0301'")  # no normal forms
    assert same("x = (", "x = (")  # no Python: its bytes
    assert not same("x = (", "x = ( ")


def test_the_digest_of_a_tree_is_the_same_in_any_version_of_python():
    # made with Python 3.11, 3.12 and 3.13; f-strings and type parameters are what their trees differ in
    text = 'def f(a: int, *, b=1.5) -> str:\n    """Doc."""\n    return f"{a!r:>{b}} and {b:.2f}" f"{a}"\n'
    assert source_digest._code_digest(text.encode()).hex()[:16] == "27dcbff2aa0db78f"


def test_a_module_that_has_changed_since_it_was_imported_is_not_recorded(tmp_path):
    """A notebook runs what it imported, whatever lies on disk by now."""
    file = tmp_path / "mine.py"
    file.write_text("x = 1\n")
    first = tree_digest(tmp_path)
    file.write_text('"""Only words."""\nx = 1\n')
    assert tree_digest(tmp_path) == first
    file.write_text("x = 2\n")
    with pytest.raises(BadInput, match=r"mine\.py: has changed .* start Python anew"):
        tree_digest(tmp_path)


def test_linked_folders_count_and_circles_end(tmp_path):
    root, elsewhere = tmp_path / "root", tmp_path / "elsewhere"
    elsewhere.mkdir()
    root.mkdir()
    (root / "__init__.py").write_text("")
    before = tree_digest(root)
    (root / "linked").symlink_to(elsewhere)
    (elsewhere / "circle").symlink_to(root)
    (elsewhere / "a.py").write_text("x = 1")
    assert tree_digest(root) != before


@pytest.mark.parametrize("kind", ["method", "dataset", "occlusion", "metric preset"])
@pytest.mark.parametrize("shape", ["package", "module", "namespace"])
def test_the_source_of_another_distribution_counts(tmp_path, monkeypatch, kind, shape):
    name = f"theirs_{shape}_{kind.replace(' ', '_')}"
    module = {"package": f"{name}.deep.inside", "module": name, "namespace": f"{name}.real.inside"}[shape]
    file = tmp_path / (module.replace(".", "/") + ".py")
    file.parent.mkdir(parents=True, exist_ok=True)
    beside = file
    if shape != "module":
        for folder in [file.parent, *([file.parent.parent] if shape == "package" else [])]:
            (folder / "__init__.py").write_text("raise RuntimeError('imported')")
        beside = (tmp_path / name if shape == "package" else file.parent) / "layers.py"
        beside.write_text("x = 1")
    file.write_text("raise RuntimeError('imported')")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(source_digest, "_known", {})
    found = registry._found
    point = EntryPoint("theirs", f"{module}:Thing", registry.GROUPS[kind])
    known = {other: found(other) | ({"theirs": point} if other == kind else {}) for other in registry.GROUPS}
    monkeypatch.setattr(registry, "_found", known.get)
    where = registry.source(kind, "theirs")
    assert beside == where or where in beside.parents
    before = tree_digest(where)
    beside.write_text("x = 2")
    source_digest._known.clear()
    assert tree_digest(where) != before
    assert module not in sys.modules


def test_a_method_of_others_that_is_built_on_ours_counts_ours(checkout, tmp_path, monkeypatch):
    package = tmp_path / "theirs_on_ours"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "method.py").write_text("from ihbench.methods.inpainthuman.method import InpaintHuman")
    found, source = registry._found, registry.source
    point = EntryPoint("theirs", "theirs_on_ours.spec:SPEC", registry.GROUPS["method"])
    monkeypatch.setattr(registry, "_found", lambda k: found(k) | ({"theirs": point} if k == "method" else {}))
    monkeypatch.setattr(registry, "source", lambda kind, name: package if name == "theirs" else source(kind, name))
    before = code_of(load_protocol("zju_occ"), "theirs")
    stage = checkout / "methods" / "inpainthuman" / "stages" / "stage1.py"
    text = stage.read_text()
    stage.write_text(text + "\nx = 1\n")
    source_digest._known.pop(str(stage), None)
    after = code_of(load_protocol("zju_occ"), "theirs")
    stage.write_text(text)
    source_digest._known.pop(str(stage), None)
    assert after != before == code_of(load_protocol("zju_occ"), "theirs")


# ------------------------------------------------------------------------------------- who asks for it


@pytest.fixture
def other_code(monkeypatch):
    """As if the renderer had been edited."""

    def edit():
        digest = source_digest.tree_digest
        monkeypatch.setattr(
            source_digest, "tree_digest", lambda root, *a: digest(root, *a)[::-1] if a else digest(root)
        )

    return edit


def test_a_run_of_other_code_is_not_found_again_but_still_reported(bench, mannequin, other_code, monkeypatch):
    assert bench.run(method=mannequin).status == 0
    (old,) = bench.folders()
    kept = (old / "run.json").read_bytes()
    other_code()
    made = []
    build = Calibration.build
    monkeypatch.setattr(Calibration, "build", lambda *a: made.append(1) or build(*a))
    assert bench.run(method=mannequin).status == 0
    assert len(bench.folders()) == 2
    assert made  # calibration rows of other code are none of ours
    assert len(list((bench.runs / "calibration").iterdir())) == 2
    assert (old / "run.json").read_bytes() == kept
    report = bench("report", "--runs", bench.runs)
    assert report.status == 0
    for folder in bench.folders():
        code = atomic.read_json(folder / "run.json")["identity"]["code"]
        assert f"mannequin (code {code})" in report.out  # rows of their own


def test_a_run_from_before_the_bench_was_hashed_is_readable_and_not_found(bench, mannequin):
    assert bench.run(method=mannequin).status == 0
    (new,) = bench.folders()
    old = bench.runs / "zju_occ@1__standin-1__mannequin__quick__s0__0123456789"
    os.replace(new, old)
    record = atomic.read_json(old / "run.json")
    record["identity"]["code"] = "0.1.0+c0ffee00"
    record["digest"] = RunIdentity(**record["identity"]).digest
    atomic.write_json(old / "run.json", record)
    assert "mannequin" in bench("report", "--runs", bench.runs).out
    assert bench.run(method=mannequin).status == 0
    assert len(bench.folders()) == 2


def test_scored_predictions_of_other_code_are_scored_again(bench, mannequin, other_code):
    assert bench.run(method=mannequin).status == 0
    words = ("score", "--protocol", bench.protocol, "--runs", bench.runs, "--scene", "standin-1", "--name", "theirs",
             "--profile", "quick", "--predictions", bench.folders()[0] / "renders")  # fmt: skip
    assert bench(*words).status == 0
    assert bench(*words).status == 0
    assert len(bench.folders()) == 2
    other_code()
    assert bench(*words).status == 0
    assert len(bench.folders()) == 3


def test_presets_scored_by_other_code_are_scored_again(bench, mannequin, other_code):
    assert bench.run(method=mannequin).status == 0
    words = ("report", "--runs", bench.runs, "--preset", "gtu-mask")
    assert bench(*words).status == 0
    file = bench.folders()[0] / "presets" / "gtu-mask.jsonl"
    stamp = file.stat().st_mtime_ns
    assert bench(*words).status == 0
    assert file.stat().st_mtime_ns == stamp
    other_code()
    assert bench(*words).status == 0
    assert file.stat().st_mtime_ns != stamp
    file.write_text('{"lacking": []}\n')  # as before the code was written there
    assert bench(*words).status == 0
    assert len(file.read_text().splitlines()) > 1


def test_no_state_is_taken_from_a_run_of_other_code(bench, mannequin):
    assert bench.run("--seed", 0, method=mannequin).status == 0
    (folder,) = bench.folders()
    Ledger(folder).save_state("fit", {"x": np.zeros(1)}, {"step": 1})
    record = RunFolder.open(folder).record
    borrower, here = RunFolder(bench.runs / "new", record), record.machine
    assert reusable_run(bench.runs, borrower, "fit", (), here) is not None
    other = replace(record, identity=replace(record.identity, code=record.identity.code + "1"))
    assert reusable_run(bench.runs, RunFolder(bench.runs / "new", other), "fit", (), here) is None
    (folder / "checkpoints" / "fit.safetensors").write_bytes(b"")  # nor one that cannot be read
    assert reusable_run(bench.runs, borrower, "fit", (), here) is None
