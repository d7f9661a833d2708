from dataclasses import replace

import pytest

from ihbench.body import load_body
from ihbench.data.mesh_check import look_at_mesh

DAMAGE = {
    "": lambda faces: faces,
    "not closed (3 open edges)": lambda faces: faces[:-1],
    "wound in opposite senses": lambda faces: [*faces[:-1], faces[-1][::-1]],
    "inside out": lambda faces: faces[:, ::-1],
}


@pytest.mark.parametrize("words", DAMAGE)
def test_what_is_wrong_with_a_surface_is_named(words):
    body = load_body()
    line, warnings = look_at_mesh(replace(body, faces=DAMAGE[words](body.faces)))
    assert line.startswith(f"{len(body.v_template)} vertices")
    assert words in " ".join(warnings)
    assert bool(warnings) == bool(words)
