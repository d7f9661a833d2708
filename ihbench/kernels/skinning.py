"""Linear blend skinning in torch, at every precision, against the float64 twin in numpy."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from ihbench.kernels.measuring import Row, Sample, interleave, peak_mib, row_of, timed

LBS_CASES = (("12k points", 128), ("50k points", 256))  # texels of a map of this side, as an avatar has them
ANGLE = 0.4  # rad, standard deviation of a joint's axis-angle components


def lbs_rows(repeats: int, cases: Sequence[tuple[str, int]] = LBS_CASES) -> list[Row]:
    """A seeded pose to joint transforms to skinned points, forward and backward; the twin is timed as well.

    The value error is the largest distance in m; the gradient's (of points and pose, for a random pull) is relative
    to the norm of torch's in float64.
    """
    import torch

    from ihbench.body import load_body, skinning_numpy, texel_table

    body = load_body()
    rng = np.random.default_rng(0)
    pose, transl = rng.normal(0, ANGLE, (24, 3)), rng.normal(0, 1, 3)
    rows = []
    for case, resolution in cases:
        texels = texel_table(body, resolution)
        points = texels.interpolate(body.v_template, body.faces)
        weights = texels.interpolate(body.weights, body.faces)
        pull = rng.normal(size=points.shape)

        def twin(points: Any = points, weights: Any = weights) -> Any:
            transforms = skinning_numpy.joint_transforms(pose, body.joints, body.parents, transl)
            return skinning_numpy.lbs(points, weights, transforms)

        exact = twin()
        given = points, pose, weights, body.joints, transl, pull
        steps: dict[str, Callable[[], Sample]] = {"numpy f64": partial(timed, twin)}
        for name, dtype in (("f64", torch.float64), ("f32", torch.float32), ("f16", torch.float16)):
            steps[f"torch {name}"] = partial(_torch_step, dtype, given, body.parents)
        timings = interleave(steps, repeats)
        *_, pulled = _skinned(torch.float64, given, body.parents)
        for name, samples in timings.items():
            value, gradient = 0.0, None
            if name != "numpy f64":
                posed, *gradients = _skinned(getattr(torch, f"float{name[-2:]}"), given, body.parents)
                value = float(np.linalg.norm(posed.double().numpy() - exact, axis=-1).max())
                gradient = max(_relative(g.double(), p) for g, p in zip(gradients[0], pulled, strict=True))
            rows.append(row_of("lbs", case, name, samples, peak_mib(steps[name]), value, gradient))
    return rows


def _leaves(dtype: Any, given: tuple) -> list[Any]:
    import torch

    points, pose, weights, joints, transl, pull = (torch.tensor(a, dtype=dtype) for a in given)
    return [points.requires_grad_(), pose.requires_grad_(), weights, joints, transl, pull]


def _forward(leaves: list[Any], parents: Any) -> Any:
    from ihbench.body import skinning

    points, pose, weights, joints, transl, _ = leaves
    return skinning.lbs(points, weights, skinning.joint_transforms(pose, joints, parents.tolist(), transl))


def _torch_step(dtype: Any, given: tuple, parents: Any) -> tuple[float, float]:
    leaves = _leaves(dtype, given)
    start = time.perf_counter()
    skinned = _forward(leaves, parents)
    middle = time.perf_counter()
    skinned.backward(leaves[-1])
    return (middle - start) * 1e3, (time.perf_counter() - middle) * 1e3


def _skinned(dtype: Any, given: tuple, parents: Any) -> tuple[Any, list[Any]]:
    """Skinned points, and the gradients of points and pose."""
    leaves = _leaves(dtype, given)
    skinned = _forward(leaves, parents)
    skinned.backward(leaves[-1])
    return skinned.detach(), [leaf.grad.double() for leaf in leaves[:2]]


def _relative(value: Any, truth: Any) -> float:
    return float((value - truth).norm() / truth.norm())
