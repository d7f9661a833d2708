"""The splat PLY: what viewers expect of the file, field by field, and the way back."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ihbench.errors import BadInput
from ihbench.files.splat_ply import read_splat_ply, splat_ply, write_splat_ply

# the order and names in which the released 3D Gaussian splatting code writes them, without the higher harmonics
FIELDS = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
FIELDS += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]


def some(n, seed=0):
    rng = np.random.default_rng(seed)
    draw = rng.normal(0, 1, (n, 3)), 10 ** rng.uniform(-4, -1, n), rng.uniform(0, 1, (n, 3))
    return tuple(array.astype(np.float32) for array in draw)


def parse(data):
    """A reader of its own: header words, and name -> column."""
    head, body = data.split(b"end_header\n", 1)
    lines = head.decode("ascii").splitlines()
    names = [line.split()[2] for line in lines if line.startswith("property")]
    assert all(line.split()[1] == "float" for line in lines if line.startswith("property"))
    table = np.frombuffer(body, np.dtype([(name, "<f4") for name in names]))
    return lines, table


@pytest.mark.parametrize("n", [0, 1, 1000])
def test_round_trip(n):
    means, scales, colors = some(n)
    back = read_splat_ply(splat_ply(means, scales, colors))
    assert [array.shape for array in back] == [(n, 3), (n,), (n, 3)]
    assert np.array_equal(back[0], means)
    np.testing.assert_allclose(back[1], scales, rtol=2e-6)
    np.testing.assert_allclose(back[2], colors, atol=1e-6)


@pytest.mark.parametrize("n", [0, 5])
def test_header(n):
    lines, table = parse(splat_ply(*some(n)))
    assert lines[:3] == ["ply", "format binary_little_endian 1.0", f"element vertex {n}"]
    assert list(table.dtype.names) == FIELDS
    assert len(table) == n


def test_every_field_means_what_a_viewer_takes_it_for():
    means, scales, colors = some(50)
    _, table = parse(splat_ply(means, scales, colors))
    assert np.array_equal(np.stack([table[name] for name in "xyz"], 1), means)
    harmonic = 1 / (2 * np.sqrt(np.pi))  # the constant spherical harmonic
    for k in range(3):
        np.testing.assert_allclose(0.5 + harmonic * table[f"f_dc_{k}"], colors[:, k], atol=1e-6)
        np.testing.assert_allclose(np.exp(table[f"scale_{k}"]), scales, rtol=2e-6)
        assert not table[f"rot_{k + 1}"].any()
        assert not table["nxnynz"[2 * k : 2 * k + 2]].any()
    assert (table["rot_0"] == 1).all()  # the real part comes first
    opacity = 1 / (1 + np.exp(-table["opacity"].astype(float)))
    np.testing.assert_allclose(opacity, 0.999, atol=1e-6)


def test_comments_stand_in_the_header_in_one_line_each():
    lines, table = parse(splat_ply(*some(3), ["units: metres", "pose: é\nelement vertex 9", "\x1b[31mend_header"]))
    assert lines[:3] == ["ply", "format binary_little_endian 1.0", "comment units: metres"]
    assert [line.startswith("comment ") for line in lines[2:5]] == [True] * 3
    assert lines[5] == "element vertex 3"
    assert len(table) == 3
    assert np.array_equal(read_splat_ply(splat_ply(*some(3), ["element vertex 9"]))[0], some(3)[0])


def test_turned_and_transparent_needles_with_harmonics():
    rng = np.random.default_rng(1)
    n = 20
    means, _, colors = some(n)
    scales, opacities = rng.uniform(1e-3, 1e-1, (n, 3)), rng.uniform(0, 1, n)
    opacities[:2] = 0, 1  # neither has a finite logit
    turns = Rotation.random(n, random_state=0).as_quat()[:, [3, 0, 1, 2]]
    harmonics = rng.normal(size=(n, 9, 3))
    _, table = parse(splat_ply(means, scales, colors, (), turns, opacities, harmonics))
    rest = [f"f_rest_{k}" for k in range(24)]
    assert list(table.dtype.names) == [*FIELDS[:9], *rest, *FIELDS[9:]]
    for k in range(3):
        np.testing.assert_allclose(np.exp(table[f"scale_{k}"]), scales[:, k], rtol=2e-6)
        np.testing.assert_allclose(table[f"f_dc_{k}"], harmonics[:, 0, k], rtol=1e-6)
        for m in range(8):  # channel by channel
            np.testing.assert_allclose(table[f"f_rest_{8 * k + m}"], harmonics[:, 1 + m, k], rtol=1e-6)
    for k in range(4):
        np.testing.assert_allclose(table[f"rot_{k}"], turns[:, k], atol=1e-6)
    np.testing.assert_allclose(1 / (1 + np.exp(-table["opacity"].astype(float))), opacities, atol=1.1e-3)
    with pytest.raises(ValueError, match="harmonics"):
        splat_ply(means, scales, colors, (), turns, opacities, harmonics[:, :5])
    with pytest.raises(ValueError, match="opacities"):
        splat_ply(means, scales, colors, (), turns, opacities + 0.5)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (lambda m, s, c: (m.T, s, c), "means"),
        (lambda m, s, c: (m, np.repeat(s[:, None], 2, 1), c), "scales"),
        (lambda m, s, c: (m, s, c[:, :1]), "colors"),
        (lambda m, s, c: (m, np.log(s), c), "logarithms"),
        (lambda m, s, c: (m, s, c * 255), "divide 8-bit"),
        (lambda m, s, c: (m, s, (c * 255).astype(np.uint8)), "divide 8-bit"),
        (lambda m, s, c: (m * np.nan, s, c), "finite"),
    ],
)
def test_other_gaussians_are_refused(change, word):
    with pytest.raises(ValueError, match=word):
        splat_ply(*change(*some(5)))


def test_a_scale_of_zero_stays_finite():
    means, scales, colors = some(2)
    _, table = parse(splat_ply(means, scales * 0, colors))
    assert np.isfinite([table[name] for name in FIELDS]).all()


def test_writing(tmp_path):
    write_splat_ply(tmp_path / "a" / "person.ply", *some(7))
    assert (tmp_path / "a" / "person.ply").read_bytes() == splat_ply(*some(7))
    with pytest.raises(BadInput):
        write_splat_ply(tmp_path / "a" / "person.ply" / "below.ply", *some(7))
