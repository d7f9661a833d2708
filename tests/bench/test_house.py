"""The rules of the house: which way imports point, and what the light commands may not import."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
CONTENT = ("methods", "datasets", "protocols", "reports")
HEAVY = ("torch", "cv2", "kornia", "lpips", "diffusers", "transformers", "skimage", "matplotlib", "pandas", "trimesh")


def imports(path):
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            yield node.module
        elif isinstance(node, ast.ImportFrom) and node.level:
            yield f"relative import in {path}"


def wrong_imports(room, path):
    for name in imports(path):
        parts = name.split(".")
        if parts[0] != "ihbench":
            if name.startswith("relative"):
                yield name
        elif len(parts) > 1 and parts[1] in CONTENT and parts[1] != room:
            yield f"{path} imports {name}"


@pytest.mark.parametrize("room", ["ihbench", *CONTENT])
def test_imports_point_one_way(room):
    files = sorted((ROOT / room).rglob("*.py"))
    assert files, f"room {room} is empty"
    assert [line for path in files for line in wrong_imports(room, path)] == []


def test_the_checker_sees_a_wrong_import(tmp_path):
    bad = tmp_path / "bad.py"  # not in the room itself: a run of another process would hash it
    bad.write_text("from ihbench.methods.inpainthuman import avatar\n", encoding="utf-8")
    assert list(wrong_imports("ihbench", bad))


def test_no_top_level_package_shadows_another():
    for room in CONTENT:
        code = f"import sys; sys.path.pop(0); from importlib.util import find_spec; print(find_spec('{room}'))"
        where = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True
        ).stdout.strip()
        assert str(ROOT) not in where


LIGHT = {
    "help": ["--help"],
    "list": ["list"],
    "protocol show": ["protocol", "show", "zju_occ"],
    "protocol diff": ["protocol", "diff", "zju_occ", "zju_occ_occnerf"],
    "plan": ["plan", "--protocol", "zju_occ"],
    "plan help": ["plan", "--help"],
    "run help": ["run", "--help"],
    "site help": ["site", "--help"],
    "view help": ["view", "--help"],
    "render help": ["render", "--help"],
    "export help": ["export", "--help"],
}


@pytest.mark.parametrize("argv", LIGHT.values(), ids=LIGHT)
def test_light_commands_import_nothing_heavy(argv):
    code = (
        "import sys\nfrom ihbench.cli import main\n"
        f"try:\n    status = main({argv!r})\nexcept SystemExit as e:\n    status = e.code\n"
        f"print('HEAVY', sorted(set({HEAVY!r}) & set(sys.modules)), status)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip().splitlines()[-1] == "HEAVY [] 0", done.stdout[-500:] + done.stderr[-500:]
