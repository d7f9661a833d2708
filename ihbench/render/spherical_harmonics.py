"""Colours that depend on the direction of view: real spherical harmonics up to degree 3, as 3D Gaussian splatting has
them (Kerbl et al. 2023, released code: signs and order; gsplat has the same)."""

from __future__ import annotations

import torch
from torch import Tensor

DEGREES = (0, 1, 2, 3)


def basis(directions: Tensor, degree: int) -> Tensor:
    """Unit vectors [N, 3] -> [N, (degree + 1)²] values of the basis."""
    x, y, z = directions.unbind(-1)
    values = [torch.full_like(x, 0.28209479177387814)]
    if degree > 0:
        c = 0.4886025119029199
        values += [-c * y, c * z, -c * x]
    xx, yy, zz = x * x, y * y, z * z
    if degree > 1:
        a, b = 1.0925484305920792, 0.5462742152960396
        values += [a * x * y, -a * y * z, 0.31539156525252005 * (2 * zz - xx - yy), -a * x * z, b * (xx - yy)]
    if degree > 2:
        a, b, c = 0.5900435899266435, 0.4570457994644658, 1.445305721320277
        values += [
            -a * y * (3 * xx - yy), 2 * c * x * y * z, -b * y * (4 * zz - xx - yy),
            0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
            -b * x * (4 * zz - xx - yy), c * z * (xx - yy), -a * x * (xx - 3 * yy),
        ]  # fmt: skip
    return torch.stack(values, -1)


def colors_of(coefficients: Tensor, means: Tensor, center: Tensor, degree: int) -> Tensor:
    """Coefficients [N, K, 3], K >= (degree + 1)², means [N, 3] m and the camera's centre [3] m -> colors [N, 3].

    In the coefficients' dtype, from directions in float64. A colour is the sum plus 0.5, cut at 0, where its gradient
    ends. A Gaussian in the camera's centre or with a value that is not finite gets NaN and no gradient.
    """
    used = (degree + 1) ** 2
    coefficients = coefficients[:, :used]
    toward = means.double() - center
    length = toward.detach().norm(dim=-1)
    usable = coefficients.detach().isfinite().all(-1).all(-1) & length.isfinite() & (length > 0)
    # replaced before the arithmetic: a gradient of 0 times NaN would be NaN
    toward = torch.where(usable[:, None], toward, 1.0)
    coefficients = torch.where(usable[:, None, None], coefficients, 0.0)
    directions = toward / toward.norm(dim=-1, keepdim=True)
    sums = torch.einsum("nk,nkc->nc", basis(directions, degree).to(coefficients.dtype), coefficients)
    return torch.where(usable[:, None], (sums + 0.5).clamp(min=0), torch.nan)
