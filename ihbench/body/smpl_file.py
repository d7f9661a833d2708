"""Read body model files without running anything in them: SMPL's official `.pkl` and `.npz`, and the bench's `.npz`.

The official files are gated and never shipped or downloaded. Facts about their contents follow
vchoutas/smplx smplx/body_models.py and SMPL's release notes.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ihbench.body.atlas import part_atlas
from ihbench.body.model import Body
from ihbench.body.skeleton import PARENTS
from ihbench.body.uv_obj import read_uv_obj
from ihbench.errors import BadInput
from ihbench.files.npz import read_npz, write_npz
from ihbench.files.paths import user_path
from ihbench.files.safe_pickle import ForeignObject, load_pickle

PROCEDURAL_FILE = Path(__file__).with_name("procedural_body.npz")
WHERE_SMPL_IS = (
    "register at https://smpl.is.tue.mpg.de, download SMPL for Python and give the .pkl file or its folder"
)
REQUIRED = ("v_template", "f", "weights", "J_regressor", "kintree_table", "shapedirs")
OPTIONAL = ("posedirs", "vt", "ft", "face_landmarks")
MAX_ELEMENTS = 10**9  # of one array; a real file's largest has 6.2 million (300 shape coefficients)


def load_body(
    path: str | Path | None = None,
    *,
    uv_path: str | Path | None = None,
    n_betas: int | None = None,
    gender: str = "neutral",
) -> Body:
    """The body model in a file, or the bench's own procedural body when `path` is None.

    path: an official SMPL `.pkl` or `.npz`, a file written by `write_body`, or a folder that holds SMPL files under
      their official names (then `gender` picks one).
    uv_path: an OBJ file with texture coordinates for the same faces. Default: the file's own coordinates, else
      `smpl_uv.obj` beside it, else an atlas cut from the mesh (`atlas.part_atlas`).
    n_betas: keep only this many shape coefficients. Default: all that the file has (10 or 300).

    Raises `BadInput` when a file is missing, damaged, hostile, or not SMPL-shaped.
    """
    if path is None:
        if uv_path is not None or n_betas is not None:
            raise BadInput("the procedural body has its own texture coordinates and shapes; give a body file as well")
        return _procedural_body()
    path = user_path(path)
    if path.is_dir():
        path = find_model_file(path, gender)
    if not path.is_file():
        raise BadInput(f"{path}: no such body file; {WHERE_SMPL_IS}")
    return _body_from_arrays(read_arrays(path), path, None if uv_path is None else Path(uv_path), n_betas)


@cache
def _procedural_body() -> Body:
    return _body_from_arrays(read_arrays(PROCEDURAL_FILE), PROCEDURAL_FILE, None, None)


def find_model_file(folder: Path, gender: str = "neutral") -> Path:
    """The SMPL file of that gender in a folder, or in the subfolders that the official archives unpack to."""
    if gender not in ("neutral", "male", "female"):
        raise BadInput(f"body gender {gender!r}: expected neutral, male or female")
    name = re.compile(rf"(smpl_{gender}|basicmodel_({gender}|{gender[0]})_lbs_.*)\.(npz|pkl)", re.IGNORECASE)
    places = [folder / subfolder for subfolder in (".", "smpl", "models", "smpl/models")]
    files = (file for place in places if place.is_dir() for file in sorted(place.iterdir()))
    if file := next((file for file in files if name.fullmatch(file.name)), None):
        return file
    raise BadInput(
        f"{folder}: no SMPL_{gender.upper()}.pkl, .npz or basicModel_{gender[0]}_lbs_*.pkl; {WHERE_SMPL_IS}"
    )


def read_arrays(path: Path) -> dict[str, NDArray]:
    """The entries of a model file that this bench uses, as plain arrays (`name` of one text). Shapes unchecked."""
    if path.suffix.lower() == ".npz":
        return read_npz(path, (*REQUIRED, *OPTIONAL, "name"))
    if path.suffix.lower() != ".pkl":
        raise BadInput(f"{path}: expected a body file that ends in .pkl or .npz; {WHERE_SMPL_IS}")
    raw = load_pickle(path)
    if not isinstance(raw, dict):
        raise BadInput(f"{path}: expected a dictionary of model arrays, found a {type(raw).__name__}")
    return {key: _plain_array(raw[key], f"{path}: {key}") for key in (*REQUIRED, *OPTIONAL) if key in raw}


def _plain_array(value: Any, where: str) -> NDArray:
    """A chumpy or scipy.sparse object, or an array, as an array."""
    if isinstance(value, ForeignObject):
        try:
            return _foreign_array(value, where)
        except (
            KeyError, IndexError, TypeError, ValueError, AttributeError, RecursionError, MemoryError,
        ) as error:  # fmt: skip
            raise BadInput(f"{where}: a damaged {value.kind} object ({error!r}); copy the file again") from None
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "biuf":
        kind = value.dtype if isinstance(value, np.ndarray) else type(value).__name__
        raise BadInput(f"{where}: expected an array of numbers, found {kind}")
    return value


def _foreign_array(value: ForeignObject, where: str) -> NDArray:
    state = value.state
    kind = value.kind.rsplit(".", 1)[1]
    if kind in ("csc_matrix", "csr_matrix", "csc_array", "csr_array"):
        shape = tuple(int(n) for n in state.get("_shape", state.get("shape", ())))
        if len(shape) != 2 or shape[0] * shape[1] > MAX_ELEMENTS:
            raise BadInput(f"{where}: a sparse matrix of shape {shape}")
        from scipy import sparse

        matrix = getattr(sparse, kind)((state["data"], state["indices"], state["indptr"]), shape)
        return matrix.toarray().astype(np.float64)
    if "idxs" in state:  # chumpy.reordering.Select: a slice of another object
        selected = _plain_array(state["a"], where).ravel()[np.asarray(state["idxs"])]
        return selected.reshape(state.get("preferred_shape", -1))
    if kind == "transpose":
        return np.transpose(_plain_array(state["a"], where), state.get("axes"))
    if kind == "reshape":
        return _plain_array(state["a"], where).reshape(state["newshape"])
    if "x" in state:
        return _plain_array(state["x"], where)
    raise BadInput(f"{where}: a {value.kind} object this bench cannot read; save the file again with plain arrays")


def _body_from_arrays(arrays: Mapping[str, NDArray], path: Path, uv_path: Path | None, n_betas: int | None) -> Body:
    check_arrays(arrays, path)
    faces = arrays["f"].astype(np.int32)
    weights = arrays["weights"].astype(np.float64)
    if arrays["weights"].dtype == np.float16:
        weights /= weights.sum(1, keepdims=True)  # half precision loses the sum of 1
    v_template = arrays["v_template"].astype(np.float64)
    J_regressor = arrays["J_regressor"].astype(np.float64)
    shapedirs = arrays["shapedirs"].astype(np.float64)
    if n_betas is not None and not 0 < n_betas <= shapedirs.shape[2]:
        raise BadInput(f"{path}: has {shapedirs.shape[2]} shape coefficients, asked for {n_betas}")
    if uv_path is None and "vt" not in arrays and path.with_name("smpl_uv.obj").is_file():
        uv_path = path.with_name("smpl_uv.obj")
    if uv_path is not None:
        uv, uv_faces = read_uv_obj(uv_path, faces)
    elif "vt" in arrays:
        uv, uv_faces = arrays["vt"].astype(np.float64), arrays["ft"].astype(np.int32)
    else:
        uv, uv_faces, _ = part_atlas(v_template, faces, weights, J_regressor @ v_template)
    return Body(
        v_template=v_template,
        shapedirs=shapedirs[:, :, :n_betas],
        posedirs=arrays["posedirs"].astype(np.float64) if "posedirs" in arrays else None,
        J_regressor=J_regressor,
        weights=weights,
        parents=np.array(PARENTS, np.int32),
        faces=faces,
        uv=uv,
        uv_faces=uv_faces,
        name=str(arrays.get("name", "smpl")),
        face_landmarks=arrays["face_landmarks"].astype(np.float64) if "face_landmarks" in arrays else None,
    )


def check_arrays(arrays: Mapping[str, NDArray], path: Path) -> None:
    """Raise `BadInput` unless the arrays make one consistent SMPL-shaped body."""
    missing = [key for key in REQUIRED if key not in arrays]
    if missing:
        raise BadInput(f"{path}: not an SMPL body file, it lacks {', '.join(missing)}; {WHERE_SMPL_IS}")
    V, F = len(np.atleast_1d(arrays["v_template"])), len(np.atleast_1d(arrays["f"]))
    if arrays["kintree_table"].shape != (2, 24):
        raise BadInput(
            f"{path}: kintree_table has shape {arrays['kintree_table'].shape}, expected (2, 24): "
            "this is not SMPL (SMPL-H and SMPL-X have 52 and 55 joints); give an SMPL file"
        )
    expected: dict[str, tuple[int | None, ...]] = {
        "kintree_table": (2, 24),
        "v_template": (V, 3),
        "f": (F, 3),
        "weights": (V, 24),
        "J_regressor": (24, V),
        "shapedirs": (V, 3, None),
        "posedirs": (V, 3, 207),
        "vt": (None, 2),
        "ft": (F, 3),
        "face_landmarks": (3,),
    }
    for key, shape in expected.items():
        if key in arrays:
            _check_array(arrays[key], shape, f"{path}: {key}")
    parents = arrays["kintree_table"][0].astype(np.int64)
    if tuple(parents[1:]) != PARENTS[1:] or parents[0] not in (-1, 2**32 - 1):
        raise BadInput(f"{path}: kintree_table: expected SMPL's 24 joints in SMPL's order")
    _check_indices(arrays["f"], V, f"{path}: f")
    if ("vt" in arrays) != ("ft" in arrays):
        raise BadInput(f"{path}: has only one of vt and ft, expected both or neither")
    if "vt" in arrays:
        _check_indices(arrays["ft"], len(arrays["vt"]), f"{path}: ft")
    if np.abs(arrays["weights"].astype(np.float64).sum(1) - 1).max() > 0.01:
        raise BadInput(f"{path}: weights: expected rows that sum to 1")
    height = float(np.ptp(arrays["v_template"], axis=0).max())
    if not 0.3 < height < 3:
        raise BadInput(f"{path}: v_template is {height:.3g} across, expected a person in metres (0.3 to 3)")


def _check_array(array: NDArray, shape: tuple[int | None, ...], where: str) -> None:
    fits = array.ndim == len(shape) and all(n in (None, m) for n, m in zip(shape, array.shape, strict=True))
    if not fits or array.size == 0:
        expected = ", ".join("any" if n is None else str(n) for n in shape)
        raise BadInput(f"{where} has shape {array.shape}, expected ({expected})")
    if array.dtype.kind not in "biuf" or not np.isfinite(array).all():
        raise BadInput(f"{where}: expected finite numbers")


def _check_indices(faces: NDArray, count: int, where: str) -> None:
    if faces.dtype.kind not in "iu" or faces.min() < 0 or faces.max() >= count:
        raise BadInput(f"{where}: expected whole numbers from 0 to {count - 1}")


def write_body(path: str | Path, body: Body) -> None:
    """Write a body as a `.npz` that `load_body` reads back, in full precision."""
    arrays = {
        "v_template": body.v_template,
        "shapedirs": body.shapedirs,
        "J_regressor": body.J_regressor,
        "weights": body.weights,
        "kintree_table": np.stack([body.parents, np.arange(24, dtype=np.int32)]),
        "f": body.faces,
        "vt": body.uv,
        "ft": body.uv_faces,
        "name": np.array(body.name),
    }
    optional = {"posedirs": body.posedirs, "face_landmarks": body.face_landmarks}
    arrays |= {key: value for key, value in optional.items() if value is not None}
    write_npz(path, arrays, compressed=True)
