"""The switches of InpaintHuman: each is explained, checked and has the paper's value in the paper profile."""

import ast
import inspect
import io
import subprocess
import sys
from contextlib import redirect_stdout
from dataclasses import fields, replace
from typing import get_args, get_type_hints

import pytest
import tyro

from ihbench.errors import BadInput
from ihbench.methods.inpainthuman import config as module
from ihbench.methods.inpainthuman.config import PAPER, PROFILES, QUICK, InpaintHumanConfig

NAMES = [field.name for field in fields(InpaintHumanConfig)]


def docstrings():
    """Field name -> the string that stands under it in the source."""
    (kind,) = (n for n in ast.parse(inspect.getsource(module)).body if isinstance(n, ast.ClassDef))
    found = {}
    for node, below in zip(kind.body, kind.body[1:], strict=False):
        if isinstance(node, ast.AnnAssign) and isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
            assert isinstance(node.target, ast.Name)
            found[node.target.id] = below.value.value
    return found


def test_every_switch_is_explained():
    assert list(docstrings()) == NAMES
    for name, text in docstrings().items():
        assert len(text.split()) >= 4, name
        assert text.endswith("."), name


def test_the_command_line_shows_every_explanation():
    out = io.StringIO()
    with redirect_stdout(out), pytest.raises(SystemExit):
        tyro.cli(InpaintHumanConfig, args=["--help"])
    shown = " ".join(out.getvalue().replace("│", " ").split())
    for name, text in docstrings().items():
        assert f"--{name.replace('_', '-')}" in shown
        assert " ".join(text.split()[:3]) in shown


def test_the_paper_profile_has_the_papers_numbers():
    assert set(PROFILES) == {"quick", "paper"}
    assert (PAPER.levels, PAPER.channels, PAPER.fusion) == ((64, 128, 256), 32, "sum")
    assert (PAPER.decoder_layers, PAPER.decoder_width) == (3, 128)
    assert (PAPER.lr_maps, PAPER.lr_decoder, PAPER.lr_encoder, PAPER.lr_final) == (1e-4, 1e-4, 1e-4, 1)
    assert (PAPER.texels, PAPER.steps, PAPER.position_map, PAPER.residual_channels) == (512, 3000, 128, 32)
    assert PAPER.residual_start == 0.3
    assert (QUICK.texels, QUICK.steps) == (256, 400)
    assert not PAPER.paper_strict


@pytest.mark.parametrize(
    "change",
    [
        {"texels": 0}, {"levels": ()}, {"levels": (64, 0)}, {"channels": 0}, {"decoder_layers": 0},
        {"decoder_width": -1}, {"encoding_frequencies": -1}, {"position_map": 0}, {"position_map": 20},
        {"residual_channels": 6}, {"scale_initial": 0.0}, {"scale_limit": float("nan")}, {"steps": 0},
        {"clip_gradient": 0.0},
    ],
    ids=str,
)  # fmt: skip
def test_values_that_cannot_work_are_refused_by_flag_and_value(change):
    ((name, value),) = change.items()
    with pytest.raises(BadInput) as caught:
        replace(QUICK, **change)
    message = str(caught.value)
    spelled = " ".join(map(str, value)) if isinstance(value, tuple) and value else value
    assert message.startswith(f"--method.{name.replace('_', '-')} {spelled}: expected ")
    assert "\n" not in message


def test_choices_are_those_the_code_knows():
    from ihbench.body import CANONICAL_POSES

    hints = get_type_hints(InpaintHumanConfig)
    assert set(get_args(hints["canonical_pose"])) == set(CANONICAL_POSES)
    for name in ("fusion", "offset", "scale_activation"):
        assert getattr(QUICK, name) in get_args(hints[name])


def test_reading_the_switches_imports_nothing_heavy():
    code = (
        "import sys, ihbench.methods.inpainthuman.config\nprint(sorted({'torch', 'cv2', 'scipy'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
